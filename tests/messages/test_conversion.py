# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import array
import dataclasses
import sys
from types import FrameType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ba_node.config import OutputConfig
from ba_node.estimate import Cloud, Estimate, Poses, Status
from ba_node.io.ros_types import decode
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    Keyframe,
    LandmarkGuesses,
    LandmarkPriors,
    Measurement,
    TrackMerge,
)
from ba_node.messages.conversion import input_message, measurement_from_message
from ba_node.messages.factory import ConversionError, stamp_ns_from_message
from ba_node.messages.outputs import POINT_DTYPE, output_messages
from ba_node.messages.report import Report, report_message
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_CODES = {np.dtype(c): c for c in "BbHhIiQqfd"}


class PlainFactory:
    """Messages as bare attributes, sequences as rclpy has them: array.array for sequences, ndarray for fixed ones."""

    def make(self, type_name: str, **fields: Any) -> Any:
        return SimpleNamespace(type_name=type_name, **fields)

    def array(self, values: NDArray[Any]) -> Any:
        return array.array(_CODES[values.dtype], values.tobytes())

    def fixed(self, values: NDArray[Any]) -> Any:
        return values


FACTORY = PlainFactory()


def assert_same(a: object, b: object) -> None:
    """Compare two dataclasses of arrays, NaN equal to NaN."""
    assert type(a) is type(b)
    for f in dataclasses.fields(a):  # type: ignore[arg-type]
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, tuple) and x and isinstance(x[0], np.ndarray):
            assert len(x) == len(y), f.name
            for left, right in zip(x, y, strict=True):
                np.testing.assert_array_equal(left, right, err_msg=f.name)
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, f"{f.name}: {x.dtype} against {y.dtype}"
            np.testing.assert_array_equal(x, y, err_msg=f.name)
        else:
            assert x == y, f.name


def test_measurements_survive_the_way_through_messages(
    keyframe: Keyframe, tracks: FeatureTracks, guesses: LandmarkGuesses, rig: CameraRig
) -> None:
    messages = {
        "keyframes": (keyframe, input_message(FACTORY, keyframe)[1]),
        "feature_tracks": (tracks, input_message(FACTORY, tracks, 5, "left_optical")[1]),
        "landmark_guesses": (guesses, input_message(FACTORY, guesses, 5, "map")[1]),
        "camera_rig": (rig, input_message(FACTORY, rig, 5)[1]),
    }
    for topic, (measurement, message) in messages.items():
        assert message.type_name == INPUT_TYPES[topic]
        assert_same(measurement, measurement_from_message(INPUT_TYPES[topic], message))
    assert messages["feature_tracks"][1].header.frame_id == "left_optical"
    assert not messages["keyframes"][1].pose.covariance.any()


def test_what_is_known_beside_pixels_survives_too(beside_pixels: list[Measurement]) -> None:
    seen = set()
    for measurement in beside_pixels:
        topic, message = input_message(FACTORY, measurement, 5, "base_link")
        assert message.type_name == INPUT_TYPES[topic]
        assert_same(measurement, measurement_from_message(INPUT_TYPES[topic], message))
        seen.add(topic)
    assert seen == {"relative_poses", "landmark_priors", "track_merges", "gravity", "pose_prior", "gnss"}


def test_a_covariance_of_a_keyframe_is_read_and_all_zero_is_unknown(keyframe: Keyframe) -> None:
    told = dataclasses.replace(keyframe, covariance=np.arange(36.0))
    for one in (keyframe, told):
        assert_same(one, measurement_from_message(INPUT_TYPES["keyframes"], input_message(FACTORY, one)[1]))


def test_arrays_of_priors_and_merges_that_do_not_fit_are_named(beside_pixels: list[Measurement]) -> None:
    _, priors = input_message(FACTORY, beside_pixels[1])
    priors.covariance = priors.covariance[:-1]
    found = measurement_from_message(INPUT_TYPES["landmark_priors"], priors)
    assert isinstance(found, LandmarkPriors)
    assert found.malformed.startswith("covariance has 17 entries, track_id 2: expected 9")
    _, merge = input_message(FACTORY, beside_pixels[2])
    merge.same_as = merge.same_as[:-1]
    found = measurement_from_message(INPUT_TYPES["track_merges"], merge)
    assert isinstance(found, TrackMerge)
    assert found.malformed.startswith("same_as has 1 entries, track_id 2")


