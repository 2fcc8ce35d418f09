# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write scenes of Bundler (``bundle.out``, also written by VisualSFM, OpenMVG and COLMAP).

A camera is that of BAL: along -z with v upwards, pixels from the middle of the image, f, k1, k2. Images that could not
be placed stand in the file as zeros, and stay out of the problem::

    # Bundle file v0.3
    <cameras> <points>
    f k1 k2, then R in three rows and t                       for each camera
    x y z; r g b; n, then n times camera, key, u and v        for each point
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.geometry import so3_exp, so3_log
from ba_node.io.bal import MAX_BYTES, BalProblem
from ba_node.io.files import opened, whole_file
from ba_node.io.model import ModelError

_HEAD = b"# Bundle file v0.3"
_CAMERA, _VIEW = 15, 4
# No size, place or count is larger.
_LARGEST = 1e15
# A rotation in the file has six digits or so.
_ORTHONORMAL = 1e-3


@dataclass(frozen=True)
class BundlerScene:
    """A scene; the numbers of the problem's cameras in the file, and what BAL has no place for."""

    bal: BalProblem
    camera: IntArray  # (n,) number in the file of each camera of the problem
    n_cameras: int  # in the file, with those that are not placed
    colour: IntArray  # (m, 3)
    key: IntArray  # (l,) number of each observation in its image's list of features


def read_bundler(path: Path) -> BundlerScene:
    """Read a scene.

    Raises:
        ModelError: it cannot be opened, is truncated, or holds something that is no finite number, no rotation, or an
            index out of range.
    """
    values = _numbers(path)
    if len(values) < 2 or not 0 <= values[0] < 2**31 or not 0 <= values[1] < 2**53:
        raise ModelError(f"{path}: expected the numbers of cameras and points after the first line")
    n_cameras, n_points = int(values[0]), int(values[1])
    end = 2 + _CAMERA * n_cameras
    if len(values) < end:
        raise ModelError(f"{path}: truncated: {n_cameras} cameras make {end} numbers, the file holds {len(values)}")
    cameras = values[2:end].reshape(-1, _CAMERA)
    points, colour, views, point = _points(path, values, end, n_points)
    placed = np.flatnonzero(cameras.any(axis=1))
    rotation = cameras[placed, 3:12].reshape(-1, 3, 3)
    off = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).reshape(-1, 9).max(axis=1, initial=0.0)
    if len(placed) and off.max() > _ORTHONORMAL:
        worst = placed[int(np.argmax(off))]
        raise ModelError(f"{path}: camera {worst}: its rotation is off an orthonormal one by {off.max():.2g}")
    index = np.full(n_cameras, -1)
    index[placed] = np.arange(len(placed))
    bad = np.flatnonzero((views[:, 0] < 0) | (views[:, 0] >= n_cameras) | (views[:, 0] % 1 != 0))
    if len(bad):
        raise ModelError(f"{path}: a view of point {point[bad[0]]} is of camera {views[bad[0], 0]:g}, of {n_cameras}")
    camera = index[views[:, 0].astype(np.intp)]
    seen = np.flatnonzero(camera >= 0)
    values9 = np.hstack([so3_log(rotation), cameras[placed, 12:15], cameras[placed, :3]])
    bal = BalProblem(values9, points, camera[seen], point[seen], views[seen, 2:])
    return BundlerScene(bal, placed, n_cameras, colour, views[seen, 1].astype(np.intp))


def write_bundler(path: Path, scene: BundlerScene) -> None:
    """Write a scene; every number reads back as the same float64."""
    bal = scene.bal
    cameras = np.zeros((scene.n_cameras, _CAMERA))
    cameras[scene.camera, :3] = bal.cameras[:, 6:]
    cameras[scene.camera, 3:12] = so3_exp(bal.cameras[:, :3]).reshape(-1, 9)
    cameras[scene.camera, 12:] = bal.cameras[:, 3:6]
    lines = [f"{scene.n_cameras} {len(bal.points)}"]
    lines += [" ".join(map(repr, row)) for row in cameras.reshape(-1, 3).tolist()]
    order = np.argsort(bal.point_index, kind="stable")
    bounds = np.searchsorted(bal.point_index[order], np.arange(len(bal.points) + 1)).tolist()
    views = [
        f"{camera} {key} {u!r} {v!r}"
        for camera, key, (u, v) in zip(
            scene.camera[bal.camera_index[order]].tolist(),
            scene.key[order].tolist(),
            bal.observations[order].tolist(),
            strict=True,
        )
    ]
    for row, (xyz, colour) in enumerate(zip(bal.points.tolist(), scene.colour.tolist(), strict=True)):
        seen = views[bounds[row] : bounds[row + 1]]
        lines += [" ".join(map(repr, xyz)), " ".join(map(str, colour)), " ".join([str(len(seen)), *seen])]
    with whole_file(path) as stream:
        stream.write(_HEAD + b"\n" + "\n".join(lines).encode() + b"\n")


def from_bal(bal: BalProblem, colour: IntArray) -> BundlerScene:
    """Return a scene of a BAL problem; features are numbered in the order of its observations."""
    n = len(bal.cameras)
    order = np.argsort(bal.camera_index, kind="stable")
    first = np.searchsorted(bal.camera_index[order], np.arange(n))
    key = np.empty(len(order), np.intp)
    key[order] = np.arange(len(order)) - first[bal.camera_index[order]]
    return BundlerScene(bal, np.arange(n), n, colour, key)


def is_bundler(path: Path) -> bool:
    """Return True if a file begins as a scene of Bundler."""
    try:
        with opened(path, MAX_BYTES, ModelError) as stream:
            return stream.read(13) == _HEAD[:13]
    except ModelError:
        return False


def _numbers(path: Path) -> FloatArray:
    with opened(path, MAX_BYTES, ModelError) as stream:
        head, text = stream.readline(100), stream.read()
    if not head.startswith(_HEAD[:13]):
        raise ModelError(f"{path}: expected {_HEAD.decode()!r} in the first line")
    try:
        values = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise ModelError(f"{path}: something is not a number: {error}") from None
    sound = np.abs(values) < _LARGEST  # NaN is not
    if not sound.all():
        row = int(np.argmin(sound))
        raise ModelError(f"{path}: number {row} after the first line is {values[row]:g}: expected a finite one")
    return values


def _points(
    path: Path, values: FloatArray, begin: int, n_points: int
) -> tuple[FloatArray, IntArray, FloatArray, IntArray]:
    """Return points (m, 3), colours (m, 3), views (l, 4) as in the file, and the point of each view (l,)."""
    begins, counts = [], []
    for number in range(n_points):
        count = values[begin + 6] if begin + 6 < len(values) else -1.0
        if count < 0 or count % 1 != 0 or begin + 7 + _VIEW * count > len(values):
            raise ModelError(f"{path}: truncated or damaged at point {number} of {n_points}")
        begins.append(begin)
        counts.append(int(count))
        begin += 7 + _VIEW * int(count)
    starts, lengths = np.array(begins, np.intp), np.array(counts, np.intp)
    rows = starts[:, None] + np.arange(6)
    point = np.repeat(np.arange(n_points), lengths)
    place = np.arange(len(point)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    views = values[(starts[point] + 7 + _VIEW * place)[:, None] + np.arange(_VIEW)]
    return values[rows[:, :3]], values[rows[:, 3:]].astype(np.intp), views, point
