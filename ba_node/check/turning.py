# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a young map whether its turns are all larger or smaller than the front-end's by one factor.

A focal length that is 2 % off makes every turn as much too large or too small, and what is left in the images is below
their noise: after a turn of 360 degrees a map of one camera is 7 degrees off, where the odometry was 0.1. Odometry
whose turns have a wrong scale shows the same, and there the images are right. So it is told only where they say by
themselves, adjusted freely with their focal length, that it is off by as much as the turns are. Where places are seen
again turns are held and differ by less, and it is not told: images alone say as much of real lenses that no model fits.
"""

from __future__ import annotations

import numpy as np

from ba_node.check import two_view
from ba_node.check.adjusted import Adjusted, Freed, problem_of_all
from ba_node.check.departure import more_errors, trimmed_mean
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.relations import spread
from ba_node.check.tracks import tracks_of
from ba_node.check.watch import NEWEST, Check
from ba_node.core import geometry
from ba_node.core.cameras import FX
from ba_node.scene.scene import Scene

# Keyframes at which it is asked before the end, and up to which a map is young; turns that are needed, and the least
# one that counts, rad.
_AT, _YOUNG, _TURNS, _LEAST_TURN = frozenset({30, 60, 90}), 120, 7, 0.015
# A smaller one than this share of the usual one tells nothing.
_TELLING = 0.3
# Turns differ by this factor at least, in logarithms, and by so many standard errors; so does the focal length by
# images, and the one is no more than so many times the other.
_FACTOR, _ERRORS, _ALIKE = 0.008, 3.5, 1.6
# Keyframes and observations that are adjusted.
_KEYFRAMES, _OBSERVATIONS = 24, 4000


def turns_differ(scene: Scene, *, final: bool = False) -> Check | None:
    """Return what is wrong if turns of a young map and the focal length by images are off alike; None if they are not.

    ``final``: it is asked at any number of keyframes, as no more will come.
    """
    count, known = len(scene.keyframes), scene.constraints
    if (count not in _AT and not final) or count > _YOUNG or known.absolute or known.landmarks:
        return None
    by_turns, error, n = _turns(scene)
    if abs(by_turns) < max(_FACTOR, more_errors(n) * _ERRORS * error) or not two_view.available():
        return None
    tracks = tracks_of(scene, NEWEST)
    problem = tracks and problem_of_all(tracks, spread(len(tracks), _KEYFRAMES), _OBSERVATIONS)
    if not tracks or not problem:
        return None
    given = tracks.cameras.params
    free = Freed(Adjusted(problem, given))
    by_images = float(np.log(free.params[0, FX] / given[0, FX]))
    errors = abs(by_images) / float(free.sigma[0])
    if errors < _ERRORS or not 1.0 / _ALIKE < by_images / by_turns < _ALIKE:
        return None
    cause = f"focal length off by a factor of about {np.exp(-by_images):.2f}"
    cause += f": the tracks fit {free.params[0, FX]:.0f} px, not {given[0, FX]:.0f}"
    evidence = (
        f"by {errors:.0f} standard errors; refined turns are {np.exp(by_turns):.3g} times as large as the front-end's,"
        f" over {n} of them"
    )
    found = Diagnosis([Finding((cause,), evidence, ("k of camera_info in camera_rig",))])
    return Check(scene, lambda: found, found)


def _turns(scene: Scene) -> tuple[float, float, int]:
    """Return the mean logarithm of how much larger refined turns are than the front-end's, its error, and how many."""
    table, order = scene.keyframes, scene.order
    both = table.refined[order[1:]] & table.refined[order[:-1]]
    pairs = order[:-1][both], order[1:][both]
    refined = geometry.so3_log(geometry.steps_between(table.rotation, table.position, *pairs)[0])
    given = geometry.so3_log(geometry.steps_between(table.input_rotation, table.input_position, *pairs)[0])
    along = refined + given
    larger, smaller = np.sum(refined * along, axis=1), np.sum(given * along, axis=1)
    size = 0.5 * np.linalg.norm(along, axis=1)
    least = max(_LEAST_TURN, _TELLING * float(np.median(size))) if len(size) else 0.0
    telling = (size > least) & (larger > 0.0) & (smaller > 0.0)
    n = int(np.count_nonzero(telling))
    return (*trimmed_mean(np.log(larger[telling] / smaller[telling])), n) if n >= _TURNS else (0.0, 0.0, n)
