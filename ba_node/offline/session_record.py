# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Collect what a replay gives, session by session, so that nothing is lost when the back-end forgets."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray
from ba_node.backend import CurrentMap, MapSummary
from ba_node.estimate import Estimate, Poses, SolveReport, World
from ba_node.measurements import Keyframe

_IDS_SHOWN = 6


@dataclass
class SessionRecord:
    """One session of a replay."""

    session_id: int  # the session
    last: Estimate  # newest estimate
    forgotten: list[Poses] = field(default_factory=list)  # last values of the keyframes that the back-end has forgotten
    inputs: dict[int, Keyframe] = field(default_factory=dict)  # accepted keyframe messages by id
    refined: set[int] = field(default_factory=set)  # ids of the keyframes that took part in a usable solve
    statuses: Counter[str] = field(default_factory=Counter)  # solves by status
    solves: list[tuple[int, SolveReport]] = field(default_factory=list)  # stamp of the newest keyframe, ns, and report
    reasons: dict[int, str] = field(default_factory=dict)  # why a solve gave nothing, by its newest keyframe
    unrefined: str = ""  # which keyframes were not refined and why, empty if all were; see :meth:`close`
    closed: MapSummary | None = None  # summary of the map at its end, None before :meth:`close`

    @property
    def map_index(self) -> int:
        """Return which map of the back-end it is; several may have the same session id."""
        return self.last.map_index

    @property
    def summary(self) -> MapSummary:
        """Return the summary of the map at its end."""
        assert self.closed is not None, "close() comes first"
        return self.closed

    def add(self, estimate: Estimate, current: CurrentMap) -> None:
        """Take in the next estimate; ``current`` is its map, as it is now."""
        before, now = self.last.trajectory, estimate.trajectory
        if len(before) and len(now) <= len(before):
            gone = ~np.isin(before.keyframe_id, now.keyframe_id)
            if gone[0]:
                # The oldest are forgotten first.
                self.forgotten.append(before[gone])
            else:
                self.refined -= set(before.keyframe_id[gone].tolist())
        if len(now) > len(self.inputs):
            # Keyframes of a session before that was joined with this one.
            self.inputs.update({one.keyframe_id: one for one in current.input_keyframes()} | self.inputs)
        self.last = estimate
        report = estimate.report
        self.statuses[report.status.name] += 1
        self.solves.append((estimate.stamp_ns, report))
        if not report.status.usable:
            self.reasons[report.newest_keyframe_id] = report.reason
        took_part = set(estimate.refined.keyframe_id.tolist())
        refined = current.refined_among(took_part)
        # What is taken back is that of a window, or, by a check of the set-up, all.
        self.refined -= took_part if current.refined_count else set(now.keyframe_id.tolist())
        self.refined |= refined

    def close(self, summary: MapSummary) -> None:
        """Take what there is to tell of the map at its end."""
        self.closed = summary
        self.unrefined = self._some_unrefined() if self.refined else _why_unrefined(summary, self.statuses, self.last)

    def _some_unrefined(self) -> str:
        """Return which keyframes were not refined though others were, and the usual reason; empty if all were."""
        poses = self.input_trajectory
        left = ~np.isin(poses.keyframe_id, np.array(list(self.refined), dtype=np.uint64))
        ids = poses.keyframe_id[left].tolist()
        if not ids:
            return ""
        reasons = Counter(self.reasons[key] for key in ids if key in self.reasons)
        reason = reasons.most_common(1)[0][0] if reasons else "solves of their windows left them out"
        moved = np.linalg.norm(np.diff(poses.position[left], axis=0), axis=1).sum()
        by = f" (the front-end's poses move {moved:.3g} m over them)" if _adjacent(left) else ""
        return f"{_listed(ids, together=_adjacent(left))}{by}: {reason}"

    @property
    def trajectory(self) -> Poses:
        """Return the newest estimate of every keyframe, by time."""
        parts = [*self.forgotten, self.last.trajectory]
        names = [item.name for item in fields(Poses)]
        poses = Poses(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
        return poses[np.argsort(poses.stamp_ns, kind="stable")]

    @property
    def input_trajectory(self) -> Poses:
        """Return the front-end's poses of the same keyframes, in the same order."""
        return Poses.of([self.inputs[key] for key in self.trajectory.keyframe_id.tolist()])

    def as_dict(self) -> dict[str, Any]:
        """Return the entries of report.json."""
        reports = [report for _, report in self.solves]
        slowest = max(((one.solve_time_s, one.newest_keyframe_id) for one in reports), default=(0.0, 0))
        return {
            "session_id": self.session_id,
            "frame_id": self.last.frame_id,
            "world": _world(self.last.world),
            "keyframes": len(self.last.trajectory) + sum(map(len, self.forgotten)),
            "keyframes_refined": len(self.refined),
            "unrefined": self.unrefined,
            "landmarks": len(self.last.cloud),
            **_figures(self.summary),
            "solves": sum(self.statuses.values()),
            "solves_by_status": dict(sorted(self.statuses.items())),
            "iterations": sum(one.iterations for one in reports),
            "solver_time_s": sum(one.solve_time_s for one in reports),
            "slowest_solve_s": slowest[0],
            "slowest_solve_keyframe_id": slowest[1],
            "solve_times_s": [one.solve_time_s for one in reports],
        }


def _world(world: World | None) -> dict[str, Any] | None:
    """Return where the map lies in the world, None if that is not known."""
    return (
        None if world is None else {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(world).items()}
    )


def _figures(summary: MapSummary) -> dict[str, Any]:
    """Return what report.json tells of a map."""
    residuals = summary.residuals
    return {
        **{name: {state: residuals[state][name] for state in residuals} for name in residuals["input"]},
        "observations": summary.observations,
        "outliers": summary.outliers,
        "rejected": summary.rejected,
        "notices": summary.notices,
        "rejection_notes": summary.rejection_notes,
        "warnings": summary.warnings,
    }


def _why_unrefined(summary: MapSummary, statuses: Counter[str], last: Estimate) -> str:
    """Return why no keyframe of a session was refined, in words."""
    if not statuses:
        return "all keyframes of the recording are in the loaded map already"
    empty = summary.notices.get("empty_tracks", 0)
    if summary.cameras == 0:
        return "no cameras came, neither camera_rig nor camera_info"
    if not summary.observations:
        return f"all {empty} tracks messages are empty" if empty else "no tracks came that could be used"
    return last.report.reason


def _adjacent(chosen: BoolArray) -> bool:
    """Return True if all that is chosen of a row of things lies side by side, and is more than one."""
    rows = np.flatnonzero(chosen)
    return len(rows) > 1 and int(rows[-1] - rows[0]) == len(rows) - 1


def _listed(ids: list[int], *, together: bool) -> str:
    """Return ids in words, the first few where there are many."""
    if together:
        return f"keyframes {ids[0]} to {ids[-1]}"
    shown = ", ".join(map(str, ids[:_IDS_SHOWN])) + (", ..." if len(ids) > _IDS_SHOWN else "")
    return f"keyframe{'s' if len(ids) > 1 else ''} {shown}"
