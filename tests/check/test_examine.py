# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Each mistake is named when it is made, and none when the set-up is sound."""

from __future__ import annotations

import dataclasses
import json
import re
from typing import Any

import numpy as np
import pytest

from ba_node.check import units
from ba_node.check.examine import examine
from ba_node.check.ids import check_ids
from ba_node.check.tracks import Tracks, tracks_of
from ba_node.config import Config
from ba_node.measurements import CameraRig, FeatureTracks
from ba_node.scene.scene import Scene
from experiments.robustness.faults import spoiled
from experiments.robustness.faults.surround import third
from experiments.synthetic import SyntheticOptions, generate
from experiments.synthetic.world import Path, World
from tests.check.named import CASES, NAMED
from tests.check.set_ups import images, intrinsics, poses, recording, seen, tracks_in
from tests.window.street import round_trip


@pytest.mark.parametrize(("wrong", "mode"), CASES)
def test_mistake_is_named(wrong: str, mode: str) -> None:
    found = examine(seen(recording(wrong=wrong, mode=mode)))
    assert re.search(NAMED[wrong][1], found.causes()), found.summary()
    assert found.harmful == (
        wrong not in ("slots", "ids modulo 200", "rows for ids") and not wrong.startswith(("stamps", "sigma"))
    )
    assert all(finding.changes for finding in found.findings)


@pytest.mark.parametrize(
    ("wrong", "named"), [("depth times 6", "depth_m in another unit"), ("poses over 6", "poses in another unit")]
)
def test_two_cameras_tell_whether_depths_or_poses_are_off(wrong: str, named: str) -> None:
    """Neither a depth nor a speed is absurd; with one camera both are named."""
    alone = examine(seen(recording(wrong=wrong, mode="rgbd", look_deg=90.0)))
    assert {"depth_m", "poses"} <= {cause.split()[0] for cause in alone.findings[0].causes}, alone.summary()
    found = examine(seen(recording(wrong=wrong, depth_share=0.8, look_deg=90.0)))
    assert found.causes().startswith(named), found.summary()
    assert ("poses" in found.causes()) == (named[:5] == "poses"), found.summary()


@pytest.mark.parametrize(("path", "x", "y"), [("loop", 160.0, 100.0), ("loop", 80.0, 120.0), ("line", 160.0, 100.0)])
def test_a_region_of_all_cameras_is_no_camera_off_its_place(path: str, x: float, y: float) -> None:
    """Where a lens bends rays, those of two cameras do not meet with another principal point."""
    data = recording(path=path, distortion="equidistant", fov_deg=120.0)
    found = examine(seen(intrinsics(lambda k: np.add(k, [0.0, 0.0, x, y]))(data), 25))
    assert re.match("region of interest not applied", found.causes()), found.summary()
    assert "camera 1" not in found.causes(), found.summary()
    assert not examine(seen(data, 25)).findings


@pytest.mark.parametrize("share", [0.03, 0.02])
def test_few_points_with_a_depth_tell_another_unit(share: float) -> None:
    """Most are out of reach of a sensor, and no two images share enough of the others."""
    rng = np.random.default_rng(1)

    def change(one: FeatureTracks) -> FeatureTracks:
        return dataclasses.replace(
            one, depth_m=np.where(rng.random(len(one.depth_m)) < share, 1000.0 * one.depth_m, np.nan)
        )

    found = examine(seen(images(change)(recording(mode="rgbd"))))
    assert found.causes().startswith("depth_m in millimetres"), found.summary()


def test_a_speed_that_nothing_has_is_said_where_images_have_no_scale() -> None:
    found = examine(seen(recording(wrong="poses in mm", mode="mono")))
    assert found.causes().startswith("poses in another unit than metres") and not found.harmful, found.summary()


