# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Close loops and follow the world: bend the whole map before everything is refined.

A loop, or a place in the world, may lie metres from where the map has drifted to; a solve of everything would not find
there from so far, and would take what is right for outliers. So the keyframes are bent first, as a graph of poses:
each step between consecutive keyframes is as the map has it, to a third of what a step of the front-end is worth, and
what is measured beside pixels pulls. Points follow the keyframe that saw them first.

Where tracks are the same points as older ones, the keyframe that sees most of them is placed by where these lie, as
one that the front-end has put in a wrong place (``arrival.py``): that is the loop. Pairs that do not agree with the
others stay apart.

All this is done to a copy of the map, on any thread, while windows go on being solved; the map then follows it.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.config import Config, OdometryConfig, SolverOptions
from ba_node.core import geometry, native_kernels, solver
from ba_node.core.factors import RelativePoses
from ba_node.core.priors import PosePriors
from ba_node.core.problem import KeyframeFactors, Observations, Problem, State
from ba_node.estimate import Extras
from ba_node.scene.scene import Scene
from ba_node.window import arrival, constraints, contradicted, full, receiver, retriangulation
from ba_node.window.problems import problem_of

# So many tracks place a keyframe; a view agrees within so many outlier gates, as the map has drifted apart.
LEAST, WIDE = 6, 3.0
# What a step of the map is worth, by what one of the front-end's is; how far (rms, in sigmas) steps may be bent.
_WORTH, _BENT = 1.0 / 3.0, 10.0
# Between two sessions nothing was measured: they were aligned so well at least.
_SEAM_RAD, _SEAM_M = 0.1, 1.0
# How far the first keyframe may be turned where nothing else tells.
_UPRIGHT_RAD = 0.02
# Absolute measurements of so many keyframes tell whether the map has left the world, at so many standard deviations.
_RECENT, _TELLING = 50, 4.0
# Map and world are tried to be aligned again once the map has grown by this share.
_TRY_AGAIN = 0.15
# And again once the map has grown by this share, and by so many keyframes.
_GROWN, _FEW = 0.05, 10
_ITERATIONS = 30
# Priors lie beside the map at so many standard deviations; where more than this share does they tell nothing.
_BESIDE, _CONTRADICTING = 10.0, 0.6


@dataclass(frozen=True)
class Due:
    """What begins a solve of everything."""

    cause: str  # in words
    loops: tuple[RelativePoses, ...] = ()  # by rows of the scene
    joined: tuple[tuple[int, int], ...] = ()  # tracks that go on under the id of another
    key: tuple[int, int] | None = None  # keyframes of the relative pose that the map does not meet


@dataclass
class Adjustment:
    """A copy of the map that is bent and refined."""

    scene: Scene  # that it is a copy of
    due: Due
    config: Config
    wanted: Extras  # what is to be worked out beside the solution
    why: str = "it broke off"  # why the map is to stay as it is, in words; empty where it is not
    taken: full.Optimization | None = None  # the solve of everything; None where the map is bent alone

    def __post_init__(self) -> None:
        """Copy the map."""
        self._copy = self.scene.clone()
        self._before = self._copy.keyframes.rotation.copy(), self._copy.keyframes.position.copy()

    def run(self) -> None:
        """Bend and refine the copy, on any thread."""
        self.why = bend(self._copy, self.config, self.due) or self._refine()

    def _refine(self) -> str:
        """Refine all of the copy if that can be; return why the map is to stay as it is."""
        if len(self._copy.keyframes) > self.config.factors.adjust_max_keyframes:
            return ""
        config = retriangulation.close_gaps(self._copy, self.config) if self.due.loops else self.config
        begun = full.take_snapshot(self._copy, config, self.wanted, self.scene)
        if isinstance(begun, str):
            # Where no point has a place, images have nothing to say against it.
            return f"no solve of everything can begin: {begun}" if self._copy.landmarks.has_position.any() else ""
        begun.solve(self.config.solver)
        self.taken, result = begun, begun.result
        usable = result.status.usable and result.state.is_finite()
        return "" if usable else f"nothing came of a solve of everything: {result.reason}"

    def put(self) -> None:
        """Move the map as its copy was bent; what came later follows the newest keyframe of that. Join tracks."""
        scene, bent = self.scene, self._copy
        rows = scene.find_keyframes(bent.keyframes.keyframe_id)
        here = np.flatnonzero(rows >= 0)
        which = np.full(len(scene.keyframes), int(bent.order[-1]))
        which[rows[here]] = here
        turn = bent.keyframes.rotation @ np.swapaxes(self._before[0], 1, 2)
        shift = bent.keyframes.position - (turn @ self._before[1][:, :, None])[..., 0]
        rotation = geometry.nearest_rotation(turn[which] @ scene.keyframes.rotation)
        position = (turn[which] @ scene.keyframes.position[:, :, None])[..., 0] + shift[which]
        scene.propagate_corrections()
        _move(scene, rotation, position)
        scene.keyframes.refined[rows[here]] |= bent.keyframes.refined[here]
        join(scene, self.due.joined)
        scene.constraints.map_from_world = bent.constraints.map_from_world

    def end(self, why: str) -> None:
        """Take note that it is over, and why the map stays as it was, in words; empty if it does not."""
        known = self.scene.constraints
        known.adjusted_at = len(self.scene.keyframes)
        if not why:
            contradicted.say_contradicted(self.scene, self.config.factors)
            return
        if self.due.key is not None:
            known.refused.add(self.due.key)
        known.merges = [pair for pair in known.merges if pair not in self.due.joined]
        self.scene.log.warn("not_adjusted", f"{self.due.cause}; the map stays as it is: {why}")


