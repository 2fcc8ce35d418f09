# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on relative poses by the C++ kernels (native/src/adjustment/relative_poses.hpp), all others by numpy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.core.factors import FactorSum, FactorTerms, KeyframeFactors, RelativePoses
from ba_node.core.problem import State

if TYPE_CHECKING:
    from ba_node.native._kernels import RelativePoses as CompiledPoses


class NativeFactorSum(FactorSum):
    """The sum of all factors of a problem, stepped locally."""

    def __init__(self, factors: Sequence[KeyframeFactors], fixed: NDArray[np.bool_]) -> None:
        """Hand those on relative poses over; they are copied."""
        super().__init__(factors, fixed)
        self._kernels = [self._kernel(kind, number) for number, kind in enumerate(self._factors)]

    def value(self, state: State) -> float:
        """Return 1/2 sum Psi."""
        total = 0.0
        for kind, kernel in zip(self._factors, self._kernels, strict=True):
            total += self._value(kind, state) if kernel is None else kernel.value(state)
        return total

    def _add(self, kind: KeyframeFactors, number: int, state: State, terms: FactorTerms) -> float:
        kernel = self._kernels[number]
        if kernel is None:
            return super()._add(kind, number, state, terms)
        return kernel.linearise(state, terms.gradient, terms.diagonal, terms.pairs.blocks)

    def _kernel(self, kind: KeyframeFactors, number: int) -> CompiledPoses | None:
        if not isinstance(kind, RelativePoses) or kind.loss not in native.LOSSES:
            return None
        kernel: CompiledPoses = native.kernels.RelativePoses(kind, self._column, self._pair[number][:, 0])
        return kernel
