# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba_front_end`: images over a real middleware become keyframes, and with ba_node refined ones."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from ba_node.estimate import Correction
from ba_node.messages.cdr import tf_message
from ba_node.ros import qos
from ba_node.ros.message_factory import message_class
from tests.ros.front_end.cameras import BEGIN_NS, STEP_NS, Camera, Kitti, begin, image_message, play

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")
pytestmark = pytest.mark.dds
PROGRAM = "ba_node.ros.front_end.main:main"
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


@pytest.fixture(scope="module")
def kitti(shared_data: Path) -> Kitti:
    return Kitti(shared_data / "kitti-stereo-images")


@pytest.mark.slow
def test_wrong_parameters_are_refused_in_a_line(start_node: StartNode) -> None:
    for argument, words in (
        ("mode:=fish", "option mode = 'fish': choose one of auto, stereo, rgbd, mono"),
        ("max_feature:=5", "'max_feature' does not exist; did you mean 'max_features'?"),
        ("rig_file:=/no/rig.yaml", "/no/rig.yaml: cannot be opened"),
        ("mask_file:=/no/mask.png", "mask /no/mask.png: no picture"),
        ("max_features:=5", "option max_features = 5: expected a number in [50, 10000]"),
    ):
        node = start_node("--ros-args", "-p", argument, program=PROGRAM)
        assert node.wait() == 2
        assert node.err.startswith("ba_front_end: ") and words in node.err, node.err
    node = start_node("stereo", program=PROGRAM)
    assert node.wait() == 2
    assert "argument 'stereo' is not known" in node.err


