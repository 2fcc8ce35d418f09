# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the files that a recording consists of: one, those that its metadata.yaml lists, or those in a folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ba_node.io.bag_topics import BagError
from ba_node.io.files import FileKindError, open_regular
from ba_node.io.unpack import ALWAYS_ALLOWED_BYTES, limit_for, pieces
from ba_node.io.yaml_file import YamlError, read_yaml

METADATA = "metadata.yaml"
STORAGES = (".mcap", ".db3")
PACKED = ".zstd"
# How the name of a recording ends.
SUFFIXES = (*STORAGES, PACKED)
MAX_PACKED_BYTES = 2**40
_KNOWN = ("mcap", "sqlite3")
# How rosbag2 numbers the parts of a recording.
_NUMBERED = re.compile(r"_(\d{1,4})\.[^.]+$")


class BagFiles(NamedTuple):
    """The files of a recording."""

    paths: list[Path]  # the files, in no particular order
    are_parts: bool  # a metadata.yaml says that they are parts of one recording
    warnings: dict[str, str]  # what somebody has to know about them, by kind


def find_files(paths: Sequence[Path]) -> BagFiles:
    """Return the files of a recording that is given as a folder, its metadata.yaml, or files.

    Raises:
        BagError: there are none, none of a kind that is read, or they are of several recordings; says what to do.
    """
    return _find_several(paths) if len(paths) > 1 else _find_one(paths[0])


def _find_several(paths: Sequence[Path]) -> BagFiles:
    given = list(dict.fromkeys(Path(path).resolve() for path in paths))
    folder = next((path for path in given if path.is_dir()), None)
    if folder is not None and len(given) > 1:
        raise BagError(f"{folder}: a folder is a recording by itself: give it alone")
    single = [_find_one(path) for path in given]
    files = list(dict.fromkeys(file for found in single for file in found.paths))
    # That a file is a part of more is no news where more are given.
    warnings = [item for found in single for item in found.warnings.items() if item[0] != "split"]
    are_parts = _of_one_metadata(files)
    if not are_parts:
        _require_common_name(files)
        warnings.extend(_gaps(files).items())
    return BagFiles(files, are_parts, dict(warnings))


def _of_one_metadata(files: list[Path]) -> bool:
    """Return True if one metadata.yaml lists all of some files."""
    if len({file.parent for file in files}) > 1:
        return False
    names = {name.removesuffix(PACKED) for name in _names(files[0].parent)}
    return {file.name.removesuffix(PACKED) for file in files} <= names


def same_recording(first: Path, second: Path) -> bool:
    """Return True if two files are parts of one recording, by a metadata.yaml beside them or by their names."""
    one, other = first.resolve(), second.resolve()
    if one.parent != other.parent:
        return False
    return _of_one_metadata([one, other]) or _base_name(one) == _base_name(other)


def _require_common_name(files: list[Path]) -> None:
    """Raise BagError unless files are called as parts of one recording are: alike but for a number at the end."""
    for file in files[1:]:
        if _base_name(file) != _base_name(files[0]):
            raise BagError(
                f"{files[0].name} and {file.name} are two recordings by their names, and are not mixed: give one;"
                " parts of one recording are called NAME_0, NAME_1, ... or lie in a folder, which is given alone"
            )


def _base_name(path: Path) -> str:
    name = path.name.removesuffix(PACKED)
    return re.sub(r"[-_.]?\d+$", "", name.removesuffix(Path(name).suffix))


def _gaps(files: list[Path]) -> dict[str, str]:
    """Return a warning if the numbers at the end of the names NAME_0, NAME_1, ... leave some out."""
    found = [_NUMBERED.search(file.name.removesuffix(PACKED)) for file in files]
    numbers = {int(match[1]) for match in found if match is not None}
    if len(numbers) < len(files) or len({_base_name(file) for file in files}) > 1:
        return {}
    missing = [number for number in range(min(numbers), max(numbers)) if number not in numbers]
    if not missing:
        return {}
    shown = _shown([f"number {number}" for number in missing])
    text = f"{files[0].name} and its like: {shown} not among the {len(files)} files: results have gaps"
    return {"missing_files": text}


def _find_one(path: Path) -> BagFiles:
    if path.name == METADATA and path.is_file():
        path = path.parent
    if not path.is_dir():
        return BagFiles([path], True, _part_of(path))
    if (path / METADATA).is_file():
        try:
            return _listed(path, _metadata(path))
        except YamlError as error:
            files = _in_folder(path)
            text = f"{error}: all recordings in its folder are taken"
            return BagFiles(files, False, {"metadata": text, **_gaps(files)})
    files = _in_folder(path)
    return BagFiles(files, False, _gaps(files))


