# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Markers and covariances over a real middleware: only for those who subscribe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.topics import TOPICS
from ba_node.ros import qos
from ba_node.ros.components import publishing
from ba_node.ros.message_factory import message_class
from ba_node.window import view
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


def tell_of_work() -> None:
    """Have the node say what it works out and what it builds."""

    def telling(name: str) -> Callable[..., Any]:
        work = getattr(view, name)

        def tell(*arguments: Any) -> Any:
            print("works out", name, flush=True)
            return work(*arguments)

        return tell

    for name in ("covariances", "view"):
        setattr(view, name, telling(name))

    def telling_topics(build: Callable[..., Any]) -> Callable[..., Any]:
        def tell(*arguments: Any) -> Any:
            built = build(*arguments)
            print("builds", *sorted({one[0] for one in built}), flush=True)
            return built

        return tell

    for name in ("output_messages", "pose_outputs"):
        vars(publishing)[name] = telling_topics(vars(publishing)[name])


@pytest.fixture(scope="module")
def data() -> SyntheticData:
    options = SyntheticOptions(seed=6, keyframes=6, length_m=10.0, path="line", outlier_share=0.0, tracks=100)
    return generate(options)


def watch(peer: Any, topic: str, latched: bool = False) -> Any:
    profile = qos.latched(100) if latched or topic == "markers" else qos.reliable(1000)
    cls = message_class(TOPICS[topic].type_name)
    return peer.node.create_subscription(cls, f"ba_node/{topic}", peer.received[topic].append, profile)


@pytest.mark.slow
def test_nothing_is_worked_out_that_nobody_looks_at(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    node, peer = start_node(prepare=tell_of_work), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    peer.play(data, session_id=0)
    assert "works out" not in node.out
    assert set(node.out.splitlines()) == {"builds", "builds refined_keyframes"}
    assert "pose" not in node.out and "path" not in node.out and "points" not in node.out
    late = make_peer()
    late.listen("path", "points")
    late.until(lambda: late.received["path"] and late.received["points"], "the map for one who comes late")
    assert len(late.received["path"][0].poses) == len(data.keyframes)
    late.close()
    subscription = watch(peer, "pose_with_covariance")
    peer.until(subscription.get_publisher_count, "the publisher")
    # The node learns of a subscriber a moment after the subscriber of it: from some solve on.
    session = 1
    while "works out covariances" not in node.out:
        peer.play(data, session)
        session += 1
        assert session < 20
    assert "works out view" not in node.out
    poses = peer.received["pose_with_covariance"]
    peer.until(lambda: poses and np.any(poses[-1].pose.covariance), "a pose with a covariance")
    covariance = np.asarray(poses[-1].pose.covariance).reshape(6, 6)
    deviation = np.sqrt(np.diagonal(covariance))
    assert np.all((deviation > 1e-5) & (deviation < 0.5)), deviation
    assert deviation[:3].max() > deviation[3:].max(), "metres first, then radians"
    assert poses[-1].header.frame_id == "map"

    peer.node.destroy_subscription(subscription)
    said = 0
    while said != node.out.count("works out"):
        said = node.out.count("works out")
        peer.play(data, session)
        session += 1
        assert session < 30
    assert node.stop() == 0


@pytest.mark.slow
def test_markers_show_the_window_and_begin_anew_with_a_session(
    start_node: StartNode, make_peer: MakePeer, data: SyntheticData
) -> None:
    start_node("--ros-args", "-p", "window.max_keyframes:=3")
    peer = make_peer()
    peer.advertise()
    peer.listen("report")
    subscription = watch(peer, "markers")
    peer.connect()
    peer.until(subscription.get_publisher_count, "the publisher")
    arrays = peer.received["markers"]
    session = 0
    while not arrays or len(arrays[-1].markers[-1].points) < 6:
        peer.play(data, session)
        session += 1
        assert session < 20
    assert arrays[0].markers[0].action == 3, "DELETEALL comes first"
    newest = {marker.ns: marker for marker in arrays[-1].markers}
    assert {"free", "fixed", "links"} <= {name for name, marker in newest.items() if marker.points}
    assert len(newest["free"].points) == 3 * 2 * 16
    assert all(marker.header.frame_id == "map" for marker in newest.values())
    ends = np.array([(p.x, p.y, p.z) for marker in newest.values() for p in marker.points])
    assert np.isfinite(ends).all()
    before = len(arrays)
    peer.play(data, session)
    peer.until(lambda: any(array.markers[0].action == 3 for array in arrays[before:]), "DELETEALL of the new session")
    late = make_peer()
    watch(late, "markers")
    late.until(lambda: late.received["markers"], "the markers that are kept")


@pytest.mark.slow
def test_odometry_goes_on_in_time(start_node: StartNode, make_peer: MakePeer, data: SyntheticData) -> None:
    """It is the newest keyframe of each solve, once; in a new session stamps may begin anew."""
    node, peer = start_node("--ros-args", "-p", "frames.base_frame:=robot"), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    subscription = watch(peer, "odometry")
    peer.connect()
    peer.until(subscription.get_publisher_count, "the publisher")
    found, session = peer.received["odometry"], 0
    while not found or np.diagonal(np.reshape(found[-1].pose.covariance, (6, 6))).max() > 1.0:
        found.clear()
        peer.play(data, session)
        session += 1
        assert session < 20
    newest_ns = data.keyframes[-1].stamp_ns
    peer.until(lambda: stamp_ns_from_message(found[-1].header.stamp) == newest_ns, "odometry of the newest keyframe")
    stamps = [stamp_ns_from_message(message.header.stamp) for message in found]
    assert stamps == sorted(set(stamps))
    assert len(found) >= len(data.keyframes) - 2, "of all but the first keyframes"
    assert {(message.header.frame_id, message.child_frame_id) for message in found} == {("map", "robot")}
    newest, refined = found[-1].pose.pose.position, peer.received["refined_keyframes"][-1]
    assert [newest.x, newest.y, newest.z] == list(refined.position[-3:])
    deviation = np.sqrt(np.diagonal(np.reshape(found[-1].pose.covariance, (6, 6))))
    assert np.all((deviation > 1e-6) & (deviation < 0.5)), deviation
    speed = np.linalg.norm([found[-1].twist.twist.linear.x, found[-1].twist.twist.linear.y])
    step = np.linalg.norm(data.keyframes[-1].position - data.keyframes[-2].position)
    lapse_s = 1e-9 * (data.keyframes[-1].stamp_ns - data.keyframes[-2].stamp_ns)
    assert abs(speed - step / lapse_s) < 0.05 * step / lapse_s
    late = make_peer()
    watch(late, "report", latched=True)
    late.until(lambda: late.received["report"], "the last report, which is kept")
    assert late.received["report"][0].newest_keyframe_id == data.keyframes[-1].keyframe_id
    late.close()
    assert node.stop() == 0
