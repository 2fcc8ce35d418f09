# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out from a recording whether the set-up is what it is said to be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.backend import Backend
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.examine import examine
from ba_node.check.tracks import tracks_of
from ba_node.config import Config
from ba_node.io.mcap import BagReader
from ba_node.offline.attention import turned_away
from ba_node.scene.scene import Scene


class CheckError(ValueError):
    """A recording that has nothing to check, or no means to check it."""


@dataclass(frozen=True)
class CheckedSession:
    """What a session of a recording tells.

    Attributes:
        session_id: the session; several may have the same.
        keyframe_ids: of the first and the last keyframe, by time.
        stamps_ns: of the same, ns.
        found: what the tracks tell.
        warnings: what else somebody has to know: stamps that jump, messages that were turned away.
    """

    session_id: int
    keyframe_ids: tuple[int, int]
    stamps_ns: tuple[int, int]
    found: Diagnosis
    warnings: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return it for a JSON file."""
        facts = {"session_id": self.session_id, "keyframe_ids": self.keyframe_ids, "stamps_ns": self.stamps_ns}
        return {**facts, **self.found.as_dict(), "warnings": self.warnings}


def check_recording(bag: Path, config: Config) -> list[CheckedSession]:
    """Return what the tracks of each session tell about the set-up.

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
    found = [checked for scene in scenes if (checked := _checked(scene)) is not None]
    if not found:
        raise CheckError(f"{bag}: no keyframes with tracks and a camera rig in it{': ' + notes[-1] if notes else ''}")
    return found


def _checked(scene: Scene) -> CheckedSession | None:
    tracks = tracks_of(scene)
    if tracks is None:
        return None
    table, ends = scene.keyframes, scene.order[[0, -1]]
    ids, stamps = (tuple(column[ends].tolist()) for column in (table.keyframe_id, table.stamp_ns))
    warnings = (*scene.log.warnings.values(), *turned_away(scene.log.rejected))
    return CheckedSession(scene.session_id or 0, ids, stamps, examine(tracks), warnings)
