# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import itertools
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from ba_node.config import Config
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_writer import BagWriter
from ba_node.io.bal import read_bal
from ba_node.io.model import from_bal
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.messages import conversion
from ba_node.messages.topics import CAMERAS, INPUT_TYPES
from ba_node.offline.convert import timeline
from ba_node.offline.recording import record
from ba_node.offline.replay import replay
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from ba_node.ros.tools.play import Listener, PlayError, PlayOptions, PlaySummary, play
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

MakePeer = Callable[..., Any]
STEP_NS = 100_000_000


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=5, keyframes=8, length_m=10.0, path="line", tracks=100, guesses=True))


def _message(measurement: Any, stamp_ns: int) -> Any:
    return conversion.input_message(ROSBAGS_FACTORY, measurement, stamp_ns, "camera")[1]


@pytest.fixture
def bag(scene: SyntheticData, tmp_path: Path) -> Path:
    path = tmp_path / "scene.mcap"
    with BagWriter(path) as writer:
        for topic, stamp_ns, measurement in scene.timeline():
            message = _message(measurement, stamp_ns)
            writer.write(f"/{topic}", INPUT_TYPES[topic], message, stamp_ns, latched=topic == "camera_rig")
    return path


def _collect(peer: Any, prefix: str = "") -> dict[str, list[bytes]]:
    """Subscribe to all inputs and keep what comes, as bytes."""
    received: dict[str, list[bytes]] = {}
    for topic, kind in INPUT_TYPES.items():
        received[topic] = []
        profile = qos.latched(10) if topic in CAMERAS else qos.lossless()
        take = received[topic].append
        peer.node.create_subscription(message_class(kind), prefix + topic, take, profile, raw=True)
    return received


def _play(peer: Any, bag: Path, options: PlayOptions, listener: Listener | None = None) -> PlaySummary:
    """Play on a thread, while the peer takes what comes."""
    results: list[PlaySummary] = []
    player = threading.Thread(target=lambda: results.append(play(bag, options, listener or Listener())))
    player.start()
    peer.until(lambda: not player.is_alive(), "the end of the play", 60.0)
    assert results, "play raised"
    return results[0]


def _recorded(bag: Path) -> dict[str, list[bytes]]:
    recorded: dict[str, list[bytes]] = {topic: [] for topic in INPUT_TYPES}
    with BagReader(bag) as reader:
        for topic, _, _, data in reader.messages():
            recorded[topic.removeprefix("/")].append(bytes(data))
    return recorded


@pytest.mark.dds
@pytest.mark.parametrize(("namespace", "prefix"), [("", ""), ("car", "/car/")])
def test_every_recorded_byte_arrives(make_peer: MakePeer, bag: Path, namespace: str, prefix: str) -> None:
    peer = make_peer()
    received = _collect(peer, prefix)
    progress: list[tuple[int, int]] = []
    listener = Listener(progress=lambda done, total: progress.append((done, total)))
    summary = _play(peer, bag, PlayOptions(rate=0.0, namespace=namespace), listener)
    recorded = _recorded(bag)
    peer.until(lambda: all(len(received[t]) >= len(recorded[t]) for t in recorded), "every message")
    assert received == recorded
    assert summary.published == {f"{prefix or '/'}{t}": len(data) for t, data in recorded.items() if data}
    assert (summary.skipped, summary.unheard, summary.unconfirmed) == ({}, (), ())
    total = sum(map(len, recorded.values()))
    assert progress == [(i, total) for i in range(1, total + 1)]


@pytest.mark.dds
def test_a_remapped_topic_goes_elsewhere(make_peer: MakePeer, bag: Path) -> None:
    peer = make_peer()
    received: list[Any] = []
    cls = message_class(INPUT_TYPES["keyframes"])
    peer.node.create_subscription(cls, "/front/kf", received.append, qos.lossless())
    options = PlayOptions(
        rate=0.0, topics=("/keyframes",), ros_args=("--ros-args", "-r", "keyframes:=front/kf"), wait_s=20.0
    )
    summary = _play(peer, bag, options)
    assert summary.published == {"/front/kf": 8}
    peer.until(lambda: len(received) == 8, "8 keyframes")


