# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write models of COLMAP, text and binary, through pycolmap.

COLMAP counts pixels from the corner of the image, so that (0.5, 0.5) is the middle of the first one; ours are half a
pixel less. Rigs of several cameras stay rigs.
"""

from __future__ import annotations

import contextlib
import importlib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import geometry
from ba_node.core.problem import Cameras
from ba_node.io.files import whole_file
from ba_node.io.model import ModelError, Reconstruction, lens_values, read_lens, stamps

_PARTS = ("cameras", "images", "points3D")
_FILES = (*_PARTS, "rigs", "frames")
# What pycolmap raises, and what numbers lead to that make no sense.
_DAMAGE = (ValueError, RuntimeError, IndexError, KeyError, OverflowError, MemoryError)


@dataclass(frozen=True)
class ColmapModel:
    """A model as pycolmap has it, and which of its parts stand where in ours."""

    world: Any  # pycolmap.Reconstruction
    model: Reconstruction
    camera_ids: list[int]
    frame_ids: list[int]
    point_ids: list[int]
    views: IntArray  # (l, 2) image, and number among its features, of each observation

    def take(self, model: Reconstruction, left_out: BoolArray) -> None:
        """Take over poses, points and cameras of a solution, and delete observations (l,) that took no part in it.

        All else, ids too, stays as it was read. COLMAP deletes what is behind its camera before it adjusts.
        """
        colmap = library()
        for id_, rotation, translation in zip(self.frame_ids, model.rotation, model.translation, strict=True):
            self.world.frames[id_].rig_from_world = _rigid(colmap, rotation, translation)
        for id_, xyz in zip(self.point_ids, model.points, strict=True):
            self.world.points3D[id_].xyz = xyz
        for number, id_ in enumerate(self.camera_ids):
            camera = self.world.cameras[id_]
            camera.params = lens_values(model.lens[number], model.cameras.params[number])
            for rig in self.world.rigs.values():
                if camera.sensor_id in rig.non_ref_sensors:
                    place = model.cameras.rotation[number], model.cameras.translation[number]
                    rig.set_sensor_from_rig(camera.sensor_id, _rigid(colmap, *place))
        for image, feature in self.views[left_out].tolist():
            if self.world.images[image].points2D[feature].has_point3D():
                self.world.delete_observation(image, feature)
        self.world.update_point_3d_errors()


def library() -> Any:
    """Return pycolmap.

    Raises:
        ModelError: it is not installed.
    """
    try:
        colmap = importlib.import_module("pycolmap")
    except ModuleNotFoundError:
        raise ModelError("models of COLMAP need pycolmap: pip install ba_node[colmap]") from None
    colmap.logging.minloglevel = 2  # what goes wrong is said by us
    return colmap


def is_model(path: Path) -> bool:
    """Return True if a folder holds a model of COLMAP."""
    return any(all((path / f"{part}{suffix}").is_file() for part in _PARTS) for suffix in (".bin", ".txt"))


def read_colmap(path: Path) -> ColmapModel:
    """Read a model, a folder with cameras, images and points3D as .bin or .txt.

    Images without a pose are left out.

    Raises:
        ModelError: the folder holds none or a damaged one, or a camera that is not supported.
    """
    if not is_model(path):
        raise ModelError(f"{path}: no model of COLMAP: expected {', '.join(_PARTS)} as .bin or .txt")
    colmap = library()
    for part in (path / f"{name}.bin" for name in _FILES):
        if part.is_file():
            _require_whole(part)
    try:
        return _converted(path, colmap.Reconstruction(path))
    except ModelError:
        raise
    except _DAMAGE as error:
        text = f"a file of it is damaged, or does not fit the others (pycolmap: {' '.join(str(error).split())})"
        raise ModelError(f"{path}: cannot be read: {text}: export it again") from None


def _converted(path: Path, world: Any) -> ColmapModel:
    """Return a model in our terms too."""
    camera_ids, point_ids = sorted(world.cameras), sorted(world.points3D)
    frame_ids = sorted(id_ for id_ in world.reg_frame_ids())
    cameras = [world.cameras[id_] for id_ in camera_ids]
    lenses = [
        read_lens(camera.model_name, camera.params, f"{path}: camera {id_}")
        for id_, camera in zip(camera_ids, cameras, strict=True)
    ]
    places = [_place(world, camera) for camera in cameras]
    poses = [world.frames[id_].rig_from_world for id_ in frame_ids]
    frame, camera, point, uv, views = _observations(world, camera_ids, frame_ids, point_ids)
    model = Reconstruction(
        tuple(camera.model_name for camera in cameras),
        np.array([(camera.width, camera.height) for camera in cameras], np.intp).reshape(-1, 2),
        Cameras(
            np.array([rotation for rotation, _ in places]).reshape(-1, 3, 3),
            np.array([translation for _, translation in places]).reshape(-1, 3),
            np.array([family for family, _ in lenses], np.uint8),
            np.array([params for _, params in lenses]).reshape(-1, 12),
        ),
        np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
        np.array([pose.translation for pose in poses]).reshape(-1, 3),
        np.array([world.points3D[id_].xyz for id_ in point_ids]).reshape(-1, 3),
        np.array([world.points3D[id_].color for id_ in point_ids], np.intp).reshape(-1, 3),
        frame,
        camera,
        point,
        uv,
        stamps(len(frame_ids)),
    )
    return ColmapModel(world, model, camera_ids, frame_ids, point_ids, views)


def _require_whole(path: Path) -> None:
    """Raise ModelError if a binary file is shorter than what it claims: pycolmap goes on reading then, for hours."""
    data = path.read_bytes()
    end, count = 8, int.from_bytes(data[:8], "little")
    for number in range(min(count, len(data))):
        end = _end_of_record(path.stem, data, end)
        if end > len(data):
            raise ModelError(f"{path}: cut off or damaged at record {number} of {count}")
    if count > len(data) or len(data) < 8:
        raise ModelError(f"{path}: cut off or damaged: {count} records in {len(data)} bytes")


def _end_of_record(part: str, data: bytes, begin: int) -> int:
    """Return where a record of a binary file ends; of a camera, whose parameters differ in number, the least."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    if part == "cameras":
        return begin + 24
    if part == "images":
        name = data.find(b"\0", begin + 64) + 1 or len(data) + 1
        return name + 8 + 24 * number(name, 8)
    if part == "points3D":
        return begin + 51 + 8 * number(begin + 43, 8)
    if part == "frames":
        return begin + 68 + 16 * number(begin + 64, 4)
    end = begin + 8
    for sensor in range(min(number(begin + 4, 4), len(data))):
        end += 8 if sensor == 0 else 9 + 56 * number(end + 8, 1)
    return end


