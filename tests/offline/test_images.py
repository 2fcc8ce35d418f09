# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Images from recordings and folders: which are meant, their rig, stamps and odometry, and what is said of bad ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.io.bag_topics import BagError
from ba_node.offline.images import ImageRequest, open_images
from tests.io.test_rig_file import a_rig
from tests.messages.adapters import layouts
from tests.messages.adapters.layouts import Sent

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
STEP_NS = 100_000_000
SIZE = (64, 48)


def picture(seed: int) -> Any:
    return np.random.default_rng(seed).integers(0, 256, SIZE[::-1], dtype=np.uint8)


def image(topic: str, stamp_ns: int, seed: int, *, depth: bool = False, compressed: bool = False) -> Sent:
    header = layouts.header(stamp_ns, topic)
    if compressed:
        data = cv2.imencode(".png", picture(seed))[1].reshape(-1)
        return Sent(topic, COMPRESSED, layouts.make(COMPRESSED, header=header, format="png", data=data), stamp_ns)
    pixels = np.full(SIZE[::-1], 1500, np.uint16) if depth else picture(seed)
    fields = {"encoding": "16UC1" if depth else "mono8", "step": SIZE[0] * pixels.itemsize}
    message = layouts.make(
        IMAGE, header=header, width=SIZE[0], height=SIZE[1], data=pixels.view(np.uint8).reshape(-1), **fields
    )
    return Sent(topic, IMAGE, message, stamp_ns)


def info(topic: str, frame: str, shift_m: float = 0.0) -> Sent:
    message = layouts.make(
        layouts.CAMERA_INFO, header=layouts.header(1, frame), width=SIZE[0], height=SIZE[1],
        distortion_model="plumb_bob", d=np.zeros(5), k=np.array([50.0, 0, 31.5, 0, 50.0, 23.5, 0, 0, 1]),
        r=np.eye(3).reshape(-1), p=np.array([50.0, 0, 31.5, 50.0 * shift_m, 0, 50.0, 23.5, 0, 0, 0, 1, 0]),
    )  # fmt: skip
    return Sent(topic, layouts.CAMERA_INFO, message, 1)


def stereo(left: str = "/left", right: str = "/right", end: str = "image_raw", **options: Any) -> list[Sent]:
    sent = [info(f"{left}/camera_info", "left"), info(f"{right}/camera_info", "right", -0.12)]
    for i in range(4):
        sent += [
            image(f"{side}/{end}", (i + 1) * STEP_NS, 10 * i + n, **options) for n, side in enumerate((left, right))
        ]
    return sent


def read(path: Path, **request: Any) -> tuple[Any, list[Any]]:
    with open_images(path, ImageRequest(**request)) as source:
        return source, list(source.read())


@pytest.mark.parametrize(
    ("messages", "request_"),
    [
        (stereo(), {}),
        (stereo("/robot/left", "/robot/right"), {}),
        (stereo(end="image_raw/compressed", compressed=True), {}),
        (stereo("/z_first", "/a_second", "image_rect"), {}),  # the right one is told by its p
        ([*stereo(), *stereo(end="image_raw/compressed", compressed=True)[2:]], {}),  # raw and compressed are one
        ([*stereo("/cam0", "/cam1"), image("/other/image", 1, 0)],
         {"topics": {"left": "/cam0/image_raw", "right": "cam1/image_raw"}}),
    ],
)  # fmt: skip
def test_pairs_are_found(messages: list[Sent], request_: Mapping[str, Any], tmp_path: Path) -> None:
    source, frames = read(layouts.write(tmp_path / "bag", messages), **request_)
    assert (source.mode, source.total, len(frames)) == ("stereo", 4, 4)
    assert np.allclose(source.rig.position, [[0.0, 0.0, 0.0], [0.12, 0.0, 0.0]])
    for i, (images, odometry) in enumerate(frames):
        assert (images.stamp_ns, images.skew_ns, odometry) == ((i + 1) * STEP_NS, 0, None)
        assert np.array_equal(images.grey[0], picture(10 * i)) and np.array_equal(images.grey[1], picture(10 * i + 1))
    assert not source.counted


def test_depth_is_told_by_its_encoding(tmp_path: Path) -> None:
    messages = [info("/camera/color/camera_info", "color")]
    for i in range(3):
        messages += [image("/camera/aligned/image", i * STEP_NS, i, depth=True)]
        messages += [image("/camera/color/image", i * STEP_NS, i)]
    source, frames = read(layouts.write(tmp_path / "bag", messages))
    assert (source.mode, len(frames), len(source.rig)) == ("rgbd", 3, 1)
    assert frames[0][0].depth_m == pytest.approx(np.full(SIZE[::-1], 1.5))


