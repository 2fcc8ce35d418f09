# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell whether a replay did harm: what it published against what came in, session by session, by the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.estimate import Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.trajectory import read_tum

# What is published may have this much more error than what came in: a share of it, and a length or an angle.
MORE_SHARE, MORE_M, MORE_DEG = 0.1, 0.005, 0.1
# Where report.json holds words for a user.
_WORDS = (
    "attention",
    "warnings",
    "unrefined",
    "bag_warnings",
    "rejection_notes",
    "bag_notes",
    "rejected",
    "bag_rejected",
)


@dataclass(frozen=True)
class SessionResult:
    """The error of one session's trajectory, before and after."""

    folder: Path  # the files that it was read from
    keyframes: int  # poses published
    input_m: float  # translation RMSE of the front-end's poses after se3 alignment, m
    published_m: float  # the same of what was published
    input_deg: float  # rotation RMSE as it stands, deg: a path that is nearly straight aligns its roll badly
    published_deg: float  # the same of what was published

    @property
    def harmless(self) -> bool:
        """Return True if what was published is about as good as what came in, or better."""
        return bool(
            self.published_m <= (1.0 + MORE_SHARE) * self.input_m + MORE_M
            and self.published_deg <= (1.0 + MORE_SHARE) * self.input_deg + MORE_DEG
        )


def session_results(out: Path, truth: Poses) -> list[SessionResult]:
    """Return the errors of every session that a replay wrote, that of the newest first.

    Args:
        out: the folder of the replay.
        truth: true poses with the stamps that the recording has.

    Raises:
        EvaluationError: a session's poses have no partner in the truth.
    """
    return [_session(path.parent, truth) for path in sorted(out.rglob("trajectory.tum"), key=_place)]


def messages_of(report: Mapping[str, Any]) -> str:
    """Return all words in report.json that are meant for a user, one text a line."""
    lines: list[str] = []
    for part in (*report.get("older_sessions", ()), report):
        for name in _WORDS:
            value = part.get(name, ())
            if isinstance(value, Mapping):
                lines += (f"{key}: {text}" for key, text in value.items())
            else:
                lines += [value] if isinstance(value, str) else value
    return "\n".join(lines)


def _place(path: Path) -> tuple[int, str]:
    return len(path.parts), path.parent.name


def _session(folder: Path, truth: Poses) -> SessionResult:
    before, after = (read_tum(folder / f"{name}.tum") for name in ("trajectory_input", "trajectory"))
    return SessionResult(
        folder,
        len(after),
        _translation_m(before, truth),
        _translation_m(after, truth),
        absolute_error(before, truth, "none").rotation.rmse,
        absolute_error(after, truth, "none").rotation.rmse,
    )


def _translation_m(poses: Poses, truth: Poses) -> float:
    try:
        return absolute_error(poses, truth, "se3").translation.rmse
    except EvaluationError:
        # A body that stands still gives nothing to align; both begin at the true first pose.
        return absolute_error(poses, truth, "none").translation.rmse
