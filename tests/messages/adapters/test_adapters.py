# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The traps of the front-ends that exist, each met by the core that live and offline share."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.core.geometry import matrix_from_quaternion
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages.adapters import SOURCES, Adapter, AdapterOptions, adapter
from tests.messages.adapters import layouts
from tests.messages.adapters.layouts import Sent

NAMES = sorted(SOURCES)


def feed(source: str, messages: Iterable[Sent], options: AdapterOptions | None = None, cameras: int = 1) -> Any:
    """Return adapter and measurements of some messages, taken by the last parts of their topics' names."""
    made = Adapter(SOURCES[source](cameras), options or AdapterOptions())
    names = {one.name for one in SOURCES[source].inputs}
    out: list[Measurement] = []
    for sent in messages:
        name = sent.topic.rpartition("/")[2]
        if name in names:
            out += [measurement for _, _, measurement in made.take(name, sent.message)]
    return made, out


def of(kind: type[Any], measurements: Iterable[Measurement]) -> list[Any]:
    return [one for one in measurements if isinstance(one, kind)]


def scene_of(source: str) -> Any:
    return layouts.scene(12, "none" if source.startswith("rtabmap") else "plumb_bob")


@pytest.mark.parametrize("source", NAMES)
def test_each_source_becomes_rig_keyframes_and_tracks(source: str) -> None:
    """Pixels, ids, poses and extrinsics are those that the scene has; the rig comes first."""
    data = scene_of(source)
    made, out = feed(source, getattr(layouts, source)(data))
    assert isinstance(out[0], CameraRig)
    keyframes, tracks = of(Keyframe, out), of(FeatureTracks, out)
    assert len(keyframes) == len(tracks) == made.sent >= 5
    truth = {
        keyframe.stamp_ns: (keyframe, images[0]) for keyframe, images in zip(data.keyframes, data.tracks, strict=True)
    }
    shift = 1 if source.startswith("rtabmap") else 0
    for keyframe, image in zip(keyframes, tracks, strict=True):
        # rtabmap_map has its stamps in a double, good for 120 ns
        stamp = min(truth, key=lambda one: abs(one - keyframe.stamp_ns))
        assert abs(stamp - keyframe.stamp_ns) <= 240
        expected, seen = truth[stamp]
        assert np.allclose(keyframe.position, expected.position, atol=1e-12)
        assert image.keyframe_id == keyframe.keyframe_id
        uv = dict(zip(seen.track_id.tolist(), seen.uv, strict=True))
        if source in ("openvins", "rtabmap", "rtabmap_map"):
            found = np.array([uv[int(track) - shift] for track in image.track_id])
            assert np.abs(found - image.uv).max() < 1e-3
        assert len(image.track_id) >= len(uv) - 1
    assert np.allclose(out[0].position[0], data.rig.position[0])
    assert np.allclose(np.abs(np.dot(out[0].orientation[0], data.rig.orientation[0])), 1.0)


@pytest.mark.parametrize("source", ["openvins", "vins_fusion", "rtabmap", "rtabmap_map"])
def test_points_become_guesses_once(source: str) -> None:
    data = scene_of(source)
    _, out = feed(source, getattr(layouts, source)(data))
    guesses = of(LandmarkGuesses, out)
    ids = np.concatenate([one.track_id for one in guesses])
    assert len(np.unique(ids)) == len(ids) > 100
    place = dict(zip(data.track_id.tolist(), data.track_landmark.tolist(), strict=True))
    shift = 1 if source.startswith("rtabmap") else 0
    truth = data.landmarks[[place[int(track) - shift] for track in ids]]
    assert np.abs(np.concatenate([one.position for one in guesses]) - truth).max() < 1e-3


def test_a_point_that_camera_0_did_not_see_is_dropped() -> None:
    made, out = feed("openvins", layouts.openvins(layouts.scene()))
    assert made.counted["not_seen_by_camera_0"] == 3 * 12
    assert not any((tracks.track_id >= 90000).any() for tracks in of(FeatureTracks, out))
    # Nor is its point a guess.
    assert not any((guesses.track_id >= 90000).any() for guesses in of(LandmarkGuesses, out))


