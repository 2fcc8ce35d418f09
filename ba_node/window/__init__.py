# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose what a solve refines, fix the rest, put the solution back, and say how well it fits."""

from ba_node.window.merging import Merged, apply, merge, outcome, put_poses, returned
from ba_node.window.problems import MIN_OBSERVATIONS, problem_of
from ba_node.window.selection import Selection, moved_guesses, rows_of, select

__all__ = [
    "MIN_OBSERVATIONS",
    "Merged",
    "Selection",
    "apply",
    "merge",
    "moved_guesses",
    "outcome",
    "problem_of",
    "put_poses",
    "returned",
    "rows_of",
    "select",
]
