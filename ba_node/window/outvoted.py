# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Say that most factors of a kind are so far off the map that they pull at nothing, and what may be wrong with them.

A factor that contradicts all else is outvoted by its loss (``factors.loss_scale``): one is a mismatch, most of a kind
are given wrongly. Each kind is counted by itself, as steps of the front-end with a stated covariance are factors like
measured relative poses, and one of them may be wrong while the other is sound. Absolute measurements are those of
``contradicted.py``.

Where no keyframe was refined, as wrong factors have spoilt all solves, the map is what the front-end gave, which errs
too. Then factors count that are off by half of what they measure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.config import FactorsConfig
from ba_node.core import geometry
from ba_node.core.units import unit_of
from ba_node.scene.scene import Scene

# So many scales of its loss off a factor pulls at a twentieth of its weight, or less; it is said if so many do and this
# share. Keyframes that are looked at, the newest.
_SCALES, _MANY, _MOST, _NEWEST = 5.0, 10, 0.5, 200
# Factors that are off by less than this share of a step, and by less than an angle, are of the right unit and frame.
_SHARE, _NEAR_DEG = 0.3, 10.0
# Without a refined keyframe: off by this share of a step, or by an angle.
_GROSS, _GROSS_DEG = 0.5, 30.0
# Shorter steps tell no unit, m.
_LEAST_M = 0.01


class _Off(NamedTuple):
    """Factors of a kind that lead from one keyframe to another, and how far they are off the map."""

    turn: FloatArray  # (n, 3) rad
    move: FloatArray  # (n, 3) m
    told: FloatArray  # (n, 3) move that is measured, m
    found: FloatArray  # (n, 3) move that the map has, m
    sigmas: FloatArray  # (n,) norm of the whitened residual


def say_outvoted(scene: Scene, config: FactorsConfig, *, everything: bool = False) -> None:
    """Say which kinds of factors the map contradicts; of the newest keyframes, or by ``everything`` of all."""
    scene.log.warnings.pop("outvoted", None)
    known = scene.constraints
    if not config.enabled or not (known.relative or known.steps or known.gravity):
        return
    order = scene.order if everything else scene.order[-_NEWEST:]
    here = np.zeros(len(scene.keyframes), bool)
    here[order] = True
    refined = scene.keyframes.refined
    some = here & refined if refined.any() else here
    limit = _SCALES * config.loss_scale
    said = [_relative(scene, some, limit), _gravity(scene, some, limit)]
    # Where others are wrong, what they drew the map to is not for steps to answer for.
    found = "; ".join(text for text in said if text) or _steps(scene, order, some, limit)
    if found:
        scene.log.warn("outvoted", found)
        if not refined.any():
            # What solves were held for follows from it, and names what is sound.
            scene.log.warnings.pop("held", None)


def _relative(scene: Scene, some: BoolArray, limit: float) -> str:
    known = [(key, one) for key, one in scene.constraints.relative.items() if not one.is_loop]
    if not known:
        return ""
    ends = scene.find_keyframes(np.array([key for key, _ in known], np.uint64).ravel()).reshape(-1, 2)
    at = np.flatnonzero((ends >= 0).all(axis=1) & some[ends].all(axis=1))
    measured = [known[i][1] for i in at]
    if len(measured) < _MANY:
        return ""
    rotation, position, root = (
        np.array([getattr(one, name) for one in measured]) for name in ("rotation", "position", "root")
    )
    off = _compared(scene, ends[at], rotation, position, root)
    wrong = _wrong(scene, off, limit)
    if not _said(wrong):
        return ""
    turned, moved = _compared(scene, ends[at][:, ::-1], rotation, position, root)[:2]
    inverted = _is_near(turned[wrong], moved[wrong], off.found[wrong])
    return _text("relative poses", off, wrong, inverted=inverted)


def _steps(scene: Scene, order: IntArray, some: BoolArray, limit: float) -> str:
    known, table = scene.constraints.steps, scene.keyframes
    ids, both = table.keyframe_id[order[1:]].tolist(), some[order[1:]] & some[order[:-1]]
    at = [i for i, one in enumerate(ids) if one in known and both[i]]
    if len(at) < _MANY or not table.refined.any():
        return ""
    pairs = np.stack([order[:-1][at], order[1:][at]], axis=1)
    back = geometry.inverse(table.input_rotation[pairs[:, 0]], table.input_position[pairs[:, 0]])
    turn, move = geometry.compose(*back, table.input_rotation[pairs[:, 1]], table.input_position[pairs[:, 1]])
    variance = np.array([known[ids[i]] for i in at])
    turned = np.tile(np.eye(6), (len(at), 1, 1))
    turned[:, :3, :3] = np.swapaxes(turn, 1, 2)
    root = np.linalg.inv(np.linalg.cholesky(turned @ variance @ np.swapaxes(turned, 1, 2)))
    off = _compared(scene, pairs, turn, move, root)
    wrong = _wrong(scene, off, limit)
    return _text("steps of the front-end with a covariance", off, wrong, steps=True) if _said(wrong) else ""


