# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings, and sessions, that end before there is much to tell: what is wrong with them is told all the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from ba_node.measurements import FeatureTracks
from experiments.robustness.faults import SOUND, spoiled
from experiments.robustness.faults.recording import Recording
from experiments.robustness.faults.spoil import spoiled_by
from tests.cases.conftest import Replay, harmless
from tests.cases.test_siblings import write

SHORT = {"keyframes": 13, "length_m": 10.0}


@pytest.mark.parametrize(("amount", "seed", "options"), [(1.2, 921, ()), (0.8, 922, ("--final-optimize",))])
def test_a_baseline_is_compared_once_more_at_the_end(
    amount: float, seed: int, options: tuple[str, ...], tmp_path: Path, run: Replay
) -> None:
    recording = spoiled("baseline_off", "stereo", amount, seed, **SHORT)
    outcome = run(write(tmp_path, recording), *options)
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells("baseline|scale of focal")


@pytest.mark.parametrize(
    ("fault", "keyframes", "words"), [("axes_confused", 5, "axes"), ("poses_inverted", 8, "invert")]
)
def test_a_few_keyframes_tell_what_is_plain(
    fault: str, keyframes: int, words: str, tmp_path: Path, run: Replay
) -> None:
    recording = spoiled(fault, "mono", seed=603, keyframes=keyframes, length_m=10.0)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, keyframes)
    outcome.tells(words)


def first_of(recording: Recording, keyframes: int) -> Recording:
    """Return the first keyframes of a recording."""
    ids = {keyframe.keyframe_id for keyframe in recording.keyframes[:keyframes]}
    entries = [entry for entry in recording.timeline if getattr(entry[2], "keyframe_id", min(ids)) in ids]
    return dataclasses.replace(recording, timeline=tuple(entries))


@pytest.mark.parametrize("keyframes", [2, 3])
@pytest.mark.parametrize(
    ("fault", "rig", "seed", "words"),
    [
        ("baseline_reversed", "stereo", 70, "baseline"),
        ("baseline_reversed", "stereo", 940, "baseline"),
        ("depth_in_mm", "rgbd", 70, "millimetres"),
        ("depth_in_mm", "rgbd", 941, "millimetres"),
    ],
)
def test_two_or_three_keyframes_tell_what_is_gross(
    fault: str, rig: str, seed: int, words: str, keyframes: int, tmp_path: Path, run: Replay
) -> None:
    recording = first_of(spoiled(fault, rig, seed=seed, look_deg=90.0 * (seed > 900)), keyframes)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, keyframes)
    outcome.tells(words)


@pytest.mark.parametrize("keyframes", [2, 3])
@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_two_or_three_sound_keyframes_are_refined(rig: str, keyframes: int, tmp_path: Path, run: Replay) -> None:
    recording = first_of(spoiled(SOUND, rig, seed=70), keyframes)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 0 and not outcome.report["attention"], outcome.words
    harmless(outcome.errors(recording.truth), 1.0, keyframes)


@pytest.mark.parametrize(
    ("fault", "rig", "amount", "seen", "words"),
    [
        ("roi_ignored", "mono", 120.0, (5, 0.0), "region of interest"),
        ("camera_turned", "stereo", 1.0, (3, 0.0), "sit on the body"),
        ("rectified_with_distortion", "stereo", 1.0, (4, 0.0), "rectified"),
        ("axes_confused", "rgbd", 1.0, (2, 0.0), "axes confused"),
        ("focal_off", "rgbd", 1.2, (6, 90.0), "focal length"),
        ("focal_off", "stereo", 1.2, (4, 0.0), "^$"),
    ],
)
def test_a_few_keyframes_with_wrong_cameras(
    fault: str, rig: str, amount: float, seen: tuple[int, float], words: str, tmp_path: Path, run: Replay
) -> None:
    keyframes, look_deg = seen
    recording = first_of(spoiled(fault, rig, amount, 70, look_deg=look_deg), keyframes)
    outcome = run(write(tmp_path, recording))
    harmless(outcome.errors(recording.truth), 1.0, keyframes)
    outcome.tells(words)


