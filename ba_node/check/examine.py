# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put the tests of a set-up together: first what the others build on; what they would only repeat is left out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from ba_node.check import ids, intrinsics, relations, units
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import Relation
from ba_node.check.tracks import Tracks

_RELATIONS = frozenset({"cameras", "poses"})
_BUILD_ON_THESE = ("intrinsics", "lengths")
# Sizes of the image whose losses differ by no more than this factor are both named.
_ALIKE = 1.1
# What nothing can be told without.
_PIXELS = "pixels"


def examine(tracks: Tracks, told: frozenset[str] = frozenset()) -> Diagnosis:
    """Return what the tracks tell about the set-up, but for the tests ``told``, which were decided before.

    Raises:
        ImportError: OpenCV is missing, see :func:`two_view.available`.
    """
    outcome = Diagnosis()
    pairs: list[Relation] | None = None

    def related() -> list[Relation]:
        nonlocal pairs
        pairs = relations.in_motion(tracks) if pairs is None else pairs
        return pairs

    tests: dict[str, Callable[[], Diagnosis]] = {
        _PIXELS: lambda: units.check_pixels(tracks),
        "stamps": lambda: units.check_stamps(tracks),
        "ids": lambda: ids.check_ids(tracks),
        "cameras": lambda: relations.check_cameras(tracks),
        "poses": lambda: _poses(tracks, related()),
        "depth": lambda: units.check_depth(tracks, related()),
        "intrinsics": lambda: intrinsics.check_intrinsics(tracks, related()),
        "lengths": lambda: units.check_lengths(tracks, related(), "intrinsics" in told | outcome.told),
    }
    for name, test in tests.items():
        if name in told | outcome.told or (outcome.harmful and name not in _RELATIONS):
            continue
        if name in _BUILD_ON_THESE and not told | outcome.told >= _RELATIONS:
            outcome.untold.append(f"{name}: not before cameras and poses are known to fit")
            continue
        found = _run(test, name)
        outcome.add(found)
        if not found.untold:
            outcome.told |= {name}
        if name == _PIXELS and found.findings:
            outcome.told |= tests.keys()
        if name == "ids" and found.findings:
            # Their tracks are of several points, and tell nothing else.
            outcome.told |= set(_BUILD_ON_THESE)
    if outcome.harmful:
        outcome.sound, outcome.untold = [], []
    return outcome


def _run(test: Callable[[], Diagnosis], name: str) -> Diagnosis:
    """Run a test; a fault in it must not keep anybody from solving, and is told as what it is."""
    try:
        return test()
    except Exception as error:
        return Diagnosis(untold=[f"{name}: internal error, {type(error).__name__}: {error}"])


def _poses(tracks: Tracks, pairs: list[Relation]) -> Diagnosis:
    motion = relations.check_motion(tracks, pairs)
    if not motion.sound and all(not finding.usual for finding in motion.findings):
        size = _of_size(tracks, motion)
        if size is not None:
            motion.findings, motion.untold = [size], []
    return motion


def _of_size(tracks: Tracks, motion: Diagnosis) -> Finding | None:
    """Return another size of the images as the cause, if poses that contradict the tracks fit with it."""
    found: list[tuple[float, intrinsics.Model]] = []
    evidence = motion.findings[0].evidence if motion.findings else "the poses fit the tracks with that undone"
    for model in intrinsics.other_sizes(tracks):
        other = tracks.with_params(model.params)
        pairs = relations.in_motion(other)
        outcome = relations.check_motion(other, pairs)
        if outcome.sound:
            motion.rows.append(dataclasses.replace(outcome.rows[0], hypothesis=model.cause))
            found.append((intrinsics.loss_of(other, pairs), model))
    if not found:
        return None
    found.sort(key=lambda one: one[0])
    # Few keyframes cannot tell these apart.
    named = [model for loss, model in found if loss <= _ALIKE * found[0][0]]
    return Finding(tuple(one.cause for one in named), evidence, tuple(one.change for one in named), usual=True)
