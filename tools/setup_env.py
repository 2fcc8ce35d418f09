# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make .venv: ROS 2 Jazzy from wheels, ba_msgs built into it, ba_node installed from this folder.

Needs Python's standard library only, and does nothing when .venv is up to date. Three steps, each with a
digest of its inputs in .venv/setup.json: `packages` (a new environment), `interfaces` (ba_msgs, and for the tests what
of tf2_msgs and rtabmap_msgs they use, which are not among the wheels), `project`.
"""

from __future__ import annotations  # so that an older Python comes as far as check_python

import argparse
import contextlib
import fcntl
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from tools.env_checks import (
    SetupError,
    build_failure,
    check_platform,
    check_python,
    check_tools,
    dotted,
    include_dir,
    pip_failure,
)

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
STATE = "setup.json"
LOG = "setup.log"
STEPS = ("packages", "interfaces", "project")
# Interface packages to build, and where they are defined. One that a wheel has brought is left as it is.
INTERFACES = {
    "ba_msgs": "msg_defs",
    "rtabmap_msgs": "tests/ros/interfaces/rtabmap_msgs",
    "tf2_msgs": "tests/ros/interfaces/tf2_msgs",
}

# What makes the environment: a change in it makes it anew.
TOOLS = ("env_checks.py", "setup_env.py", "venv_hook.py")

# Variables of a sourced ROS, of another environment or of pip that would lead the steps below outside .venv.
FOREIGN_VARIABLES = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
    "PIP_PREFIX",
    "PIP_REQUIRE_VIRTUALENV",
    "PIP_TARGET",
    "PIP_USER",
    "PYTHONHOME",
    "PYTHONPATH",
)
# Set by the ROS wheels in the environment of every program they have prepared.
WHEELS_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"


@dataclass
class State:
    """What a `.venv` holds, as written in setup.json."""

    venv: str
    python: str
    done: dict[str, str] = field(default_factory=dict)


def digest(files: Iterable[Path], root: Path, seed: str = "") -> str:
    """Hash the names (relative to root) and contents of files, and a seed, into one stamp."""
    total = hashlib.sha256(seed.encode())
    for path in sorted(files):
        total.update(f"\0{path.relative_to(root)}\0{hashlib.sha256(path.read_bytes()).hexdigest()}".encode())
    return total.hexdigest()


def wanted_stamps(root: Path) -> dict[str, str]:
    """Return the stamp that each step has to carry for the files as they are now."""
    tools = [root / "tools" / name for name in TOOLS]
    packages = digest([*root.glob("requirements/*.txt"), *(path for path in tools if path.is_file())], root)
    interfaces = [path for folder in INTERFACES.values() for path in root.glob(f"{folder}/**/*") if path.is_file()]
    project = [root / name for name in ("setup.py", "setup.cfg", "package.xml")]
    project += [path for path in root.glob("ba_node/native/src/**/*") if path.is_file()]
    return {
        "packages": packages,
        "interfaces": digest(interfaces, root, packages),
        "project": digest(project, root, packages),
    }


def pending_steps(state: State | None, wanted: State) -> list[str]:
    """Return the steps still to do; all of them if the environment is new, was moved, or has other packages."""
    if state is None or (state.venv, state.python) != (wanted.venv, wanted.python):
        return list(STEPS)
    if state.done.get("packages") != wanted.done["packages"]:
        return list(STEPS)
    return [step for step in STEPS if state.done.get(step) != wanted.done[step]]


def read_state(venv: Path) -> State | None:
    """Return what setup.json says, or None if there is no working environment of ours."""
    try:
        state = State(**json.loads((venv / STATE).read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return state if (venv / "bin" / "python").exists() else None


def write_state(venv: Path, state: State) -> None:
    """Write setup.json whole or not at all."""
    fresh = venv / f"{STATE}.new"
    fresh.write_text(json.dumps(asdict(state), indent=1) + "\n")
    fresh.replace(venv / STATE)


def clean_environ(environ: Mapping[str, str], venv: Path) -> dict[str, str]:
    """Return an environment in which programs of venv come first and no other ROS is seen."""
    clean = {name: value for name, value in environ.items() if name not in (*FOREIGN_VARIABLES, WHEELS_GUARD)}
    prefixes = tuple(f"{prefix}/" for prefix in environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix)
    libraries = [path for path in clean.pop("LD_LIBRARY_PATH", "").split(os.pathsep) if path]
    if WHEELS_GUARD not in environ:  # otherwise the folders are those of an environment of ROS wheels
        kept = [path for path in libraries if not f"{path}/".startswith(prefixes)]
        if kept:
            clean["LD_LIBRARY_PATH"] = os.pathsep.join(kept)
    clean["PATH"] = os.pathsep.join([str(venv / "bin"), environ.get("PATH", os.defpath)])
    clean["VIRTUAL_ENV"] = str(venv)
    clean["AMENT_PREFIX_PATH"] = str(venv)
    return clean


def relocate_cmake(text: str, python_include: str, numpy_include: str) -> str:
    """Replace the include folders of the Python that built the wheels by those of this environment."""
    text = re.sub(r"/opt/python/[^;\"\s]*/numpy/(?:_core|core)/include", lambda _: numpy_include, text)
    return re.sub(r"/opt/python/[^;\"\s/]*/include/python3\.\d+", lambda _: python_include, text)


class Environment:
    """The `.venv` being made: runs the steps, keeps the log."""

    def __init__(self, venv: Path, root: Path) -> None:
        self.venv = venv
        self.root = root
        self.python = venv / "bin" / "python"
        self.environ = clean_environ(os.environ, venv)

    def create(self) -> None:
        """Make an empty environment, in place of an older one of ours."""
        ours = not self.venv.exists() or (self.venv / STATE).is_file() or not any(self.venv.iterdir())
        if self.venv.is_symlink() or not ours:
            raise SetupError(f"{self.venv} was not made by this project: move it away, then run make again")
        say(f"creating .venv with Python {platform.python_version()}")
        shutil.rmtree(self.venv, ignore_errors=True)
        self.venv.mkdir(exist_ok=True)
        # First of all, so that an interrupted run is known as ours.
        write_state(self.venv, State(str(self.venv), dotted(sys.version_info[:2])))
        base = getattr(sys, "_base_executable", sys.executable)
        self.run(
            [base, "-m", "venv", str(self.venv)], lambda _: "python -m venv failed; try another Python: make PYTHON=..."
        )

    def run(self, command: list[str], explain: Callable[[str], str]) -> str:
        """Run a command, append its output to the log and return it; raise SetupError with an explanation."""
        result = subprocess.run(
            command,
            cwd=self.root,
            env=self.environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
        )
        with (self.venv / LOG).open("a") as log:
            log.write(f"$ {shlex.join(command)}\n{result.stdout}\n")
        if result.returncode != 0:
            raise SetupError(f"{explain(result.stdout)} (details: {self.venv / LOG})")
        return result.stdout

    def pip(self, *arguments: str) -> None:
        """Install with the pip of the environment."""
        quiet = ("--disable-pip-version-check", "--no-input", "--progress-bar", "off")
        self.run([str(self.python), "-m", "pip", "install", *quiet, *arguments], pip_failure)

    def packages(self) -> None:
        """Install the pinned packages into a new environment."""
        self.create()
        say("installing ROS 2 Jazzy, tools and libraries (about a minute)")
        lists = self.root / "requirements"
        pinned = ("-c", str(lists / "constraints.txt"))
        self.pip(*pinned, "-r", str(lists / "build.txt"))
        groups = [
            argument for name in ("ros", "run", "extras", "dev") for argument in ("-r", str(lists / f"{name}.txt"))
        ]
        self.pip("--no-build-isolation", *pinned, *groups)
        self.relocate()
        self.hook()

    def relocate(self) -> None:
        """Correct the include folders in the CMake targets that the wheels export."""
        question = "import numpy; print(numpy.get_include())"
        numpy_include = self.run([str(self.python), "-c", question], lambda _: "numpy does not start").strip()
        for path in self.venv.glob("share/*/cmake/*.cmake"):
            text = path.read_text()
            if "/opt/python/" in text:
                path.write_text(relocate_cmake(text, str(include_dir()), numpy_include))

    def hook(self) -> None:
        """Make every Python of the environment start with variables that lead into it."""
        site = self.venv / "lib" / f"python{dotted(sys.version_info[:2])}" / "site-packages"
        shutil.copyfile(self.root / "tools" / "venv_hook.py", site / "ba_node_venv.py")
        # Such files run in alphabetical order: this one before all others.
        (site / "0_ba_node_venv.pth").write_text("import ba_node_venv\n")

    def interfaces(self) -> None:
        """Build the interface packages that are missing and install them into the environment."""
        for package in INTERFACES:
            self.remove(package)
        missing = [package for package in INTERFACES if not (self.venv / "share" / package).is_dir()]
        say(f"building {' and '.join(missing)}")
        with ThreadPoolExecutor() as pool:
            list(pool.map(self.build, missing))

    def remove(self, package: str) -> None:
        """Remove an interface package that was built here."""
        build = self.venv / "build" / package
        with contextlib.suppress(FileNotFoundError):
            installed = [Path(line) for line in (build / "install_manifest.txt").read_text().splitlines()]
            for path in installed:
                path.unlink(missing_ok=True)
            shutil.rmtree(self.venv / "share" / package, ignore_errors=True)
        shutil.rmtree(build, ignore_errors=True)

    def build(self, package: str) -> None:
        """Build an interface package and install it into the environment."""
        build = self.venv / "build" / package
        settings = {
            "BUILD_TESTING": "OFF",
            "CMAKE_BUILD_TYPE": "Release",
            "CMAKE_INSTALL_PREFIX": str(self.venv),
            "CMAKE_PREFIX_PATH": str(self.venv),
            "Python3_EXECUTABLE": str(self.python),
        }
        cmake = str(self.venv / "bin" / "cmake")
        defines = [f"-D{name}={value}" for name, value in settings.items()]
        source = str(self.root / INTERFACES[package])
        explain = partial(build_failure, package=package)
        self.run([cmake, "-S", source, "-B", str(build), "-G", "Ninja", *defines], explain)
        self.run([cmake, "--build", str(build), "--target", "install"], explain)

    def project(self) -> None:
        """Install ba_node so that changes of its files take effect at once."""
        say("building the C++ kernels and installing ba_node")
        self.pip("--no-deps", "--no-build-isolation", "--editable", str(self.root))
        # An editable installation leaves out the share folder, and the one where `ros2 run` looks for executables.
        share, programs = self.venv / "share" / "ba_node", self.venv / "lib" / "ba_node"
        index = self.venv / "share" / "ament_index" / "resource_index" / "packages"
        links = {index / "ba_node": self.root / "resource" / "ba_node"}
        links |= {share / name: self.root / name for name in ("package.xml", "config", "bags")}
        # `ros2 launch` looks for files, and not behind links to folders.
        links |= {share / "launch" / path.name: path for path in (self.root / "launch").glob("*.launch.py")}
        links |= {programs / name: self.venv / "bin" / name for name in ("ba", "ba_adapter", "ba_front_end", "ba_node")}
        if (share / "launch").is_symlink():
            (share / "launch").unlink()
        for link, target in links.items():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(target)


@contextlib.contextmanager
def locked(root: Path) -> Iterator[None]:
    """Let one process at a time work on the environment."""
    folder = os.open(root, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("waiting for another make")
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def say(text: str) -> None:
    """Print a line of progress."""
    print(f"setup: {text}", flush=True)


def pending(exact: bool) -> tuple[list[str], State]:
    """Return the steps to do and the state they lead to; exact: an environment of another Python does not count."""
    state = read_state(VENV)
    own = dotted(sys.version_info[:2])
    python = own if state is None or exact else state.python
    wanted = State(str(VENV), python, wanted_stamps(ROOT))
    return pending_steps(state, wanted), wanted


def bring_up_to_date(exact: bool) -> None:
    """Do the steps that are pending."""
    start = time.monotonic()
    with locked(ROOT):
        steps, wanted = pending(exact)
        if not steps:
            return
        check_tools(os.environ)
        environment = Environment(VENV, ROOT)
        state = read_state(VENV)
        for step in steps:
            getattr(environment, step)()
            if step == "packages":
                state = read_state(VENV)
            assert state is not None
            state.done[step] = wanted.done[step]
            write_state(VENV, state)
    say(f"done in {time.monotonic() - start:.0f} s")


def main() -> int:
    """Check or make the environment; return the exit status."""
    parser = argparse.ArgumentParser(description="Make .venv with ROS 2 Jazzy, ba_msgs and ba_node.")
    parser.add_argument("--check", action="store_true", help="only say by the exit status whether .venv is up to date")
    parser.add_argument("--exact", action="store_true", help="make .venv anew if it has another Python than this one")
    arguments = parser.parse_args()
    if arguments.check:
        return 1 if pending(arguments.exact)[0] else 0
    try:
        check_platform(platform.system(), platform.machine())
        check_python(sys.version_info[:2])
        bring_up_to_date(arguments.exact)
    except SetupError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("setup: interrupted; the next make goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
