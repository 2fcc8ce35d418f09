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
        scene, report = self.backend.scene, self.estimate.report
        table, poses = scene.keyframes, self.estimate.trajectory
        span = (poses.stamp_ns[-1] - poses.stamp_ns[0]) / _NS_PER_S if len(poses) else 0.0
        way = float(np.linalg.norm(np.diff(poses.position, axis=0), axis=1).sum())
        rows = [
            ("session", "none yet" if scene.session_id is None else str(scene.session_id)),
            ("frame of the map", self.estimate.frame_id),
            ("frame of the input", scene.frame_id or "not named"),
            ("cameras", str(0 if scene.cameras is None else len(scene.cameras.model))),
            ("keyframes", f"{len(table)}, {np.count_nonzero(table.refined)} refined, {span:.1f} s, {way:.1f} m"),
            ("landmarks", f"{len(scene.landmarks)}, {len(self.estimate.cloud)} with position and two views"),
            ("observations", f"{len(scene.sightings)}, {np.count_nonzero(scene.sightings.outlier)} outliers"),
            ("rms, all observations", f"{self.backend.rms_px():.3f} px"),
            ("solves", f"{self.backend.solve_count}, the last: {report.status.name.lower()}, {report.reason}"),
            ("rejected", ", ".join(f"{n} {reason}" for reason, n in self.backend.rejected.items()) or "nothing"),
        ]
        if self.backend.finished:
            rows.append(("older sessions", ", ".join(str(key) for key, _ in self.backend.finished)))
        return rows
