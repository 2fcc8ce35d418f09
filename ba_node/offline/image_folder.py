# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find pictures in a folder: which of them are of which camera, when they were taken, and what tells the cameras.

A folder holds pictures of one camera, or in folders below it those of the left and the right one, or of colour and
depth (names in :data:`FOLDERS`, in capitals or not), or left and right in the names of the pictures themselves. Beside
them is the rig: a YAML of any form (``rig.yaml``, or the only ones there), EuRoC's ``sensor.yaml`` of each camera, or
KITTI's ``calib.txt`` of projection matrices.

Stamps are the lines of ``times.txt`` or the names of the pictures, in s, ms, us or ns, whichever gives times of this
age or steps as between images. Other numbers in names count the pictures, so that one that is missing leaves a gap.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ba_node.front_end.streams import cameras_of
from ba_node.io.bag_topics import BagError
from ba_node.io.rig_file import read_rig
from ba_node.measurements import CameraRig
from ba_node.messages.rig import rig_from_infos

FOLDERS = {
    "stereo": (
        ("left", "image_l", "image_0", "image_00", "cam0", "cam_0"),
        ("right", "image_r", "image_1", "image_01", "cam1", "cam_1"),
    ),
    "rgbd": (("rgb", "color", "colour"), ("depth",)),
}
# Folders that pictures may lie in below those, and recordings above them: those of EuRoC, KITTI's raw data.
_BELOW, _ABOVE = ("", "data", "image_raw"), ("", "mav0")
# What names of pictures of the two cameras have.
_SIDES = (("left", "right"), ("cam0", "cam1"), ("_l", "_r"))
PICTURES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
# Names of fewer digits count pictures. Units of times; none is after the latest, and steps are between the others.
_TIME_DIGITS, _UNITS_NS, _LATEST_NS, _STEPS_NS = 10, (10**9, 10**6, 10**3, 1), 5 * 10**18, (10**6, 10**10)
# Numbers that are further apart (median) do not count pictures.
_MOST_APART = 10
# Share of pictures that are named alike, above which the others are slips.
_USUAL = 0.75


@dataclass(frozen=True)
class PictureFolder:
    """Pictures by camera, of a mode."""

    path: Path
    mode: str  # stereo, rgbd or mono
    pictures: tuple[list[Path], ...]  # of each camera, by time
    aside: tuple[Path, ...] = ()  # pictures whose names tell neither their number nor their place among the others

    def stamps(self, rate_hz: float) -> list[list[int]]:
        """Return when each picture was taken, ns, by camera.

        Raises:
            BagError: ``times.txt`` has too few lines, or one that is no time.
        """
        texts = [[_number_of(file) for file in files] for files in self.pictures]
        places = _places(texts)
        rank = {place: i for i, place in enumerate(sorted({p for camera in places for p in camera}))}
        times = self.path / "times.txt"
        if times.exists():
            seconds = _times(times)
            if len(seconds) > max(rank):  # a line an image, though some pictures are missing
                rank = {place: place for place in rank}
            elif len(seconds) != len(rank):
                raise BagError(f"{times}: {len(seconds)} lines for {len(rank)} pictures: expected a time for each")
            unit = _unit_ns(seconds)
            return [[round(seconds[rank[place]] * unit) for place in camera] for camera in places]
        values = [[Decimal(text) for text in camera] for camera in texts if all(camera)]
        if len(values) == len(texts) and all(_is_time(text) for camera in texts for text in camera):
            unit = _unit_ns(values[0])
            return [[round(value * unit) for value in camera] for camera in values]
        return [[round(place / rate_hz * 1e9) for place in camera] for camera in places]

    def rig(self, *, rectified: bool) -> CameraRig:
        """Return the cameras that files of the folder tell.

        Raises:
            BagError: there are none, or they are of fewer cameras.
            RigError: a YAML holds no rig.
        """
        cameras = len(cameras_of(self.mode))
        path = self.path
        own = [path / name for name in ("rig.yaml", "camchain.yaml") if (path / name).exists()][:1]
        pair = [path / name for name in ("left.yaml", "right.yaml")[:cameras] if (path / name).exists()]
        euroc = [folder / "sensor.yaml" for files in self.pictures for folder in files[0].parents[:2]]
        euroc = [file for file in euroc if file.exists()]
        files = own or pair or euroc or sorted([*path.glob("*.yaml"), *path.glob("*.yml")])[:2]
        if files:
            rig = read_rig(*files, rectified=rectified)
        elif (path / "calib.txt").exists():
            rig = _kitti_rig(path / "calib.txt", cameras)
        else:
            raise BagError(
                f"{path}: nothing tells the cameras: put a rig.yaml beside the pictures (ba rig --help), or give --rig"
            )
        if len(rig) < cameras:
            names = ", ".join(file.name for file in files)
            raise BagError(
                f"{path}: {self.mode} needs {cameras} cameras, and {names or 'calib.txt'} tells {len(rig)}: put"
                " left.yaml and right.yaml there, one rig.yaml of both, or give --rig"
            )
        return rig


