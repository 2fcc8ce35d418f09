# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find the rig in a recording: its camera_rig, or its camera_info with p, r and /tf_static."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ba_node.backend import why_refused
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.rig_file import RigError, read_rig
from ba_node.measurements import CameraRig
from ba_node.messages.conversion import measurement_from_message
from ba_node.messages.factory import ConversionError
from ba_node.messages.rig import rig_from_infos
from ba_node.messages.topics import INPUT_TYPES, TF_STATIC
from ba_node.messages.transforms import StaticTree

_YAML = (".yaml", ".yml")


def load_rig(paths: Sequence[Path], *, rectified: bool = False, base: str = "") -> CameraRig:
    """Return the rig in YAML files of any form, or in a recording.

    Raises:
        RigError: a YAML file holds none, or a camera is one that node and replay turn away.
        BagError: the recording cannot be read, or holds none.
    """
    if all(path.suffix in _YAML for path in paths):
        rig = read_rig(*paths, rectified=rectified)
    else:
        with BagReader(paths) as reader:
            rig = rig_of_recording(reader, rectified=rectified, base=base)
    refused = why_refused(rig)
    if refused:
        raise RigError(f"{', '.join(map(str, paths))}: {refused}")
    return rig


def static_tree(reader: BagReader) -> StaticTree:
    """Return what /tf_static of a recording says; an empty tree if there is none."""
    tree = StaticTree()
    for topic, _, _, data in reader.messages([TF_STATIC]) if TF_STATIC in reader.topics else ():
        tree.add(reader.decode(topic, data))
    return tree


def rig_of_recording(
    reader: BagReader, infos: Sequence[str] = (), *, rectified: bool = False, base: str = ""
) -> CameraRig:
    """Return the rig of a recording.

    Args:
        reader: an open recording.
        infos: topics of camera_info, the left one first; empty: a camera_rig if there is one, else all there are.
        rectified: the images are rectified.
        base: body frame, empty for the first camera.

    Raises:
        BagError: there is none, or it cannot be told which is meant; says what is there.
    """
    rigs = [topic for topic, kind in sorted(reader.topics.items()) if kind == INPUT_TYPES["camera_rig"]]
    found = sorted(topic for topic, kind in reader.topics.items() if kind == INPUT_TYPES["camera_info"])
    if not infos and rigs:
        rig = measurement_from_message(INPUT_TYPES["camera_rig"], _first(reader, rigs[0]))
        assert isinstance(rig, CameraRig)
        if rig.malformed:
            raise BagError(f"{reader.path}: {rigs[0]}: {rig.malformed}")
        return rig
    chosen = list(infos) or found
    if not chosen or len(chosen) > 2:
        raise BagError(
            f"{reader.path}: cannot tell the rig from {len(chosen)} topics of {INPUT_TYPES['camera_info']}"
            f"{': ' + ', '.join(chosen) if chosen else ''}: give it as YAML"
        )
    try:
        messages = [_first(reader, topic) for topic in chosen]
        return rig_from_infos(messages, rectified=rectified, tree=static_tree(reader), base=base)
    except ConversionError as error:
        raise BagError(f"{reader.path}: {' and '.join(chosen)}: {error}") from error


def _first(reader: BagReader, topic: str) -> object:
    for name, _, _, data in reader.messages([topic]):
        return reader.decode(name, data)
    raise BagError(f"{reader.path}: no message on {topic}: record it, or give the rig as YAML (--rig FILE)")