@pytest.mark.parametrize("keyframes", [10, 25])
def test_cameras_that_are_tracked_one_by_one_are_no_mistake(keyframes: int) -> None:
    found = examine(seen(recording(wrong="other ids of each camera"), keyframes))
    assert found.findings == [] and found.notices == ["no_shared_track"], found.summary()
    assert any("cameras 0 and 1 share no track" in text for text in found.sound), found.summary()


def test_two_cameras_without_a_common_track_are_named_where_the_steps_tell_no_scale() -> None:
    still = poses(lambda rotation, position, _: (rotation, np.repeat(position[:1], len(position), axis=0)))
    found = examine(seen(still(recording(wrong="other ids of each camera"))))
    assert "cameras 0 and 1 share no track, though they look at the same" in found.causes(), found.summary()
    assert found.notices == []


@pytest.mark.parametrize("mode", ["stereo", "mono"])
def test_cameras_that_look_aside_on_a_straight_way_are_not_taken_for_mirrored_images(mode: str) -> None:
    drift = {"drift_rotation_deg": 0.3, "drift_translation": 0.02, "look_deg": 20.0}
    found = examine(seen(recording(2, "yaw 20 of the wrong sign", mode, path="line", **drift)))
    assert re.match(r"camera 0 does not fit its place on the body by about (3\d|4[0-4]) degrees", found.causes()), (
        found.summary()
    )


@pytest.mark.parametrize("path", ["line", "loop"])
def test_mirrored_images_of_a_camera_that_looks_aside_are_no_inverted_poses(path: str) -> None:
    drift = {"drift_rotation_deg": 0.3, "drift_translation": 0.02, "look_deg": 90.0}
    found = examine(seen(recording(2, "mirrored", "mono", path=path, **drift)))
    assert found.causes() == "images mirrored: left and right are exchanged", found.summary()


@pytest.mark.parametrize("look_deg", [0.0, 90.0, 45.0])
def test_noise_of_depths_is_no_other_kind_of_depth(look_deg: float) -> None:
    """A wall at one distance, and depths that scatter by more than what there is to see."""
    for wrong in ("", "depth of other points"):
        data = recording(5, wrong, "rgbd", path="line", look_deg=look_deg, depth_noise=0.1, drift_rotation_deg=0.3)
        found = examine(seen(data))
        assert bool(found.findings) == bool(wrong), found.summary()
    assert "depth_m is of other points" in found.causes(), found.summary()


@pytest.mark.parametrize(("order", "named"), [([2, 0, 1], "1, 2, 0"), ([0, 2, 1], "cameras 2 and 1 swapped")])
def test_three_cameras_in_another_order_are_named(order: list[int], named: str) -> None:
    def change(rig: CameraRig) -> CameraRig:
        return dataclasses.replace(rig, position=rig.position[order], orientation=rig.orientation[order])

    tracks = tracks_in(third(spoiled("sound", "stereo")).changed(CameraRig, change).measurements)
    found = examine(tracks)
    assert named in found.findings[0].causes[0], found.summary()


def test_turns_among_many_outliers_tell_no_delay() -> None:
    drift = {"drift_rotation_deg": 1.0, "drift_translation": 0.06, "outlier_share": 0.3, "noise_px": 1.0}
    path = {"path": "loop", "length_m": 30.0, "keyframes": 60, "look_deg": 90.0}
    sent = spoiled("sound", "mono", seed=281, **drift, **path)  # type: ignore[arg-type]
    ids = {keyframe.keyframe_id for keyframe in sent.keyframes[:40]}
    tracks = tracks_in(
        one for one in sent.measurements if isinstance(one, CameraRig) or getattr(one, "keyframe_id", None) in ids
    )
    assert not examine(tracks).findings


def test_poses_that_stand_still_with_the_camera_are_no_mistake() -> None:
    """Nothing is said of poses that are all the same until many keyframes see the camera move."""
    found = examine(seen(recording(wrong="no positions"), keyframes=10))
    assert not found.findings, found.summary()


