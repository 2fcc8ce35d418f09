# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The documentation builds as a site without a warning, names every command, and shows in a browser."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from ba_node.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site, with every warning an error."""
    if sys.version_info < (3, 11):
        pytest.skip("this Sphinx is not for Python 3.10")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(out)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return out


@pytest.mark.slow
def test_every_page_is_in_the_contents(site: Path) -> None:
    index = (site / "index.html").read_text()
    for page in DOCS.glob("*.md"):
        assert (site / f"{page.stem}.html").is_file()
        assert f'href="{page.stem}.html"' in index or page.stem == "index", f"{page.name} is nowhere in the contents"
    commands = (site / "commands.html").read_text()
    assert [name for name in COMMANDS if f"usage: ba {name} " not in commands] == []


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium")
@pytest.mark.parametrize("page", ["index", "tutorial", "methods", "commands"])
def test_pages_show_in_a_browser_without_a_network(site: Path, page: str) -> None:
    assert CHROMIUM is not None
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0", "--dump-dom"]
    address = f"file://{site}/{page}.html"
    run = subprocess.run([CHROMIUM, *options, address], capture_output=True, text=True, check=True, timeout=120)
    title = re.search(r"^# (.*)$", (DOCS / f"{page}.md").read_text(), re.MULTILINE)
    assert title is not None
    assert f"<h1>{title[1]}" in run.stdout
    assert 'class="sidebar-tree"' in run.stdout
    console = [line for line in run.stderr.splitlines() if "CONSOLE" in line]
    assert not console, console
    assert not re.findall(r'(?:src|href)="(https?://[^"]+\.(?:js|css|woff2?))"', run.stdout), "needs a network"


def test_rosdoc2_finds_the_pages() -> None:
    head, settings = yaml.safe_load_all((ROOT / "rosdoc2.yaml").read_text())
    assert head == {"type": "rosdoc2 config", "version": 1}
    (builder,) = settings["builders"]
    assert (ROOT / builder["sphinx"]["sphinx_sourcedir"] / "conf.py").is_file()
    named = ET.parse(ROOT / "package.xml").find("export/rosdoc2")
    assert named is not None and named.text == "rosdoc2.yaml"


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{path.name}" for path in sorted(DOCS.glob("*.md")))])
def test_links_lead_somewhere(page: str) -> None:
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        assert target.startswith("http") or ((ROOT / page).parent / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", ["README.md", "docs/tutorial.md", "docs/recordings.md", "docs/faq.md"])
def test_pages_name_commands_that_exist(page: str) -> None:
    named = set(re.findall(r"(?:^ {4}|`|/)ba ([a-z]+)", (ROOT / page).read_text(), re.MULTILINE))
    assert named
    assert named <= set(COMMANDS), f"{page}: no such command: {named - set(COMMANDS)}"