def test_topics_of_rectified_images_have_the_camera_of_p(tmp_path: Path) -> None:
    messages = stereo(end="image_rect")
    for sent in messages[:2]:
        sent.message.d[0], sent.message.k[0] = -0.3, 60.0
    rig = read(layouts.write(tmp_path / "bag", messages))[0].rig
    assert (rig.intrinsics[0, 0], rig.distortion[0].tolist(), rig.position[1, 0]) == (50.0, [], pytest.approx(0.12))


def test_odometry_comes_at_the_time_of_the_image(tmp_path: Path) -> None:
    messages = [info("/camera_info", "cam")]
    for i in range(4):
        stamp = (i + 1) * STEP_NS
        messages.append(image("/image_raw", stamp, i))
        later = stamp + 50_000_000
        pose = layouts.odometry(later, "odom", [i, 0, 0], [0, 0, 0, 1])
        messages.append(Sent("/odom", layouts.ODOMETRY, pose, later))
    source, frames = read(layouts.write(tmp_path / "bag", messages), topics={"odometry": "/odom"})
    assert source.mode == "mono"
    assert [pose.translation[0] for _, pose in frames] == pytest.approx([0.5, 1.5, 2.5])
    assert source.counted == {"no odometry": 1}


def test_odometry_of_another_frame_is_said(tmp_path: Path) -> None:
    pose = layouts.odometry(STEP_NS, "odom", [1, 0, 0], [0, 0, 0, 1], "base_link")
    messages = [
        info("/camera_info", "cam"),
        image("/image_raw", STEP_NS, 0),
        Sent("/odom", layouts.ODOMETRY, pose, STEP_NS),
    ]
    source, frames = read(layouts.write(tmp_path / "bag", messages), topics={"odometry": "/odom"})
    assert len(frames) == 1 and not source.counted
    assert "no way from there to 'cam'" in source.warnings["odometry of another frame"]


def transforms(stamp_ns: int, *links: tuple[str, str, list[float]]) -> Any:
    """Return a tf2_msgs/TFMessage of links (parent, child, place)."""
    made = [
        layouts.make(
            "geometry_msgs/msg/TransformStamped",
            header=layouts.header(stamp_ns, parent),
            child_frame_id=child,
            transform=layouts.transform_at(place, [0, 0, 0, 1]),
        )
        for parent, child, place in links
    ]
    return layouts.make("tf2_msgs/msg/TFMessage", transforms=made)


def with_transforms(parent: str = "odom") -> list[Sent]:
    """Return images of a camera 0.2 m above a base that moves 1 m an image, among other transforms."""
    kind = "tf2_msgs/msg/TFMessage"
    sent = [
        info("/camera_info", "cam"),
        Sent("/tf_static", kind, transforms(1, ("base_link", "cam", [0.0, 0.0, 0.2])), 1),
    ]
    for i in range(4):
        stamp = (i + 1) * STEP_NS
        links = ("map", "odom", [7.0, 0, 0]), (parent, "marker", [99.0, 0, 0]), (parent, "base_link", [float(i), 0, 0])
        sent.append(Sent("/tf", kind, transforms(stamp, *links), stamp))
        sent.append(image("/image_raw", stamp, i))
    return sent


def test_odometry_by_transforms(tmp_path: Path) -> None:
    """Those from the fixed frame to what the cameras sit on, and no others."""
    bag = layouts.write(tmp_path / "bag", with_transforms())
    for topic in ("/tf", "tf:odom"):
        source, frames = read(bag, topics={"odometry": topic})
        assert [pose.translation.tolist() for _, pose in frames] == [[i, 0.0, 0.2] for i in range(4)]
        assert not source.counted and not source.warnings
    source, frames = read(bag, topics={"odometry": "/tf"}, base="base_link")
    assert [pose.translation.tolist() for _, pose in frames] == [[i, 0.0, 0.0] for i in range(4)]
    source, frames = read(bag, topics={"odometry": "/tf:map"})
    assert not frames and source.counted == {"no odometry": 4}
    words = source.warnings["odometry of another frame"]
    assert words.startswith("transforms from 'map' are to odom, and /tf_static has no way from there to 'cam'")
    with pytest.raises(BagError, match=r"from 'odom': say --topic odometry=/tf:FRAME; there are .* from: map, world"):
        read(layouts.write(tmp_path / "world", with_transforms("world")), topics={"odometry": "/tf"})


