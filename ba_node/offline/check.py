# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test calibration and conventions of a recording against its tracks."""

from __future__ import annotations

from pathlib import Path

from ba_node.backend import Backend
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.examine import examine
from ba_node.check.tracks import tracks_of
from ba_node.config import Config
from ba_node.io.mcap import BagReader
from ba_node.scene.scene import Scene


class CheckError(ValueError):
    """A recording that has nothing to check, or no means to check it."""


def check_recording(bag: Path, config: Config) -> list[tuple[int, Diagnosis]]:
    """Return what the tracks of each session tell about the set-up, with its id.

    Raises:
        BagError: the recording cannot be read.
        CheckError: it holds no keyframes with tracks and a rig, or OpenCV is missing.
    """
    if not two_view.available():
        raise CheckError("OpenCV is missing: install opencv-python-headless (rosdep key python3-opencv)")
    backend = Backend(config)
    scenes: list[Scene] = [backend.scene]
    with BagReader(bag) as reader:
        for _, _, measurement in reader.measurements():
            backend.add(measurement)
            if backend.scene is not scenes[-1]:
                scenes.append(backend.scene)
        backend.flush(final=True)
        scenes += [backend.scene] if backend.scene is not scenes[-1] else []
        notes = [*reader.rejection_notes, *backend.rejection_notes]
    found = []
    for scene in scenes:
        tracks = tracks_of(scene)
        if tracks is not None:
            found.append((scene.session_id or 0, examine(tracks)))
    if not found:
        raise CheckError(f"{bag}: no keyframes with tracks and a camera rig in it{': ' + notes[-1] if notes else ''}")
    return found
