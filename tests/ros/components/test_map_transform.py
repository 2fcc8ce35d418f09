# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom on /tf, and cameras placed by /tf_static, over a real middleware."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

tf2 = pytest.importorskip("tf2_msgs.msg", reason="needs tf2_msgs: make setup", exc_type=ImportError)
geometry_msgs = pytest.importorskip("geometry_msgs.msg")

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
S = 1_000_000_000
TOLERANCE_NS = S // 5


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    return generate(
        SyntheticOptions(
            seed=3, keyframes=8, length_m=10.0, path="line", outlier_share=0.0, drift_rotation_deg=2.0, tracks=100
        )
    )


def listening(make_peer: MakePeer) -> Any:
    peer = make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.node.create_subscription(tf2.TFMessage, "/tf", peer.received["/tf"].append, qos.reliable(1000))
    return peer


def newest_refined(peer: Any, data: SyntheticData) -> Any:
    """Return the refined keyframes of the last solve; topics have no order among each other."""
    refined, newest = peer.received["refined_keyframes"], data.keyframes[-1].keyframe_id
    peer.until(lambda: refined and refined[-1].keyframe_id[-1] == newest, "the newest keyframe")
    return refined[-1]


def transforms(peer: Any) -> list[Any]:
    return [stamped for message in peer.received["/tf"] for stamped in message.transforms]


def placed(stamped: Any) -> Transform:
    t, q = stamped.transform.translation, stamped.transform.rotation
    rotation = geometry.matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w]))
    return Transform(rotation, np.array([t.x, t.y, t.z]))


def assert_leads_to_refined(peer: Any, data: SyntheticData, stamped: Any) -> None:
    """Compare map -> odom * odom -> base of the newest keyframe with its refined pose."""
    refined = newest_refined(peer, data)
    newest = {keyframe.keyframe_id: keyframe for keyframe in data.keyframes}[int(refined.keyframe_id[-1])]
    odom_from_base = Transform(geometry.matrix_from_quaternion(newest.orientation), newest.position)
    map_from_base = placed(stamped).after(odom_from_base)
    np.testing.assert_allclose(map_from_base.translation, refined.position[-3:], atol=1e-9)
    expected = geometry.matrix_from_quaternion(np.asarray(refined.orientation[-4:]))
    np.testing.assert_allclose(map_from_base.rotation, expected, atol=1e-9)


