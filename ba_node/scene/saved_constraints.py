# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Copy what is known beside pixels into plain arrays and facts, and take it in again, checked as what comes first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray
from ba_node.scene.constraints import Absolute, Constraints, RelativeMeasure, positive_covariance
from ba_node.scene.map_content import (
    MapContent,
    prefixed,
    require,
    require_all,
    require_rotations,
    require_unique,
    within,
)
from ba_node.scene.rejections import RejectionLog
from ba_node.scene.tables import Column

_ID, _STAMP, _IS, _ONE = Column(np.uint64), Column(np.int64), Column(np.bool_), Column(np.float64)
_THREE, _TURN, _SIX = Column(np.float64, (3,)), Column(np.float64, (3, 3)), Column(np.float64, (6, 6))
# What each group has for one thing; a map of an older version has none of them.
_GROUPS: dict[str, dict[str, Column]] = {
    "relative_poses": {
        "from": _ID, "to": _ID, "rotation": _TURN, "position": _THREE, "root": _SIX,
        "is_loop": _IS, "unchecked": _IS, "refused": _IS,
    },
    "steps": {"keyframe_id": _ID, "covariance": _SIX},
    "gravity": {"keyframe_id": _ID, "down": _THREE, "sigma_rad": _ONE},
    "landmark_priors": {"track_id": _ID, "position": _THREE, "covariance": _TURN},
    "absolute": {
        "stamp_ns": _STAMP, "position": _THREE, "rotation": _TURN, "covariance": _SIX,
        "has_rotation": _IS, "of_antenna": _IS,
    },
    "merges": {"track_id": _ID, "same_as": _ID},
}  # fmt: skip
_FINITE = np.finfo(float).max


def take(known: Constraints) -> MapContent:
    """Return a copy of all that is known beside pixels."""
    place = known.map_from_world
    world = {
        "frame_id": known.world_frame,
        "origin": None if known.origin is None else known.origin.tolist(),
        "map_from_world": None if place is None else [place[0].ravel().tolist(), place[1].tolist()],
        "renamed": [list(pair) for pair in known.renamed.items()],
        "adjusted_at": known.adjusted_at,
        "steps_precise": known.steps_precise,
        "seams": sorted(known.seams),
    }
    rows: dict[str, Iterable[tuple[Any, ...]]] = {
        "relative_poses": (
            (*key, one.rotation, one.position, one.root, one.is_loop, key in known.unchecked, key in known.refused)
            for key, one in known.relative.items()
        ),
        "steps": known.steps.items(),
        "gravity": ((key, *one) for key, one in known.gravity.items()),
        "landmark_priors": ((track, *one) for track, one in known.landmarks.items()),
        "absolute": (_absolute_row(one) for one in known.absolute),
        "merges": known.merges,
    }
    arrays: dict[str, NDArray[Any]] = {}
    for group, columns in _GROUPS.items():
        parts = list(zip(*rows[group], strict=True)) or [()] * len(columns)
        arrays |= prefixed(
            group,
            (
                (name, np.array(part, column.dtype).reshape(-1, *column.shape))
                for (name, column), part in zip(columns.items(), parts, strict=True)
            ),
        )
    return MapContent(arrays, {"world": world})


def restore(content: MapContent, known: Constraints) -> None:
    """Take over what :func:`take` gave; maps of older versions have less.

    Raises:
        MapError: something of it cannot be.
    """
    if "world" in content.facts:
        _restore_world(MapContent(facts=content.fact("world", dict)), known)
    if not any(name.startswith("relative_poses/") for name in content.arrays):
        return
    found = {group: content.columns(group, columns) for group, columns in _GROUPS.items()}
    for group, columns in found.items():
        for name, values in columns.items():
            if values.dtype == np.float64:
                require_all(within(values, _FINITE), f"{group}/{name}", values, "finite numbers")
            if name == "keyframe_id" or (group, name) == ("landmark_priors", "track_id"):
                require_unique(values, f"{group}/{name}")
    _restore_relative(found["relative_poses"], known)
    _require_positive(found["steps"]["covariance"], "steps")
    known.steps = dict(_rows(found["steps"]))
    down, sigma_rad = found["gravity"]["down"], found["gravity"]["sigma_rad"]
    require_all(np.abs(np.linalg.norm(down, axis=1) - 1.0) < 1e-6, "gravity/down", down, "a unit vector")
    require_all(sigma_rad > 0.0, "gravity/sigma_rad", sigma_rad, "a number > 0")
    known.gravity = {key: (down, sigma) for key, down, sigma in _rows(found["gravity"])}
    _require_positive(found["landmark_priors"]["covariance"], "landmark_priors")
    known.landmarks = {track: (position, spread) for track, position, spread in _rows(found["landmark_priors"])}
    require_rotations(found["absolute"]["rotation"], "absolute/rotation")
    stamps = found["absolute"]["stamp_ns"]
    require(bool((np.diff(stamps) >= 0).all()), "absolute/stamp_ns: expected the oldest first")
    known.absolute = [_absolute(row) for row in _rows(found["absolute"])]
    known.merges = [(track, other) for track, other in _rows(found["merges"])]