def test_odometry_that_nobody_asked_for_is_named(tmp_path: Path) -> None:
    """Nothing of transforms that do not lead from odom to the body."""

    def told(name: str, messages: list[Sent], **request: Any) -> str:
        with open_images(layouts.write(tmp_path / name, messages), ImageRequest(**request)) as source:
            return source.unused_odometry()

    pose = layouts.odometry(STEP_NS, "odom", [1, 0, 0], [0, 0, 0, 1])
    bare = [info("/camera_info", "cam"), image("/image_raw", STEP_NS, 0)]
    wheels = [*bare, Sent("/wheels/odom", layouts.ODOMETRY, pose, STEP_NS)]
    assert told("bare", bare) == ""
    words = "the recording has /wheels/odom (nav_msgs/Odometry): --topic odometry=/wheels/odom takes the scale from it"
    assert told("wheels", wheels) == words
    assert told("asked", wheels, topics={"odometry": "/wheels/odom"}) == ""
    assert "/tf (transforms from odom): --topic odometry=/tf takes" in told("tf", with_transforms())
    assert told("world", with_transforms("world")) == ""
    loose = [one for one in with_transforms() if one.topic != "/tf_static"]
    assert told("loose", loose) == ""


def test_a_calibration_that_changes_is_said(tmp_path: Path) -> None:
    messages = [*stereo(), info("/left/camera_info", "left")]
    source, _ = read(layouts.write(tmp_path / "same", messages))
    assert source.warnings == {}
    messages[-1].message.k[0] *= 1.2
    source, _ = read(layouts.write(tmp_path / "other", messages))
    (words,) = source.warnings.values()
    assert "/left/camera_info is another calibration from" in words and "the first is taken" in words
    assert source.rig.intrinsics[0, 0] == read(tmp_path / "same")[0].rig.intrinsics[0, 0]


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (
            {"topics": {"odometry": "/left/image_raw"}},
            "no topic of nav_msgs/msg/Odometry or tf2_msgs/msg/TFMessage; there are: none",
        ),
        ({"topics": {"odometry": "/nope"}}, "odometry=/nope: no topic of nav_msgs/msg/Odometry"),
        ({"base": "nope"}, "no way from 'nope'"),
    ],
)
def test_what_is_asked_for_and_not_there_is_said(request_: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(BagError, match=words):
        read(layouts.write(tmp_path / "bag", stereo()), **request_)


def test_a_rig_is_given_or_recorded(tmp_path: Path) -> None:
    """Without camera_info; of a rig for two, one camera takes the first."""
    bag = layouts.write(tmp_path / "bag", [image("/cam0/image_raw", 1, 0), image("/cam1/image_raw", 1, 1)])
    source, frames = read(bag, rig=a_rig())
    assert (source.mode, len(frames), np.array_equal(frames[0][0].grey[0], picture(0))) == ("stereo", 1, True)
    alone = layouts.write(tmp_path / "alone", [image("/cam0/image_raw", 1, 0)])
    assert len(read(alone, rig=a_rig())[0].rig) == 1
    with pytest.raises(BagError, match=r"stereo needs 2 cameras, and the rig has 1 \(left\)"):
        read(bag, rig=read(alone, rig=a_rig())[0].rig)


def test_what_is_missing_is_counted_with_figures(tmp_path: Path) -> None:
    messages = stereo()
    del messages[5]  # the second right one
    messages[6].message.encoding = "strange"
    source, frames = read(layouts.write(tmp_path / "bag", messages))
    assert [images.stamp_ns // STEP_NS for images, _ in frames] == [1, 4]
    assert source.counted == {"no right/image_raw": 1, "unreadable": 1}
    assert "100.0 ms off" in source.notes["no right/image_raw"] and "'strange'" in source.notes["unreadable"]


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([info("/a/camera_info", "a")], "no images in it: a recording of keyframes and tracks is for ba replay"),
        ([image(f"/c{i}/image", 1, i) for i in range(3)], "say --topic left=TOPIC"),
        ([*stereo("/a/left", "/a/right"), *stereo("/b/left", "/b/right")], "cannot tell which images are meant"),
        (stereo()[2:], "no message on /left/camera_info"),
        ([stereo()[0], *stereo()[2:]], "no message on /right/camera_info"),
        (
            [*stereo()[2:], info("/left/camera_info", "l", -0.1), info("/right/camera_info", "r")],
            "left and right are swapped",
        ),
    ],
)
def test_a_recording_that_cannot_be_read_is_said(messages: list[Sent], words: str, tmp_path: Path) -> None:
    with pytest.raises(BagError, match=words):
        read(layouts.write(tmp_path / "bag", messages))
