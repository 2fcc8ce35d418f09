# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write problems of "Bundle Adjustment in the Large" (BAL), and turn them into ours and back.

The projection of a BAL camera (Agarwal et al., ECCV 2010; thesis 2.17-2.21) is::

    X' = R x + t,   p = -(X', Y') / Z',   u = f (1 + k1 |p|^2 + k2 |p|^4) p

It looks down -z with v upwards. With the camera at ``diag(1, -1, -1)`` on the body, z points forward and y down:
``x_cam / z_cam = p_x`` and ``y_cam / z_cam = -p_y``, so the image coordinates of the same picture are ``(u, -v)``.
"""

from __future__ import annotations

import bz2
import gzip
import re
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core.cameras import Model
from ba_node.core.geometry import so3_exp, so3_log
from ba_node.core.problem import Cameras, Observations, Problem, State
from ba_node.io.files import opened, whole_file
from ba_node.io.unpack import TooLargeError, limit_for, unpack

_CAMERA = ("rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z", "f", "k1", "k2")


# The largest problem published has 1.2 GB of text.
MAX_BYTES = 2**32
# Text of measured numbers packs four times.
MAX_GROWTH = 10
# Rows of text that are written at a time.
_ROWS = 2**13
# Bytes at the begin among which a file that is no text has a zero.
_BEGIN = 1000
_NONE = np.empty(0)
# The camera of all keyframes: its focal length is one, as theirs are in ``State.intrinsics``.
_RIG = Cameras(
    rotation=np.array([[[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]]),
    translation=np.zeros((1, 3)),
    model=np.array([Model.RATIONAL], dtype=np.uint8),
    params=np.array([[1.0, 1.0, *[0.0] * 10]]),
)
for _array in vars(_RIG).values():
    _array.setflags(write=False)


class BalError(ValueError):
    """A BAL file that cannot be read."""


@dataclass(frozen=True)
class BalProblem:
    """A problem as the file has it."""

    cameras: FloatArray  # (n, 9) rotation vector, translation, f (px), k1, k2
    points: FloatArray  # (m, 3) in the world
    camera_index: IntArray  # (l,) camera of each observation
    point_index: IntArray  # (l,) point of each observation
    observations: FloatArray  # (l, 2) u to the right, v upwards, px, from the centre of the image


def read_bal(path: Path | str) -> BalProblem:
    """Read ``*.txt``, ``*.bz2`` or ``*.gz``.

    Raises:
        BalError: the file cannot be opened or unpacked, is truncated, or holds something that is no finite number or an
            index out of range; names the line.
    """
    path = Path(path)
    text = _unpack(path)
    values = numbers_of(path, text)
    n_cameras, n_points, n_obs = _header(path, text, values)
    ends = 3 + np.cumsum([4 * n_obs, 9 * n_cameras, 3 * n_points])
    _check_count(path, text, values, (n_cameras, n_points, n_obs), int(ends[-1]))
    rows = values[3 : ends[0]].reshape(n_obs, 4)
    problem = BalProblem(
        cameras=values[ends[0] : ends[1]].reshape(n_cameras, 9).copy(),
        points=values[ends[1] : ends[2]].reshape(n_points, 3).copy(),
        camera_index=rows[:, 0].astype(np.intp),
        point_index=rows[:, 1].astype(np.intp),
        observations=rows[:, 2:].copy(),
    )
    for column, (name, limit) in enumerate((("camera", n_cameras), ("point", n_points))):
        index = rows[:, column]
        bad = np.flatnonzero((index != np.floor(index)) | (index < 0) | (index >= limit))
        if len(bad):
            line = _line_of(text, 3 + 4 * int(bad[0]) + column)
            raise BalError(f"{path}: line {line}: {name} index {index[bad[0]]:g} out of range [0, {limit})")
    return problem


def write_bal(path: Path | str, problem: BalProblem) -> None:
    """Write ``*.txt``, ``*.bz2`` or ``*.gz``; every number reads back as the same float64."""
    path = Path(path)
    with whole_file(path) as stream, _packing(path, stream) as out:
        for text in _text(problem):
            out.write(text.encode())


def _packing(path: Path, stream: IO[bytes]) -> AbstractContextManager[IO[bytes] | gzip.GzipFile | bz2.BZ2File]:
    """Return what packs for a stream as the name of the file says."""
    if path.suffix == ".bz2":
        return bz2.open(stream, "wb")
    if path.suffix == ".gz":
        return gzip.GzipFile("", "wb", fileobj=stream, mtime=0)
    return nullcontext(stream)


def _text(problem: BalProblem) -> Iterator[str]:
    """Yield the text of a problem in pieces: as Python's numbers all of it would take ten times its memory."""
    n_obs = len(problem.observations)
    yield f"{len(problem.cameras)} {len(problem.points)} {n_obs}\n"
    columns = (problem.camera_index, problem.point_index, problem.observations[:, 0], problem.observations[:, 1])
    for begin in range(0, n_obs, _ROWS):
        yield "".join(map("{} {} {!r} {!r}\n".format, *(column[begin : begin + _ROWS].tolist() for column in columns)))
    for numbers in (problem.cameras.ravel(), problem.points.ravel()):
        for begin in range(0, len(numbers), _ROWS):
            yield "".join(map("{!r}\n".format, numbers[begin : begin + _ROWS].tolist()))


