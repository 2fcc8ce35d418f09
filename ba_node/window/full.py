# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine everything that is kept, on a snapshot, while windows go on being solved; then merge the result.

Between the copy and the result keyframes and points come, move and go. With ``A`` the pose (world from body) that a
keyframe k of the snapshot has when the result comes, and ``B`` the one that the result gives it, the correction at k is

    C_k = B inverse(A),         for one camera    C_k(x) = s_k R_C x + t_C,

s_k being the median, over the points of k in the result, of how much farther from k they are than before: where scale
drifts, the map has another scale at each of its ends.

- A keyframe of the snapshot gets B, a point of the snapshot its new place.
- Every other keyframe is moved by the correction of the last one of the snapshot before it, every other point by the
  correction of the keyframe that saw it first: what came later keeps its place relative to the end of the snapshot.
- Then the keyframes after the copy and a window before are solved, all others that see their points being fixed: what
  came later has seen points of the snapshot as well, and these have moved.
- A point that lost its place meanwhile stays without. What was forgotten is passed over, and the result of a map that
  is no longer the current one altogether.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.config import METHOD_LOSSES, CalibrationConfig, Config, SolverConfig, SolverOptions
from ba_node.core import calibration, geometry, methods, native_kernels, solver
from ba_node.core.calibration import Calibration
from ba_node.core.problem import State
from ba_node.core.result import Iteration, Result
from ba_node.estimate import Extras
from ba_node.scene.scene import Scene
from ba_node.window import odometry, quality
from ba_node.window.covariance import Covariances, covariances
from ba_node.window.merging import Merged, classify, merge, scaled, settled
from ba_node.window.problems import joined_observations, problem_of, some_observations
from ba_node.window.selection import Selection, select

# What solves a problem in place of solver.solve, as where many processes work on it.
Solve = Callable[..., Result]
MAX_ITERATIONS = 50
NOTHING = Extras()
# A window is solved again and again, everything once: it is worth more digits.
_FUNCTION_TOLERANCE = 1e-6
# Fewer points than this tell a keyframe no scale of its own.
_MIN_POINTS = 3
# Windows are not to wait long for it.
_MAX_JOINED = 100
# What is told of it.
_TOLD = (
    "method",
    "iterations",
    "objective_before",
    "objective_after",
    "rms_px_before",
    "rms_px_after",
    "keyframes",
    "landmarks",
    "observations",
)


def options(config: SolverConfig, method: str = "", max_iterations: int = 0) -> SolverOptions:
    """Return the choices for a solve of everything: those of the parameters but for what is given, and finer."""
    given = config.function_tolerance
    tolerance = min(given, _FUNCTION_TOLERANCE) if given >= 0.0 else _FUNCTION_TOLERANCE
    changed = dataclasses.replace(
        config,
        method=method or config.method,
        # A method that is named after a loss brings it.
        loss="auto" if method in METHOD_LOSSES else config.loss,
        max_iterations=max_iterations or MAX_ITERATIONS,
        function_tolerance=tolerance,
    )
    return methods.from_config(changed)


