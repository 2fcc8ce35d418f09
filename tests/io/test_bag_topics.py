# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a recording are taken, and that nothing is guessed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_source import BagChannel
from ba_node.io.bag_topics import NO_CHOICE, BagError, Chooser, TopicChoice, parse_topic
from ba_node.io.bag_writer import BagWriter
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses
from ba_node.messages.conversion import input_message
from ba_node.messages.topics import INPUT_TYPES
from ba_node.offline.replay import MapOptions, replay
from experiments.synthetic import SyntheticOptions, generate

F = ROSBAGS_FACTORY
KF, FT, LG, RIG, INFO = "keyframes", "feature_tracks", "landmark_guesses", "camera_rig", "camera_info"
FRAMES = {"/left/camera_info": "left", "/right/camera_info": "right", "/feature_tracks": "right"}


def choose(found: dict[str, list[str]], choice: TopicChoice = NO_CHOICE, frames: dict[str, str] | None = None) -> Any:
    def frame(topic: str) -> str:
        return (frames or {}).get(topic, topic)

    return Chooser(found, lambda topic: frozenset({frame(topic)}), lambda topic: camera(frame(topic))).choose(choice)


def camera(frame: str, focal: float = 400.0) -> CameraRig:
    pose = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]])
    intrinsics, size = np.array([[focal, focal, 320.0, 240.0]]), np.array([[640, 480]])
    return CameraRig("body", (frame,), ("plumb_bob",), intrinsics, (np.zeros(5),), size, *pose)


def robots(*names: str, guesses: bool = False) -> dict[str, list[str]]:
    kinds = (KF, FT, RIG, LG) if guesses else (KF, FT, RIG)
    return {kind: [f"{name}/{kind}" for name in names] for kind in kinds}


def test_camera_info_is_the_one_whose_frame_the_tracks_are_in() -> None:
    found = {KF: ["/keyframes"], FT: ["/feature_tracks"], INFO: ["/left/camera_info", "/right/camera_info"]}
    chosen = choose(found, frames=FRAMES)
    assert chosen.taken[INFO] == "/right/camera_info"
    assert chosen.left == {"/left/camera_info": "/right/camera_info is taken as camera_info"}


def test_cameras_that_cannot_be_told_apart_are_refused_unless_they_say_the_same() -> None:
    found = {KF: ["/keyframes"], FT: ["/feature_tracks"], INFO: ["/a/camera_info", "/b/camera_info"]}
    frames = {"/a/camera_info": "left", "/b/camera_info": "left", "/feature_tracks": "left"}
    assert choose(found, frames=frames).taken[INFO] == "/a/camera_info"
    words = r"cannot tell which camera_info are meant.*frame 'other'.*--topic camera_info=/a/camera_info"
    with pytest.raises(BagError, match=words):
        choose(found, frames={"/feature_tracks": "other"})
    picked = TopicChoice({INFO: "/b/camera_info"})
    assert choose(found, picked, {"/feature_tracks": "other"}).taken[INFO] == "/b/camera_info"


def test_the_name_and_place_of_the_input_tell() -> None:
    found = {KF: ["/keyframes"], FT: ["/feature_tracks"], INFO: ["/camera_info", "/rear/camera_info"]}
    assert choose(found).taken[INFO] == "/camera_info"


def test_a_rig_leaves_camera_info_aside() -> None:
    found = {KF: ["/keyframes"], FT: ["/feature_tracks"], RIG: ["/camera_rig"], INFO: ["/a", "/b"]}
    chosen = choose(found)
    assert INFO not in chosen.taken
    assert chosen.left == {"/a": "/camera_rig tells the cameras", "/b": "/camera_rig tells the cameras"}


def test_a_lone_camera_that_says_other_numbers_than_the_rig_is_named() -> None:
    found = {KF: ["/keyframes"], FT: ["/feature_tracks"], RIG: ["/camera_rig"], INFO: ["/a", "/b"]}
    said = {"/camera_rig": camera("left"), "/a": camera("left", 500.0), "/b": camera("left", 400.0001)}
    chosen = Chooser(found, lambda topic: frozenset({topic}), said.__getitem__).choose(NO_CHOICE)
    assert chosen.left["/b"] == "/camera_rig tells the cameras"
    assert chosen.left["/a"].endswith("with other numbers for 'left': fx = 400 px where this says 500")


def test_two_robots_need_a_namespace() -> None:
    found = robots("/robot1", "/robot2", guesses=True)
    with pytest.raises(BagError, match=r"which keyframes .*--topic keyframes=/robot1/keyframes or --namespace /robot1"):
        choose(found)
    for space in ("/robot2", "robot2", "robot2/"):
        chosen = choose(found, TopicChoice(namespace=space))
        assert chosen.taken == {kind: f"/robot2/{kind}" for kind in (KF, FT, LG, RIG)}
        assert len(chosen.left) == 4
    by_topic = choose(found, TopicChoice({KF: "/robot1/keyframes"}))
    assert by_topic.taken == {kind: f"/robot1/{kind}" for kind in (KF, FT, LG, RIG)}
    with pytest.raises(BagError, match=r"--namespace /robot3: no keyframes in it; there are: /robot1/k.*, /robot2/k"):
        choose(found, TopicChoice(namespace="/robot3"))


