# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Close loops and follow the world: bend the whole map before everything is refined.

A loop, or a place in the world, may lie metres from where the map has drifted to; a solve of everything would not find
there from so far, and would take what is right for outliers. So the keyframes are bent first, as a graph of poses:
each step between consecutive keyframes is as the map has it, to a third of what a step of the front-end is worth, and
what is measured beside pixels pulls. Points follow the keyframe that saw them first.

A map that grows is refined as a whole from time to time without being bent.

All this is done to a copy of the map, on any thread, while windows go on being solved; the map then follows it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import Config, OdometryConfig, SolverOptions
from ba_node.core import geometry, solver
from ba_node.core.factors import RelativePoses
from ba_node.core.priors import PosePriors
from ba_node.core.problem import KeyframeFactors, Observations, Problem, State
from ba_node.estimate import Extras
from ba_node.scene.scene import Scene
from ba_node.window import constraints, contradicted, full, loops, odometry, outvoted, receiver, retriangulation, trial

# What a step of the map is worth, by what one of the front-end's is; how far (rms, in sigmas) steps may be bent.
_WORTH, _BENT = 1.0 / 3.0, 10.0
# Between two sessions nothing was measured: they were aligned so well at least.
_SEAM_RAD, _SEAM_M = 0.1, 1.0
# How far the first keyframe may be turned where nothing else tells.
_UPRIGHT_RAD = 0.02
# Absolute measurements of so many keyframes tell whether the map has left the world, at so many standard deviations.
_RECENT, _TELLING = 50, 4.0
# That is asked once in so many keyframes.
_ASKED = 5
# One that lies far beside the map may be wrong, and nothing else may tell: it takes so many that agree to move it.
_CONFIRMED = 2
# Map and world are tried to be aligned again once the map has grown by this share.
_TRY_AGAIN = 0.15
# And again once the map has grown by this share, and by so many keyframes.
_GROWN, _FEW = 0.05, 10
# A map of at most so many keyframes is refined as a whole each time that it is so many times as large: with one camera
# that shows no lengths, whose scale drifts, and with others.
_YOUNG, _AGAIN = 320, (1.25, 1.4)
_ITERATIONS = 30
# Share of the keyframes that windows have to have refined.
_REFINED = 0.8
# Warnings that say nothing of the images and poses that are in the map; and those of what is left out of solves.
_OF_NAMES = frozenset(["bad_stamp", "equal_stamps", "clock_jump", "clock_step", "lower_session", "stray_session"])
_ALLOWED = _OF_NAMES | {"frame_changed", "frame_name", "far_from_origin", "moving", "outvoted", "parted", "stray"}
# Poses that explain tracks better by less than this share do so by rounding; worse by more than that, worse indeed.
_ROUNDED, _WORSE = 1e-9, 0.005
_NOTHING_CAME = "nothing came of a solve of everything"
# Priors lie beside the map at so many standard deviations; where more than this share does they tell nothing.
_BESIDE, _CONTRADICTING = 10.0, 0.6


