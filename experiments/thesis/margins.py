# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What a comparison of a claim asks for: margins from the thesis's own figures, or, where it prints none, said here.

A ratio that the thesis prints is asked for by half, in orders of magnitude: by its square root. So it is nearer to the
thesis than to no difference, and the thesis's own figures pass.
"""

from __future__ import annotations

import math

from experiments.thesis.catalogue import PRINTED
from experiments.thesis.verdicts import Below

# Objectives at one minimum differ by less than this from one seed or machine to another.
SAME = 1.0001
# A curve of the gradient that ends deeper by the look of a logarithmic plot, and one that does by orders of magnitude.
DEEPER, MUCH_DEEPER = 2.0, 10.0
# A curve that rises less on its way.
STEADIER = 1.5


def by_ratio(experiment: str, metric: str, small: str, *large: str) -> tuple[Below, ...]:
    """Return that a metric of one case is below that of others by half of what the thesis prints for each."""
    figures = PRINTED[experiment]
    return tuple(
        Below(experiment, metric, small, (label,), round(math.sqrt(figures[label][metric] / figures[small][metric]), 4))
        for label in large
    )


def deeper(experiment: str, small: str, *large: str, factor: float = DEEPER) -> tuple[Below, ...]:
    """Return that the gradient of one case ends below those of others."""
    return (Below(experiment, "gradient", small, large, factor),)


def lower(experiment: str, small: str, *large: str) -> tuple[Below, ...]:
    """Return that the objective of one case ends below those of others by more than those at one minimum differ."""
    return (Below(experiment, "objective", small, large, SAME),)


def same(experiment: str, one: str, other: str, share: float = 0.001) -> tuple[Below, ...]:
    """Return that the objectives of two cases end within a share of each other."""
    return tuple(Below(experiment, "objective", a, (b,), 1.0 / (1.0 + share)) for a, b in ((one, other), (other, one)))


def steadier(experiment: str, small: str, *large: str) -> tuple[Below, ...]:
    """Return that the gradient of one case rises less on its way than those of others."""
    return (Below(experiment, "gradient_rise", small, large, STEADIER),)
