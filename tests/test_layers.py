# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The layers, asserted from the imports: each module may use what stands below it, and nothing else."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

from tools.draw_architecture import LAYERS

PACKAGE = Path(__file__).resolve().parent.parent / "ba_node"

# A module may import modules of the layers before its own, and of its own layer where SAME says so.
RANK = {name: rank for rank, names in enumerate(LAYERS.values()) for name in names}
# Who may use its neighbours in a layer, and which of them.
SAME = {
    "config": {"kept"},
    "estimate": {"measurements"},
    "scene": {"measurements"},
    "io": {"messages"},
    "offline": {"ros"},
    "cli": {"offline", "ros"},
}
ROS_ONLY = (
    "rclpy",
    "action_msgs",
    "ba_msgs",
    "diagnostic_msgs",
    "geometry_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
    "tf2_msgs",
    "visualization_msgs",
)
# What stands above the back-end uses its face, and of the numerics only what describes arrays.
BEHIND_THE_FACE = ("scene", "window", "check")
NUMERICS_FOR_ALL = ("geometry", "cameras", "problem")
# `ba solve` and what belongs to it work on a file, without a back-end.
WITHOUT_BACKEND = (
    "offline/bal_share.py",
    "offline/ranks.py",
    "offline/solve_bal.py",
    "offline/solve_model.py",
    "offline/solve_ranks.py",
    "offline/solver_settings.py",
)
MODULES = sorted(PACKAGE.rglob("*.py"))


def unit(path: Path) -> str:
    """Return the module or folder directly below the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> list[str]:
    """Return the full names of everything that a file imports anywhere, for typing too."""
    names = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def test_nothing_installed_imports_what_is_not() -> None:
    outside = {"experiments", "tests", "tools"}
    found = {(path.name, name) for path in MODULES for name in imports(path) if name.split(".")[0] in outside}
    assert not found


def test_every_module_has_a_layer() -> None:
    units = {unit(path) for path in MODULES} - {"__init__"}
    assert units == set(RANK)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_down(path: Path) -> None:
    here = unit(path)
    for name in imports(path):
        parts = name.split(".")
        if parts[0] in ROS_ONLY:
            assert here == "ros", f"{path} imports {name}"
        if parts[0] != "ba_node" or here == "__init__" or parts[1] in (here, "__version__"):
            continue
        if RANK[here] > RANK["backend"]:
            assert parts[1] not in BEHIND_THE_FACE, f"{path} reaches below the back-end: {name}"
            if parts[1] == "core" and str(path.relative_to(PACKAGE)) not in WITHOUT_BACKEND:
                assert parts[2] in NUMERICS_FOR_ALL, f"{path} reaches into the core: {name}"
        below = RANK[parts[1]] < RANK[here] or parts[1] in SAME.get(here, ())
        assert below, f"{here} may not import {parts[1]} ({name} in {path.name})"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_nothing_reaches_through_the_face(path: Path) -> None:
    """The tables of a map are its back-end's own: nothing above takes them by ``backend.scene``."""
    if RANK.get(unit(path), 0) <= RANK["backend"]:
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and node.attr == "scene":
            owner = node.value.attr if isinstance(node.value, ast.Attribute) else getattr(node.value, "id", "")
            assert owner.endswith("config"), f"{path}, line {node.lineno}: {owner}.scene"


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("ba_node.config", ("numpy",)),
        ("ba_node.core.methods", ("mcap", "rosbags", "rclpy", "yaml")),
        ("ba_node.backend", ("mcap", "rosbags", "matplotlib", *ROS_ONLY)),
        ("ba_node.offline.replay", ("matplotlib", *ROS_ONLY)),
    ],
)
def test_import_brings_nothing_from_above(module: str, absent: tuple[str, ...]) -> None:
    script = f"import {module}, sys; print(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.split())
    assert "ba_node" in loaded
    assert not loaded & set(absent), f"{module} brings {sorted(loaded & set(absent))}"


def test_no_files_import_each_other_in_a_circle() -> None:
    """Not for typing either."""
    names = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in MODULES}

    def files(path: Path) -> set[str]:
        """Return the files that one imports, or of which it imports a name."""
        return {part for name in imports(path) for part in (name, name.rpartition(".")[0]) if part in names}

    arrows = {name: files(path) for name, path in names.items()}
    assert sum(map(len, arrows.values())) > len(names)
    list(graphlib.TopologicalSorter(arrows).static_order())  # raises CycleError with the files
