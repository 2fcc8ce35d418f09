# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test calibration and conventions of a recording against its tracks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.backend import Backend, CurrentMap, Diagnosis, can_examine
from ba_node.config import Config
from ba_node.io.bag_reader import BagReader
from ba_node.offline.attention import turned_away
from ba_node.offline.recording import arriving


class CheckError(ValueError):
    """A recording that has nothing to check, or no means to check it."""


@dataclass(frozen=True)
class CheckedSession:
    """What a session of a recording tells."""

    session_id: int  # the session; several may have the same
    keyframe_ids: tuple[int, int]  # of the first and the last keyframe, by time
    stamps_ns: tuple[int, int]  # of the same, ns
    found: Diagnosis  # what the tracks tell
    warnings: tuple[str, ...]  # what else somebody has to know: stamps that jump, messages that were turned away

    def as_dict(self) -> dict[str, Any]:
        """Return it for a JSON file."""
        facts = {"session_id": self.session_id, "keyframe_ids": self.keyframe_ids, "stamps_ns": self.stamps_ns}
        return {**facts, **self.found.as_dict(), "warnings": self.warnings}


@dataclass(frozen=True)
class CheckedRecording:
    """What a recording tells."""

    sessions: list[CheckedSession]  # what the tracks of each tell, at least one
    warnings: tuple[str, ...]  # what could not be read of it: files that are missing, messages that are damaged

    @property
    def all_warnings(self) -> tuple[str, ...]:
        """Return what somebody has to know beside the findings, of the recording and of its sessions."""
        return (*self.warnings, *(text for session in self.sessions for text in session.warnings))

    def as_dict(self) -> dict[str, Any]:
        """Return it for a JSON file."""
        return {"sessions": [session.as_dict() for session in self.sessions], "warnings": self.warnings}


def check_recording(bag: Path, config: Config) -> CheckedRecording:
    """Return what the tracks of each session tell about the set-up.

    Raises:
        BagError: the recording cannot be read.
        CheckError: it holds no keyframes with tracks and a rig, or OpenCV is missing.
    """
    if not can_examine():
        raise CheckError("OpenCV is missing: install opencv-python-headless (rosdep key python3-opencv)")
    backend = Backend(config)
    maps = [backend.map]
    with BagReader(bag) as reader:
        for _, _, measurement in arriving(reader.measurements(), backend):
            backend.add(measurement)
            if backend.map is not maps[-1]:
                maps.append(backend.map)
        backend.flush(final=True)
        maps += [backend.map] if backend.map is not maps[-1] else []
        notes = reader.rejection_notes
        warnings = (*reader.warnings.values(), *turned_away(reader.rejected), *list(notes)[-1:])
    found = [checked for one in maps if (checked := _checked(one)) is not None]
    if not found:
        reason = notes[-1] if notes else backend.map.summary().rejection_cause
        raise CheckError(f"{bag}: no keyframes with tracks and a camera rig in it{': ' + reason if reason else ''}")
    return CheckedRecording(found, warnings)


def _checked(one: CurrentMap) -> CheckedSession | None:
    found = one.examine()
    if found is None:
        return None
    poses = one.estimate().trajectory[np.array([0, -1])]
    ids, stamps = poses.keyframe_id.tolist(), poses.stamp_ns.tolist()
    warnings = (*one.warnings, *turned_away(one.rejected))
    return CheckedSession(one.session_id, (ids[0], ids[1]), (stamps[0], stamps[1]), found, warnings)
