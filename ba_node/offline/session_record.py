# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Collect what a replay gives, session by session, so that nothing is lost when the back-end forgets."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ba_node.config import Config
from ba_node.estimate import Estimate, Poses
from ba_node.measurements import Keyframe
from ba_node.scene.scene import Scene
from ba_node.scene.tables import BoolArray
from ba_node.window import quality

_IDS_SHOWN = 6


@dataclass
class SessionRecord:
    """One session of a replay.

    Attributes:
        session_id: the session.
        map_index: which map of the back-end it is; several may have the same session id.
        last: newest estimate.
        forgotten: last values of the keyframes that the back-end has forgotten.
        inputs: accepted keyframe messages by id.
        refined: ids of the keyframes that took part in a usable solve.
        statuses: solves by status.
        solver_time_s: in all, s.
        slowest: time and keyframe of the slowest solve.
        iterations: outer iterations in all.
        reasons: why a solve gave nothing, by its newest keyframe.
        unrefined: which keyframes were not refined and why, empty if all were; see :meth:`close`.
        summary: what is known only while the session's scene exists, see :meth:`close`.
    """

    session_id: int
    map_index: int = 0
    last: Estimate | None = None
    forgotten: list[Poses] = field(default_factory=list)
    inputs: dict[int, Keyframe] = field(default_factory=dict)
    refined: set[int] = field(default_factory=set)
    statuses: Counter[str] = field(default_factory=Counter)
    solver_time_s: float = 0.0
    slowest: tuple[float, int] = (0.0, 0)
    iterations: int = 0
    reasons: dict[int, str] = field(default_factory=dict)
    unrefined: str = ""
    summary: dict[str, Any] = field(default_factory=dict)

    def add(self, estimate: Estimate, scene: Scene) -> None:
        """Take in the next estimate."""
        if self.last is not None:
            before = self.last.trajectory
            gone = ~np.isin(before.keyframe_id, estimate.trajectory.keyframe_id)
            if gone.any():
                self.forgotten.append(before[gone])
        self.last = estimate
        report = estimate.report
        self.statuses[report.status.name] += 1
        self.iterations += report.iterations
        self.solver_time_s += report.solve_time_s
        self.slowest = max(self.slowest, (report.solve_time_s, report.newest_keyframe_id))
        if not report.status.usable:
            self.reasons[report.newest_keyframe_id] = report.reason
        rows = ((key, scene.find_keyframe(key)) for key in estimate.refined.keyframe_id.tolist())
        self.refined.update(key for key, row in rows if row is not None and scene.keyframes.refined[row])
        # What a check of the set-up has taken back.
        table = scene.keyframes
        self.refined.difference_update(table.keyframe_id[~table.refined].tolist())

    def close(self, scene: Scene, config: Config) -> None:
        """Summarise the whole map of a scene that is about to be dropped."""
        self.unrefined = self._some_unrefined() if self.refined else _why_unrefined(scene, self.statuses, self.last)
        of = {state: quality.summary(scene, config, state) for state in quality.STATES}
        self.summary = {
            **{name: {state: of[state][name] for state in of} for name in of["input"]},
            "observations": len(scene.sightings),
            "outliers": int(np.count_nonzero(scene.sightings.outlier)),
            "rejected": dict(sorted(scene.log.rejected.items())),
            "notices": dict(sorted(scene.log.notices.items())),
            "rejection_notes": list(scene.log.notes),
            "warnings": dict(scene.log.warnings),
        }

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
        assert self.last is not None
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
        assert self.last is not None
        return {
            "session_id": self.session_id,
            "frame_id": self.last.frame_id,
            "keyframes": len(self.last.trajectory) + sum(map(len, self.forgotten)),
            "keyframes_refined": len(self.refined),
            "unrefined": self.unrefined,
            "landmarks": len(self.last.cloud),
            **self.summary,
            "solves": sum(self.statuses.values()),
            "solves_by_status": dict(sorted(self.statuses.items())),
            "iterations": self.iterations,
            "solver_time_s": self.solver_time_s,
            "slowest_solve_s": self.slowest[0],
            "slowest_solve_keyframe_id": self.slowest[1],
        }


def _why_unrefined(scene: Scene, statuses: Counter[str], last: Estimate | None) -> str:
    """Return why no keyframe of a session was refined, in words."""
    if not statuses:
        return "all keyframes of the recording are in the loaded map already"
    empty = scene.log.notices["empty_tracks"]
    if scene.cameras is None:
        return "no cameras came, neither camera_rig nor camera_info"
    if not len(scene.sightings):
        return f"all {empty} tracks messages are empty" if empty else "no tracks came that could be used"
    return last.report.reason if last is not None else ""


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
