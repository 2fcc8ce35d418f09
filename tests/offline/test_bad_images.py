# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What `ba track` makes of files whose images are unusual, or bad: a map that is right, or a line that says why not."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.io.bag_reader import BagReader
from ba_node.io.rig_file import rig_yaml
from ba_node.measurements import Keyframe
from tests.front_end import world
from tests.messages.adapters import layouts

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

IMAGE = "sensor_msgs/msg/Image"
BEGIN_NS, STEP_NS, COUNT = 10**9, 10**8, 12
SIDES = ("left", "right")


@dataclass(frozen=True)
class Shot:
    """One image of one camera."""

    number: int
    side: str
    stamp_ns: int
    pixels: Any
    encoding: str = "mono8"


Shots = list[Shot]


@functools.cache
def drive() -> tuple[Shot, ...]:
    """Return sound grey images of a stereo rig."""
    return tuple(
        Shot(i, side, BEGIN_NS + i * STEP_NS, world.render(world.rig(), index, pose).grey)
        for i, pose in enumerate(world.drive(COUNT))
        for index, side in enumerate(SIDES)
    )


def each(change: Callable[[Shot], dict[str, Any]]) -> Callable[[Shots], Shots]:
    """Return what changes every image."""
    return lambda shots: [dataclasses.replace(one, **change(one)) for one in shots]


def encoded(encoding: str, make: Callable[[Any], Any]) -> Callable[[Shots], Shots]:
    return each(lambda one: {"encoding": encoding, "pixels": np.ascontiguousarray(make(one.pixels))})


def deep(pixels: Any) -> Any:
    return 2000 + 30 * pixels.astype(np.uint16)


def colour(pixels: Any) -> Any:
    """Return three channels that differ, as of a scene of one tint."""
    return np.stack([0.5 * pixels, pixels, 0.8 * pixels], axis=2).astype(np.uint8)


def bayer(pattern: str, pixels: Any) -> Any:
    """Return the mosaic of a pattern of the same scene."""
    mosaic, channels = np.zeros_like(pixels), dict(zip("rgb", np.moveaxis(colour(pixels), 2, 0), strict=True))
    for i, letter in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = channels[letter][i // 2 :: 2, i % 2 :: 2]
    return mosaic


def late(side: str, by_ns: int) -> Callable[[Shots], Shots]:
    return each(lambda one: {"stamp_ns": one.stamp_ns + by_ns * (one.side == side)})


def without(*numbers: int, sides: tuple[str, ...] = SIDES) -> Callable[[Shots], Shots]:
    return lambda shots: [one for one in shots if one.number not in numbers or one.side not in sides]


def black(*numbers: int) -> Callable[[Shots], Shots]:
    return each(lambda one: {"pixels": one.pixels * (one.number not in numbers)})


def swapped(shots: Shots) -> Shots:
    return each(lambda one: {"side": SIDES[one.side == "left"]})(shots)


def pause(shots: Shots) -> Shots:
    return each(lambda one: {"stamp_ns": one.stamp_ns + 30 * 10**9 * (one.number > 4)})(shots)


def one_of_the_future(shots: Shots) -> Shots:
    return each(lambda one: {"stamp_ns": one.stamp_ns + 86_400 * 10**9 * (one.number == 4)})(shots)


def all_of_the_future(shots: Shots) -> Shots:
    return each(lambda one: {"stamp_ns": one.stamp_ns + 2 * 10**18})(shots)


def record(path: Path, shots: Shots, scale: float = 1.0) -> Path:
    """Write a recording whose camera_info tells the baseline in p, for images larger by a scale."""
    fx, fy, cx, cy = (scale * world.rig().intrinsics[0]).tolist()
    size = {"width": int(scale * world.SIZE[0]), "height": int(scale * world.SIZE[1])}
    sent = []
    for index, side in enumerate(SIDES):
        p = np.array([fx, 0, cx, -fx * world.BASELINE * index, 0, fy, cy, 0, 0, 0, 1, 0])
        info = layouts.make(
            layouts.CAMERA_INFO, header=layouts.header(1, side), distortion_model="plumb_bob", d=np.zeros(5),
            k=p[[0, 1, 2, 4, 5, 6, 8, 9, 10]], r=np.eye(3).ravel(), p=p, **size,
        )  # fmt: skip
        sent.append(layouts.Sent(f"/{side}/camera_info", layouts.CAMERA_INFO, info, 1))
    for shot in shots:
        message = layouts.make(
            IMAGE, header=layouts.header(shot.stamp_ns, shot.side), width=world.SIZE[0], height=world.SIZE[1],
            encoding=shot.encoding, step=shot.pixels.strides[0], data=shot.pixels.view(np.uint8).ravel(),
        )  # fmt: skip
        sent.append(layouts.Sent(f"/{shot.side}/image_raw", IMAGE, message, BEGIN_NS + shot.number * STEP_NS))
    return layouts.write(path, sent)


def pictures(path: Path, shots: Shots) -> Path:
    """Write a folder of PNG files."""
    for shot in shots:
        (path / shot.side).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / shot.side / f"{shot.number:06d}.png"), shot.pixels)
    (path / "rig.yaml").write_text(rig_yaml(world.rig(), "own")[0])
    return path