def due(scene: Scene, config: Config, *, final: bool = False) -> Due | None:
    """Return why the whole map is to be bent now, None if it is not; join tracks whose places agree already.

    ``final``: nothing more will come.
    """
    known, n = scene.constraints, len(scene.keyframes)
    if not config.factors.enabled or n < 2 or scene.cameras is None:
        return None
    unaligned = bool(known.absolute or known.landmarks) and known.map_from_world is None
    if unaligned and (final or n - known.adjusted_at >= _TRY_AGAIN * n):
        known.adjusted_at = n
        constraints.align(scene, config)
    jumped = ""
    if known.absolute and (final or n - known.judged_at >= max(_FEW, _GROWN * n)):
        known.judged_at = n
        jumped = receiver.judge(scene, config.factors)
    if final and (known.absolute or known.landmarks) and known.map_from_world is None:
        count = len(known.absolute) + len(known.landmarks)
        scene.log.warn(
            "unaligned",
            f"{count} priors in frame {known.world_frame!r} were not used: the path is too short, or they are too few"
            " or too noisy, to tell where the map lies in it (factors.align_m)",
        )
    found = _merged(scene, config, final) if known.merges else None
    found = found or (_measured(scene, config) if known.unchecked else None)
    if known.steps_precise and not found:
        known.steps_precise = False
        found = Due("the front-end's steps are more precise than was stated")
    return found or (Due(jumped) if jumped else _left_the_world(scene, config, final))


def bend(scene: Scene, config: Config, what: Due) -> str:
    """Bend the map, join tracks; return why not, in words, in which case nothing was changed."""
    table, order = scene.keyframes, scene.order
    scene.propagate_corrections()
    steps, place, origin = _steps(scene, config.odometry), scene.places(), table.position[order[0]]
    others = tuple(kind.take(np.arange(len(kind)), place) for kind in (*what.loops, *_loops(scene)))
    world = _world(scene, config, origin)
    fixed = np.zeros(len(order), bool)
    fixed[0] = not world
    start = State(*geometry.inverse(table.rotation[order], table.position[order] - origin), *2 * (np.empty((0, 3)),))
    none = Observations(*3 * (np.empty(0, np.intp),), np.empty((0, 2)), *3 * (np.empty(0),))
    assert scene.cameras is not None
    state = start
    # From far off a robust loss would take the loop for an outlier: first it is one square.
    for loss in ("squared", "cauchy"):
        factors = (steps, *(dataclasses.replace(kind, loss=loss) for kind in others), *world)
        problem = Problem(state, fixed, scene.cameras, none, factors)
        options = dataclasses.replace(SolverOptions(), max_iterations=_ITERATIONS, function_tolerance=1e-6)
        result = solver.solve(problem, options)
        if not result.status.usable:
            return f"the poses cannot be bent: {result.reason}"
        state = result.state
    bent = float(np.sqrt(np.mean(steps.residuals(state) ** 2)))
    if bent > _BENT:
        return f"steps would have to be bent by {bent:.1f} of their standard deviations"
    if world:
        wrong = np.linalg.norm(world[0].residuals(state)[:, 3:], axis=1) > _BESIDE
        if np.count_nonzero(wrong) > _CONTRADICTING * len(wrong):
            count = f"{np.count_nonzero(wrong)} of {len(wrong)} priors would lie beside it"
            return f"{count}: they contradict each other, or their covariance is too small"
    rotation, position = geometry.inverse(state.rotation, state.translation)
    _move(scene, geometry.nearest_rotation(rotation)[place], (position + origin)[place])
    # Where the world holds them they need no images.
    table.refined[:] |= bool(world)
    join(scene, what.joined)
    return ""


