# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba_front_end`: images over a real middleware become keyframes, and with ba_node refined ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.messages.factory import header_message
from ba_node.ros import qos
from ba_node.ros.convert import RclpyFactory, message_class

pytestmark = pytest.mark.dds
PROGRAM = "ba_node.ros.front_end.main:main"
FACTORY = RclpyFactory()
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
BEGIN_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000


class Kitti:
    """51 real stereo pairs with their calibration and truth."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        rows = [line.split() for line in (folder / "calib.txt").read_text().splitlines() if line.strip()]
        self.p = [np.array([float(value) for value in row[-12:]]) for row in rows]
        self.truth = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)

    def image(self, side: str, i: int) -> Any:
        return cv2.imread(str(sorted((self.folder / f"image_{side[0]}").glob("*.png"))[i]), cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def kitti(shared_data: Path) -> Kitti:
    return Kitti(shared_data / "kitti-stereo-images")


def image_message(stamp_ns: int, pixels: Any, encoding: str = "mono8") -> Any:
    height, width = pixels.shape[:2]
    return message_class("sensor_msgs/msg/Image")(
        header=header_message(FACTORY, stamp_ns, "camera"),
        height=height,
        width=width,
        encoding=encoding,
        step=pixels.strides[0],
        data=FACTORY.array(np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)),
    )


def info_message(stamp_ns: int, p: Any, size: tuple[int, int], frame: str) -> Any:
    return message_class("sensor_msgs/msg/CameraInfo")(
        header=header_message(FACTORY, stamp_ns, frame),
        width=size[0],
        height=size[1],
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=p.reshape(3, 4)[:, :3].reshape(-1),
        r=np.eye(3).reshape(-1),
        p=p,
    )


class Camera:
    """Publishes images of streams with their camera_info."""

    def __init__(self, peer: Any, *names: str, compressed: bool = False) -> None:
        self.peer, self.names, self.compressed = peer, names, compressed
        suffix, kind = ("/compressed", "CompressedImage") if compressed else ("", "Image")
        for name in names:
            topics = {f"{name}/image_raw{suffix}": kind}
            if name != "depth":
                topics[f"{name}/camera_info"] = "CameraInfo"
            for topic, one in topics.items():
                made = peer.node.create_publisher(message_class(f"sensor_msgs/msg/{one}"), topic, qos.reliable(100))
                peer.publishers[topic] = made

    def connect(self) -> None:
        self.peer.until(lambda: all(p.get_subscription_count() for p in self.peer.publishers.values()), "the node")

    def publish(self, name: str, stamp_ns: int, pixels: Any, p: Any, encoding: str = "mono8") -> None:
        if name != "depth":
            info = info_message(stamp_ns, p, pixels.shape[1::-1], name)
            self.peer.publishers[f"{name}/camera_info"].publish(info)
        if self.compressed:
            data = FACTORY.array(cv2.imencode(".png", pixels)[1].reshape(-1))
            message = message_class("sensor_msgs/msg/CompressedImage")(format="png", data=data)
            message.header = header_message(FACTORY, stamp_ns, name)
            self.peer.publishers[f"{name}/image_raw/compressed"].publish(message)
        else:
            self.peer.publishers[f"{name}/image_raw"].publish(image_message(stamp_ns, pixels, encoding))


def play(camera: Camera, kitti: Kitti, rows: range, apart_ns: int = 0) -> Iterator[int]:
    """Publish stereo pairs; yield the number of each."""
    for i in rows:
        for side, p in zip(("left", "right"), kitti.p, strict=True):
            stamp = BEGIN_NS + i * STEP_NS + (apart_ns if side == "right" else 0)
            camera.publish(side, stamp, kitti.image(side, i), p)
        yield i


def begin(peer: Any, *names: str, **options: bool) -> Camera:
    camera = Camera(peer, *names, **options)
    camera.connect()
    return camera


def test_wrong_parameters_are_refused_in_a_line(start_node: StartNode) -> None:
    for argument, words in (
        ("mode:=fish", "option mode = 'fish': choose one of auto, stereo, rgbd, mono"),
        ("max_feature:=5", "'max_feature' does not exist; did you mean 'max_features'?"),
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


def test_pairs_are_tracked(start_node: StartNode, make_peer: MakePeer, kitti: Kitti) -> None:
    node, peer = start_node("--ros-args", "-p", "mode:=stereo", program=PROGRAM), make_peer()
    camera = Camera(peer, "left", "right")
    camera.connect()
    for _ in play(camera, kitti, range(3)):
        pass
    peer.until(lambda: "3 images" in node.err, "the log")
    assert node.stop() == 0
    assert node.out.startswith("stopped: 3 images"), node.out
