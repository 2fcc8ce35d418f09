# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The launch files: what can be told from their text, and with `launch` installed, what they describe."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

import pytest

from ba_node.config import declarations

ROOT = Path(__file__).resolve().parent.parent
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
ARGUMENTS = {"namespace", "params_file", "use_sim_time", "autostart", "log_level"}


def _calls(tree: ast.Module, name: str) -> list[ast.Call]:
    return [n for n in ast.walk(tree) if isinstance(n, ast.Call) and getattr(n.func, "id", "") == name]


def _first(calls: list[ast.Call]) -> set[str]:
    """Return the first arguments that are given as they are."""
    return {str(call.args[0].value) for call in calls if call.args and isinstance(call.args[0], ast.Constant)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_names_are_those_of_the_package(path: Path) -> None:
    tree = ast.parse(path.read_text())
    constants = {
        node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    declared = _first(_calls(tree, "DeclareLaunchArgument"))
    used = _first(_calls(tree, "LaunchConfiguration"))
    assert used, "nothing is configurable"
    assert used - declared <= {"namespace"}, f"used but not declared: {used - declared}"
    scripts = (ROOT / "setup.py").read_text()
    keywords = [k for call in _calls(tree, "Node") + _calls(tree, "ExecutableInPackage") for k in call.keywords]
    executables = {str(k.value.value) for k in keywords if k.arg == "executable" and isinstance(k.value, ast.Constant)}
    assert executables
    assert all(f'"{name} = ba_node.' in scripts for name in executables), executables
    groups = {p.name.split(".")[0] for p in declarations()}
    dotted = {c for c in constants if c.count(".") == 1 and c.split(".")[0] in groups}
    assert dotted <= {p.name for p in declarations()}


def test_the_node_is_launched_with_every_argument() -> None:
    assert {path.name for path in FILES} >= {"ba_node.launch.py", "replay.launch.py"}
    tree = ast.parse((ROOT / "launch" / "ba_node.launch.py").read_text())
    declared, used = (_first(_calls(tree, name)) for name in ("DeclareLaunchArgument", "LaunchConfiguration"))
    assert declared == ARGUMENTS
    assert used == ARGUMENTS


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_launch_understands_it(path: Path) -> None:
    pytest.importorskip("launch_ros", reason="launch is not among the wheels; ROS itself brings it")
    spec = importlib.util.spec_from_file_location(path.name.replace(".", "_"), path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.generate_launch_description().entities