@pytest.mark.parametrize("source", ["openvins", "vins_fusion"])
def test_ids_that_float32_does_not_hold_exactly_are_dropped_and_counted(source: str) -> None:
    messages = list(getattr(layouts, source)(layouts.scene(4)))
    for sent in messages:
        if sent.type_name == layouts.CLOUD:
            sent.message.channels[-1].values[4] = np.float32(2**24 + 1)  # becomes 2^24
            sent.message.channels[-2].values[4] = np.float32(0.5)
    made, out = feed(source, messages)
    clouds = sum(sent.type_name == layouts.CLOUD for sent in messages)
    assert made.counted["inexact_id"] == 2 * clouds
    assert max(int(tracks.track_id.max()) for tracks in of(FeatureTracks, out)) < 2**24


@pytest.mark.parametrize(("apart_ns", "sent"), [(0, 9), (120, 9), (999_999, 9), (1_100_000, 0)])
def test_stamps_pair_within_a_tolerance(apart_ns: int, sent: int) -> None:
    made, _ = feed("vins_fusion", layouts.vins_fusion(layouts.scene(), apart_ns=apart_ns))
    assert made.sent == sent
    made.finish()
    assert made.counted["no_pose"] == made.counted["no_features"] == 9 - sent


def test_late_keyframes_find_the_cloud_of_their_image() -> None:
    data = layouts.scene()
    made, out = feed("vins_mono", layouts.vins_mono(data))
    assert made.sent == 5
    assert [one.keyframe_id for one in of(Keyframe, out)] == [one.stamp_ns for one in data.keyframes[:9:2]]


def test_a_source_without_camera_info_gets_a_camera_of_its_normalised_points() -> None:
    """Its pixels are undistorted: rays through it are those of the source to the float32 that these are."""
    data = layouts.scene()
    made, out = feed("vins_fusion", layouts.vins_fusion(data))
    rig = out[0]
    assert isinstance(rig, CameraRig) and rig.models == ("",)
    assert np.allclose(rig.intrinsics[0, :2], data.rig.intrinsics[0, :2], rtol=0.2)
    tracks = of(FeatureTracks, out)[0]
    rays = (tracks.uv - rig.intrinsics[0, 2:]) / rig.intrinsics[0, :2]
    assert np.abs(rays - layouts.normalised(data, data.tracks[0][0])).max() < 1e-6
    assert "no camera_info" in made.notes["camera"]


def test_with_camera_info_the_pixels_are_raw() -> None:
    data = layouts.scene()
    info = layouts.camera_info(data.rig, 0, 0, "cam0")
    messages = [Sent("/camera_info", layouts.CAMERA_INFO, info, 0), *layouts.vins_fusion(data)]
    made, out = feed("vins_fusion", messages)
    assert np.allclose(out[0].intrinsics, data.rig.intrinsics[:1])
    assert np.allclose(out[0].distortion[0], data.rig.distortion[0])
    assert np.abs(of(FeatureTracks, out)[0].uv - data.tracks[0][0].uv).max() < 1e-3
    assert "camera" not in made.notes


def test_a_camera_info_of_another_camera_is_not_taken() -> None:
    data = layouts.scene()
    info = layouts.camera_info(data.rig, 0, 0, "cam0")
    info.k[0] *= 1.1
    made, out = feed("vins_fusion", [Sent("/camera_info", layouts.CAMERA_INFO, info, 0), *layouts.vins_fusion(data)])
    assert out[0].models == ("",) and made.sent == 9
    assert "camera_info is of another camera" in made.notes["camera"]


def test_ids_of_vins_mono_tell_the_camera() -> None:
    data = layouts.scene()
    rig = AdapterOptions(rig=data.rig)
    made, out = feed("vins_mono", layouts.vins_mono(data, cameras=2), rig, cameras=2)
    first, second = of(FeatureTracks, out)[:2]
    assert (first.camera_index, second.camera_index) == (0, 1)
    for found, expected in ((first, data.tracks[0][0]), (second, data.tracks[0][1])):
        assert found.track_id.tolist() == expected.track_id.tolist()
        assert np.abs(found.uv - expected.uv).max() < 1e-3
    assert not made.counted


