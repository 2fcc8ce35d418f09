# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""``ba calibrate`` on recordings with wrong cameras, and the same by a replay."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from ba_node.cli.main import main
from ba_node.core import geometry
from ba_node.io.rig_file import read_rig
from ba_node.measurements import CameraRig, Measurement
from ba_node.offline.recording import record
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

OPTIONS = SyntheticOptions(
    seed=1, keyframes=30, landmarks=1200, tracks=80, length_m=40.0, baseline_m=0.2, outlier_share=0.02,
    drift_rotation_deg=0.3, drift_translation=0.01,
)  # fmt: skip


def spoiled(measurement: Measurement) -> Measurement:
    """Return a rig with focal lengths 2 % too long, and the second camera turned by 1 degree and moved by 1 cm."""
    if not isinstance(measurement, CameraRig):
        return measurement
    turned = geometry.matrix_from_quaternion(measurement.orientation)
    turned[1] = turned[1] @ geometry.so3_exp(np.radians(1.0) * np.array([0.6, 0.64, 0.48]))
    position = measurement.position.copy()
    position[1] += 0.01 / np.sqrt(3.0)
    return dataclasses.replace(
        measurement,
        intrinsics=measurement.intrinsics * [1.02, 1.02, 1.0, 1.0],
        orientation=geometry.quaternion_from_matrix(turned),
        position=position,
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SyntheticData]:
    data = generate(OPTIONS)
    path = tmp_path_factory.mktemp("calibrate") / "wrong.mcap"
    record(path, ((topic, stamp, spoiled(m)) for topic, stamp, m in data.timeline()), data.truth)
    return path, data


@pytest.mark.slow
def test_wrong_cameras_are_recovered_to_a_fifth(recording: tuple[Path, SyntheticData], tmp_path: Path) -> None:
    path, data = recording
    assert main(["calibrate", str(path), "--out", str(tmp_path / "rig.yaml")]) == 0
    rig, true = read_rig(tmp_path / "rig.yaml"), data.rig
    off = np.abs(rig.intrinsics[:, :2] / true.intrinsics[:, :2] - 1.0).max()
    assert off < 0.02 / 5, f"focal lengths are {100 * off:.2f} % off"
    turns = [geometry.matrix_from_quaternion(one.orientation) for one in (rig, true)]
    turn = np.degrees(np.linalg.norm(geometry.so3_log(np.swapaxes(turns[0], 1, 2) @ turns[1]), axis=1))
    assert turn[0] < 1e-6 and turn[1] < 0.2, f"the second camera is {turn[1]:.3f} deg off"
    away = np.linalg.norm(rig.position - true.position, axis=1)
    assert away[0] < 1e-9 and away[1] < 0.002, f"the second camera is {1e3 * away[1]:.1f} mm off"
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())["cameras"]
    assert 0.0 < written[1]["standard_deviations"]["fx"] < 2.0
    assert "rotation_x" in written[0]["not_told"], "no track tells where the first camera sits on the body"


@pytest.mark.slow
def test_a_replay_refines_cameras_and_tells_covariances(
    recording: tuple[Path, SyntheticData], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = recording
    options = ["--set", "calibration.intrinsics=refined", "--set", "calibration.extrinsics=refined"]
    found = {}
    for name, chosen in (("given", []), ("refined", options)):
        guard = ["--set", "guard.enabled=false", "--set", "guard.check_setup=false", "--no-report"]
        main(["replay", str(path), "--out", str(tmp_path / name), "--final-optimize", "--covariance", *guard, *chosen])
        found[name] = json.loads((tmp_path / name / "report.json").read_text())["trajectory_error_m"]["refined"]
    assert found["refined"] < 0.5 * found["given"], found
    report = json.loads((tmp_path / "refined" / "report.json").read_text())
    assert {row["name"] for row in report["calibration"] if row["told"] and row["camera"] == 1} >= {"fx", "rotation_x"}
    with np.load(tmp_path / "refined" / "covariance.npz") as file:
        assert file["pose"].shape == (30, 6, 6) and len(file["keyframe_id"]) == 30
        assert not file["pose"][0].any(), "the first keyframe is held"
        assert (np.linalg.eigvalsh(file["pose"][1:]) > 0.0).all()
        assert np.mean(np.isfinite(file["point"]).all(axis=(1, 2))) > 0.9
    assert "camera 1" in capsys.readouterr().out


@pytest.mark.parametrize("option", ["--covariance", "--set=calibration.intrinsics=refined"])
def test_what_needs_a_solve_of_everything_says_so(
    recording: tuple[Path, SyntheticData], tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    assert main(["replay", str(recording[0]), "--out", str(tmp_path / "out"), option]) == 2
    assert "add --final-optimize" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
