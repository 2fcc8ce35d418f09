# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools import env_checks, setup_env, venv_hook

ROOT = Path(__file__).resolve().parent.parent
STAMPS = {"packages": "p", "interfaces": "i", "project": "j"}


def state(venv: str = "/a/.venv", python: str = "3.11", **done: str) -> setup_env.State:
    return setup_env.State(venv, python, {**STAMPS, **done})


def test_nothing_is_pending_when_all_stamps_agree() -> None:
    assert setup_env.pending_steps(state(), state()) == []


@pytest.mark.parametrize(
    ("found", "steps"),
    [
        (None, ["packages", "interfaces", "project"]),
        (state(venv="/moved/.venv"), ["packages", "interfaces", "project"]),
        (state(python="3.12"), ["packages", "interfaces", "project"]),
        (state(packages="old"), ["packages", "interfaces", "project"]),
        (setup_env.State("/a/.venv", "3.11"), ["packages", "interfaces", "project"]),
        (setup_env.State("/a/.venv", "3.11", {"packages": "p"}), ["interfaces", "project"]),
        (state(interfaces="old"), ["interfaces"]),
        (state(project="old"), ["project"]),
    ],
    ids=[
        "new",
        "moved",
        "other Python",
        "other packages",
        "interrupted",
        "half made",
        "other messages",
        "other project",
    ],
)
def test_pending_steps(found: setup_env.State | None, steps: list[str]) -> None:
    assert setup_env.pending_steps(found, state()) == steps


def small_project(root: Path) -> Path:
    for name in ("requirements/run.txt", "msg_defs/msg/A.msg", "setup.py", "setup.cfg", "package.xml", "ba_node/a.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("before\n")
    (root / "tools").mkdir()
    (root / "tools" / "venv_hook.py").write_text("before\n")
    return root


@pytest.mark.parametrize(
    ("changed", "stamps"),
    [
        ("requirements/run.txt", {"packages", "interfaces", "project"}),
        ("tools/venv_hook.py", {"packages", "interfaces", "project"}),
        ("msg_defs/msg/A.msg", {"interfaces"}),
        ("msg_defs/msg/B.msg", {"interfaces"}),
        ("tests/ros/interfaces/tf2_msgs/msg/C.msg", {"interfaces"}),
        ("package.xml", {"project"}),
        ("ba_node/a.py", set()),
    ],
)
def test_a_change_reaches_the_stamps_that_depend_on_it(tmp_path: Path, changed: str, stamps: set[str]) -> None:
    root = small_project(tmp_path)
    before = setup_env.wanted_stamps(root)
    (root / changed).parent.mkdir(parents=True, exist_ok=True)
    (root / changed).write_text("after\n")
    after = setup_env.wanted_stamps(root)
    assert {step for step in before if before[step] != after[step]} == stamps


def test_state_is_read_back_only_where_python_runs(tmp_path: Path) -> None:
    setup_env.write_state(tmp_path, state())
    assert setup_env.read_state(tmp_path) is None
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to(sys.executable)
    assert setup_env.read_state(tmp_path) == state()
    (tmp_path / setup_env.STATE).write_text('{"venv": "/a')
    assert setup_env.read_state(tmp_path) is None


@pytest.mark.parametrize("version", [(3, 10), (3, 11), (3, 12), (3, 13)])
def test_supported_python(version: tuple[int, int]) -> None:
    env_checks.check_python(version)


@pytest.mark.parametrize("version", [(3, 9), (3, 14)])
def test_unsupported_python_names_the_way_out(version: tuple[int, int]) -> None:
    expected = rf"Python 3\.{version[1]} is not supported.*3\.10 to 3\.13.*make PYTHON=python3\.12"
    with pytest.raises(env_checks.SetupError, match=expected):
        env_checks.check_python(version)


def test_other_platform_is_sent_to_an_installed_ros() -> None:
    env_checks.check_platform("Linux", "x86_64")
    with pytest.raises(env_checks.SetupError, match=r"this is Linux aarch64: install ROS 2 Jazzy.*colcon build"):
        env_checks.check_platform("Linux", "aarch64")


def test_missing_compiler_names_the_way_out(tmp_path: Path) -> None:
    names = ("c++", "g++", "clang++")
    with pytest.raises(env_checks.SetupError, match=r"no C\+\+ compiler.*build-essential.*CXX"):
        env_checks.check_compiler("CXX", "C++", names, {"PATH": str(tmp_path)})
    with pytest.raises(env_checks.SetupError, match=r"CXX=icpx is not a program"):
        env_checks.check_compiler("CXX", "C++", names, {"PATH": str(tmp_path), "CXX": "icpx -O2"})
    (tmp_path / "clang++").touch(mode=0o755)
    env_checks.check_compiler("CXX", "C++", names, {"PATH": str(tmp_path)})


def test_missing_headers_name_the_way_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("sysconfig.get_path", lambda _: str(tmp_path))
    monkeypatch.setattr("sysconfig.get_config_var", lambda _: None)
    with pytest.raises(
        env_checks.SetupError, match=r"Python\.h .* is missing: install it \(sudo apt install python3\.\d+-dev\)"
    ):
        env_checks.check_tools(os.environ)
    (tmp_path / "Python.h").touch()
    assert env_checks.include_dir() == str(tmp_path)


def test_cmake_targets_get_the_folders_of_this_environment() -> None:
    exported = (
        'INTERFACE_INCLUDE_DIRECTORIES "/opt/python/cp312-cp312/include/python3.12;'
        '/opt/python/cp312-cp312/lib/python3.12/site-packages/numpy/_core/include;${_IMPORT_PREFIX}/include"'
    )
    moved = setup_env.relocate_cmake(exported, "/py/include", "/venv/numpy/include")
    assert moved == 'INTERFACE_INCLUDE_DIRECTORIES "/py/include;/venv/numpy/include;${_IMPORT_PREFIX}/include"'
    assert setup_env.relocate_cmake(moved, "/other", "/other") == moved


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        (
            "ERROR: Could not find a version that satisfies the requirement mcap==1.6.0 (from versions: none)",
            "cannot install mcap==1.6.0: the package index cannot be reached",
        ),
        (
            "ERROR: No matching distribution found for mcap==99",
            "cannot install mcap==99: the package index has no such",
        ),
        ("OSError: [Errno 28] No space left on device", "cannot install the packages: the disk is full"),
        ("ReadTimeoutError: timed out", "cannot install the packages: the package index cannot be reached"),
    ],
)
def test_pip_failure_is_one_line(output: str, expected: str) -> None:
    explanation = env_checks.pip_failure(output)
    assert explanation.startswith(expected)
    assert "\n" not in explanation


