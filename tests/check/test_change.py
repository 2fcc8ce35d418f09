# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""All images of cameras together tell from which keyframe on they are others, and by how much."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from ba_node.check import change
from ba_node.check.adjusted import placed, problem_of_all
from ba_node.check.change import check_change
from ba_node.check.onset import check_onset
from ba_node.check.tracks import Tracks
from ba_node.core import bordered, geometry
from ba_node.core.cameras import FX
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.robustness.faults.recording import Recording
from experiments.robustness.faults.spoil import spoiled, spoiled_by
from experiments.synthetic import SyntheticData
from tests.check.set_ups import FloatArray, poses, recording, seen

SIDEWAYS: dict[str, Any] = {"look_deg": 90.0}
LOOP: dict[str, Any] = {"path": "loop", "length_m": 30.0, "keyframes": 60, **SIDEWAYS}


def tracks_of(data: Recording) -> Tracks:
    """Return the tracks of a recording with a fault."""
    images: dict[int, list[FeatureTracks]] = {}
    for one in data.measurements:
        if isinstance(one, FeatureTracks):
            images.setdefault(one.keyframe_id, []).append(one)
    tracks = tuple(tuple(images[one.keyframe_id]) for one in data.keyframes)
    rig = next(one for one in data.measurements if isinstance(one, CameraRig))
    return seen(dataclasses.replace(data.sound, rig=rig, keyframes=data.keyframes, tracks=tracks))