@pytest.mark.dds
def test_keeps_the_recorded_times(make_peer: MakePeer, bag: Path, scene: SyntheticData) -> None:
    peer = make_peer()
    arrivals: list[float] = []
    cls = message_class(INPUT_TYPES["keyframes"])
    peer.node.create_subscription(cls, "keyframes", lambda _: arrivals.append(time.monotonic()), qos.lossless())
    summary = _play(peer, bag, PlayOptions(rate=2.0, topics=("/keyframes",)))
    peer.until(lambda: len(arrivals) == 8, "8 keyframes")
    recorded_s = (scene.keyframes[-1].stamp_ns - scene.keyframes[0].stamp_ns) * 1e-9
    assert recorded_s / 2 <= summary.duration_s < recorded_s / 2 + 1.0
    assert np.diff(arrivals).min() > 0.2 * recorded_s / 2 / 7, "they do not come in a burst"


@pytest.mark.dds
def test_says_who_does_not_listen(make_peer: MakePeer, bag: Path) -> None:
    peer = make_peer()
    peer.node.create_subscription(message_class(INPUT_TYPES["keyframes"]), "keyframes", lambda _: None, qos.lossless())
    notices: list[str] = []
    summary = _play(peer, bag, PlayOptions(rate=0.0, wait_s=0.5), Listener(notice=notices.append))
    assert sorted(summary.unheard) == ["/camera_rig", "/feature_tracks", "/landmark_guesses"]
    assert [notice for notice in notices if notice.startswith("nobody listens to") and "/feature_tracks" in notice]
    assert summary.published["/keyframes"] == 8


@pytest.mark.dds
@pytest.mark.usefixtures("domain")
def test_a_type_that_is_not_installed_is_skipped(
    bag: Path, monkeypatch: pytest.MonkeyPatch, make_peer: MakePeer
) -> None:
    def lookup(type_name: str) -> Any:
        if "Keyframe" not in type_name:
            raise LookupError(f"message type {type_name!r} is not known")
        return message_class(type_name)

    monkeypatch.setattr("ba_node.ros.tools.play.message_class", lookup)
    peer = make_peer()
    peer.node.create_subscription(message_class(INPUT_TYPES["keyframes"]), "keyframes", lambda _: None, qos.lossless())
    notices: list[str] = []
    summary = _play(peer, bag, PlayOptions(rate=0.0), Listener(notice=notices.append))
    assert summary.published == {"/keyframes": 8}
    assert sorted(summary.skipped) == ["/camera_rig", "/feature_tracks", "/landmark_guesses"]
    assert sum("is skipped" in notice for notice in notices) == 3


@pytest.mark.dds
@pytest.mark.usefixtures("domain")
def test_nothing_to_play_is_an_error(bag: Path) -> None:
    with pytest.raises(PlayError, match=r"no topic can be played; topics in the recording: .*/keyframes"):
        play(bag, PlayOptions(topics=("/images",)))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [("rate", -1.0, "--rate -1:"), ("rate", float("nan"), "--rate nan:"), ("wait_s", float("inf"), "--wait inf:")],
)
def test_senseless_options_are_refused(name: str, value: float, words: str) -> None:
    options: dict[str, Any] = {name: value}
    with pytest.raises(PlayError, match=f"{words} expected a finite number"):
        PlayOptions(**options)


@pytest.mark.slow
@pytest.mark.dds
def test_real_stereo_sequence_through_the_node(
    start_node: Callable[..., Any], make_peer: MakePeer, shared_data: Path
) -> None:
    node, peer = start_node(), make_peer()
    peer.listen("refined_keyframes", "report")
    peer.connect()
    summary = _play(peer, shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap", PlayOptions(rate=1.0))
    assert sum(summary.published.values()) == 104

    def refined() -> set[int]:
        return {int(key) for message in peer.received["refined_keyframes"] for key in message.keyframe_id}

    peer.until(lambda: len(refined()) == 26, "26 refined keyframes")
    assert peer.received["report"][-1].rms_px_after < 0.5
    assert peer.received["report"][-1].dropped == 0
    assert node.stop() == 0


@pytest.mark.dds
@pytest.mark.slow
def test_a_whole_map_comes_back_as_in_a_replay(
    start_node: Callable[..., Any], make_peer: MakePeer, shared_data: Path, tmp_path: Path
) -> None:
    """Ladybug-49: 49 cameras, one a keyframe. The node gives the topics of a replay, and every keyframe finite."""
    bag = tmp_path / "ladybug.mcap"
    record(bag, timeline(from_bal(read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))))
    assert replay(bag, tmp_path / "out", Config())["keyframes_refined"] == 49
    with BagReader(tmp_path / "out" / "refined.mcap") as offline:
        wanted = dict(offline.topics)
    node, peer = start_node(), make_peer()
    peer.listen("refined_keyframes", "pose", "path", "points", "report")
    peer.connect()
    _play(peer, bag, PlayOptions(rate=1.0))
    poses: dict[int, tuple[float, ...]] = {}

    def all_back() -> bool:
        for message in peer.received["refined_keyframes"]:
            rows = np.asarray(message.position).reshape(-1, 3)
            poses.update(zip(message.keyframe_id, map(tuple, rows), strict=True))
        return len(poses) == 49

    peer.until(all_back, "49 refined keyframes")
    assert np.isfinite(list(poses.values())).all()
    assert all(peer.received[topic.rsplit("/", 1)[-1]] for topic in wanted), f"of {sorted(wanted)}"
    assert peer.received["report"][-1].dropped == 0
    assert node.stop() == 0