@pytest.mark.parametrize("wrong", ["baseline reversed", "extrinsics inverted", "axes missing"])
def test_two_cameras_tell_after_three_keyframes(wrong: str) -> None:
    found = examine(seen(recording(wrong=wrong), keyframes=3))
    assert re.search(NAMED[wrong][1], found.causes()), found.summary()


@pytest.mark.parametrize("wrong", ["poses inverted", "camera from world", "poses of camera"])
def test_one_camera_tells_after_ten_keyframes(wrong: str) -> None:
    found = examine(seen(recording(wrong=wrong, mode="mono"), keyframes=10))
    assert re.search(NAMED[wrong][1], found.causes()), found.summary()


@pytest.mark.parametrize("wrong", ["axes missing", "extrinsics inverted"])
def test_one_camera_tells_after_five_keyframes_what_is_plain(wrong: str) -> None:
    found = examine(seen(recording(wrong=wrong, mode="mono", path="line"), keyframes=5))
    assert "axes confused" in found.causes(), found.summary()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"path": "line"},
        {"mode": "mono"},
        {"mode": "mono", "path": "line"},
        {"mode": "rgbd"},
        {"outlier_share": 0.3},
        {"mode": "mono", "outlier_share": 0.3},
        {"drift_rotation_deg": 3.0, "drift_translation": 0.1},
        {"path": "line", "look_deg": 90.0},
        {"mode": "mono", "distortion": "plumb_bob"},
        {"distortion": "equidistant", "fov_deg": 130.0},
        {"noise_px": 0.0, "outlier_share": 0.0},
        {"mode": "mono", "send_sigma": False, "noise_px": 1.5},
        {"tracks": 30},
        {"ids": "random64"},
    ],
    ids=str,
)
@pytest.mark.parametrize("keyframes", [6, 15, 60])
def test_silent_when_sound(options: dict[str, object], keyframes: int) -> None:
    found = examine(seen(recording(**options), keyframes))  # type: ignore[arg-type]
    assert not found.findings, found.summary()
    assert found.sound, found.untold


def test_ids_are_told_where_images_end_before_the_keyframes_do() -> None:
    tracks = seen(recording())
    rows = np.flatnonzero(tracks.keyframe < len(tracks) // 2)
    parts = {name: getattr(tracks, name)[rows] for name in ("keyframe", "camera", "track", "uv", "sigma_px", "depth_m")}
    found = check_ids(dataclasses.replace(tracks, **parts))
    assert found.sound == ["tracks keep their ids"], found.summary()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["stereo", "mono", "rgbd"])
@pytest.mark.parametrize("seed", range(20))
def test_silent_on_every_seed(seed: int, mode: str) -> None:
    for path in ("loop", "line"):
        data = recording(seed, mode=mode, path=path)
        for keyframes in (10, 25, 60):
            found = examine(seen(data, keyframes))
            assert not found.findings, f"{path}, {keyframes} keyframes: {found.summary()}"


@pytest.mark.slow
@pytest.mark.parametrize("keyframes", [25, 40, 60])
def test_a_wall_beside_the_way_is_no_contradiction(keyframes: int) -> None:
    """Two relations explain the images of a plane; the steps of one of them are 50 degrees off."""
    drift = {"drift_rotation_deg": 0.3, "drift_translation": 0.01, "outlier_share": 0.01}
    data = recording(2, mode="mono", path="line", length_m=52.0, look_deg=-60.0, **drift)  # type: ignore[arg-type]
    assert not examine(seen(data, keyframes)).findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "keyframes", "options"),
    [
        (143, 25, {"landmarks": 5000, "drift_rotation_deg": 0.8, "track_loss": 0.15}),
        (170, 40, {"landmarks": 1500, "drift_translation": 0.06, "tracks": 200, "fov_deg": 60.0, "keyframes": 45}),
    ],
)
def test_ids_are_not_told_by_the_other_relation_of_a_plane(
    seed: int, keyframes: int, options: dict[str, object]
) -> None:
    """Images far apart that see a wall seemed to agree on half of their tracks: by the wrong one of two relations."""
    usual = {"path": "line", "length_m": 10.0, "look_deg": -90.0, "noise_px": 0.3, "outlier_share": 0.01, "tracks": 120}
    drift = {"drift_rotation_deg": 0.3, "drift_translation": 0.02}
    data = recording(seed, mode="mono", **(usual | drift | options))  # type: ignore[arg-type]
    found = examine(seen(data, keyframes))
    assert not found.findings, found.summary()


