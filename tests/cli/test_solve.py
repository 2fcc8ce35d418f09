# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import ConfigError
from ba_node.core import methods
from ba_node.io.bal import read_bal
from ba_node.offline.solver_settings import describe, option_names, solver_options

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
    assert report["method"] == "local_dinm"
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
    assert (options.rules.loss, options.rules.loss_scale) == ("huber", 2.0)
    assert (options.damping, options.t_eps) == ("diag", 0.5)
    assert options.rules.cheirality == "keep"
    assert solver_options("auto", ["solver.method=irls_huber"]) == methods.options("irls_huber")


def test_every_option_can_be_set_to_its_own_value() -> None:
    for method, options in methods.METHODS.items():
        values = describe(options)
        assert set(option_names()) == set(values) - {"method"}
        assert solver_options(method, [f"{name}={values[name]}" for name in option_names()]) == options


def test_every_option_refuses_nonsense() -> None:
    for name in option_names():
        with pytest.raises(ConfigError, match=name):
            solver_options("auto", [f"{name}=nonsense"])


def test_kernels_that_cannot_do_it_are_named() -> None:
    with pytest.raises(ConfigError, match=r"backend = 'native': .*; take numpy or auto"):
        solver_options("local_dinm", ["backend=native", "parameterisation=global"])


def test_without_settings_the_method_is_as_declared() -> None:
    for name in methods.METHODS:
        assert solver_options(name, []) == methods.options(name)
        assert describe(methods.options(name))["method"] == name


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("los=huber", "did you mean 'loss'?"),
        ("loss=l1", "choose one of squared, huber"),
        ("max_iterations=0", "expected a finite number > 0"),
        ("max_iterations=2.5", "expected int"),
        ("t_eps=nan", "expected a finite number >= 0"),
        ("solver.max_iterations=0", "expected a number in [1, 100000]"),
        ("solver.bogus=1", "did you mean"),
        ("window.max_keyframes=3", "does not exist"),
        ("loss", "expected name=value"),
        ("backend=cuda", "choose one of auto, native, numpy"),
        ("los=huber", "Choose one of parameterisation, loss, loss_scale"),
        ("loss=huber", "without loss_scale (gamma): method local_dinm has none"),
        ("solver.loss=huber", "without loss_scale (gamma)"),
        ("gamma=0", "expected a finite number > 0"),
        ("linear_solver=cholesky", "only pcg stops at the boundary of a region"),
        ("annealing=gnc", "take loss = truncated_quadratic or annealing = none"),
        ("schur=X", "choose one of points, cameras, none, adaptive"),
        ("scaling=X", "choose one of none, identity, diag, inc"),
        ("damping=X", "choose one of none, identity, diag, inc"),
        ("damping_policy=X", "choose one of nielsen, fast"),
        ("linear_solver=X", "choose one of auto, cholesky, dense, sparse, pcg"),
        ("preconditioner=X", "choose one of none, schur_block, b_block, schur_diag, b_diag"),
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
