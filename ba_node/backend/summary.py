# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Count what is in a map, and say how well it explains its observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import Config
from ba_node.scene.scene import Scene
from ba_node.window import quality


@dataclass(frozen=True)
class MapSummary:
    """What there is to tell of a map."""

    session_id: int | None  # the session, None before the first message that names one
    frame_id: str  # name of the front-end's fixed frame, empty if it has none
    cameras: int  # number of cameras; 0 before a rig came that can be used
    refused_rig: str  # why the last rig that was refused was, empty if none was
    keyframes: int  # number of keyframes
    refined: int  # those that took part in a usable solve
    landmarks: int  # number of tracks
    observations: int  # number of observations
    outliers: int  # those that sit out the next solve
    # of the states ``input`` and ``refined``, figures as of ``window.quality.summary``
    residuals: dict[str, dict[str, float | int | None]]
    rejected: dict[str, int]  # what was turned away, by reason
    notices: dict[str, int]  # what was unusual but used, by kind
    rejection_notes: list[str]  # the last rejections in words, oldest first
    rejection_cause: str  # the first case of what was turned away by itself, in words; empty if nothing was
    warnings: dict[str, str]  # what somebody has to know or mend, by kind
    observed: quality.Residuals  # of each observation, by what is refined
    body_from_camera: FloatArray  # (3, 3) axes of the first camera on the body; those of the body before a rig came


@dataclass(frozen=True)
class MapEnded:
    """Another map has taken the place of the one before."""

    summary: MapSummary  # of the map before
    replaced: bool  # True if it held nothing but a keyframe with a wrong stamp, and counts as never begun


def summary_of(scene: Scene, config: Config) -> MapSummary:
    """Return the summary of a scene."""
    return MapSummary(
        session_id=scene.session_id,
        frame_id=scene.frame_id,
        cameras=0 if scene.cameras is None else len(scene.cameras.model),
        refused_rig=scene.refused_rig,
        keyframes=len(scene.keyframes),
        refined=int(np.count_nonzero(scene.keyframes.refined)),
        landmarks=len(scene.landmarks),
        observations=len(scene.observations),
        outliers=int(np.count_nonzero(scene.observations.outlier)),
        residuals={state: quality.summary(scene, config, state) for state in quality.STATES},
        rejected=dict(sorted(scene.log.rejected.items())),
        notices=dict(sorted(scene.log.notices.items())),
        rejection_notes=list(scene.log.notes),
        rejection_cause=scene.log.cause(),
        warnings=dict(scene.log.warnings),
        observed=quality.residuals(scene, config, "refined"),
        body_from_camera=np.eye(3) if scene.cameras is None else scene.cameras.rotation[0].T,
    )