def over_a_floor(_world: World, path: Path) -> tuple[World, Path]:
    rng, n = np.random.default_rng(6), 12_000
    points = np.zeros((n, 3))
    points[:, :2] = rng.uniform(path.position.min(axis=0)[:2] - 15.0, path.position.max(axis=0)[:2] + 15.0, (n, 2))
    return World(points, np.tile([0.0, 0.0, 1.0], (n, 1)), np.full((1, 2, 3), -1e4)), path


@pytest.mark.slow
@pytest.mark.parametrize("keyframes", [25, 40, 60])
def test_a_floor_does_not_tell_a_wrong_baseline(keyframes: int) -> None:
    """By the wrong one of two relations the baseline seemed to be 1.4 times what the steps tell."""
    options = SyntheticOptions(
        seed=123, keyframes=60, path="line", length_m=18.0, look_deg=-45.0, tracks=200, noise_px=0.3,
        outlier_share=0.1, drift_rotation_deg=0.05, drift_translation=0.06,
    )  # fmt: skip
    found = examine(seen(generate(options, over_a_floor), keyframes))
    assert not found.findings, found.summary()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (1010, {"keyframes": 45, "length_m": 22.5, "look_deg": 60.0, "noise_px": 0.5, "tracks": 200}),
        (118, {"keyframes": 30, "length_m": 10.0, "distortion": "equidistant", "noise_px": 0.3, "tracks": 120}),
    ],
)
def test_points_at_the_limit_of_two_cameras_do_not_shorten_the_baseline(seed: int, options: dict[str, Any]) -> None:
    """Those that noise brought nearer were taken alone: the baseline seemed to be 6 % too short."""
    drift: dict[str, Any] = {"drift_rotation_deg": 0.05, "drift_translation": 0.02}
    data = recording(seed, path="line", outlier_share=0.01, track_loss=0.02, landmarks=2500, **drift, **options)
    found = examine(seen(data))
    assert not found.findings, found.summary()
    told = next(row.hypothesis for row in found.rows if row.test == "lengths")
    assert abs(float(told.rpartition(" ")[2]) - 1.0) < 0.025, told


def test_observations_outside_the_image_are_named() -> None:
    tracks = dataclasses.replace(seen(recording(mode="mono"), 10), image_size=np.array([[480, 640]]))
    found = examine(tracks)
    assert not found.harmful and "image size of camera 0 is not that of the images" in found.summary()
    assert re.search(r"\d+% of its observations lie outside 480 x 640 px", found.summary())


@pytest.mark.parametrize(("since", "zoom"), [(10, 1.2), (13, 1.2), (2, 1.2), (10, 1.0)])
def test_observations_that_come_to_lie_outside_the_image_tell_since_when(since: int, zoom: float) -> None:
    tracks = dataclasses.replace(seen(recording(mode="mono"), 16), image_size=np.array([[640, 480]]))
    later, middle = tracks.keyframe >= since, np.array([320.0, 240.0])
    found = units.check_image_size(
        tracks.seen(np.where(later[:, None], middle + zoom * (tracks.uv - middle), tracks.uv))
    )
    if zoom == 1.0:
        assert not found.findings
    elif since < 5:
        assert not found.harmful  # those before are too few to tell
    else:
        assert found.since_ns == tracks.stamp_ns[since], found.summary()
        assert "images of camera 0 are others from stamp" in found.summary()


@pytest.mark.slow
def test_same_tracks_give_the_same_numbers() -> None:
    tracks = seen(recording(wrong="turned 1 about y"))
    first, second = (json.dumps(examine(tracks).as_dict()) for _ in range(2))
    assert first == second


