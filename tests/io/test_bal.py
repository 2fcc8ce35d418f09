# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import bz2
import dataclasses
import gzip
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core.objective import Objective, reprojection_errors
from ba_node.io.bal import BalError, BalProblem, from_state, read_bal, to_problem, write_bal

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def make(seed: int = 0, n_cameras: int = 4, n_points: int = 9, n_obs: int = 20) -> BalProblem:
    rng = np.random.default_rng(seed)
    focal, distortion = rng.uniform(300, 900, (n_cameras, 1)), rng.normal(scale=1e-3, size=(n_cameras, 2))
    return BalProblem(
        cameras=np.hstack([0.3 * rng.normal(size=(n_cameras, 6)), focal, distortion]),
        points=rng.normal(size=(n_points, 3)) - [0.0, 0.0, 8.0],
        camera_index=rng.integers(0, n_cameras, n_obs),
        point_index=rng.integers(0, n_points, n_obs),
        observations=rng.normal(scale=200.0, size=(n_obs, 2)),
    )


def residuals(bal: BalProblem) -> NDArray[np.float64]:
    """Return predicted minus measured by the projection as the BAL page states it, with no code of ours in it."""
    camera = bal.cameras[bal.camera_index]
    w, t, f, k1, k2 = camera[:, :3], camera[:, 3:6], camera[:, 6], camera[:, 7], camera[:, 8]
    angle = np.linalg.norm(w, axis=1, keepdims=True)
    axis = w / np.where(angle > 0, angle, 1.0)
    x = bal.points[bal.point_index]
    along = np.sum(axis * x, axis=1, keepdims=True)
    rotated = x * np.cos(angle) + np.cross(axis, x) * np.sin(angle) + axis * along * (1 - np.cos(angle))
    moved = rotated + t
    p = -moved[:, :2] / moved[:, 2:]
    r2 = np.sum(p * p, axis=1)
    predicted: NDArray[np.float64] = (f * (1 + k1 * r2 + k2 * r2**2))[:, None] * p
    return predicted - bal.observations


def same(a: BalProblem, b: BalProblem) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))


@pytest.mark.parametrize("suffix", [".txt", ".bz2", ".gz", ".txt.gz"])
def test_what_was_written_is_read_exactly(tmp_path: Path, suffix: str) -> None:
    bal = make()
    path = tmp_path / f"p{suffix}"
    write_bal(path, bal)
    assert same(read_bal(path), bal)
    first = path.read_bytes()
    write_bal(path, bal)
    assert path.read_bytes() == first


