# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine what all keyframes share: intrinsics, places of the cameras on the body, and offsets of their clocks.

An outer Gauss-Newton method around the solver. At a solution of poses and points for given cameras the normal equations
are bordered by the columns K of the shared parameters q; with the points, and then the poses, eliminated a small system
is left::

    S_q = K' W K - ...,    (S_q + P) dq = -(g_q + P (q - q_0)),    P = diag(1 / sigma_0^2)

for priors sigma_0 about the given values q_0. Then poses and points are solved again for the cameras that this gives.

Only what is observable moves: in the directions of ``P^-1/2 S_q P^-1/2 = V diag(lambda) V'`` the data tell lambda times
as much as the priors, and those of less than 1 stay where they are. A parameter counts as told where the standard
deviation after it is less than a quarter of the prior's (lambda = :data:`LEAST_TOLD`).

Parameters of camera c, in their order:

- fx, cx, cy (px), and the first two coefficients of its distortion; fy, which follows fx but for what its pixels are
  not square, as it is hardly told where a body drives on a plane;
- its place on the body, as a local step of camera from body, rotation (rad) and translation (m), against the first
  camera. The place of the first one is held: no track sees where on the body a whole rig sits;
- its time offset (s): its images show what the body saw so much later than the stamp says, on the way that the
  keyframes before and after tell. That of the first camera shifts all; those of the others are against the first. The
  pixels are brought to the time of the stamp: ``u - (du/dt) offset`` with ``dX_body/dt = -(omega x X_body) - v``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import interpolate, sparse
from scipy.spatial import transform

from ba_node.arrays import FloatArray
from ba_node.config import CalibrationConfig, SolverOptions
from ba_node.core import covariance, geometry, parameterisation
from ba_node.core.objective import Objective
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.core.rows import GIVEN, Rows, joined, rows_of

# The data have to tell so many times as much as the prior.
LEAST_TOLD = 16.0
_ROUNDS = 12
# A step of less than this share of the priors' sigmas is none.
_SMALL = 2e-3
_NONE = 1e-9  # rounding
# No parameter steps by more than this many of the priors' sigmas at once.
_MOST = 2.0
# While the cameras are wrong the loss is as wide as this many times the median residual.
_WIDE = 3.0
_INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2")
_PLACE = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")
_TIME = "time_offset"
_STEP = 1e-6
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

    def lines(self) -> list[str]:
        """Return what was found, in words: of each camera what was refined, then what the data do not tell."""
        found = []
        for camera in range(len(self.time_offset)):
            own = [parameter for parameter in self.parameters if parameter.camera == camera]
            told = [one.text() for one in own if one.told]
            hardly = [one.text() for one in own if not one.told and one.change]
            untold = [one.name for one in own if not one.told and not one.change]
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


Solve = Callable[[Problem, SolverOptions], State]


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
    straight = (position[2:] - position[:-2]) / (stamp_s[2:] - stamp_s[:-2])[:, None]
    changes = float(np.sum(np.diff(velocity, axis=0) ** 2))
    doubt = np.sqrt(np.sum((velocity[1:-1] - straight) ** 2) / changes) if changes > 0.0 else 0.0
    return Motion((np.swapaxes(rotation, 1, 2) @ velocity[:, :, None])[..., 0], turn, float(doubt))


def calibrate(
    problem: Problem, stamp_s: FloatArray, options: SolverOptions, config: CalibrationConfig, solve: Solve
) -> tuple[Problem, State, Calibration]:
    """Refine the shared parameters of a problem, and its poses and points with them.

    ``stamp_s`` (n_kf,) are the stamps of its keyframes, ascending; ``solve`` solves for poses and points alone.

    Returns:
        The problem with the refined cameras and its pixels at the time of the stamps, its solution, and what was found.
    """
    found = Calibration(problem.cameras, np.zeros(len(problem.cameras.model)), parameters_of(problem, config))
    given, state = problem, solve(problem, _wide(problem, problem.start, options))
    for _ in range(_ROUNDS):
        problem = with_calibration(given, state, found, stamp_s)
        wide = _wide(problem, state, options)
        state = solve(dataclasses.replace(problem, start=state), wide)
        border = _Border(problem, state, wide, found, motion_of(state, stamp_s))
        step = border.step()
        found = _stepped(found, step)
        if np.abs(step).max(initial=0.0) < _SMALL:
            break
    problem = with_calibration(given, state, found, stamp_s)
    state = solve(dataclasses.replace(problem, start=state), options)
    border = _Border(problem, state, options, found, motion_of(state, stamp_s))
    return problem, state, dataclasses.replace(found, parameters=border.described())


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


