# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put all that a back-end knows into the content of a map, and take it out again."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.backend.current_map import Completion, CurrentMap
from ba_node.config import Config, SceneConfig
from ba_node.estimate import SolveReport, Status, Transform
from ba_node.scene import snapshot
from ba_node.scene.map_content import MapContent, require, require_all, require_rotations, within
from ba_node.scene.scene import Scene
from ba_node.scene.tables import Column
from ba_node.window.correction import MapCorrection

_CORRECTION = {"rotation": Column(np.float64, (3, 3)), "translation": Column(np.float64, (3,))}
# map from odom: between a front-end's poses and refined ones, and turned about the origin.
_MAX_CORRECTION_M = 1e12


@dataclass(frozen=True)
class MapState:
    """All that a back-end knows, parameters apart."""

    scene: Scene  # the current map
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


def map_of(known: MapState, config: Config, index: int) -> CurrentMap:
    """Return the map with a number that goes on from all that a back-end knew."""
    scene, newest = known.scene, None
    scene.config = config.scene
    if known.current is not None:
        newest = int(scene.keyframes.keyframe_id[known.current])
    made = CurrentMap(config, scene, index)
    made.report, made.correction = known.report, known.correction
    made.completion = Completion(newest, known.settled, known.delivered)
    return made


def pack(known: MapState) -> MapContent:
    """Return a copy of all that is known."""
    content = snapshot.take(known.scene)
    transforms, agreeing, stamp_ns = known.correction.state()
    for name, column in _CORRECTION.items():
        values = [getattr(transform, name) for transform in transforms]
        content.arrays[f"correction/{name}"] = np.array(values, column.dtype).reshape(-1, *column.shape)
    facts = {
        "current": known.current,
        "settled": known.settled,
        "delivered": list(known.delivered),
        "solve_count": known.solve_count,
        "report": _report_facts(known.report),
        "correction": {"agreeing": agreeing, "stamp_ns": stamp_ns},
    }
    return MapContent(content.arrays, content.facts | facts)


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
    require_all(within(translation, _MAX_CORRECTION_M), "correction/translation", translation, "at most 1e12 m")
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
