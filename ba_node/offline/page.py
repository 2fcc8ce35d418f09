# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put figures and tables on one page that needs nothing else: plotly.js and all data are in it, packed."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from html import escape, unescape
from pathlib import Path

from ba_node.io.files import whole_file
from ba_node.offline.figures import Figure

# Browsers that draw a page without a window, for its pictures.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_DRAW_MS = 60_000
_TIMEOUT_S = 300


class PageError(ValueError):
    """A page that cannot be made, or a picture of it."""


def write_page(path: Path, title: str, figures: Sequence[Figure], head: str, tail: str = "") -> None:
    """Write a page: title, ``head`` (HTML), the figures, ``tail`` (HTML).

    Raises:
        PageError: plotly is not installed.
        OSError: the file cannot be written.
    """
    frames = (
        f"<figure{' class=wide' if figure.wide else ''}><h3>{escape(figure.title)}</h3>"
        f'<figcaption>{escape(figure.caption)}</figcaption><div class="plot" id="plot-{figure.key}"></div></figure>'
        for figure in figures
    )
    data = [{key: value for key, value in asdict(figure).items() if key != "caption"} for figure in figures]
    parts = {
        "TITLE": escape(title),
        "HEAD": head,
        "FIGURES": "\n".join(frames),
        "TAIL": tail,
        "LIBRARY": _packed(_library()),
        "DATA": _packed(json.dumps(data, separators=(",", ":")).encode()),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    text = re.sub(r"@([A-Z]+)@", lambda found: parts[found[1]], template)
    with whole_file(path) as stream:
        stream.write(text.encode())


def _library() -> bytes:
    """Return plotly.js, which comes with plotly."""
    spec = importlib.util.find_spec("plotly")
    if spec is None or spec.origin is None:
        raise PageError("no page of figures without plotly: pip install ba_node[report]")
    return Path(spec.origin).with_name("package_data").joinpath("plotly.min.js").read_bytes()


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


def write_pictures(page: Path, folder: Path) -> list[Path]:
    """Have a browser without a window draw each figure of a page, and write it as PNG.

    Raises:
        PageError: there is no such browser, or it draws nothing.
    """
    found = list(re.finditer(r'<img id="png-(\w+)" src="data:image/png;base64,([^"]+)"', browse(page, "#png")))
    if not found:
        raise PageError(f"{page}: the browser has drawn nothing of it")
    written = []
    for picture in found:
        written.append(folder / f"{picture[1]}.png")
        with whole_file(written[-1]) as stream:
            stream.write(base64.b64decode(picture[2]))
    return written


def browse(page: Path, fragment: str = "") -> str:
    """Open a page in a browser without a window and return what stands in it then, as HTML.

    Raises:
        PageError: there is no such browser, or it fails.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise PageError(f"no pictures without one of these programs: {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"]
        command += [f"--user-data-dir={profile}", f"--virtual-time-budget={_DRAW_MS}", "--dump-dom"]
        command += ["--window-size=1366,900", page.resolve().as_uri() + fragment]
        try:
            run = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=True)
        except subprocess.SubprocessError as error:
            raise PageError(f"{page}: {browser} cannot open it: {error}") from None
    failed = re.search(r'<body[^>]* data-failed="([^"]*)"', run.stdout)
    if failed:
        raise PageError(f"{page}: the browser reports: {unescape(failed[1])}")
    return run.stdout
