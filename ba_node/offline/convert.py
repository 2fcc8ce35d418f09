# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read any of the formats, as a reconstruction or as poses alone, and write it as any other that can hold it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ba_node.backend import Backend, MapContent
from ba_node.config import Config
from ba_node.core.geometry import inverse, quaternion_from_matrix
from ba_node.core.problem import Cameras
from ba_node.estimate import Cloud, Poses
from ba_node.io import bundler, colmap
from ba_node.io.bal import read_bal, write_bal
from ba_node.io.map_file import is_map, read_map
from ba_node.io.mcap import BagReader, TopicChoice
from ba_node.io.model import ModelError, Reconstruction, from_bal, lens_of, to_bal
from ba_node.io.ply import write_ply
from ba_node.io.pose_files import is_g2o, read_g2o, write_g2o, write_kitti
from ba_node.io.reference import first_line, read_poses
from ba_node.io.trajectory import write_tum
from ba_node.measurements import CameraRig, Measurement
from ba_node.offline.model_timeline import timeline
from ba_node.offline.recording import record

BAL = (".txt", ".bz2", ".gz")
_BAGS = (".mcap", ".db3", ".zstd")
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
    if path.is_dir() or path.suffix in _BAGS:
        return of_recording(path, choice, progress)
    if bundler.is_bundler(path):
        scene = bundler.read_bundler(path)
        return replace(from_bal(scene.bal), colour=scene.colour)
    if is_map(path):
        return of_map(read_map(path))
    if is_g2o(path):
        return read_g2o(path)
    line = first_line(path)
    is_table = "," in line or len(line.split()) in (8, 12)
    return read_poses(path) if is_table else from_bal(read_bal(path))


def write(path: Path, what: Reconstruction | Poses, form: str) -> str:
    """Write; return in words what was left out, empty if nothing was.

    Raises:
        ModelError: the format has no place for it. OSError: it cannot be written.
    """
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
    rows = known[a["sightings/landmark"]] & ~a["sightings/outlier"]
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
        a["sightings/keyframe"][rows].astype(np.intp),
        a["sightings/camera"][rows].astype(np.intp),
        number[a["sightings/landmark"][rows]],
        a["sightings/uv"][rows].astype(np.float64),
        a["keyframes/stamp_ns"],
    )
