# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write trajectories as the TUM RGB-D benchmark has them, ``stamp x y z qx qy qz qw`` a line; write KITTI.

Stamps are seconds with nine decimals, made from and read to integer nanoseconds without a float in between; the
other numbers are written so that they read back as the same float64.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import ROUND_HALF_EVEN, Decimal, DecimalException, InvalidOperation, localcontext
from pathlib import Path
from typing import TypeVar

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.geometry import matrix_from_quaternion
from ba_node.estimate import Poses
from ba_node.io.files import opened, whole_file

# A million poses.
MAX_BYTES = 2**27
_NS = 1_000_000_000
_COLUMNS = "stamp x y z qx qy qz qw"
Row = TypeVar("Row")


class TrajectoryError(ValueError):
    """A trajectory file that cannot be read."""


def write_tum(path: Path | str, poses: Poses) -> None:
    """Write stamped poses; keyframe ids have no place in the format."""
    rows = np.hstack([poses.position, poses.orientation]).tolist()
    lines = [
        f"{format_stamp(stamp)} {' '.join(map(repr, row))}\n"
        for stamp, row in zip(poses.stamp_ns.tolist(), rows, strict=True)
    ]
    with whole_file(path) as stream:
        stream.write("".join([f"# {_COLUMNS}\n", *lines]).encode())


def read_tum(path: Path | str) -> Poses:
    """Read stamped poses, numbered from 0 in the order of the file; empty lines and those with # are passed over.

    Raises:
        TrajectoryError: the file cannot be opened or holds no pose; a line has not eight finite numbers, a stamp beyond
            int64 nanoseconds, or a quaternion of zeros. Names the line.
    """
    rows = read_rows(path, lambda words: (parse_stamp(words[0]), _parse_pose(words)))
    if not rows:
        raise TrajectoryError(f"{path}: no pose in it: expected lines with {_COLUMNS}")
    stamps, values = zip(*rows, strict=True)
    return numbered(np.array(stamps, np.int64), np.array(values)[:, :3], np.array(values)[:, 3:])


def numbered(stamp_ns: IntArray, position: FloatArray, orientation: FloatArray) -> Poses:
    """Return poses whose ids count from 0."""
    return Poses(np.arange(len(stamp_ns), dtype=np.uint64), stamp_ns, position, orientation)


def read_rows(path: Path | str, parse: Callable[[list[str]], Row], separator: str | None = None) -> list[Row]:
    """Return what is made of the words of each line; empty lines and those with # are passed over.

    Raises:
        TrajectoryError: the file cannot be opened, is no text, or ``parse`` raises ValueError; names the line.
    """
    rows: list[Row] = []
    with opened(path, MAX_BYTES, TrajectoryError) as stream:
        lines = stream.read().decode("utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if "\N{REPLACEMENT CHARACTER}" in line:
            raise TrajectoryError(f"{path}:{number}: not a text file")
        try:
            rows.append(parse(line.split(separator)))
        except ValueError as error:
            raise TrajectoryError(f"{path}:{number}: {error}") from None
    return rows


def write_kitti(path: Path, poses: Poses) -> None:
    """Write poses as KITTI's odometry benchmark has them: three rows of world from body a line, without stamps."""
    rotation = matrix_from_quaternion(poses.orientation)
    rows = np.concatenate([rotation, poses.position[:, :, None]], axis=2).reshape(-1, 12)
    with whole_file(path) as stream:
        stream.write("".join(f"{' '.join(map(repr, row))}\n" for row in rows.tolist()).encode())


def read_text(path: Path) -> str:
    """Return the text of a file.

    Raises:
        TrajectoryError: it cannot be opened, or is no text.
    """
    with opened(path, MAX_BYTES, TrajectoryError) as stream:
        data = stream.read()
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise TrajectoryError(f"{path}: not a text file: {error}") from error


def format_stamp(stamp_ns: int) -> str:
    """Return seconds with nine decimals."""
    seconds, rest = divmod(abs(stamp_ns), _NS)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{rest:09d}"


def parse_stamp(text: str) -> int:
    """Return seconds in decimal notation as integer ns, rounded if there are more than nine decimals.

    Raises:
        ValueError: not a finite number, or beyond int64.
    """
    try:
        with localcontext() as context:
            context.prec = 60
            stamp_ns = (Decimal(text) * _NS).to_integral_value(rounding=ROUND_HALF_EVEN)
    except InvalidOperation:
        raise ValueError(f"stamp {text[:40]!r} is not a number") from None
    except DecimalException:
        stamp_ns = Decimal("inf")
    if not (stamp_ns.is_finite() and -(2**63) <= stamp_ns < 2**63):
        raise ValueError(f"stamp {text[:40]!r}: expected finite seconds, within int64 nanoseconds")
    return int(stamp_ns)


def _parse_pose(words: list[str]) -> list[float]:
    if len(words) != 8:
        kitti = "; those of KITTI have no stamps" if len(words) == 12 else ""
        raise ValueError(f"{len(words)} values: expected 8 ({_COLUMNS}){kitti}")
    values = [_parse_number(word, name) for word, name in zip(words[1:], _COLUMNS.split()[1:], strict=True)]
    if not any(values[3:]):
        raise ValueError("the quaternion is zero: expected a unit quaternion")
    return values


def _parse_number(word: str, name: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"{name} = {word!r} is not a number") from None
    if not np.isfinite(value):
        raise ValueError(f"{name} = {word}: expected a finite number")
    return value
