# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings with several sessions, and recordings from which nothing can be refined."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.io.trajectory import read_tum
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement, OfTime
from ba_node.offline.recording import record
from ba_node.offline.replay import replay
from experiments.synthetic import SyntheticOptions, generate
from tests.window.test_joining import CUT, N, small_eight, two_sessions

S = 1_000_000_000
HOUR = 3600 * S
Timeline = list[tuple[str, int, Measurement]]


def timeline(**options: Any) -> Timeline:
    fixed: dict[str, Any] = {"keyframes": 10, "landmarks": 600, "tracks": 60, "path": "line", "length_m": 10.0}
    return list(generate(SyntheticOptions(**(fixed | options))).timeline())


def restamped(rows: Iterable[tuple[str, int, Measurement]], begin: int, shift_ns: int) -> Timeline:
    """Return a recording in which the stamps of keyframes from an id on are moved, but not the times of the record."""
    return [
        (topic, time_ns, dataclasses.replace(m, stamp_ns=m.stamp_ns + shift_ns))
        if isinstance(m, Keyframe) and m.keyframe_id >= begin
        else (topic, time_ns, m)
        for topic, time_ns, m in rows
    ]


def test_sessions_with_the_same_id_do_not_share_a_folder(tmp_path: Path) -> None:
    bag = tmp_path / "back.mcap"
    rows = restamped(restamped(timeline(keyframes=15), 5, -HOUR), 10, -HOUR)
    record(bag, rows)
    report = replay(bag, tmp_path / "out", Config())
    old = report["older_sessions"]
    assert [(entry["session_id"], entry["folder"], entry["keyframes"]) for entry in old] == [
        (0, "session_0", 5), (0, "session_0_2", 5)
    ]  # fmt: skip
    folders = [tmp_path / "out" / name for name in ("session_0", "session_0_2", ".")]
    stamps = [set(read_tum(folder / "trajectory.tum").stamp_ns.tolist()) for folder in folders]
    assert [len(one) for one in stamps] == [5, 5, 5]
    assert not (stamps[0] & stamps[1] or stamps[1] & stamps[2])
    for folder, one in zip(folders, stamps, strict=True):
        assert set(read_tum(folder / "trajectory_input.tum").stamp_ns.tolist()) == one


@pytest.mark.slow
def test_a_recording_twice_in_one_file_gives_the_same_twice(tmp_path: Path) -> None:
    rows = timeline(keyframes=12)
    length = rows[-1][1] - rows[0][1] + S
    record(tmp_path / "once.mcap", rows)
    record(tmp_path / "twice.mcap", [*rows, *((topic, time + length, m) for topic, time, m in rows)])
    config = Config().with_values({"scene.max_reorder_s": 1.0})
    replay(tmp_path / "once.mcap", tmp_path / "once", config)
    report = replay(tmp_path / "twice.mcap", tmp_path / "twice", config)
    assert len(report["older_sessions"]) == 1
    for name in ("trajectory.tum", "trajectory_input.tum", "points.ply"):
        expected = (tmp_path / "once" / name).read_bytes()
        assert (tmp_path / "twice" / name).read_bytes() == expected, name
        assert (tmp_path / "twice" / "session_0" / name).read_bytes() == expected, name


def test_a_first_keyframe_that_is_absurd_leaves_no_session(tmp_path: Path) -> None:
    rows = timeline()
    moved = [
        (t, time, dataclasses.replace(m, stamp_ns=m.stamp_ns + HOUR))
        if isinstance(m, Keyframe) and m.keyframe_id == 0
        else (t, time, m)
        for t, time, m in rows
    ]
    record(tmp_path / "first.mcap", moved)
    report = replay(tmp_path / "first.mcap", tmp_path / "out", Config())
    assert report["older_sessions"] == []
    assert report["keyframes"] == 9
    assert report["rejected"] == {"bad_stamp": 1}


def without(rows: Timeline, *kinds: type) -> Timeline:
    return [row for row in rows if not isinstance(row[2], kinds)]


def of_others(rows: Timeline) -> Timeline:
    """Return a recording whose tracks name keyframes that never come."""
    return [
        (t, s, dataclasses.replace(m, keyframe_id=m.keyframe_id + 1000) if isinstance(m, FeatureTracks) else m)
        for t, s, m in rows
    ]


def without_poses(rows: Timeline) -> Timeline:
    return [
        (t, s, dataclasses.replace(m, orientation=np.zeros(4)) if isinstance(m, Keyframe) else m) for t, s, m in rows
    ]


