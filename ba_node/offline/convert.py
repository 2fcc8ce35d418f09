# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read any of the formats, as a reconstruction or as poses alone, and write it as any other that can hold it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.backend import Backend, MapContent
from ba_node.config import Config
from ba_node.core.cameras import Model
from ba_node.core.geometry import inverse, quaternion_from_matrix
from ba_node.core.problem import Cameras
from ba_node.estimate import Cloud, Poses
from ba_node.io import bundler, colmap
from ba_node.io.bag_files import SUFFIXES
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import TopicChoice
from ba_node.io.bal import read_bal, write_bal
from ba_node.io.g2o import is_pinhole, read_g2o, write_g2o
from ba_node.io.map_file import is_map, read_map
from ba_node.io.model import ModelError, Reconstruction, from_bal, lens_of, stamps, to_bal
from ba_node.io.ply import read_ply, write_ply
from ba_node.io.reference import first_line, read_poses
from ba_node.io.trajectory import write_kitti, write_tum
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.offline.recording import record

_FIXED_FRAME, _BODY_FRAME = "map", "body"
_MAX_CAMERAS = 2**16
BAL = (".txt", ".bz2", ".gz")
# By name, how a target of the format usually ends.
FORMATS = {
    "mcap": (".mcap",),
    "colmap": ("",),
    "colmap-text": (),
    "bundler": (".out",),
    "bal": BAL,
    "tum": (".tum",),
    "kitti": (".kitti",),
    "g2o": (".g2o",),
    "ply": (".ply",),
}


def read(
    path: Path, choice: TopicChoice, progress: Callable[[int, int], None] = lambda _done, _total: None
) -> Reconstruction | Poses:
    """Read a file or folder, whichever format it has; ``progress`` hears of the messages of a recording.

    Raises:
        ModelError: it has none that is known. Readers raise errors of their own, all of them ValueErrors.
    """
    if path.is_dir() and colmap.is_model(path):
        return colmap.read_colmap(path).model
    if path.is_dir() or path.suffix in SUFFIXES:
        return of_recording(path, choice, progress)
    if bundler.is_bundler(path):
        scene = bundler.read_bundler(path)
        return replace(from_bal(scene.bal), colour=scene.colour)
    if is_map(path):
        return of_map(read_map(path))
    if path.suffix == ".g2o":
        return read_g2o(path)
    if path.suffix == ".ply":
        return of_points(*read_ply(path))
    line = first_line(path)
    is_table = path.suffix in (".tum", ".kitti", ".csv") or "," in line or len(line.split()) in (8, 12)
    return read_poses(path) if is_table else from_bal(read_bal(path))


def write(path: Path, what: Reconstruction | Poses, form: str) -> str:
    """Write; return in words what was left out, empty if nothing was.

    Raises:
        ModelError: the format has no place for it. OSError: it cannot be written.
    """
    if form == "g2o" and isinstance(what, Reconstruction) and is_pinhole(what):
        write_g2o(path, what)
        return "image sizes and colours"
    if form in ("tum", "kitti", "g2o"):
        writers: dict[str, Callable[[Path, Poses], None]] = {"tum": write_tum, "kitti": write_kitti, "g2o": write_g2o}
        writers[form](path, what if isinstance(what, Poses) else poses_of(what))
        return "" if isinstance(what, Poses) else "cameras, points and observations"
    if isinstance(what, Poses):
        raise ModelError(f"{path}: poses alone are written as tum, kitti or g2o, not as {form}: there are no points")
    if form == "ply":
        views = np.bincount(what.point, minlength=len(what.points)).astype(np.int32)
        unknown = np.full(len(what.points), np.nan, np.float32)
        write_ply(path, Cloud(np.arange(len(views), dtype=np.uint64), what.points, unknown, views), "map")
        return "cameras, poses and observations"
    if form == "mcap":
        once, repeated = what.once()
        record(path, timeline(once))
        return f"{repeated} observations of points that an image saw already" if repeated else ""
    if form == "bal":
        write_bal(path, to_bal(what))
        return "principal points, image sizes and colours"
    if form == "bundler":
        bundler.write_bundler(path, bundler.from_bal(to_bal(what), what.colour))
        return "principal points and image sizes"
    colmap.write_colmap(path, colmap.to_colmap(what), text=form == "colmap-text")
    return ""


