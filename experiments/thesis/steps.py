# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Search the steps behind the scaling `inc` on a BAL problem.

For each kind of parameter the table shows how far forward differences with a step h are from the analytic Jacobian, as
a share of it. The best step has a star. A residual that is linear in a parameter is fitted by every step, better the
larger it is: there the search determines nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from experiments.thesis.step_search import StepErrors

EXAMPLE = "ba steps problem-49-7776-pre.txt.bz2"
_WIDTH = 13


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("problem", type=Path, metavar="PROBLEM")
    parser.add_argument(
        "--parameterisation", choices=("global", "local", "both"), default="both", help="of the pose (default: both)"
    )


def run(args: argparse.Namespace) -> int:
    """Search."""
    from ba_node.io.bal import read_bal, to_problem  # noqa: PLC0415
    from experiments.thesis.step_search import search_steps  # noqa: PLC0415

    problem = to_problem(read_bal(args.problem))
    problem.check()
    kinds = ("global", "local") if args.parameterisation == "both" else (args.parameterisation,)
    for parameterisation in kinds:
        print(f"{parameterisation} parameterisation")
        print(_table(search_steps(problem, parameterisation)))
    return 0


def _table(found: list[StepErrors]) -> str:
    from experiments.thesis.step_search import POWERS  # noqa: PLC0415

    lines = ["".join(text.rjust(_WIDTH) for text in ("h", *(item.kind for item in found)))]
    for i, power in enumerate(POWERS):
        cells = [f"{item.errors[i]:.1e}{'*' if item.step == 10.0**power else ' '}" for item in found]
        lines.append("".join(text.rjust(_WIDTH) for text in (f"1e{power:+03d}", *cells)))
    best = ["linear" if item.step is None else f"{item.step:.0e}" for item in found]
    lines.append("".join(text.rjust(_WIDTH) for text in ("best", *best)))
    return "\n".join(lines) + "\n"
