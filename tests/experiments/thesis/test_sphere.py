# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic sphere: it has the shape that section 5.1 of the thesis describes, and the solver comes back to it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import ConfigError, SolverOptions
from ba_node.core.geometry import so3_exp
from ba_node.core.objective import Objective, reprojection_errors
from ba_node.core.result import Status
from ba_node.core.solver import solve
from ba_node.io.bal import read_bal, to_problem
from ba_node.offline.solver_settings import solver_options
from experiments.thesis.final_state import truth_errors
from experiments.thesis.sphere import HALF_IMAGE_PX, SphereData, centres, generate_sphere
from experiments.thesis.sphere_file import start_of, truth_of, write_sphere
from experiments.thesis.sphere_options import PRESETS, PRINTED_OBSERVATIONS, SphereOptions, preset

SMALL = ("10-253", "10-289", "50-1000")


@pytest.fixture(scope="module", params=SMALL)
def sized(request: pytest.FixtureRequest) -> tuple[SphereOptions, SphereData]:
    options = PRESETS[request.param]
    return options, generate_sphere(options)


class TestShape:
    def test_counts_are_those_asked_for(self, sized: tuple[SphereOptions, SphereData]) -> None:
        options, data = sized
        assert (len(data.cameras), len(data.points)) == (options.images, options.points)
        printed = PRINTED_OBSERVATIONS[f"{options.images}-{options.points}"]
        assert len(data.uv) == pytest.approx(printed, rel=0.01), "all that is visible, as many as the thesis has"
        assert np.bincount(data.point_index).min() >= 2
        assert np.bincount(data.camera_index).min() >= options.min_image_points
        pairs = np.unique(data.point_index * options.images + data.camera_index)
        assert len(pairs) == len(data.uv), "a point is seen twice in one image"

    def test_points_lie_on_the_sphere_and_face_their_cameras(self, sized: tuple[SphereOptions, SphereData]) -> None:
        options, data = sized
        assert np.allclose(np.linalg.norm(data.points, axis=1), options.radius, rtol=1e-12)
        ray = centres(data.cameras)[data.camera_index] - data.points[data.point_index]
        assert np.sum(ray * data.points[data.point_index], axis=1).min() > 0.0

    def test_cameras_are_near_and_look_at_the_centre(self, sized: tuple[SphereOptions, SphereData]) -> None:
        options, data = sized
        centre = centres(data.cameras)
        away = np.linalg.norm(centre, axis=1) / options.radius
        assert options.near <= away.min() and away.max() <= options.far
        axis = -so3_exp(data.cameras[:, :3])[:, 2]
        angle = np.degrees(np.arccos(np.sum(-centre * axis, axis=1) / np.linalg.norm(centre, axis=1)))
        assert angle.max() <= min(options.tilt_deg, 30.0) + 1e-6, f"{angle.max():.2f} deg"

    def test_truth_leaves_only_noise_by_the_solvers_own_projection(
        self, sized: tuple[SphereOptions, SphereData]
    ) -> None:
        options, data = sized
        problem = to_problem(truth_of(data))
        error = reprojection_errors(problem, problem.start)
        assert np.isfinite(error).all(), "a point lies behind its camera"
        inlier = error[~data.outlier]
        sigma = float(np.sqrt(np.mean(inlier**2)))
        assert sigma == pytest.approx(options.noise_px, rel=0.1)
        assert int(data.outlier.sum()) == round(options.outlier_share * len(data.uv))
        if data.outlier.any():
            assert np.linalg.norm(error[data.outlier], axis=1).min() > 8.0
        ideal = data.uv[~data.outlier] + inlier * [1.0, -1.0]
        assert (np.abs(ideal) <= HALF_IMAGE_PX + 1e-6).all()

    def test_the_start_is_as_far_off_as_that_of_the_thesis(self, sized: tuple[SphereOptions, SphereData]) -> None:
        options, data = sized
        start, truth = to_problem(start_of(data)), to_problem(truth_of(data)).start
        errors = truth_errors(start.start, truth)
        cameras, points = {253: (None, None), 289: (75.57, 14.01), 1000: (44.14, 11.78)}[options.points]
        if cameras is None:
            assert Objective(start, SolverOptions()).value(start.start) == pytest.approx(2.44e5, rel=0.02)
        else:
            assert errors["rmse_cameras"] == pytest.approx(cameras, rel=0.01)
            assert errors["rmse_points"] == pytest.approx(points, rel=0.01)

    def test_neighbours_overlap_more_than_others(self, sized: tuple[SphereOptions, SphereData]) -> None:
        centre = centres(sized[1].cameras)
        beside = np.linalg.norm(np.diff(centre, axis=0), axis=1).mean()
        all_pairs = np.linalg.norm(centre[:, None] - centre[None], axis=2)
        assert beside < 0.75 * all_pairs[np.triu_indices(len(centre), 1)].mean()

    def test_the_start_is_wrong_everywhere_and_without_distortion(
        self, sized: tuple[SphereOptions, SphereData]
    ) -> None:
        _, data = sized
        assert (data.start_cameras[:, 7:] == 0.0).all()
        assert (data.start_cameras[:, :7] != data.cameras[:, :7]).all()
        assert (data.start_points != data.points).all()