def _observations(
    world: Any, camera_ids: list[int], frame_ids: list[int], point_ids: list[int]
) -> tuple[IntArray, IntArray, IntArray, FloatArray, IntArray]:
    """Return frame, camera and point of each observation, its pixel from the middle of the first, and its view."""
    camera_of, frame_of, point_of = (
        {id_: number for number, id_ in enumerate(ids)} for ids in (camera_ids, frame_ids, point_ids)
    )
    frames, cameras, points, pixels, views = [], [], [], [], [np.empty((0, 2), np.intp)]
    for id_ in sorted(world.reg_image_ids()):
        image = world.images[id_]
        seen = image.get_observation_points2D()
        features = image.get_observation_point2D_idxs()
        views.append(np.stack([np.full(len(seen), id_), np.array(features, np.intp)], axis=1))
        frames.append(np.full(len(seen), frame_of[image.frame_id]))
        cameras.append(np.full(len(seen), camera_of[image.camera_id]))
        points.append(np.array([point_of[point.point3D_id] for point in seen], np.intp))
        pixels.append(np.array([point.xy for point in seen]).reshape(-1, 2) - 0.5)
    none = [np.empty(0, np.intp)]
    index = [np.concatenate(part or none) for part in (frames, cameras, points)]
    return index[0], index[1], index[2], np.concatenate([np.empty((0, 2)), *pixels]), np.concatenate(views)


def write_colmap(path: Path, world: Any, *, text: bool = False) -> None:
    """Write a model into a folder, which is made if there is none; another model in it is written over.

    On an error none of its files has changed.

    Raises:
        ModelError: the folder cannot be made, or holds something else, or there is no room for temporary files.
        OSError: a file cannot be written.
    """
    if path.exists() and not is_model(path) and (not path.is_dir() or any(path.iterdir())):
        raise ModelError(f"{path}: is there already and is no model of COLMAP: name another folder")
    with tempfile.TemporaryDirectory(prefix="ba_colmap_") as made, contextlib.ExitStack() as stack:
        (world.write_text if text else world.write_binary)(made)
        path.mkdir(exist_ok=True)
        for part in sorted(Path(made).iterdir()):
            _require_written(part)
            stream = stack.enter_context(whole_file(path / part.name))
            stream.write(part.read_bytes())
            stream.flush()  # all are on the disk before the first of them takes its name
    for name in _FILES:
        # What an older model of the other form has left would be read in its place.
        (path / f"{name}{'.bin' if text else '.txt'}").unlink(missing_ok=True)


