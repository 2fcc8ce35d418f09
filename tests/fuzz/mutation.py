# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw inputs near good ones with hypothesis."""

from __future__ import annotations

from hypothesis import strategies as st

from tests.fuzz import targets


@st.composite
def mutated(draw: st.DrawFn, name: str) -> bytes:
    """Draw a good input of a target with bytes changed, left out, repeated, or cut off."""
    data = bytearray(draw(st.sampled_from(targets.seeds()[name])))
    for _ in range(draw(st.integers(1, 5))):
        if not data:
            break
        at, length = draw(st.integers(0, len(data) - 1)), draw(st.integers(1, 16))
        kind = draw(st.sampled_from(["set", "insert", "remove", "repeat", "cut"]))
        if kind == "set":
            data[at : at + length] = draw(st.binary(min_size=1, max_size=length))
        elif kind == "insert":
            data[at:at] = draw(st.binary(min_size=1, max_size=length))
        elif kind == "remove":
            del data[at : at + length]
        elif kind == "repeat":
            data[at:at] = data[max(0, at - 10 * length) : at]
        elif draw(st.integers(0, 3)) == 0:
            del data[at:]
    return bytes(data)
