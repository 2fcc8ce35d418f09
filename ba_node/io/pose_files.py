# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write poses as KITTI's odometry benchmark and as g2o have them, and read those of g2o.

KITTI: a line a pose, the first three rows of world from camera, without stamps. g2o: a pose graph, ``VERTEX_SE3:QUAT id
x y z qx qy qz qw``, and ``EDGE_SE3:QUAT`` between neighbours with the identity for information.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import geometry
from ba_node.estimate import Poses
from ba_node.io.files import opened, whole_file
from ba_node.io.model import stamps
from ba_node.io.trajectory import MAX_BYTES, TrajectoryError

_VERTEX, _EDGE = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_INFORMATION = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))


def is_g2o(path: Path) -> bool:
    """Return True if a file begins as a pose graph of g2o."""
    return path.suffix == ".g2o"


def read_g2o(path: Path) -> Poses:
    """Read the vertices of a pose graph in order of their ids; there are no stamps, so they are 0.1 s apart.

    Raises:
        TrajectoryError: there are none, one is not seven finite numbers, or an id comes twice.
    """
    found: dict[int, list[float]] = {}
    for number, line in enumerate(_text(path).splitlines(), start=1):
        words = line.split()
        if not words or words[0] != _VERTEX:
            continue
        try:
            key, values = int(words[1]), [float(word) for word in words[2:]]
        except (ValueError, IndexError):
            raise TrajectoryError(f"{path}:{number}: something is not a number: {line[:60]!r}") from None
        if len(values) != 7 or not np.isfinite(values).all() or not any(values[3:]) or key in found or key < 0:
            raise TrajectoryError(f"{path}:{number}: expected a new id and a pose x y z qx qy qz qw: {line[:60]!r}")
        found[key] = values
    if not found:
        raise TrajectoryError(f"{path}: no {_VERTEX} in it")
    ids = sorted(found)
    poses = np.array([found[key] for key in ids])
    return Poses(np.array(ids, dtype=np.uint64), stamps(len(ids)), poses[:, :3], poses[:, 3:])


def write_kitti(path: Path, poses: Poses) -> None:
    """Write poses as KITTI has them."""
    rows = np.concatenate([_matrix(poses), poses.position[:, :, None]], axis=2).reshape(-1, 12)
    _write(path, [" ".join(map(repr, row)) for row in rows.tolist()])


def write_g2o(path: Path, poses: Poses) -> None:
    """Write poses as a pose graph of g2o, each tied to the next by where it stands; the first is fixed."""
    both = np.hstack([poses.position, poses.orientation]).tolist()
    lines = [f"{_VERTEX} {i} {' '.join(map(repr, row))}" for i, row in enumerate(both)]
    rotation = _matrix(poses)
    back = np.swapaxes(rotation[:-1], 1, 2)
    step = (back @ np.diff(poses.position, axis=0)[:, :, None])[..., 0]
    turn = geometry.quaternion_from_matrix(back @ rotation[1:])
    edges = np.hstack([step, turn]).tolist()
    lines += ["FIX 0"] if both else []
    lines += [f"{_EDGE} {i} {i + 1} {' '.join(map(repr, row))} {_INFORMATION}" for i, row in enumerate(edges)]
    _write(path, lines)


def _matrix(poses: Poses) -> FloatArray:
    return geometry.matrix_from_quaternion(poses.orientation)


def _text(path: Path) -> str:
    with opened(path, MAX_BYTES, TrajectoryError) as stream:
        return stream.read().decode("utf-8", errors="replace")


def _write(path: Path, lines: list[str]) -> None:
    with whole_file(path) as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())