def test_what_belongs_to_another_robot_is_never_taken() -> None:
    found = robots("/robot1", "/robot2")
    found[LG], found[RIG] = ["/robot2/landmark_guesses"], ["/robot2/camera_rig"]
    chosen = choose(found, TopicChoice(namespace="/robot1"))
    assert chosen.taken == {KF: "/robot1/keyframes", FT: "/robot1/feature_tracks"}
    found[RIG] = ["/camera_rig"]
    assert choose(found, TopicChoice(namespace="/robot1")).taken[RIG] == "/camera_rig"


def test_one_robot_without_tracks_is_not_meant() -> None:
    found = robots("/robot1", "/robot2")
    found[FT] = ["/robot2/feature_tracks"]
    assert choose(found).taken[KF] == "/robot2/keyframes"


def test_several_keyframes_of_one_robot() -> None:
    tracks = ["/feature_tracks", "/loop/feature_tracks"]
    found = {KF: ["/keyframes", "/loop/keyframes"], FT: tracks, RIG: ["/camera_rig"]}
    with pytest.raises(BagError, match="cannot tell which keyframes are meant: /keyframes, /loop/keyframes"):
        choose(found)
    found[FT] = ["/feature_tracks"]
    assert choose(found).taken[KF] == "/keyframes"


def test_words_that_name_nothing() -> None:
    with pytest.raises(BagError, match=r"--topic keyframe=/x: expected NAME=TOPIC, NAME being one of keyframes, "):
        parse_topic("keyframe=/x")
    with pytest.raises(BagError, match="expected NAME=TOPIC"):
        parse_topic("keyframes")
    assert parse_topic("keyframes=robot1/kf") == (KF, "/robot1/kf")
    with pytest.raises(BagError, match=r"--topic keyframes=/x: no such topic of ba_msgs/msg/Keyframe; there are: /r/k"):
        choose(robots("/r"), TopicChoice({KF: "/x"}))


def write_robots(path: Path, spaces: dict[str, int]) -> None:
    """Write the recordings of several robots, by namespace and seed, into one file."""
    entries = []
    for space, seed in spaces.items():
        data = generate(SyntheticOptions(keyframes=12, landmarks=3000, tracks=150, length_m=10.0, seed=seed))
        for topic, stamp, m in data.timeline():
            if isinstance(m, CameraRig):
                message = input_message(F, m, stamp)[1]
            elif isinstance(m, Keyframe):
                message = input_message(F, m)[1]
            elif isinstance(m, LandmarkGuesses):
                message = input_message(F, m, stamp, "odom")[1]
            else:
                assert isinstance(m, FeatureTracks)
                message = input_message(F, m, stamp, f"camera{m.camera_index}")[1]
            entries.append((stamp, f"{space}/{topic}", INPUT_TYPES[topic], message))
    entries.sort(key=lambda entry: entry[0])
    with BagWriter(path) as bag:
        for stamp, topic, kind, message in entries:
            bag.write(topic, kind, message, stamp)


def test_a_robot_of_two_gives_what_it_gives_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_robots(tmp_path / "two.mcap", {"/robot1": 1, "/robot2": 2})
    write_robots(tmp_path / "one.mcap", {"": 2})
    arguments = ["replay", str(tmp_path / "two.mcap"), "--out", str(tmp_path / "out"), "--no-report"]
    assert main(arguments) == 2
    assert "--namespace /robot1" in capsys.readouterr().err
    assert main([*arguments, "--namespace", "/robot2"]) == 0
    out = capsys.readouterr().out
    assert "topics                 /robot2/keyframes, /robot2/feature_tracks" in out
    assert "left aside             /robot1/keyframes: /robot2/keyframes is taken as keyframes" in out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["topics_taken"][RIG] == "/robot2/camera_rig"
    assert set(report["topics_left"]) >= {f"/robot1/{kind}" for kind in (KF, FT, RIG)}
    replay(tmp_path / "one.mcap", tmp_path / "alone", Config())
    assert (tmp_path / "alone" / "trajectory.tum").read_bytes() == (tmp_path / "out" / "trajectory.tum").read_bytes()
    options = MapOptions(topics=TopicChoice({KF: "/robot2/keyframes"}))
    replay(tmp_path / "two.mcap", tmp_path / "again", Config(), options=options)
    assert (tmp_path / "again" / "trajectory.tum").read_bytes() == (tmp_path / "out" / "trajectory.tum").read_bytes()


def test_topics_without_messages_are_not_meant(tmp_path: Path) -> None:
    write_robots(tmp_path / "one.mcap", {"/robot2": 2})
    with BagReader(tmp_path / "one.mcap") as reader:
        messages = list(reader.messages())
    with BagWriter(tmp_path / "two.mcap") as bag:
        for name in (KF, FT, RIG):
            bag._register(BagChannel(0, f"/robot1/{name}", INPUT_TYPES[name], ("cdr", "ros2msg"), "", 0), {})
        for topic, kind, time, data in messages:
            bag.write(topic, kind, data, time)
    with BagReader(tmp_path / "two.mcap") as reader:
        assert "/robot1/keyframes" in reader.topics
        list(reader.measurements())
        assert reader.taken[KF] == "/robot2/keyframes"