def _metadata(folder: Path) -> dict[str, Any]:
    content = read_yaml(folder / METADATA, YamlError)
    facts = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    if not isinstance(facts, dict) or not isinstance(facts.get("relative_file_paths"), list):
        raise YamlError(f"{folder / METADATA}: no rosbag2_bagfile_information with relative_file_paths")
    return facts


def _names_in(facts: dict[str, Any]) -> list[str]:
    """Return the files that a metadata.yaml lists, relative to its folder; older writers add its own name in front."""
    return list(dict.fromkeys(Path(str(name)).name for name in facts["relative_file_paths"]))


def _names(folder: Path) -> list[str]:
    """Return the files that the metadata.yaml of a folder lists, none where there is none that can be read."""
    try:
        return _names_in(_metadata(folder))
    except YamlError:
        return []


def _listed(folder: Path, facts: dict[str, Any]) -> BagFiles:
    storage, packing = facts.get("storage_identifier"), str(facts.get("compression_format") or "")
    names = _names_in(facts)
    if storage and storage not in _KNOWN:  # without one the files tell
        raise BagError(f"{folder}: storage {storage!r} is not read: convert it with ros2 bag convert to mcap")
    if packing not in ("", "zstd"):
        raise BagError(f"{folder}: compression_format {packing!r} is not read: unpack it, or record with zstd or none")
    found = {name: _there(folder / name) for name in names}
    files = [file for file in found.values() if file is not None]
    missing = [name for name, file in found.items() if file is None]
    if not files:
        raise BagError(f"{folder}: none of the files that its {METADATA} lists is there: {_shown(missing)}")
    text = f"{folder}: {len(missing)} of its {len(names)} files are missing: {_shown(missing)}: results have gaps"
    warnings = {"missing_files": text} if missing else {}
    parts = {_base_name(file) for file in files}
    taken = {name.removesuffix(PACKED) for name in names}
    more = [
        file.name
        for file in _recordings_in(folder)
        if _base_name(file) in parts and file.name.removesuffix(PACKED) not in taken
    ]
    if more:
        text = f"{folder}: its {METADATA} does not list {_shown(more)}: left aside; take it away to read all files"
        warnings["unlisted_files"] = text
    return BagFiles(files, True, warnings)


def _there(path: Path) -> Path | None:
    """Return a file, or the same packed or unpacked; None if neither is there."""
    other = path.with_suffix("") if path.suffix == PACKED else path.with_name(path.name + PACKED)
    return next((candidate for candidate in (path, other) if candidate.is_file()), None)


def _in_folder(folder: Path) -> list[Path]:
    """Return the recordings in a folder, by number and name; what is there packed and unpacked once."""
    files = _recordings_in(folder)
    if not files:
        raise BagError(f"{folder}: no recording in this folder: expected .mcap or .db3 files, as ros2 bag writes them")
    return files


def _recordings_in(folder: Path) -> list[Path]:
    files = [f for f in folder.iterdir() if f.is_file() and f.name.removesuffix(PACKED).endswith(STORAGES)]
    by_name = {f.name.removesuffix(PACKED): f for f in sorted(files, key=lambda f: f.suffix == PACKED, reverse=True)}
    return [by_name[name] for name in sorted(by_name, key=_natural)]


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(word[:18]), "") if word.isdecimal() else (-1, word) for word in re.split(r"(\d+)", name)]


def _part_of(path: Path) -> dict[str, str]:
    """Return a warning if a file is one of several of a recording."""
    names = _names(path.parent)
    if len(names) < 2 or path.name not in names:
        return {}
    return {"split": f"{path} is one of {len(names)} files of a recording: give its folder {path.parent} to read all"}


def unpack_file(path: Path, folder: Path) -> Path:
    """Unpack a file into a folder and return the one made.

    Raises:
        BagError: it cannot be read, is damaged, or far larger than a recording can be.
    """
    target = folder / path.stem
    try:
        # A recording of black images packs well.
        limit = limit_for(path.stat().st_size, growth=1000, always=16 * ALWAYS_ALLOWED_BYTES)
        with open_regular(path, MAX_PACKED_BYTES) as packed, target.open("xb") as out:
            out.writelines(pieces("zstd", packed, limit))
            if not out.tell():
                raise BagError(f"{path}: nothing comes out of its {path.stat().st_size} bytes: it is cut off, or empty")
    except BagError:
        raise
    except FileKindError as error:
        raise BagError(str(error)) from None
    except OSError as error:
        raise BagError(f"{path}: cannot be unpacked: {error.strerror or error}") from error
    except Exception as error:  # what the library raises on damaged data is no OSError
        raise BagError(f"{path}: cannot be unpacked: {error}") from error
    return target


def _shown(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
