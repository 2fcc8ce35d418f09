# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of all images together whether the intrinsics of cameras change on the way.

``onset.py`` compares an image with points that two before it place. A camera that looks sideways sees few points so
often, and takes another region of interest for a step, a zoom for points that are nearer. All images together know
better. Keyframes are adjusted with the cameras as given; then each image k gets a focal length and a principal point of
its own, off the given ones by theta_k, in focal lengths. With poses and points eliminated (bordered.py) the normal
equations of these are ``V theta = r``. What one change from keyframe K on, beside a mistake of all images, would be
worth follows by sums::

    theta_k = a + b [k >= K]        [A_00 A_0K] [a]   [r_0]      A_JL = sum of V_kl over k >= J, l >= L
                                    [A_K0 A_KK] [b] = [r_K]      r_J  = sum of r_k over k >= J

``b' cov(b)^-1 b`` is a score, chi-square of three degrees of freedom where nothing changes (Rao, *Large sample tests of
statistical hypotheses concerning several parameters*, 1948), and one linearisation tells it of every K. The likeliest
is then adjusted in earnest, and the cameras as given once more from where that ended: the change has to leave clearly
less.

The front-end's poses are where all this begins, no more; but where steps of theirs jump nearby, poses may have ended
anywhere, and nothing is told. A lower score counts where the step to that keyframe alone is far off the front-end's: so
it is where a change passes for a step, and what changed can hardly be told. Not where the front-end's own step stands
out of its others: it is that which jumps.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.check.adjusted import ALONG, DAMPING, Adjusted, Measure, placed, problem_of_all
from ba_node.check.diagnosis import Diagnosis, Finding
from ba_node.check.onset import ADVICE, ERRORS, LEAST, Change, named
from ba_node.check.tracks import Tracks
from ba_node.core import bordered, geometry, native_kernels
from ba_node.core.cameras import CX, CY, FX, FY
from ba_node.core.problem import Cameras, Problem, State

# Keyframes that are needed, and those at either end at which no change is looked for.
_KEYFRAMES, _ENDS = 12, 4
_NEWEST, _OBSERVATIONS, _MAX_CAMERAS = 60, 5000, 4
# Observations where a step is odd: a score grows with them, that of chance does not.
_ALL = 15_000
# What a score is at least where images change: sound drives show 14, others by their faults 36, which grows with the
# observations. And by how many times its mean the sum of losses is lower with the change.
_SCORE, _SURE = 45.0, 25.0
# A lower score tells of a change where the front-end's step to that keyframe is off by so many times what any other is,
# these by less than this part of a step.
_DOUBTED, _ODD, _SMALL = 15.0, 2.5, 0.25
# A step that jumps is off by more than this part of the usual step, so many keyframes around. The usual step is longer
# than this share of all; those much shorter tell nothing. Steps around one that it is as long as.
_JUMP, _NEAR, _LONG, _TELLING, _AROUND = 0.5, 15, 0.7, 0.3, 4
# A step of the front-end that is so many times as large as all others, and a turn so large (rad) or a move (m), is a
# jump of its own: images that change leave its steps as they are. A change is told so many keyframes beside it.
_TIMES, _LEAST_JUMP, _BESIDE = 3.0, (0.1, 0.1), 2
# Residuals between these, in units of the noise, may be of objects that move, which pull together: their share counts
# so many times.
_MOVING, _TOGETHER = (4.0, 15.0), 20.0
# The first keyframe of about the best score: where no track spans a change, it may lie between some.
_ABOUT = 0.99
# Where the usual residual is larger, in sigmas, something else is wrong.
_MOST_NOISE = 1.3
# Share of the residuals that the usual one is above, many being of mismatches; and that of two normal variables.
_LOW, _USUAL = 0.3, 0.8446


@dataclass(frozen=True)
class _Changed:
    """An adjustment with a change: what it is, where it ended, and the sizes of the residuals there, sigmas."""

    change: Change
    state: State
    norms: FloatArray

    @property
    def is_sure(self) -> bool:
        """Return True if the change is more than noise, and than is worth a word."""
        return bool((np.abs(self.change.value) > np.maximum(LEAST, ERRORS * self.change.error)).any())


def check_change(tracks: Tracks) -> Diagnosis:
    """Look for a keyframe from which on focal length or principal point are others."""
    outcome, n, n_cam = Diagnosis(), len(tracks), len(tracks.cameras.model)
    if n < _KEYFRAMES or n_cam > _MAX_CAMERAS:
        return outcome
    keyframes = np.arange(max(0, n - _NEWEST), n)
    for most in (_OBSERVATIONS, _ALL):
        outcome.findings, doubted = _changes(tracks, keyframes, most)
        if outcome.findings or not doubted:
            break
    return outcome


