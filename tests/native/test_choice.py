# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What takes part in a window, chosen by the C++ kernels and by numpy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node import native
from ba_node.arrays import take_rows
from ba_node.config import Config
from ba_node.core import geometry, native_kernels, triangulation
from ba_node.core.cameras import DISTORTION, Model
from ba_node.core.problem import Problem
from ba_node.measurements import FeatureTracks
from ba_node.scene import ingest, still_images
from ba_node.scene.scene import Scene
from ba_node.window import moving, odometry, steps, trial
from ba_node.window.initial_points import agreed_points
from ba_node.window.problems import Least, determined, part_of, problem_of, some_observations
from experiments.synthetic import SyntheticOptions, generate

pytestmark = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")

Find = Callable[[], Any]
Both = Callable[[Find], tuple[Any, Any]]


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Both:
    """Return what gives the results of a function with the C++ kernels and without."""

    def results(function: Find) -> tuple[Any, Any]:
        compiled = function()
        with monkeypatch.context() as without:
            without.setattr(native, "kernels", None)
            return compiled, function()

    return results


def window(depth_share: float = 0.3) -> Problem:
    """Return a problem of all that a short drive sees."""
    options = SyntheticOptions(seed=5, keyframes=10, tracks=60, length_m=12.0, depth_share=depth_share)
    scene = Scene(Config().scene)
    for _, _, measurement in generate(options).timeline():
        scene.add(measurement)
    landmarks = np.arange(len(scene.landmarks))
    positions = np.random.default_rng(4).normal(size=(len(landmarks), 3))
    return problem_of(
        scene, np.arange(len(scene.observations)), scene.order, landmarks, np.zeros(3), positions, Config()
    )[0]