def emptied(rows: Timeline) -> Timeline:
    """Return a recording whose tracks have no rows."""
    none: dict[str, Any] = {
        "track_id": np.empty(0, np.uint64),
        "uv": np.empty((0, 2)),
        "sigma_px": np.empty(0),
        "depth_m": np.empty(0),
    }
    return [(t, s, dataclasses.replace(m, **none) if isinstance(m, FeatureTracks) else m) for t, s, m in rows]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (of_others(timeline()), "nothing was refined: no tracks came that could be used"),
        (emptied(timeline()), "nothing was refined: all 20 tracks messages are empty"),
        (timeline(keyframes=2)[:4], "nothing was refined: one keyframe only"),
    ],
    ids=["tracks of others", "empty tracks", "one keyframe"],
)
def test_what_cannot_be_refined_is_written_as_it_came_and_said(
    rows: Timeline, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "bare.mcap", rows)
    assert main(["replay", str(tmp_path / "bare.mcap"), "--out", str(tmp_path / "out"), "--no-report"]) == 3
    told = capsys.readouterr()
    assert f"ba: warning: {words}" in told.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["keyframes_refined"] == 0
    found, given = (read_tum(tmp_path / "out" / f"{name}.tum") for name in ("trajectory", "trajectory_input"))
    assert len(found) == report["keyframes"] > 0
    np.testing.assert_allclose(found.position, given.position, atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (without(timeline(), Keyframe), "no topic of type ba_msgs/msg/Keyframe"),
        (without(timeline(), Keyframe, FeatureTracks), "no topic of type ba_msgs/msg/Keyframe"),
        (without(timeline(), FeatureTracks), "no topic of type ba_msgs/msg/FeatureTracks"),
        (
            without_poses(timeline()),
            "none of 10 keyframes can be used (tracks messages: 20, camera rigs: 1): keyframe 0",
        ),
    ],
    ids=["no keyframes", "a rig alone", "no tracks", "no poses"],
)
def test_what_is_worth_nothing_is_refused_by_name(
    rows: Timeline, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "bare.mcap", rows)
    assert main(["replay", str(tmp_path / "bare.mcap"), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out" / "report.json").exists()
    assert not (tmp_path / "out" / "refined.mcap").exists()


@pytest.mark.slow
def test_the_lower_session_of_a_front_end_that_restarted_is_written(tmp_path: Path) -> None:
    rows = timeline()
    length = rows[-1][1] - rows[0][1] + S
    first = [
        (t, s, m if isinstance(m, CameraRig | OfTime) else dataclasses.replace(m, session_id=6)) for t, s, m in rows
    ]
    record(tmp_path / "restart.mcap", [*first, *((t, s + length, m) for t, s, m in rows[1:])])
    report = replay(tmp_path / "restart.mcap", tmp_path / "out", Config())
    assert (report["session_id"], report["keyframes"]) == (0, 8)
    assert [(entry["folder"], entry["keyframes"]) for entry in report["older_sessions"]] == [("session_6", 10)]
    assert any("below the current 6: a new session begins" in line for line in report["attention"])


TOPICS = {CameraRig: "camera_rig", Keyframe: "keyframes", FeatureTracks: "feature_tracks"}


@pytest.mark.slow
@pytest.mark.parametrize("joined", [True, False])
def test_sessions_that_are_joined_are_written_as_one(tmp_path: Path, joined: bool) -> None:
    data = small_eight()
    rows = ((TOPICS[type(one)], data.keyframes[0].stamp_ns + i, one) for i, one in enumerate(two_sessions(data)))
    record(tmp_path / "two.mcap", rows, data.truth)
    chosen = ["--set", f"scene.join_sessions={str(joined).lower()}", "--no-report"]
    assert main(["replay", str(tmp_path / "two.mcap"), "--out", str(tmp_path / "out"), *chosen]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["keyframes"], report["keyframes_refined"]) == ((N, N) if joined else (N - CUT, N - CUT))
    assert report["trajectory_error_m"]["refined"] < 0.02
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")) == report["keyframes"]


@pytest.mark.slow
def test_keyframes_that_are_culled_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "loop.mcap"
    record(path, timeline(path="loop", keyframes=40, length_m=24.0, landmarks=1500), None)
    chosen = ["--set", "scene.redundant_share=0.6", "--set", "window.max_keyframes=10", "--no-report"]
    assert main(["replay", str(path), "--out", str(tmp_path / "out"), *chosen]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["notices"]["redundant"] > 3
    assert report["keyframes"] == report["keyframes_refined"] == 40 - report["notices"]["redundant"]
