# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Judge absolute measurements by the front-end's steps between them: how they scatter, and which stretches have jumped.

A measured position less what steps lead to, ``c_i``, is white noise of the source, sigma, on a random walk of the
steps, q a step. With ``d_i = c_{i+1} - c_i``::

    var(d_i - d_{i+1}) = 6 sigma^2 + 2 q^2,    var(d_i + d_{i+1}) = 2 sigma^2 + 2 q^2

so the source's own noise shows whatever the steps are worth. Where it is well above what was stated, all of the source
count by so much less. A source that changes its reference shows as a step of c: medians of ten on either side differ by
far more than noise leaves of them, and than they do elsewhere, and images or wheels confirm that the body has not
jumped. Stretches between such steps that lie elsewhere than most of the measurements take no part in a solve.

Spreads are taken from lower quartiles, so that one in three may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray, take_rows
from ba_node.config import FactorsConfig
from ba_node.scene.scene import Scene
from ba_node.window import constraints

# So many tell how they scatter; so many times what was stated is no chance; path and noise as in constraints.aligned.
_LEAST, _WORSE, _SPREAD = 30, 2.0, 5.0
# So many on either side of a jump, which is so many standard deviations of what their medians differ by.
_SIDE, _SURE = 10, 5.0
# So many tracks seen before and after tell that the body has not jumped; map and front-end agree to this share of it.
_SHARED, _AGREE = 6, 0.25
# Lower quartile of the norm of three standard normal numbers; variance of a median by that of a mean.
_QUARTILE, _MEDIAN = 1.101, np.pi / 2.0


@dataclass(frozen=True)
class _Compared:
    """Measurements of one source, oldest first, against the front-end's steps between them."""

    pairs: constraints.Pairs
    difference: FloatArray  # (n - 1, 3) d, m
    path_m: FloatArray  # (n,) along the front-end's path
    noise_m: float  # sigma


def judge(scene: Scene, config: FactorsConfig) -> str:
    """Judge all absolute measurements anew; return in words what is new, empty if nothing is."""
    known = scene.constraints
    if known.map_from_world is None:
        return ""
    before = known.left_out, set(known.scatter)
    known.left_out, everything = [], constraints.pair(scene, config, everything=True)
    told = []
    for source in np.unique(everything.source).tolist():
        pairs = take_rows(everything, everything.source == source)
        stated = _stated(pairs) / known.scatter.pop(source, 1.0)
        if len(pairs) < _LEAST:
            continue
        one = _compared(scene, pairs)
        times = _scatter(scene, one, stated)
        if times > 1.0:
            known.scatter[source] = times
            told.append(
                f"{len(pairs)} priors in frame {known.world_frame!r} scatter by {one.noise_m:.2g} m about the path,"
                f" {times:.0f} times what their covariance states: they count by so much less"
            )
        known.left_out += [(source, *span) for span in _jumped(scene, one, config.adjust_m)]
    scene.log.warnings.pop("scattered", None)
    if told:
        scene.log.warn("scattered", "; ".join(told))
    if (known.left_out, set(known.scatter)) == before:
        return ""
    return f"priors in frame {known.world_frame!r} were judged anew"


def _compared(scene: Scene, pairs: constraints.Pairs) -> _Compared:
    table, row = scene.keyframes, pairs.row
    assert scene.constraints.map_from_world is not None
    there = table.input_position[row] + (table.input_rotation[row] @ pairs.lever_arm[:, :, None])[..., 0]
    turn = table.rotation[row] @ np.swapaxes(table.input_rotation[row], 1, 2)
    step = (turn[:-1] @ np.diff(there, axis=0)[:, :, None])[..., 0]
    apart = np.diff(scene.sessions_of(row)) != 0
    step[apart] = np.diff(pairs.points(scene), axis=0)[apart]
    d = np.diff(pairs.position @ scene.constraints.map_from_world[0].T, axis=0) - step
    less, more = _spread(d[:-1] - d[1:]), _spread(d[:-1] + d[1:])
    noise2 = max(0.25 * (less**2 - more**2), 0.0)
    path = np.append(0.0, np.cumsum(np.linalg.norm(step, axis=1)))
    return _Compared(pairs, d, path, float(np.sqrt(noise2)))


def _spread(vectors: FloatArray) -> float:
    """Return the standard deviation along an axis of (n, 3) vectors."""
    return float(np.quantile(np.linalg.norm(vectors, axis=1), 0.25)) / _QUARTILE


def _stated(pairs: constraints.Pairs) -> FloatArray:
    """Return the standard deviations of positions along an axis, (n,) m."""
    return np.asarray(np.sqrt(np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0))


