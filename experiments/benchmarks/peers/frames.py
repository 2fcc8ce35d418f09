# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Between BAL's camera (looks down -z, v upwards) and the optical frame (looks down z, v downwards) of most peers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ba_node.core.geometry import so3_exp, so3_log
from ba_node.io.bal import BalProblem

FloatArray = NDArray[np.float64]

FLIP = np.diag([1.0, -1.0, -1.0])


def optical_poses(bal: BalProblem) -> tuple[FloatArray, FloatArray]:
    """Return optical frame from world: rotations (n, 3, 3) and translations (n, 3)."""
    rotation: FloatArray = FLIP @ so3_exp(bal.cameras[:, :3])
    translation: FloatArray = bal.cameras[:, 3:6] @ FLIP
    return rotation, translation


def optical_uv(bal: BalProblem) -> FloatArray:
    """Return image coordinates with v downwards, (n_obs, 2) px."""
    return bal.observations * [1.0, -1.0]


def bal_cameras(rotation: FloatArray, translation: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """Return cameras (n, 9) from poses of the optical frame and f, k1, k2 (n, 3)."""
    return np.hstack([so3_log(FLIP @ rotation), translation @ FLIP, intrinsics])
