# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write files of g2o: pose graphs, and bundle problems of pinhole cameras.

A pose graph is ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, and ``EDGE_SE3:QUAT`` between neighbours. A bundle problem is
one of two forms, poses world from camera with z forward and y down in both (g2o, types/sba)::

    VERTEX_CAM id x y z qx qy qz qw fx fy cx cy baseline       PARAMS_CAMERAPARAMETERS id f cx cy baseline
    VERTEX_TRACKXYZ id x y z                                   VERTEX_SE3:EXPMAP id x y z qx qy qz qw
    EDGE_PROJECT_P2MC point camera u v i11 i12 i22             EDGE_PROJECT_XYZ2UV:EXPMAP point pose params u v ...

The information of an edge becomes ``sigma_px = i11^-1/2``. What ``FIX`` holds is not kept: in a bundle problem it is
the frame of the world, which the solver leaves free.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.core import geometry
from ba_node.core.cameras import CX, FX, N_PARAMS, Model
from ba_node.core.problem import Cameras
from ba_node.estimate import Poses
from ba_node.io.files import whole_file
from ba_node.io.model import ModelError, Reconstruction, lens_of, stamps
from ba_node.io.trajectory import read_text

_POSE, _STEP = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"
_CAM, _EXPMAP, _PARAMS = "VERTEX_CAM", "VERTEX_SE3:EXPMAP", "PARAMS_CAMERAPARAMETERS"
_POINT, _OLD_POINT = "VERTEX_TRACKXYZ", "VERTEX_XYZ"
_CAM_EDGE, _EXPMAP_EDGE = "EDGE_PROJECT_P2MC", "EDGE_PROJECT_XYZ2UV:EXPMAP"
# Numbers behind each word that is read.
_WIDTH = {_POSE: 8, _CAM: 13, _EXPMAP: 8, _PARAMS: 5, _POINT: 4, _OLD_POINT: 4, _CAM_EDGE: 7, _EXPMAP_EDGE: 8}
# Ids come first in each.
_IDS = {_CAM_EDGE: 2, _EXPMAP_EDGE: 3}
_UNREAD = {
    "EDGE_PROJECT_P2SC": "of two images in one",
    "EDGE_PROJECT_XYZ2UVU:EXPMAP": "of two images in one",
    "EDGE_STEREO_SE3_PROJECT_XYZ:EXPMAP": "of two images in one",
    "EDGE_SE3_PROJECT_XYZ:EXPMAP": "of cameras that the file does not hold",
    "EDGE_PROJECT_PSI2UV:EXPMAP": "of points by inverse depth",
}
_INFORMATION = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))


def read_g2o(path: Path) -> Poses | Reconstruction:
    """Read a pose graph or a bundle problem; there are no stamps, so poses are 0.1 s apart in order of their ids.

    Raises:
        TrajectoryError: it cannot be opened.
        ModelError: it holds neither, a line is damaged, an id comes twice or is missing, or observations have an
            information that is not the same in u and v.
    """
    tables = _tables(path)
    frames, points = _vertices(path, tables, (_CAM, _EXPMAP)), _vertices(path, tables, (_POINT, _OLD_POINT))
    if not len(points) and not len(tables[_CAM_EDGE]) + len(tables[_EXPMAP_EDGE]):
        poses = _vertices(path, tables, (_POSE, _EXPMAP, _CAM))
        if not len(poses):
            raise ModelError(f"{path}: no {_POSE} in it, nor {_CAM} or {_EXPMAP} with {_POINT}")
        return Poses(poses[:, 0].astype(np.uint64), stamps(len(poses)), poses[:, 1:4], poses[:, 4:8])
    edges, lens = _edges(path, tables)
    point, frame = (_places(path, edges[:, k], of[:, 0]) for k, of in enumerate((points, frames)))
    information = edges[:, 4:]
    if (information[:, 0] != information[:, 2]).any() or information[:, 1].any() or (information[:, 0] <= 0.0).any():
        raise ModelError(f"{path}: an observation whose information is not i I with i > 0 has no place here")
    intrinsics, camera = np.unique(lens, axis=0, return_inverse=True)
    params = np.zeros((len(intrinsics), N_PARAMS))
    params[:, :4] = intrinsics
    places = np.tile(np.eye(3), (len(params), 1, 1)), np.zeros((len(params), 3))
    rotation = geometry.matrix_from_quaternion(frames[:, 4:8])
    return Reconstruction(
        tuple(lens_of(int(Model.RATIONAL), row) for row in params),
        np.zeros((len(params), 2), np.intp),
        Cameras(*places, np.zeros(len(params), np.uint8), params),
        *geometry.inverse(rotation, frames[:, 1:4]),
        points[:, 1:4],
        np.full((len(points), 3), 255),
        frame,
        camera.ravel(),
        point,
        edges[:, 2:4],
        stamps(len(frames)),
        information[:, 0] ** -0.5,
    )


def write_g2o(path: Path, what: Poses | Reconstruction) -> None:
    """Write poses as a pose graph, each tied to the next by where it stands, or a reconstruction as a bundle problem.

    Raises:
        ModelError: a camera is no pinhole. OSError: the file cannot be written.
    """
    lines = _graph(what) if isinstance(what, Poses) else _bundle(path, what)
    with whole_file(path) as stream:
        stream.write("".join(f"{line}\n" for line in lines).encode())


