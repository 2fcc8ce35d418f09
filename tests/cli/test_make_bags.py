# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba synth` and `ba convert`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ba_node.cli.main import main
from ba_node.core.cameras import parameters, project
from ba_node.core.geometry import inverse, matrix_from_quaternion
from ba_node.io.bag_reader import BagReader
from ba_node.io.bal import read_bal
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.offline.recording import read_truth

SMALL = ["--keyframes", "5", "--landmarks", "200", "--tracks", "30", "--path", "line", "--length-m", "10"]


def test_synth_gives_the_same_bytes_for_the_same_options(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in "abc"]
    for path, seed in zip(paths, ("1", "1", "2"), strict=True):
        assert main(["synth", str(path), *SMALL, "--seed", seed]) == 0
    first, same, other = (path.read_bytes() for path in paths)
    assert first == same
    assert first != other


def test_synth_records_the_truth(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    assert main(["synth", str(path), *SMALL, "--ids", "random64", "--guesses", "--no-send-sigma"]) == 0
    with BagReader(path) as reader:
        assert reader.topics["/ground_truth/pose"] == "geometry_msgs/msg/PoseStamped"
        truth = read_truth(reader)
        got = [measurement for _, _, measurement in reader.measurements()]
    keyframes = [m for m in got if isinstance(m, Keyframe)]
    assert truth is not None
    assert len(truth) == len(keyframes) == 5
    assert truth.stamp_ns.tolist() == [keyframe.stamp_ns for keyframe in keyframes]
    # The walk of the published poses starts at the truth.
    assert_allclose(truth.position[0], keyframes[0].position, atol=1e-12)
    assert max(keyframe.keyframe_id for keyframe in keyframes) > 2**53
    assert any(isinstance(m, LandmarkGuesses) for m in got)
    assert all(len(m.sigma_px) == 0 for m in got if isinstance(m, FeatureTracks))


def test_synth_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["synth", str(tmp_path / "s.bag")]) == 2
    assert capsys.readouterr().err.endswith("give a name that ends so\n")
    assert main(["synth", str(tmp_path / "s.mcap"), "--keyframes", "1"]) == 2
    assert "keyframes = 1: expected a number in [2, 100000]" in capsys.readouterr().err
    assert main(["synth", str(tmp_path / "no" / "s.mcap"), *SMALL]) == 2
    assert "there is no folder" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_convert_keeps_the_geometry(bal_file: Path, tmp_path: Path) -> None:
    """Project the guesses through the recorded rig and poses: where BAL's own formula puts them, v turned over."""
    path = tmp_path / "b.mcap"
    assert main(["convert", str(bal_file), str(path)]) == 0
    bal = read_bal(bal_file)
    with BagReader(path) as reader:
        got = [(stamp, m) for _, stamp, m in reader.measurements()]
    rig = next(m for _, m in got if isinstance(m, CameraRig))
    keyframes = [m for _, m in got if isinstance(m, Keyframe)]
    images = [m for _, m in got if isinstance(m, FeatureTracks)]
    guesses = [m for _, m in got if isinstance(m, LandmarkGuesses)]
    assert [k.keyframe_id for k in keyframes] == [0, 1, 2, 3]
    assert np.diff([k.stamp_ns for k in keyframes]).tolist() == [100_000_000] * 3
    assert keyframes[0].stamp_ns > 0
    assert sum(len(g.track_id) for g in guesses) == 30
    for keyframe, image in zip(keyframes, images, strict=True):
        i = image.camera_index
        model, params = parameters(rig.models[i], rig.intrinsics[i], rig.distortion[i])
        body = inverse(matrix_from_quaternion(keyframe.orientation), keyframe.position)
        camera = inverse(matrix_from_quaternion(rig.orientation[i]), rig.position[i])
        x_body = bal.points[image.track_id.astype(int)] @ body[0].T + body[1]
        x_cam = x_body @ camera[0].T + camera[1]
        uv = project(x_cam, np.full(len(x_cam), model, np.uint8), np.tile(params, (len(x_cam), 1)))
        rows = bal.camera_index == i
        rotated = bal.points[bal.point_index[rows]] + bal.cameras[i, 3:6]
        p = -rotated[:, :2] / rotated[:, 2:]
        s = np.sum(p * p, axis=1, keepdims=True)
        f, k1, k2 = bal.cameras[i, 6:]
        assert_allclose(uv * [1.0, -1.0], f * (1.0 + k1 * s + k2 * s**2) * p, atol=1e-9)
        assert_allclose(image.uv * [1.0, -1.0], bal.observations[rows], rtol=1e-6, atol=1e-4)


def test_convert_refuses_what_it_cannot_do(bal_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(bal_file), str(tmp_path / "b.bag")]) == 2
    assert "which format is this to be? Give --to, a name that ends in .mcap, .out" in capsys.readouterr().err
    text = bal_file.read_text().splitlines()
    text[1 + 120 + 6] = "-500.0"
    bad = tmp_path / "bad.txt"
    bad.write_text("\n".join(text))
    assert main(["convert", str(bad), str(tmp_path / "b.mcap")]) == 2
    assert "camera 0: f = -500 px: expected > 0" in capsys.readouterr().err
    assert not (tmp_path / "b.mcap").exists()