def test_every_image_is_no_keyframe() -> None:
    """Of 40 images over 10 m some are taken: where tracks have moved enough, or many are new."""
    data = layouts.scene(40, keyframe_rate_hz=20.0)
    made, _ = feed("openvins", layouts.openvins(data))
    assert made.images == 40
    assert 10 <= made.sent <= 30, made.sent
    every, _ = feed("openvins", layouts.openvins(data), AdapterOptions(parallax_deg=0.0))
    assert every.sent == 40
    few, _ = feed("openvins", layouts.openvins(data), AdapterOptions(parallax_deg=90.0, new_share=0.5))
    assert 2 <= few.sent < made.sent
    stands = [dataclasses.replace(one, position=data.keyframes[0].position) for one in data.keyframes]
    still = dataclasses.replace(data, keyframes=tuple(stands), tracks=(data.tracks[0],) * 40)
    assert feed("openvins", layouts.openvins(still))[0].sent == 1
    # VINS-Fusion sends keyframes alone: all are taken.
    assert feed("vins_fusion", layouts.vins_fusion(still))[0].sent == 37


def test_a_calibration_that_moves_is_said_once_it_was_sent() -> None:
    messages = list(layouts.openvins(layouts.scene(6)))
    intrinsics = [sent for sent in messages if sent.topic.endswith("intrinsics")]
    intrinsics[-1].message.k[0] *= 1.02
    made, out = feed("openvins", messages)
    assert len(of(CameraRig, out)) == 1
    assert made.counted["calibration_moved"] >= 1


def test_words_of_rtabmap_count_only_in_the_local_map_and_as_inliers() -> None:
    data = scene_of("rtabmap")
    made, _ = feed("rtabmap", layouts.rtabmap(data))
    assert made.counted == {"not_in_the_local_map": 5 * 12, "outlier_of_the_source": 12}
    # The fields that only local bundle adjustment fills.
    with_rig, _ = feed("rtabmap", layouts.rtabmap(data, bundle=False), AdapterOptions(rig=data.rig))
    assert with_rig.sent == made.sent
    without, nothing = feed("rtabmap", layouts.rtabmap(data, bundle=False))
    assert (without.sent, nothing, without.waits_for_rig) == (0, [], True)


@pytest.mark.parametrize(
    ("change", "reason", "words"),
    [
        ({"words_keys": np.zeros(0, np.int32), "words_values": []}, "no_words", "Odom/FillInfoData"),
        ({"words_keys": np.zeros(0, np.int32), "words_values": [], "type": 1}, "no_words", "Odom/Strategy 0"),
        ({"lost": True}, "lost", "lost"),
        ({"words_values": []}, "malformed", "words_keys and 0 words_values"),
        ({"local_map_values": []}, "malformed", "local_map_keys and 0 local_map_values"),
    ],
)
def test_what_rtabmap_leaves_out_is_said(change: dict[str, Any], reason: str, words: str) -> None:
    messages = list(layouts.rtabmap(scene_of("rtabmap")))[:2]
    for name, value in change.items():
        setattr(messages[1].message, name, value)
    made, out = feed("rtabmap", messages)
    assert made.counted[reason] >= 1 and made.sent == 0
    assert words in made.notes[reason]
    assert any(reason in line for line in made.told())
    assert not of(Keyframe, out)


def test_fields_of_rtabmap_that_may_be_empty() -> None:
    """Without the local map or matches, inliers alone count; without these too, all words do."""
    data = scene_of("rtabmap")
    n = len(data.tracks[0][0].track_id)
    empty, none = np.zeros(0, np.int32), {"local_map_keys": np.zeros(0, np.int32), "local_map_values": []}
    for change, count in (
        (none, n - 1 + 5),
        ({**none, "word_matches": empty}, n - 1),
        ({"word_matches": empty}, n - 1),
        ({**none, "word_matches": empty, "word_inliers": empty}, n + 5),
    ):
        messages = list(layouts.rtabmap(data))[:2]
        for name, value in change.items():
            setattr(messages[1].message, name, value)
        _, out = feed("rtabmap", messages)
        assert len(of(FeatureTracks, out)[0].track_id) == count, change
        assert bool(of(LandmarkGuesses, out)) == ("local_map_keys" not in change)
    thin = list(layouts.rtabmap(data))[:2]
    fields = ("header", "words_keys", "words_values", "word_inliers", "local_bundle_models")
    thin[1] = thin[1]._replace(message=SimpleNamespace(**{name: getattr(thin[1].message, name) for name in fields}))
    assert feed("rtabmap", thin)[0].sent == 1


def test_a_reset_of_rtabmap_begins_a_session() -> None:
    first, second = (list(layouts.rtabmap(scene_of("rtabmap"))) for _ in range(2))
    later = 10**10
    for sent in second:
        sent.message.header.stamp.sec += later // 10**9
    second[0].message.pose.covariance[0] = 9999.0
    _, out = feed("rtabmap", [*first, *second])
    assert [one.session_id for one in of(Keyframe, out)] == [0] * 12 + [1] * 12