@pytest.mark.dds
@pytest.mark.parametrize("rate", [0.0, 4.0])
def test_the_time_goes_with_the_recording(bag: Path, scene: SyntheticData, make_peer: MakePeer, rate: float) -> None:
    """Two rounds from the middle on, with the time on /clock; the cameras come although they were sent before."""
    peer = make_peer()
    received = _collect(peer)
    times: list[int] = []
    profile = qos.reliable(1000)
    peer.node.create_subscription(Clock, "/clock", lambda message: times.append(_ns(message.clock)), profile)
    start_ns = scene.keyframes[4].stamp_ns
    start_s = (start_ns - scene.keyframes[0].stamp_ns) * 1e-9
    options = PlayOptions(rate=rate, start_s=start_s, rounds=2, clock_hz=50.0)
    summary = _play(peer, bag, options)
    later = [keyframe for keyframe in scene.keyframes if keyframe.stamp_ns >= start_ns]
    assert summary.published["/keyframes"] == 2 * len(later) == 8
    peer.until(lambda: len(received["keyframes"]) == 8, "every keyframe")
    assert len(received["camera_rig"]) == 2
    peer.until(lambda: len(times) == summary.published["/clock"], "every time")
    last_ns = scene.keyframes[-1].stamp_ns
    assert (times[0], times[-1], max(times), min(times)) == (start_ns, last_ns, last_ns, start_ns)
    assert [b for a, b in itertools.pairwise(times) if b <= a] == [start_ns], "time goes back at the second round alone"
    stamps = {keyframe.stamp_ns for keyframe in later}
    assert stamps <= set(times)
    if rate:
        assert len(times) > 2 * len(stamps), "and between the messages"
        assert summary.duration_s >= 2 * (last_ns - start_ns) * 1e-9 / rate


@pytest.mark.slow
@pytest.mark.dds
def test_a_node_goes_by_that_time(bag: Path, scene: SyntheticData, make_peer: MakePeer, start_node: Any) -> None:
    node, peer = start_node("--ros-args", "-p", "use_sim_time:=true"), make_peer()
    peer.listen("report")
    peer.connect()
    summary = _play(peer, bag, PlayOptions(rate=2.0, clock_hz=100.0))
    assert not summary.unheard
    last = scene.keyframes[-1].keyframe_id
    reports = peer.received["report"]
    peer.until(lambda: reports and reports[-1].newest_keyframe_id == last, "the last report")
    # By the clock of the recording the newest pose is young; by the one on the wall it is years old.
    assert 0.0 <= reports[-1].stamp_latency_p50_s < 10.0
    assert node.stop() == 0


@pytest.mark.slow
@pytest.mark.dds
def test_a_loop_goes_on_until_it_is_interrupted(bag: Path, scene: SyntheticData, make_peer: MakePeer) -> None:
    peer = make_peer()

    def players() -> set[tuple[int, ...]]:
        infos = peer.node.get_publishers_info_by_topic("/keyframes")
        return {tuple(info.endpoint_gid) for info in infos if info.node_name == "ba_play"}

    received = _collect(peer)
    words = ["play", str(bag), "--rate", "0", "--loop"]
    command = ["env", "--default-signal=INT", sys.executable, "-m", "ba_node.cli.main", *words]

    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        peer.until(lambda: len(received["keyframes"]) > 3 * len(scene.keyframes), "the fourth round")
        peer.until(players, "the publishers to be known")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
    assert (process.returncode, error) == (130, "ba: interrupted\n")
    # Those that end without a word are known for 20 s.
    peer.until(lambda: not players(), "the publishers to be gone", timeout_s=10.0)


def test_a_start_after_the_end_is_refused(bag: Path) -> None:
    with pytest.raises(PlayError, match=r"--start 100: the recording is 1\.8 s long"):
        play(bag, PlayOptions(wait_s=0.0, start_s=100.0))


def _ns(stamp: Any) -> int:
    return int(Time.from_msg(stamp).nanoseconds)
