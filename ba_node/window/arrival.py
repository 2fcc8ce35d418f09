# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Relocalise a new keyframe whose pose by the front-end contradicts its tracks.

A keyframe that was not refined yet stands where the front-end's step from the one before puts it. If the points that
are known already lie nowhere near where it sees them, the front-end has jumped or the tracks are wrong. Then its pose
is sought from other starts: where the keyframes before it are, where they were heading, and where the correction of
each of them puts it. From each the robust error is lowered with the points held, the loss narrowing from coarse to
fine; the pose that most views agree with is where it begins. If less than a third of them agree
with any, it sits the solve out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import Config, SolverOptions
from ba_node.core import geometry, native_kernels
from ba_node.core.objective import Objective
from ba_node.core.problem import Problem, State
from ba_node.scene.scene import Scene
from ba_node.window.problems import problem_of

# Fewer known points than this place no keyframe.
_MIN_POINTS = 10
# An error of the front-end's turn (rad) beyond which it is not left to the solve to mend.
_FAR_RAD = 0.2
# Views agree within this many outlier gates: the newest points are not placed well yet.
_WIDE = 5.0
# Half of the views may be wrong, and some more may see what is not placed well.
_AGREEING = 0.3
# Widths of the loss, sigmas, and steps with each.
_WIDTHS = (200.0, 60.0, 20.0, 6.0, 3.0)
_ROUNDS = 3
# So many keyframes before it are asked where it might be, and so many of the answers are tried.
_ASKED = 3
_TRIED = 3
# Only these newest keyframes are sought: what was not found then is not found later.
_SOUGHT = 2
# A front-end jumps where its step is so many times as quick as any of so many before, of which some are needed, and no
# less than this (m, rad).
_QUICKER, _RECENT, _SOME, _LEAST_JUMP = 3.0, 30, 5, (0.5, 1.0)
# Keyframes at which it is asked whether the first one has jumped: it comes before all that could place it. Of its views
# no more than this share agree, and of those of the one after it at least so many.
_ASKED_AT, _HARDLY_ANY, _MOST = frozenset({6, 12, 25}), 0.1, 0.6


def strays(
    scene: Scene, config: Config, problem: Problem, keyframes: IntArray, landmarks: IntArray, norms: FloatArray
) -> IntArray:
    """Return the rows of keyframes that were not refined yet and begin where they do not see what is known.

    The problem is of these keyframes and landmarks, rows in the scene; ``norms`` (n_obs,) are its residuals at the
    start, sigmas.
    """
    obs, new = problem.observations, ~scene.keyframes.refined[keyframes]
    rows = new.take(obs.keyframe).nonzero()[0]
    if config.tracks.outlier_px <= 0 or new.all() or not len(rows):
        return keyframes[:0]
    rows = rows[scene.landmarks.has_position[landmarks].take(obs.point[rows])]
    count = np.bincount(obs.keyframe[rows], minlength=len(new))
    near = np.bincount(obs.keyframe[rows[norms[rows] <= _limit(problem)]], minlength=len(new))
    return keyframes[(count >= _MIN_POINTS) & (near < _AGREEING * count)]


class Stray(NamedTuple):
    """A keyframe that began in the wrong place."""

    row: int  # in the scene
    found: bool  # its tracks have shown its place
    off_m: float = 0.0  # how far the front-end had put it from there; 0 where it is not its own pose that is wrong
    off_rad: float = 0.0  # by how much it had turned it

    def text(self, keyframe_id: int) -> str:
        """Return what to say of it, empty if nothing."""
        if self.found and self.off_m == self.off_rad == 0.0:
            return ""
        if not self.found:
            return (
                f"keyframe {keyframe_id} is left out, as its tracks contradict what is known wherever it may be: are"
                " its track ids right?"
            )
        return (
            f"the front-end's pose of keyframe {keyframe_id} is {self.off_m:.3g} m and {np.degrees(self.off_rad):.3g}"
            " deg off where its tracks show it: it has jumped; the keyframe was placed by its tracks"
        )


