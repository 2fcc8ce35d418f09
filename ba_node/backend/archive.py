# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put all that a back-end knows into the content of a map, and take it out again."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.config import SceneConfig
from ba_node.estimate import Cloud, Estimate, Poses, SolveReport, Status, Transform
from ba_node.scene import snapshot
from ba_node.scene.map_content import MapContent, prefixed, require, require_all, require_rotations, within
from ba_node.scene.scene import Scene
from ba_node.scene.tables import Column
from ba_node.window.correction import MapCorrection

_POSES = {
    "keyframe_id": Column(np.uint64),
    "stamp_ns": Column(np.int64),
    "position": Column(np.float64, (3,)),
    "orientation": Column(np.float64, (4,)),
}
_CLOUD = {
    "track_id": Column(np.uint64),
    "position": Column(np.float64, (3,)),
    "rms_px": Column(np.float32),
    "views": Column(np.int32),
}
_CORRECTION = {"rotation": Column(np.float64, (3, 3)), "translation": Column(np.float64, (3,))}


@dataclass(frozen=True)
class MapState:
    """All that a back-end knows, parameters apart."""

    scene: Scene  # the current map
    finished: list[tuple[int, Estimate]]  # session id and last estimate of the sessions before
    report: SolveReport  # of the last solve
    correction: MapCorrection  # map from odom
    current: int | None  # row of the newest keyframe that came, None before the first
    settled: bool  # it counts as complete
    delivered: tuple[int, ...]  # cameras that delivered for each of the last keyframes
    solve_count: int  # solves since the beginning

    def sizes(self) -> dict[str, int]:
        """Return how many keyframes, landmarks and observations there are."""
        scene = self.scene
        return {
            "keyframes": len(scene.keyframes),
            "landmarks": len(scene.landmarks),
            "observations": len(scene.observations),
        }


def pack(known: MapState) -> MapContent:
    """Return a copy of all that is known."""
    content = snapshot.take(known.scene)
    transforms, agreeing, stamp_ns = known.correction.state()
    for name, column in _CORRECTION.items():
        values = [getattr(transform, name) for transform in transforms]
        content.arrays[f"correction/{name}"] = np.array(values, column.dtype).reshape(-1, *column.shape)
    finished = _finished_content(known.finished)
    facts = {
        "current": known.current,
        "settled": known.settled,
        "delivered": list(known.delivered),
        "solve_count": known.solve_count,
        "report": _report_facts(known.report),
        "correction": {"agreeing": agreeing, "stamp_ns": stamp_ns},
    }
    return MapContent(content.arrays | finished.arrays, content.facts | finished.facts | facts)


def unpack(content: MapContent, config: SceneConfig) -> MapState:
    """Return what the content of a map says, in arrays of its own.

    Raises:
        MapError: it is not a whole and consistent map.
    """
    scene = snapshot.build(content, config)
    current, n = content.fact("current", (int, type(None))), len(scene.keyframes)
    delivered, solve_count = content.fact("delivered", list), content.fact("solve_count", int)
    require(current is None or 0 <= current < n, f"current = {current}, expected one of {n} keyframes")
    require(all(type(count) is int for count in delivered), f"delivered = {delivered}, expected counts")
    require(0 <= solve_count < 2**62, f"solve_count = {solve_count}, expected a count")
    return MapState(
        scene,
        [_estimate(content, i, head) for i, head in enumerate(content.fact("finished", list))],
        _report_from(content),
        _correction_from(content),
        current,
        content.fact("settled", bool),
        tuple(delivered),
        solve_count,
    )


def _correction_from(content: MapContent) -> MapCorrection:
    facts = MapContent(facts=content.fact("correction", dict))
    columns = content.columns("correction", _CORRECTION)
    require_rotations(columns["rotation"], "correction/rotation")
    translation = columns["translation"]
    require_all(within(translation, np.finfo(float).max), "correction/translation", translation, "finite numbers")
    require(len(translation) in (0, 2, 3), f"correction: {len(translation)} transforms, expected 0, 2 or 3")
    transforms = tuple(Transform(np.array(r), np.array(t)) for r, t in zip(*columns.values(), strict=True))
    return MapCorrection(transforms, facts.fact("agreeing", int), facts.fact("stamp_ns", int))


def _report_facts(report: SolveReport) -> dict[str, Any]:
    """Return a report as JSON has it."""
    return dataclasses.asdict(report) | {"status": report.status.name, "rejected": dict(report.rejected)}


def _report_from(content: MapContent) -> SolveReport:
    """Return the report in a fact named ``report``; what another version of ba_node added or lacks is passed over.

    Raises:
        MapError: a value of it has the wrong type.
    """
    facts = MapContent(facts=content.fact("report", dict))
    values: dict[str, Any] = {}
    for field in dataclasses.fields(SolveReport):
        if field.name not in facts.facts:
            continue
        if field.name == "rejected":
            values[field.name] = facts.counts(field.name)
        elif field.name == "warnings":
            texts = facts.fact(field.name, (list, tuple))
            require(all(isinstance(text, str) for text in texts), f"warnings = {texts}, expected texts")
            values[field.name] = tuple(texts)
        elif field.name == "status":
            name = facts.fact(field.name, str)
            require(name in Status.__members__, f"status = {name!r}, expected one of {', '.join(Status.__members__)}")
            values[field.name] = Status[name]
        else:
            default = field.default
            values[field.name] = facts.fact(field.name, (int, float) if type(default) is float else type(default))
    return SolveReport(**values)


def _finished_content(finished: Sequence[tuple[int, Estimate]]) -> MapContent:
    """Return finished sessions as the fact ``finished`` and arrays ``finished/<number>/...``."""
    content = MapContent(facts={"finished": []})
    for i, (session_id, estimate) in enumerate(finished):
        for group, columns in (("poses", estimate.trajectory), ("points", estimate.cloud)):
            fields = ((field.name, getattr(columns, field.name)) for field in dataclasses.fields(columns))
            content.arrays.update(prefixed(f"finished/{i}/{group}", fields))
        head = {"session_id": session_id, "stamp_ns": estimate.stamp_ns, "frame_id": estimate.frame_id}
        content.facts["finished"].append(head | {"report": _report_facts(estimate.report)})
    return content


def _estimate(content: MapContent, i: int, head: Mapping[str, Any]) -> tuple[int, Estimate]:
    require(isinstance(head, dict), f"finished: {head!r} is no session")
    facts = MapContent(facts=dict(head))
    group = f"finished/{i}"
    poses, points = content.columns(f"{group}/poses", _POSES), content.columns(f"{group}/points", _CLOUD)
    for name, values in ((f"{group}/poses/{key}", poses[key]) for key in ("position", "orientation")):
        require_all(within(values, np.finfo(float).max), name, values, "finite numbers")
    trajectory = Poses(**{name: np.array(values) for name, values in poses.items()})
    estimate = Estimate(
        stamp_ns=facts.fact("stamp_ns", int),
        frame_id=facts.fact("frame_id", str),
        refined=trajectory,
        trajectory=trajectory,
        cloud=Cloud(**{name: np.array(values) for name, values in points.items()}),
        report=_report_from(facts),
    )
    return facts.fact("session_id", int), estimate