def test_odometry_that_was_lost_for_a_while_goes_on_with_its_session() -> None:
    messages = list(layouts.rtabmap(scene_of("rtabmap")))
    for sent in messages[8:12]:
        if sent.type_name == layouts.ODOMETRY:
            sent.message.pose.pose.orientation.w = sent.message.pose.pose.orientation.x = 0.0
            sent.message.pose.pose.orientation.y = sent.message.pose.pose.orientation.z = 0.0
            sent.message.pose.covariance[0] = 9999.0
        else:
            sent.message.lost = True
    made, out = feed("rtabmap", messages)
    assert {one.session_id for one in of(Keyframe, out)} == {0} and made.sent == 10
    assert made.counted["lost"] == 4


def test_images_of_several_cameras_side_by_side_are_told_apart() -> None:
    messages = list(layouts.rtabmap(scene_of("rtabmap")))[:2]
    info = messages[1].message
    info.local_bundle_models[0].models *= 2
    for keypoint in info.words_values[::2]:
        keypoint.pt.x += 640.0
    _, out = feed("rtabmap", messages)
    tracks = of(FeatureTracks, out)
    assert [one.camera_index for one in tracks] == [0, 1]
    assert all(one.uv[:, 0].max() < 640 for one in tracks)


def test_nodes_of_rtabmap_keep_their_ids_and_depths() -> None:
    data = scene_of("rtabmap_map")
    made, out = feed("rtabmap_map", layouts.rtabmap_map(data))
    assert [one.keyframe_id for one in of(Keyframe, out)] == list(range(7, 19))
    assert made.counted == {"no_word": 12, "ambiguous_word": 24, "repeated_keyframe": 11}
    tracks = of(FeatureTracks, out)[0]
    keyframe = data.keyframes[0]
    rig = data.rig
    body = (layouts.points(data, data.tracks[0][0]) - keyframe.position) @ matrix_from_quaternion(keyframe.orientation)
    depth = ((body - rig.position[0]) @ matrix_from_quaternion(rig.orientation[0]))[:, 2]
    expected = dict(zip(data.tracks[0][0].track_id.tolist(), depth, strict=True))
    assert np.abs(tracks.depth_m - [expected[int(i) - 1] for i in tracks.track_id]).max() < 1e-3


def test_a_layout_of_another_source_is_named() -> None:
    mono, fusion = list(layouts.vins_mono(layouts.scene(4))), list(layouts.vins_fusion(layouts.scene(6)))
    cloud = next(sent.message for sent in mono if sent.type_name == layouts.CLOUD)
    made, _ = feed("vins_fusion", [Sent("/keyframe_point", layouts.CLOUD, cloud, 0)])
    assert made.counted == {"malformed": 1} and "--from vins_mono" in made.notes["malformed"]
    cloud = next(sent.message for sent in fusion if sent.type_name == layouts.CLOUD)
    made, _ = feed("vins_mono", [Sent("/feature", layouts.CLOUD, cloud, 0)])
    assert made.counted == {"malformed": 1} and "--from vins_fusion" in made.notes["malformed"]


def test_a_source_that_starts_again_begins_a_session() -> None:
    data = layouts.scene()
    messages = list(layouts.vins_fusion(data))
    made, out = feed("vins_fusion", messages + messages)
    assert [one.session_id for one in of(Keyframe, out)] == [0] * 9 + [1] * 9
    made.restart()
    assert made.summary() == "18 keyframes of 18 images in 3 sessions"


def test_what_waits_is_bounded_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "MAX_WAITING", 3)
    clouds = [sent for sent in layouts.openvins(layouts.scene(12)) if sent.type_name == layouts.CLOUD]
    made, _ = feed("openvins", clouds)
    assert made.counted["no_pose"] == 12 - 3
    assert made.notes["no_pose"].startswith("none came")
    made, _ = feed("rtabmap", layouts.rtabmap(scene_of("rtabmap"), bundle=False))
    assert made.counted["no_rig"] == 12 - 3 and "--rig FILE" in made.notes["no_rig"]


@pytest.mark.parametrize("source", NAMES)
def test_broken_messages_are_counted(source: str) -> None:
    made = Adapter(SOURCES[source](1), AdapterOptions())
    for one in SOURCES[source].inputs:
        assert list(made.take(one.name, object())) == []
    assert set(made.counted) == {"malformed"}
