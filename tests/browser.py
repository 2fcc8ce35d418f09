# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Open pages in a browser without a window."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from html import unescape
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_DRAW_MS = 60_000
_TIMEOUT_S = 300


class BrowserError(ValueError):
    """A page that a browser reports an error of."""


def browse(page: Path) -> str:
    """Open a page from its file and return what stands in it then, as HTML.

    Raises:
        BrowserError: an error was reported on the console, or a script failed.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)))
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"]
        command += [f"--user-data-dir={profile}", f"--virtual-time-budget={_DRAW_MS}", "--dump-dom"]
        command += ["--window-size=1366,900", page.resolve().as_uri()]
        run = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True)
    failed = re.search(r'<body[^>]* data-failed="([^"]*)"', run.stdout)
    if failed:
        raise BrowserError(f"{page}: the browser reports: {unescape(failed[1])}")
    return run.stdout