@dataclass
class Adjustment:
    """A copy of the map that is bent and refined."""

    scene: Scene  # that it is a copy of
    due: loops.Due
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
        self.why = (not self.due.grown and bend(self._copy, self.config, self.due)) or self._refine()

    def _refine(self) -> str:
        """Refine all of the copy if that can be; return why the map is to stay as it is."""
        if len(self._copy.keyframes) > self.config.factors.adjust_max_keyframes:
            return ""
        config = self.config
        if self.due.loops and not retriangulation.has_scale(self._copy):
            config = retriangulation.close_gaps(self._copy, config)
        begun = self._solved(self._copy, config)
        if isinstance(begun, str):
            # Where no point has a place, images have nothing to say against it.
            return begun if begun.startswith(_NOTHING_CAME) or self._copy.landmarks.has_position.any() else ""
        self.taken = begun
        if self.due.loops:
            self._close_gaps(begun, config)
        return ""

    def _solved(self, scene: Scene, config: Config) -> full.Optimization | str:
        """Return a solve of everything in a copy, or why there is none, in words."""
        begun = full.take_snapshot(scene, config, self.wanted, self.scene, bent=not self.due.grown)
        if isinstance(begun, str):
            return f"no solve of everything can begin: {begun}"
        unscaled = self.due.grown and not retriangulation.has_scale(scene)
        if unscaled and begun.selection.much_moves:
            return "much of what is seen moves"
        begun.solve(self.config.solver)
        result = begun.result
        usable = result.status.usable and result.state.is_finite()
        if unscaled and usable and not _explains_better(scene, begun, self._before, config, -_WORSE):
            return "it explains the tracks worse"
        return begun if usable else f"{_NOTHING_CAME}: {result.reason}"

    def _close_gaps(self, begun: full.Optimization, config: Config) -> None:
        """Refine the keyframes that a solve of everything has left out, if poses then explain the tracks better."""
        copy = self._copy.clone()
        refined = begun.outcome(begun.result.state, config).state
        if (
            refined is None
            or full.merge_snapshot(copy, config, dataclasses.replace(begun, scene=copy), refined) is None
        ):
            return
        if copy.keyframes.refined.all():
            return
        before = copy.keyframes.rotation.copy(), copy.keyframes.position.copy()
        closed = self._solved(copy, retriangulation.close_gaps(copy, config))
        if not isinstance(closed, str) and _explains_better(copy, closed, before, config):
            self._copy, self.taken = copy, closed

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
        loops.join(scene, self.due.joined)
        scene.constraints.map_from_world = bent.constraints.map_from_world

    def end(self, why: str) -> None:
        """Take note that it is over, and why the map stays as it was, in words; empty if it does not."""
        known = self.scene.constraints
        if self.due.grown or (self.due.quiet and why):
            if why:
                self.scene.log.notice("not_refined")
            return
        known.adjusted_at = len(self.scene.keyframes)
        if not why:
            contradicted.say_contradicted(self.scene, self.config.factors)
            return
        if self.due.key is not None:
            known.refused.add(self.due.key)
        known.merges = [pair for pair in known.merges if pair not in self.due.joined]
        self.scene.log.warn("not_adjusted", f"{self.due.cause}; the map stays as it is: {why}")


def _explains_better(
    scene: Scene, taken: full.Optimization, poses: tuple[FloatArray, FloatArray], config: Config, by: float = _ROUNDED
) -> bool:
    """Return whether a solve explains the tracks better, by a share, than poses (rotations, positions by row) do."""
    whole, rows = taken.selection.whole, scene.find_keyframes(taken.keyframe_id)
    state = taken.outcome(taken.result.state, config).state
    if state is None:
        return False
    before = geometry.inverse(poses[0][rows], poses[1][rows] - taken.selection.origin)
    tried, _ = trial.choose(taken.track_id, whole.observations.point, len(taken.track_id))
    found = trial.explained(whole, (tried, 0), before, (state.rotation, state.translation), config.solver.kernels)
    return bool(found.mean[1, 0] < (1.0 - by) * found.mean[0, 0])


def due(scene: Scene, config: Config, *, final: bool = False) -> loops.Due | None:
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
    if final or n - known.compared_at >= max(_FEW, _GROWN * n):
        known.compared_at = n
        outvoted.say_outvoted(scene, config.factors, everything=final)
    jumped = ""
    if known.absolute and (final or n - known.judged_at >= max(_FEW, _GROWN * n)):
        known.judged_at = n
        jumped = receiver.judge(scene, config.factors)
    if final and (known.absolute or known.landmarks) and known.map_from_world is None:
        count = len(known.absolute) + len(known.landmarks)
        scene.log.warn(
            "unaligned",
            f"{count} priors in frame {known.world_frame!r} were not used: the path is too short, or they are too few"
            " or too noisy, to tell where the map lies in it (factors.align_m)."
            f"{contradicted.likely(scene, constraints.every_pair(scene, config.factors), units_alone=True)}",
        )
    found = loops.merged(scene, config, final) if known.merges else None
    found = found or (loops.measured(scene, config) if known.unchecked else None)
    if known.steps_precise and not found:
        known.steps_precise = False
        found = loops.Due("the front-end's steps are more precise than was stated", quiet=True)
    return found or (loops.Due(jumped) if jumped else _left_the_world(scene, config, final) or _grown(scene, config))


