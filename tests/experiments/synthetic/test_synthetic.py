# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ba_node.config import ConfigError, declared
from ba_node.evaluation.metrics import absolute_error
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

FloatArray = NDArray[np.float64]

SMALL = SyntheticOptions(keyframes=20, landmarks=1500, tracks=150, seed=3)


@cache
def recording(options: SyntheticOptions) -> SyntheticData:
    return generate(options)


def variant(**changes: object) -> SyntheticData:
    return recording(dataclasses.replace(SMALL, **changes))  # type: ignore[arg-type]


def truth_uv(data: SyntheticData, k: int, image: FeatureTracks) -> tuple[FloatArray, FloatArray]:
    """Project the true points by scipy's rotations and OpenCV's formula: a route of its own."""
    rig, camera = data.rig, image.camera_index
    order = np.argsort(data.track_id)
    rows = order[np.searchsorted(data.track_id, image.track_id, sorter=order)]
    world = data.landmarks[data.track_landmark[rows]]
    body = Rotation.from_quat(data.truth.orientation[k]).inv().apply(world - data.truth.position[k])
    x, y, z = Rotation.from_quat(rig.orientation[camera]).inv().apply(body - rig.position[camera]).T
    fx, fy, cx, cy = rig.intrinsics[camera]
    k1, k2, p1, p2, k3 = rig.distortion[camera]
    a, b = x / z, y / z
    s = a * a + b * b
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    u = fx * (a * radial + 2 * p1 * a * b + p2 * (s + 2 * a * a)) + cx
    v = fy * (b * radial + p1 * (s + 2 * b * b) + 2 * p2 * a * b) + cy
    return np.stack([u, v], axis=1), z


def residuals(data: SyntheticData) -> FloatArray:
    return np.concatenate(
        [image.uv - truth_uv(data, k, image)[0] for k, images in enumerate(data.tracks) for image in images]
    )


@pytest.mark.parametrize("lens", ["none", "plumb_bob"])
@pytest.mark.parametrize("path", ["loop", "line"])
def test_without_noise_observations_are_the_projections_of_the_truth(lens: str, path: str) -> None:
    data = variant(noise_px=0.0, outlier_share=0.0, distortion=lens, path=path)
    worst = np.abs(residuals(data)).max()
    # Half a unit in the last place of float32 below 1024 px.
    assert worst <= 2.0**-15 * 1.001, f"largest difference {worst} px"


def test_noise_has_the_standard_deviation_asked_for() -> None:
    r = residuals(variant(noise_px=0.7, outlier_share=0.0))
    assert len(r) > 4000
    assert r.std() == pytest.approx(0.7, rel=4 / np.sqrt(2 * r.size))
    assert abs(r.mean()) < 4 * 0.7 / np.sqrt(r.size)


def test_outliers_have_the_share_and_the_size_asked_for() -> None:
    share = 0.1
    length = np.linalg.norm(residuals(variant(noise_px=0.5, outlier_share=share)), axis=1)
    outlier = length > 6.0
    assert outlier.mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / len(length)))
    assert length[outlier].min() > 10.0 - 3.0
    assert length[outlier].max() < 60.0 + 3.0


def test_nearly_all_observations_are_inside_the_image() -> None:
    data = variant(outlier_share=0.2)
    uv = np.concatenate([image.uv for images in data.tracks for image in images])
    inside = ((uv >= -0.5) & (uv <= data.rig.image_size[0] - 0.5)).all(axis=1)
    assert inside.mean() > 0.995


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not() -> None:
    def bytes_of(data: SyntheticData) -> bytes:
        arrays = [image.uv for images in data.tracks for image in images]
        return b"".join(a.tobytes() for a in [*arrays, data.odometry.position, data.track_id, data.landmarks])

    options = dataclasses.replace(SMALL, ids="random64", keyframes=8)
    assert bytes_of(generate(options)) == bytes_of(generate(options))
    assert bytes_of(generate(options)) != bytes_of(generate(dataclasses.replace(options, seed=4)))


def test_noise_does_not_move_the_points_or_the_drift() -> None:
    quiet, loud = variant(noise_px=0.0), variant(depth_share=0.5, outlier_share=0.3, noise_px=0.0)
    np.testing.assert_array_equal(quiet.landmarks, loud.landmarks)
    np.testing.assert_array_equal(quiet.odometry.position, loud.odometry.position)
    np.testing.assert_array_equal(quiet.track_landmark, loud.track_landmark)


@pytest.mark.parametrize("least", [1, 2, 4])
def test_published_tracks_are_seen_in_as_many_keyframes_as_promised(least: int) -> None:
    data = variant(min_track_keyframes=least)
    ids, views = np.unique(np.concatenate([images[0].track_id for images in data.tracks]), return_counts=True)
    assert views.min() == least
    np.testing.assert_array_equal(ids, np.sort(data.track_id))


def test_an_image_has_no_more_tracks_than_asked_for_and_none_twice() -> None:
    for images in variant().tracks:
        for image in images:
            assert 50 < len(image.track_id) <= SMALL.tracks
            assert len(np.unique(image.track_id)) == len(image.track_id)


