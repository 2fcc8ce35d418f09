# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine what all keyframes share: intrinsics, places of the cameras on the body, and offsets of their clocks.

Poses, points and the shared parameters q are solved together (``bordered.py``), with priors sigma_0 about the given
values. With poses and points eliminated at a solution, ``S_q`` is what the data tell of q. Only what is observable
moves: in the directions of ``P^-1/2 S_q P^-1/2 = V diag(lambda) V'``, P = diag(1 / sigma_0^2), the data tell lambda
times as much as the priors; those of more than 1 are the basis in which q moves, the others stay where they are. A
parameter counts as told where the standard deviation after it is less than a quarter of the prior's (lambda =
:data:`LEAST_TOLD`). This is repeated, as the way and the loss depend on the solution.

Parameters of camera c, in their order:

- fx, cx, cy (px), and the first two coefficients of its distortion; fy, which follows fx but for what its pixels are
  not square, as it is hardly told where a body drives on a plane;
- its place on the body, as a local step of camera from body, rotation (rad) and translation (m), against the first
  camera. The place of the first one is held: no track sees where on the body a whole rig sits;
- its time offset (s): its images show what the body saw so much later than the stamp says, on the way that the
  keyframes before and after tell. That of the first camera shifts all, and is held where the way is too rough for the
  keyframes to tell how velocities change (:func:`_roughness`); those of the others are against the first. The
  pixels are brought to the time of the stamp: ``u - (du/dt) offset`` with ``dX_body/dt = -(omega x X_body) - v``.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import interpolate, sparse
from scipy.spatial import transform

from ba_node.arrays import FloatArray
from ba_node.config import CalibrationConfig, SolverOptions
from ba_node.core import bordered, covariance, geometry, point_priors, solver
from ba_node.core.objective import Objective
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.core.rows import GIVEN, Rows, joined, rows_of

# The data have to tell so many times as much as the prior.
LEAST_TOLD = 16.0
_ROUNDS, _ITERATIONS = 12, 20
# A change of less than this share of the priors' sigmas is none.
_SMALL = 2e-3
# While the cameras are wrong the loss is as wide as this many times the median residual.
_WIDE = 3.0
_INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2")
_PLACE = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")
_TIME = "time_offset"
# Changes that are rounding alone, in any of the units.
_ROUNDING = 1e-12
_COLUMNS = dict(zip((*_INTRINSICS, *_PLACE, _TIME), (*range(6), *bordered.PLACE, bordered.TIME), strict=True))
# The clock of the first camera shows in how velocities change: held where these may be wrong by more than this share.
_ROUGH = 0.15
# Standard deviation of fy / fx, which is that of the pixels.
_NOT_SQUARE = 0.003


@dataclass(frozen=True)
class Parameter:
    """One shared parameter and what became of it."""

    camera: int
    name: str  # as above
    unit: str
    prior: float  # standard deviation before
    change: float = 0.0  # from the given value
    sigma: float = np.nan  # standard deviation after; NaN where nothing is known
    told: bool = False  # the data tell it

    def text(self) -> str:
        """Return its change and standard deviation in words."""
        return f"{self.name} {self.change:+.4g} +- {self.sigma:.2g}{' ' * bool(self.unit)}{self.unit}"


