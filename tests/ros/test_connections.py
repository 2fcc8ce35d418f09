# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Who talks to the node and how: quality of service, silence, jumps of time, namespaces, over a real middleware."""

from __future__ import annotations

import dataclasses
import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES
from ba_node.ros.components import silence
from ba_node.ros.message_factory import message_class
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
KEYFRAMES = 6
BEST_EFFORT = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=5, keyframes=KEYFRAMES, length_m=10.0, path="line", outlier_share=0.0))


def _send(peer: Any, scene: SyntheticData, shift_ns: int = 0) -> None:
    """Publish a scene, each keyframe when the one before was solved, and the time if somebody made /clock."""
    reports = peer.received["report"]
    peer.publish(scene.rig)
    for keyframe, tracks in zip(scene.keyframes, scene.tracks, strict=True):
        stamp_ns = keyframe.stamp_ns + shift_ns
        if "/clock" in peer.publishers:
            peer.publishers["/clock"].publish(Clock(clock=Time(nanoseconds=stamp_ns).to_msg()))
        peer.publish(dataclasses.replace(keyframe, stamp_ns=stamp_ns))
        for image in tracks:
            peer.publish(image, stamp_ns)
        what = f"a report on keyframe {keyframe.keyframe_id}"
        peer.until(
            lambda key=keyframe.keyframe_id: reports and reports[-1].newest_keyframe_id == key and _full(reports), what
        )


def _full(reports: list[Any]) -> bool:
    return bool(reports[-1].keyframes + reports[-1].fixed_keyframes > 1 or reports[-1].newest_keyframe_id == 0)


def _connected(make_peer: MakePeer, namespace: str = "") -> Any:
    peer = make_peer(namespace=namespace)
    peer.advertise()
    peer.listen("report", "refined_keyframes", "path")
    peer.connect()
    return peer


@pytest.mark.slow
def test_publisher_and_subscriber_that_do_not_match_are_named(start_node: StartNode, make_peer: MakePeer) -> None:
    node, peer = start_node(), make_peer()
    peer.node.create_publisher(message_class(INPUT_TYPES["keyframes"]), "keyframes", BEST_EFFORT)
    peer.until(lambda: "/keyframes: no messages pass" in node.err, "a warning about the publisher")
    warning = next(line for line in node.err.splitlines() if "/keyframes: no messages pass" in line)
    assert "[WARN]" in warning
    assert "between this node and publisher /peer: incompatible RELIABILITY" in warning
    assert "qos_overrides./keyframes.*" in warning
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.node.create_subscription(message_class(OUTPUT_TYPES["pose"]), "ba_node/pose", print, latched)
    peer.until(lambda: "/ba_node/pose: no messages pass" in node.err, "a warning about the subscriber")
    assert "subscriber /peer: incompatible DURABILITY" in node.err


@pytest.mark.slow
def test_a_camera_driver_that_does_not_latch_is_nothing_to_warn_about(
    start_node: StartNode, make_peer: MakePeer
) -> None:
    node, peer = start_node(), make_peer()
    camera = peer.node.create_publisher(message_class(INPUT_TYPES["camera_info"]), "camera_info", BEST_EFFORT)
    peer.until(camera.get_subscription_count, "the node to subscribe")
    peer.node.create_publisher(message_class(INPUT_TYPES["keyframes"]), "keyframes", BEST_EFFORT)
    peer.until(lambda: "/keyframes: no messages pass" in node.err, "the warning that is due")
    assert "camera_info" not in node.err


def test_quality_of_service_is_overridden_by_parameters(start_node: StartNode, make_peer: MakePeer) -> None:
    arguments = ["qos_overrides./feature_tracks.subscription.reliability:=best_effort"]
    arguments += ["qos_overrides./ba_node/points.publisher.durability:=volatile"]
    node, peer = start_node("--ros-args", *(word for name in arguments for word in ("-p", name))), make_peer()
    infos = peer.node.get_subscriptions_info_by_topic
    peer.until(lambda: infos("/feature_tracks") and infos("/keyframes"), "the node to subscribe")
    assert infos("/feature_tracks")[0].qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert infos("/keyframes")[0].qos_profile.reliability == ReliabilityPolicy.RELIABLE
    peer.until(lambda: peer.node.get_publishers_info_by_topic("/ba_node/points"), "the node to publish")
    (info,) = peer.node.get_publishers_info_by_topic("/ba_node/points")
    assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
    assert node.stop() == 0