def place(scene: Scene, config: Config, rows: IntArray) -> tuple[Stray, ...]:
    """Move keyframes (rows, oldest first) that begin in the wrong place, and say what became of each.

    Their poses are changed until they are settled anew.
    """
    newest = set(scene.order[-_SOUGHT:].tolist())
    return tuple(_placed(scene, config, int(row), int(row) in newest) for row in rows)


def _placed(scene: Scene, config: Config, row: int, sought: bool) -> Stray:
    """Move a keyframe to where its tracks show it, if it is ``sought`` and found."""
    problem = _views(scene, config, row)
    if problem is None:
        return Stray(row, found=False)
    best, most = problem.start, 0
    starts = [
        State(rotation[None], translation[None], problem.start.points, problem.start.intrinsics)
        for rotation, translation in (_starts(scene, row) if sought else [])
    ]
    near = [_near(problem, start, config) for start in starts]
    for i in sorted(range(len(starts)), key=lambda i: -near[i])[:_TRIED]:
        state = lowered(problem, starts[i])
        norms = native_kernels.residual_norms(problem, state, config.solver.kernels)
        agreeing = int(np.count_nonzero(norms <= _WIDE * config.tracks.outlier_px))
        if agreeing > most:
            best, most = state, agreeing
    if most < max(_MIN_POINTS, _AGREEING * len(problem.observations)):
        return Stray(row, found=False)
    table = scene.keyframes
    rotation, position = geometry.inverse(best.rotation[0], best.translation[0])
    rotation, position = geometry.nearest_rotation(rotation), position + table.position[scene.order[0]]
    scene.moved(np.array([row]))
    if max(near[-_ASKED:]) >= _AGREEING * len(problem.observations):
        # Its step from one of the keyframes before is right: it is another one that has jumped.
        table.rotation[row], table.position[row] = rotation, position
        return Stray(row, found=True)
    off_m = float(np.linalg.norm(position - table.position[row]))
    off_rad = float(np.linalg.norm(geometry.so3_log(table.rotation[row].T @ rotation)))
    table.rotation[row], table.position[row] = rotation, position
    return Stray(row, True, off_m, off_rad)


def first_jumped(scene: Scene, config: Config) -> str:
    """Return in words that a map agrees with all keyframes but its first; empty if not, or if it is not asked now."""
    if len(scene.keyframes) not in _ASKED_AT or not scene.keyframes.refined[scene.order[1]]:
        return ""
    agree, gate = [], _WIDE * (config.tracks.outlier_px or np.inf)
    for row in scene.order[:2].tolist():
        problem = _views(scene, config, row, outliers=True)
        if problem is None:
            return ""
        agree.append(native_kernels.residual_norms(problem, problem.start, config.solver.kernels) <= gate)
    first, next_one = agree
    if first.mean() > _HARDLY_ANY or next_one.mean() < _MOST:
        return ""
    return (
        f"keyframe {scene.keyframes.keyframe_id[scene.order[0]]}, the first, stands apart: {np.count_nonzero(first)} of"
        f" its {len(first)} observations agree with what those after it see. The front-end has jumped from there, or"
        " its track ids are wrong; its pose stands as it came"
    )


def parted(scene: Scene, rows: IntArray) -> list[str]:
    """Return in words to which keyframes (rows, oldest first) the front-end jumps while no track leads there."""
    table, places, found = scene.keyframes, scene.places(), []
    for row in rows.tolist():
        near = scene.order[max(0, places[row] - _RECENT) : places[row] + 1]
        if len(near) < _SOME + 2:
            continue
        turns, moves = geometry.steps_between(table.input_rotation, table.input_position, near[:-1], near[1:])
        sizes = np.stack([np.linalg.norm(moves, axis=1), np.linalg.norm(geometry.so3_log(turns), axis=1)])
        rates = sizes / np.maximum(np.diff(table.stamp_ns[near]), 1)
        times = rates[:, -1] / np.maximum(rates[:, :-1].max(axis=1), 1e-30)
        jumps = (sizes[:, -1] > _LEAST_JUMP) & (times > _QUICKER)
        if jumps.any() and _shared(scene, row) < _MIN_POINTS:
            found.append(
                f"the front-end jumps at keyframe {table.keyframe_id[row]}, by {sizes[0, -1]:.3g} m and"
                f" {np.degrees(sizes[1, -1]):.3g} deg, {times[jumps].max():.0f} times as quick as before, and no track"
                " leads there: the map is in two parts, and where they lie to each other is not known. A front-end that"
                " begins anew has to raise session_id"
            )
    return found


