# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Diagonal matrices D for damping (H + mu D) and for the scaled trust region (|D p| <= radius).

``inc`` (3.38, 3.94-3.99): D = diag(1/step), with the steps that make forward differences of the reprojection error
agree best with the analytic Jacobian. The search of ``ba steps`` gives 1e-8 on Ladybug-49 for
rotation, translation and points, in both parameterisations. The residual is linear in f, k1 and k2, where the search
determines nothing; their values are those of nine tried that brought ``local_dinm`` to the smallest gradient there in
50 iterations.
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray

# Steps by kind of parameter: rotation (rad), translation (m), f (px), k1, k2, point (m).
INC_STEPS = {"rotation": 1e-8, "translation": 1e-8, "f": 1e-5, "k1": 1e-8, "k2": 1e-8, "point": 1e-8}

# Smallest entry of diag(H) that Marquardt damping and scaling count with, so that an unobserved direction is damped.
_MIN_DIAGONAL = 1e-6


def diagonals(kind: str, hessian: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return D for keyframes (n_free, d) and points (n_points, 3); zeros for ``none``.

    ``hessian`` is diag(B) (n_free, d) and diag(C) (n_points, 3).
    """
    d_c, d_p = hessian
    if kind == "identity":
        return np.ones_like(d_c), np.ones_like(d_p)
    if kind == "diag":
        return np.maximum(d_c, _MIN_DIAGONAL), np.maximum(d_p, _MIN_DIAGONAL) if len(d_p) else d_p
    if kind == "inc":
        steps = INC_STEPS
        row = [steps["rotation"]] * 3 + [steps["translation"]] * 3 + [steps["f"], steps["k1"], steps["k2"]]
        # Only ratios matter; dividing by the point's makes a point's entry 1.
        inverse = steps["point"] / np.array(row[: d_c.shape[1]])
        return np.broadcast_to(inverse, d_c.shape), np.ones_like(d_p)
    return np.zeros_like(d_c), np.zeros_like(d_p)


def scaled_space(
    kind: str, hessian: tuple[FloatArray, FloatArray], *, literal: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return D of ``p~ = D p`` (3.94-3.99), as :func:`diagonals`; the root of diag(H), and I for ``none``.

    ``literal``: diag(H) itself, as Algorithm 7 has it.
    """
    if kind == "none":
        kind = "identity"
    d_c, d_p = diagonals(kind, hessian)
    return (np.sqrt(d_c), np.sqrt(d_p)) if kind == "diag" and not literal else (d_c, d_p)