@dataclass
class Optimization:
    """A solve of everything that was kept at a moment, with the ids by which to find its parts again."""

    scene: Scene  # where it is from; asked only whether it is still the current one
    selection: Selection  # the problem. Its rows hold at that moment only.
    keyframe_id: IdArray  # (n_kf,) uint64
    track_id: IdArray  # (n_pt,) uint64
    placed: BoolArray  # (n_pt,) True where the point had a position
    position: FloatArray  # (n_kf, 3) positions at that moment, m: where scale floats, they go on giving it
    held: BoolArray  # (n_kf,) keyframes that are fixed but for the one that holds a floating scale
    floating: IntArray  # (n_kf,) as Selection.unscaled, of parts whose scale no step of the front-end holds
    stamp_ns: NDArray[np.int64]  # (n_kf,) ns
    refine: CalibrationConfig  # what of the cameras is refined too
    wanted: Extras = NOTHING  # what is to be worked out beside the solution
    # result and (n_all,) sizes of the residuals after it, as ``Selection.norms``; None before :meth:`solve`
    solved: tuple[Result, FloatArray] | None = None
    covariances: Covariances | None = None  # None likewise, and if they were not asked for
    calibration: Calibration | None = None  # None likewise

    def solve(
        self,
        config: SolverConfig,
        method: str = "",
        max_iterations: int = 0,
        *,
        clock: Callable[[], float] = lambda: 0.0,
        on_iteration: Callable[[Iteration], bool] | None = None,
        by: Solve | None = None,
    ) -> None:
        """Solve, on any thread; the map is not touched. Arguments as of :func:`options` and ``solver.solve``."""
        chosen = options(config, method, max_iterations)
        if self.refine.wanted:
            self._calibrate(chosen)
        # Refined cameras may take other pixels.
        with nullcontext() if self.refine.wanted else self._without_inliers():
            result = (by or solver.solve)(
                self.selection.problem, chosen, clock=clock, on_iteration=on_iteration, weakest=True
            )
        result = result.settled()
        self.solved = result, native_kernels.residual_norms(self.selection.whole, result.state, chosen.kernels)
        if self.wanted.covariance and result.status.usable and result.state.is_finite():
            problem = dataclasses.replace(self.selection.problem, fixed=self.held)
            state = self._scaled(result.state)
            selection = dataclasses.replace(self.selection, problem=problem)
            self.covariances = covariances(selection, state, self.position, chosen, points=self.wanted.points)

    @contextmanager
    def _without_inliers(self) -> Iterator[None]:
        """Keep of all observations those alone that the problem leaves out, until it is solved."""
        inlier = self.selection.inlier
        left_out = some_observations(self.selection.whole, np.flatnonzero(~inlier)).observations
        self.selection = dataclasses.replace(self.selection, observations=left_out)
        try:
            yield
        finally:
            whole = joined_observations(inlier, self.selection.problem.observations, left_out)
            self.selection = dataclasses.replace(self.selection, observations=whole)

    def _calibrate(self, chosen: SolverOptions) -> None:
        """Let the problem begin at the solution for refined cameras."""
        given, stamp_s = self.selection.problem, (self.stamp_ns - self.stamp_ns[0]) * 1e-9
        if given.n_factors:
            given = dataclasses.replace(given, fixed=self.held)  # the front-end's steps hold the scale
        problem, state, found = calibration.calibrate(given, stamp_s, chosen, self.refine)
        # The observations that sit the solve out are to be classified by the same cameras.
        everything = dataclasses.replace(given, observations=self.selection.observations)
        whole = calibration.with_calibration(everything, state, found, stamp_s)
        problem = dataclasses.replace(problem, start=state)
        self.selection = dataclasses.replace(self.selection, problem=problem, observations=whole.observations)
        self.calibration = found

    def _scaled(self, state: State) -> State:
        """Return a state in the scale of the map where nothing in the solve has told one."""
        return scaled(dataclasses.replace(self.selection, unscaled=self.floating), self.position, state)

    @property
    def result(self) -> Result:
        """Return what the solver gave back."""
        assert self.solved is not None, "solve() comes first"
        return self.solved[0]

    def with_result(self, **changes: Any) -> Optimization:
        """Return the same with another result of the solver: other words, for example, for why it stopped."""
        assert self.solved is not None, "solve() comes first"
        return dataclasses.replace(self, solved=(dataclasses.replace(self.result, **changes), self.solved[1]))

    def statistics(self) -> dict[str, Any]:
        """Return how the solve went, by the names of a report."""
        assert self.solved is not None, "solve() comes first"
        statistics = quality.statistics(self.selection, *self.solved)
        return {name: statistics[name] for name in _TOLD}

    def outcome(self, state: State, config: Config) -> Merged:
        """Return a solution in the scale of the map, with its points where they may be published."""
        return settled(self.selection, self._scaled(state), config.tracks, config.solver.kernels)


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation x + translation: (n,), (n, 3, 3), (n, 3)."""

    scale: FloatArray
    rotation: FloatArray
    translation: FloatArray

    def move(self, which: IntArray, points: FloatArray) -> FloatArray:
        """Return points moved, each by one of the transforms."""
        turned = (self.rotation[which] @ points[:, :, None])[..., 0]
        return np.asarray(self.scale[which, None] * turned + self.translation[which])


def take_snapshot(
    scene: Scene, config: Config, wanted: Extras = NOTHING, origin: Scene | None = None, *, bent: bool = False
) -> Optimization | str:
    """Return the problem of all keyframes and points, or why there is none; later changes do not reach it.

    ``origin`` is the scene that the result is for where this one is a clone of it. A map that was ``bent`` to meet a
    loop is not where the front-end's steps lead: it keeps its scale, unless they were found to be precise.
    """
    sizes = {"max_keyframes": max(2, len(scene.keyframes)), "max_landmarks": max(10, len(scene.landmarks))}
    window = dataclasses.replace(config.window, old_keyframes="fix", **sizes)
    selection = select(scene, dataclasses.replace(config, window=window))
    if isinstance(selection, str):
        return selection
    problem = selection.problem
    # The front-end's steps hold the scale where there are any; a second keyframe that is held would keep the map as
    # long, and turned, as it was.
    floating = selection.unscaled
    if not bent or scene.step_shares != (1.0, 1.0):
        tied = np.append(odometry.ties(scene, config.odometry, selection.keyframes), False)
        floating = np.where(np.isin(floating, floating[tied]), -1, floating)
    fixed = _fixed(problem.fixed, floating, scene.keyframes.position[selection.keyframes])
    selection = dataclasses.replace(selection, problem=dataclasses.replace(problem, fixed=fixed))
    return Optimization(
        origin or scene,
        selection,
        scene.keyframes.keyframe_id[selection.keyframes],
        scene.landmarks.track_id[selection.landmarks],
        scene.landmarks.has_position[selection.landmarks],
        scene.keyframes.position[selection.keyframes],
        problem.fixed,
        floating,
        scene.keyframes.stamp_ns[selection.keyframes],
        config.calibration,
        wanted,
    )


def _fixed(fixed: BoolArray, unscaled: IntArray, position: FloatArray) -> BoolArray:
    """Return the keyframes to fix: where scale floats, one more, the first that is a usual step from the fixed one.

    In many iterations with little damping a floating scale shrinks a map until nothing is left of it.
    """
    more = fixed.copy()
    for anchor in np.unique(unscaled[unscaled >= 0]):
        members = np.flatnonzero(unscaled == anchor)
        step = np.median(np.linalg.norm(np.diff(position[members], axis=0), axis=1)) if len(members) > 1 else 0.0
        away = np.linalg.norm(position[members] - position[anchor], axis=1)
        if len(members) > 2 and step > 0.0:
            more[members[np.argmax(away >= min(step, away.max()))]] = True
    return more


def merge_snapshot(scene: Scene, config: Config, taken: Optimization, state: State) -> int | None:
    """Merge the result for a snapshot, in the scale of the map (``Optimization.outcome``), into the map.

    Returns:
        How many refined keyframes that are not of the snapshot followed; None if nothing of the snapshot is left.
    """
    keyframes = scene.find_keyframes(taken.keyframe_id)
    here = keyframes >= 0
    if scene is not taken.scene or not here.any():
        return None
    table, points = scene.keyframes, scene.landmarks
    rotation, position = geometry.inverse(state.rotation, state.translation)
    rotation, position = geometry.nearest_rotation(rotation), position + taken.selection.origin
    found = state.points + taken.selection.origin
    landmarks = scene.find_landmarks(taken.track_id)
    kept = (landmarks >= 0) & (~taken.placed | points.has_position[landmarks])

    similarity = _corrections(scene, taken, (rotation, position, found), keyframes, landmarks)
    member = np.full(len(table), -1)
    member[keyframes[here]] = np.flatnonzero(here)
    anchor = _anchors(member[scene.order])
    anchor_of_row = np.empty(len(table), np.intp)
    anchor_of_row[scene.order] = anchor

    follow_points(scene, landmarks[kept], anchor_of_row, similarity)
    others = np.flatnonzero((member < 0) & table.refined)
    which = anchor_of_row[others]
    table.position[others] = similarity.move(which, table.position[others])
    table.rotation[others] = geometry.nearest_rotation(similarity.rotation[which] @ table.rotation[others])

    table.rotation[keyframes[here]], table.position[keyframes[here]] = rotation[here], position[here]
    table.refined[keyframes[here]] = True
    points.position[landmarks[kept]] = found[kept]
    points.has_position[landmarks[kept]] = True
    points.changed()
    scene.moved()
    scene.propagate_corrections()
    _classify(scene, config, taken.selection, keyframes[here], landmarks[kept])
    _join(scene, config, len(table) - 1 - int(scene.places()[keyframes[here]].max()))
    return len(others)


def _join(scene: Scene, config: Config, later: int) -> None:
    """Refine the keyframes on both sides of the seam against all that is older."""
    if later == 0:
        return
    size = min(later + config.window.max_keyframes, _MAX_JOINED)
    wide = dataclasses.replace(
        config.window, old_keyframes="fix", max_keyframes=size, max_fixed_keyframes=len(scene.keyframes)
    )
    selection = select(scene, dataclasses.replace(config, window=wide))
    if not isinstance(selection, str):
        result = solver.solve(selection.problem, options(config.solver, max_iterations=config.solver.max_iterations))
        merge(scene, selection, result, config.tracks, config.solver.kernels)


def _corrections(
    scene: Scene,
    taken: Optimization,
    result: tuple[FloatArray, FloatArray, FloatArray],
    keyframes: IntArray,
    landmarks: IntArray,
) -> Similarity:
    """Return the correction at each keyframe of the snapshot; senseless at those that are forgotten."""
    rotation, position, found = result
    before = (scene.keyframes.rotation[keyframes], scene.keyframes.position[keyframes])
    turn = rotation @ np.swapaxes(before[0], -1, -2)
    obs = taken.selection.problem.observations
    known = (landmarks >= 0) & taken.placed & scene.landmarks.has_position[landmarks]
    usable = known[obs.point] & (keyframes >= 0)[obs.keyframe] & (taken.selection.unscaled >= 0)[obs.keyframe]
    at, point = obs.keyframe[usable], obs.point[usable]
    far = np.linalg.norm(found[point] - position[at], axis=1)
    was = np.linalg.norm(scene.landmarks.position[landmarks[point]] - before[1][at], axis=1)
    sound = (far > 0) & (was > 0)
    scale = _medians(far[sound] / was[sound], at[sound], len(keyframes))
    return Similarity(scale, turn, position - scale[:, None] * (turn @ before[1][:, :, None])[..., 0])


def _medians(values: FloatArray, group: IntArray, n_groups: int) -> FloatArray:
    """Return the median of each group's values, 1 where there are too few to tell."""
    values = values[np.lexsort((values, group))]
    count = np.bincount(group, minlength=n_groups)
    middle = (np.cumsum(count) - count + (count - 1) // 2)[count >= _MIN_POINTS]
    even = count[count >= _MIN_POINTS] % 2 == 0
    median = np.ones(n_groups)
    median[count >= _MIN_POINTS] = np.where(even, 0.5 * (values[middle] + values[middle + even]), values[middle])
    return median


def _anchors(member: IntArray) -> IntArray:
    """Return for each keyframe, oldest first, the last ``member`` (number in the copy, -1: none), or the first."""
    at = np.maximum.accumulate(np.where(member >= 0, np.arange(len(member)), -1))
    return np.asarray(member[np.where(at < 0, int(np.argmax(member >= 0)), at)])


def follow_points(scene: Scene, updated: IntArray, anchor_of_row: IntArray, similarity: Similarity) -> None:
    """Move the points that the result does not place with the keyframe that saw them first."""
    follows = scene.landmarks.has_position.copy()
    follows[updated] = False
    places = scene.places()
    first = np.zeros(len(scene.landmarks), np.intp)
    first[scene.observations.landmark] = len(places) - 1
    np.minimum.at(first, scene.observations.landmark, places[scene.observations.keyframe])
    rows = np.flatnonzero(follows)
    which = anchor_of_row[scene.order[first[rows]]]
    scene.landmarks.position[rows] = similarity.move(which, scene.landmarks.position[rows])


def _classify(scene: Scene, config: Config, selection: Selection, keyframes: IntArray, landmarks: IntArray) -> None:
    """Classify what the keyframes of the snapshot saw of its points anew; later ones have their windows for that."""
    views = scene.views_of(landmarks)
    origin = selection.origin
    problem, rows = problem_of(
        scene, views, keyframes, landmarks, origin, scene.landmarks.position[landmarks] - origin, config
    )
    now = dataclasses.replace(
        selection,
        problem=problem,
        observations=problem.observations,
        rows=rows,
        inlier=~scene.observations.outlier[rows],
        keyframes=keyframes,
        landmarks=landmarks,
    )
    norms = native_kernels.residual_norms(problem, problem.start, config.solver.kernels)
    classify(scene, now, problem.start, norms, config.tracks, config.solver.kernels)