@pytest.mark.parametrize(("rig", "look_deg"), [("stereo", 0.0), ("rgbd", 90.0)])
def test_a_focal_length_slightly_off_on_a_short_way(rig: str, look_deg: float, tmp_path: Path, run: Replay) -> None:
    seed = 70 if rig == "stereo" else 74
    recording = spoiled("focal_off", rig, 0.98, seed, keyframes=20, length_m=10.0, look_deg=look_deg)
    outcome = run(write(tmp_path, recording))
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))


def test_steps_alone_tell_how_long_a_way_of_one_camera_is(tmp_path: Path, run: Replay) -> None:
    recording = spoiled("new_ids_twice", "mono", seed=11)
    (found,) = run(write(tmp_path, recording)).errors(recording.truth)
    assert found.published_m < 0.6 * found.input_m


@pytest.mark.slow
def test_each_of_two_sessions_is_compared_at_its_end(tmp_path: Path, run: Replay) -> None:
    recording = spoiled_by([("session_lowered", 3.0), ("baseline_off", 1.3)], "stereo", 88)
    outcome = run(write(tmp_path, recording))
    harmless(outcome.errors(recording.truth), 0.9, len(recording.keyframes))
    outcome.tells("session", "baseline|scale of focal")


@pytest.mark.slow
@pytest.mark.parametrize("rig", ["stereo", "mono", "rgbd"])
def test_a_short_sound_drive_is_refined(rig: str, tmp_path: Path, run: Replay) -> None:
    recording = spoiled(SOUND, rig, seed=923, **SHORT)
    outcome = run(write(tmp_path, recording), "--final-optimize")
    assert outcome.code == 0 and not outcome.report["attention"], outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))


@pytest.mark.slow
def test_a_principal_point_off_on_a_straight_way(tmp_path: Path, run: Replay) -> None:
    recording = spoiled("roi_ignored", "mono", 15.0, 924)
    outcome = run(write(tmp_path, recording), "--final-optimize")
    assert outcome.code == 3, outcome.words
    harmless(outcome.errors(recording.truth), 1.0, len(recording.keyframes))
    outcome.tells("principal point")


@pytest.mark.parametrize(
    ("factor", "last", "seed", "unit"), [(1000.0, 5, 925, "in millimetres"), (3.28, 13, 926, "in feet")]
)
def test_depths_that_change_their_unit_near_the_end_are_named(
    factor: float, last: int, seed: int, unit: str, tmp_path: Path, run: Replay
) -> None:
    recording = spoiled(SOUND, "rgbd", seed=seed)
    late = len(recording.keyframes) - last

    def change(image: FeatureTracks) -> FeatureTracks:
        times = factor if recording.number(image.keyframe_id) >= late else 1.0
        return dataclasses.replace(image, depth_m=times * image.depth_m)

    outcome = run(write(tmp_path, recording.changed(FeatureTracks, change)))
    assert outcome.code == 3, outcome.words
    (found,) = outcome.errors(recording.truth)
    assert found.published_m < 0.5 * found.input_m, "the images go on without them"
    outcome.tells(rf"depth_m of \d+ keyframes \({late} to \d+\).*{unit}")


@pytest.mark.slow
def test_a_baseline_that_is_off_by_little_is_said_and_does_no_harm(tmp_path: Path, run: Replay) -> None:
    recording = spoiled("baseline_off", "stereo", 0.983, 401, path="loop", length_m=30.0, keyframes=60)
    outcome = run(write(tmp_path, recording))
    assert outcome.code == 3, outcome.words
    outcome.tells("scale of focal length or baseline: lengths are 0.98")
    (found,) = outcome.errors(recording.truth)
    assert found.published_m <= 1.001 * found.input_m