def is_pinhole(model: Reconstruction) -> bool:
    """Return True if no camera has a distortion, so that g2o has a place for all of them."""
    return bool((model.cameras.model == Model.RATIONAL).all()) and not model.cameras.params[:, 4:].any()


def _tables(path: Path) -> dict[str, FloatArray]:
    """Return the numbers behind each word, a row a line."""
    rows: dict[str, list[list[float]]] = {word: [] for word in _WIDTH}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        word, *texts = line.split() or [""]
        if word in _UNREAD:
            raise ModelError(
                f"{path}:{number}: {word}: observations {_UNREAD[word]} are not read: expected {_CAM_EDGE}"
            )
        if word not in rows:
            continue
        try:
            values = [float(text) for text in texts]
        except ValueError:
            values = []
        ids = values[: _IDS.get(word, 1)]
        if len(values) != _WIDTH[word] or not np.isfinite(values).all() or any(i < 0 or i % 1 for i in ids):
            raise ModelError(
                f"{path}:{number}: expected {word} with {_WIDTH[word]} finite numbers, ids first: {line[:60]!r}"
            )
        rows[word].append(values)
    return {word: np.array(of).reshape(-1, _WIDTH[word]) for word, of in rows.items()}


def _vertices(path: Path, tables: dict[str, FloatArray], words: Iterable[str]) -> FloatArray:
    """Return id, position and, of poses, quaternion of all vertices of some kinds, by id."""
    found = [tables[word][:, :8] for word in words]
    rows = np.concatenate(found)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    twice = np.flatnonzero(np.diff(rows[:, 0]) == 0)
    if len(twice):
        raise ModelError(f"{path}: vertex {rows[twice[0], 0]:.0f} comes twice: expected a new id")
    if rows.shape[1] == 8 and not rows[:, 4:].any(axis=1).all():
        raise ModelError(f"{path}: a pose has a quaternion of zeros: expected a new id and a pose")
    return rows


def _edges(path: Path, tables: dict[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return point, frame, u, v and information (3) of each observation, and fx, fy, cx, cy of its camera."""
    own, shared, params = tables[_CAM_EDGE], tables[_EXPMAP_EDGE], tables[_PARAMS]
    by_id = np.argsort(params[:, 0], kind="stable")
    of = by_id[_places(path, shared[:, 2], params[by_id, 0])]
    cams = tables[_CAM][np.argsort(tables[_CAM][:, 0])]
    lens = np.concatenate([cams[_places(path, own[:, 1], cams[:, 0]), 8:12], params[of][:, [1, 1, 2, 3]]])
    return np.concatenate([own, shared[:, [0, 1, 3, 4, 5, 6, 7]]]), lens


def _places(path: Path, ids: FloatArray, known: FloatArray) -> IntArray:
    """Return where ids are among those that are known, which are sorted."""
    missing = ids[~np.isin(ids, known)]
    if len(missing):
        raise ModelError(f"{path}: an observation is of {missing[0]:.0f}, which is not in the file, or of another kind")
    return np.searchsorted(known, ids)


def _graph(poses: Poses) -> list[str]:
    both = np.hstack([poses.position, poses.orientation])
    rotation = geometry.matrix_from_quaternion(poses.orientation)
    back = np.swapaxes(rotation[:-1], 1, 2)
    step = (back @ np.diff(poses.position, axis=0)[:, :, None])[..., 0]
    edges = np.hstack([step, geometry.quaternion_from_matrix(back @ rotation[1:])])
    lines = [f"{_POSE} {i} {_joined(row)}" for i, row in enumerate(both)]
    lines += ["FIX 0"] if lines else []
    return lines + [f"{_STEP} {i} {i + 1} {_joined(row)} {_INFORMATION}" for i, row in enumerate(edges)]


def _bundle(path: Path, model: Reconstruction) -> list[str]:
    if not is_pinhole(model):
        raise ModelError(f"{path}: g2o has cameras without distortion alone: undistort, or write poses, as .tum")
    images, rotation, translation, image = model.images()
    back, position = geometry.inverse(rotation, translation)
    lens = model.cameras.params[images[:, 1], FX : CX + 2]
    rows = np.hstack([position, geometry.quaternion_from_matrix(back), lens, np.zeros((len(lens), 1))])
    n = len(rows)
    lines = [f"{_CAM} {i} {_joined(row)}" for i, row in enumerate(rows)]
    lines += ["FIX 0"] if lines else []
    lines += [f"{_POINT} {n + i} {_joined(row)}" for i, row in enumerate(model.points)]
    seen = zip(model.point.tolist(), image.tolist(), model.uv, model.sigma.tolist(), strict=True)
    return lines + [f"{_CAM_EDGE} {n + p} {i} {_joined(uv)} {s**-2!r} 0 {s**-2!r}" for p, i, uv, s in seen]


def _joined(row: FloatArray) -> str:
    return " ".join(map(repr, row.tolist()))
