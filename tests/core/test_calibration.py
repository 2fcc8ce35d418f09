# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Shared parameters of cameras: derivatives, what is recovered, what is not told."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.arrays import FloatArray
from ba_node.config import CalibrationConfig
from ba_node.core import bordered, calibration, geometry, methods, parameterisation
from ba_node.core.calibration import Calibration
from ba_node.core.objective import Objective
from ba_node.core.problem import Cameras, Problem, State

MakeProblem = Callable[..., tuple[Problem, State]]
ALL = CalibrationConfig(intrinsics="refined", extrinsics="refined", time_offset="refined")
EXACT = dataclasses.replace(methods.options("auto"), cheirality="constant", function_tolerance=1e-12)


def smooth(make_problem: MakeProblem, **fields: object) -> tuple[Problem, State, FloatArray]:
    """Return a problem of keyframes on a smooth way, without noise, its true state and stamps (s)."""
    problem, truth = make_problem(keyframes=16, points=80, stereo=True, noise_px=0.0, start_error=0.0, **fields)
    stamp_s: FloatArray = np.linspace(0.0, 3.75, 16)
    wave = np.stack([np.sin(stamp_s), np.cos(0.7 * stamp_s), np.sin(1.3 * stamp_s)], axis=1)
    rotation = geometry.so3_exp(0.08 * wave)
    centre = np.stack([0.3 * np.arange(16), 0.3 * wave[:, 0], 0.3 * wave[:, 2]], axis=1)
    state = State(rotation, -(rotation @ centre[:, :, None])[..., 0], truth.points, truth.intrinsics)
    return seen(problem, state), state, stamp_s


def seen(problem: Problem, state: State) -> Problem:
    """Return a problem whose pixels are those of a state, where it begins."""
    obs = problem.observations
    errors = Objective(problem, EXACT).errors(state)
    front = ~np.isnan(errors[:, 0])
    columns = {f.name: getattr(obs, f.name) for f in dataclasses.fields(obs)}
    kept = {name: a[front] if len(a) else a for name, a in columns.items()}
    kept["uv"] = (obs.uv + errors)[front]
    return dataclasses.replace(problem, observations=dataclasses.replace(obs, **kept), start=state)


def test_derivatives_are_those_of_differences(make_problem: MakeProblem) -> None:
    problem, state, stamp_s = smooth(make_problem)
    found = Calibration(problem.cameras, np.zeros(2), calibration.parameters_of(problem, ALL))
    flow = calibration._flow(problem, state, calibration.motion_of(state, stamp_s))
    rows = calibration._with_columns(problem, state, EXACT, found, flow)
    got = rows.keyframes.toarray()[:, -len(found.parameters) :]
    unknowns = calibration._unknowns(found)
    for i, parameter in enumerate(found.parameters):
        residuals = []
        h = 1e-6 * parameter.prior
        for sign in (1.0, -1.0):
            theta = calibration._following(found)[:, i] * sign * h
            moved = bordered.moved_cameras(problem.cameras, unknowns, theta)
            refined = Calibration(moved, bordered.offsets(unknowns, theta, 2), found.parameters)
            posed = calibration.with_calibration(problem, state, refined, stamp_s)
            residuals.append(Objective(posed, EXACT).linearise(state).residual.ravel())
        expected = (residuals[0] - residuals[1]) / (2.0 * h)
        if parameter.camera == 0 and parameter.name in calibration._PLACE:
            assert not got[:, i].any(), "the place of the first camera is held"
            continue
        scale = np.abs(expected).max()
        assert np.abs(got[:, i] - expected).max() < 1e-4 * scale, parameter


def test_motion_is_that_of_a_known_way() -> None:
    stamp_s: FloatArray = np.linspace(0.0, 2.9, 30)
    turn = np.array([0.3, -0.2, 0.5])
    rotation = geometry.so3_exp(stamp_s[:, None] * turn)
    position = np.stack([np.sin(stamp_s), stamp_s**2, np.cos(stamp_s)], axis=1)
    body = geometry.inverse(rotation, position)
    found = calibration.motion_of(State(*body, np.empty((0, 3)), np.empty((0, 3))), stamp_s)
    velocity = np.stack([np.cos(stamp_s), 2.0 * stamp_s, -np.sin(stamp_s)], axis=1)
    back = (rotation @ found.velocity[:, :, None])[..., 0]
    np.testing.assert_allclose(found.turn[3:-3], np.tile(turn, (24, 1)), atol=1e-6)
    np.testing.assert_allclose(back[3:-3], velocity[3:-3], atol=2e-4)


def spoiled(cameras: Cameras) -> Cameras:
    """Return cameras with focal lengths 2 % off, and the second turned by 1 degree and 1 cm away."""
    params = cameras.params.copy()
    params[:, :2] *= 1.02
    step = np.zeros((2, 6))
    step[1] = [*(np.radians(1.0) / np.sqrt(3.0) * np.ones(3)), *(0.01 / np.sqrt(3.0) * np.ones(3))]
    rotation, translation = parameterisation.retract("local", cameras.rotation, cameras.translation, step)
    return dataclasses.replace(cameras, params=params, rotation=rotation, translation=translation)