def test_an_override_of_no_topic_is_an_error(start_node: StartNode, make_peer: MakePeer) -> None:
    node, peer = start_node("--ros-args", "-p", "qos_overrides./keyframe.subscription.depth:=5"), make_peer()
    words = "did you mean 'qos_overrides./keyframes.subscription.depth'"
    peer.until(lambda: words in node.err, "the error")
    assert node.alive


@pytest.mark.slow
def test_silence_names_topics_and_publishers(start_node: StartNode, make_peer: MakePeer, scene: SyntheticData) -> None:
    node = start_node("--ros-args", "-r", "__ns:=/car", "-r", "keyframes:=front/kf", "-p", "node.silence_s:=1.0")
    peer = make_peer(namespace="car")
    peer.advertise()
    peer.until(lambda: "no feature_tracks for" in node.err and "no keyframes for" in node.err, "warnings")
    keyframes, tracks = (
        next(line for line in node.err.splitlines() if f"no {topic} for" in line)
        for topic in ("keyframes", "feature_tracks")
    )
    assert "/car/front/kf (ba_msgs/msg/Keyframe) has 0 publishers" in keyframes
    peer.until(lambda: "/car/feature_tracks (ba_msgs/msg/FeatureTracks) has 1 publisher from" in node.err, tracks)
    assert "/car/peer (ba_msgs/msg/FeatureTracks)" in node.err
    assert "no cameras came either; /car/camera_rig" in keyframes
    del scene
    assert node.stop() == 0


