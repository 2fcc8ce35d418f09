# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import ConfigError, SolverOptions
from ba_node.core import methods
from ba_node.core.problem import Problem
from ba_node.core.result import Result
from ba_node.core.solver import solve
from ba_node.io.bal import BalProblem, behind, read_bal, translated, write_bal
from ba_node.offline import solve_bal
from ba_node.offline.solver_settings import option_names, solver_options

ROW = {
    "iteration",
    "time_s",
    "objective",
    "gradient_norm",
    "linear_iterations",
    "accepted",
    "damping",
    "radius",
    "side",
}


def test_solve_writes_trace_and_problem(bal_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trace, refined = tmp_path / "t.json", tmp_path / "refined.txt"
    # The optimum is exact, hence an objective at rounding; the gradient tolerance ends it.
    assert main(["solve", str(bal_file), "--iterations", "40", "--json", str(trace), "--out", str(refined)]) == 0
    report = json.loads(trace.read_text())
    rows = report["trace"]
    assert set(rows[0]) == ROW
    assert [row["iteration"] for row in rows] == list(range(len(rows)))
    assert rows[0]["objective"] == report["objective_before"] > 100.0
    assert report["objective_after"] < 1e-6 * report["objective_before"]
    assert all(b["objective"] <= a["objective"] for a, b in itertools.pairwise(rows))
    assert report["problem"] == {"file": "four.txt", "cameras": 4, "points": 30, "observations": 120}
    assert report["method"] == "local_irls"
    assert report["options"]["max_iterations"] == 40
    assert report["setup_s"] > 0.0
    assert report["peak_rss_mb"] > 10.0
    assert report["status"] in ("CONVERGED", "MAX_ITERATIONS", "STALLED")
    assert report["reason"]
    again = main(["solve", str(refined), "--iterations", "1", "--json", str(trace)])
    assert again == 0
    assert json.loads(trace.read_text())["objective_before"] == pytest.approx(
        report["objective_after"], rel=1e-3, abs=1e-9
    )
    assert "objective" in capsys.readouterr().out


def test_infinite_radius_is_null(bal_file: Path, tmp_path: Path) -> None:
    trace = tmp_path / "t.json"
    settings = ["--set", "trust_region=none", "--set", "damping=diag"]
    assert main(["solve", str(bal_file), *settings, "--iterations", "2", "--json", str(trace)]) == 0
    text = trace.read_text()
    assert "Infinity" not in text
    assert json.loads(text)["trace"][0]["radius"] is None


def test_observations_are_kept_in_the_refined_file(bal_file: Path, tmp_path: Path) -> None:
    refined = tmp_path / "r.bz2"
    assert main(["solve", str(bal_file), "--iterations", "2", "--out", str(refined)]) == 0
    np.testing.assert_array_equal(read_bal(refined).observations, read_bal(bal_file).observations)


def test_settings_by_bare_name_and_by_parameter() -> None:
    options = solver_options("local_dinm", ["loss=huber", "solver.loss_scale_px=2", "damping=diag", "t_eps=0.5"])
    assert (options.loss, options.loss_scale_px) == ("huber", 2.0)
    assert (options.damping, options.t_eps) == ("diag", 0.5)
    assert options.cheirality == "keep"
    assert solver_options("auto", ["solver.method=irls_huber"]) == methods.options("irls_huber")


def test_every_option_can_be_set_to_its_own_value() -> None:
    for method, options in methods.METHODS.items():
        values = dataclasses.asdict(options)
        assert set(option_names()) == set(values) - {"method"}
        assert solver_options(method, [f"{name}={values[name]}" for name in option_names()]) == options


def test_every_option_refuses_nonsense() -> None:
    for name in option_names():
        with pytest.raises(ConfigError, match=name):
            solver_options("auto", [f"{name}=nonsense"])


def test_kernels_that_cannot_do_it_are_named() -> None:
    with pytest.raises(ConfigError, match=r"kernels = 'native': .*; take numpy or auto"):
        solver_options("local_dinm", ["backend=native", "parameterisation=global"])


def test_without_settings_the_method_is_as_declared() -> None:
    for name in methods.METHODS:
        assert solver_options(name, []) == methods.options(name)
        assert dataclasses.asdict(methods.options(name))["method"] == (name if name != "auto" else "local_irls")


@pytest.mark.parametrize("loss", ["truncated_quadratic", "geman_mcclure"])
def test_a_loss_with_a_plateau_is_led_up_to_unless_that_is_not_wanted(loss: str) -> None:
    assert solver_options("auto", [f"loss={loss}", "gamma=1"]).annealing == "gnc"
    assert solver_options("auto", [f"loss={loss}", "gamma=1", "annealing=none"]).annealing == "none"
    with pytest.raises(ConfigError, match="annealing = gnc with loss = huber"):
        solver_options("irls_tq", ["loss=huber"])


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("los=huber", "did you mean 'loss'?"),
        ("loss=l1", "choose one of squared, huber"),
        ("max_iterations=0", "option max_iterations = 0: expected a number in [1, 100000]"),
        ("max_iterations=2.5", "expected int"),
        ("t_eps=nan", "option t_eps = nan: expected a number in [0, 1e+100]"),
        ("solver.max_iterations=0", "expected a number in [1, 100000]"),
        ("solver.bogus=1", "did you mean"),
        ("window.max_keyframes=3", "does not exist"),
        ("loss", "expected name=value"),
        ("backend=cuda", "choose one of auto, native, numpy"),
        ("los=huber", "hoose one of linear_solver, kernels, threads, loss"),
        ("loss=huber", "without loss_scale_px (gamma): method local_dinm has none"),
        ("solver.loss=huber", "without loss_scale_px (gamma)"),
        ("gamma=0", "option loss_scale_px = 0.0: expected a number in [1e-06, 1e+06] px"),
        ("annealing=gnc", "take loss = truncated_quadratic or geman_mcclure, or annealing = none"),
        ("schur=X", "choose one of points, cameras, none, adaptive, adaptive_scaled"),
        ("scaling=X", "choose one of none, identity, diag, inc"),
        ("damping=X", "choose one of none, identity, diag, inc"),
        ("damping_policy=X", "choose one of nielsen, fast"),
        ("linear_solver=X", "choose one of auto, cholesky, dense, sparse, pcg"),
        (
            "preconditioner=X",
            "choose one of auto, none, schur_block, b_block, schur_diag, b_diag, two_level, b_literal",
        ),
        ("parameterisation=X", "choose one of local, global"),
    ],
)
def test_bad_settings_are_explained(setting: str, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        solver_options("local_dinm", [setting])
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 1 1\n0 7 1.0 2.0\n" + "0\n" * 12, "point index 7 out of range [0, 1)"),
        ("1 1 1\n0 0 1.0 2.0\n0\n", "truncated"),
        ("", "the file is empty"),
    ],
)
def test_bad_files_are_named(text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.txt"
    path.write_text(text)
    assert main(["solve", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"ba: error: {path}: ")
    assert words in error
    assert main(["solve", str(tmp_path / "none.txt")]) == 2
    assert "No such file or directory" in capsys.readouterr().err


def test_missing_folder_is_told_before_the_work(
    bal_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option in ("--json", "--out"):
        assert main(["solve", str(bal_file), option, str(tmp_path / "no" / "file")]) == 2
        output = capsys.readouterr()
        assert "there is no folder" in output.err
        assert output.out == ""


def test_an_unknown_method_is_answered_with_the_nearest_and_all(
    bal_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", str(bal_file), "--method", "local_dimn"]) == 2
    error = capsys.readouterr().err
    assert "did you mean 'local_dinm'?" in error
    assert all(name in error for name in methods.METHODS)


@pytest.mark.slow
def test_ladybug_meets_the_published_start_and_the_target(shared_data: Path, tmp_path: Path) -> None:
    trace = tmp_path / "t.json"
    source = shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"
    assert main(["solve", str(source), "--method", "local_dinm", "--iterations", "50", "--json", str(trace)]) == 0
    report = json.loads(trace.read_text())
    assert f"{report['objective_before']:.2f}" == "850912.46"
    assert report["objective_after"] <= 13500.0, report["objective_after"]


UTM = np.array([512_345.678, 5_412_345.678, 345.678])


def _solved(tmp_path: Path, problem: BalProblem, *options: str) -> tuple[dict[str, Any], BalProblem]:
    """Solve a problem and return the figures and what was written."""
    source, figures, refined = tmp_path / "in.txt", tmp_path / "out.json", tmp_path / "out.txt"
    write_bal(source, problem)
    assert main(["solve", str(source), "--json", str(figures), "--out", str(refined), *options]) == 0
    return json.loads(figures.read_text()), read_bal(refined)


def test_coordinates_of_a_country_give_the_same_result(tmp_path: Path, bal_file: Path) -> None:
    """A problem with noise, so that there is an objective to compare: about its own origin, and in UTM coordinates."""
    problem, rng = read_bal(bal_file), np.random.default_rng(3)
    problem = dataclasses.replace(problem, observations=problem.observations + rng.normal(0.0, 0.5, (120, 2)))
    near, refined = _solved(tmp_path, problem, "--method", "auto", "--iterations", "200")
    far, there = _solved(tmp_path, translated(problem, UTM), "--method", "auto", "--iterations", "200")
    assert near["origin"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(far["origin"], np.median(problem.points, axis=0) + UTM, atol=1e-6)
    assert far["objective_before"] == pytest.approx(near["objective_before"], rel=1e-6)
    assert far["objective_after"] == pytest.approx(near["objective_after"], rel=1e-3)
    again, _ = _solved(tmp_path, there, "--iterations", "1")
    assert again["objective_before"] == pytest.approx(far["objective_after"], rel=1e-6), (
        "in the coordinates of the file"
    )
    extent = np.linalg.norm(refined.points - refined.points[0], axis=1).max()
    assert extent > 1.0 and np.abs(there.points - UTM).max() < 100.0


def test_moving_a_problem_there_and_back_changes_nothing(bal_file: Path) -> None:
    problem = read_bal(bal_file)
    back = translated(translated(problem, UTM), -UTM)
    np.testing.assert_allclose(back.cameras, problem.cameras, atol=1e-8)
    np.testing.assert_allclose(back.points, problem.points, atol=1e-8)
    assert not behind(problem).any()
    assert behind(dataclasses.replace(problem, points=-problem.points)).all()


def test_a_negative_focal_length_is_said(tmp_path: Path, bal_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cameras that look along +z, with f < 0 so that the pixels fit: nothing is in front, so the rms was 0."""
    problem = read_bal(bal_file)
    cameras, points = problem.cameras.copy(), problem.points * [-1.0, -1.0, -1.0]
    cameras[:, 3:6] *= -1.0
    cameras[:, 6] *= -1.0
    write_bal(
        tmp_path / "in.txt",
        dataclasses.replace(problem, cameras=cameras, points=points, observations=-problem.observations),
    )
    assert main(["solve", str(tmp_path / "in.txt"), "--iterations", "3"]) == 3
    told = capsys.readouterr().err
    assert "4 of 4 cameras have a focal length that is not positive (camera 0: f = -500 px): a BAL camera" in told
    assert "120 of 120 observations are of points behind their camera at the start" in told


def test_a_solve_that_fails_says_why(tmp_path: Path, bal_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    problem = read_bal(bal_file)
    cameras = problem.cameras.copy()
    cameras[2, 6] = 1e200
    write_bal(tmp_path / "in.txt", dataclasses.replace(problem, cameras=cameras))
    figures, refined = tmp_path / "out.json", tmp_path / "out.txt"
    assert main(["solve", str(tmp_path / "in.txt"), "--json", str(figures), "--out", str(refined)]) == 2
    told = capsys.readouterr()
    assert "in.txt: failed: the objective or its derivatives are not finite at the start" in told.err
    assert "objective 0" not in told.out
    assert json.loads(figures.read_text())["status"] == "FAILED"
    assert not refined.exists(), "there is nothing to write"


def test_a_result_worse_than_its_start_is_said(
    bal_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def worse(problem: Problem, options: SolverOptions, **others: Any) -> Result:
        result = solve(problem, options, **others)
        return dataclasses.replace(result, trace=result.trace[::-1])

    monkeypatch.setattr(solve_bal, "solve", worse)
    assert main(["solve", str(bal_file), "--iterations", "5"]) == 3
    assert "is worse than at the start" in capsys.readouterr().err