def _changes(tracks: Tracks, keyframes: IntArray, most: int) -> tuple[list[Finding], bool]:
    """Return what changes by about so many observations, and whether one step is so odd that more are worth a look."""
    problem, n_cam = problem_of_all(tracks, keyframes, most), len(tracks.cameras.model)
    if problem is None:
        return [], False
    given = Adjusted(problem, tracks.cameras.params)
    noise = float(np.quantile(given.norms, _LOW)) / _USUAL
    off = _off(given.state, tracks, keyframes)
    odd = int(np.argmax(off))
    others = float(np.delete(off, odd).max())
    doubted = _ODD * others < off[odd] and others < _SMALL
    if noise > _MOST_NOISE:
        return [], doubted
    off_by = given.norms / noise
    together = 1.0 + _TOGETHER * float(np.mean((off_by > _MOVING[0]) & (off_by < _MOVING[1])))
    noise *= math.sqrt(together)
    # The images of all cameras may change alike, or those of one.
    which = [tuple(range(n_cam)), *((camera,) for camera in range(n_cam if n_cam > 1 else 0))]
    with np.errstate(all="ignore"):
        problem = placed(dataclasses.replace(problem, start=given.state))
        scores = _scores(problem, which, noise)
        cameras, score = which[int(np.argmax(scores.max(axis=1)))], scores.max(axis=0)
        if score.max() > _SCORE * most / _OBSERVATIONS:
            k = int(np.argmax(score > _ABOUT * score.max()))
            found = _adjusted(problem, cameras, k, noise)
            jumps = _jumps(_off(found.state, tracks, keyframes), k)
            if found.is_sure and not jumps and _gain(found, given) > _SURE * together:
                change, at = found.change, int(keyframes[k])
                return [named(tracks, camera, at, change, np.zeros(3)) for camera in cameras], doubted
    passes = doubted and score.max() > _DOUBTED and abs(int(np.argmax(score)) - odd) <= 1
    if passes and not _stands_out(tracks, keyframes, odd):
        return [_unclear(tracks, int(keyframes[odd]), off[odd], others)], doubted
    return [], doubted


def _gain(found: _Changed, given: Adjusted) -> float:
    """Return by how many times its mean the sum of losses is lower with a change.

    The cameras as given are adjusted once more from where the change ended.
    """
    measure = Measure(given.norms)
    return len(measure) * (given.thorough(found.state, measure) / measure(found) - 1.0)


def _off(state: State, tracks: Tracks, keyframes: IntArray) -> FloatArray:
    """Return how far each keyframe is off where the front-end's step takes it from the one before, in steps.

    Steps are as long as those around them, one camera seeing no lengths; of the first it is 0. (n_kf,)
    """
    rotation, position = geometry.inverse(state.rotation, state.translation)
    n = len(keyframes)
    pairs = np.arange(n - 1), np.arange(1, n)
    _, ours = geometry.steps_between(rotation, position, *pairs)
    _, given = geometry.steps_between(tracks.rotation[keyframes], tracks.position[keyframes], *pairs)
    lengths = [np.linalg.norm(steps, axis=1) for steps in (ours, given)]
    usual = [max(float(np.quantile(of, _LONG)), 1e-9) for of in lengths]
    told = lengths[1] > _TELLING * usual[1]
    ratio = np.array([_usual(lengths, told, i) for i in range(n - 1)])
    ratio = np.where(np.isfinite(ratio), ratio, usual[0] / usual[1])
    # What a long step is off by is a part of its own length.
    length = np.maximum(usual[0], ratio * lengths[1])
    return np.append(0.0, np.linalg.norm(ours - ratio[:, None] * given, axis=1) / length)


def _stands_out(tracks: Tracks, keyframes: IntArray, k: int) -> bool:
    """Return True if a step of the front-end about the k-th keyframe is far longer than others, or turns far more."""
    pairs = keyframes[:-1], keyframes[1:]
    turns, moves = geometry.steps_between(tracks.rotation, tracks.position, *pairs)
    sizes = np.linalg.norm(geometry.so3_log(turns), axis=1), np.linalg.norm(moves, axis=1)
    near = slice(max(0, k - 1 - _BESIDE), k + _BESIDE)
    return any(
        bool(of[near].max() > max(_TIMES * float(np.delete(of, near).max(initial=0.0)), least))
        for of, least in zip(sizes, _LEAST_JUMP, strict=True)
    )


def _usual(lengths: list[FloatArray], told: BoolArray, i: int) -> float:
    near = slice(max(0, i - _AROUND), i + _AROUND + 1)
    ours, given = (of[near][told[near]] for of in lengths)
    return float(np.median(ours / given)) if len(given) else np.nan


def _jumps(off: FloatArray, k: int) -> bool:
    """Return True if the front-end's steps to keyframes near the k-th, but for its own, are far off."""
    near = slice(max(0, k - _NEAR), k + _NEAR + 1)
    return bool((np.delete(off, k)[near] > _JUMP).any())


