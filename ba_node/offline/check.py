# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Test calibration and conventions of a recording against its tracks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ba_node.backend import Backend, Diagnosis, can_examine
from ba_node.config import Config
from ba_node.io.mcap import BagReader
from ba_node.offline.attention import turned_away


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
    if not can_examine():
        raise CheckError("OpenCV is missing: install opencv-python-headless (rosdep key python3-opencv)")
    backend = Backend(config)
    found: list[CheckedSession] = []

    def examine() -> None:
        checked = _checked(backend)
        if checked is not None:
            found.append(checked)

    with BagReader(bag) as reader:
        for _, _, measurement in reader.measurements():
            for admitted in backend.admit(measurement):
                if admitted.begins is not None:
                    examine()
                backend.take(admitted)
        backend.flush(final=True)
        examine()
        notes = [*reader.rejection_notes, *backend.rejection_notes]
    if not found:
        raise CheckError(f"{bag}: no keyframes with tracks and a camera rig in it{': ' + notes[-1] if notes else ''}")
    return found


def _checked(backend: Backend) -> CheckedSession | None:
    diagnosis = backend.examine()
    if diagnosis is None:
        return None
    keyframes = sorted(backend.map.input_keyframes(), key=lambda keyframe: keyframe.stamp_ns)
    ends = (keyframes[0], keyframes[-1])
    return CheckedSession(
        backend.map.session_id,
        (ends[0].keyframe_id, ends[1].keyframe_id),
        (ends[0].stamp_ns, ends[1].stamp_ns),
        diagnosis,
        (*backend.warnings, *turned_away(backend.rejected)),
    )
