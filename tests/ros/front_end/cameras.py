# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Cameras that publish images over a real middleware, and the real pairs that they have seen."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ba_node.messages.factory import header_message
from ba_node.ros import qos
from ba_node.ros.message_factory import RclpyFactory, message_class

FACTORY = RclpyFactory()
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
            topics = {f"{name}/image_raw{suffix}".lstrip("/"): kind}
            if name != "depth":
                topics[f"{name}/camera_info".lstrip("/")] = "CameraInfo"
            for topic, one in topics.items():
                made = peer.node.create_publisher(message_class(f"sensor_msgs/msg/{one}"), topic, qos.reliable(100))
                peer.publishers[topic] = made

    def connect(self) -> None:
        self.peer.until(lambda: all(p.get_subscription_count() for p in self.peer.publishers.values()), "the node")

    def publish(self, name: str, stamp_ns: int, pixels: Any, p: Any, encoding: str = "mono8", frame: str = "") -> None:
        if name != "depth":
            info = info_message(stamp_ns, p, pixels.shape[1::-1], frame or name)
            self.peer.publishers[f"{name}/camera_info".lstrip("/")].publish(info)
        if self.compressed:
            data = FACTORY.array(cv2.imencode(".png", pixels)[1].reshape(-1))
            message = message_class("sensor_msgs/msg/CompressedImage")(format="png", data=data)
            message.header = header_message(FACTORY, stamp_ns, name)
            self.peer.publishers[f"{name}/image_raw/compressed".lstrip("/")].publish(message)
        else:
            self.peer.publishers[f"{name}/image_raw".lstrip("/")].publish(image_message(stamp_ns, pixels, encoding))


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