def find_pictures(path: Path) -> PictureFolder:
    """Return the pictures of a folder.

    Raises:
        BagError: there are none where they are looked for.
    """
    for root in (path / name for name in _ABOVE if (path / name).is_dir()):
        for kind, names in FOLDERS.items():
            first, second = (_first(root, some) for some in names)
            if first and (second or not pictures_in(root)):
                return _named(root, kind if second else "mono", (first, second) if second else (first,))
        files = pictures_in(root)
        if files:
            sides = _by_side(files)
            return _named(root, "stereo" if sides else "mono", sides or (files,))
    elsewhere = sorted({str(file.parent.relative_to(path)) for file in path.rglob("*") if _is_picture(file)})
    there = f"; there are pictures in {', '.join(elsewhere[:6])}: call them left and right" if elsewhere else ""
    raise BagError(
        f"{path}: no pictures ({', '.join(PICTURES)}), neither here nor in left/ and right/, rgb/ and depth/{there}"
    )


def _named(root: Path, mode: str, pictures: tuple[list[Path], ...]) -> PictureFolder:
    """Return a folder; where numbers come twice, without the few pictures that are named in another way."""
    kept, aside = [], []
    for files in pictures:
        ways = [file.stem.replace(_number_of(file) or file.stem, "#", 1) for file in files]
        usual = max(ways, key=ways.count)
        alike = [file for file, way in zip(files, ways, strict=True) if way == usual]
        few = len({Decimal(_number_of(file) or -1) for file in files}) < len(files) and len(alike) > _USUAL * len(files)
        kept.append(alike if few else files)
        aside += [file for file in files if file not in kept[-1]]
    return PictureFolder(root, mode, tuple(kept), tuple(aside))


def pictures_in(folder: Path) -> list[Path]:
    """Return the pictures in a folder, those with numbers in their names in the order of these."""
    return sorted((file for file in folder.iterdir() if _is_picture(file)), key=_natural) if folder.is_dir() else []


def _is_picture(file: Path) -> bool:
    return file.suffix.lower() in PICTURES and file.is_file()


def _natural(file: Path) -> tuple[list[tuple[int, str]], str]:
    """Return what sorts frame9 before frame10."""
    parts = re.split(r"(\d+)", file.stem)
    return [(int(part), "") if part.isdigit() else (0, part) for part in parts], file.name


def _first(root: Path, names: Sequence[str]) -> list[Path]:
    """Return the pictures of the first folder of some names that has any."""
    there = {folder.name.lower(): folder for folder in sorted(root.iterdir()) if folder.is_dir()}
    found = (pictures_in(there[name] / below) for name in names if name in there for below in _BELOW)
    return next(filter(None, found), [])


def _by_side(files: Sequence[Path]) -> tuple[list[Path], ...]:
    """Return pictures of two cameras whose names say which is whose; nothing where they do not."""
    for words in _SIDES:
        sides = tuple([file for file in files if _has(file.stem.lower(), word)] for word in words)
        if all(sides) and sum(map(len, sides)) == len(files):
            return sides
    return ()


