# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The short form of `make fuzz`: a few examples of every target, the same in every run."""

from __future__ import annotations

import resource

import pytest
from hypothesis import Phase, given, settings

from tests.fuzz import targets
from tests.fuzz.mutation import mutated

EXAMPLES = {"stream": 40, "drive": 3, "cdr": 40}
GROWTH_KB = 1_000_000


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.slow
@pytest.mark.parametrize("name", targets.NAMES)
def test_no_bytes_break_it(name: str) -> None:
    before = _peak_kb()

    @settings(max_examples=EXAMPLES.get(name, 40), phases=(Phase.explicit, Phase.reuse, Phase.generate), database=None)
    @given(mutated(name))
    def run(data: bytes) -> None:
        targets.run(name, data)

    for data in targets.seeds()[name]:
        assert targets.run(name, data) >= 1
    run()
    assert _peak_kb() - before < GROWTH_KB
