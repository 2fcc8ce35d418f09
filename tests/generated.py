# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make synthetic data once for all tests that ask for the same; it is not to be changed in place."""

from __future__ import annotations

import functools

from experiments.synthetic import SyntheticData, SyntheticOptions, generate


@functools.lru_cache(maxsize=32)
def generated(options: SyntheticOptions) -> SyntheticData:
    """Return what ``generate`` gives."""
    return generate(options)