def test_nothing_to_tell() -> None:
    data = recording(mode="mono", keyframes=3)
    found = examine(seen(data, keyframes=1))
    assert not found.findings
    assert not found.sound
    assert found.summary().startswith("the tracks cannot tell")


def test_json_holds_no_nan() -> None:
    def refuse(name: str) -> None:
        raise AssertionError(name)

    text = json.dumps(examine(seen(recording(mode="mono"), keyframes=10)).as_dict())
    json.loads(text, parse_constant=refuse)


@pytest.mark.slow
def test_tracks_without_rays_are_left_out() -> None:
    tracks = seen(recording(distortion="equidistant", fov_deg=150.0), keyframes=5)
    assert isinstance(tracks, Tracks)
    for rows in tracks.images.values():
        assert np.isfinite(tracks.ray[rows]).all()
        assert (np.diff(tracks.track[rows]) > 0).all()


@pytest.mark.slow
def test_what_is_given_counts_where_consensus_finds_nothing_better() -> None:
    """Where points are far, samples of five tracks may miss the relation of two cameras."""
    tracks = tracks_in(spoiled("sound", "stereo", seed=59).measurements)
    found = examine(tracks)
    assert not found.findings, found.summary()
    assert "camera 1 is where the rig says" in found.sound


@pytest.mark.slow
@pytest.mark.parametrize(("noise_px", "seed", "keyframes"), [(1.0, 3, 15), (1.0, 5, 15), (2.0, 2, 40)])
def test_a_street_seen_low_in_the_image_is_no_region(noise_px: float, seed: int, keyframes: int) -> None:
    """Points lie in the lower half of the image, and too little parallax leaves the poses untold."""
    found = examine(seen(round_trip(noise_px, seed=seed, drift_rotation_deg=1.5), keyframes))
    assert not found.harmful, found.summary()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "rig", "share", "seed"),
    [
        ("outliers_uniform", "stereo", 0.5, 0),
        ("outliers_uniform", "rgbd", 0.2, 0),
        ("outliers_jumping", "mono", 0.5, 0),
        ("outliers_moving", "stereo", 0.3, 0),
        pytest.param("outliers_moving", "stereo", 0.4, 0, marks=pytest.mark.slow),
        ("outliers_moving", "stereo", 0.5, 0),
        ("outliers_moving", "rgbd", 0.4, 0),
    ],
)
def test_outliers_are_no_mistake_of_the_set_up(kind: str, rig: str, share: float, seed: int) -> None:
    drift = {"drift_rotation_deg": 0.5, "drift_translation": 0.03}
    size = {"keyframes": 60, "length_m": 30.0, "path": "loop", "tracks": 200, "landmarks": 3000, "outlier_share": 0.0}
    data = spoiled(kind, rig, share, seed, **drift, **size)
    scene, due = Scene(Config().scene), [10, 15, 25]
    for _, _, measurement in data.timeline:
        scene.add(measurement)
        if due and len(scene.keyframes) > due[0]:
            tracks = tracks_of(scene)
            assert tracks is not None
            found = examine(tracks)
            assert not found.harmful, f"{due[0]} keyframes: {found.summary()}"
            due = due[1:]
        if not due:
            break
    assert not due


@pytest.mark.parametrize(("factor", "mode"), [(1.5, "mono"), (0.5, "stereo")])
def test_a_wrong_focal_length_is_no_matter_of_outliers(factor: float, mode: str) -> None:
    """It keeps tracks from agreeing with any relation, as outliers do, and there are some of these too."""
    sound = recording(4, "", mode, keyframes=40, path="loop", outlier_share=0.2)
    assert not examine(seen(sound)).findings
    found = examine(seen(intrinsics(lambda k: k * [factor, factor, 1.0, 1.0])(sound)))
    assert f"focal length off by a factor of about {factor:.2f}" in found.causes(), found.summary()