def test_what_cannot_be_tracked_is_said_with_figures(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    """Nobody publishes; then a right image 60 ms late; then left and right swapped. The node goes on."""
    node, peer = start_node("--ros-args", "-p", "mode:=stereo", program=PROGRAM), make_peer()
    peer.until(lambda: "nobody publishes /left/image_raw and /right/image_raw" in node.err, "the log")
    camera = begin(peer, "left", "right")
    image = kitti.image("left", 0)
    for i in range(3):
        camera.publish("right", BEGIN_NS + i * STEP_NS * 2 + 60_000_000, image, kitti.p[0])
        camera.publish("left", BEGIN_NS + i * STEP_NS * 2, image, kitti.p[1])
    peer.until(lambda: "no right/image_raw" in node.err and "+60.0 ms off" in node.err, "the log")
    for i in range(3):
        for name, p in (("left", kitti.p[1]), ("right", kitti.p[0])):
            camera.publish(name, BEGIN_NS + (10 + i) * STEP_NS, image, p)
    peer.until(lambda: "left and right are swapped" in node.err, "the log")
    assert node.stop() == 0
    assert node.out.startswith("stopped: 0 images, 0 keyframes; left out: no right/image_raw = "), node.out


def at_10_hz(camera: Camera, kitti: Kitti, rows: range, turned_deg: float = 0.0) -> None:
    """Publish pairs as a camera does, whatever the node is doing, and take messages in between.

    The second camera is turned by so much about its vertical axis.
    """
    read = {(side, i): kitti.image(side, i) for i in rows for side in ("left", "right")}
    if turned_deg:
        K = kitti.p[1].reshape(3, 4)[:, :3]
        warp = K @ cv2.Rodrigues(np.array([0.0, np.radians(turned_deg), 0.0]))[0] @ np.linalg.inv(K)
        for (side, i), image in list(read.items()):
            if side == "right":
                size = image.shape[::-1]
                read[side, i] = cv2.warpPerspective(image, warp, size, None, cv2.INTER_CUBIC, cv2.BORDER_REFLECT)
    began = time.monotonic()
    for n, i in enumerate(rows):
        while time.monotonic() < began + n * STEP_NS / 1e9:
            camera.peer.executor.spin_once(timeout_sec=0.005)
        for side, p in zip(("left", "right"), kitti.p, strict=True):
            camera.publish(side, BEGIN_NS + i * STEP_NS, read[side, i], p)


def errors(kitti: Kitti, stamps: Any, position: Any) -> Any:
    """Return the distances from the truth, m, of positions at stamps in ns; both begin at the first left camera."""
    return np.linalg.norm(position - kitti.truth[(np.asarray(stamps) - BEGIN_NS) // STEP_NS, :, 3], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, pytest.param(51, marks=pytest.mark.slow)])
def test_pairs_at_10_hz_come_back_as_refined_keyframes(
    count: int, start_node: StartNode, make_peer: MakePeer, kitti: Kitti
) -> None:
    """None is dropped on the way, and the trajectory is as near to the truth as offline."""
    back_end, node, peer = start_node(), start_node(program=PROGRAM), make_peer()
    peer.listen("refined_keyframes", "report")
    poses = peer.received["odometry"]
    kind = message_class("nav_msgs/msg/Odometry")
    peer.node.create_subscription(kind, "ba_front_end/odometry", poses.append, qos.reliable(1000))
    camera = begin(peer, "left", "right")
    peer.until(lambda: peer.node.count_subscribers("keyframes"), "the back-end")
    at_10_hz(camera, kitti, range(count))
    peer.until(lambda: poses and stamp_of(poses[-1]) == BEGIN_NS + (count - 1) * STEP_NS, "the last pose")
    assert node.stop() == 0
    said = re.fullmatch(r"stopped: (\d+) images, (\d+) keyframes; left out: nothing\n", node.out)
    assert said and int(said[1]) == count, node.out
    peer.until(lambda: len(peer.refined_ids()) == int(said[2]), "all keyframes")
    assert back_end.stop() == 0
    length_m = np.linalg.norm(np.diff(kitti.truth[:count, :, 3], axis=0), axis=1).sum()
    at = [message.pose.pose.position for message in poses]
    tracked = errors(kitti, [stamp_of(message) for message in poses], np.array([(p.x, p.y, p.z) for p in at]))
    last = peer.received["refined_keyframes"][-1]
    refined = errors(kitti, last.stamp_ns, np.asarray(last.position).reshape(-1, 3))
    for name, error in (("tracked", tracked), ("refined", refined)):
        assert error.max() < 0.1 + 0.01 * length_m, f"{name}: {error.max():.3f} m on {length_m:.1f} m"


@pytest.mark.slow
def test_a_turned_second_camera_begins_the_map_again(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    """By 0.1 degree: the first keyframes come again, as another session, and its map is as near to the truth."""
    back_end, node, peer = start_node(), start_node(program=PROGRAM), make_peer()
    peer.listen("refined_keyframes", "report")
    as_back_end(peer)
    camera = begin(peer, "left", "right")
    peer.until(lambda: peer.node.count_subscribers("keyframes") > 1, "the back-end")
    at_10_hz(camera, kitti, range(20), turned_deg=0.1)
    sent, refined = peer.received["keyframes"], peer.received["refined_keyframes"]
    last_ns = BEGIN_NS + 17 * STEP_NS

    def is_refined() -> bool:
        return bool(refined) and refined[-1].session_id == sent[-1].session_id and max(refined[-1].stamp_ns) >= last_ns

    peer.until(is_refined, "the last keyframe")
    first, second = sorted({one.session_id for one in sent})
    began_ns = next(stamp_of(one) for one in sent if one.session_id == second)
    assert (second, began_ns) == (first + 1, BEGIN_NS)
    assert "px of yaw" in node.err and "tracked again; the one before is void" in node.err
    stamps, at = np.asarray(refined[-1].stamp_ns), np.asarray(refined[-1].position).reshape(-1, 3)
    true = kitti.truth[(stamps - BEGIN_NS) // STEP_NS, :, 3]
    ways = [float(np.linalg.norm(np.diff(one, axis=0), axis=1).sum()) for one in (at, true)]
    assert ways[0] / ways[1] == pytest.approx(1.0, abs=0.01), ways
    assert node.stop() == 0 and back_end.stop() == 0


def as_back_end(peer: Any) -> None:
    """Subscribe to keyframes and tracks: without both nothing is sent."""
    for topic, kind in (("keyframes", "Keyframe"), ("feature_tracks", "FeatureTracks")):
        take = peer.received[topic].append
        peer.node.create_subscription(message_class(f"ba_msgs/msg/{kind}"), topic, take, qos.reliable(1000))


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


@pytest.mark.slow
def test_other_modes_and_compressed_images(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    """One compressed camera under another name, with odometry by TF from a base that /tf_static places."""
    arguments = ("-p", "odometry:=tf", "-p", "base_frame:=base_link", "-r", "image_raw:=cam/image_raw")
    node = start_node("--ros-args", *arguments, program=PROGRAM)
    peer = make_peer()
    sent = peer.received["keyframes"]
    as_back_end(peer)
    rigs = peer.received["camera_rig"]
    peer.node.create_subscription(message_class("ba_msgs/msg/CameraRig"), "camera_rig", rigs.append, qos.latched())
    tf = message_class("tf2_msgs/msg/TFMessage")
    static = peer.node.create_publisher(tf, "/tf_static", qos.latched())
    moving = peer.publishers["/tf"] = peer.node.create_publisher(tf, "/tf", qos.reliable(100))
    static.publish(tf_message(Correction("camera", np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0])),
                              "base_link", 0))  # fmt: skip
    camera = begin(peer, "cam", compressed=True)
    for i in range(15):
        image = kitti.image("left", i)
        stamp = BEGIN_NS + i * STEP_NS
        camera.publish("cam", stamp, image, kitti.p[0], frame="camera")
        place = Correction("base_link", kitti.truth[i, :, 3], np.array([0.0, 0.0, 0.0, 1.0]))
        moving.publish(tf_message(place, "odom", stamp))
    peer.until(lambda: len(sent) >= 3, "keyframes")
    assert sent[0].header.frame_id == "odom"
    assert (rigs[0].header.frame_id, rigs[0].body_from_camera[0].position.z) == ("base_link", 1.0)
    position = sent[-1].pose.pose.position
    i = (
        sent[-1].keyframe_id and (sent[-1].header.stamp.sec * 10**9 + sent[-1].header.stamp.nanosec - BEGIN_NS)
    ) // STEP_NS
    assert position.z == pytest.approx(kitti.truth[i, 2, 3], abs=0.05)
    assert node.stop() == 0


@pytest.mark.slow
def test_depth_and_masks(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    """Depth from semi-global matching in mm; a mask that lets the lower half alone be seen; stamps in the future."""
    node, peer = start_node("--ros-args", "-p", "mask_topic:=true", program=PROGRAM), make_peer()
    as_back_end(peer)
    camera = Camera(peer, "rgb", "depth")
    kind = message_class("sensor_msgs/msg/Image")
    peer.publishers["mask"] = peer.node.create_publisher(kind, "mask", qos.reliable(100))
    camera.connect()
    match = cv2.StereoSGBM.create(0, 128, 5)
    begin_ns = time.time_ns() + 10**10
    mask = np.zeros_like(kitti.image("left", 0))
    mask[mask.shape[0] // 2 :] = 255
    # A mask is lost that the node has no connection for yet, and an image may come without: the first one comes often.
    for _ in range(10):
        peer.publishers["mask"].publish(image_message(begin_ns, mask))
        next_s = time.monotonic() + 0.1
        peer.until(lambda until_s=next_s: time.monotonic() > until_s, "the next one")
    for i in range(8):
        left, right = kitti.image("left", i), kitti.image("right", i)
        disparity = match.compute(left, right).astype(float) / 16.0
        depth = np.where(disparity > 1.0, -kitti.p[1][3] / np.maximum(disparity, 1.0), 0.0)
        stamp = begin_ns + i * STEP_NS
        camera.publish("rgb", stamp, np.dstack([left] * 3), kitti.p[0], "bgr8")
        camera.publish("depth", stamp, np.minimum(depth * 1000.0, 65535).astype(np.uint16), kitti.p[0], "16UC1")
        peer.publishers["mask"].publish(image_message(stamp, mask))
    peer.until(lambda: len(peer.received["feature_tracks"]) >= 4, "tracks")
    v = np.concatenate([np.asarray(message.v) for message in peer.received["feature_tracks"]])
    assert len(v) > 200 and v.min() > left.shape[0] // 2 - 2
    depth_m = np.concatenate([np.asarray(message.depth_m) for message in peer.received["feature_tracks"]])
    assert 5.0 < np.nanmedian(depth_m) < 40.0
    last = peer.received["keyframes"][-1]
    moved = kitti.truth[(stamp_of(last) - begin_ns) // STEP_NS, 2, 3]
    assert last.pose.pose.position.z == pytest.approx(moved, rel=0.1)
    assert "ahead of this machine's clock" in node.err
    assert node.stop() == 0


@pytest.mark.slow
def test_darkness_raises_the_covariance_and_then_the_session(
    start_node: StartNode, make_peer: MakePeer, kitti: Kitti
) -> None:
    """The keyframe after two black pairs tells its step with what they left open; after six another map begins."""
    node, peer = start_node("--ros-args", "-p", "max_lost:=4", program=PROGRAM), make_peer()
    keyframes, poses = peer.received["keyframes"], peer.received["odometry"]
    as_back_end(peer)
    kind = message_class("nav_msgs/msg/Odometry")
    peer.node.create_subscription(kind, "ba_front_end/odometry", poses.append, qos.reliable(1000))
    camera = begin(peer, "left", "right")
    shown: list[int | None] = [0, 1, 2, 3, None, None, 4, 5, *[None] * 6, 40, 41]
    for n, i in enumerate(shown):
        for side, p in zip(("left", "right"), kitti.p, strict=True):
            pixels = kitti.image(side, i or 0)
            camera.publish(side, BEGIN_NS + n * STEP_NS, pixels if i is not None else 0 * pixels, p)
    peer.until(lambda: poses and stamp_of(poses[-1]) == BEGIN_NS + (len(shown) - 1) * STEP_NS, "the last pose")
    sigma_m = {(stamp_of(one) - BEGIN_NS) // STEP_NS: float(one.pose.covariance[0]) ** 0.5 for one in poses}
    assert [sigma_m[n] for n in (4, 5, 8, 13)] == pytest.approx([0.2, 0.3, 0.2, 0.7])
    assert max(sigma_m[n] for n in (1, 2, 3, 6, 7)) < 0.1
    told = {(stamp_of(one) - BEGIN_NS) // STEP_NS: one for one in keyframes}
    assert told[6].pose.covariance[0] ** 0.5 == pytest.approx(0.3)
    assert not any(np.any(told[n].pose.covariance) for n in told if n < 6 or n == 14)
    assert told[14].session_id == told[6].session_id + 1
    for words in ("shows nothing", "now lost", "images without a pose; the map of the one before stays as it is"):
        assert words in node.err, node.err
    assert node.stop() == 0


@pytest.mark.slow
def test_a_restart_of_the_node_is_another_session(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    node, peer = start_node(program=PROGRAM), make_peer()
    sent = peer.received["keyframes"]
    as_back_end(peer)
    camera = begin(peer, "left", "right")
    for _ in play(camera, kitti, range(3)):
        pass
    peer.until(lambda: sent, "a keyframe")
    for transition in ("deactivate", "cleanup", "configure", "activate"):
        request = ChangeState.Request(transition=Transition(label=transition))
        client = peer.node.create_client(ChangeState, "ba_front_end/change_state")
        peer.until(client.service_is_ready, "the service")
        future = client.call_async(request)
        peer.until(future.done, transition)
        assert future.result().success, transition
    camera.connect()
    peer.until(lambda: node.err.count("is taken as right/image_raw") == 2, "the log")
    for _ in play(camera, kitti, range(3, 6)):
        pass
    peer.until(lambda: sent[-1].session_id > sent[0].session_id, "another session")
    assert node.stop() == 0


@pytest.mark.slow
@pytest.mark.parametrize("announced", [False, True])
def test_a_right_camera_that_starts_late(
    announced: bool, start_node: StartNode, make_peer: MakePeer, kitti: Kitti
) -> None:
    """Left images alone for seconds, which is said; then pairs, as mosaics in yellow light, and steps of true scale."""
    node, peer = start_node(program=PROGRAM), make_peer()
    sent = peer.received["keyframes"]
    as_back_end(peer)
    tint = np.tile([[1.0, 0.8], [0.8, 0.4]], np.array(kitti.image("left", 0).shape) // 2 + 1)
    camera = Camera(peer, *(("left", "right") if announced else ("left",)))

    def publish(side: str, number: int) -> None:
        image = kitti.image(side, max(number, 0))
        mosaic = (image * tint[: image.shape[0], : image.shape[1]]).astype(np.uint8)
        camera.publish(side, BEGIN_NS + number * STEP_NS, mosaic, kitti.p[side == "right"], "bayer_rggb8")

    words = "no image came for 5 s of /right/image_raw" if announced else "nobody publishes /right/image_raw"
    if announced:
        camera.connect()
    early = -200
    while words not in node.err and early < 0:
        publish("left", early)
        early, next_s = early + 1, time.monotonic() + STEP_NS / 1e9
        peer.until(lambda until_s=next_s: time.monotonic() > until_s, "the next one")
    assert words in node.err, node.err
    assert not sent
    if not announced:
        Camera(peer, "right")
        camera.connect()
    for i in range(12):
        for side in ("left", "right"):
            publish(side, i)
    peer.until(lambda: sent and stamp_of(sent[-1]) >= BEGIN_NS + 9 * STEP_NS, "keyframes")
    assert stamp_of(sent[0]) == BEGIN_NS
    at = sent[-1].pose.pose.position
    assert errors(kitti, [stamp_of(sent[-1])], np.array([[at.x, at.y, at.z]])).max() < 0.25
    assert node.stop() == 0
    assert "mosaic of colours" not in node.err and "ms off" not in node.err, node.err