def test_build_failure_quotes_the_first_error() -> None:
    output = "-- ok\nCMake Error at CMakeLists.txt:7 (find_package):\n  No package std_msgs\n\nmore\n"
    expected = "cannot build ba_msgs: CMake Error at CMakeLists.txt:7 (find_package): No package std_msgs"
    assert env_checks.build_failure(output, "ba_msgs") == expected


def test_setup_sees_no_other_ros() -> None:
    sourced = {
        "AMENT_PREFIX_PATH": "/ros/ws:/opt/ros/jazzy",
        "LD_LIBRARY_PATH": "/opt/ros/jazzy/lib:/opt/gcc/lib64",
        "PATH": "/usr/bin",
        "PIP_USER": "1",
        "PYTHONPATH": "/opt/ros/jazzy/lib/python3.12/site-packages",
    }
    clean = setup_env.clean_environ(sourced, Path("/v"))
    assert clean == {
        "AMENT_PREFIX_PATH": "/v",
        "LD_LIBRARY_PATH": "/opt/gcc/lib64",
        "PATH": "/v/bin:/usr/bin",
        "VIRTUAL_ENV": "/v",
    }


def test_environment_of_other_wheels_is_not_passed_on() -> None:
    prepared = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "LD_LIBRARY_PATH": "/other/lib", "PATH": "/usr/bin"}
    assert "/other/lib" not in setup_env.clean_environ(prepared, Path("/v")).values()


def test_started_python_leaves_a_sourced_ros() -> None:
    environ = {
        "AMENT_PREFIX_PATH": "/opt/ros/jazzy",
        "LD_LIBRARY_PATH": "/opt/ros/jazzy/lib",
        "PYTHONPATH": "/mine:/opt/ros/jazzy/lib/python3.12/site-packages",
    }
    venv_hook.enter(environ, "/v")
    assert environ == {"AMENT_PREFIX_PATH": "/v", "LD_LIBRARY_PATH": "", "PYTHONPATH": "/mine"}


