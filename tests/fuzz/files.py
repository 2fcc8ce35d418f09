# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Readers of files as functions of bytes: each takes what is in the file, whatever it is."""

from __future__ import annotations

import bz2
import dataclasses
import functools
import gzip
import importlib.util
import io
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io import model, ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bal import BalProblem, read_bal, write_bal
from ba_node.io.bundler import from_bal, read_bundler, write_bundler
from ba_node.io.colmap import read_colmap, to_colmap, write_colmap
from ba_node.io.g2o import read_g2o, write_g2o
from ba_node.io.map_file import load_map, write_map
from ba_node.io.parameters import configure, parameters_yaml
from ba_node.io.ply import read_ply, write_ply
from ba_node.io.reference import read_poses
from ba_node.io.rig_file import FORMS, read_rig, rig_yaml
from ba_node.io.trajectory import read_tum, write_kitti, write_tum
from ba_node.messages.adapters import SOURCES, AdapterOptions
from ba_node.offline.adapt import adapt
from ba_node.offline.recording import read_truth, record
from ba_node.offline.track import TrackRequest, track
from experiments.robustness.faults import MONO, SOUND, spoiled
from tests.front_end import world
from tests.messages.adapters import layouts

COLMAP = ("cameras", "images", "points3D", "rigs", "frames")
# Forms of COLMAP's models, and whether they are text; none where pycolmap is missing.
FORMS_OF_COLMAP = {"": False, "_text": True} if importlib.util.find_spec("pycolmap") else {}
# Images of a recording, and left, top, width and height of the part of each that is in it, px.
_IMAGE, _IMAGES, _CUT = "sensor_msgs/msg/Image", 3, (80, 60, 160, 120)
Reader = Callable[[Path], object]
_TINY: dict[str, Any] = {"keyframes": 3, "length_m": 10.0, "landmarks": 200, "tracks": 12}
_MEMBER = struct.Struct("<HI")


def read_recording(path: Path) -> None:
    """Read a recording as a replay does, to its end."""
    with BagReader(path) as reader:
        for _ in reader.measurements():
            pass
        read_truth(reader)


def read_folder(path: Path) -> None:
    """Read a folder of rosbag2 whose metadata.yaml is the input."""
    folder = path.with_suffix(".folder")
    folder.mkdir()
    (folder / "a.mcap").write_bytes(seeds()["mcap_packed"][0])
    path.rename(folder / "metadata.yaml")
    read_recording(folder)


def read_plain_map(path: Path) -> None:
    """Pack members as they come into an archive with right checksums, and load that as a map.

    A member is a name of n bytes and a content of m bytes behind the two lengths: a change of a byte reaches the reader
    of arrays, which it seldom does behind a checksum.
    """
    data, stream = path.read_bytes(), io.BytesIO()
    offset = 0
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file, warnings.catch_warnings():
        # It warns of names that come twice, but writes them.
        warnings.simplefilter("ignore")
        while offset + _MEMBER.size <= len(data) and len(file.filelist) < 100:
            n, m = _MEMBER.unpack_from(data, offset)
            name = data[offset + _MEMBER.size :][:n].decode("latin-1")
            file.writestr(zipfile.ZipInfo(name), data[offset + _MEMBER.size + n :][:m])
            offset += _MEMBER.size + n + m
    path.write_bytes(stream.getvalue())
    load_map(path, Config().scene)


def _colmap(part: str, text: str = "") -> Reader:
    """Return a reader of a model of COLMAP of which one file is the input; ``text`` is "_text" where files are text."""

    def read(path: Path) -> None:
        folder = path.with_suffix(".model")
        folder.mkdir()
        for name in COLMAP:
            content = path.read_bytes() if name == part else seeds()[f"colmap{text}_{name}"][0]
            (folder / f"{name}.{'txt' if text else 'bin'}").write_bytes(content)
        read_colmap(folder)

    return read


def _adapted(source: str) -> Reader:
    """Return a reader of a recording of another front-end."""
    return lambda path: adapt(path, path.with_suffix(".mcap"), source, AdapterOptions(), 1, {})