def _shared(scene: Scene, row: int) -> int:
    """Return how many tracks of a keyframe were seen before it."""
    table, own = scene.observations, scene.rows_of(row)
    earlier = (scene.places() < scene.places()[row])[table.keyframe]
    return len(np.intersect1d(table.landmark[own], table.landmark[earlier]))


def _views(scene: Scene, config: Config, row: int, *, outliers: bool = False) -> Problem | None:
    """Return the views of known points by a keyframe, at the points as they are; None if there are too few."""
    table, points = scene.observations, scene.landmarks
    rows = scene.rows_of(row)
    rows = rows[points.has_position[table.landmark[rows]] & (outliers | ~table.outlier[rows])]
    landmarks = np.unique(table.landmark[rows]).astype(np.intp)
    if len(landmarks) < _MIN_POINTS:
        return None
    origin = scene.keyframes.position[scene.order[0]]
    return problem_of(scene, rows, np.array([row]), landmarks, origin, points.position[landmarks] - origin, config)[0]


def _near(problem: Problem, state: State, config: Config) -> int:
    """Return how many points are near enough to their views for the solve to mend the pose."""
    norms = native_kernels.residual_norms(problem, state, config.solver.kernels)
    return int(np.count_nonzero(norms <= _limit(problem)))


def _limit(problem: Problem) -> float:
    """Return the residual, sigmas, of a turn that is not left to the solve to mend."""
    return _FAR_RAD * float(problem.cameras.params[0, 0]) / float(problem.observations.sigma_px[0])


def _starts(scene: Scene, row: int) -> list[tuple[FloatArray, FloatArray]]:
    """Return poses (body from world, in the problem) to begin with: where others are or would put the keyframe."""
    table, order = scene.keyframes, scene.order
    origin = table.position[order[0]]
    at = int(scene.places()[row])
    before = order[:at][::-1][:_ASKED]
    poses = [(table.rotation[k], table.position[k]) for k in (row, *before)]
    if len(before) > 1:
        step = geometry.compose(*geometry.inverse(*poses[2]), *poses[1])
        poses.append(geometry.compose(*poses[1], *step))
    given = (table.input_rotation[row], table.input_position[row])
    poses += [geometry.compose(*scene.corrections(np.array(k)), *given) for k in before]
    return [geometry.inverse(rotation, position - origin) for rotation, position in poses]


def lowered(problem: Problem, state: State) -> State:
    """Return the pose after steps of a robust loss that narrows; points are held."""
    with np.errstate(all="ignore"):
        for width in _WIDTHS:
            measure = Objective(
                problem, SolverOptions(loss="geman_mcclure", loss_scale_px=width, cheirality="constant")
            )
            value, mu = measure.value(state), 1e-4
            for _ in range(_ROUNDS):
                at = measure.linearise(state)
                rows, residual = at.d_keyframe.reshape(-1, 6), at.residual.reshape(-1)
                normal = rows.T @ rows
                normal[np.diag_indices(6)] *= 1.0 + mu
                normal[np.diag_indices(6)] += 1e-9
                step = np.linalg.lstsq(normal, -(rows.T @ residual), rcond=None)[0]
                moved = measure.retract(state, np.asarray(step[None], float), np.zeros_like(state.points))
                after = measure.value(moved)
                if np.isfinite(after) and after < value:
                    state, value, mu = moved, after, mu / 5.0
                else:
                    mu *= 25.0
    return state
