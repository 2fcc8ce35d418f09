# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses, as functions of the norm of a whitened residual; config/solver.py has their formulas.

The objective is ``1/2 sum Psi(|r|)`` with Psi(x) ~ x^2 near zero (4.20-4.22, where Psi carries the half itself). IRLS
(4.23-4.28) weighs each residual with ``w = Psi'(x) / (2 x)``, the first-order weight: it is never negative, so the
weighted normal equations stay positive semi-definite where the second-order (Triggs) correction does not.

A truncated quadratic pulls at nothing that starts outside ``scale``. Graduated non-convexity (GNC-TLS; Yang et al.,
*Graduated Non-Convexity for Robust Spatial Perception*, RA-L 2020) puts a family of surrogates in its place, nearly
convex for a small graduation mu and the loss itself for mu without end::

    Psi_mu(x) = x^2                                             x^2 <= mu/(mu + 1) c^2
              = 2 c x sqrt(mu (mu + 1)) - mu (c^2 + x^2)        between
              = c^2                                             x^2 >= (mu + 1)/mu c^2

Before them Huber's loss of the same scale, which is convex, stands in for a loss with a plateau.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ba_node.arrays import FloatArray

CostAndWeight = tuple[FloatArray, FloatArray]

# The graduation for which Huber's loss stands in.
HUBER = 0.0
# One standard deviation of a normal distribution, in median absolute deviations.
NORMAL = 1.4826


def robust_spread(errors: FloatArray) -> FloatArray:
    """Return the standard deviation about 0 of errors (n, ...), if they are normal but for outliers: (...)."""
    return np.asarray(NORMAL * np.median(np.abs(errors), axis=0))


def _squared(norm: FloatArray, _scale: float) -> CostAndWeight:
    return norm * norm, np.ones_like(norm)


def _huber(norm: FloatArray, scale: float) -> CostAndWeight:
    # With m = min(x, c) both branches are m (2 x - m), and c / max(x, c): no slow choice row by row.
    near = np.minimum(norm, scale)
    return near * (2.0 * norm - near), scale / np.maximum(norm, scale)


def _truncated_quadratic(norm: FloatArray, scale: float) -> CostAndWeight:
    return np.minimum(norm * norm, scale * scale), np.where(norm <= scale, 1.0, 0.0)


def _cauchy(norm: FloatArray, scale: float) -> CostAndWeight:
    ratio = (norm / scale) ** 2
    return scale * scale * np.log1p(ratio), 1.0 / (1.0 + ratio)


def _geman_mcclure(norm: FloatArray, scale: float) -> CostAndWeight:
    root = 1.0 / (1.0 + (norm / scale) ** 2)
    return norm * norm * root, root * root


LOSSES: dict[str, Callable[[FloatArray, float], CostAndWeight]] = {
    "squared": _squared,
    "huber": _huber,
    "truncated_quadratic": _truncated_quadratic,
    "cauchy": _cauchy,
    "geman_mcclure": _geman_mcclure,
}


def evaluate(loss: str, norm: FloatArray, scale: float, graduation: float = np.inf) -> CostAndWeight:
    """Return the cost and the IRLS weight of residuals, of norm (n,), for one of LOSSES.

    The loss leaves the square at ``scale``. ``graduation`` is mu of the surrogate of a truncated quadratic, HUBER for
    Huber's loss in the place of any; infinite for the loss itself.

    Returns:
        (n,) Psi and (n,) weights in [0, 1].

    Raises:
        ValueError: the loss is unknown.
    """
    if loss not in LOSSES:
        raise ValueError(f"loss {loss!r} does not exist: choose one of {', '.join(LOSSES)}")
    if graduation == HUBER:
        return _huber(norm, scale)
    if loss == "truncated_quadratic" and np.isfinite(graduation):
        return _surrogate(norm, scale, graduation)
    return LOSSES[loss](norm, scale)


def _surrogate(norm: FloatArray, scale: float, mu: float) -> CostAndWeight:
    """Return Psi_mu and its weight ``c/x sqrt(mu (mu + 1)) - mu`` between the square and the plateau."""
    root = np.sqrt(mu * (mu + 1.0))
    inside, outside = norm <= scale * np.sqrt(mu / (mu + 1.0)), norm >= scale * np.sqrt((mu + 1.0) / mu)
    between = 2.0 * scale * norm * root - mu * (scale * scale + norm * norm)
    cost = np.where(inside, norm * norm, np.where(outside, scale * scale, between))
    slope = scale * root / np.where(inside, 1.0, norm) - mu
    return cost, np.where(inside, 1.0, np.where(outside, 0.0, np.clip(slope, 0.0, 1.0)))
