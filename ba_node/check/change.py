# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Ask of all images together whether the intrinsics of the only camera change on the way.

``onset.py`` compares an image with points that two before it place. A camera that looks sideways sees few points so
often, and takes another region of interest for a step, a zoom for points that are nearer. All images together know
better. Keyframes are adjusted with the camera as given; then each image k gets a focal length and a principal point of
its own, off the given ones by theta_k, in focal lengths. With poses and points eliminated (bordered.py) the normal
equations of these are ``V theta = r``. What one change from keyframe K on, beside a mistake of all images, would be
worth follows by sums::

    theta_k = a + b [k >= K]        [A_00 A_0K] [a]   [r_0]      A_JL = sum of V_kl over k >= J, l >= L
                                    [A_K0 A_KK] [b] = [r_K]      r_J  = sum of r_k over k >= J

``b' cov(b)^-1 b`` is a score, chi-square of three degrees of freedom where nothing changes (Rao, *Large sample tests of
statistical hypotheses concerning several parameters*, 1948), and one linearisation tells it of every K. The likeliest
is then adjusted in earnest, and the camera as given once more from where that ended: the change has to leave clearly
less. The front-end's poses are where all this begins, no more, so that jumps of theirs do not matter.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.check.adjusted import ALONG, DAMPING, Adjusted, Measure, placed, problem_of_all
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.onset import ERRORS, LEAST, Change, named
from ba_node.check.tracks import Tracks
from ba_node.core import bordered, native_kernels
from ba_node.core.cameras import CX, CY, FX, FY
from ba_node.core.problem import Cameras, Problem, State

# Keyframes that are needed, and those at either end at which no change is looked for.
_KEYFRAMES, _ENDS = 12, 3
_NEWEST, _OBSERVATIONS = 60, 5000
# What a score is at least where images change: sound drives show 12, mistakes of all images alike 36. And by how many
# times its mean the sum of losses is lower with the change.
_SCORE, _SURE = 45.0, 25.0
# The first keyframe of about the best score: where no track spans a change, it may lie between some.
_ABOUT = 0.99
# Where the usual residual is larger, in sigmas, something else is wrong.
_MOST_NOISE = 1.3
# Usual size of two normal variables, of standard deviation 1.
_USUAL = 1.1774


@dataclass(frozen=True)
class _Changed:
    """An adjustment with a change: what it is, where it ended, and the sizes of the residuals there, sigmas."""

    change: Change
    state: State
    norms: FloatArray


def check_change(tracks: Tracks) -> Diagnosis:
    """Look for a keyframe from which on focal length or principal point are others."""
    outcome, n = Diagnosis(), len(tracks)
    if n < _KEYFRAMES or len(tracks.cameras.model) != 1:
        return outcome
    keyframes = np.arange(max(0, n - _NEWEST), n)
    problem = problem_of_all(tracks, keyframes, _OBSERVATIONS)
    if problem is None:
        return outcome
    given = Adjusted(problem, tracks.cameras.params)
    noise = float(np.median(given.norms)) / _USUAL
    if noise > _MOST_NOISE:
        return outcome
    with np.errstate(all="ignore"):
        scores = _scores(placed(dataclasses.replace(problem, start=given.state)), noise)
        if not scores.max() > _SCORE:
            return outcome
        k = int(np.argmax(scores > _ABOUT * scores.max()))
        found = _adjusted(placed(dataclasses.replace(problem, start=given.state)), k, noise)
    change, measure = found.change, Measure(given.norms)
    if not (np.abs(change.value) > np.maximum(LEAST, ERRORS * change.error)).any():
        return outcome
    if len(measure) * (given.thorough(found.state, measure) / measure(found) - 1.0) > _SURE:
        outcome.findings.append(named(tracks, 0, int(keyframes[k]), change, np.zeros(3)))
    return outcome


def _scores(problem: Problem, noise: float) -> FloatArray:
    """Return what a change from each keyframe on is worth, (n_kf,); 0 at the ends."""
    n = problem.n_keyframes
    each = _seen_by(problem, problem.observations.keyframe, n)
    system = _linearised(each, bordered.Shared(tuple(_unknowns(n))))
    matrix, right = system.of_border()
    focal = problem.cameras.params[0, FX]
    v, r = focal**2 * matrix.reshape(n, 3, n, 3), focal * right.reshape(n, 3)
    # Sums from each keyframe on.
    a = np.flip(np.cumsum(np.cumsum(np.flip(v, (0, 2)), axis=0), axis=2), (0, 2))
    r = np.flip(np.cumsum(np.flip(r, 0), axis=0), 0)
    scores = np.zeros(n)
    for k in range(_ENDS, n - _ENDS):
        both = np.block([[a[0, :, 0], a[0, :, k]], [a[k, :, 0], a[k, :, k]]])
        covariance = noise**2 * np.linalg.pinv(both, hermitian=True)
        b = (covariance @ np.append(r[0], r[k]))[3:] / noise**2
        scores[k] = b @ np.linalg.solve(covariance[3:, 3:], b)
    return np.nan_to_num(scores)


def _adjusted(problem: Problem, k: int, noise: float) -> _Changed:
    """Adjust with a change from keyframe k on, beside a mistake of all images."""
    halves = _seen_by(problem, (problem.observations.keyframe >= k).astype(np.intp), 2)
    focal = problem.cameras.params[0, FX]
    shared = bordered.Shared(tuple(_unknowns(2)), focal * np.kron([[1.0, 0.0], [1.0, 1.0]], np.eye(3)))
    _, end = bordered.solve_shared(halves, shared, ALONG)
    state = State(end.rotation, end.translation, end.points, end.intrinsics)
    at = dataclasses.replace(halves, start=end, cameras=end.cameras)
    covariance = np.linalg.pinv(_linearised(at, shared).of_border()[0], hermitian=True)
    error = noise * np.sqrt(np.diagonal(covariance)[3:])
    before, after = end.cameras.params
    value = np.array([np.log(after[FX] / before[FX]), *(after[CX : CY + 1] - before[CX : CY + 1]) / focal])
    return _Changed(Change(np.ones(2), value, error), state, native_kernels.residual_norms(at, state))


def _linearised(problem: Problem, shared: bordered.Shared) -> bordered.BorderedSystem:
    kernels = bordered.SharedKernels(problem, ALONG, shared)
    kernels.linearise(kernels.start)
    system = kernels.damp("diag", DAMPING)
    assert isinstance(system, bordered.BorderedSystem)
    return system


def _seen_by(problem: Problem, camera: IntArray, n: int) -> Problem:
    """Return a problem with the camera (n_obs,) of each observation one of n copies of the only one."""
    rig = Cameras(**{name: np.repeat(of_one, n, axis=0) for name, of_one in vars(problem.cameras).items()})
    return dataclasses.replace(
        problem, cameras=rig, observations=dataclasses.replace(problem.observations, camera=camera)
    )


def _unknowns(n: int) -> list[bordered.Unknown]:
    """Return focal length and principal point of each of n cameras."""
    return [bordered.Unknown(camera, columns) for camera in range(n) for columns in ((FX, FY), (CX,), (CY,))]
