# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba_adapter --from SOURCE` between a front-end and the node, over a real middleware."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message

from ba_node.io.rig_file import rig_yaml
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from tests.messages.adapters import layouts
from tests.messages.adapters.layouts import Sent

pytestmark = pytest.mark.dds
PROGRAM = "ba_node.ros.tools.adapter:main"
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


def play(peer: Any, messages: list[Sent]) -> None:
    """Publish messages of rosbags once the adapter has subscribed to all their topics."""
    for sent in messages:
        if sent.topic not in peer.publishers:
            kind = message_class(sent.type_name)
            peer.publishers[sent.topic] = peer.node.create_publisher(kind, sent.topic, qos.reliable(100))
    peer.until(lambda: all(p.get_subscription_count() for p in peer.publishers.values()), "the adapter to subscribe")
    for sent in messages:
        data = bytes(layouts.store().serialize_cdr(sent.message, sent.type_name))
        peer.publishers[sent.topic].publish(deserialize_message(data, message_class(sent.type_name)))


def needs_rtabmap_msgs() -> None:
    """Skip where the package of the tests is not the one that is installed: the real one has more fields."""
    try:
        fields = set(message_class("rtabmap_msgs/msg/OdomInfo").get_fields_and_field_types())
    except LookupError:
        pytest.skip("rtabmap_msgs is not built: make setup")
    if fields != {name for name, _ in layouts.store().fielddefs["rtabmap_msgs/msg/OdomInfo"][1]}:
        pytest.skip("another rtabmap_msgs is installed")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "expected", "images"),
    [
        ("openvins", 12, 12),
        ("rtabmap", 12, 12),
        ("rtabmap_map", 12, 23),  # each node but the last comes again
        pytest.param("vins_fusion", 9, 9, marks=pytest.mark.slow),
    ],
)
def test_what_a_front_end_publishes_comes_back_refined(
    source: str, expected: int, images: int, start_node: StartNode, make_peer: MakePeer
) -> None:
    rectified = source.startswith("rtabmap")
    if rectified:
        needs_rtabmap_msgs()
    data = layouts.scene(12, "none" if rectified else "plumb_bob")
    node, adapter, peer = start_node(), start_node("--from", source, program=PROGRAM), make_peer()
    peer.listen("refined_keyframes")
    peer.until(lambda: peer.node.count_subscribers("keyframes"), "the node")
    peer.until(lambda: peer.node.count_publishers("keyframes"), "the adapter")
    play(peer, list(getattr(layouts, source)(data)))
    wanted = {keyframe.stamp_ns for keyframe in data.keyframes[:expected]}
    if source == "openvins":
        peer.until(lambda: peer.refined_ids() >= wanted, "all keyframes")
    else:  # which of the two stamps a keyframe has, is that of its pose
        peer.until(lambda: len(peer.refined_ids()) == expected, "all keyframes")
    # Counts and reasons stand in the log while it runs.
    peer.until(lambda: f"{expected} keyframes of {images} images" in adapter.err, "the log")
    if source == "openvins":
        assert "not_seen_by_camera_0 = 36" in adapter.err
    if source == "rtabmap_map":
        assert "ambiguous_word = 24" in adapter.err and "repeated_keyframe = 11" in adapter.err
    assert adapter.stop() == 0, adapter.err
    assert adapter.out.startswith(f"stopped: {expected} keyframes of {images} images"), adapter.out
    assert node.stop() == 0


@pytest.mark.slow
def test_without_a_front_end_it_is_said_what_is_missing(start_node: StartNode, make_peer: MakePeer) -> None:
    adapter, peer = start_node("--from", "vins_mono", program=PROGRAM), make_peer()
    peer.until(lambda: "nobody publishes" in adapter.err, "the log")
    for words in ("/feature (sensor_msgs/msg/PointCloud)", "/keyframe_pose", "is vins_mono running?"):
        assert words in adapter.err
    assert adapter.stop() == 0


def test_what_cannot_be_is_refused_in_a_line(start_node: StartNode, tmp_path: Path) -> None:
    """Where rtabmap's messages are installed, it is taken."""
    broken = tmp_path / "rig.yaml"
    broken.write_text("a: 1")
    adapter = start_node("--from", "openvins", "--rig", str(broken), program=PROGRAM)
    assert adapter.wait() == 2
    assert adapter.err.startswith("ba_adapter: ") and "no rig" in adapter.err
    try:
        message_class("rtabmap_msgs/msg/OdomInfo")
    except LookupError:
        adapter = start_node("--from", "rtabmap", program=PROGRAM)
        assert adapter.wait() == 2
        assert "ros-jazzy-rtabmap-msgs" in adapter.err and "Traceback" not in adapter.err


@pytest.mark.slow
def test_a_rig_is_given_in_a_file(tmp_path: Path, start_node: StartNode, make_peer: MakePeer) -> None:
    """Without extrinsics of the source; it starts before anybody listens to keyframes, which is said."""
    data = layouts.scene()
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig_yaml(data.rig)[0])
    adapter, peer = start_node("--from", "vins_fusion", "--rig", str(rig), program=PROGRAM), make_peer()
    messages = [sent for sent in layouts.vins_fusion(data) if not sent.topic.endswith("extrinsic")]
    play(peer, messages)
    peer.until(lambda: "nobody_listens = 9" in adapter.err, "the log")
    assert adapter.stop() == 0