def _compared(scene: Scene, ends: IntArray, turn: FloatArray, move: FloatArray, root: FloatArray) -> _Off:
    table, (first, second) = scene.keyframes, ends.T
    turned, found = geometry.steps_between(table.rotation, table.position, first, second)
    off = geometry.so3_log(np.swapaxes(turn, 1, 2) @ turned), found - move
    sigmas = np.linalg.norm((root @ np.concatenate(off, axis=1)[:, :, None])[..., 0], axis=1)
    return _Off(*off, move, found, sigmas)


def _wrong(scene: Scene, off: _Off, limit: float) -> BoolArray:
    wrong = np.asarray(off.sigmas > limit)
    if not scene.keyframes.refined.any():
        moved = np.linalg.norm(off.move, axis=1) > _GROSS * np.linalg.norm(off.found, axis=1)
        wrong &= moved | (np.linalg.norm(off.turn, axis=1) > np.radians(_GROSS_DEG))
    return wrong


def _said(wrong: BoolArray) -> bool:
    return bool(np.count_nonzero(wrong) >= _MANY and wrong.mean() > _MOST)


def _is_near(turn: FloatArray, move: FloatArray, found: FloatArray) -> bool:
    """Return whether turns and moves are off by what a covariance that is too small may leave out."""
    share = np.linalg.norm(move, axis=1) / np.maximum(np.linalg.norm(found, axis=1), _LEAST_M)
    degrees = np.degrees(np.linalg.norm(turn, axis=1))
    return bool(np.median(share) < _SHARE and np.median(degrees) < _NEAR_DEG)


def _text(kind: str, off: _Off, wrong: BoolArray, *, inverted: bool = False, steps: bool = False) -> str:
    """Return how many of a kind are wrong, and why that may be."""
    turn, move, told, found = (part[wrong] for part in off[:4])
    lengths = (np.linalg.norm(part, axis=1) for part in (told, found))
    long, real = (float(np.median(part)) for part in lengths)
    unit = unit_of(long / real) if real > _LEAST_M else ""
    usual = f"{np.median(np.linalg.norm(move, axis=1)):.3g} m and {_median_deg(turn):.1f} degrees (median)"
    field = "pose.covariance in the keyframes" if steps else "their covariance"
    if _is_near(turn, move, found):
        why = f"{field} is too small, or depths, cameras or another source contradict them"
    elif unit:
        why = f"their positions are {unit}, expected metres"
    elif inverted:
        why = "they are inverted: expected the pose of the second keyframe in the body of the first"
    else:
        why = "they are of another frame than the body (of a camera, or its optical axes), inverted, or in another unit"
    return _outvoted(kind, wrong, usual, why)


def _gravity(scene: Scene, some: BoolArray, limit: float) -> str:
    known = scene.constraints.gravity
    if len(known) < _MANY:
        return ""
    rows = scene.find_keyframes(np.fromiter(known, np.uint64, len(known)))
    at = np.flatnonzero((rows >= 0) & some[rows])
    if len(at) < _MANY:
        return ""
    measured = list(known.values())
    down, sigma_rad = (np.array([measured[i][part] for i in at]) for part in (0, 1))
    cosine = -np.sum(scene.keyframes.rotation[rows[at], 2] * down, axis=1)
    off_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    # The residual is a chord, see core/priors.py.
    wrong = np.asarray(2.0 * np.sin(0.5 * off_rad) > limit * sigma_rad)
    if not scene.keyframes.refined.any():
        wrong &= off_rad > np.radians(_GROSS_DEG)
    if not _said(wrong):
        return ""
    degrees = float(np.degrees(np.median(off_rad[wrong])))
    if degrees > 180.0 - _GROSS_DEG:
        why = "they point up: expected down, against what an accelerometer at rest measures"
    elif degrees < _GROSS_DEG:
        why = "sigma_rad is too small, the IMU is turned on the body, or z of the front-end's frame does not point up"
    else:
        why = "they are in another frame than the body (of the IMU, or a camera), or z of the map does not point up"
    return _outvoted("directions of gravity", wrong, f"{degrees:.1f} degrees (median)", why)


def _outvoted(kind: str, wrong: BoolArray, off: str, why: str) -> str:
    count = f"{np.count_nonzero(wrong)} of {len(wrong)} {kind}"
    return f"{count} contradict the rest and are outvoted: they are off by {off}, so likely {why}"


def _median_deg(turn: FloatArray) -> float:
    return float(np.degrees(np.median(np.linalg.norm(turn, axis=1))))