@pytest.mark.slow
def test_what_is_wrong_is_recovered(make_problem: MakeProblem) -> None:
    problem, _, stamp_s = smooth(make_problem, distorted=False)
    rng = np.random.default_rng(3)
    obs = problem.observations
    noisy = dataclasses.replace(obs, uv=obs.uv + 0.3 * rng.normal(size=obs.uv.shape), sigma_px=np.full(len(obs), 0.3))
    given = dataclasses.replace(problem, observations=noisy, cameras=spoiled(problem.cameras))
    wanted = CalibrationConfig(intrinsics="refined", extrinsics="refined")
    _, _, found = calibration.calibrate(given, stamp_s, EXACT, wanted)
    true, got = problem.cameras, found.cameras
    assert np.abs(got.params[:, :2] / true.params[:, :2] - 1.0).max() < 0.004
    # Against the first camera, which is held; what is true has it in the same place.
    turn = geometry.so3_log(np.swapaxes(true.rotation, 1, 2) @ got.rotation)
    assert np.degrees(np.linalg.norm(turn, axis=1)).max() < 0.2
    # The length of the baseline is the scale of the map: no track tells it, but its direction.
    way, wanted_way = (cams.translation[1] / np.linalg.norm(cams.translation[1]) for cams in (got, true))
    assert np.arccos(way @ wanted_way) < 0.025
    told = {(parameter.camera, parameter.name) for parameter in found.parameters if parameter.told}
    assert {(0, "fx"), (1, "fx"), (1, "rotation_x")} <= told
    assert not any(camera == 0 and name in calibration._PLACE for camera, name in told)


def test_what_nothing_tells_stays(make_problem: MakeProblem) -> None:
    """One camera and no steps of a front-end: neither its place on the body nor its clock shows in the tracks."""
    problem, truth = make_problem(keyframes=8, noise_px=0.3, fixed=1, points=60)
    stamp_s: FloatArray = np.linspace(0.0, 1.75, 8)
    wanted = CalibrationConfig(extrinsics="refined", time_offset="refined")
    fixed = dataclasses.replace(problem, fixed=np.arange(8) < 2, start=truth)
    _, _, found = calibration.calibrate(fixed, stamp_s, EXACT, wanted)
    place = [parameter for parameter in found.parameters if parameter.name in calibration._PLACE]
    assert [parameter.told for parameter in place] == [False] * 6
    assert np.array_equal(found.cameras.rotation, problem.cameras.rotation)
    assert "not told by the data, left as given: rotation_x" in found.lines()[0]


def test_a_late_second_camera_is_found(make_problem: MakeProblem) -> None:
    problem, state, stamp_s = smooth(make_problem)
    late = Calibration(problem.cameras, np.array([0.0, 0.02]), ())
    # Pixels that were taken 20 ms after the stamp: moving them back gives those of the state.
    there = calibration.with_calibration(
        problem, state, dataclasses.replace(late, time_offset=-late.time_offset), stamp_s
    )
    given = dataclasses.replace(there, start=state)
    _, _, found = calibration.calibrate(given, stamp_s, EXACT, CalibrationConfig(time_offset="refined"))
    assert found.time_offset[1] - found.time_offset[0] == pytest.approx(0.02, abs=0.001)


@pytest.mark.slow
def test_sound_cameras_stay_within_what_is_told(make_problem: MakeProblem) -> None:
    problem, _, stamp_s = smooth(make_problem)
    rng = np.random.default_rng(5)
    obs = problem.observations
    noisy = dataclasses.replace(obs, uv=obs.uv + rng.normal(size=obs.uv.shape) * obs.sigma_px[:, None])
    given = dataclasses.replace(problem, observations=noisy)
    wanted = CalibrationConfig(intrinsics="refined")
    _, _, found = calibration.calibrate(given, stamp_s, EXACT, wanted)
    sigmas = np.array([parameter.change / parameter.sigma for parameter in found.parameters if parameter.told])
    assert len(sigmas) >= 8 and np.abs(sigmas).max() < 4.0 and np.mean(sigmas**2) < 2.5


def test_what_moved_by_rounding_alone_is_left_as_given() -> None:
    nothing = np.empty((0, 3, 3))
    cameras = Cameras(nothing, nothing[:, 0], np.empty(0, np.uint8), np.empty((0, 12)))
    moved, given = (calibration.Parameter(0, name, "s", 0.05, by, 0.05) for name, by in (("a", 1e-6), ("b", 2e-16)))
    found = calibration.Calibration(cameras, np.zeros(1), (moved, given))
    assert found.lines() == [
        "hardly told by the data: a +1e-06 +- 0.05 s; not told by the data, left as given: b",
    ]