def _require_written(part: Path) -> None:
    """Raise ModelError if the end of a file is missing: pycolmap does not say when a disk is full."""
    if part.suffix == ".bin":
        try:
            _require_whole(part)
            return
        except ModelError:
            pass
    elif part.read_bytes()[-1:] == b"\n":
        return
    raise ModelError(f"no room for temporary files in {part.parent.parent}: make room, or name another TMPDIR")


def to_colmap(model: Reconstruction) -> Any:
    """Return a model of COLMAP: a rig where frames have several cameras, else cameras by themselves."""
    colmap = library()
    world = colmap.Reconstruction()
    images = np.unique(np.stack([model.frame, model.camera], axis=1), axis=0)
    is_rig = len(images) > len(np.unique(images[:, 0]))
    place = model.cameras.rotation, model.cameras.translation
    if is_rig:
        first = geometry.inverse(place[0][:1], place[1][:1])
        place = geometry.compose(*place, *(np.repeat(part, len(place[0]), axis=0) for part in first))
        rig = colmap.Rig(rig_id=1)
    for number, (name, params) in enumerate(zip(model.lens, model.cameras.params, strict=True)):
        width, height = (
            int(side) or int(2 * middle + 1) for side, middle in zip(model.size[number], params[2:4], strict=True)
        )
        values = lens_values(name, params)
        camera = colmap.Camera(
            model=name, width=max(width, 1), height=max(height, 1), params=values, camera_id=number + 1
        )
        if not is_rig:
            world.add_camera_with_trivial_rig(camera)
            continue
        world.add_camera(camera)
        if number == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, _rigid(colmap, place[0][number], place[1][number]))
    if is_rig:
        world.add_rig(rig)
    _add_images(colmap, world, model, images, is_rig)
    return world


def _add_images(colmap: Any, world: Any, model: Reconstruction, images: IntArray, is_rig: bool) -> None:
    """Add frames, images and points to a world that has cameras and rigs."""
    order = np.lexsort((model.camera, model.frame))
    key = images[:, 0] * len(model.lens) + images[:, 1]
    bounds = np.searchsorted((model.frame * len(model.lens) + model.camera)[order], [*key, np.inf])
    tracks = [colmap.Track() for _ in model.points]
    made = []
    for number, (frame, camera) in enumerate(images.tolist()):
        rows = order[bounds[number] : bounds[number + 1]]
        name = f"camera_{camera}/{frame:06d}.png" if is_rig else f"{frame:06d}.png"
        made.append(colmap.Image(name=name, keypoints=model.uv[rows] + 0.5, camera_id=camera + 1, image_id=number + 1))
        for place, point in enumerate(model.point[rows].tolist()):
            tracks[point].add_element(number + 1, place)
        pose = (model.rotation[frame], model.translation[frame])
        from_body = 0 if is_rig else camera
        cams = model.cameras
        posed = _rigid(colmap, *geometry.compose(cams.rotation[from_body], cams.translation[from_body], *pose))
        if not is_rig:
            world.add_image_with_trivial_frame(made[-1], posed)
        elif number == 0 or images[number - 1, 0] != frame:
            held = colmap.Frame(frame_id=frame + 1, rig_id=1)
            held.rig_from_world = posed
            for other in np.flatnonzero(images[:, 0] == frame).tolist():
                sensor = colmap.sensor_t(colmap.SensorType.CAMERA, int(images[other, 1]) + 1)
                held.add_data_id(colmap.data_t(sensor, other + 1))
            world.add_frame(held)
        if is_rig:
            made[-1].frame_id = frame + 1
            world.add_image(made[-1])
    for xyz, colour, track in zip(model.points, model.colour, tracks, strict=True):
        world.add_point3D(xyz, track, colour.astype(np.uint8))
    world.update_point_3d_errors()


def _place(world: Any, camera: Any) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation, camera from rig."""
    for rig in world.rigs.values():
        if camera.sensor_id in rig.non_ref_sensors:
            pose = rig.sensor_from_rig(camera.sensor_id)
            if pose is not None:
                return np.asarray(pose.rotation.matrix()), np.asarray(pose.translation)
    return np.eye(3), np.zeros(3)


def _rigid(colmap: Any, rotation: FloatArray, translation: FloatArray) -> Any:
    return colmap.Rigid3d(colmap.Rotation3d(rotation), translation)
