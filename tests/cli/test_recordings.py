# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba info`, `ba cut` and `ba merge`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ba_node.cli.main import main
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_writer import BagWriter
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from tests.cli.conftest import KEYFRAMES


def told(bag: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["info", str(bag), "--json", "-"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_info_counts_what_is_there(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = told(bag, capsys)
    with BagReader(bag) as reader:
        got = [measurement for _, _, measurement in reader.measurements()]
    images = [m for m in got if isinstance(m, FeatureTracks)]
    assert found["inputs"]["keyframes"] == sum(isinstance(m, Keyframe) for m in got) == KEYFRAMES
    assert found["inputs"]["cameras"] == 2
    assert found["inputs"]["observations"] == sum(len(m.track_id) for m in images)
    assert found["inputs"]["tracks"] == len({int(track) for m in images for track in m.track_id})
    assert found["topics"]["/feature_tracks"]["count"] == len(images) == 2 * KEYFRAMES
    assert found["taken"] == {name: f"/{name}" for name in ("keyframes", "feature_tracks", "camera_rig")}
    assert (found["refusal"], found["attention"]) == ("", [])
    assert main(["info", str(bag)]) == 0
    text = capsys.readouterr().out
    assert "a replay uses  /keyframes, /feature_tracks, /camera_rig" in text
    assert f"keyframes      {KEYFRAMES} in 1 session, 2 cameras" in text


def test_info_names_gaps_and_keyframes_without_tracks(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keyframes 3 to 6 of 0 to 7 are lost, and the last has no tracks."""
    spoiled = tmp_path / "gap.mcap"
    with BagReader(bag) as reader, BagWriter(spoiled) as writer:
        stamps = sorted({time for channel, time, _ in reader.raw() if channel.topic == "/keyframes"})
        for channel, time, data in reader.raw():
            lost = channel.topic in ("/keyframes", "/feature_tracks") and stamps[3] <= time <= stamps[6]
            if not lost and not (channel.topic == "/feature_tracks" and time == stamps[7]):
                writer.copy(channel, time, data)
    step = (stamps[1] - stamps[0]) * 1e-9
    found = told(spoiled, capsys, code=3)
    assert found["inputs"]["keyframes"] == 4
    assert (
        found["inputs"]["pauses"]
        == f"1, the longest {5 * step:.2f} s, {2 * step:.2f} s after the first; usual are {step:.2f} s"
    )
    assert found["inputs"]["keyframes_without_tracks"] == 1
    assert "1 of 4 keyframes have no tracks" in found["attention"]


def test_info_names_two_rigs(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other, both = tmp_path / "other.mcap", tmp_path / "both.mcap"
    assert main(["synth", str(other), "--baseline-m", "0", "--keyframes", "5"]) == 0
    assert main(["merge", str(bag), str(other), "--out", str(both)]) == 3
    found = told(both, capsys, code=3)
    assert "2 camera rigs that differ: a session keeps its first, and drops the others" in found["attention"]


def test_info_says_why_a_replay_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign = tmp_path / "images.mcap"
    with BagWriter(foreign) as writer:
        for number in range(3):
            image = ROSBAGS_FACTORY.make("std_msgs/msg/String", data="x") if number else None
            if image is not None:
                writer.write("/chatter", "std_msgs/msg/String", image, number)
    found = told(foreign, capsys, code=3)
    assert "ba_msgs/msg/Keyframe" in found["refusal"]
    assert found["topics"]["/chatter"]["count"] == 2
    (tmp_path / "broken.mcap").write_bytes(b"no recording")
    assert main(["info", str(tmp_path / "broken.mcap")]) == 2
    assert "broken.mcap" in capsys.readouterr().err


def test_a_cut_keeps_the_cameras_and_the_bytes(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "part.mcap"
    with BagReader(bag) as reader:
        whole = list(reader.raw())
    first = whole[0][1]
    begin, end = 0.6, 1.4
    assert main(["cut", str(bag), "--out", str(part), "--start", str(begin), "--end", str(end)]) == 0
    inside = [(c.topic, t, d) for c, t, d in whole if first + begin * 1e9 <= t <= first + end * 1e9]
    assert len(inside) > 8
    with BagReader(part) as reader:
        got = [(c.topic, t, d) for c, t, d in reader.raw()]
        assert [row for row in got if row[0] != "/camera_rig"] == inside
        assert any(isinstance(m, CameraRig) for _, _, m in reader.measurements())
        assert next(c for c, _, _ in reader.raw(["/camera_rig"])).is_latched
    assert f"{part}: {len(inside) + 1} messages" in capsys.readouterr().out
    assert main(["cut", str(bag), "--out", str(part), "--topics", "keyframes"]) == 0
    with BagReader(part) as reader:
        assert reader.topics == {"/keyframes": "ba_msgs/msg/Keyframe"}
        assert reader.message_count == KEYFRAMES


def test_parts_merge_to_what_they_were(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ["poses.mcap", "rest.mcap", "both.mcap"]
    poses, rest, both = (tmp_path / name for name in names)
    assert main(["cut", str(bag), "--out", str(poses), "--topics", "keyframes", "ground_truth/pose"]) == 0
    assert main(["cut", str(bag), "--out", str(rest), "--topics", "camera_rig", "feature_tracks"]) == 0
    assert main(["merge", str(poses), str(rest), "--out", str(both)]) == 0

    def content(path: Path) -> list[tuple[int, str, bytes]]:
        with BagReader(path) as reader:
            return sorted((time, channel.topic, data) for channel, time, data in reader.raw())

    assert content(both) == content(bag)
    assert main(["replay", str(both), "--out", str(tmp_path / "out"), "--no-report"]) == 0
    capsys.readouterr()
    assert main(["merge", str(bag), str(poses), "--out", str(both)]) == 3
    assert "/keyframes is in several of them" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--start", "50"), "no message from 50 s on: it has "),
        (("--start", "2", "--end", "1"), "no message from 2 to 1 s"),
        (("--topics", "nothing"), "no topic /nothing; there are: /camera_rig, /feature_tracks"),
    ],
)
def test_a_cut_of_nothing_writes_nothing(
    arguments: tuple[str, ...], words: str, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cut", str(bag), "--out", str(tmp_path / "part.mcap"), *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--start", "nan"], "from nan to inf s: expected"),
        (["--end", "nan"], "to nan s"),
        (["--start", "inf"], "no message"),
    ],
)
def test_a_cut_from_nowhere_is_said(
    words: list[str], said: str, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cut", str(bag), "--out", str(tmp_path / "part.mcap"), *words]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert main(["cut", str(bag), "--out", str(tmp_path / "all.mcap"), "--start=-inf"]) == 0