def _scatter(scene: Scene, one: _Compared, stated: FloatArray) -> float:
    """Return how many times as much as stated (n,) a source scatters; 1 where that may be chance.

    Steps that are worse than a precise source are no noise of this, nor is that part of it that was stated to be worse.
    What scatters by as much as the path spreads tells nothing, whatever it counts.
    """
    expected = np.sqrt(stated[:-2] ** 2 + 4.0 * stated[1:-1] ** 2 + stated[2:] ** 2)
    second = np.diff(one.difference, axis=0)
    times = min(_spread(second / expected[:, None]), one.noise_m / float(np.median(stated)))
    spread = float(np.sqrt(np.sum(np.var(one.pairs.points(scene), axis=0))))
    return times if times > _WORSE and spread >= _SPREAD * one.noise_m else 1.0


def _jumped(scene: Scene, one: _Compared, least_m: float) -> list[tuple[int, int]]:
    """Return stretches (first and last stamp, ns) that lie elsewhere than most; the last one goes on."""
    n, stamps = len(one.pairs), one.pairs.stamp_ns
    c = np.append(np.zeros((1, 3)), np.cumsum(one.difference, axis=0), axis=0)
    middle = np.median(np.lib.stride_tricks.sliding_window_view(c, _SIDE, axis=0), axis=-1)
    jump = middle[_SIDE:] - middle[:-_SIDE]  # (n - 2 side + 1, 3) before c[side + i]
    size = np.linalg.norm(jump, axis=1)
    length = one.path_m[2 * _SIDE - 1 :] - one.path_m[: n - 2 * _SIDE + 1]
    usual = _spread(jump) * np.maximum(length / max(float(np.median(length)), 1e-9), 1.0)
    noise = max(one.noise_m, float(np.median(_stated(one.pairs))))
    least = np.maximum(_SURE * np.maximum(np.sqrt(2.0 * _MEDIAN / _SIDE) * noise, usual), least_m)
    found: list[int] = []
    for i in np.argsort(-size, kind="stable").tolist():
        if size[i] <= least[i]:
            continue
        begins = _begin(c[i : i + 2 * _SIDE], middle[i], middle[i + _SIDE])
        if all(abs(i - other) >= _SIDE for other in found) and _confirmed(scene, one.pairs.row, i + begins, size[i]):
            found.append(i)
    found.sort()
    begins_at = [i + _begin(c[i : i + 2 * _SIDE], middle[i], middle[i + _SIDE]) for i in found]
    begin = np.array([0, *sorted(begins_at), n])
    level = np.append(np.zeros((1, 3)), np.cumsum(jump[found], axis=0), axis=0)
    same = np.linalg.norm(level[:, None] - level, axis=2) <= np.max(least[found], initial=0.0)
    believed = same[int(np.argmax(same @ np.diff(begin)))]
    ends = [*stamps[begin[1:-1]].tolist(), np.iinfo(np.int64).max]
    return [(int(stamps[begin[k]]), int(ends[k]) - 1) for k in np.flatnonzero(~believed)]


def _begin(c: FloatArray, before: FloatArray, after: FloatArray) -> int:
    """Return from which of some measurements on they lie nearer to where they are after a jump than before it."""
    nearer = np.linalg.norm(c - before, axis=1) - np.linalg.norm(c - after, axis=1)
    return int(np.argmin(np.cumsum(nearer)[:-1])) + 1


def _confirmed(scene: Scene, row: IntArray, at: int, size_m: float) -> bool:
    """Return whether images or wheels tell that the body did not jump about measurement ``at``."""
    places = scene.places()
    first, last = (int(places[row[k]]) for k in (max(at - 2, 0), min(at + 1, len(row) - 1)))
    table, order = scene.keyframes, scene.order[first : last + 1]
    moves = []
    for rotation, position in ((table.rotation, table.position), (table.input_rotation, table.input_position)):
        back = np.swapaxes(rotation[order[:-1]], 1, 2)
        moves.append((back @ np.diff(position[order], axis=0)[:, :, None])[..., 0])
    off = float(np.max(np.linalg.norm(moves[0] - moves[1], axis=1), initial=0.0))
    pairs = zip(order[:-1].tolist(), order[1:].tolist(), strict=True)
    return off <= _AGREE * size_m and all(_tied(scene, a, b) for a, b in pairs)


def _tied(scene: Scene, a: int, b: int) -> bool:
    """Return whether wheels lead from one keyframe to the next, or enough tracks that agree with their points."""
    one, other = (int(scene.keyframes.keyframe_id[row]) for row in (a, b))
    if scene.constraints.relative.keys() & {(one, other), (other, one)}:
        return True
    return int(np.count_nonzero(np.isin(_agreeing(scene, a), _agreeing(scene, b)))) >= _SHARED


def _agreeing(scene: Scene, row: int) -> IntArray:
    """Return the landmarks that a keyframe sees where they are."""
    table, rows = scene.observations, scene.rows_of(row)
    rows = rows[~table.outlier[rows]]
    landmarks = table.landmark[rows].astype(np.intp)
    good: BoolArray = scene.landmarks.has_position[landmarks]
    return landmarks[good]
