# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
import threading
from dataclasses import dataclass

from ba_node.kept import kept_property
from tests.test_layers import MODULES, imports


@dataclass(frozen=True)
class Square:
    side: float
    working: threading.Event
    go_on: threading.Event | None = None

    @kept_property
    def area(self) -> float:
        """Return the area, once it may."""
        self.working.set()
        if self.go_on is not None:
            assert self.go_on.wait(10.0)
        return self.side**2


def test_is_worked_out_once() -> None:
    one = Square(3.0, threading.Event())
    assert one.area == 9.0
    one.working.clear()
    assert one.area == 9.0
    assert not one.working.is_set(), "it was worked out again"
    assert Square.area.__doc__ == "Return the area, once it may."


def test_nobody_waits_for_another_instance() -> None:
    held = Square(2.0, threading.Event(), threading.Event())
    assert held.go_on is not None
    found: list[float] = []
    thread = threading.Thread(target=lambda: found.append(held.area))
    thread.start()
    try:
        assert held.working.wait(10.0)
        other = threading.Thread(target=lambda: found.append(Square(3.0, threading.Event()).area))
        other.start()
        other.join(10.0)
        assert found == [9.0]
    finally:
        held.go_on.set()
        thread.join()
    assert found == [9.0, 4.0]


def test_functools_cached_property_is_not_used() -> None:
    """Its lock is one for all instances up to Python 3.11, and what runs beside solves stops while it has it."""
    for path in MODULES:
        assert "functools.cached_property" not in imports(path), path
        names = [node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)]
        assert "cached_property" not in names, path
