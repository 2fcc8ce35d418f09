# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out from a recording whether the set-up is what it is said to be."""

from __future__ import annotations

from pathlib import Path

from ba_node.backend import Backend, Diagnosis, can_examine
from ba_node.config import Config
from ba_node.io.mcap import BagReader


class CheckError(ValueError):
    """A recording that has nothing to check, or no means to check it."""


def check_recording(bag: Path, config: Config) -> list[tuple[int, Diagnosis]]:
    """Return what the tracks of each session tell about the set-up, with its id.

    Raises:
        BagError: the recording cannot be read.
        CheckError: it holds no keyframes with tracks and a rig, or OpenCV is missing.
    """
    if not can_examine():
        raise CheckError("OpenCV is missing: install opencv-python-headless (rosdep key python3-opencv)")
    backend = Backend(config)
    found: list[tuple[int, Diagnosis]] = []

    def examine() -> None:
        diagnosis = backend.examine()
        if diagnosis is not None:
            found.append((backend.map.session_id, diagnosis))

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
