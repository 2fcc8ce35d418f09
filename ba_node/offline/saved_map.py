# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Tell what is in a saved map."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io.map_file import load_map

_NS_PER_S = 1e9


class SavedMap:
    """A map from a file.

    Attributes:
        backend: that knows it, with the parameters' defaults.
        estimate: its poses and points.

    Raises:
        MapFileError: the file is none, or damaged.
    """

    def __init__(self, path: Path) -> None:
        """Read it."""
        config = Config()
        self.backend = Backend(config)
        self.backend.take_over(load_map(path, config.scene))
        self.estimate = self.backend.estimate()

    def facts(self) -> list[tuple[str, str]]:
        """Return name and value of what there is to tell."""
        summary, report, poses = self.backend.map.summary(), self.estimate.report, self.estimate.trajectory
        span = (poses.stamp_ns[-1] - poses.stamp_ns[0]) / _NS_PER_S if len(poses) else 0.0
        way = float(np.linalg.norm(np.diff(poses.position, axis=0), axis=1).sum())
        rows = [
            ("session", "none yet" if summary.session_id is None else str(summary.session_id)),
            ("frame of the map", self.estimate.frame_id),
            ("frame of the input", summary.frame_id or "not named"),
            ("cameras", str(summary.cameras)),
            ("keyframes", f"{summary.keyframes}, {summary.refined} refined, {span:.1f} s, {way:.1f} m"),
            ("landmarks", f"{summary.landmarks}, {len(self.estimate.cloud)} with position and two views"),
            ("observations", f"{summary.observations}, {summary.outliers} outliers"),
            ("rms, all observations", f"{self.backend.map.rms_px():.3f} px"),
            ("solves", f"{self.backend.solve_count}, the last: {report.status.name.lower()}, {report.reason}"),
            ("rejected", ", ".join(f"{n} {reason}" for reason, n in self.backend.rejected.items()) or "nothing"),
        ]
        if self.backend.finished:
            rows.append(("older sessions", ", ".join(str(key) for key, _ in self.backend.finished)))
        return rows
