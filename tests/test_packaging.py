# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
import ast
import importlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

import ba_node

ROOT = Path(__file__).resolve().parent.parent
HEADER = ("Copyright 2026 The ba_node Authors", "SPDX-License-Identifier: Apache-2.0")
SOURCE_NAMES = {"Makefile", "CMakeLists.txt"}
SOURCE_SUFFIXES = {".py", ".sh", ".toml", ".cfg", ".xml", ".cpp", ".hpp", ".h"}
MADE = {".git", ".venv", "build", "install", "log", "out"}


def setup_keywords() -> dict[str, ast.expr]:
    tree = ast.parse((ROOT / "setup.py").read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setup"]
    return {keyword.arg: keyword.value for keyword in calls[0].keywords if keyword.arg}


def console_scripts() -> list[str]:
    scripts: list[str] = ast.literal_eval(setup_keywords()["entry_points"])["console_scripts"]
    return scripts


def source_files() -> list[Path]:
    """List the files under version control, or all files where there is none (an unpacked archive)."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    names = (
        listed.stdout.splitlines() if listed.returncode == 0 else [str(p.relative_to(ROOT)) for p in ROOT.rglob("*")]
    )
    paths = [ROOT / name for name in names if not MADE & set(Path(name).parts)]
    return [path for path in paths if path.is_file() and (path.suffix in SOURCE_SUFFIXES or path.name in SOURCE_NAMES)]


@pytest.mark.parametrize(
    ("folder", "name", "build_type"), [(".", "ba_node", "ament_python"), ("msg_defs", "ba_msgs", "ament_cmake")]
)
def test_manifest_is_valid(folder: str, name: str, build_type: str) -> None:
    catkin_package = pytest.importorskip("catkin_pkg.package")
    package = catkin_package.parse_package(str(ROOT / folder))
    package.validate()
    assert (package.name, package.package_format) == (name, 3)
    assert [export.content for export in package.exports if export.tagname == "build_type"] == [build_type]


def test_versions_agree() -> None:
    manifests = [ElementTree.parse(ROOT / folder / "package.xml").findtext("version") for folder in (".", "msg_defs")]
    versions = {*manifests, ast.literal_eval(setup_keywords()["version"]), ba_node.__version__}
    assert len(versions) == 1, f"package.xml, msg_defs/package.xml, setup.py and ba_node differ: {versions}"


@pytest.mark.filterwarnings("ignore:nodes.Node.traverse:DeprecationWarning")  # catkin_pkg's call of docutils
@pytest.mark.parametrize("folder", [".", "msg_defs"])
def test_changelog_ends_with_this_version(folder: str) -> None:
    changelog = pytest.importorskip("catkin_pkg.changelog")
    read = changelog.get_changelog_from_path(ROOT / folder / "CHANGELOG.rst")
    # Newest first; what comes next is gathered under Forthcoming, which is no version.
    assert "\nForthcoming\n" in (ROOT / folder / "CHANGELOG.rst").read_text()
    version, date, items = next(iter(read.foreach_version()))
    assert (version, date is None, bool(items)) == (ba_node.__version__, False, True)


@pytest.mark.parametrize("script", console_scripts())
def test_console_script_exists(script: str) -> None:
    module, function = script.split(" = ")[1].split(":")
    if module == "ba_node.ros.main":
        pytest.importorskip("rclpy")
    assert callable(getattr(importlib.import_module(module), function))


def test_files_carry_the_licence() -> None:
    files = source_files()
    assert len(files) > 10, f"only {len(files)} source files found"
    missing = [
        str(path.relative_to(ROOT)) for path in files if not all(line in path.read_text()[:500] for line in HEADER)
    ]
    assert not missing, f"without copyright and SPDX lines: {missing}"


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
def test_messages_come_with_the_node_unless_they_are_a_package_of_their_own(apart: bool, tmp_path: Path) -> None:
    """colcon looks into no folder below a package, so that setup.py builds what lies there."""
    source, tools, prefix = tmp_path / "source", tmp_path / "tools", tmp_path / "install" / "ba_node"
    source.mkdir()
    for name in ("ba_node", "config", "launch", "bags", "msg_defs", "resource", "package.xml", "setup.cfg", "setup.py"):
        (source / name).symlink_to(ROOT / name)
    for name, line in (("cmake", f'echo "$@" >> {tmp_path}/calls'), ("c++", "exit 1"), ("gcc", "exit 1")):
        tools.mkdir(exist_ok=True)
        (tools / name).write_text(f"#!/bin/sh\n{line}\n")
        (tools / name).chmod(0o755)
    if apart:
        marker = prefix.parent / "ba_msgs" / "share" / "colcon-core" / "packages" / "ba_msgs"
        marker.parent.mkdir(parents=True)
        marker.touch()
    build = ["egg_info", "--egg-base", str(tmp_path), "build", "--build-base", str(tmp_path / "build")]
    install = ["install", "--prefix", str(prefix), "--record", str(tmp_path / "log")]
    environ = {**os.environ, "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}", "CC": "false", "CXX": "false"}
    # Of another ROS than the one of this Python, which has ba_msgs.
    script = f"import os, runpy; os.environ['AMENT_PREFIX_PATH'] = {str(prefix)!r}; runpy.run_path('setup.py')"
    command = [sys.executable, "-c", script, *build, *install, "--single-version-externally-managed"]
    done = subprocess.run(command, cwd=source, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (prefix / "share" / "ba_node" / "package.xml").is_file()
    calls = (tmp_path / "calls").read_text().splitlines() if (tmp_path / "calls").exists() else []
    assert len(calls) == (0 if apart else 2), calls
    assert apart or f"-DCMAKE_INSTALL_PREFIX={prefix}" in calls[0]


def test_messages_carry_the_licence_of_the_node() -> None:
    assert (ROOT / "msg_defs" / "LICENSE").read_text() == (ROOT / "LICENSE").read_text()


def test_cmake_lists_every_message() -> None:
    listed = re.findall(
        r'"((?:msg|srv|action)/\w+\.(?:msg|srv|action))"', (ROOT / "msg_defs/CMakeLists.txt").read_text()
    )
    present = sorted(f"{path.parent.name}/{path.name}" for path in (ROOT / "msg_defs").glob("*/*.*"))
    assert sorted(listed) == present


def test_make_help_lists_every_command() -> None:
    text = (ROOT / "Makefile").read_text()
    commands = set(re.search(r"^\.PHONY: (.*)$", text, re.MULTILINE)[1].split())  # type: ignore[index]
    assert set(re.findall(r"^([\w-]+):.*## ", text, re.MULTILINE)) == commands


@pytest.mark.slow
def test_wheel_holds_all_that_is_needed_at_run_time(tmp_path: Path) -> None:
    pytest.importorskip("wheel")
    source = tmp_path / "source"
    for name in ("ba_node", "config", "experiments", "launch", "msg_defs", "resource"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("LICENSE", "package.xml", "setup.cfg", "setup.py"):
        shutil.copy(ROOT / name, source)
    subprocess.run([sys.executable, "setup.py", "-q", "sdist"], cwd=source, capture_output=True, check=True)
    with tarfile.open(next((source / "dist").glob("*.tar.gz"))) as archive:
        assert not [name for name in archive.getnames() if "experiments/" in name]
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", ".", "."]
    few = {**os.environ, "BA_NODE_TARGETS": "baseline"}  # the others hold the same names, and take minutes
    built = subprocess.run(command, cwd=source, env=few, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    with zipfile.ZipFile(next(source.glob("*.whl"))) as wheel:
        names = wheel.namelist()

    messages = {path.name for path in (ROOT / "msg_defs/msg").glob("*.msg")}
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "ba_node").rglob("*.py")}
    shared = {f"share/ba_node/{name}" for name in ("package.xml", "config/ba_node.yaml", "launch/ba_node.launch.py")}
    shared.add("share/ament_index/resource_index/packages/ba_node")
    data = f"ba_node-{ba_node.__version__}.data/data/"
    assert not [name for name in names if "experiments/" in name]
    assert messages == {Path(name).name for name in names if name.startswith("ba_node/io/ba_msgs/")}
    assert "ba_node/py.typed" in names
    assert modules <= set(names), f"not in the wheel: {modules - set(names)}"
    assert shared <= {name.removeprefix(data) for name in names}


def _needs_newer(line: str, oldest: str) -> bool | None:
    """Return whether a pinned package is for a newer Python than the oldest; None if not asked for, or not here."""
    wanted = Requirement(line)
    short = oldest.rpartition(".")[0]
    if wanted.marker and not wanted.marker.evaluate({"python_version": short, "python_full_version": oldest}):
        return None
    try:
        here = importlib.metadata.metadata(wanted.name)
    except importlib.metadata.PackageNotFoundError:
        return None
    # Of another version, which newer Pythons take, nothing is known here.
    if not wanted.specifier.contains(here["Version"]):
        return None
    # As one of them says nothing of it, and whether that is None or an error differs from version to version.
    return not all(SpecifierSet(one).contains(oldest) for one in here.get_all("Requires-Python") or ())


def test_pinned_packages_install_on_the_oldest_python() -> None:
    oldest = re.search(r'python_requires="(.+?)"', (ROOT / "setup.py").read_text())
    assert oldest is not None
    patch = f"{oldest[1].strip('>=')}.0"
    lines = [
        line
        for name in ("build", "ros", "run", "extras", "dev", "constraints")
        for line in (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    asked = {line: _needs_newer(line, patch) for line in lines}
    assert sum(newer is not None for newer in asked.values()) > 50, "hardly any is installed here"
    newer = [line for line, is_newer in asked.items() if is_newer]
    assert not newer, f"not for Python {patch}; give them a marker python_version, and another version below it"