@pytest.mark.parametrize(
    ("fault", "amount", "options", "words", "truth"),
    [
        ("zoomed_midway", 1.2, LOOP, r"focal length of camera 0 from stamp (\S+) s on is (\S+) times", (1.2,)),
        ("zoomed_midway", 0.85, LOOP, r"focal length of camera 0 from stamp (\S+) s on is (\S+) times", (0.85,)),
        (
            "region_midway",
            40.0,
            SIDEWAYS,
            r"region .* of camera 0 from stamp (\S+) s on .* \((\S+), (\S+)\) px",
            (-40, -24),
        ),
    ],
)
@pytest.mark.parametrize("rig", ["mono", "rgbd"])
def test_what_three_images_do_not_tell(
    fault: str, amount: float, options: dict[str, Any], words: str, truth: tuple[float, ...], rig: str
) -> None:
    tracks = tracks_of(spoiled(fault, rig, amount, 8701, **options))
    assert not check_onset(tracks).findings
    found = check_change(tracks).findings
    match = re.search(words, "; ".join(one.causes[0] for one in found))
    assert match, found
    assert [float(value) for value in match.groups()[1:]] == pytest.approx(truth, rel=0.08)
    # In a loop few tracks span a keyframe: it may be the one before.
    assert found[0].since_ns in tracks.stamp_ns[len(tracks) // 2 - 1 : len(tracks) // 2 + 1]


def test_both_cameras_of_a_pair_are_named() -> None:
    found = check_change(tracks_of(spoiled("region_midway", "stereo", 20.0, 9507, **LOOP))).findings
    assert [one.causes[0].split(" from ")[0] for one in found] == [
        f"region of interest or principal point of camera {camera}" for camera in (0, 1)
    ]


@pytest.mark.parametrize(
    ("fault", "amount", "rig", "seed"),
    [
        ("region_midway", 15.0, "mono", 9504),
        ("zoomed_midway", 1.05, "stereo", 9508),
        ("zoomed_midway", 1.05, "mono", 9504),
    ],
)
def test_a_small_change_that_passes_for_a_step_is_named_by_its_keyframe(
    fault: str, amount: float, rig: str, seed: int
) -> None:
    tracks = tracks_of(spoiled(fault, rig, amount, seed, **SIDEWAYS))
    (found,) = check_change(tracks).findings
    assert "zoomed or another region of interest" in found.causes[0]
    assert found.since_ns == tracks.stamp_ns[20]


@pytest.mark.parametrize(
    "faults",
    [(("region_midway", 12.0),), (("zoomed_midway", 1.15), ("outliers_uniform", 0.2))],
    ids=["region", "zoom"],
)
def test_a_step_that_is_odd_is_asked_of_more_observations(
    faults: tuple[tuple[str, float], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    tracks = tracks_of(spoiled_by(faults, "stereo", 11017 if len(faults) == 1 else 11001, **SIDEWAYS))
    (found,) = check_change(tracks).findings
    assert found.since_ns == tracks.stamp_ns[20]
    monkeypatch.setattr(change, "_ALL", change._OBSERVATIONS)
    assert not check_change(tracks).findings


@pytest.mark.parametrize(("mode", "cameras"), [("mono", (0,)), ("stereo", (0, 1)), ("stereo", (1,))])
def test_a_score_is_that_of_a_linearisation_with_cameras_before_and_after(mode: str, cameras: tuple[int, ...]) -> None:
    tracks = seen(recording(mode=mode, path="loop"), 30)
    problem = problem_of_all(tracks, np.arange(30), 2000)
    assert problem is not None
    problem = placed(problem)
    obs, n = problem.observations, len(tracks.cameras.model)
    (scores,) = change._scores(problem, [cameras], 1.0)
    assert scores[:4].tolist() == scores[-4:].tolist() == [0.0] * 4
    focal = tracks.cameras.params[list(cameras), FX]
    basis = np.kron(np.kron([[1.0, 0.0], [1.0, 1.0]], focal[:, None]), np.eye(3)).astype(np.float64)
    shared = bordered.Shared(tuple(change._unknowns([*cameras, *(n + camera for camera in cameras)])), basis)
    for k in (4, 11, 25):
        later = np.isin(obs.camera, cameras) & (obs.keyframe >= k)
        system = change._linearised(change._seen_by(problem, obs.camera + n * later, 2, by_camera=False), shared)
        step = system.solve_dense()
        assert step is not None
        b, covariance = step[-3:], np.linalg.inv(system.of_border()[0])[3:, 3:]
        assert scores[k] == pytest.approx(b @ np.linalg.solve(covariance, b), rel=1e-3), k


@pytest.mark.parametrize("path", ["line", "loop"])
@pytest.mark.parametrize("mode", ["mono", "stereo"])
@pytest.mark.parametrize("look_deg", [0.0, 90.0])
def test_sound_images_are_not_named(path: str, mode: str, look_deg: float) -> None:
    for keyframes in (15, 40, 60):
        assert not check_change(seen(recording(mode=mode, path=path, look_deg=look_deg), keyframes)).findings


@pytest.mark.parametrize("options", [SIDEWAYS, LOOP], ids=["line", "loop"])
@pytest.mark.parametrize(
    "faults",
    [
        (("one_keyframe_far", 15.0),),
        (("odometry_freezes", 6.0),),
        (("odometry_freezes", 10.0),),
        (("outliers_moving", 0.4),),
        (("pure_rotation", 5.0),),
        (("stops_midway", 15.0),),
        (("focal_slightly_off", 1.05),),
        (("roi_ignored", 20.0),),
        (("rectified_with_distortion", 1.0),),
    ],
)
def test_other_faults_are_not_taken_for_it(faults: tuple[tuple[str, float], ...], options: dict[str, Any]) -> None:
    assert not check_change(tracks_of(spoiled_by(faults, "mono", 9401, **options))).findings


def test_what_moves_over_a_few_keyframes_is_no_change() -> None:
    """Tracks on an object pull together: a score of 57 is not enough, they have to gain more."""
    data = spoiled("outliers_moving", "mono", 0.3, 11408, **SIDEWAYS)
    newest = {one.keyframe_id for one in data.keyframes[20:]}
    rest = dataclasses.replace(
        data,
        timeline=tuple(
            entry
            for entry in data.timeline
            if not isinstance(entry[2], Keyframe | FeatureTracks) or entry[2].keyframe_id in newest
        ),
    )
    assert not check_change(tracks_of(rest)).findings


@pytest.mark.parametrize(("heading_deg", "shift_m"), [(60.0, (0.0, 0.0, 0.0)), (0.0, (-10.0, 5.0, 0.0))])
def test_a_jump_of_the_front_end_is_no_change_of_the_images(
    heading_deg: float, shift_m: tuple[float, float, float]
) -> None:
    """Poses that begin on two sides of a jump end anywhere, and other intrinsics on one side fit that better."""

    def jumped(rotation: FloatArray, position: FloatArray, _: SyntheticData) -> tuple[FloatArray, FloatArray]:
        turn = geometry.so3_exp(np.radians([0.0, 0.0, heading_deg]))
        rotation, position = rotation.copy(), position.copy()
        position[20:] = (position[20:] - position[20]) @ turn.T + position[20] + shift_m
        rotation[20:] = turn @ rotation[20:]
        return rotation, position

    drift = {"drift_rotation_deg": 0.2, "drift_translation": 0.01}
    found = check_change(seen(poses(jumped)(recording(3, "", "stereo", path="line", keyframes=40, **drift))))
    assert not found.findings, found.summary()
