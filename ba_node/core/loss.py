# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses, as functions of the norm of a whitened residual.

The objective is ``1/2 sum Psi(|r|)`` with Psi(x) ~ x^2 near zero. IRLS (4.20-4.28) weighs each residual with
``w = Psi'(x) / (2 x)``, the first-order weight: it is never negative, so the weighted normal equations stay positive
semi-definite where the second-order (Triggs) correction does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LOSSES = ("squared", "huber")


def evaluate(loss: str, norm: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return the cost and the IRLS weight of residuals.

    Args:
        loss: one of LOSSES. Huber: x^2 up to ``scale``, then 2 scale x - scale^2.
        norm: (n,) norm of each whitened residual.
        scale: where the loss leaves the square.

    Returns:
        (n,) Psi and (n,) weights in (0, 1].

    Raises:
        ValueError: the loss is unknown.
    """
    if loss == "squared":
        return norm * norm, np.ones_like(norm)
    if loss == "huber":
        inside = norm <= scale
        cost = np.where(inside, norm * norm, 2.0 * scale * norm - scale * scale)
        return cost, np.where(inside, 1.0, scale / np.where(inside, 1.0, norm))
    raise ValueError(f"loss {loss!r} does not exist: choose one of {', '.join(LOSSES)}")
