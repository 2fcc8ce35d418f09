# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Write a map to one .npz file and read it back, bit for bit; docs/map_format.md describes the file.

An .npz is a zip archive of .npy arrays, which ``numpy.load`` and readers in many languages open. One more member,
``map.json``, holds the version of the format and what is no array. Every member carries a checksum, so that damage is
noticed; members are not compressed and carry no time, so the same map gives the same bytes.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node import __version__
from ba_node.backend import MapContent, MapError, archive
from ba_node.config import SceneConfig
from ba_node.io.files import opened, whole_file
from ba_node.io.unpack import ALWAYS_ALLOWED_BYTES, limit_for

FORMAT = "ba_node map"
VERSION = 2
SUFFIX = ".npz"
# Larger files are not read: such a map would not fit into the memory of most machines.
MAX_BYTES = 2**32
# What other tools have packed may grow by this factor.
MAX_GROWTH = 20
_HEAD = "map.json"
_MAX_HEAD_BYTES = 2**24
_ARRAY = ".npy"
# Not written, but what other tools write may be compressed.
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# What numpy, zipfile and zlib raise on archives that are cut off, altered, or made on purpose to be strange.
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, ValueError, NotImplementedError, RuntimeError)


class MapFileError(ValueError):
    """A file that is no map, a damaged one, or one of a newer format."""


def write_map(path: Path | str, content: MapContent) -> None:
    """Write a file that is whole and on the disk when this returns; before, an older one of the name stays.

    Raises:
        OSError: it cannot be written.
    """
    head = {"format": FORMAT, "version": VERSION, "written_by": f"ba_node {__version__}", **content.facts}
    with whole_file(path, durable=True) as stream, zipfile.ZipFile(stream, "w") as file:
        file.writestr(zipfile.ZipInfo(_HEAD), json.dumps(head, indent=1, allow_nan=False))
        for name, array in content.arrays.items():
            with file.open(zipfile.ZipInfo(name + _ARRAY), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, version=(1, 0), allow_pickle=False)


def read_map(path: Path | str) -> MapContent:
    """Read a file as it is; whether its parts fit together is checked by :func:`load_map`.

    Raises:
        MapFileError: it cannot be opened, is no map or damaged, or has a newer format.
    """
    with opened(path, MAX_BYTES, MapFileError) as stream:
        try:
            return _read(stream)
        except MapFileError as error:
            raise MapFileError(f"{path}: {error}") from None


def map_name(name: Path | str) -> Path:
    """Return the name of the file of a map: with ``.npz`` at its end, added where it is missing."""
    path = Path(name)
    return path if path.suffix == SUFFIX else Path(f"{path}{SUFFIX}")


def is_map(path: Path | str) -> bool:
    """Return True for a file that says to be a map, of whatever version; its arrays are not looked at."""
    try:
        with opened(path, MAX_BYTES, MapFileError) as stream, zipfile.ZipFile(stream) as file:
            if file.getinfo(_HEAD).file_size > _MAX_HEAD_BYTES:
                return False
            head = json.loads(file.read(_HEAD))
    except (RecursionError, *_DAMAGE):
        return False
    return isinstance(head, dict) and head.get("format") == FORMAT


def load_map(path: Path | str, config: SceneConfig) -> archive.MapState:
    """Return what a file holds, for :meth:`Backend.take_over`.

    Raises:
        MapFileError: as :func:`read_map`; or the parts of the file contradict each other.
    """
    content = read_map(path)
    try:
        return archive.unpack(content, config)
    except MapError as error:
        raise MapFileError(f"{path}: damaged: {error}") from error


def _read(stream: Any) -> MapContent:
    if not zipfile.is_zipfile(stream):
        stream.seek(0)
        is_cut = stream.read(2) == b"PK"
        raise MapFileError("cut off or damaged" if is_cut else "not a map: expected an .npz file of ba_node")
    try:
        with zipfile.ZipFile(stream) as file:
            if any(item.compress_type not in _COMPRESSIONS for item in file.infolist()):
                raise MapFileError("damaged: a member is compressed in a way that is not used")
            claimed = sum(item.file_size for item in file.infolist())
            if claimed > limit_for(stream.seek(0, io.SEEK_END), MAX_GROWTH, ALWAYS_ALLOWED_BYTES):
                raise MapFileError(f"its members claim {claimed >> 20} MB, which no map packs into that file")
            if _HEAD not in file.namelist():
                raise MapFileError(f"not a map: it has no {_HEAD}, which save_map writes")
            facts = _head(file.read(_HEAD))
            names = [name for name in file.namelist() if name.endswith(_ARRAY)]
            return MapContent({_current(name.removesuffix(_ARRAY)): _array(file.read(name)) for name in names}, facts)
    except MapFileError:
        raise
    except MemoryError:
        raise MapFileError("damaged, or too large for the memory of this machine") from None
    except _DAMAGE as error:
        raise MapFileError(f"damaged: {error}") from error


def _head(data: bytes) -> dict[str, Any]:
    head = json.loads(data)
    if not isinstance(head, dict) or head.get("format") != FORMAT:
        raise MapFileError(f"not a map: {_HEAD} does not say format {FORMAT!r}")
    version = head.get("version")
    if type(version) is not int or version < 1:
        raise MapFileError(f"damaged: version = {version!r}, expected a number")
    if version > VERSION:
        writer = head.get("written_by", "a newer ba_node")
        raise MapFileError(f"format version {version}, written by {writer}; this ba_node reads up to {VERSION}: update")
    return {name: value for name, value in head.items() if name not in ("format", "version", "written_by")}


def _current(name: str) -> str:
    """Return the name of an array that version 1 has under another one."""
    return name.replace("sightings/", "observations/", 1) if name.startswith("sightings/") else name


def _array(data: bytes) -> NDArray[Any]:
    """Return the array in an .npy file; one that claims another size than it has would cost all memory."""
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    except Exception as error:  # it parses the text as Python, and raises whatever that does
        raise MapFileError(f"damaged: {error}") from error
    if version != (1, 0):
        raise MapFileError(f"damaged: array of .npy version {version}, expected (1, 0)")
    size = int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize
    if dtype.hasobject or size != len(data) - stream.tell():
        raise MapFileError(f"damaged: an array {shape} of {dtype} in {len(data)} bytes")
    stream.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array
