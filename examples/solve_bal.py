# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a BAL problem with the solver alone: python examples/solve_bal.py PROBLEM.txt REFINED.txt.

`ba solve` does the same, with a trace and every option on the command line.
"""

import dataclasses
import sys

from ba_node.core import methods, solver
from ba_node.io.bal import from_state, read_bal, to_problem, write_bal


def main(source, target):
    bal = read_bal(source)
    options = dataclasses.replace(methods.options("local_dinm"), max_iterations=50)
    result = solver.solve(to_problem(bal), options)
    for step in result.trace:
        print(f"{step.iteration:3d}  objective {step.objective:.6g}  gradient {step.gradient_norm:.2e}")
    print(f"{result.status.name}: {result.reason}")
    write_bal(target, from_state(bal, result.state))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python examples/solve_bal.py SOURCE TARGET")
    main(*sys.argv[1:])
