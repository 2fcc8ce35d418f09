# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give all poses and points of a map as they are at a moment, put together when somebody looks at them.

The tables of a scene are copied by pieces, and what has not changed since the estimate before is shared with it
(``scene/tables.py``). So an estimate costs what its solve has changed, and stays as it is, on any thread, whatever
becomes of the map.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.core import geometry
from ba_node.estimate import Cloud, Poses
from ba_node.scene.scene import Scene
from ba_node.scene.tables import Piece

# A point is one of the map once so many images have seen it.
_LEAST_VIEWS = 2


def poses_of(scene: Scene, rows: IntArray) -> Poses:
    """Return the poses of some keyframes."""
    table = scene.keyframes
    return _poses(table.keyframe_id[rows], table.stamp_ns[rows], table.rotation[rows], table.position[rows])


class MapPoses(Poses):
    """The poses of all keyframes, oldest first."""

    @classmethod
    def taken(cls, scene: Scene) -> MapPoses:
        """Take them as they are now."""
        lazy = cls.__new__(cls)
        vars(lazy).update(_rows=scene.keyframes.copy(), _order=scene.order)
        return lazy

    def __len__(self) -> int:
        return len(self._order) if "_order" in vars(self) else super().__len__()

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> Poses:
        """Return some of the poses; the newest are cheap."""
        if "_order" not in vars(self):
            return super().__getitem__(rows)
        at = self._order[rows]
        return _poses(*(self._rows.take(name, at) for name in self._rows.pieces[0]))

    def __getattr__(self, name: str) -> Any:
        """Put together what nobody has looked at yet."""
        return _made(self, name, Poses, lambda: self[:])


class MapCloud(Cloud):
    """The points of the map that have a position and two views, by track id."""

    @classmethod
    def taken(cls, scene: Scene) -> MapCloud:
        """Take them as they are now."""
        lazy = cls.__new__(cls)
        vars(lazy).update(_rows=scene.landmarks.copy())
        return lazy

    def __getattr__(self, name: str) -> Any:
        """Put together what nobody has looked at yet."""
        return _made(self, name, Cloud, self._whole)

    def _whole(self) -> Cloud:
        pieces = [_points(piece) for piece in self._rows.pieces]
        columns = [np.concatenate(column) for column in zip(*(vars(piece).values() for piece in pieces), strict=True)]
        if (columns[0][1:] < columns[0][:-1]).any():
            order = np.argsort(columns[0])
            columns = [column[order] for column in columns]
        return Cloud(*columns)


def _made(lazy: Poses | Cloud, name: str, kind: type, make: Any) -> Any:
    """Return a field of a dataclass that is made when a field of it is looked at for the first time."""
    if name not in kind.__annotations__:
        raise AttributeError(name)
    vars(lazy).update(vars(make()))
    return vars(lazy)[name]


def _poses(keyframe_id: IdArray, stamp_ns: IntArray, rotation: FloatArray, position: FloatArray) -> Poses:
    return Poses(keyframe_id, stamp_ns, position, geometry.quaternion_from_matrix(rotation))


def _points(piece: Piece) -> Cloud:
    """Return the points among some rows of landmarks."""
    if piece.made is None:
        rows = piece["has_position"] & (piece["views"] >= _LEAST_VIEWS)
        piece.made = Cloud(*(piece[name][rows] for name in ("track_id", "position", "rms_px", "views")))
    made: Cloud = piece.made
    return made
