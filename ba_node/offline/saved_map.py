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


def open_map(path: Path) -> Backend:
    """Return a back-end that knows a saved map, with the parameters' defaults.

    Raises:
        MapFileError: the file is none, or damaged.
    """
    config = Config()
    backend = Backend(config)
    backend.take_over(load_map(path, config.scene))
    return backend


def facts(backend: Backend) -> list[tuple[str, str]]:
    """Return name and value of what is in a map."""
    estimate, summary = backend.estimate(), backend.map.summary()
    report, poses = estimate.report, estimate.trajectory
    span = (poses.stamp_ns[-1] - poses.stamp_ns[0]) / _NS_PER_S if len(poses) else 0.0
    way = float(np.linalg.norm(np.diff(poses.position, axis=0), axis=1).sum())
    return [
        ("session", "none yet" if summary.session_id is None else str(summary.session_id)),
        ("frame of the map", estimate.frame_id),
        ("frame of the input", summary.frame_id or "not named"),
        ("cameras", str(summary.cameras)),
        ("keyframes", f"{summary.keyframes}, {summary.refined} refined, {span:.1f} s, {way:.1f} m"),
        ("landmarks", f"{summary.landmarks}, {len(estimate.cloud)} with position and two views"),
        ("observations", f"{summary.observations}, {summary.outliers} outliers"),
        ("rms, all observations", f"{backend.map.rms_px():.3f} px"),
        ("solves", f"{backend.solve_count}, the last: {report.status.name.lower()}, {report.reason}"),
        ("rejected", ", ".join(f"{n} {reason}" for reason, n in backend.map.rejected.items()) or "nothing"),
    ]