@pytest.mark.slow
@pytest.mark.parametrize("sim_time", [False, True], ids=["wall time", "use_sim_time"])
def test_a_bag_that_plays_again_begins_a_new_session(
    sim_time: bool, start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    arguments = ["-p", "scene.max_reorder_s:=0.5", "-p", f"use_sim_time:={str(sim_time).lower()}"]
    node, peer = start_node("--ros-args", *arguments), make_peer()
    if sim_time:
        peer.publishers["/clock"] = peer.node.create_publisher(Clock, "/clock", 10)
    peer.advertise()
    peer.listen("report", "refined_keyframes", "path")
    peer.connect()
    _send(peer, scene)
    span_s = (scene.keyframes[-1].stamp_ns - scene.keyframes[0].stamp_ns) * 1e-9
    assert span_s > 0.5, "the first keyframe lies further back than the bound"
    first_round = len(peer.received["report"])
    _send(peer, scene)
    assert f"keyframe 0 is {span_s:.1f} s older than the newest" in node.err
    assert "a new session begins" in node.err
    again = peer.received["report"][first_round:]
    assert [r.newest_keyframe_id for r in again][-1] == KEYFRAMES - 1
    assert max(r.keyframes + r.fixed_keyframes for r in again) <= KEYFRAMES, "the map of the first round is gone"
    # By the wall clock the data is years old.
    ages_s = [abs(r.stamp_latency_p50_s) for r in peer.received["report"]]
    assert max(ages_s) < 60.0 if sim_time else min(ages_s) > 1e7, ages_s
    assert node.stop() == 0


@pytest.mark.slow
def test_keyframes_out_of_order_are_sorted_by_their_stamps(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    node, peer = start_node(), _connected(make_peer)
    peer.publish(scene.rig)
    for i in (0, 1, 3, 2, 5, 4):
        peer.publish(scene.keyframes[i])
        for image in scene.tracks[i]:
            peer.publish(image, scene.keyframes[i].stamp_ns)
        wanted = scene.keyframes[i].keyframe_id
        # The first has nothing to be refined against.
        peer.until(lambda i=i, wanted=wanted: i == 0 or wanted in peer.refined_ids(), f"keyframe {wanted}, refined")
    stamps = [keyframe.stamp_ns for keyframe in scene.keyframes]

    def path_stamps() -> list[int]:
        paths = peer.received["path"]
        return [stamp_ns_from_message(pose.header.stamp) for pose in paths[-1].poses] if paths else []

    peer.until(lambda: path_stamps() == stamps, "a path in the order of time")
    assert "a new session begins" not in node.err
    last = peer.received["report"][-1]
    assert last.keyframes + last.fixed_keyframes == KEYFRAMES
    assert node.stop() == 0


@pytest.mark.slow
@pytest.mark.parametrize("shift_ns", [0, 9 * 10**9])
def test_a_pause_of_nine_seconds_changes_nothing(
    shift_ns: int, start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    """The stamps go on where they stopped, or nine seconds later; map -> odom is repeated meanwhile."""
    node, peer = start_node(), _connected(make_peer)
    transforms = peer.received["/tf"]
    peer.node.create_subscription(message_class("tf2_msgs/msg/TFMessage"), "/tf", transforms.append, 100)
    _send(peer, _part(scene, slice(0, 3)))
    end_s = time.monotonic() + 9.0
    peer.until(lambda: time.monotonic() > end_s, "the end of the pause")
    assert len(transforms) > 20
    _send(peer, _part(scene, slice(3, None)), shift_ns)
    expected = {k.stamp_ns + (shift_ns if i >= 3 else 0) for i, k in enumerate(scene.keyframes)}
    peer.until(lambda: _stamps(peer) >= expected, "every keyframe")
    assert {report.session_id for report in peer.received["report"]} == {0}
    stamps = [stamp_ns_from_message(message.transforms[0].header.stamp) for message in transforms]
    assert np.all(np.diff(stamps) > 0)
    assert node.stop() == 0


def _part(scene: SyntheticData, rows: slice) -> SyntheticData:
    return dataclasses.replace(scene, keyframes=scene.keyframes[rows], tracks=scene.tracks[rows])


def _stamps(peer: Any) -> set[int]:
    return {int(stamp) for message in peer.received["refined_keyframes"] for stamp in message.stamp_ns}


@pytest.mark.slow
def test_two_nodes_in_two_namespaces_do_not_disturb_each_other(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    nodes = [start_node("--ros-args", "-r", f"__ns:=/{name}") for name in ("left", "right")]
    left, right = _connected(make_peer, "left"), _connected(make_peer, "right")
    _send(left, scene)
    left.until(lambda: left.received["path"], "the path on the left")
    assert not right.received["report"]
    _send(right, scene, shift_ns=10**12)
    right.until(lambda: right.received["path"], "the path on the right")
    for peer, shift_ns in ((left, 0), (right, 10**12)):
        expected = {keyframe.stamp_ns + shift_ns for keyframe in scene.keyframes}
        peer.until(lambda peer=peer, expected=expected: _stamps(peer) >= expected, "every keyframe")
        assert _stamps(peer) == expected
    assert [node.stop() for node in nodes] == [0, 0]


def lose_patience() -> None:
    """Have the node say sooner that a clock stands still."""
    vars(silence)["_CLOCK_PATIENCE_S"] = 0.6


@pytest.mark.slow
def test_simulated_time_without_a_clock_is_told(start_node: StartNode, make_peer: MakePeer) -> None:
    """By name, in the log and on /diagnostics; a clock that comes, or another parameter, ends it."""
    node = start_node("--ros-args", "-p", "use_sim_time:=true", prepare=lose_patience)
    peer = make_peer()
    peer.node.create_subscription(DiagnosticArray, "/diagnostics", peer.received["/diagnostics"].append, 10)

    def inputs() -> str:
        arrays = peer.received["/diagnostics"]
        found = [one.message for one in arrays[-1].status if one.name.endswith(": inputs")] if arrays else []
        return str(found[0]) if found else ""

    words = r"use_sim_time is true and no time has come for \d+ s: /clock has 0 publishers; start the simulation, play"
    peer.until(lambda: re.search(words, inputs()), "a warning on /diagnostics")
    peer.until(lambda: re.search(words, node.err), "a warning in the log")
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    peer.until(lambda: clock.get_subscription_count() > 0, "the node to hear the time")
    ticks = iter(range(1, 10**6))

    def told(wanted: str) -> Callable[[], bool]:
        return lambda: clock.publish(Clock(clock=Time(seconds=next(ticks)).to_msg())) or wanted in inputs()

    peer.until(lambda: told("")() and "use_sim_time" not in inputs(), "the time")
    still = r"the time has stood still for \d+ s: /clock has 1 publisher \(/peer\)"
    peer.until(lambda: re.search(still, inputs()), "it to stand still")
    assert peer.set("use_sim_time", False).successful
    peer.until(lambda: "use_sim_time" not in inputs(), "the wall clock")
    assert node.stop() == 0