def larger(path: Path, shots: Shots) -> Path:
    return record(path, shots, 2.0)


@dataclass(frozen=True)
class Case:
    """What is written, and what is expected of it."""

    spoil: Callable[[Shots], Shots]
    code: int = 0  # 0 all is well, 2 nothing was written, 3 something has to be looked at
    words: str = ""  # what is said
    write: Callable[[Path, Shots], Path] = record
    sessions: int = 1


PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
CASES = {
    "colour": Case(encoded("bgr8", colour)),
    "colour_files": Case(encoded("bgr8", colour), write=pictures),
    "16_bit": Case(encoded("mono16", deep)),
    "16_bit_files": Case(encoded("mono16", deep), write=pictures),
    **{f"bayer_{one}8": Case(encoded(f"bayer_{one}8", functools.partial(bayer, one))) for one in PATTERNS},
    "bayer_rggb16": Case(encoded("bayer_rggb16", lambda pixels: deep(bayer("rggb", pixels)))),
    "grey_called_colour": Case(encoded("rgb8", lambda pixels: pixels), 2, "expected 960 bytes a row"),
    "colour_called_grey": Case(encoded("mono8", colour), 2, "with 960 bytes a row: 3 times what mono8 has"),
    "a_mosaic_called_grey": Case(
        encoded("mono8", functools.partial(bayer, "rggb")), 3, "look like a mosaic of colours"
    ),
    "an_unknown_encoding": Case(
        each(lambda one: {"encoding": "hsv8" if one.number == 3 else "mono8"}), 3, "encoding 'hsv8'"
    ),
    "dropped_pairs": Case(without(2, 5)),
    "dropped_images": Case(without(2, 5, sides=("right",)), 3, "left out 2 images: no right/image_raw"),
    "dropped_first_images": Case(without(2, 5, sides=("left",)), 3, "left out 2 images: right/image_raw alone"),
    "unsynchronised_by_20_ms": Case(late("right", 20_000_000), 3, "the second image is +20.0 ms off the first"),
    "unsynchronised_by_60_ms": Case(late("right", 60_000_000), 3, "the second image is -40.0 ms off the first"),
    "swapped": Case(swapped, 2, "left and right images seem to be exchanged"),
    "another_resolution": Case(list, 2, "image of 320 x 240 px where the calibration is for 640 x 480", write=larger),
    "one_stamp_in_the_future": Case(one_of_the_future, 3, "86399.8 s ahead of the one after it: no keyframe"),
    "all_stamps_in_the_future": Case(all_of_the_future),
    "a_camera_that_begins_later": Case(without(0, 1, sides=("right",)), 3, "left out 2 images: no right/image_raw"),
    "black_images": Case(black(4, 5), 3, "shows nothing (black, or covered): the map stays as it is"),
    "30_s_of_nothing": Case(pause, 3, "30.2 s without images before"),
}
# Without a scale of their own, or another one.
OTHER_SCALE = {"unsynchronised_by_20_ms", "unsynchronised_by_60_ms"}


@pytest.mark.parametrize("name", CASES)
def test_a_map_that_is_right_or_a_line_that_says_why_not(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case, out = CASES[name], tmp_path / "tracks.mcap"
    source = case.write(tmp_path / "source", case.spoil(list(drive())))
    assert main(["track", str(source), str(out), "--track", "max_features=200"]) == case.code
    told = capsys.readouterr().err
    assert case.words in told, told
    assert bool(told) == bool(case.code) and "Traceback" not in told
    assert out.exists() == (case.code != 2)
    if case.code == 2:
        assert told.count("\n") == 1, told
        return
    with BagReader(out) as reader:
        keyframes = [one for _, _, one in reader.measurements() if isinstance(one, Keyframe)]
    assert len({one.session_id for one in keyframes}) == case.sessions
    if name in OTHER_SCALE:
        return
    assert len(keyframes) >= 3
    order = sorted({shot.stamp_ns: shot.number for shot in case.spoil(list(drive())) if shot.side == "left"}.items())
    number = dict(order) if case.write is record else {i * STEP_NS: i for i in range(COUNT)}
    truth = world.drive(COUNT)
    off = [one.position - truth[number[one.stamp_ns]].translation for one in keyframes]
    first = off[0] if name == "a_camera_that_begins_later" else 0.0
    length = float(np.linalg.norm(truth[-1].translation))
    assert np.linalg.norm(np.array(off) - first, axis=1).max() < 0.03 * length