def test_started_python_keeps_a_workspace_built_on_it() -> None:
    overlay = {
        "AMENT_PREFIX_PATH": "/ws/install/ba_msgs:/v",
        "LD_LIBRARY_PATH": "/ws/install/ba_msgs/lib",
        "PYTHONPATH": "/ws/install/ba_msgs/lib/python3.12/site-packages",
    }
    started = dict(overlay)
    venv_hook.enter(started, "/v")
    assert started == overlay


def test_started_python_keeps_its_own_libraries_and_drops_those_of_others() -> None:
    own = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "AMENT_PREFIX_PATH": "/v", "LD_LIBRARY_PATH": "/v/lib:/v/ros.libs"}
    started = dict(own)
    venv_hook.enter(started, "/v")
    assert started == own
    other = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "LD_LIBRARY_PATH": "/w/lib"}
    venv_hook.enter(other, "/v")
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in other


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["python", "/v/bin/ba", "replay"], 130, "ba: interrupted\n"),
        (["python", "-m", "ba_node.cli.main"], 130, "ba: interrupted\n"),
        (["python", "bar"], 0, "mine\n"),
    ],
)
def test_a_python_that_starts_is_interrupted_quietly_where_it_is_to_run_ba(
    words: list[str], code: int, told: str
) -> None:
    script = (
        "import signal, sys; from tools import venv_hook\n"
        "signal.signal(signal.SIGINT, lambda *_: print('mine', file=sys.stderr))\n"
        f"venv_hook.end_quietly({words!r})\n"
        "signal.raise_signal(signal.SIGINT)"
    )
    environ = {**os.environ, venv_hook.WHEELS_GUARD: "1"}
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environ, capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stderr) == (code, told)


def test_shell_and_python_agree_on_the_versions() -> None:
    script = (ROOT / "tools" / "setup.sh").read_text()
    accepted = re.search(r"^ *((?:3\.\d+ ?\|? ?)+)\)", script, re.MULTILINE)
    assert accepted is not None
    (_, lowest), (_, highest) = env_checks.SUPPORTED
    assert accepted[1].split(" | ") == [f"3.{minor}" for minor in range(lowest, highest + 1)]


def test_shell_names_the_pythons_it_tried(tmp_path: Path) -> None:
    old = tmp_path / "python3.8"
    old.write_text("#!/bin/sh\necho 3.8\n")
    old.chmod(0o755)
    script = ["sh", str(ROOT / "tools" / "setup.sh")]
    result = subprocess.run(script, env={**os.environ, "PYTHON": str(old)}, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    assert f"tried {old} (3.8); choose one" in result.stderr


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_alone_prints_the_commands() -> None:
    listed = subprocess.run(["make", "-s"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    named = [line.split()[0] for line in listed.splitlines()]
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    assert named == phony[1].split()
    assert {"setup", "demo", "test", "lint"} <= set(named)


def test_only_interfaces_that_no_wheel_brought_are_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    monkeypatch.setattr(setup_env.Environment, "build", lambda _, package: built.append(package))
    environment = setup_env.Environment(tmp_path, ROOT)
    environment.interfaces()
    (tmp_path / "share" / "tf2_msgs").mkdir(parents=True)
    environment.interfaces()
    assert sorted(built[:3]) == ["ba_msgs", "rtabmap_msgs", "tf2_msgs"]
    assert sorted(built[3:]) == ["ba_msgs", "rtabmap_msgs"]


def test_what_was_built_before_is_removed_first(tmp_path: Path) -> None:
    share, build = tmp_path / "share" / "tf2_msgs", tmp_path / "build" / "tf2_msgs"
    share.mkdir(parents=True)
    build.mkdir(parents=True)
    library = tmp_path / "libtf2_msgs.so"
    library.touch()
    (build / "install_manifest.txt").write_text(f"{library}\n{share / 'package.xml'}\n")
    setup_env.Environment(tmp_path, ROOT).remove("tf2_msgs")
    assert not library.exists() and not share.exists() and not build.exists()
