# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold a whole map as plain arrays and plain facts, and check what is claimed to be one.

What comes from a file is not trusted: every column must be there with its type, shape and length, every number must be
one that the checks of ``ingest.py`` let through, every index must point at something.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray
from ba_node.scene.tables import Column

_ROTATION_TOLERANCE = 1e-6


class MapError(ValueError):
    """Something that is not a map, or not a whole one; the text says what is wrong with which part."""


@dataclass(frozen=True)
class MapContent:
    """A map: what docs/map_format.md describes."""

    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)  # by name, for example ``keyframes/position``
    facts: dict[str, Any] = field(default_factory=dict)  # what JSON can hold

    def fact(self, name: str, kind: type | tuple[type, ...]) -> Any:
        """Return a fact.

        Raises:
            MapError: it is missing or of another type.
        """
        value = self.facts.get(name)
        # JSON has true and 1, and Python takes one for the other.
        wanted = kind if isinstance(kind, tuple) else (kind,)
        if name not in self.facts or (isinstance(value, bool) and bool not in wanted) or not isinstance(value, wanted):
            names = " or ".join(one.__name__ for one in wanted)
            raise MapError(f"{name} = {value!r}, expected {names}")
        require(not isinstance(value, int) or -(2**63) <= value < 2**64, f"{name} = {value}, expected 64 bits")
        return value

    def counts(self, name: str) -> dict[str, int]:
        """Return a fact that counts things by name.

        Raises:
            MapError: it is missing or something else.
        """
        value = self.fact(name, dict)
        require(all(type(n) is int and n >= 0 for n in value.values()), f"{name}: expected counts")
        return {str(key): n for key, n in value.items()}

    def sizes(self) -> dict[str, int]:
        """Return how many keyframes, landmarks and observations it has."""
        columns = {
            "keyframes": "keyframes/keyframe_id",
            "landmarks": "landmarks/track_id",
            "observations": "observations/keyframe",
        }
        return {name: len(self.arrays[column]) for name, column in columns.items()}

    def columns(self, group: str, wanted: Mapping[str, Column]) -> dict[str, NDArray[Any]]:
        """Return the arrays of a group, of equal length.

        Raises:
            MapError: one is missing, or has another type, shape or length than the first.
        """
        found: dict[str, NDArray[Any]] = {}
        for name, column in wanted.items():
            full = f"{group}/{name}"
            array = self.arrays.get(full)
            if array is None:
                raise MapError(f"{full} is missing")
            dtype = np.dtype(column.dtype)
            expected = f"({'n, ' if column.shape else 'n,'}{', '.join(map(str, column.shape))}) {dtype}"
            is_right = array.ndim > 0 and array.shape[1:] == column.shape and array.dtype == dtype
            require(is_right, f"{full} is {array.shape} {array.dtype}, expected {expected}")
            first = next(iter(found.values()), array)
            require(len(array) == len(first), f"{full} has {len(array)} rows, the first of {group} {len(first)}")
            found[name] = array
        return found


def require(condition: object, otherwise: str) -> None:
    """Raise MapError with a text unless a condition holds."""
    if not condition:
        raise MapError(otherwise)


def require_all(good: BoolArray, name: str, values: NDArray[Any], expected: str) -> None:
    """Raise MapError that names the first row which is not good."""
    bad = np.flatnonzero(~good)
    if len(bad):
        raise MapError(f"{name} of row {bad[0]} = {values[bad[0]].tolist()}: expected {expected}")


def require_index(values: NDArray[Any], limit: int, name: str) -> None:
    """Raise MapError unless every value counts from 0 to below the limit."""
    require_all((values >= 0) & (values < limit), name, values, f"an index below {limit}")


def require_unique(ids: NDArray[Any], name: str) -> None:
    """Raise MapError if a value occurs twice."""
    unique, count = np.unique(ids, return_counts=True)
    require(len(unique) == len(ids), f"{name} = {unique[np.argmax(count)] if len(ids) else 0} occurs more than once")


def require_rotations(rotation: FloatArray, name: str) -> None:
    """Raise MapError unless (n, 3, 3) are rotations."""
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).reshape(-1, 9).max(axis=1, initial=0.0)
        good = (off <= _ROTATION_TOLERANCE) & (np.linalg.det(rotation) > 0)
    require_all(good, name, rotation, "a rotation")


def within(values: NDArray[Any], limit: float) -> BoolArray:
    """Return which rows hold numbers of at most this size, none of them NaN."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(values) <= limit).all(axis=tuple(range(1, values.ndim))))


def prefixed(group: str, columns: Iterable[tuple[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return copies of the columns of a group by their full names."""
    return {f"{group}/{name}": np.array(values) for name, values in columns}