def format_of(path: Path, asked: str | None) -> str:
    """Return the format of a target, by its name unless it is asked for.

    Raises:
        ModelError: the name tells none.
    """
    if asked is not None:
        return asked
    for form, suffixes in FORMATS.items():
        if path.suffix in suffixes or (form == "colmap" and path.is_dir()):
            return form
    ends = ", ".join(suffix for suffixes in FORMATS.values() for suffix in suffixes if suffix)
    raise ModelError(f"{path}: which format is this to be? Give --to, a name that ends in {ends}, or that of a folder")


def counts(what: Reconstruction | Poses) -> str:
    """Return in words how much there is."""
    if isinstance(what, Poses):
        return f"{len(what)} poses"
    frames, cameras = len(what.rotation), len(what.lens)
    return f"{frames} keyframes, {cameras} cameras, {len(what.points)} points, {len(what.uv)} observations"


def poses_of(model: Reconstruction) -> Poses:
    """Return the frames of a reconstruction by time, world from body."""
    order = np.argsort(model.stamp_ns, kind="stable")
    rotation, position = inverse(model.rotation[order], model.translation[order])
    return Poses(order.astype(np.uint64), model.stamp_ns[order], position, quaternion_from_matrix(rotation))


def of_points(points: FloatArray, colour: IntArray) -> Reconstruction:
    """Return points, (m, 3), that nothing sees."""
    none, flat = np.empty((0, 3, 3)), np.empty((0, 3))
    cameras = Cameras(none, flat, np.empty(0, np.uint8), np.empty((0, 12)))
    index = np.empty(0, np.intp)
    seen = (index, index, index, np.empty((0, 2)))
    return Reconstruction((), np.empty((0, 2), np.intp), cameras, none, flat, points, colour, *seen, stamps(0))


def of_recording(path: Path, choice: TopicChoice, progress: Callable[[int, int], None]) -> Reconstruction:
    """Return what the back-end makes of a recording with its defaults, as `ba replay` does: the newest session.

    Raises:
        BagError: the recording cannot be read.
        ModelError: nothing in it can be used.
    """
    backend = Backend(Config())
    sizes = np.zeros((0, 2), np.intp)
    with BagReader(path, choice) as reader:

        def measurements() -> Iterator[Measurement]:
            nonlocal sizes
            for done, (_, _, measurement) in enumerate(reader.measurements(), start=1):
                if isinstance(measurement, CameraRig) and not measurement.malformed:
                    sizes = measurement.image_size.astype(np.intp)
                yield measurement
                progress(done, reader.message_count)

        for _ in backend.replay(measurements()):
            pass
    model = of_map(backend.snapshot())
    # A map does not hold how large images are.
    return replace(model, size=sizes) if len(sizes) == len(model.lens) else model


def of_map(content: MapContent) -> Reconstruction:
    """Return a map as it is refined, without its outliers.

    Raises:
        ModelError: it has no keyframes or no cameras.
    """
    a = content.arrays
    if "cameras/model" not in a or not len(a["keyframes/stamp_ns"]):
        raise ModelError("nothing in it can be used: it has no keyframes, or no cameras")
    rotation, translation = inverse(a["keyframes/rotation"], a["keyframes/position"])
    known = a["landmarks/has_position"]
    rows = known[a["observations/landmark"]] & ~a["observations/outlier"]
    number = np.cumsum(known) - 1
    kinds, params = a["cameras/model"], a["cameras/params"]
    return Reconstruction(
        tuple(lens_of(int(kind), values) for kind, values in zip(kinds, params, strict=True)),
        np.zeros((len(kinds), 2), np.intp),
        Cameras(a["cameras/rotation"], a["cameras/translation"], kinds, params),
        rotation,
        translation,
        a["landmarks/position"][known],
        np.full((int(known.sum()), 3), 255),
        a["observations/keyframe"][rows].astype(np.intp),
        a["observations/camera"][rows].astype(np.intp),
        number[a["observations/landmark"][rows]],
        a["observations/uv"][rows].astype(np.float64),
        a["keyframes/stamp_ns"],
    )