@dataclass(frozen=True)
class Calibration:
    """Refined cameras."""

    cameras: Cameras
    time_offset: FloatArray  # (n_cam,) s
    parameters: tuple[Parameter, ...]
    clock_held: bool = False  # the way is too rough to tell how late the images of the first camera are

    def lines(self) -> list[str]:
        """Return what was found, in words: of each camera what was refined, then what the data do not tell."""
        found = []
        for camera in range(len(self.time_offset)):
            own = [parameter for parameter in self.parameters if parameter.camera == camera]
            told = [one.text() for one in own if one.told]
            hardly = [one.text() for one in own if not one.told and abs(one.change) > _ROUNDING]
            untold = [one.name for one in own if not one.told and abs(one.change) <= _ROUNDING]
            parts = [", ".join(told)] if told else []
            parts += [f"hardly told by the data: {', '.join(hardly)}"] if hardly else []
            parts += [f"not told by the data, left as given: {', '.join(untold)}"] if untold else []
            found += ["; ".join(parts)] if own else []
        return found

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return the parameters for a JSON file; sigma is None where nothing is known."""
        rows = [dataclasses.asdict(one) for one in self.parameters]
        return [row | {"sigma": row["sigma"] if np.isfinite(row["sigma"]) else None} for row in rows]

    def since(self, given: Cameras) -> Calibration:
        """Return the same with the changes from cameras that were given some rounds ago."""
        back = np.swapaxes(given.rotation, 1, 2)
        turn = geometry.so3_log(back @ self.cameras.rotation)
        moved = (back @ (self.cameras.translation - given.translation)[:, :, None])[..., 0]
        place, params = np.concatenate([turn, moved], axis=1), self.cameras.params - given.params
        changes = [
            params[one.camera, _INTRINSICS.index(one.name)]
            if one.name in _INTRINSICS
            else place[one.camera, _PLACE.index(one.name)]
            if one.name in _PLACE
            else one.change
            for one in self.parameters
        ]
        pairs = zip(self.parameters, changes, strict=True)
        parameters = tuple(dataclasses.replace(one, change=float(change)) for one, change in pairs)
        return dataclasses.replace(self, parameters=parameters)


@dataclass(frozen=True)
class Motion:
    """How the body moves at each keyframe."""

    velocity: FloatArray  # (n_kf, 3) along its own axes, m/s
    turn: FloatArray  # (n_kf, 3) angular velocity along its own axes, rad/s
    # by what share of how they change from keyframe to keyframe the velocities may be wrong: keyframes do not tell what
    # the body does between them
    doubt: float = 0.0


def parameters_of(problem: Problem, config: CalibrationConfig) -> tuple[Parameter, ...]:
    """Return the shared parameters that are to be refined."""
    found = []
    for camera in range(len(problem.cameras.model)):
        focal = float(problem.cameras.params[camera, 0])
        if config.intrinsics == "refined":
            share = config.intrinsics_sigma
            priors = np.array([share, _NOT_SQUARE, share, share]) * focal
            found += [
                Parameter(camera, name, "px", prior) for name, prior in zip(_INTRINSICS, priors.tolist(), strict=False)
            ]
            found += [Parameter(camera, name, "", config.distortion_sigma) for name in _INTRINSICS[4:]]
        if config.extrinsics == "refined":
            found += [Parameter(camera, name, "rad", config.rotation_sigma_rad) for name in _PLACE[:3]]
            found += [Parameter(camera, name, "m", config.position_sigma_m) for name in _PLACE[3:]]
        if config.time_offset == "refined":
            found.append(Parameter(camera, _TIME, "s", config.time_sigma_s))
    return tuple(found)


def motion_of(state: State, stamp_s: FloatArray) -> Motion:
    """Return the motion at each keyframe, by cubic splines through all of them; stamps are (n_kf,), ascending.

    Differences of neighbours would tell too small a velocity where it changes from keyframe to keyframe. At rest where
    two keyframes have one stamp, or there are fewer than three.
    """
    rotation, position = geometry.inverse(state.rotation, state.translation)
    if len(stamp_s) < 3 or np.diff(stamp_s).min() <= 0.0:
        return Motion(np.zeros_like(position), np.zeros_like(position))
    velocity = interpolate.CubicSpline(stamp_s, position)(stamp_s, 1)
    turn = transform.RotationSpline(stamp_s, transform.Rotation.from_matrix(rotation))(stamp_s, 1)
    own = (np.swapaxes(rotation, 1, 2) @ velocity[:, :, None])[..., 0]
    return Motion(own, turn, max(_roughness(own), _roughness(turn)))


def _roughness(velocity: FloatArray) -> float:
    """Return by what share a velocity (n_kf, 3) may be wrong where it changes: 1/4 |second|^2 / |first differences|^2.

    0 where changes go on from keyframe to keyframe; 1/2 for one from a keyframe to the next, of which a spline through
    the keyframes sees half; 3/4 for noise.
    """
    first = float(np.sum(np.diff(velocity, axis=0) ** 2))
    return 0.25 * float(np.sum(np.diff(velocity, n=2, axis=0) ** 2)) / first if first > 0.0 else 0.0


def calibrate(
    problem: Problem, stamp_s: FloatArray, options: SolverOptions, config: CalibrationConfig
) -> tuple[Problem, State, Calibration]:
    """Refine the shared parameters of a problem, and its poses and points with them.

    ``stamp_s`` (n_kf,) are the stamps of its keyframes, ascending.

    Returns:
        The problem with the refined cameras and its pixels at the time of the stamps, its solution, and what was found.
    """
    given, state = problem, _solved(problem, problem.start, _wide(problem, problem.start, options))
    rough = motion_of(state, stamp_s).doubt > _ROUGH
    found = Calibration(problem.cameras, np.zeros(len(problem.cameras.model)), parameters_of(problem, config), rough)
    for _ in range(_ROUNDS):
        before = found
        state, found = _round(given, state, found, stamp_s, options)
        pairs = zip(before.parameters, found.parameters, strict=True)
        if max((abs(now.change - then.change) / now.prior for then, now in pairs), default=0.0) < _SMALL:
            break
    problem = with_calibration(given, state, found, stamp_s)
    state = _solved(problem, state, options)
    parameters = _described(problem, state, options, found, motion_of(state, stamp_s))
    return problem, state, dataclasses.replace(found, parameters=parameters)


def _solved(problem: Problem, start: State, options: SolverOptions) -> State:
    """Return the solution for given cameras."""
    result = solver.solve(dataclasses.replace(problem, start=start), options)
    return result.state if result.status.usable and result.state.is_finite() else start


def _round(
    given: Problem, state: State, found: Calibration, stamp_s: FloatArray, options: SolverOptions
) -> tuple[State, Calibration]:
    """Solve for poses, points and what can be observed of the parameters, with the way and the loss of a state."""
    problem = with_calibration(given, state, found, stamp_s)
    chosen = dataclasses.replace(
        _wide(problem, state, options), trust_region="none", schur="points", annealing="none", kernels="numpy"
    )
    chosen = dataclasses.replace(chosen, linear_solver="auto", max_iterations=_ITERATIONS)
    problem, motion = dataclasses.replace(problem, start=state), motion_of(state, stamp_s)
    if problem.point_priors is not None:
        problem = point_priors.as_observations(problem)
        beside = ((0, problem.n_keyframes - given.n_keyframes), (0, 0))
        motion = Motion(np.pad(motion.velocity, beside), np.pad(motion.turn, beside))
    shared = bordered.Shared(_unknowns(found), flow=_flow(problem, problem.start, motion))
    prior = np.array([parameter.prior for parameter in found.parameters])
    moves = _following(found) * prior
    with np.errstate(all="ignore"):
        kernels = bordered.SharedKernels(problem, chosen, dataclasses.replace(shared, basis=_held(found, moves)))
        kernels.linearise(kernels.start)
        system = kernels.damp("none", 0.0)
        assert isinstance(system, bordered.BorderedSystem)
        values, vectors = np.linalg.eigh(system.of_border()[0])
    told = vectors[:, values > 1.0]
    if not told.shape[1]:
        return state, found
    change = np.array([parameter.change for parameter in found.parameters]) / prior
    shared = dataclasses.replace(shared, basis=_held(found, moves) @ told, prior=told.T @ change)
    result, end = bordered.solve_shared(problem, shared, chosen)
    if not (result.status.usable and end.is_finite()):
        return state, found
    step = told @ end.z
    parameters = tuple(
        dataclasses.replace(one, change=one.change + float(by))
        for one, by in zip(found.parameters, prior * step, strict=True)
    )
    n = len(given.cameras.model)
    late = found.time_offset + bordered.offsets(shared.unknowns, moves @ step, n)
    refined = Cameras(*(values[:n] for values in vars(end.cameras).values()))
    return point_priors.without(end, given), Calibration(refined, late, parameters, found.clock_held)


def _unknowns(found: Calibration) -> tuple[bordered.Unknown, ...]:
    return tuple(bordered.Unknown(one.camera, (_COLUMNS[one.name],)) for one in found.parameters)


def _held(found: Calibration, moves: FloatArray) -> FloatArray:
    """Return how the numbers of the cameras move (q, q), without the place of the first one, nor its clock if held."""
    names = (*_PLACE, _TIME) if found.clock_held else _PLACE
    held = [one.camera == 0 and one.name in names for one in found.parameters]
    return np.where(np.array(held, bool)[:, None], 0.0, moves)


def with_calibration(given: Problem, state: State, found: Calibration, stamp_s: FloatArray) -> Problem:
    """Return the given problem with refined cameras, and the pixels moved to the time of the stamps at a state."""
    posed = dataclasses.replace(given, cameras=found.cameras)
    if not found.time_offset.any():
        return posed
    obs = given.observations
    flow = _flow(posed, state, motion_of(state, stamp_s))
    moved = obs.uv - flow * found.time_offset[obs.camera, None]
    return dataclasses.replace(posed, observations=dataclasses.replace(obs, uv=moved))


def _flow(problem: Problem, state: State, motion: Motion) -> FloatArray:
    """Return how the pixels move, (n_obs, 2) px/s; 0 behind a camera."""
    obs = problem.observations
    at = Objective(problem, SolverOptions(cheirality="constant")).linearise(state)
    return np.asarray(_by_time(at.d_point, state, motion, obs)[:, :2] * obs.sigma_px[:, None])


def _by_time(d_point: FloatArray, state: State, motion: Motion, obs: Observations) -> FloatArray:
    """Return the derivatives (n_obs, d) of residuals by the time at which the body sees the points."""
    rotation = state.rotation[obs.keyframe]
    points = (rotation @ state.points[obs.point][:, :, None])[..., 0] + state.translation[obs.keyframe]
    moves = -np.cross(motion.turn[obs.keyframe], points) - motion.velocity[obs.keyframe]
    return np.asarray((d_point @ np.swapaxes(rotation, 1, 2) @ moves[:, :, None])[..., 0])


def _described(
    problem: Problem, state: State, options: SolverOptions, found: Calibration, motion: Motion
) -> tuple[Parameter, ...]:
    """Return the parameters with what is known of them at a solution."""
    prior = np.array([parameter.prior for parameter in found.parameters])
    change = np.array([parameter.change for parameter in found.parameters])
    n, q = 6 * int(np.count_nonzero(~problem.fixed)), len(prior)
    follow = _following(found)
    with np.errstate(all="ignore"):
        rows = _with_columns(problem, state, options, found, _flow(problem, state, motion))
        priors = Rows(
            change / prior,
            sparse.csr_matrix((1.0 / prior, (np.arange(q), n + np.arange(q))), (q, n + q)),
            sparse.csr_matrix((q, rows.points.shape[1])),
            np.ones(q),
            np.ones(q),
            np.full(q, GIVEN),
            np.arange(q),
        )
        told_by = covariance.uncertainty_of_rows(
            joined([rows, priors]), options.loss == "squared", np.empty((n + q, 0))
        )
    if told_by is None:
        return found.parameters
    sigma = np.sqrt(np.diagonal(follow @ told_by.of(n + np.arange(q)) @ follow.T))
    prior = np.sqrt(np.sum((follow * prior) ** 2, axis=1))
    # The clock of the first camera shows in how velocities change, that of another one in the velocities.
    of_all = [parameter.name == _TIME and parameter.camera == 0 for parameter in found.parameters]
    sigma = np.hypot(sigma, np.where(of_all, motion.doubt * np.abs(change), 0.0))
    told = sigma * np.sqrt(1.0 + LEAST_TOLD) < prior
    rows_of_all = zip(found.parameters, prior, follow @ change, sigma, told, strict=True)
    return tuple(
        dataclasses.replace(one, prior=float(p), change=float(c), sigma=float(s), told=bool(t))
        for one, p, c, s, t in rows_of_all
    )


def _following(found: Calibration) -> FloatArray:
    """Return the matrix (q, q) by which fy follows fx."""
    follow = np.eye(len(found.parameters))
    for i, parameter in enumerate(found.parameters):
        if parameter.name == "fy":
            params = found.cameras.params[parameter.camera]
            follow[i, i - 1] = params[1] / params[0]
    return follow


def _with_columns(problem: Problem, state: State, options: SolverOptions, found: Calibration, flow: FloatArray) -> Rows:
    """Return the rows of a problem at a state, with columns of the parameters beside those of the poses."""
    rows = rows_of(problem, state, options)
    plain = Objective(problem, SolverOptions(cheirality="constant"))
    counts = np.any(plain.linearise(state).d_point != 0.0, axis=2).ravel()
    by_theta = bordered.shared_jacobian(plain, state, bordered.Shared(_unknowns(found), flow=flow))[counts]
    beside = sparse.csr_matrix(by_theta @ _held(found, _following(found)))
    beside.resize(len(rows), len(found.parameters))
    return dataclasses.replace(rows, keyframes=sparse.hstack([rows.keyframes, beside], "csr"))


def _wide(problem: Problem, state: State, options: SolverOptions) -> SolverOptions:
    """Return options whose loss is as wide as the residuals at a state need."""
    norm = np.linalg.norm(Objective(problem, options).errors(state), axis=1) / problem.observations.sigma_px
    median = float(np.nanmedian(norm)) if len(norm) else 0.0
    return dataclasses.replace(options, loss_scale_px=max(options.loss_scale_px, _WIDE * median))
