# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put the tests of a set-up together: first what the others build on; what they would only repeat is left out."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.check import (
    change,
    exposure,
    ids,
    intrinsics,
    lengths,
    motion,
    mounting,
    onset,
    placement,
    relations,
    units,
)
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import Relation
from ba_node.check.tracks import Tracks

_RELATIONS = frozenset({"cameras", "poses"})
_BUILD_ON_THESE = ("intrinsics", "mounting", "lengths")
# What a camera that is exposed later seems to be.
_OF_CAMERAS = ("cameras", "intrinsics", "mounting", "lengths")
# Sizes of the image whose losses differ by no more than this factor are both named.
_ALIKE = 1.1
# Part of the loss as given that another size may leave where the poses alone do not tell.
_CLEARLY = 0.9
# What all others would but repeat.
_ALONE = ("pixels", "onset")


def examine(tracks: Tracks, told: frozenset[str] = frozenset(), more: Tracks | None = None) -> Diagnosis:
    """Return what the tracks tell about the set-up, but for the tests ``told``, which were decided before.

    ``more`` are those of keyframes before them too: they are asked since when it is so, where these do not tell.

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
        "pixels": lambda: units.check_pixels(tracks),
        "image size": lambda: units.check_image_size(tracks),
        "stamps": lambda: units.check_stamps(tracks),
        "sigma": lambda: units.check_sigma(tracks),
        "ids": lambda: ids.check_ids(tracks),
        "onset": lambda: onset.check_onset(tracks),
        "silent": lambda: placement.check_silent(tracks),
        "cameras": lambda: _cameras(tracks, related),
        "poses": lambda: _poses(tracks, related()),
        "depth": lambda: lengths.check_depth(tracks, related()),
        "intrinsics": lambda: intrinsics.check_intrinsics(tracks, related()),
        "mounting": lambda: mounting.check_mounting(tracks, related()),
        "lengths": lambda: lengths.check_lengths(tracks, related(), "intrinsics" in told | outcome.told),
        "change": lambda: change.check_change(tracks),
    }
    for name, test in tests.items():
        if name in told | outcome.told or (outcome.harmful and name not in _RELATIONS):
            continue
        if name in _BUILD_ON_THESE and not told | outcome.told >= _RELATIONS:
            outcome.untold.append(f"{name}: not before cameras and poses are known to fit")
            continue
        found = run(test, name)
        if name == "cameras" or (found.harmful and name in _OF_CAMERAS):
            late = run(functools.partial(exposure.find_late, tracks, found), "exposure")
            found = late if late.findings else found
        outcome.add(found)
        if not found.untold:
            outcome.told |= {name}
        if name in _ALONE and found.findings:
            outcome.told |= tests.keys()
        if name in ("ids", "sigma") and found.findings:
            # Such tracks are of several points, or how precise they are is not known: little things are not told.
            outcome.told |= set(_BUILD_ON_THESE)
    asked = tracks if "onset" in told else more
    if outcome.harmful and outcome.since_ns is None and asked is not None:
        # It may be so only since images changed.
        outcome.findings = run(lambda: onset.check_onset(asked), "onset").findings or outcome.findings
    if outcome.harmful:
        outcome.sound, outcome.untold = [], []
    return outcome


def run(test: Callable[[], Diagnosis], name: str) -> Diagnosis:
    """Run a test; a fault in it must not keep anybody from solving, and is told as what it is."""
    try:
        return test()
    except Exception as error:
        text = f"{name}: internal error, {type(error).__name__}: {error}"
        return Diagnosis(untold=[text], failed=[text])


def _cameras(tracks: Tracks, related: Callable[[], list[Relation]]) -> Diagnosis:
    """Compare the cameras with each other, and where they misfit with what they would be in images of another size.

    A region of interest of all cameras alike shows as cameras that are off their places, where their lenses bend rays
    or they look elsewhere: with it undone all of them fit, and the poses too.
    """
    outcome = placement.check_cameras(tracks, related)
    if not outcome.harmful or outcome.usual:
        return outcome
    pairs, sizes = related(), intrinsics.other_sizes(tracks)
    models = [intrinsics.freed_from(tracks, pairs, params) for params in (tracks.cameras.params, *map(_params, sizes))]
    for model in (*(one for one in models if one is not None), *sizes):
        other = model.of(tracks)
        moved = relations.in_motion(other)
        again = placement.check_cameras(other, functools.partial(list, moved))
        if again.sound and not again.harmful and motion.check_motion(other, moved).sound:
            outcome.findings = [Finding((model.cause,), f"with that {' and '.join(again.sound)}", (model.change,))]
            return outcome
    # Few keyframes do not confirm it; but tracks that lie far off the centre are seldom a camera's.
    causes, changes = tuple(one.cause for one in sizes), tuple(one.change for one in sizes)
    outcome.findings = [
        dataclasses.replace(one, causes=(*causes, *one.causes), changes=(*changes, *one.changes))
        for one in outcome.findings
    ]
    return outcome


def _params(model: intrinsics.Model) -> FloatArray:
    return model.params


def _poses(tracks: Tracks, pairs: list[Relation]) -> Diagnosis:
    outcome = motion.check_motion(tracks, pairs)
    if not outcome.sound and not (outcome.findings and outcome.usual):
        size = _of_size(tracks, pairs, outcome)
        if size is not None:
            outcome.findings, outcome.untold = [size], []
        elif outcome.rows:
            # A wrong lens keeps tracks from agreeing with any relation, as outliers do.
            lens = intrinsics.check_intrinsics(tracks, pairs)
            if lens.findings:
                outcome.findings, outcome.untold = lens.findings, []
                outcome.rows += lens.rows
    return outcome


def _of_size(tracks: Tracks, pairs: list[Relation], outcome: Diagnosis) -> Finding | None:
    """Return another size of the images as the cause, if poses that contradict the tracks fit with it."""
    evidence = outcome.findings[0].evidence if outcome.findings else "the poses fit the tracks with that undone"
    fits: list[tuple[float, str, str]] = []
    # Few keyframes cannot tell precisely where a region is; and a wrong focal length alone contradicts the poses.
    models = [intrinsics.freed_from(tracks, pairs, size.params) or size for size in intrinsics.other_sizes(tracks)]
    free = intrinsics.freed_from(tracks, pairs, tracks.cameras.params) if outcome.rows else None
    for model in models if free is None else [*models, free]:
        other = tracks.seen(params=model.params)
        related = relations.in_motion(other)
        fit = motion.check_motion(other, related)
        if fit.sound:
            outcome.rows.append(dataclasses.replace(fit.rows[0], hypothesis=model.cause))
            fits.append((intrinsics.loss_of(other, related), model.cause, model.change))
    # Where the poses as given were not told, they are not known to contradict the tracks: the images have to say it.
    if not fits or (not outcome.findings and not _is_clear(min(fits)[0], intrinsics.loss_of(tracks, pairs))):
        return None
    # Few keyframes cannot tell these apart.
    causes, changes = zip(
        *((cause, change) for loss, cause, change in sorted(fits) if loss <= _ALIKE * min(fits)[0]), strict=True
    )
    return Finding(causes, evidence, changes, usual=True)


def _is_clear(loss: float, given: float) -> bool:
    """Return True if another size leaves clearly less of a loss that is known."""
    return given < np.inf and loss < _CLEARLY * given
