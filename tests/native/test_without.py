# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Where no compiler was found the package is there without its extension, and numpy does all of the work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import ba_node

PACKAGE = Path(ba_node.__file__).parent
BAG = Path(__file__).parents[2] / "bags" / "mono_loop.mcap"


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that holds the package without anything compiled."""
    folder = tmp_path_factory.mktemp("tree")
    shutil.copytree(PACKAGE, folder / "ba_node", ignore=shutil.ignore_patterns("_kernels*.so", "__pycache__", "src"))
    return folder


def run(tree: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """Run ``ba`` from there."""
    command = [sys.executable, "-m", "ba_node.cli.main", *args]
    environment = os.environ | {"PYTHONPATH": str(tree)}
    return subprocess.run(command, env=environment, cwd=tree, capture_output=True, text=True, timeout=120, check=False)


def test_the_version_says_so(tree: Path) -> None:
    assert "(kernels: numpy)" in run(tree, "--version").stdout


@pytest.mark.slow
def test_a_recording_is_refined_as_well(tree: Path, tmp_path: Path) -> None:
    done = run(tree, "replay", str(BAG), "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["kernels"] == "numpy"
    assert report["trajectory_error_m"]["refined"] == pytest.approx(0.0082, abs=2e-4)