def test_lone_camera_is_a_rig_of_one_at_the_origin(rig: CameraRig) -> None:
    info = input_message(FACTORY, rig, 0)[1].cameras[0]
    one = measurement_from_message("sensor_msgs/msg/CameraInfo", info)
    assert isinstance(one, CameraRig)
    assert (len(one), one.frame_id, one.names, one.models) == (1, "left_optical", ("left_optical",), ("plumb_bob",))
    np.testing.assert_array_equal(one.intrinsics, rig.intrinsics[:1])
    np.testing.assert_array_equal(one.position, np.zeros((1, 3)))
    np.testing.assert_array_equal(one.orientation, [[0.0, 0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(info.p, [700.1, 0, 320.3, 0, 0, 701.2, 240.4, 0, 0, 0, 1, 0])


@pytest.mark.parametrize(
    ("field", "length", "words"),
    [
        ("u", 10, "u has 10 entries, track_id 12"),
        ("v", 13, "v has 13 entries, track_id 12"),
        ("v", 0, "v has 0 entries, track_id 12"),
        ("sigma_px", 1, "sigma_px has 1 entries, track_id 12"),
        ("depth_m", 11, "depth_m has 11 entries, track_id 12"),
        ("track_id", 11, "u has 12 entries, track_id 11; v has 12 entries, track_id 11"),
    ],
)
def test_tracks_of_unequal_lengths_say_so(field: str, length: int, words: str) -> None:
    good = FeatureTracks(1, 2, 0, np.arange(12, dtype=np.uint64), np.zeros((12, 2)))
    message = input_message(FACTORY, good, 0, "c")[1]
    setattr(message, field, array.array("Q" if field == "track_id" else "f", [0] * length))
    tracks = measurement_from_message(INPUT_TYPES["feature_tracks"], message)
    assert isinstance(tracks, FeatureTracks)
    assert tracks.malformed == words
    assert tracks.uv.shape == (0, 2)
    assert (len(tracks.track_id), len(tracks.sigma_px), len(tracks.depth_m)) == (0, 0, 0)
    assert (tracks.session_id, tracks.keyframe_id) == (1, 2)


def test_guesses_of_unequal_lengths_say_so(guesses: LandmarkGuesses) -> None:
    message = input_message(FACTORY, guesses, 0, "map")[1]
    message.position = array.array("d", [0.0] * 5)
    found = measurement_from_message(INPUT_TYPES["landmark_guesses"], message)
    assert isinstance(found, LandmarkGuesses)
    assert found.malformed.startswith("position has 5 entries, track_id 2")
    assert found.position.shape == (0, 3)
    assert len(found.track_id) == 0


def malformed(message: Any) -> str:
    found = measurement_from_message(INPUT_TYPES["camera_rig"], message)
    assert isinstance(found, CameraRig)
    return found.malformed


def test_a_rig_that_cannot_be_used_says_so(rig: CameraRig) -> None:
    message = input_message(FACTORY, rig, 0)[1]
    message.body_from_camera.pop()
    assert malformed(message) == "cameras has 2 entries, body_from_camera 1: expected one pose for each camera"
    message = input_message(FACTORY, rig, 0)[1]
    message.cameras[1].k[1] = 0.5
    assert malformed(message).startswith("camera 1 ('right_optical'): skew k[1] = 0.5")


def test_a_type_that_is_no_input_is_named() -> None:
    with pytest.raises(ConversionError, match="'std_msgs/msg/String' is not an input"):
        measurement_from_message("std_msgs/msg/String", SimpleNamespace())


@given(arrays(np.uint64, st.integers(0, 5), elements=st.integers(0, 2**64 - 1)))
def test_ids_are_exact(ids: NDArray[np.uint64]) -> None:
    tracks = FeatureTracks(0, 0, 0, ids, np.zeros((len(ids), 2)))
    back = measurement_from_message(INPUT_TYPES["feature_tracks"], input_message(FACTORY, tracks, 0, "")[1])
    assert isinstance(back, FeatureTracks)
    assert back.track_id.tolist() == ids.tolist()


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_stamps_are_exact_and_nanoseconds_never_negative(stamp_ns: int) -> None:
    keyframe = Keyframe(0, 0, stamp_ns, "map", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    stamp = input_message(FACTORY, keyframe)[1].header.stamp
    assert 0 <= stamp.nanosec < 10**9
    assert stamp_ns_from_message(stamp) == stamp_ns


def test_a_stamp_beyond_the_message_is_an_error(keyframe: Keyframe) -> None:
    with pytest.raises(ConversionError, match="2147483648"):
        input_message(FACTORY, dataclasses.replace(keyframe, stamp_ns=2**31 * 10**9))[1]


def test_nothing_kept_shares_memory_with_the_message(tracks: FeatureTracks) -> None:
    message = input_message(FACTORY, tracks, 0, "c")[1]
    kept = measurement_from_message(INPUT_TYPES["feature_tracks"], message)
    assert isinstance(kept, FeatureTracks)
    message.track_id[0] = 99
    assert kept.track_id[0] == 0


def outputs(estimate: Estimate, config: OutputConfig, **options: Any) -> list[tuple[str, str, Any]]:
    """Return the messages, those that come serialised decoded."""
    found = output_messages(FACTORY, estimate, config, **options)
    return [(topic, kind, decode(kind, one) if isinstance(one, bytes) else one) for topic, kind, one in found]


def test_output_topics_types_and_stamps(estimate: Estimate) -> None:
    out = outputs(estimate, OutputConfig())
    assert [topic for topic, _, _ in out] == ["refined_keyframes", *["pose"] * 5, "report", "path", "points"]
    assert all(type_name == OUTPUT_TYPES[topic] for topic, type_name, message in out)
    assert {message.header.frame_id for _, _, message in out} == {"map"}
    stamps = [stamp_ns_from_message(message.header.stamp) for _, _, message in out]
    newest = estimate.stamp_ns
    assert stamps == [newest, *estimate.refined.stamp_ns.tolist(), newest, newest, newest]


def test_output_poses_are_those_of_the_estimate(estimate: Estimate) -> None:
    out = outputs(estimate, OutputConfig())
    refined = out[0][2]
    assert refined.session_id == 3
    assert list(refined.keyframe_id) == estimate.refined.keyframe_id.tolist()
    assert list(refined.stamp_ns) == estimate.refined.stamp_ns.tolist()
    assert list(refined.position) == estimate.refined.position.ravel().tolist()
    assert list(refined.orientation) == estimate.refined.orientation.ravel().tolist()
    singles = [message.pose for topic, _, message in out if topic == "pose"]
    np.testing.assert_array_equal(
        [[p.position.x, p.position.y, p.position.z] for p in singles], estimate.refined.position
    )
    q = [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in singles]
    np.testing.assert_array_equal(q, estimate.refined.orientation)


def test_path_keeps_the_newest(estimate: Estimate) -> None:
    out = outputs(estimate, OutputConfig(path_max_poses=4), wanted={"path"})
    assert [topic for topic, _, _ in out] == ["path"]
    poses = out[0][2].poses
    assert [stamp_ns_from_message(p.header.stamp) for p in poses] == estimate.trajectory.stamp_ns[-4:].tolist()
    assert [p.header.frame_id for p in poses] == ["map"] * 4


def test_points_are_laid_out_as_their_fields_say(estimate: Estimate) -> None:
    ((_, _, cloud),) = outputs(estimate, OutputConfig(), wanted=["points"])
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("rms_px", 12, 7, 1), ("views", 16, 6, 1),
    ]  # fmt: skip
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, 100, 20, 2000)
    assert (cloud.is_bigendian, cloud.is_dense) == (False, True)
    records = np.frombuffer(cloud.data, dtype=POINT_DTYPE)
    for column, name in enumerate("xyz"):
        np.testing.assert_array_equal(records[name], estimate.cloud.position[:, column].astype(np.float32))
    np.testing.assert_array_equal(records["rms_px"], estimate.cloud.rms_px)
    np.testing.assert_array_equal(records["views"], estimate.cloud.views)


@pytest.mark.parametrize("limit", [1, 7, 99, 100, 101])
def test_points_are_thinned_evenly(estimate: Estimate, limit: int) -> None:
    ((_, _, cloud),) = outputs(estimate, OutputConfig(points_max=limit), wanted={"points"})
    kept = np.frombuffer(cloud.data, dtype=POINT_DTYPE)["x"]
    rows = np.flatnonzero(np.isin(estimate.cloud.position[:, 0].astype(np.float32), kept))
    assert cloud.width == len(rows) == min(limit, 100)
    if limit > 1:
        assert np.ptp(np.diff(rows)) <= 1, f"gaps between kept points differ by more than one: {np.diff(rows)}"


def test_points_beyond_single_precision_are_not_called_dense(estimate: Estimate) -> None:
    far = dataclasses.replace(estimate.cloud, position=np.full((100, 3), 1e300))
    ((_, _, cloud),) = outputs(dataclasses.replace(estimate, cloud=far), OutputConfig(), wanted={"points"})
    assert cloud.is_dense is False


def test_report_carries_every_field(whole_report: Report) -> None:
    message = report_message(FACTORY, whole_report, 5, "map")
    values = vars(whole_report.latency) | vars(whole_report.queue) | vars(whole_report.solve)
    del values["rejected"]
    values["warnings"] = ["baseline of camera 1 reversed", "falling behind"]
    assert len({(type(v), str(v)) for v in values.values()}) >= len(values) - 2, "values too alike to tell fields apart"
    for name, value in values.items():
        assert getattr(message, name) == value, name
    assert type(message.status) is int
    assert message.rejected_reason == ["malformed", "unknown_camera", "unreadable"]
    assert list(message.rejected_count) == [5, 2, 4]
    assert vars(message).keys() == values.keys() | {"type_name", "header", "rejected_reason", "rejected_count"}


@pytest.mark.parametrize("status", [Status.FAILED, Status.SKIPPED])
def test_a_failed_solve_gives_the_report_only(estimate: Estimate, status: Status) -> None:
    failed = dataclasses.replace(estimate, report=dataclasses.replace(estimate.report, status=status))
    out = outputs(failed, OutputConfig())
    assert [topic for topic, _, _ in out] == ["report"]
    assert out[0][2].status == status


def test_a_held_solve_gives_the_map_as_it_stands(estimate: Estimate) -> None:
    held = dataclasses.replace(estimate, report=dataclasses.replace(estimate.report, status=Status.HELD))
    assert [topic for topic, _, _ in outputs(held, OutputConfig())] == ["report", "path", "points"]


def test_an_empty_map_makes_empty_messages(estimate: Estimate) -> None:
    none = Poses(np.empty(0, np.uint64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 4)))
    cloud = Cloud(np.empty(0, np.uint64), np.empty((0, 3)), np.empty(0, np.float32), np.empty(0, np.int32))
    empty = dataclasses.replace(estimate, refined=none, trajectory=none, cloud=cloud)
    out = {topic: message for topic, _, message in outputs(empty, OutputConfig())}
    assert (len(out["refined_keyframes"].keyframe_id), out["path"].poses) == (0, [])
    assert (out["points"].width, len(out["points"].data), out["points"].is_dense) == (0, 0, True)
    assert "pose" not in out


def lines_run(action: Callable[[], object]) -> int:
    """Return how many lines of Python an action runs."""
    count = 0

    def trace(_frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    finally:
        sys.settrace(before)
    return count


def test_conversion_does_not_loop_over_elements(estimate: Estimate) -> None:
    def take(n: int) -> int:
        tracks = FeatureTracks(0, 0, 0, np.arange(n, dtype=np.uint64), np.zeros((n, 2)), np.ones(n), np.ones(n))
        message = input_message(FACTORY, tracks, 0, "c")[1]
        return lines_run(lambda: measurement_from_message(INPUT_TYPES["feature_tracks"], message))

    def give(n: int) -> int:
        cloud = Cloud(np.arange(n, dtype=np.uint64), np.zeros((n, 3)), np.zeros(n, np.float32), np.zeros(n, np.int32))
        large = dataclasses.replace(estimate, cloud=cloud)
        return lines_run(lambda: output_messages(FACTORY, large, OutputConfig(), wanted={"points"}))

    for work in (take, give):
        work(10)
        assert work(10_000) == work(10) > 0