def to_problem(bal: BalProblem) -> Problem:
    """Return the problem in our terms: a keyframe for each camera with its own f, k1, k2, and nothing fixed.

    The one camera of the rig has unit focal length, as the focal lengths are in ``State.intrinsics``.
    """
    keyframe, point, images = bal.camera_index, bal.point_index, bal.observations
    # One call: the first one of each of numpy's functions takes ten times as long as others.
    made = _from_bal if native.kernels is None else native.kernels.from_bal
    found = made(bal.cameras, point, images)
    if found is None:
        order = np.argsort(point, kind="stable")
        keyframe, point = keyframe[order], point[order]
        found = made(bal.cameras, point, images[order])
    assert found is not None
    rotation, translation, intrinsics, uv, camera, sigma = found
    return Problem(
        start=State(rotation, translation, bal.points.copy(), intrinsics),
        fixed=np.zeros(len(translation), dtype=bool),
        cameras=_RIG,
        observations=Observations(keyframe, camera, point, uv, sigma, depth_m=_NONE, depth_sigma_m=_NONE),
    )


def _from_bal(cameras: FloatArray, point: IntArray, images: FloatArray) -> tuple[NDArray[Any], ...] | None:
    """Return what ``native.kernels.from_bal`` does."""
    if (point[1:] < point[:-1]).any():
        return None
    uv = np.array(images)
    # A product with (1, -1) goes by rows of two numbers, five times as slow.
    np.negative(uv[:, 1], out=uv[:, 1])
    poses = so3_exp(cameras[:, :3]), cameras[:, 3:6].copy(), cameras[:, 6:].copy()
    return *poses, uv, np.zeros(len(uv), dtype=np.intp), np.ones(len(uv))


def translated(bal: BalProblem, offset: FloatArray) -> BalProblem:
    """Return the same problem in a world whose points lie ``offset`` further, (3,)."""
    cameras = bal.cameras.copy()
    cameras[:, 3:6] -= so3_exp(cameras[:, :3]) @ offset
    return replace(bal, cameras=cameras, points=bal.points + offset)


def behind(bal: BalProblem) -> BoolArray:
    """Return which observations, (l,), are of a point that is not in front of its camera, which looks along -z."""
    forward = so3_exp(bal.cameras[:, :3])[:, 2]
    seen = np.einsum("ij,ij->i", forward[bal.camera_index], bal.points[bal.point_index])
    return np.asarray(seen + bal.cameras[bal.camera_index, 5] >= 0.0)


def from_state(bal: BalProblem, state: State) -> BalProblem:
    """Return the problem with cameras and points of a solution of :func:`to_problem`."""
    cameras = np.hstack([so3_log(state.rotation), state.translation, state.intrinsics])
    return replace(bal, cameras=cameras, points=state.points.copy())