def test_a_track_ends_at_its_longest_age() -> None:
    data = variant(max_track_keyframes=3, track_loss=0.0)
    _, views = np.unique(np.concatenate([images[0].track_id for images in data.tracks]), return_counts=True)
    assert views.max() == 3


def test_a_point_seen_again_keeps_its_track_only_with_reobserve() -> None:
    again, anew = variant(reobserve=True), variant(reobserve=False)
    assert len(np.unique(again.track_landmark)) == len(again.track_landmark)
    assert len(np.unique(anew.track_landmark)) < len(anew.track_landmark)
    common = np.intersect1d(again.tracks[0][0].track_id, again.tracks[-1][0].track_id)
    assert len(common) > 20, "the loop does not close"
    assert len(np.intersect1d(anew.tracks[0][0].track_id, anew.tracks[-1][0].track_id)) == 0


def test_drift_is_that_of_the_random_walk() -> None:
    """The increments of the published poses differ from the true ones by the noise asked for."""
    data = variant(keyframes=400, landmarks=200, tracks=30, drift_rotation_deg=1.2, drift_translation=0.05)
    steps = []
    for poses in (data.truth, data.odometry):
        rotation = Rotation.from_quat(poses.orientation)
        turn = rotation[:-1].inv() * rotation[1:]
        shift = rotation[:-1].inv().apply(np.diff(poses.position, axis=0))
        steps.append((turn, shift))
    (true_turn, true_shift), (turn, shift) = steps
    root = np.sqrt(SMALL.length_m / 399)
    angles = np.degrees((true_turn.inv() * turn).as_rotvec())
    tolerance = 4 / np.sqrt(2 * angles.size)
    assert angles.std() == pytest.approx(1.2 * root, rel=tolerance)
    assert (shift - true_shift).std() == pytest.approx(0.05 * root, rel=tolerance)


def test_drift_starts_at_the_truth_and_reaches_the_promised_size() -> None:
    """With the defaults the input is off by half a metre to one metre (RMSE after se3 alignment)."""
    errors = []
    for seed in range(12):
        data = generate(SyntheticOptions(keyframes=20, landmarks=50, tracks=8, min_track_keyframes=1, seed=seed))
        np.testing.assert_array_equal(data.odometry.position[0], data.truth.position[0])
        errors.append(absolute_error(data.odometry, data.truth, "se3").translation.rmse)
    assert 0.45 < np.median(errors) < 0.9, f"rms errors {errors} m"
    assert min(errors) > 0.2
    assert max(errors) < 1.5


def test_without_drift_the_published_poses_are_the_true_ones() -> None:
    data = variant(drift_rotation_deg=0.0, drift_translation=0.0)
    np.testing.assert_allclose(data.odometry.position, data.truth.position, atol=1e-12)
    turn = Rotation.from_quat(data.odometry.orientation).inv() * Rotation.from_quat(data.truth.orientation)
    assert turn.magnitude().max() < 1e-7


def test_random_ids_spread_over_uint64_and_are_distinct() -> None:
    data = variant(ids="random64")
    for ids in (data.track_id, data.truth.keyframe_id):
        assert ids.dtype == np.uint64
        assert len(np.unique(ids)) == len(ids)
        assert ids.min() == 0
        assert ids.max() == 2**64 - 1
        counts, _ = np.histogram(ids.astype(float), bins=4, range=(0.0, 2.0**64))
        assert counts.min() >= 0.5 * len(ids) / 4, f"ids in each quarter of the range: {counts}"
    assert np.any(np.diff(data.truth.keyframe_id.astype(float)) < 0), "ids must not tell the order"


def test_the_right_camera_sees_points_farther_left_by_the_disparity() -> None:
    data = variant(noise_px=0.0, outlier_share=0.0)
    for k, (left, right) in enumerate(data.tracks):
        _, in_left, in_right = np.intersect1d(left.track_id, right.track_id, return_indices=True)
        assert len(in_left) == len(right.track_id) > 30
        disparity = left.uv[in_left, 0] - right.uv[in_right, 0]
        assert disparity.min() > 0.0
        depth = truth_uv(data, k, left)[1][in_left]
        np.testing.assert_allclose(disparity * depth, data.rig.intrinsics[0, 0] * SMALL.baseline_m, rtol=1e-3)


def test_depth_has_the_share_and_noise_asked_for_and_only_in_the_first_camera() -> None:
    data = variant(depth_share=0.6, depth_noise=0.02)
    ratios, known = [], []
    for k, (left, right) in enumerate(data.tracks):
        assert len(right.depth_m) == 0
        has = np.isfinite(left.depth_m)
        known.append(has)
        ratios.append(left.depth_m[has] / truth_uv(data, k, left)[1][has] - 1.0)
    share, noise = np.concatenate(known), np.concatenate(ratios)
    assert share.mean() == pytest.approx(0.6, abs=4 * np.sqrt(0.24 / len(share)))
    assert noise.std() == pytest.approx(0.02, rel=4 / np.sqrt(2 * len(noise)))


