# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-ends of examples/, into the node over a real middleware."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ba_node.ros.message_factory import RclpyFactory

pytestmark = pytest.mark.dds

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
STUBS = Path(__file__).resolve().parent / "stubs"
FACTORY = RclpyFactory()
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


@pytest.mark.slow
def test_the_python_example_feeds_the_node(start_node: StartNode) -> None:
    node = start_node()
    command = [sys.executable, str(EXAMPLES / "front_end.py")]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert run.returncode == 0, run.stdout + run.stderr
    before, after = (float(value) for value in re.findall(r": ([0-9.]+) m from the truth", run.stdout))
    assert after < 0.8 * before, run.stdout
    assert "20 of 20 keyframes came back" in run.stdout
    assert node.stop() == 0


@pytest.mark.slow
def test_the_cpp_example_compiles_against_the_messages(tmp_path: Path) -> None:
    """And runs, with a stand-in for rclcpp, which the wheels do not bring."""
    prefix = next((p for p in _prefixes() if (p / "include" / "ba_msgs" / "ba_msgs" / "msg").is_dir()), None)
    compiler = shutil.which(os.environ.get("CXX", "c++"))
    if prefix is None or compiler is None:
        pytest.skip("no C++ headers of ba_msgs, or no C++ compiler")
    source = str(EXAMPLES / "front_end.cpp")
    # Those that ba_msgs builds on may stand in another prefix, below which it was laid.
    found = [folder for one in _prefixes() for folder in (one / "include").glob("*") if folder.is_dir()]
    include = [f"-I{folder}" for folder in found]
    command = [compiler, "-std=c++17", "-Wall", "-Werror", source, "-o", "front_end", f"-I{STUBS}", *include]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    assert subprocess.run([tmp_path / "front_end"], check=False).returncode == 0


def test_the_cpp_example_builds_with_rclcpp(tmp_path: Path) -> None:
    header = next((p for p in _prefixes() if (p / "include" / "rclcpp").is_dir()), None)
    if header is None:
        pytest.skip("rclcpp is not installed here (the wheels bring rclpy alone)")
    shutil.copy(EXAMPLES / "front_end.cpp", tmp_path)
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(front_end CXX)\nfind_package(rclcpp REQUIRED)\n"
        "find_package(ba_msgs REQUIRED)\nadd_executable(front_end front_end.cpp)\n"
        "target_link_libraries(front_end rclcpp::rclcpp ${ba_msgs_TARGETS})\n"
    )
    for command in (["cmake", "-S", ".", "-B", "b"], ["cmake", "--build", "b"]):
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr


def _prefixes() -> list[Path]:
    return [Path(sys.prefix), *(Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p)]