@pytest.mark.slow
def test_map_to_odom_and_odometry_together_are_the_refined_pose(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.connect()
    peer.play(data)
    newest_ns = data.keyframes[-1].stamp_ns

    def of_newest() -> list[Any]:
        return [s for s in transforms(peer) if stamp_ns_from_message(s.header.stamp) >= newest_ns + TOLERANCE_NS]

    # Repeated while no keyframe comes: whoever looks up now finds it.
    peer.until(lambda: len(of_newest()) >= 5, "repeated transforms")
    assert {(s.header.frame_id, s.child_frame_id) for s in transforms(peer)} == {("map", "odom")}
    stamps = [stamp_ns_from_message(s.header.stamp) for s in transforms(peer)]
    assert stamps == sorted(set(stamps)), "stamps rise, as tf asks"
    assert of_newest()[-1].transform == of_newest()[0].transform
    assert_leads_to_refined(peer, data, of_newest()[-1])
    assert max(report.correction_m for report in peer.received["report"]) > 0.0
    assert node.stop() == 0, node.err


@pytest.mark.slow
def test_a_gate_holds_the_transform_but_not_the_map(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    arguments = ["-p", "frames.gate_m:=0.000001", "-p", "frames.gate_confirmations:=1000"]
    start_node("--ros-args", *arguments, "-p", "frames.transform_tolerance:=0.5", "-p", "frames.odom_frame:=vo")
    peer = listening(make_peer)
    peer.connect()
    peer.play(data)
    usable = [report for report in peer.received["report"] if report.status < 3]
    assert [report.correction_held for report in usable] == [False] + [True] * (len(usable) - 1)
    peer.until(lambda: len(transforms(peer)) > len(usable), "transforms after the last solve")
    found = [placed(stamped) for stamped in transforms(peer)]
    assert transforms(peer)[0].child_frame_id == "vo"
    for one in found:
        np.testing.assert_array_equal(one.translation, found[0].translation)
    first = stamp_ns_from_message(transforms(peer)[0].header.stamp)
    assert first - data.keyframes[1].stamp_ns >= S // 2


@pytest.mark.slow
def test_it_can_be_switched_off_and_on_again(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    node, peer = start_node("--ros-args", "-p", "frames.publish_tf:=false"), listening(make_peer)
    peer.connect()
    peer.play(data)
    assert peer.received["/tf"] == []
    peer.until(lambda: "/tf is off: frames.publish_tf = false" in node.err, "a word about it")
    assert peer.set("frames.publish_tf", True).successful
    peer.until(lambda: peer.received["/tf"], "a transform")


@pytest.mark.slow
def test_a_front_end_that_calls_its_frame_map_leaves_no_room(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(), listening(make_peer)
    peer.connect()
    named = [dataclasses.replace(keyframe, frame_id="map") for keyframe in data.keyframes]
    peer.play(dataclasses.replace(data, keyframes=tuple(named)))
    peer.until(lambda: "give frames.map_frame another name" in node.err, "a warning")
    assert peer.received["/tf"] == []
    assert node.err.count("give frames.map_frame another name") == 1


def forget_tf2_msgs() -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "tf2_msgs"]:
        del sys.modules[name]
    modules: Any = sys.modules
    modules["tf2_msgs"] = None
    message_class.cache_clear()


@pytest.mark.slow
def test_without_tf2_msgs_it_runs_and_says_once_what_is_off(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node("--ros-args", "-p", "frames.extrinsics:=tf_static", prepare=forget_tf2_msgs), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    peer.play(data)
    assert newest_refined(peer, data)
    assert peer.node.count_publishers("/tf") == 0
    assert node.err.count("/tf is off: tf2_msgs is not installed") == 1, node.err
    assert node.err.count("cameras sit where camera_rig says") == 1, node.err
    assert node.stop() == 0


def static_transform(parent: str, child: str, place: Transform) -> Any:
    message = geometry_msgs.TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = place.translation.tolist()
    q.x, q.y, q.z, q.w = geometry.quaternion_from_matrix(place.rotation).tolist()
    return message


@pytest.mark.slow
def test_cameras_sit_where_tf_static_says(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    node, peer = start_node("--ros-args", "-p", "frames.extrinsics:=tf_static"), listening(make_peer)
    static = peer.node.create_publisher(tf2.TFMessage, "/tf_static", qos.latched())
    peer.publishers["/tf_static"] = static
    peer.connect()
    rig = data.rig
    elsewhere = dataclasses.replace(rig, position=rig.position + 3.0, orientation=np.roll(rig.orientation, 1, axis=1))
    peer.publish(elsewhere)
    peer.until(lambda: f"no way from 'base_link' to '{rig.names[0]}'" in node.err, "a word on what is missing")
    mast = Transform(geometry.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([0.0, 0.0, 1.0]))
    found = [static_transform("base_link", "mast", mast)]
    for name, position, orientation in zip(rig.names, rig.position, rig.orientation, strict=True):
        camera = Transform(geometry.matrix_from_quaternion(orientation), position)
        found.append(static_transform("mast", name, mast.inverse().after(camera)))
    static.publish(tf2.TFMessage(transforms=found))
    peer.play(dataclasses.replace(data, rig=elsewhere))
    last = peer.received["report"][-1]
    assert last.status < 3, last.reason
    assert last.rms_px_after < 2.0, "with the places of the rig nothing would fit"
    refined = newest_refined(peer, data)
    error = np.asarray(refined.position).reshape(-1, 3) - data.truth.position[-len(refined.keyframe_id) :]
    before = data.odometry.position - data.truth.position
    assert np.sqrt(np.mean(error**2)) < 0.5 * np.sqrt(np.mean(before**2))
