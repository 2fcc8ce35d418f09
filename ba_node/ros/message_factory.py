# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Make rclpy messages: the factory that ``ba_node.messages.conversion`` asks for."""

from __future__ import annotations

import array
import functools
import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


@functools.cache
def message_class(type_name: str) -> Any:
    """Return the Python class of a type such as ``ba_msgs/msg/Keyframe``.

    Raises:
        LookupError: the package is not installed, or has no such type.
    """
    package, _, rest = type_name.partition("/")
    kind, _, name = rest.partition("/")
    if not (package and kind and name):
        raise LookupError(f"message type {type_name!r}: expected package/msg/Name")
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError) as error:
        raise LookupError(f"message type {type_name!r} is not known to this Python environment: {error}") from error


class RclpyFactory:
    """Make messages of rclpy."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Return a message with the given fields."""
        return message_class(type_name)(**fields)

    def array(self, values: NDArray[Any]) -> array.array[Any]:
        """Return a sequence of numbers as array.array: rclpy takes it over as it is, an ndarray element by element."""
        flat = np.ascontiguousarray(values)
        out = array.array(_TYPECODES[flat.dtype.str[1:]])
        out.frombytes(flat.data.cast("B") if flat.size else b"")
        return out

    def fixed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return an array of fixed size: rclpy keeps these as ndarray."""
        return values


# The type code of array.array, as rclpy's setters ask for it, for each dtype.
_TYPECODES = {"u1": "B", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f4": "f", "f8": "d"}