def _grown(scene: Scene, config: Config) -> loops.Due | None:
    """Return whether a young map has grown by so much that all of it is to be refined again.

    Windows hold what is older as it was found when less was known, and with it the scale of one camera. Not where more
    than pixels and steps places the map, where a fifth of the keyframes is not refined, where more is odd than stamps,
    names and what is left out (what moves, keyframes that contradict their tracks), where little is seen, where the
    front-end is far worse than stated, or, with one camera, where it hardly moves for some of the time.
    """
    known, n, window = scene.constraints, len(scene.keyframes), config.window
    odd = scene.log.warnings.keys() - _ALLOWED
    if not max(window.max_keyframes + 1, _AGAIN[0] * known.grown_at) <= n <= _YOUNG or odd:
        return None
    if window.old_keyframes != "fix" or config.factors.adjust_m <= 0.0:
        return None
    scaled = retriangulation.has_scale(scene)
    if n < _AGAIN[scaled] * known.grown_at:
        return None
    looped = known.renamed or any(one.is_loop for one in known.relative.values())
    if known.absolute or known.landmarks or known.seams or looped:
        return None
    if scene.keyframes.refined[scene.order].mean() < _REFINED:
        return None
    known.grown_at = n
    told = scaled or odometry.tell_scale(scene, config.odometry)
    sound = told and odometry.as_stated(scene, config.odometry)
    return loops.Due("the map has grown", grown=True) if sound else None


def bend(scene: Scene, config: Config, what: loops.Due) -> str:
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
    loops.join(scene, what.joined)
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


def _left_the_world(scene: Scene, config: Config, final: bool) -> loops.Due | None:
    """Return whether recent absolute measurements agree that the map lies beside where they are."""
    known, n = scene.constraints, len(scene.keyframes)
    if known.map_from_world is None or config.factors.adjust_m <= 0.0:
        return None
    if n - known.adjusted_at < (1 if final else max(_FEW, _GROWN * n)) or (n - known.asked_at < _ASKED and not final):
        return None
    known.asked_at = n
    pairs = constraints.every_pair(scene, config.factors, max(n - _RECENT, 0))
    if not len(pairs):
        return None
    rotation, translation = known.map_from_world
    off = pairs.position @ rotation.T + translation - pairs.points(scene)
    sigma = float(np.median(np.sqrt(np.trace(pairs.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3.0)))
    middle = np.median(off, axis=0)
    middle_m, noise_m = float(np.linalg.norm(middle)), _TELLING * sigma
    scene.log.warnings.pop("unconfirmed", None)
    if middle_m <= max(config.factors.adjust_m, noise_m / np.sqrt(len(pairs))) and not final:
        return None
    near_m = max(config.factors.adjust_m, np.sqrt(3.0) * noise_m)
    agreeing = np.count_nonzero(np.linalg.norm(off - middle, axis=1) <= near_m)
    if middle_m > near_m and agreeing < _CONFIRMED:
        priors = f"in frame {known.world_frame!r}"
        which = f"of {len(pairs)} recent priors {priors} no two agree, and half of them lie"
        which = f"the only recent prior {priors} lies" if len(pairs) == 1 else which
        text = f"{which} {middle_m:.2f} m beside the map: it stays as it is until another one confirms that."
        text += contradicted.likely(scene, pairs)
        scene.log.warn("unconfirmed", text)
        return None
    return loops.Due(f"the map has come to lie {middle_m:.2f} m beside where priors have it")