def _unclear(tracks: Tracks, k: int, off: float, others: float) -> Finding:
    where = f"from stamp {tracks.stamp_ns[k] * 1e-9:.3f} s on"
    cause = f"images {where} are others, as where they are zoomed or another region of interest; what cannot be told"
    evidence = (
        f"the front-end's step to it is off by {100 * off:.0f} % of a step, others by at most {100 * others:.0f} %,"
        " and focal length or principal point that differ explain the tracks better"
    )
    return Finding((cause,), evidence, (ADVICE,), since_ns=int(tracks.stamp_ns[k]))


def _scores(problem: Problem, which: Sequence[tuple[int, ...]], noise: float) -> FloatArray:
    """Return what a change of some cameras from each keyframe on is worth, (n_which, n_kf); 0 at the ends."""
    n, n_cam, obs = problem.n_keyframes, len(problem.cameras.model), problem.observations
    each = _seen_by(problem, obs.camera * n + obs.keyframe, n)
    matrix, right = _linearised(each, bordered.Shared(tuple(_unknowns(range(n * n_cam))))).of_border()
    focal = np.repeat(problem.cameras.params[:, FX], 3 * n)
    v = (focal[:, None] * focal * matrix).reshape(n_cam, n, 3, n_cam, n, 3)
    r = (focal * right).reshape(n_cam, n, 3)
    scores = np.zeros((len(which), n))
    for row, cameras in zip(scores, which, strict=True):
        # Sums over cameras, and from each keyframe on.
        a = v[np.ix_(cameras, range(n), range(3), cameras, range(n), range(3))].sum(axis=(0, 3))
        a = np.flip(np.cumsum(np.cumsum(np.flip(a, (0, 2)), axis=0), axis=2), (0, 2))
        to = np.flip(np.cumsum(np.flip(r[list(cameras)].sum(axis=0), 0), axis=0), 0)
        for k in range(_ENDS, n - _ENDS):
            both = np.block([[a[0, :, 0], a[0, :, k]], [a[k, :, 0], a[k, :, k]]])
            inverse = np.linalg.pinv(both, hermitian=True)
            b = (inverse @ np.append(to[0], to[k]))[3:]
            row[k] = b @ np.linalg.pinv(inverse[3:, 3:], hermitian=True) @ b / noise**2
    return np.nan_to_num(scores)


def _adjusted(problem: Problem, cameras: tuple[int, ...], k: int, noise: float) -> _Changed:
    """Adjust with a change of some cameras from keyframe k on, beside a mistake of all their images."""
    obs, n_cam = problem.observations, len(problem.cameras.model)
    later = np.isin(obs.camera, cameras) & (obs.keyframe >= k)
    halves = _seen_by(problem, obs.camera + n_cam * later, 2, by_camera=False)
    focal = problem.cameras.params[list(cameras), FX]
    basis = np.kron(np.kron([[1.0, 0.0], [1.0, 1.0]], focal[:, None]), np.eye(3))
    unknowns = _unknowns([*cameras, *(n_cam + camera for camera in cameras)])
    shared = bordered.Shared(tuple(unknowns), np.asarray(basis, float))
    _, end = bordered.solve_shared(halves, shared, ALONG)
    state = State(end.rotation, end.translation, end.points, end.intrinsics)
    at = dataclasses.replace(halves, start=end, cameras=end.cameras)
    covariance = np.linalg.pinv(_linearised(at, shared).of_border()[0], hermitian=True)
    error = noise * np.sqrt(np.diagonal(covariance)[3:])
    before, after = end.cameras.params[cameras[0]], end.cameras.params[n_cam + cameras[0]]
    value = np.array([np.log(after[FX] / before[FX]), *(after[CX : CY + 1] - before[CX : CY + 1]) / focal[0]])
    return _Changed(Change(np.ones(2), value, error), state, native_kernels.residual_norms(at, state))


def _linearised(problem: Problem, shared: bordered.Shared) -> bordered.BorderedSystem:
    kernels = bordered.SharedKernels(problem, ALONG, shared)
    kernels.linearise(kernels.start)
    system = kernels.damp("diag", DAMPING)
    assert isinstance(system, bordered.BorderedSystem)
    return system


def _seen_by(problem: Problem, camera: IntArray, copies: int, *, by_camera: bool = True) -> Problem:
    """Return a problem with the camera (n_obs,) of each observation one of some copies; those of a camera in a row."""
    n = len(problem.cameras.model)
    rows = np.repeat(np.arange(n), copies) if by_camera else np.tile(np.arange(n), copies)
    rig = Cameras(**{name: of_each[rows] for name, of_each in vars(problem.cameras).items()})
    return dataclasses.replace(
        problem, cameras=rig, observations=dataclasses.replace(problem.observations, camera=camera)
    )


def _unknowns(cameras: Iterable[int]) -> list[bordered.Unknown]:
    """Return focal length and principal point of each of some cameras."""
    return [bordered.Unknown(camera, columns) for camera in cameras for columns in ((FX, FY), (CX,), (CY,))]
