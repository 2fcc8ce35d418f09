# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of Sphinx; `make docs` builds the pages, rosdoc2 finds them by rosdoc2.yaml."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))
# So wide are the help texts of the commands, whatever terminal this runs in.
os.environ["COLUMNS"] = "100"

from ba_node import __version__  # noqa: E402
from ba_node.cli.main import COMMANDS, GROUPS, build_parser  # noqa: E402

project, author, release = "ba_node", "The ba_node Authors", __version__
project_copyright = "2026, The ba_node Authors"
extensions = ["myst_parser"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"ba_node {release}"
html_static_path: list[str] = []
exclude_patterns = ["_build"]
# Fonts and scripts are those of the theme alone: a page looks the same without a network.
html_theme_options = {"navigation_with_keys": True}

_STRAY = "<!-- all other pages -->"
_OUTSIDE = re.compile(r"\[([^\]\n]+)\]\(\.\./[^)\s]+\)")


def commands_page() -> str:
    """Return the help texts of all commands by group."""
    parts = ["# Commands\n", "What `ba COMMAND --help` says of each.\n"]
    for title, names in GROUPS.items():
        parts.append(f"## {title[0].upper()}{title[1:]}\n")
        for name in names:
            subparsers = build_parser(name)._subparsers
            assert subparsers is not None
            choices: Any = subparsers._group_actions[0].choices
            parts.append(f"### ba {name}\n\n{COMMANDS[name]}.\n\n```text\n{choices[name].format_help()}```\n")
    return "\n".join(parts)


def index_page(text: str) -> str:
    """Return the contents with names for ``fleet*``, and all pages that nothing names at the end."""
    pages = sorted(path.stem for path in DOCS.glob("*.md") if path.stem != "index")
    text = re.sub(
        r"^(\w+)\*$", lambda m: "\n".join(page for page in pages if page.startswith(m[1])), text, flags=re.MULTILINE
    )
    others = [page for page in pages if not re.search(rf"^{page}$", text, re.MULTILINE)]
    return text.replace(_STRAY, "\n".join(others))


def read_page(_app: object, name: str, source: list[str]) -> None:
    """Put what is generated into a page, and leave links to files that are no pages as text."""
    if name == "commands":
        source[0] = commands_page()
    if name == "index":
        source[0] = index_page(source[0])
    source[0] = _OUTSIDE.sub(r"`\1`", source[0])


def setup(app: Any) -> None:
    """Have pages read by :func:`read_page`, and those that others make stale read every time."""
    app.connect("source-read", read_page)
    app.connect("env-get-outdated", lambda *_: ["commands", "index"])