def _unpack(path: Path) -> bytes:
    with opened(path, MAX_BYTES, BalError) as stream:
        data = stream.read()
    if path.suffix not in (".bz2", ".gz"):
        return data
    try:
        return unpack(path.suffix[1:], data, limit_for(len(data), MAX_GROWTH))
    except TooLargeError as error:
        raise BalError(f"{path}: {error}: unpack it yourself if it is sound") from None
    except Exception as error:  # the libraries have no common class for damaged data
        raise BalError(f"{path}: cannot be unpacked, it is truncated or damaged: {error}") from error


def numbers_of(path: Path, text: bytes) -> FloatArray:
    """Return all numbers of the text, finite; numpy reads them 20 times as fast as a split would, C++ 80 times."""
    if not text.strip():
        raise BalError(f"{path}: the file is empty: expected a line with the numbers of cameras, points, observations")
    found: FloatArray | None = None if native.kernels is None else native.kernels.numbers(text)
    if found is not None:
        return found
    try:
        with warnings.catch_warnings():
            # What numpy 2.2 warns of is an error from 2.3 on.
            warnings.simplefilter("error", DeprecationWarning)
            values: FloatArray = np.fromstring(text, dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning):
        _raise_not_a_number(path, text)
        values = np.array(text.split(), dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        line = _line_of(text, int(bad[0]))
        raise BalError(f"{path}: line {line}: {values[bad[0]]}: expected a finite number")
    return values


def _raise_not_a_number(path: Path, text: bytes) -> None:
    if b"\0" in text[:_BEGIN]:
        raise BalError(f"{path}: not a text, as BAL and Bundler are; a recording is refined by ba replay")
    for word in _words(text):
        if not _is_number(word[0]):
            shown = word[0][:40].decode("ascii", errors="replace")
            raise BalError(f"{path}: line {_line_at(text, word.start())}: {shown!r} is not a number")


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _header(path: Path, text: bytes, values: FloatArray) -> tuple[int, int, int]:
    counts = values[:3]
    if len(counts) < 3 or np.any(counts != np.floor(counts)) or np.any(counts < 0) or np.any(counts > 2**53):
        line = text.lstrip()[:80].splitlines()[0].decode("ascii", errors="replace")
        raise BalError(
            f"{path}: line {_line_of(text, 0)}: {line!r}: expected the numbers of cameras, points, observations"
        )
    return int(counts[0]), int(counts[1]), int(counts[2])


def _check_count(path: Path, text: bytes, values: FloatArray, counts: tuple[int, int, int], expected: int) -> None:
    if len(values) == expected:
        return
    promised = f"{counts[0]} cameras, {counts[1]} points and {counts[2]} observations make {expected} numbers"
    if len(values) < expected:
        where = _place(len(values) - 3, counts)
        raise BalError(f"{path}: truncated: {promised}, the file holds {len(values)} and ends in {where}")
    raise BalError(f"{path}: line {_line_of(text, expected)}: {promised}, the file holds {len(values)}")


def _place(index: int, counts: tuple[int, int, int]) -> str:
    """Return in words what the number after the header at an index belongs to."""
    n_cameras, _, n_obs = counts
    if index < 4 * n_obs:
        return f"observation {index // 4}"
    index -= 4 * n_obs
    if index < 9 * n_cameras:
        return f"camera {index // 9} ({_CAMERA[index % 9]})"
    return f"point {(index - 9 * n_cameras) // 3}"


def _line_of(text: bytes, index: int) -> int:
    """Return the line, counted from one, of a number; only called when an error is certain."""
    word = next(islice(_words(text), index, None), None)
    return _line_at(text, len(text.rstrip()) if word is None else word.start())


def _line_at(text: bytes, offset: int) -> int:
    return 1 + text.count(b"\n", 0, offset)


def _words(text: bytes) -> Iterator[re.Match[bytes]]:
    """Yield the words one by one: a list of all takes ten times the memory of the text."""
    return re.finditer(rb"\S+", text)