def read_images(path: Path) -> None:
    """Track the images of a recording."""
    track(path, path.with_suffix(".mcap"), TrackRequest())


def _packed(suffix: str, pack: Callable[[bytes], bytes]) -> Reader:
    def read(path: Path) -> None:
        packed = path.with_suffix(suffix)
        packed.write_bytes(pack(path.read_bytes()))
        read_bal(packed)

    return read


# Name -> what reads a file.
READERS: dict[str, Reader] = {
    "mcap": read_recording,
    "mcap_packed": read_recording,
    "sqlite": read_recording,
    "folder": read_folder,
    "tum": read_tum,
    "bal": read_bal,
    "bal_bz2": _packed(".bz2", bz2.compress),
    "bal_gz": _packed(".gz", gzip.compress),
    "bal_bz2_raw": lambda path: read_bal(path.rename(path.with_suffix(".bz2"))),
    "bundler": read_bundler,
    "g2o": read_g2o,
    "ply": read_ply,
    "poses": read_poses,
    "rig": read_rig,
    **{f"colmap{form}_{part}": _colmap(part, form) for form in FORMS_OF_COLMAP for part in COLMAP},
    **{f"adapt_{source}": _adapted(source) for source in SOURCES},
    "images": read_images,
    "yaml": lambda path: configure(path, {}),
    "map": lambda path: load_map(path, Config().scene),
    "map_members": read_plain_map,
}


@functools.cache
def seeds() -> dict[str, list[bytes]]:
    """Return whole files for every reader."""
    with TemporaryDirectory() as name:
        return _seeds(Path(name))


def _seeds(folder: Path) -> dict[str, list[bytes]]:
    recording = spoiled(SOUND, MONO, **_TINY, guesses=True)
    record(folder / "a.mcap", recording.timeline, recording.sound.truth)
    backend = Backend(Config())
    for measurement in recording.measurements:
        backend.add(measurement)
    backend.flush(final=True)
    estimate = backend.solve()
    assert estimate is not None
    write_tum(folder / "a.tum", estimate.trajectory)
    write_map(folder / "a.npz", backend.snapshot())
    _write_sqlite(folder / "a.mcap", folder / "b")
    rng = np.random.default_rng(0)
    bal = _bal(rng)
    write_bal(folder / "a.txt", bal)
    write_bundler(folder / "a.out", from_bal(bal, np.full(bal.points.shape, 255)))
    write_g2o(folder / "a.g2o", estimate.trajectory)
    pinhole = dataclasses.replace(bal, cameras=bal.cameras * (np.arange(9) < 7))
    write_g2o(folder / "b.g2o", model.from_bal(pinhole))
    write_ply(folder / "a.ply", estimate.cloud, "map")
    for form, text in FORMS_OF_COLMAP.items():
        write_colmap(folder / f"model{form}", to_colmap(model.from_bal(bal)), text=text)
    write_kitti(folder / "a.kitti", estimate.trajectory)
    read = {suffix: (folder / f"a.{suffix}").read_bytes() for suffix in ("mcap", "tum", "npz", "txt")}
    yaml = parameters_yaml(Config()).encode()
    metadata = (folder / "b" / "metadata.yaml").read_bytes()
    return {
        "mcap": [_unpacked(folder / "a.mcap", chunked) for chunked in (True, False)],
        "mcap_packed": [read["mcap"]],
        "sqlite": [(folder / "b" / "b.db3").read_bytes()],
        "folder": [metadata.replace(b"b.db3", b"a.mcap").replace(b"sqlite3", b"mcap")],
        "tum": [read["tum"]],
        "bal": [read["txt"]],
        "bal_bz2": [read["txt"]],
        "bal_gz": [read["txt"]],
        "bal_bz2_raw": [bz2.compress(read["txt"])],
        "bundler": [(folder / "a.out").read_bytes()],
        "g2o": [(folder / "a.g2o").read_bytes(), (folder / "b.g2o").read_bytes()],
        "ply": [(folder / "a.ply").read_bytes()],
        "poses": [(folder / "a.kitti").read_bytes(), read["tum"], read["tum"].replace(b" ", b",")],
        "rig": [rig_yaml(world.rig(), form)[0].encode() for form in FORMS],
        **{
            f"colmap{form}_{part}": [(folder / f"model{form}" / f"{part}{'.txt' if text else '.bin'}").read_bytes()]
            for form, text in FORMS_OF_COLMAP.items()
            for part in COLMAP
        },
        **{f"adapt_{source}": [_of_front_end(folder, source)] for source in SOURCES},
        "images": [_of_images(folder)],
        "yaml": [yaml, b"a: &a [1, 2]\nb: *a\nsolver: {max_iterations: 3}\n"],
        "map": [read["npz"]],
        "map_members": [_members(folder / "a.npz")],
    }


