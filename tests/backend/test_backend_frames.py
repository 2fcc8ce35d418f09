# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The correction map -> odom, poses of a camera, and what is worked out only when asked for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate, Extras
from ba_node.measurements import CameraRig, Keyframe, Measurement
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

SMALL: dict[str, Any] = {
    "keyframes": 10, "landmarks": 800, "tracks": 60, "length_m": 10.0, "path": "line", "drift_rotation_deg": 2.0,
}  # fmt: skip


def data_of(**options: Any) -> SyntheticData:
    return generate(SyntheticOptions(**{**SMALL, **options}))


def run(backend: Backend, stream: list[Measurement]) -> list[Estimate]:
    return [event for event in backend.replay(stream) if isinstance(event, Estimate)]


def stream_of(data: SyntheticData) -> list[Measurement]:
    return [measurement for _, _, measurement in data.timeline()]


def matrix(position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = geometry.matrix_from_quaternion(orientation), position
    return out


@pytest.mark.slow
def test_the_correction_leads_from_odometry_to_the_refined_pose() -> None:
    data = data_of()
    estimates = run(Backend(Config()), stream_of(data))
    inputs = {keyframe.keyframe_id: keyframe for keyframe in data.keyframes}
    usable = [estimate for estimate in estimates if estimate.report.status.usable]
    assert len(usable) >= 8
    for estimate in usable:
        assert estimate.correction is not None
        assert (estimate.frame_id, estimate.correction.odom_frame) == ("map", "odom")
        newest = inputs[estimate.report.newest_keyframe_id]
        map_from_odom = matrix(estimate.correction.position, estimate.correction.orientation)
        expected = matrix(estimate.refined.position[-1], estimate.refined.orientation[-1])
        np.testing.assert_allclose(map_from_odom @ matrix(newest.position, newest.orientation), expected, atol=1e-9)
    assert usable[-1].report.correction_m > 0.0
    assert usable[-1].report.correction_rad > 0.0
    assert estimates[0].correction is None, "one keyframe gives none"


@pytest.mark.slow
def test_a_gate_holds_the_correction_and_the_report_says_so() -> None:
    config = Config().with_values({"frames.gate_m": 1e-6, "frames.gate_confirmations": 1000})
    reports = [e.report for e in run(Backend(config), stream_of(data_of())) if e.report.status.usable]
    assert [report.correction_held for report in reports] == [False] + [True] * (len(reports) - 1)


@pytest.mark.slow
def test_a_new_session_begins_without_a_correction() -> None:
    data = data_of()
    backend = Backend(Config())
    run(backend, stream_of(data))
    backend.add(dataclasses.replace(data.keyframes[0], session_id=1))
    for image in data.tracks[0]:
        backend.add(dataclasses.replace(image, session_id=1))
    backend.flush()
    estimate = backend.solve()
    assert estimate is not None
    assert (estimate.report.session_id, estimate.correction) == (1, None)


@pytest.mark.slow
def test_names_of_frames_come_from_the_parameters_or_the_keyframes() -> None:
    named = Config().with_values({"frames.map_frame": "world", "frames.odom_frame": "vo"})
    last = run(Backend(named), stream_of(data_of()))[-1]
    assert last.correction is not None
    assert (last.frame_id, last.correction.odom_frame) == ("world", "vo")
    nameless = [
        dataclasses.replace(m, frame_id="") if isinstance(m, Keyframe) else m for m in stream_of(data_of(keyframes=4))
    ]
    unnamed = run(Backend(Config()), nameless)[-1]
    assert unnamed.correction is not None
    assert unnamed.correction.odom_frame == "odom"


def as_of_camera(measurement: Measurement, rig: CameraRig) -> Measurement:
    """Return a keyframe with the pose of camera 0 instead of the body's."""
    if not isinstance(measurement, Keyframe):
        return measurement
    pose = matrix(measurement.position, measurement.orientation) @ matrix(rig.position[0], rig.orientation[0])
    return dataclasses.replace(
        measurement, position=pose[:3, 3], orientation=geometry.quaternion_from_matrix(pose[:3, :3])
    )


@pytest.mark.slow
def test_poses_of_the_camera_give_the_same_map_and_come_back_as_such() -> None:
    data = data_of()
    # Steps of the camera are not as precise as those of the body, by their lever arm: without them.
    config = Config().with_values({"odometry.enabled": False})
    of_body = run(Backend(config), stream_of(data))[-1]
    config = config.with_values({"frames.poses_of": "camera"})
    of_camera = run(Backend(config), [as_of_camera(m, data.rig) for m in stream_of(data)])[-1]
    mount = matrix(data.rig.position[0], data.rig.orientation[0])
    assert not np.allclose(mount, np.eye(4)), "the camera stands elsewhere than the body"
    for k in range(len(of_body.refined)):
        body = matrix(of_body.refined.position[k], of_body.refined.orientation[k])
        camera = matrix(of_camera.refined.position[k], of_camera.refined.orientation[k])
        np.testing.assert_allclose(body @ mount, camera, atol=2e-4)
    np.testing.assert_allclose(of_body.cloud.position, of_camera.cloud.position, atol=1e-2)


def test_a_rig_that_cannot_be_used_is_counted_also_with_poses_of_the_camera() -> None:
    backend = Backend(Config().with_values({"frames.poses_of": "camera"}))
    rig = data_of().rig
    backend.add(dataclasses.replace(rig, position=np.full_like(rig.position, np.nan)))
    assert backend.map.rejected == {"bad_rig": 1}


@pytest.mark.slow
@pytest.mark.parametrize("baseline_m", [0.2, 0.0], ids=["stereo", "one camera"])
def test_extras_are_worked_out_only_when_asked_for(baseline_m: float) -> None:
    backend = Backend(Config().with_values({"window.max_keyframes": 5, "factors.adjust_m": 0.0}))
    plain = run(backend, stream_of(data_of(baseline_m=baseline_m)))
    assert all(estimate.covariance is None and estimate.view is None for estimate in plain)

    backend = Backend(backend.config)
    backend.extras = Extras(covariance=True, view=True)
    last = run(backend, stream_of(data_of(baseline_m=baseline_m)))[-1]
    assert last.view is not None and last.covariance is not None
    n = len(last.refined)
    assert (len(last.view.free), len(last.view.rms_px), last.covariance.shape) == (n, n, (n, 6, 6))
    assert int(last.view.free.sum()) == last.report.keyframes
    assert (last.covariance[~last.view.free] == 0.0).all()
    deviation = np.sqrt(np.diagonal(last.covariance[last.view.free], axis1=1, axis2=2))
    assert np.all((deviation > 1e-6) & (deviation < 1.0)), deviation
    assert 0.1 < np.median(last.view.rms_px) < 2.0
    assert len(last.view.links) > n - 1 and last.view.shared.min() > 0
    same = [
        getattr(plain[-1].refined, name).tobytes() == getattr(last.refined, name).tobytes() for name in ("position",)
    ]
    assert all(same), "what is looked at does not change"