def _rows(columns: Mapping[str, NDArray[Any]]) -> Iterable[tuple[Any, ...]]:
    """Yield the rows of a group; single numbers as those of Python, arrays as copies."""
    parts = [values.tolist() if values.ndim == 1 else list(np.array(values)) for values in columns.values()]
    return zip(*parts, strict=True)


def _absolute_row(one: Absolute) -> tuple[Any, ...]:
    covariance = np.zeros((6, 6))
    covariance[-len(one.covariance) :, -len(one.covariance) :] = one.covariance
    has_rotation = one.rotation is not None
    rotation = one.rotation if has_rotation else np.eye(3)
    return one.stamp_ns, one.position, rotation, covariance, has_rotation, one.of_antenna


def _absolute(row: tuple[Any, ...]) -> Absolute:
    stamp_ns, position, rotation, covariance, has_rotation, of_antenna = row
    covariance = covariance if has_rotation else covariance[3:, 3:]
    if covariance.any() or has_rotation:
        _require_positive(covariance[None], "absolute")
    return Absolute(stamp_ns, position, rotation if has_rotation else None, covariance, of_antenna)


def _restore_relative(found: Mapping[str, NDArray[Any]], known: Constraints) -> None:
    require_rotations(found["rotation"], "relative_poses/rotation")
    for first, second, rotation, position, root, is_loop, unchecked, refused in _rows(found):
        key = first, second
        twice = key in known.relative or key[::-1] in known.relative
        require(first != second and not twice, f"relative_poses: keyframes {first} and {second}, expected two, once")
        known.put_relative(key, RelativeMeasure(rotation, position, root, is_loop))
        if unchecked:
            known.unchecked.append(key)
        if refused:
            known.refused.add(key)


def _require_positive(covariances: FloatArray, group: str) -> None:
    log = RejectionLog()
    for i, one in enumerate(covariances):
        good = positive_covariance(f"{group}/covariance of row {i}", one, len(one), log) is not None
        require(good, log.notes[-1] if log.notes else "")


def _restore_world(facts: MapContent, known: Constraints) -> None:
    known.world_frame = facts.fact("frame_id", str)
    if facts.fact("origin", (list, type(None))) is not None:
        known.origin = _numbers(facts.facts["origin"], 3, "world: origin")
    place = facts.fact("map_from_world", (list, type(None)))
    if place is not None:
        require(len(place) == 2, f"world: map_from_world = {place}, expected a rotation and a translation")
        rotation = _numbers(place[0], 9, "world: map_from_world").reshape(3, 3)
        require_rotations(rotation[None], "world: map_from_world")
        known.map_from_world = rotation, _numbers(place[1], 3, "world: map_from_world")
    for pair in facts.fact("renamed", list):
        good = isinstance(pair, list) and len(pair) == 2 and all(type(one) is int and 0 <= one < 2**64 for one in pair)
        # A later name of a track is one that has none: no ring of names can form.
        require(good and known.name_of(pair[1]) != pair[0], f"world: renamed has {pair!r}, expected two tracks")
        known.renamed[pair[0]] = pair[1]
    if "adjusted_at" in facts.facts:
        known.adjusted_at, known.steps_precise = facts.fact("adjusted_at", int), facts.fact("steps_precise", bool)
        seams = facts.fact("seams", list)
        require(all(type(one) is int and 0 <= one < 2**64 for one in seams), f"world: seams = {seams!r}")
        known.seams = set(seams)


def _numbers(values: Any, n: int, name: str) -> FloatArray:
    good = isinstance(values, list) and len(values) == n and all(type(one) in (int, float) for one in values)
    require(good and all(abs(one) < _FINITE for one in values), f"{name} = {values!r}, expected {n} finite numbers")
    return np.array(values, float)