def _in_body(d_point: FloatArray, state: State, obs: Observations) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives (n_obs, d, 3) by the points in the body, and these points (n_obs, 3), m."""
    rotation = state.rotation[obs.keyframe]
    points = (rotation @ state.points[obs.point][:, :, None])[..., 0] + state.translation[obs.keyframe]
    return d_point @ np.swapaxes(rotation, 1, 2), points


def _by_time(d_point: FloatArray, state: State, motion: Motion, obs: Observations) -> FloatArray:
    """Return the derivatives (n_obs, d) of residuals by the time at which the body sees the points."""
    by_body, points = _in_body(d_point, state, obs)
    moves = -np.cross(motion.turn[obs.keyframe], points) - motion.velocity[obs.keyframe]
    return np.asarray((by_body @ moves[:, :, None])[..., 0])


class _Border:
    """The equations at a solution, bordered by the shared parameters."""

    def __init__(
        self, problem: Problem, state: State, options: SolverOptions, found: Calibration, motion: Motion
    ) -> None:
        self._parameters, self._cameras = found.parameters, found.cameras
        self._squared = options.loss == "squared"
        self._prior = np.array([parameter.prior for parameter in found.parameters])
        self._change = np.array([parameter.change for parameter in found.parameters])
        self._n, self._doubt = 6 * int(np.count_nonzero(~problem.fixed)), motion.doubt
        with np.errstate(all="ignore"):
            self._rows = _with_columns(rows_of(problem, state, options), _columns(problem, state, found, motion))

    def step(self) -> FloatArray:
        """Return the step of the shared parameters in units of the priors' sigmas, (q,)."""
        rows, n = self._rows, self._n
        reduced = covariance.Reduced(rows, rows.weight)
        gradient = np.asarray(reduced.influence.T @ (rows.weight * rows.residual))
        s = reduced.s + 1e-12 * np.diag(np.diagonal(reduced.s))
        poses = np.linalg.solve(s[:n, :n], np.column_stack([s[:n, n:], gradient[:n]]))
        own = s[n:, n:] - s[n:, :n] @ poses[:, :-1]
        slope = gradient[n:] - s[n:, :n] @ poses[:, -1]
        values, vectors = np.linalg.eigh(own * self._prior[:, None] * self._prior)
        along = vectors.T @ (self._prior * slope + self._change / self._prior)
        step = vectors @ np.where(values > 1.0, -along / (1.0 + np.maximum(values, 0.0)), 0.0)
        step[np.abs(step) < _NONE] = 0.0
        return np.asarray(step * min(1.0, _MOST / max(float(np.abs(step).max(initial=0.0)), _NONE)))

    def described(self) -> tuple[Parameter, ...]:
        """Return the parameters with what is known of them."""
        rows, q = self._rows, len(self._prior)
        priors = Rows(
            self._change / self._prior,
            sparse.csr_matrix((1.0 / self._prior, (np.arange(q), self._n + np.arange(q))), (q, self._n + q)),
            sparse.csr_matrix((q, rows.points.shape[1])),
            np.ones(q),
            np.ones(q),
            np.full(q, GIVEN),
            np.arange(q),
        )
        conditions = np.empty((self._n + q, 0))
        found = covariance.uncertainty_of_rows(joined([rows, priors]), self._squared, conditions)
        if found is None:
            return self._parameters
        follow = self._following()
        sigma = np.sqrt(np.diagonal(follow @ found.of(self._n + np.arange(q)) @ follow.T))
        prior = np.sqrt(np.sum((follow * self._prior) ** 2, axis=1))
        # The clock of the first camera shows in how velocities change, that of another one in the velocities.
        shared = [parameter.name == _TIME and parameter.camera == 0 for parameter in self._parameters]
        sigma = np.hypot(sigma, np.where(shared, self._doubt * np.abs(self._change), 0.0))
        told = sigma * np.sqrt(1.0 + LEAST_TOLD) < prior
        rows_of_all = zip(self._parameters, prior, follow @ self._change, sigma, told, strict=True)
        return tuple(
            dataclasses.replace(one, prior=float(p), change=float(c), sigma=float(s), told=bool(t))
            for one, p, c, s, t in rows_of_all
        )

    def _following(self) -> FloatArray:
        """Return the matrix (q, q) by which fy follows fx."""
        follow = np.eye(len(self._parameters))
        for i, parameter in enumerate(self._parameters):
            if parameter.name == "fy":
                params = self._cameras.params[parameter.camera]
                follow[i, i - 1] = params[1] / params[0]
        return follow


