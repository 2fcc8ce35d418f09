# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ba_node.ros.worker.latency import WINDOW, Sliding


@given(st.lists(st.floats(0.0, 1e3), min_size=1, max_size=150))
def test_quantiles_are_those_of_the_last_numbers(values: list[float]) -> None:
    sliding = Sliding()
    for value in values:
        found = sliding.add(value)
    last = values[-WINDOW:]
    assert found.largest == max(last)
    assert found.p50 == np.percentile(last, 50, method="lower")
    assert found.p95 == np.percentile(last, 95, method="higher")
