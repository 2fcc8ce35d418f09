# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run ba_node on one problem."""

from __future__ import annotations

import dataclasses

import numpy as np

import ba_node
from ba_node.core.geometry import so3_log
from ba_node.core.methods import METHODS
from ba_node.core.result import Iteration
from ba_node.core.solver import solve
from experiments.benchmarks.problem_file import case_problem, write_state
from experiments.benchmarks.trace import Recorder, arguments


def main() -> None:
    """Solve with method auto; --config is the backend."""
    args, case = arguments(__doc__)
    options = dataclasses.replace(
        METHODS["auto"],
        loss=args.loss,
        loss_scale_px=args.scale,
        cheirality="keep",
        kernels=args.config or "native",
        threads=args.threads,
        max_iterations=args.iterations,
        function_tolerance=args.tolerance,
    )
    recorder = Recorder()

    def note(row: Iteration) -> bool:
        recorder.add(row.objective)
        return True

    result = solve(case_problem(case), options, on_iteration=note)
    recorder.write(
        args.trace, getattr(ba_node, "__version__", ""), result.reason, linear_iterations=result.linear_iterations
    )
    state = result.state
    intrinsics = state.intrinsics if len(state.intrinsics) else case.bal.cameras[:, 6:]
    write_state(args.state, np.hstack([so3_log(state.rotation), state.translation, intrinsics]), state.points)


if __name__ == "__main__":
    main()