def test_the_same_options_give_the_same_numbers_and_noise_moves_no_point() -> None:
    options = PRESETS["10-253"]
    first, again = generate_sphere(options), generate_sphere(options)
    for item in dataclasses.fields(SphereData):
        assert np.array_equal(getattr(first, item.name), getattr(again, item.name)), item.name
    louder = generate_sphere(dataclasses.replace(options, noise_px=2.0, outlier_share=0.1))
    assert np.array_equal(first.points, louder.points) and np.array_equal(first.point_index, louder.point_index)
    other = generate_sphere(dataclasses.replace(options, seed=1))
    assert not np.array_equal(first.points, other.points)


def test_a_wide_cone_is_sparser() -> None:
    def share(cone_deg: float) -> float:
        options = SphereOptions(images=40, points=300, cone_deg=cone_deg, min_image_points=10)
        return len(generate_sphere(options).uv) / (40 * 300)

    dense, sparse = share(10.0), share(120.0)
    assert sparse < 0.5 * dense, f"{sparse:.2f} of all pairs, {dense:.2f} in a narrow cone"


def test_files_hold_start_and_truth(tmp_path: Path) -> None:
    data = generate_sphere(PRESETS["10-253"])
    truth = write_sphere(tmp_path / "ball.txt", data)
    assert truth.name == "ball.truth.txt"
    start, right = read_bal(tmp_path / "ball.txt"), read_bal(truth)
    assert np.array_equal(start.cameras, data.start_cameras) and np.array_equal(right.cameras, data.cameras)
    assert np.array_equal(right.points, data.points) and np.array_equal(start.observations, right.observations)
    assert write_sphere(tmp_path / "ball.txt.gz", data).name == "ball.truth.txt.gz"


def test_dinm_falls_as_in_the_thesis() -> None:
    problem = to_problem(start_of(generate_sphere(PRESETS["10-253"])))
    result = solve(problem, solver_options("dinm", ["max_iterations=100"]))
    assert result.status in (Status.CONVERGED, Status.MAX_ITERATIONS, Status.STALLED)
    assert 5e4 < result.objective_before < 5e5, f"{result.objective_before:.3g} at the start"
    assert result.objective_after < 30.0, f"{result.objective_after:.3g} after {len(result.trace)} iterations"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"near": 3.0}, "near = 3 is above far = 2"),
        ({"observations": 300}, "253 points seen in two images each need 506"),
        ({"observations": 2500}, "are visible: lower it"),
        ({"min_image_area": 0.95}, "lower min_image_points"),
        ({"images": 1}, "expected a number in [2, 10000]"),
    ],
)
def test_impossible_wishes_are_refused(changes: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        generate_sphere(dataclasses.replace(PRESETS["10-253"], **changes))  # type: ignore[arg-type]
    assert words in str(refusal.value)


def test_an_unknown_preset_is_answered_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="choose one of 10-253, 10-289, 50-1000, 100-4000, 500-5000"):
        preset("7-7")


def test_the_command_makes_a_sphere_with_its_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, size = tmp_path / "ball.txt", ["--preset", "10-253"]
    assert main(["sphere", str(path), *size]) == 0
    assert "10 images, 253 points, 1334 observations, 0 of them outliers" in capsys.readouterr().out
    truth = (tmp_path / "ball.truth.txt").read_text().split()
    assert truth[:3] == ["10", "253", "1334"]
    first = path.read_bytes()
    assert main(["sphere", str(path), *size]) == 0
    assert path.read_bytes() == first
    assert main(["sphere", str(path), *size, "--outlier-share", "0.1", "--seed", "4"]) == 0
    found = re.findall(r"(\d+) observations, (\d+) of them outliers", capsys.readouterr().out)
    assert len(found) == 2 and int(found[1][1]) == round(0.1 * int(found[1][0])) > 100
    for wrong, words in ((["s.mcap"], "give a name that ends so"), (["s.txt", "--observations", "9"], "need 506")):
        assert main(["sphere", str(tmp_path / wrong[0]), *wrong[1:]]) == 2
        assert words in capsys.readouterr().err