def _world(scene: Scene, config: Config, origin: FloatArray) -> tuple[KeyframeFactors, ...]:
    """Return the factors of all that is absolute, by places in the order of time; none without an alignment."""
    known = scene.constraints
    if not (known.absolute or known.landmarks) or not constraints.align(scene, config):
        return ()
    pairs = constraints.every_pair(scene, config.factors)
    if not len(pairs):
        return ()
    return constraints.absolute(scene, config, pairs, scene.places()[pairs.row], origin), _upright(scene)


def _upright(scene: Scene) -> PosePriors:
    """Return what holds the first keyframe as it is turned: positions along a straight road do not tell its roll."""
    root = np.diag(np.repeat([1.0 / _UPRIGHT_RAD, 0.0], 3))
    first, none = scene.keyframes.rotation[scene.order[:1]], np.zeros((1, 3))
    return PosePriors(np.array([[0]]), first, none, none, root[None])


def _move(scene: Scene, rotation: FloatArray, position: FloatArray) -> None:
    """Give all keyframes new poses, by row; points follow."""
    table = scene.keyframes
    turn = rotation @ np.swapaxes(table.rotation, 1, 2)
    moved = full.Similarity(np.ones(len(table)), turn, position - (turn @ table.position[:, :, None])[..., 0])
    full.follow_points(scene, np.empty(0, np.intp), np.arange(len(table)), moved)
    table.rotation[:], table.position[:] = rotation, position
    scene.moved()
    scene.landmarks.changed()


def _steps(scene: Scene, config: OdometryConfig) -> RelativePoses:
    """Return the steps of the map between consecutive keyframes, by places in the order of time."""
    table, order = scene.keyframes, scene.order
    back = geometry.inverse(table.rotation[order[:-1]], table.position[order[:-1]])
    turn, move = geometry.compose(*back, table.rotation[order[1:]], table.position[order[1:]])
    length, angle = np.linalg.norm(move, axis=1), np.linalg.norm(geometry.so3_log(turn), axis=1)
    sigma_rad = config.sigma_rad + config.sigma_rad_per_m * length + config.sigma_rad_per_rad * angle
    sigma_m = config.sigma_m + config.sigma_m_per_m * length
    root = np.zeros((len(move), 6, 6))
    axes = np.arange(3)
    root[:, axes, axes] = 1.0 / np.maximum(_WORTH * sigma_rad, 1e-9)[:, None]
    root[:, axes + 3, axes + 3] = 1.0 / np.maximum(_WORTH * sigma_m, 1e-9)[:, None]
    anew = np.diff(scene.sessions_of(order)) > 0
    root[anew] = np.diag(np.repeat([1.0 / _SEAM_RAD, 1.0 / _SEAM_M], 3))
    at = np.arange(len(move))
    return RelativePoses(np.stack([at, at + 1], axis=1), turn, move, root)


def _loops(scene: Scene) -> tuple[RelativePoses, ...]:
    """Return all measured relative poses of refined keyframes, by rows of the scene."""
    found = []
    for key, one in scene.constraints.relative.items():
        ends = [scene.find_keyframe(end) for end in key]
        if None not in ends and key not in scene.constraints.refused:
            found.append((ends, one.rotation, one.position, one.root))
    if not found:
        return ()
    ends_of, rotation, position, root = (np.array(values) for values in zip(*found, strict=True))
    return (RelativePoses(ends_of, rotation, position, root, "cauchy", 3.0),)