def test_guesses_come_once_for_each_track_before_its_first_observation() -> None:
    data = variant(guesses=True, guess_noise=0.0, drift_rotation_deg=0.0, drift_translation=0.0)
    known: set[int] = set()
    for _, _, item in data.timeline():
        if isinstance(item, LandmarkGuesses):
            assert known.isdisjoint(item.track_id.tolist())
            known.update(item.track_id.tolist())
            rows = data.track_landmark[item.track_id.astype(int)]
            np.testing.assert_allclose(item.position, data.landmarks[rows], atol=1e-9)
        if isinstance(item, FeatureTracks):
            assert known.issuperset(item.track_id.tolist())
    assert len(known) == len(data.track_id)


def test_timeline_is_in_the_order_of_a_front_end() -> None:
    data = variant(guesses=True)
    items = list(data.timeline())
    assert isinstance(items[0][2], CameraRig)
    stamps = [stamp for _, stamp, _ in items]
    assert stamps == sorted(stamps)
    expected = ["camera_rig"] + ["keyframes", "landmark_guesses", "feature_tracks", "feature_tracks"] * 2
    assert [topic for topic, _, _ in items[:9]] == expected
    for topic, stamp, item in items:
        if topic == "keyframes":
            assert isinstance(item, Keyframe)
            assert item.stamp_ns == stamp
    np.testing.assert_array_equal(np.diff(data.truth.stamp_ns), 250_000_000)


@pytest.mark.parametrize("path", ["loop", "line"])
def test_the_body_drives_forward_with_z_up_for_the_length_asked_for(path: str) -> None:
    data = variant(path=path, keyframes=200, landmarks=200, tracks=20)
    rotation = Rotation.from_quat(data.truth.orientation)
    steps = np.diff(data.truth.position, axis=0)
    ahead = rotation[:-1].inv().apply(steps / np.linalg.norm(steps, axis=1, keepdims=True))
    assert ahead[:, 0].min() > 0.9
    assert rotation.apply([0.0, 0.0, 1.0])[:, 2].min() > 0.99
    assert np.linalg.norm(steps[:, :2], axis=1).sum() == pytest.approx(SMALL.length_m, rel=5e-3)
    if path == "loop":
        np.testing.assert_allclose(data.truth.position[-1, :2], data.truth.position[0, :2], atol=1e-3)


def test_points_behind_a_block_are_not_seen() -> None:
    """From the first pose, in the passage, the outer faces of both blocks are hidden."""
    data = variant(landmarks=6000, tracks=5000, min_track_keyframes=1, look_deg=90.0)
    block_far_side = data.landmarks[:, 0] < -5.0
    seen = np.zeros(len(data.landmarks), dtype=bool)
    seen[data.track_landmark[data.tracks[0][0].track_id.astype(int)]] = True
    between = np.abs(data.landmarks[:, 1]) < 1.0
    assert not np.any(seen & block_far_side & between)
    assert np.any(seen & ~block_far_side)


def test_cameras_look_where_they_are_told() -> None:
    for angle, axis in ((0.0, [1.0, 0.0, 0.0]), (90.0, [0.0, 1.0, 0.0])):
        rig = variant(look_deg=angle).rig
        forward = Rotation.from_quat(rig.orientation[0]).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(forward, axis, atol=1e-12)
        down = Rotation.from_quat(rig.orientation[0]).apply([0.0, 1.0, 0.0])
        np.testing.assert_allclose(down, [0.0, 0.0, -1.0], atol=1e-12)


@pytest.mark.parametrize("lens", ["none", "plumb_bob", "equidistant"])
@pytest.mark.parametrize("path", ["loop", "line"])
def test_nothing_is_nan(lens: str, path: str) -> None:
    data = variant(distortion=lens, path=path, baseline_m=0.0, guesses=True, fov_deg=120.0)
    assert len(data.rig) == 1
    for _, _, item in data.timeline():
        values = [v for v in vars(item).values() if isinstance(v, np.ndarray) and v.dtype == float]
        assert values
        assert all(np.isfinite(v).all() for v in values)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"keyframes": 1}, "keyframes = 1"),
        ({"noise_px": float("nan")}, "noise_px = nan"),
        ({"outlier_share": 1.5}, "outlier_share = 1.5"),
        ({"path": "spiral"}, "choose one of loop, line"),
        ({"seed": -1}, "seed = -1"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"min_track_keyframes": 99}, "min_track_keyframes = 99"),
        ({"max_track_keyframes": 1}, "max_track_keyframes = 1"),
    ],
)
def test_options_out_of_range_are_refused_by_name(changes: dict[str, object], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        dataclasses.replace(SMALL, **changes)  # type: ignore[arg-type]


def test_every_option_is_declared_with_its_default_in_range() -> None:
    for parameter in declared(SyntheticOptions):
        assert parameter.check(parameter.default) == parameter.default
        assert parameter.doc.endswith(".")
    assert dataclasses.replace(SMALL, length_m=40).length_m == 40.0