def timeline(model: Reconstruction) -> Iterator[tuple[str, int, Measurement]]:
    """Yield topic, stamp in ns and measurement: the rig, then of each frame its keyframe, guesses and tracks.

    Ids are the indices in the model. A point is guessed with the first frame that sees it; points that no image sees
    are not sent, unless points are all that there is. No image may see a point twice.

    Raises:
        ModelError: more cameras than a message can number, or a focal length that is not positive.
    """
    n_cameras = len(model.lens)
    if not n_cameras:
        ids = np.arange(len(model.points), dtype=np.uint64)
        yield "landmark_guesses", int(stamps(1)[0]), LandmarkGuesses(0, ids, model.points)
        return
    if n_cameras > _MAX_CAMERAS:
        raise ModelError(f"{n_cameras} cameras: a recording can number {_MAX_CAMERAS}")
    focal = model.cameras.params[:, :2].min(axis=1, initial=np.inf)
    if (focal <= 0.0).any():
        camera = int(np.argmax(focal <= 0.0))
        raise ModelError(f"camera {camera}: f = {focal[camera]:g} px: expected > 0")
    yield "camera_rig", int(model.stamp_ns.min(initial=2**62)), rig(model)
    rotation, position = inverse(model.rotation, model.translation)
    orientation = quaternion_from_matrix(rotation)
    order = np.lexsort((model.camera, model.frame))
    bounds = np.searchsorted(model.frame[order], np.arange(len(rotation) + 1))
    sent = np.zeros(len(model.points), dtype=bool)
    for frame in np.argsort(model.stamp_ns, kind="stable").tolist():
        stamp_ns = int(model.stamp_ns[frame])
        rows = order[bounds[frame] : bounds[frame + 1]]
        yield "keyframes", stamp_ns, Keyframe(0, frame, stamp_ns, _FIXED_FRAME, position[frame], orientation[frame])
        new = np.unique(model.point[rows][~sent[model.point[rows]]])
        if len(new):
            sent[new] = True
            yield "landmark_guesses", stamp_ns, LandmarkGuesses(0, new.astype(np.uint64), model.points[new])
        for camera in np.unique(model.camera[rows]).tolist():
            of = rows[model.camera[rows] == camera]
            ids = model.point[of].astype(np.uint64)
            yield "feature_tracks", stamp_ns, FeatureTracks(0, frame, camera, ids, model.uv[of], model.sigma[of])


def rig(model: Reconstruction) -> CameraRig:
    """Return the cameras as a rig."""
    names, coefficients = zip(*map(_named, model.cameras.model, model.cameras.params), strict=True)
    rotation, position = inverse(model.cameras.rotation, model.cameras.translation)
    return CameraRig(
        frame_id=_BODY_FRAME,
        names=tuple(f"camera_{number}" for number in range(len(names))),
        models=names,
        intrinsics=model.cameras.params[:, :4],
        distortion=coefficients,
        image_size=model.size.astype(np.int64),
        position=position,
        orientation=quaternion_from_matrix(rotation),
    )


def _named(model: np.uint8, params: FloatArray) -> tuple[str, FloatArray]:
    """Return distortion model and coefficients as CameraInfo has them."""
    if model == Model.EQUIDISTANT:
        return "equidistant", params[4:8]
    return ("rational_polynomial", params[4:12]) if params[9:12].any() else ("plumb_bob", params[4:9])
