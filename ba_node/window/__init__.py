# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose what a solve refines, hold it in place, put the solution back, and say how well it fits."""

from ba_node.window.merging import Merged, merge, outcome, put
from ba_node.window.problems import problem_of
from ba_node.window.selection import MIN_OBSERVATIONS, Selection, moved_guesses, rows_of, select

__all__ = [
    "MIN_OBSERVATIONS",
    "Merged",
    "Selection",
    "merge",
    "moved_guesses",
    "outcome",
    "problem_of",
    "put",
    "rows_of",
    "select",
]
