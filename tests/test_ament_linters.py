# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The linters of ament, as `colcon test` runs them; each is left out where it is not installed."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.linter

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = [str(ROOT / name) for name in ("ba_node", "experiments", "launch", "tests", "tools")]
# Files that ament_copyright looks at where a folder is under version control.
LICENCE = [str(ROOT / name) for name in ("CONTRIBUTING.md", "LICENSE")]
MANIFESTS = [str(ROOT / name) for name in ("package.xml", "msg_defs/package.xml", "config")]
NO_SCHEMA = "failed to load external entity"


def test_copyright(capfd: pytest.CaptureFixture[str]) -> None:
    linter = pytest.importorskip("ament_copyright.main", reason="ament_copyright is not installed")
    known = pytest.importorskip("ament_copyright").get_licenses()
    if "apache2_spdx" not in known:
        pytest.skip("ba_node is not installed with its entry points, so ament_copyright does not know SPDX lines")
    code = linter.main([*FOLDERS, str(ROOT / "msg_defs"), *LICENCE])
    assert code == 0, capfd.readouterr().err


@pytest.mark.slow  # ruff has looked at the same by then
def test_flake8() -> None:
    pytest.importorskip("ament_flake8.main", reason="ament_flake8 is not installed")
    # Its workers are forked, which a process must not do that other tests have given threads.
    program = "import sys; from ament_flake8.main import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "--config", str(ROOT / "setup.cfg"), *FOLDERS]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.slow
def test_pep257(capfd: pytest.CaptureFixture[str]) -> None:
    """Docstrings as Google writes them; tests say by their names what they do."""
    linter = pytest.importorskip("ament_pep257.main", reason="ament_pep257 is not installed")
    style = ["--convention", "google", "--add-ignore", "D105", "D107"]
    code = linter.main([*style, "--", *(folder for folder in FOLDERS if not folder.endswith("tests"))])
    assert code == 0, capfd.readouterr().err


def test_xmllint(capfd: pytest.CaptureFixture[str]) -> None:
    linter = pytest.importorskip("ament_xmllint.main", reason="ament_xmllint is not installed")
    if shutil.which("xmllint") is None:
        pytest.skip("the program xmllint is not installed")
    code = linter.main(MANIFESTS)
    told = capfd.readouterr()
    if NO_SCHEMA in told.out + told.err:
        pytest.skip("the schema of package.xml cannot be fetched here")
    assert code == 0, told.err