def _bal(rng: np.random.Generator) -> BalProblem:
    camera, point = (index.ravel() for index in np.meshgrid(np.arange(2), np.arange(4), indexing="ij"))
    cameras = np.hstack([rng.normal(size=(2, 6)).round(2), np.tile([500.0, 0.0, 0.0], (2, 1))])
    return BalProblem(cameras, rng.normal(size=(4, 3)).round(2), camera, point, rng.normal(size=(8, 2)).round(1))


def _of_front_end(folder: Path, source: str) -> bytes:
    """Return a recording of what another front-end publishes."""
    made = getattr(layouts, source)(layouts.scene(5, tracks=8, landmarks=300))
    return _file_in(layouts.write(folder / source, made))


def _of_images(folder: Path) -> bytes:
    """Return a recording of images of a stereo rig, cut so that they are small."""
    rig, (left, top, width, height), sent = world.rig(), _CUT, []
    fx, fy, cx, cy = rig.intrinsics[0] - [0.0, 0.0, left, top]
    for index, name in enumerate(rig.names):
        info = layouts.make(
            layouts.CAMERA_INFO, header=layouts.header(1, name), width=width, height=height,
            k=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]), r=np.eye(3).ravel(),
            p=np.array([fx, 0, cx, -fx * world.BASELINE * index, 0, fy, cy, 0, 0, 0, 1, 0]),
        )  # fmt: skip
        sent.append(layouts.Sent(f"/{name}/camera_info", layouts.CAMERA_INFO, info, 1))
    for k, pose in enumerate(world.drive(_IMAGES)):
        for index, name in enumerate(rig.names):
            grey = world.render(rig, index, pose).grey[top : top + height, left : left + width]
            image = layouts.make(
                _IMAGE, header=layouts.header(10**9 + 10**8 * k, name), width=width, height=height,
                encoding="mono8", step=width, data=grey.ravel(),
            )  # fmt: skip
            sent.append(layouts.Sent(f"/{name}/image_raw", _IMAGE, image, 10**9 + 10**8 * k))
    return _file_in(layouts.write(folder / "images", sent))


def _file_in(folder: Path) -> bytes:
    return next(folder.glob("*.mcap")).read_bytes()


def _unpacked(path: Path, chunked: bool) -> bytes:
    """Return a recording without compression and checksums, so that a changed byte reaches the decoders."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=4096, compression=CompressionType.NONE, use_chunking=chunked, enable_crcs=False)
    writer.start("ros2")
    channels: dict[str, int] = {}
    with BagReader(path) as reader:
        for topic, kind, time_ns, data in reader.messages():
            if topic not in channels:
                text = ros_types.schema_text(kind).encode()
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text))
            writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def _write_sqlite(bag: Path, folder: Path) -> None:
    with BagReader(bag) as reader, Rosbag2(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, time_ns, data in reader.messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros_types.typestore())
            writer.write(connections[topic], time_ns, data)


def _members(path: Path) -> bytes:
    with zipfile.ZipFile(path) as file:
        parts = [(item.encode("latin-1"), file.read(item)) for item in file.namelist()]
    return b"".join(_MEMBER.pack(len(name), len(content)) + name + content for name, content in parts)
