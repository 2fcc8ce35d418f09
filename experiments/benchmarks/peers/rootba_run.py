# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run rootba (TU Munich): Schur complement, square root, or the power series of PoBA, in double precision."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ba_node.io.bal import write_bal
from experiments.benchmarks.peers.frames import bal_cameras
from experiments.benchmarks.problem_file import write_state
from experiments.benchmarks.trace import arguments

FloatArray = NDArray[np.float64]

# eta 0.01, as PoBA's authors have it, gets sc and power to 1 % and 0.1 % sooner than the default of 0.1, but not qr.
_SOLVERS = {
    "sc": ["SCHUR_COMPLEMENT", "--eta", "0.01"],
    "qr": ["SQUARE_ROOT"],
    "power": ["POWER_SCHUR_COMPLEMENT", "--eta", "0.01"],
    "power-50": ["POWER_SCHUR_COMPLEMENT", "--eta", "0.01", "--power-order", "50"],
}


def _read_solution(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return cameras (n, 9) as in BAL and points (m, 3) of a saved problem.

    After two strings: cameras, each t (3), quaternion xyzw (4), f, k1, k2, in a frame that looks along z; then points,
    each with its observations (int32, 2 float64).
    """
    data, place = path.read_bytes(), 0

    def take(kind: type, count: int) -> NDArray[Any]:
        nonlocal place
        values: NDArray[Any] = np.frombuffer(data, kind, count, place)
        place += values.nbytes
        return values

    for _ in range(2):
        take(np.uint8, int(take(np.uint64, 1)[0]))
    cameras = take(np.float64, 10 * int(take(np.uint64, 1)[0])).reshape(-1, 10)
    points = np.empty((int(take(np.uint64, 1)[0]), 3))
    for row in points:
        row[:] = take(np.float64, 3)
        take(np.uint8, 20 * int(take(np.uint64, 1)[0]))
    rotation = Rotation.from_quat(cameras[:, 3:7]).as_matrix()
    return bal_cameras(rotation, cameras[:, :3], cameras[:, 7:]), points


def main() -> None:
    """Solve; --config is ``PROGRAM:`` and one of _SOLVERS. Times, objectives and memory are those of its log."""
    args, case = arguments(__doc__ or "")
    program, _, kind = args.config.rpartition(":")
    with tempfile.TemporaryDirectory(prefix="ba_rootba_") as name:
        folder = Path(name)
        problem, log, solved = folder / "problem.txt", folder / "log.json", folder / "solved.bin"
        write_bal(problem, case.bal)
        loss = ["--residual-robust-norm", "HUBER", "--residual-huber-parameter", repr(args.scale)]
        command = [
            program,
            "--config",
            os.devnull,
            "--input",
            str(problem),
            "--no-normalize",
            "--init-depth-threshold",
            "0",
        ]
        command += ["--solver-type", *_SOLVERS[kind], "--use-double", "--optimized-cost", "ERROR"]
        command += loss if args.loss == "huber" else ["--residual-robust-norm", "NONE"]
        command += ["--max-num-iterations", str(args.iterations), "--function-tolerance", repr(args.tolerance)]
        command += ["--num-threads", str(args.threads), "--verbosity-level", "0", "--quiet"]
        command += ["--log-log-path", str(log), "--log-save-log-flags", "JSON"]
        command += ["--save-output", "--output-optimized-path", str(solved)]
        subprocess.run(command, check=True, capture_output=True, env=os.environ)
        rows = json.loads(log.read_text())
        cameras, points = _read_solution(solved)
    # Steps that were not taken keep the objective before them.
    trace: list[tuple[float, float]] = []
    for time, cost, taken in zip(rows["cumulative_time"], rows["cost"], rows["step_is_successful"], strict=True):
        trace.append((time, cost if taken or not trace else trace[-1][1]))
    memory = {"start_mb": rows["resident_memory"][0] / 2**20, "peak_mb": max(rows["resident_memory"]) / 2**20}
    told = {"version": f"rootba {kind}", "reason": "", "total_s": trace[-1][0], "trace": trace, **memory}
    args.trace.write_text(json.dumps(told))
    write_state(args.state, cameras, points)


if __name__ == "__main__":
    main()