@settings(max_examples=50)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=14, max_size=14))
def test_any_float_survives(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    path = tmp_path_factory.mktemp("bal") / "p.txt"
    v = np.array(values)
    bal = BalProblem(v[None, :9], v[None, 9:12], np.zeros(1, np.intp), np.zeros(1, np.intp), v[None, 12:])
    write_bal(path, bal)
    assert same(read_bal(path), bal)


def test_projection_of_to_problem_is_that_of_the_format() -> None:
    bal = make(seed=5, n_obs=200, n_points=60)
    problem = to_problem(bal)
    problem.check()
    order = np.argsort(bal.point_index, kind="stable")
    ours = reprojection_errors(problem, problem.start) * [1.0, -1.0]
    np.testing.assert_allclose(ours, residuals(bal)[order], rtol=0, atol=1e-9)


def test_from_state_gives_the_problem_back() -> None:
    bal = make()
    back = from_state(bal, to_problem(bal).start)
    np.testing.assert_allclose(back.cameras, bal.cameras, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(back.points, bal.points)
    assert back.observations is bal.observations


def test_observations_are_sorted_by_point_and_stay_together() -> None:
    bal = make(n_obs=200)
    problem = to_problem(bal)
    obs = problem.observations
    rows = sorted(range(200), key=lambda i: bal.point_index[i])
    assert obs.point.tolist() == [bal.point_index[i] for i in rows]
    assert obs.keyframe.tolist() == [bal.camera_index[i] for i in rows]
    np.testing.assert_array_equal(obs.uv, bal.observations[rows] * [1.0, -1.0])
    assert problem.free_intrinsics
    assert not problem.fixed.any()


@pytest.mark.skipif(native.kernels is None, reason="not built")
@pytest.mark.parametrize("is_sorted", [True, False])
def test_numpy_makes_the_same_problem(is_sorted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    bal = make(n_obs=200)
    bal.cameras[:3, :3] = [0.0, 0.0, 0.0], [1e-6, -2e-6, 3e-6], [np.pi, 0.0, 0.0]
    if is_sorted:
        bal = dataclasses.replace(bal, point_index=np.sort(bal.point_index))
    found = native.kernels.from_bal(bal.cameras, bal.point_index, bal.observations)
    assert (found is not None) == is_sorted
    ours = to_problem(bal)
    monkeypatch.setattr(native, "kernels", None)
    expected = to_problem(bal)
    np.testing.assert_allclose(ours.start.rotation, expected.start.rotation, rtol=0.0, atol=1e-15)
    for one, other in ((ours.start, expected.start), (ours.observations, expected.observations)):
        for name in vars(one).keys() - {"rotation"}:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=True)
    assert not np.shares_memory(ours.start.points, bal.points)


@pytest.mark.skipif(native.kernels is None, reason="not built")
def test_order_is_no_matter_to_poses() -> None:
    """Ranks have parts of a problem, some of them sorted, and the same cameras to the last bit."""
    bal = make(n_obs=200)
    part = dataclasses.replace(bal, point_index=np.sort(bal.point_index))
    np.testing.assert_array_equal(to_problem(part).start.rotation, to_problem(bal).start.rotation)


@pytest.mark.skipif(native.kernels is None, reason="not built")
def test_another_shape_is_refused() -> None:
    bal = make(n_cameras=9, n_obs=20)
    point = np.sort(bal.point_index)
    assert native.kernels.from_bal(bal.cameras, point, bal.observations) is not None
    for cameras, points, uv in (
        (bal.cameras[:, :8], point, bal.observations),
        (bal.cameras.ravel(), point, bal.observations),
        (bal.cameras, point[1:], bal.observations),
        (bal.cameras, point, bal.observations.ravel()),
    ):
        with pytest.raises(ValueError, match="expected"):
            native.kernels.from_bal(cameras, points, uv)


TEXT = """2 1 2

0 0 1.0 2.0
1 0 3.0 4.0
""" + "\n".join(str(0.1 * i) for i in range(18)) + "\n1\n2\n3\n"  # fmt: skip


def edit(line: int, new: str) -> str:
    lines = TEXT.splitlines()
    lines[line - 1] = new
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        (" \n\n", "is empty"),
        ("hello world\n", "line 1: 'hello' is not a number"),
        ("\0\1 2 3\n", "not a text, as BAL and Bundler are; a recording is refined by ba replay"),
        ("2 1\n", "line 1: '2 1': expected the numbers of cameras, points, observations"),
        ("2.5 1 2\n", "line 1: '2.5 1 2': expected the numbers"),
        ("-2 1 2\n", "line 1: '-2 1 2': expected the numbers"),
        (edit(4, "2 0 3.0 4.0"), r"line 4: camera index 2 out of range \[0, 2\)"),
        (edit(3, "-1 0 3.0 4.0"), r"line 3: camera index -1 out of range \[0, 2\)"),
        (edit(3, "0.5 0 3.0 4.0"), r"line 3: camera index 0.5 out of range \[0, 2\)"),
        (edit(4, "1 1 3.0 4.0"), r"line 4: point index 1 out of range \[0, 1\)"),
        (edit(6, "nan"), "line 6: nan: expected a finite number"),
        (edit(4, "1 0 -inf 4.0"), "line 4: -inf: expected a finite number"),
        (edit(7, "1e999"), "line 7: inf: expected a finite number"),
        (edit(8, "0.3x"), "line 8: '0.3x' is not a number"),
        (edit(8, "\u00e9"), "line 8: .* is not a number"),
        (edit(8, "1.0-2.0"), "line 8: '1.0-2.0' is not a number"),
        (TEXT + "4\n", "line 26: 2 cameras, 1 points and 2 observations make 32 numbers, the file holds 33"),
        ("\n".join(TEXT.splitlines()[:-1]), "truncated: .* make 32 numbers, the file holds 31 and ends in point 0"),
        ("\n".join(TEXT.splitlines()[:11]), r"ends in camera 0 \(k1\)"),
        ("\n".join(TEXT.splitlines()[:3]), "ends in observation 1"),
        ("99999999999999 9999999999999 999999999999\n1 2 3", "truncated: .*ends in observation 0"),
    ],
)
def test_a_wrong_file_is_an_error_that_names_the_place(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "p.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BalError, match=words) as caught:
        read_bal(path)
    assert str(path) in str(caught.value)


def test_the_file_of_the_cases_above_is_sound(tmp_path: Path) -> None:
    path = tmp_path / "p.txt"
    path.write_text(TEXT, encoding="utf-8")
    assert read_bal(path).points.tolist() == [[1.0, 2.0, 3.0]]


def test_every_truncation_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "p.txt"
    for length in range(len(TEXT) - 2):
        path.write_text(TEXT[:length], encoding="utf-8")
        with pytest.raises(BalError):
            read_bal(path)


@pytest.mark.parametrize("suffix", [".bz2", ".gz"])
def test_a_damaged_archive_is_an_error(tmp_path: Path, suffix: str) -> None:
    whole = bz2.compress(TEXT.encode()) if suffix == ".bz2" else gzip.compress(TEXT.encode())
    path = tmp_path / f"p{suffix}"
    flipped = whole[:30] + bytes([whole[30] ^ 0xFF]) + whole[31:]
    for data in (b"", whole[:-3], whole[: len(whole) // 2], b"plain text", flipped):
        path.write_bytes(data)
        with pytest.raises(BalError):
            read_bal(path)
    with pytest.raises(BalError, match="cannot be opened: No such file"):
        read_bal(tmp_path / "absent.txt")


def test_ladybug_starts_at_the_known_objective(shared_data: Path) -> None:
    bal = read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt")
    assert (len(bal.cameras), len(bal.points), len(bal.observations)) == (49, 7776, 31843)
    objective = 0.5 * float(np.sum(residuals(bal) ** 2))
    assert f"{objective:.2f}" == "850912.46", objective


def test_ladybug_objective_by_the_core(shared_data: Path) -> None:
    bal = read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt")
    problem = to_problem(bal)
    problem.check()
    value = Objective(problem, SolverOptions(cheirality="keep")).value(problem.start)
    assert f"{value:.2f}" == "850912.46", value
    errors = reprojection_errors(problem, problem.start)
    in_front = np.isfinite(errors).all(axis=1)
    assert in_front.mean() > 0.99, f"{in_front.mean():.4f} of the points are in front of their cameras"
    direct = residuals(bal)[np.argsort(bal.point_index, kind="stable")] * [1.0, -1.0]
    np.testing.assert_allclose(errors[in_front], direct[in_front], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "shape"), [("1-1", (1, 1, 1)), ("3-7", (3, 7, 19)), ("3-7-18", (3, 7, 18))])
def test_files_with_a_blank_line_after_the_header(shared_data: Path, name: str, shape: tuple[int, int, int]) -> None:
    bal = read_bal(shared_data / "gtsam-dubrovnik-small" / f"dubrovnik-{name}-pre.txt")
    assert (len(bal.cameras), len(bal.points), len(bal.observations)) == shape
    assert np.abs(residuals(bal)).max() < 50.0, "residuals of a real problem at its start are pixels, not hundreds"


@pytest.mark.skipif(native.kernels is None, reason="not built")
def test_numbers_are_read_to_the_bit() -> None:
    rng = np.random.default_rng(5)
    values = np.concatenate([rng.normal(size=2000) * 10.0 ** rng.integers(-300, 300, 2000), rng.integers(-9, 9, 99)])
    words = [f(value) for f in (repr, "{:.3e}".format, "{:.17g}".format) for value in values.tolist()]
    spaces = rng.choice(list(" \t\n\r\v\f"), (len(words) + 1, 2))
    text = "".join(f"{a}{b}{word}" for (a, b), word in zip(spaces, words, strict=False)) + "".join(spaces[-1])
    np.testing.assert_array_equal(native.kernels.numbers(text.encode()), np.array(words, dtype=np.float64))
    assert native.kernels.numbers(b"-1.5").tolist() == [-1.5]
    assert native.kernels.numbers(b" \n").shape == (0,)


@pytest.mark.skipif(native.kernels is None, reason="not built")
@pytest.mark.parametrize("word", ["x", "1x", "1,2", "nan", "inf", "1e999", "1e-999", "+1", "0x10", "-", ".", "1\0"])
def test_what_is_no_plain_number_is_left_to_numpy(word: str) -> None:
    assert native.kernels.numbers(f"1 {word} 2".encode()) is None