def _measured(scene: Scene, config: Config) -> Due | None:
    """Return a loop by pose that the map does not meet."""
    known, table = scene.constraints, scene.keyframes
    for key in list(known.unchecked):
        ends = [scene.find_keyframe(end) for end in key]
        if None in ends or not table.refined[np.array(ends, np.intp)].all():
            continue
        known.unchecked.remove(key)
        first, second = np.array(ends, np.intp)
        back = geometry.inverse(table.rotation[first], table.position[first])
        _, there = geometry.compose(*back, table.rotation[second], table.position[second])
        off = float(np.linalg.norm(there - known.relative[key].position))
        if 0.0 < config.factors.adjust_m < off and known.relative[key].is_loop:
            return Due(f"the relative pose of keyframe {key[1]} in {key[0]} is {off:.2f} m off the map", key=key)
    return None


def _left_the_world(scene: Scene, config: Config, final: bool) -> Due | None:
    """Return whether recent absolute measurements agree that the map lies beside where they are."""
    known, n = scene.constraints, len(scene.keyframes)
    if known.map_from_world is None or config.factors.adjust_m <= 0.0:
        return None
    if n - known.adjusted_at < (1 if final else max(_FEW, _GROWN * n)):
        return None
    pairs = constraints.every_pair(scene, config.factors, max(n - _RECENT, 0))
    if not len(pairs):
        return None
    rotation, translation = known.map_from_world
    off = pairs.position @ rotation.T + translation - pairs.points(scene)
    sigma = np.sqrt(np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
    middle = float(np.linalg.norm(np.median(off, axis=0)))
    if middle > max(config.factors.adjust_m, _TELLING * float(np.median(sigma)) / np.sqrt(len(pairs))) or final:
        return Due(f"the map has come to lie {middle:.2f} m beside where priors have it")
    return None


def _merged(scene: Scene, config: Config, final: bool) -> Due | None:
    """Return the loop that pairs of tracks tell; join those whose places agree, turn away those that are none."""
    known, points, table = scene.constraints, scene.landmarks, scene.keyframes
    pairs = np.array(known.merges, np.uint64)
    rows = scene.find_landmarks(pairs.ravel()).reshape(-1, 2)
    there = np.flatnonzero((rows >= 0).all(axis=1))
    pairs, rows = pairs[there], rows[there]
    both = np.array([bool(_images(scene, a) & _images(scene, b)) for a, b in rows], bool)
    if both.any():
        _give_up(scene, pairs[both], "one image sees both, they are no one point")
        pairs, rows = pairs[~both], rows[~both]
    if np.count_nonzero(points.has_position[rows[:, 1]]) < LEAST:
        # Windows of then gave them no place: those of now tell where the earlier keyframe is.
        rows = rows[:, ::-1]
    seen = points.has_position[rows[:, 1]]
    new, seen[seen] = _most_seen(scene, rows[seen])
    if np.count_nonzero(seen) < LEAST:
        if final and known.merges:
            _give_up(scene, np.array(known.merges, np.uint64), f"no keyframe sees {LEAST} that have a place")
        return None
    old = min((int(k) for k, _ in _images(scene, rows[seen][0, 1])), key=lambda k: int(scene.places()[k]))
    found = _resected(scene, config, new, rows[seen], old)
    if found is None:
        _give_up(
            scene, pairs, f"keyframe {table.keyframe_id[new]} sees them nowhere near where these are, from any place"
        )
        return None
    pose, agrees, sigma_rad, far_m = found
    if not agrees.all():
        _give_up(scene, pairs[seen][~agrees], "the others do not see it there")
    joined = tuple((int(a), int(b)) for a, b in np.concatenate([pairs[seen][agrees], pairs[~seen]]))
    moved = float(np.linalg.norm(pose[1] - table.position[new]))
    if not 0.0 < config.factors.adjust_m < moved:
        join(scene, joined)
        return None
    measured = geometry.compose(*geometry.inverse(table.rotation[old], table.position[old]), *pose)
    root = np.diag(np.repeat([1.0 / sigma_rad, 1.0 / (sigma_rad * far_m)], 3))
    loop = RelativePoses(np.array([[old, new]]), measured[0][None], measured[1][None], root[None])
    off = f"{moved:.2f} m beside where the map has it"
    return Due(f"{len(joined)} merged tracks see keyframe {table.keyframe_id[new]} {off}", (loop,), joined)


def join(scene: Scene, pairs: tuple[tuple[int, int], ...]) -> None:
    """Let tracks go on under the ids of others."""
    for track, other in pairs:
        scene.join_tracks(track, other)
    scene.constraints.merges = [pair for pair in scene.constraints.merges if pair not in pairs]


def _give_up(scene: Scene, pairs: IdArray, why: str) -> None:
    """Turn pairs away."""
    given = [(int(a), int(b)) for a, b in pairs]
    scene.log.reject("bad_merge", f"merge of track {given[0][0]} with {given[0][1]}: {why}", len(given))
    scene.constraints.merges = [pair for pair in scene.constraints.merges if pair not in given]


def _images(scene: Scene, landmark: int) -> set[tuple[int, int]]:
    """Return keyframe and camera of all views of a landmark."""
    views, seen = scene.views_of(np.array([landmark])), scene.observations
    return set(zip(seen.keyframe[views].tolist(), seen.camera[views].tolist(), strict=True))


def _most_seen(scene: Scene, rows: IntArray) -> tuple[int, BoolArray]:
    """Return the keyframe that sees the first of most pairs (n, 2) of landmarks, the newest of several, and which."""
    seen = [{keyframe for keyframe, _ in _images(scene, row)} for row in rows[:, 0]]
    count = Counter(keyframe for one in seen for keyframe in one)
    place = scene.places()
    new = max(count, key=lambda keyframe: (count[keyframe], place[keyframe]), default=-1)
    return new, np.array([new in one for one in seen], bool)


def _resected(
    scene: Scene, config: Config, new: int, rows: IntArray, old: int
) -> tuple[tuple[FloatArray, FloatArray], BoolArray, float, float] | None:
    """Return where a keyframe is that sees the places of other landmarks; None if most of its views agree with none.

    ``rows`` (n, 2) are the landmarks that it sees and those that are the same points; it may be near ``old``.

    Returns:
        Rotation and position in the map; which pairs agree (n,); standard deviation of its rotation, rad; distance of
        the points, m.
    """
    table, points = scene.keyframes, scene.landmarks
    views = scene.views_of(rows[:, 0])
    origin = table.position[old]
    order = np.argsort(rows[:, 0])
    problem, _ = problem_of(
        scene, views, np.array([new]), rows[order, 0], origin, points.position[rows[order, 1]] - origin, config
    )
    best, least = problem.start, np.inf
    for row in (new, old):
        pose = geometry.inverse(table.rotation[row], table.position[row] - origin)
        begin = State(pose[0][None], pose[1][None], problem.start.points, problem.start.intrinsics)
        state = arrival.lowered(problem, begin)
        off = native_kernels.residual_norms(problem, state, config.solver.kernels)
        cost = float(np.sum(np.minimum(off, WIDE * config.tracks.outlier_px)))
        if cost < least:
            best, least = state, cost
    norms = native_kernels.residual_norms(problem, best, config.solver.kernels)
    right = np.bincount(problem.observations.point, norms <= WIDE * config.tracks.outlier_px, len(rows)) > 0
    if np.count_nonzero(right) < max(LEAST, (len(rows) + 1) // 2):
        return None
    agrees = np.empty(len(rows), bool)
    agrees[order] = right
    rotation, position = geometry.inverse(best.rotation[0], best.translation[0])
    far = float(np.median(np.linalg.norm(best.points[right] - position, axis=1)))
    obs = problem.observations
    noise = float(np.median(obs.sigma_px)) * max(1.0, float(np.median(norms)))
    sigma_rad = 2.0 * noise / float(problem.cameras.params[0, 0]) / np.sqrt(np.count_nonzero(right))
    return (geometry.nearest_rotation(rotation), position + origin), agrees, sigma_rad, far