def _with_columns(rows: Rows, columns: FloatArray) -> Rows:
    """Return rows with columns (n_obs rows that count, q) beside those of the poses; those of factors are 0."""
    beside = np.zeros((len(rows), columns.shape[1]))
    beside[: len(columns)] = columns
    return dataclasses.replace(rows, keyframes=sparse.hstack([rows.keyframes, sparse.csr_matrix(beside)], "csr"))


def _columns(problem: Problem, state: State, found: Calibration, motion: Motion) -> FloatArray:
    """Return the derivatives by the shared parameters, (m, q), of all rows of observations that count."""
    obs = problem.observations
    at = Objective(problem, SolverOptions(cheirality="constant")).linearise(state)
    by_body, points = _in_body(at.d_point, state, obs)
    by_place = np.concatenate([np.cross(points[:, None, :], by_body), by_body], axis=2)
    by_time = _by_time(at.d_point, state, motion, obs)
    by_time[:, 2:] = 0.0  # a depth is not moved to the time of the stamp
    out = np.zeros((*at.residual.shape, len(found.parameters)))
    for i, parameter in enumerate(found.parameters):
        of = obs.camera == parameter.camera
        if parameter.name in _INTRINSICS:
            out[of, :2, i] = _by_intrinsics(problem, state, parameter)[of]
        elif parameter.name == _TIME:
            of |= parameter.camera == 0
            out[of, :, i] = by_time[of]
        elif parameter.camera > 0:
            out[of, :, i] = by_place[of, :, _PLACE.index(parameter.name)]
    return out[np.any(at.d_point != 0.0, axis=2)]


def _by_intrinsics(problem: Problem, state: State, parameter: Parameter) -> FloatArray:
    """Return the derivatives (n_obs, 2) of whitened residuals by an intrinsic parameter, by central differences."""
    step = _STEP * parameter.prior
    errors = []
    for sign in (1.0, -1.0):
        params = problem.cameras.params.copy()
        _change_intrinsics(params[parameter.camera], parameter.name, sign * step)
        changed = dataclasses.replace(problem, cameras=dataclasses.replace(problem.cameras, params=params))
        errors.append(Objective(changed, SolverOptions()).errors(state))
    return np.nan_to_num((errors[0] - errors[1]) / (2.0 * step)) / problem.observations.sigma_px[:, None]


def _change_intrinsics(params: FloatArray, name: str, by: float) -> None:
    """Change a parameter of a camera (12,) in place; fy follows fx."""
    if name == "fx":
        params[1] *= 1.0 + by / params[0]
    params[_INTRINSICS.index(name)] += by


def _stepped(found: Calibration, step: FloatArray) -> Calibration:
    """Return a calibration after a step (q,) in units of the priors' sigmas."""
    cams, offset = found.cameras, found.time_offset.copy()
    params, place = cams.params.copy(), np.zeros((len(offset), 6))
    changed = []
    for parameter, size in zip(found.parameters, step, strict=True):
        by = parameter.prior * float(size)
        if parameter.name in _INTRINSICS:
            _change_intrinsics(params[parameter.camera], parameter.name, by)
        elif parameter.name == _TIME:
            offset[parameter.camera or slice(None)] += by
        else:
            place[parameter.camera, _PLACE.index(parameter.name)] += by
        changed.append(dataclasses.replace(parameter, change=parameter.change + by))
    rotation, translation = parameterisation.retract("local", cams.rotation, cams.translation, place)
    refined = dataclasses.replace(cams, params=params, rotation=rotation, translation=translation)
    return Calibration(refined, offset, tuple(changed))


def _wide(problem: Problem, state: State, options: SolverOptions) -> SolverOptions:
    """Return options whose loss is as wide as the residuals at a state need."""
    norm = np.linalg.norm(Objective(problem, options).errors(state), axis=1) / problem.observations.sigma_px
    median = float(np.nanmedian(norm)) if len(norm) else 0.0
    return dataclasses.replace(options, loss_scale_px=max(options.loss_scale_px, _WIDE * median))
