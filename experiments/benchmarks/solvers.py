# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The solvers: how each is started, what it can solve, and whether it is here."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ba_node import native
from experiments.benchmarks.problem_file import Case

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]


@dataclass(frozen=True)
class Solver:
    """A solver in one configuration."""

    name: str  # for tables
    command: tuple[str, ...]  # what starts it, without the arguments of trace.py
    config: str = ""  # its --config
    threads: int = 1  # its --threads
    max_observations: int | None = None  # larger problems are left out (None: none are)
    sizes: tuple[int, ...] = (6, 9)  # parameters a camera that it can leave free
    needs_in_front: bool = False  # it drops points behind a camera, so it takes part only where none starts there
    quick: bool = True  # takes part in --quick
    printed: bool = False  # its trace is what it prints, with fewer digits

    def refuses(self, case: Case, behind: bool) -> str:
        """Return why it takes no part in a problem, or an empty string."""
        n_obs = len(case.bal.observations)
        if self.max_observations is not None and n_obs > self.max_observations:
            return f"left out above {self.max_observations} observations"
        if case.size not in self.sizes:
            return f"has no camera with {case.size} free parameters"
        if behind and self.needs_in_front:
            return "drops points behind a camera"
        return ""


def find(build: Path, python: str) -> tuple[list[Solver], list[str]]:
    """Return the solvers that are here, and a line for each that is not.

    Args:
        build: where the driver of Ceres is built.
        python: interpreter with the wheels of the peers.
    """
    ours, absent = _ba_node()
    driver, reason = _ceres_driver(build)
    if driver:
        ours += [Solver(f"ceres {name}", (str(driver),), name, quick=name == "dense") for name in _CERES]
    else:
        absent.append(f"ceres: {reason}")
    # bal_sc takes the square root too, and then forms the Schur complement all the same.
    rootba = shutil.which("bal")
    if rootba is None:
        absent.append("rootba: its program bal is not on the PATH")
    for name in _ROOTBA if rootba else ():
        command = (sys.executable, "-m", "experiments.benchmarks.peers.rootba_run")
        ours.append(Solver(f"rootba {name}", command, f"{rootba}:{name}", sizes=(9,), quick=False))
    for peer in _WHEELS:
        module = peer.command[-1]
        missing = _missing_modules(python, _IMPORTS[module])
        if missing:
            absent.append(
                f"{peer.name}: no module {', '.join(missing)}: {python} -m pip install -r requirements/bench.txt"
            )
        else:
            ours.append(dataclasses.replace(peer, command=(python, "-m", f"experiments.benchmarks.peers.{module}")))
    return ours, absent


_CERES = ("dense", "sparse", "iterative")
_ROOTBA = ("sc", "qr", "power", "power-50")
_IMPORTS = {
    "pycolmap_run": ("pycolmap",),
    "gtsam_run": ("gtsam",),
    "g2o_run": ("g2opy",),
    "scipy_run": ("scipy",),
}
_WHEELS = (
    Solver("pycolmap", ("pycolmap_run",), needs_in_front=True, quick=False, printed=True, max_observations=200_000),
    Solver("gtsam", ("gtsam_run",), needs_in_front=True, quick=False, max_observations=20_000),
    Solver("g2o", ("g2o_run",), sizes=(6,), quick=False, max_observations=20_000),
    Solver("scipy", ("scipy_run",), quick=False, max_observations=20_000),
)


def _ba_node() -> tuple[list[Solver], list[str]]:
    command = (sys.executable, "-m", "experiments.benchmarks.peers.ba_node_run")
    numpy = Solver("ba_node numpy", command, "numpy", max_observations=20_000, quick=False)
    reason = native.missing("local", "huber")
    if reason:
        return [Solver("ba_node numpy", command, "numpy")], [f"ba_node native: {reason}"]
    two = Solver("ba_node 2 threads", command, "native", threads=2, quick=False)
    return [Solver("ba_node", command, "native"), two, numpy], []


def _missing_modules(python: str, names: tuple[str, ...]) -> list[str]:
    if python == sys.executable:
        return [name for name in names if importlib.util.find_spec(name) is None]
    code = "import importlib.util, sys; print(*[n for n in sys.argv[1:] if importlib.util.find_spec(n) is None])"
    done = subprocess.run([python, "-c", code, *names], capture_output=True, text=True, check=True)
    return done.stdout.split()


def _ceres_driver(build: Path) -> tuple[Path | None, str]:
    """Build the driver; return it, or None and the reason."""
    here = str(Path(sys.executable).parent)
    cmake = shutil.which("cmake", path=os.pathsep.join([here, os.environ.get("PATH", os.defpath)]))
    if cmake is None:
        return None, "no cmake to build its driver"
    build.mkdir(parents=True, exist_ok=True)
    log = build / "build.log"
    for arguments in (["-S", str(FOLDER), "-B", str(build)], ["--build", str(build)]):
        with log.open("a") as stream:
            if subprocess.run([cmake, *arguments], stdout=stream, stderr=stream, check=False).returncode:
                return None, f"its driver cannot be built (libceres-dev installed? {log})"
    return build / "ceres_driver", ""