def _has(name: str, word: str) -> bool:
    return name.endswith(word) if word.startswith("_") else word in name


def _number_of(file: Path) -> str:
    """Return the longest number in the name of a picture, empty if there is none."""
    name = file.stem.lower().replace("cam0", "").replace("cam1", "")
    return max(_NUMBER.findall(name), key=len, default="")


def _is_time(text: str) -> bool:
    whole, _, fraction = text.partition(".")
    return len(whole) >= _TIME_DIGITS or (len(whole) >= _TIME_DIGITS - 4 and bool(fraction))


def _places(texts: Sequence[Sequence[str]]) -> list[list[int]]:
    """Return which image of the recording each picture is, by the numbers that count them, else by their order."""
    numbers = [[int(Decimal(text)) for text in camera if text] for camera in texts]
    in_order = [list(range(len(camera))) for camera in texts]
    known = sorted({number for camera in numbers for number in camera})
    complete = all(len(set(a)) == len(b) for a, b in zip(numbers, texts, strict=True))
    if not complete or len(known) < 2:
        return in_order
    step = math.gcd(*np.diff(known).tolist())
    if np.median(np.diff(known)) > _MOST_APART * step and not all(
        _is_time(text) for camera in texts for text in camera
    ):
        return in_order
    return [[(number - known[0]) // step for number in camera] for camera in numbers]


def _unit_ns(values: Sequence[Decimal]) -> int:
    """Return the unit of times in which none lies far ahead, and steps are those of images (median), ns."""
    steps = sorted(abs(b - a) for a, b in itertools.pairwise(values))
    step = steps[len(steps) // 2] if steps else None
    units = [unit for unit in _UNITS_NS if max(values) * unit < _LATEST_NS] or [1]
    fitting = [unit for unit in units if step is None or _STEPS_NS[0] <= step * unit <= _STEPS_NS[1]]
    return (fitting or units)[0]


def _times(path: Path) -> list[Decimal]:
    """Return the first number of each line."""
    words = [line.split()[0] for line in path.read_text(errors="replace").splitlines() if line.strip()]
    try:
        times = [Decimal(word) for word in words if not word.startswith("#")]
    except InvalidOperation:
        bad = next(word for word in words if not _NUMBER.match(word.lstrip("+-")) and not word.startswith("#"))
        raise BagError(f"{path}: {bad!r}: expected a time at the beginning of each line") from None
    if not all(time.is_finite() for time in times):
        raise BagError(f"{path}: a time that is not finite")
    return times


class Picture:
    """A file, with the fields of a CompressedImage."""

    def __init__(self, file: Path) -> None:
        self._file, self.format = file, f"{file.parent.name}/{file.name}"

    @property
    def data(self) -> bytes:
        """Return its content, which is read when it is looked at."""
        return self._file.read_bytes()


def _kitti_rig(path: Path, cameras: int) -> CameraRig:
    """Return the rectified cameras of rows of 12 numbers, each with or without a name before it."""
    rows = _rows_of_12(path)
    if len(rows) < cameras:
        raise BagError(f"{path}: {len(rows)} rows of 12 numbers, the projection of a camera each: expected {cameras}")
    infos: list[Any] = [
        SimpleNamespace(
            header=SimpleNamespace(frame_id=f"camera{i}"), width=0, height=0, k=[], d=[], r=np.eye(3).reshape(-1),
            p=row, distortion_model="", binning_x=0, binning_y=0,
        )
        for i, row in enumerate(rows[:cameras])
    ]  # fmt: skip
    return rig_from_infos(infos, rectified=True)


def _rows_of_12(path: Path) -> list[list[float]]:
    """Return the numbers of each line of 12 words at least, without a name before them."""
    lines = [re.sub(r"^\w+:", "", line).split() for line in path.read_text(errors="replace").splitlines()]
    try:
        return [[float(word) for word in words] for words in lines if len(words) >= 12]
    except ValueError as error:
        raise BagError(f"{path}: {error}") from None
