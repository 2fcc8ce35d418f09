# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of a young map at its end whether it explains what was observed worse than what came in: then that stands.

Each solve is tried against the front-end's poses on some tracks of its window (``window/guard.py``). What is lost from
one window to the next, or in keyframes that were left out, shows in all observations alone. So does that too little
stands for anything to be told from it, or that a step holds by no tracks.
"""

from __future__ import annotations

import numpy as np

from ba_node.check.departure import carried, departed, deviates, has_scale, length_factor
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.measured_depths import depths_err
from ba_node.check.turning import turns_differ
from ba_node.check.watch import Check, of_all_images, of_few_keyframes, of_the_newest
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.scene.scene import Scene
from ba_node.window import quality, standing, steps

# Keyframes up to which a map is young.
_YOUNG = 120
# A measure is worse if it is higher by a share of it, usually this one, and by so much, px.
_SHARE, _SLACK_PX = 0.05, 0.05
_LEAVE_OUT = (
    "what the feature_tracks follow: leave out people, vehicles and the like; where nothing moves, the pose in the"
    " keyframes"
)
# Warnings that tracks contradict poses.
_DOUBTFUL = ("moving", "held", "stray")
# Shares of the tracks that stand where less is not asked for more, with one camera and with others.
_MOSTLY_STANDS = (0.8, 0.62)
# Share of the tracks across a step that have to agree with both its sides.
_TORN = 0.2


def is_worse(before: float, after: float, share: float = _SHARE) -> bool:
    """Return True if a measure of what came in, px, has risen by more than a share, and more than chance."""
    return after > (1.0 + share) * before + _SLACK_PX


def amiss(scene: Scene) -> Check | None:
    """Return what is wrong with a young map that goes on, None if nothing is, or if it is not asked now."""
    wrong = departed(scene) or turns_differ(scene)
    return depths_err(scene, at_once=wrong is not None) or wrong


def wrong_at_the_end(scene: Scene, config: Config) -> Check | None:
    """Return what is wrong with a map when no more will come, None if nothing is."""
    wrong = of_the_newest(scene, deviates(scene, final=True))
    wrong = (
        wrong
        or of_all_images(scene)
        or depths_err(scene, at_once=True)
        or departed(scene, final=True)
        or turns_differ(scene, final=True)
        or explains_worse(scene, config)
        or most_moves(scene, config)
        or torn(scene, config)
        or of_few_keyframes(scene)
    )
    return wrong or departed(scene, final=True, doubted=True)


def keep_lengths(scene: Scene, config: Config) -> bool:
    """Make a map as long as the front-end's where images tell no length, or another by little, but hardly by chance.

    Cameras may be off, or the front-end: its lengths are what came in, and the map's shape is the images'.
    Return True if that changed it.
    """
    factor = length_factor(scene) if config.checks_setup else 1.0
    if factor == 1.0:
        return False
    scene.propagate_corrections()
    table, points = scene.keyframes, scene.landmarks
    origin = table.position[scene.order[0]].copy()
    for places in (table.position, points.position):
        places[:] = origin + (places - origin) / factor
    scene.moved()
    points.changed()
    if has_scale(scene):
        scene.log.notice("lengths_kept")
    return True


def explains_worse(scene: Scene, config: Config) -> Check | None:
    """Return what is wrong if a young map explains its observations worse than what came in; None if it does not.

    Nothing is asked where something absolute places the map: images may have to give way to that.
    """
    known = scene.constraints
    if len(scene.keyframes) > _YOUNG or known.absolute or known.landmarks or not scene.keyframes.refined.any():
        return None
    before, after = (quality.summary(scene, config, state)["bounded_px"] for state in ("input", "refined"))
    if before is None or after is None or not is_worse(before, after):
        return None
    held = scene.log.warnings.get("held", "")
    evidence = f"rms with none above 10 sigmas {before:.3g} -> {after:.3g} px{held and '; '}{held}"
    cause = "the result explains the observations worse than what came in"
    change = "what ba check names, track ids that are not of one point, or solver.* and tracks.* that were set"
    return _found(scene, Finding((cause,), evidence, (change,)))


def most_moves(scene: Scene, config: Config) -> Check | None:
    """Return what is wrong if too little stands for a young map to be better than what came in; None if that is not so.

    It is asked where tracks gave a reason. A window is not asked by itself: what is taken here and held there is no
    good map either. Steps that objects carried along are looked for too, of which less is enough here.
    """
    if not _is_doubtful(scene):
        return None
    shares, scaled = standing.of_map(scene, config), has_scale(scene)
    if shares is None or shares.by_solution > _MOSTLY_STANDS[scaled]:
        return None
    finding = carried(scene, mostly=True)
    if shares.too_few(scaled):
        finding = Finding((standing.CAUSE,), str(shares), (_LEAVE_OUT,))
    return None if finding is None else _found(scene, finding)


def torn(scene: Scene, config: Config) -> Check | None:
    """Return what is wrong if few tracks bear out a step of a young map far off the front-end's; None if not so.

    Where most of what is seen moves, keyframes are placed by what moves along, and those before and after hang by that.
    """
    if not _is_doubtful(scene):
        return None
    table, order, obs = scene.keyframes, scene.order, scene.observations
    refined = geometry.inverse(table.rotation[order], table.position[order])
    given = geometry.inverse(table.input_rotation[order], table.input_position[order])
    first = np.arange(len(order) - 1)
    off = steps.compare(
        steps.between(*refined, first, first + 1), steps.between(*given, first, first + 1), config.guard
    )
    place, n = scene.places()[obs.keyframe], len(scene.landmarks)
    agrees = ~obs.outlier & scene.landmarks.has_position[obs.landmark]
    for k in np.flatnonzero(off.sigmas > config.guard.max_sigmas).tolist():
        across, borne_out = (
            np.count_nonzero(
                (np.bincount(obs.landmark[some & (place <= k)], minlength=n) > 0)
                & (np.bincount(obs.landmark[some & (place > k)], minlength=n) > 0)
            )
            for some in (np.ones(len(place), bool), agrees)
        )
        if borne_out < _TORN * across:
            cause = f"no tracks bear out the step to keyframe {table.keyframe_id[order[k + 1]]}"
            evidence = f"{borne_out} of {across} across it; it is {off.sigmas[k]:.0f} sigmas off the front-end's"
            return _found(scene, Finding((cause,), evidence, (_LEAVE_OUT,)))
    return None


def _is_doubtful(scene: Scene) -> bool:
    """Return True of a young map if tracks contradicted poses, and nothing else places it."""
    known = scene.constraints
    young = len(scene.keyframes) <= _YOUNG and bool(scene.keyframes.refined.any())
    odd = not scene.log.warnings.keys().isdisjoint(_DOUBTFUL)
    return young and odd and not (known.absolute or known.landmarks)


def _found(scene: Scene, finding: Finding) -> Check:
    found = Diagnosis([finding])
    return Check(scene, lambda: found, found)
