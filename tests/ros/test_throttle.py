# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from ba_node.ros.throttle import Throttle


def test_lets_each_key_through_once_a_period() -> None:
    throttle = Throttle(5.0)
    passed = [(key, t) for t in range(12) for key in ("a", "b") if throttle.passes(key, float(t))]
    assert passed == [("a", 0), ("b", 0), ("a", 5), ("b", 5), ("a", 10), ("b", 10)]


def test_remembers_a_bounded_number_of_keys() -> None:
    throttle = Throttle(5.0, max_keys=2)
    assert all(throttle.passes(key, 0.0) for key in ("a", "b", "c"))
    assert not throttle.passes("c", 1.0)
    assert throttle.passes("a", 1.0), "the oldest key was forgotten to make room"