@pytest.mark.parametrize("kind", ["straight", "distorted", "fisheye", "without depths"])
def test_rays_are_those_of_numpy(kind: str) -> None:
    problem = window(0.0 if kind == "without depths" else 0.3)
    cams = problem.cameras
    params = cams.params.copy()
    if kind in ("distorted", "fisheye"):
        params[0, DISTORTION] = [-0.05, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    model = np.array([Model.EQUIDISTANT, Model.RATIONAL], np.uint8) if kind == "fisheye" else cams.model
    uv = problem.observations.uv.copy()
    if kind != "straight":
        uv[::9] = 1e5  # where cameras with distortion see nothing
    problem = dataclasses.replace(
        problem,
        cameras=dataclasses.replace(cams, params=params, model=model),
        observations=dataclasses.replace(problem.observations, uv=uv),
    )
    compiled, plain = (triangulation.rays_of(problem, kernels) for kernels in ("native", "numpy"))
    assert (len(plain.point) < len(uv)) == (kind in ("distorted", "fisheye"))
    for field in dataclasses.fields(plain):
        np.testing.assert_allclose(
            getattr(compiled, field.name), getattr(plain, field.name), rtol=1e-13, atol=1e-14, err_msg=field.name
        )


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_what_determines_something_is_what_numpy_finds(depth_share: float, both: Both) -> None:
    problem, rng = window(depth_share), np.random.default_rng(6)
    usable = rng.random(len(problem.observations)) < 0.9
    moves = rng.random(problem.n_points) < 0.1
    problem.start.points[rng.random(problem.n_points) < 0.1] = np.nan
    n_kf = problem.n_keyframes
    least = Least(rng.integers(5, 30, n_kf), np.full(n_kf, 0.15))
    compiled, plain = both(lambda: determined(problem, usable, moves, 3 * problem.n_points // 4, least))
    assert 0 < np.count_nonzero(plain[1]) < n_kf, "some keyframes are left"
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_a_part_is_what_numpy_takes(depth_share: float, both: Both) -> None:
    problem = window(depth_share)
    points, keyframes = np.arange(problem.n_points) % 3 > 0, np.arange(problem.n_keyframes) % 4 > 0
    obs = problem.observations
    rows = np.flatnonzero(points[obs.point] & keyframes[obs.keyframe])
    compiled, plain = both(lambda: part_of(problem, rows, points, keyframes))
    for field in dataclasses.fields(plain.observations):
        a, b = (getattr(found.observations, field.name) for found in (compiled, plain))
        np.testing.assert_array_equal(a, b, err_msg=field.name)
        assert a.dtype == b.dtype, field.name


def test_what_moves_is_what_numpy_finds() -> None:
    problem, rng = window(), np.random.default_rng(7)
    norms = (
        np.abs(rng.normal(size=len(problem.observations)))
        * rng.choice([1.0, 4.0, 100.0], problem.n_points)[problem.observations.point]
    )
    norms[::11] = np.inf
    off = rng.uniform(1.0, 1.5, problem.n_keyframes)
    compiled, plain = (moving._leaves_more_than_noise(problem, norms, off, kernels) for kernels in ("native", "numpy"))
    assert 20 < np.count_nonzero(plain) < problem.n_points - 20
    np.testing.assert_array_equal(compiled, plain)


@pytest.mark.parametrize("factor", [0.1, 1.0])
def test_what_seems_to_move_is_what_numpy_finds(factor: float) -> None:
    """With keyframes that are off, of the window as a whole, or as noise has them."""
    problem, rng = window(), np.random.default_rng(10)
    obs, unrefined = problem.observations, np.arange(problem.n_keyframes) >= 7
    norms = np.abs(rng.normal(size=len(obs))) * rng.choice([1.0, 4.0], problem.n_points)[obs.point]
    norms *= 1.0 + factor * 10.0 * unrefined[obs.keyframe]
    norms[::13] = np.inf
    problem.start.points[::9] = np.nan
    compiled, plain = (moving._seem_to_move(problem, norms, unrefined, kernels) for kernels in ("native", "numpy"))
    assert len(np.unique(plain[0])) > 1, "keyframes are off apart"
    assert 0 < np.count_nonzero(plain[1]) < problem.n_points
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_residuals_of_some_are_those_of_all(depth_share: float) -> None:
    problem = window(depth_share)
    rows = np.random.default_rng(11).permutation(len(problem.observations))[:200]
    for kernels in ("native", "numpy"):
        every = native_kernels.residual_norms(problem, problem.start, kernels)
        some = native_kernels.residual_norms(problem, problem.start, kernels, rows)
        assert 20 < np.count_nonzero(np.isfinite(some)) < 180
        np.testing.assert_array_equal(some, every[rows])


def test_tracks_that_need_no_look_are_those_of_numpy(both: Both) -> None:
    good: dict[str, Any] = {
        "ids": np.array([3, 7, 2**64 - 1], np.uint64),
        "uv": np.array([[0.0, -1e6], [1e6, 5.0], [2.0, 3.0]]),
        "sigma": np.array([1e-6, 1.0, 1e6]),
        "depth": np.array([np.nan, 1e-3, 1e6]),
    }
    wrong: dict[str, list[Any]] = {
        "ids": [[7, 3, 9], [3, 3, 9], []],
        "uv": [[[0.0, 0.0], [0.0, np.nan], [0.0, 0.0]], [[0.0, -1.1e6], [0.0, 0.0], [0.0, 0.0]]],
        "sigma": [[0.0, 1.0, 1.0], [1.0, np.nan, 1.0], [1.0, 1.0, np.inf]],
        "depth": [[np.nan, 0.0, 1.0], [1.0, np.inf, 1.0]],
    }
    cases = [(good, True), (good | {"depth": np.full(3, np.nan)}, True)]
    cases += [(good | {name: np.array(v, good[name].dtype)}, False) for name, columns in wrong.items() for v in columns]
    compiled, plain = both(lambda: [ingest._nothing_to_check(**case) for case, _ in cases])
    assert compiled == plain == [expected for _, expected in cases]


@pytest.mark.parametrize("wanted", [0, 40, 10_000])
def test_tracks_to_try_are_those_of_numpy(wanted: int, both: Both) -> None:
    rng, n = np.random.default_rng(12), 300
    track_id = rng.permutation(np.iinfo(np.uint64).max - np.arange(n, dtype=np.uint64) * 12345)
    point = rng.integers(0, n, 1000)
    compiled, plain = both(lambda: trial.choose(track_id, point, wanted))
    assert (len(plain[0]) > 0) == (wanted > 0)
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a, b)


def test_rotations_have_the_bits_of_numpy(both: Both) -> None:
    q = np.random.default_rng(13).normal(size=(2000, 4)) * [1.0, 1.0, 1.0, 0.5]
    q[:3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, -1e-9], [0.0, 0.0, -3.0, 0.0]]
    compiled, plain = both(lambda: geometry.matrix_from_quaternion(q))
    np.testing.assert_array_equal(compiled, plain)
    compiled, plain = both(lambda: geometry.quaternion_from_matrix(plain.reshape(-1, 4, 3, 3)))
    np.testing.assert_array_equal(compiled, plain)
    assert geometry.quaternion_from_matrix(np.empty((0, 3, 3))).shape == (0, 4)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("distorted", [False, True])
def test_tracks_are_explained_as_numpy_does(cameras: int, distorted: bool) -> None:
    problem, rng = window(), np.random.default_rng(8)
    cams = problem.cameras
    params = cams.params.copy()
    if distorted:
        params[:, DISTORTION][:, 0] = -0.02
    cams = dataclasses.replace(cams, params=params)
    problem = dataclasses.replace(problem, cameras=take_rows(cams, slice(cameras)))
    obs = problem.observations
    problem = some_observations(problem, np.flatnonzero(obs.camera < cameras))
    tried = rng.permutation(np.flatnonzero(np.bincount(problem.observations.point) > 2))[:60]
    poses = problem.start.rotation, problem.start.translation
    off = poses[0], poses[1] + 0.02 * rng.normal(size=poses[1].shape)
    compiled, plain = (trial.explained(problem, (tried, 9), off, poses, kernels) for kernels in ("native", "numpy"))
    assert plain.mean.shape == (2, 1 + cameras)
    assert np.isfinite(plain.mean[:, 0]).all()
    assert abs(plain.mean[0, 0] - plain.mean[1, 0]) > 1e-3, "the poses differ"
    for field in dataclasses.fields(plain):
        np.testing.assert_allclose(
            getattr(compiled, field.name), getattr(plain, field.name), rtol=1e-7, err_msg=field.name
        )


@pytest.mark.parametrize("depth_share", [0.0, 0.3])
def test_places_that_views_agree_on_are_those_of_numpy(depth_share: float) -> None:
    problem, tracks = window(depth_share), Config().tracks
    compiled, plain = (agreed_points(problem, tracks, 30.0, kernels) for kernels in ("native", "numpy"))
    assert 20 < np.count_nonzero(plain.good) < problem.n_points - 5
    np.testing.assert_array_equal(compiled.good, plain.good)
    np.testing.assert_array_equal(compiled.measured[plain.good], plain.measured[plain.good])
    np.testing.assert_allclose(compiled.points[plain.good], plain.points[plain.good], rtol=1e-6)


@pytest.mark.parametrize("singular", [False, True])
def test_the_loosest_pose_is_that_of_numpy(singular: bool) -> None:
    rng = np.random.default_rng(9)
    root = rng.normal(size=(5, 6, 6)) * [1e3, 1e3, 1e3, 1.0, 1.0, 1.0]
    blocks, position = np.swapaxes(root, 1, 2) @ root, rng.normal(size=(5, 3)) * 10.0
    inverse = np.linalg.inv(blocks)
    moves = np.concatenate([geometry.hat(position), np.broadcast_to(-np.eye(3), (5, 3, 3))], axis=2)
    of_position = np.linalg.eigvalsh(moves @ inverse @ np.swapaxes(moves, 1, 2))[:, -1]
    of_rotation = np.linalg.eigvalsh(inverse[:, :3, :3])[:, -1]
    expected = (0.0, 0.0) if singular else np.sqrt([of_position.max(), of_rotation.max()])
    if singular:
        root[3, :, 2] = root[3, :, 4]
        blocks = np.swapaxes(root, 1, 2) @ root
    np.testing.assert_allclose(native.kernels.loosest(blocks, position, 1e11), expected, rtol=1e-6)


def test_what_cannot_be_worked_with_is_not_sound() -> None:
    problem = window()
    problem.start.points[:] = 1e300
    assert native.kernels.is_sound(problem)
    for place in ("observations", "start", "cameras"):
        record = getattr(problem, place)
        for field in ("keyframe", "camera", "point", "uv", "sigma_px", "rotation", "translation", "points", "params"):
            values = getattr(record, field, None)
            if values is None or (place, field) in (("cameras", "rotation"), ("cameras", "translation")):
                continue
            wrong = values.copy()
            wrong[len(wrong) // 2] = -1 if values.dtype.kind == "i" else np.nan
            changed = dataclasses.replace(problem, **{place: dataclasses.replace(record, **{field: wrong})})
            assert not native.kernels.is_sound(changed), f"{place}.{field}"


def test_a_single_wrong_number_is_found_wherever_it_stands() -> None:
    """Rows are looked at by eights: each place of the first and of what is left over at the end, and both limits."""
    problem = window()
    rows = problem.observations
    limits = {"keyframe": problem.n_keyframes, "camera": len(problem.cameras.model), "point": problem.n_points}
    wrong: dict[str, tuple[float, ...]] = {name: (-1, limit, -(2**63), 2**63 - 1) for name, limit in limits.items()}
    wrong |= {"uv": (np.nan, np.inf, -np.inf), "sigma_px": (np.nan, np.inf, -np.inf, 0.0, -1.0)}
    for name, values in wrong.items():
        for place in [*range(9), *range(-9, 0)]:
            for value in values:
                column = getattr(rows, name).copy()
                column[place] = value
                changed = dataclasses.replace(problem, observations=dataclasses.replace(rows, **{name: column}))
                assert not native.kernels.is_sound(changed), f"{name}[{place}] = {value}"
    unsorted = rows.point.copy()
    unsorted[-1] = unsorted[0]
    assert not native.kernels.is_sound(
        dataclasses.replace(problem, observations=dataclasses.replace(rows, point=unsorted))
    )


def turned_steps(off: float) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return poses of 30 keyframes that are ``off``, and as they turn and go."""
    rng = np.random.default_rng(8)
    turn = rng.normal(size=(30, 3)) * [0.02, 0.3, 0.02]
    move = np.array([2.0, 0.0, 0.0]) + rng.normal(size=(30, 3))
    other = turn * (1.0 + 4.0 * off) + off * rng.normal(size=turn.shape), move * (1.0 + off)
    measured, found = ((geometry.so3_exp(np.cumsum(a, axis=0)), np.cumsum(b, axis=0)) for a, b in ((turn, move), other))
    return found, measured


@pytest.mark.parametrize("off", [0.0, 1e-6, 0.01, 0.3])
def test_steps_are_compared_as_numpy_does(off: float, both: Both) -> None:
    found, measured = turned_steps(off)
    first, second = np.arange(0, 28, 2), np.arange(1, 29, 2)

    def compared() -> list[Any]:
        beside = steps.against(found, measured, first, second, Config().guard)
        ours, theirs = (steps.between(*poses, first, second) for poses in (found, measured))
        apart = steps.compare(ours, theirs, Config().guard)
        for one, other in ((beside.solved, ours), (beside.measured, theirs), (beside.off, apart)):
            for name, values in vars(one).items():
                np.testing.assert_array_equal(values, getattr(other, name), err_msg=name)
        return [*vars(ours).values(), *vars(apart).values(), beside.scale, beside.turn]

    compiled, plain = both(compared)
    assert (compiled[-2:] == [1.0, 1.0]) == (off < 0.3)
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=2e-8)


def test_fewer_steps_than_show_a_factor_show_none(both: Both) -> None:
    found, measured = turned_steps(0.3)
    few = np.arange(4)

    def error() -> float:
        return steps.against(found, measured, few, few + 1, Config().guard).scale

    assert both(error) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("tried", "rows", "track"),
    [
        ([6, 0, 9, 3], [10, 11, 12, 13, 14, 0, 1, 2, 4, 5, 6, 7], [0, 0, 0, 0, 0, 1, 1, 1, 3, 3, 3, 3]),
        ([10, 4, 5], [17, 18, 19, 8, 9], [0, 0, 0, 2, 2]),
        ([], [], []),
    ],
)
def test_views_of_tracks_are_those_that_numpy_finds(
    tried: list[int], rows: list[int], track: list[int], both: Both
) -> None:
    """Of points with and without views, in any order."""
    point = np.repeat(np.arange(12), [3, 0, 1, 4, 0, 2, 5, 1, 1, 0, 3, 0])
    for found in both(lambda: trial._views_of(np.array(tried, np.intp), point)):
        assert [one.tolist() for one in found] == [rows, track]


@pytest.mark.parametrize("rise", [True, False])
def test_what_two_images_share_is_what_numpy_finds(rise: bool, both: Both) -> None:
    """Of 200 ids each, some of whose pixels stay as they are, one coordinate of others; the largest id among them."""
    rng = np.random.default_rng(8)
    known = np.append(np.unique(rng.integers(0, 2**64 - 2, 300, dtype=np.uint64)), np.uint64(2**64 - 1))
    where = rng.uniform(0.0, 600.0, (len(known), 2))
    images = []
    for moved in (0.0, 1.0):
        rows = np.append(rng.choice(len(known) - 1, 199, replace=False), len(known) - 1)
        uv = where + moved * rng.integers(0, 2, where.shape)
        rows = np.sort(rows) if rise else rows
        images.append(FeatureTracks(0, 0, 0, known[rows], uv[rows]))
    compiled, plain = both(lambda: still_images._shared(*images))
    assert compiled == plain
    assert 100 < plain[0] < 200 and 10 < plain[1] < plain[0] - 10
    assert (
        native.kernels.shared_pixels(*zip(*((one.track_id, one.uv) for one in images), strict=True)) is None
    ) != rise


@pytest.mark.parametrize("n", [7, 8])
def test_steps_are_off_by_as_much_as_numpy_finds(n: int, both: Both) -> None:
    found, measured = turned_steps(0.01)
    rows, sigmas = np.arange(n), (np.full(n, 0.01), np.linspace(0.1, 0.2, n))

    def medians() -> Any:
        ours, theirs = (geometry.steps_between(*poses, rows, rows + 1) for poses in (found, measured))
        return odometry._medians_off(ours, theirs, sigmas)

    compiled, plain = both(medians)
    np.testing.assert_allclose(compiled, plain, rtol=1e-9)
    assert plain.min() > 0.01
