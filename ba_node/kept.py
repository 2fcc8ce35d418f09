# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A property that is worked out once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar, overload

Value = TypeVar("Value")


class kept_property(Generic[Value]):  # noqa: N801  named as what it stands for
    """functools.cached_property without its lock: two threads may both work a value out, and neither waits.

    Up to Python 3.11 that lock is one for all instances. Work beside solves, which stops while a solve goes on, kept it
    for seconds, and the solve waited for it.
    """

    def __init__(self, work_out: Callable[[Any], Value]) -> None:
        self._work_out, self.__doc__ = work_out, work_out.__doc__

    def __set_name__(self, _owner: type, name: str) -> None:
        self._name = name

    @overload
    def __get__(self, instance: None, owner: type | None = None) -> kept_property[Value]: ...

    @overload
    def __get__(self, instance: object, owner: type | None = None) -> Value: ...

    def __get__(self, instance: object | None, owner: type | None = None) -> kept_property[Value] | Value:
        if instance is None:
            return self
        # What stands in the instance is found before this is asked again.
        value = vars(instance)[self._name] = self._work_out(instance)
        return value
