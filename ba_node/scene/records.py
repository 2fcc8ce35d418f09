# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the columns of the scene's three tables: keyframes, landmarks, and who saw what."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ba_node.scene.tables import BoolArray, Column, FloatArray, IdArray, IntArray, Table

if TYPE_CHECKING:
    from collections.abc import Mapping

Float32Array = NDArray[np.float32]

_LONG_AGO = np.iinfo(np.int64).min


class Keyframes(Table):
    """One row a keyframe, in order of arrival.

    ``input_*`` is world from body as the front-end gave it, ``rotation`` and ``position`` as far as it is known now;
    ``refined`` tells that the latter took part in a solve and no longer follow the front-end; ``solved`` that a solve
    was made for it with all that matters (see ``Backend``).
    """

    COLUMNS: ClassVar[Mapping[str, Column]] = {
        "keyframe_id": Column(np.uint64),
        "stamp_ns": Column(np.int64),
        "input_rotation": Column(np.float64, (3, 3)),
        "input_position": Column(np.float64, (3,)),
        "rotation": Column(np.float64, (3, 3)),
        "position": Column(np.float64, (3,)),
        "refined": Column(np.bool_),
        "solved": Column(np.bool_),
    }
    keyframe_id: IdArray
    stamp_ns: NDArray[np.int64]
    input_rotation: FloatArray
    input_position: FloatArray
    rotation: FloatArray
    position: FloatArray
    refined: BoolArray
    solved: BoolArray


class Landmarks(Table):
    """One row a track. ``guess`` is as given, in the front-end's fixed frame; ``last`` the newest observation row."""

    COLUMNS: ClassVar[Mapping[str, Column]] = {
        "track_id": Column(np.uint64),
        "position": Column(np.float64, (3,), np.nan),
        "guess": Column(np.float64, (3,), np.nan),
        "has_position": Column(np.bool_),
        "has_guess": Column(np.bool_),
        "last": Column(np.intp, (), -1),
        "last_seen": Column(np.int64, (), _LONG_AGO),
        "views": Column(np.int32),
        "rms_px": Column(np.float32, (), np.nan),
    }
    track_id: IdArray
    position: FloatArray
    guess: FloatArray
    has_position: BoolArray
    has_guess: BoolArray
    last: IntArray
    last_seen: NDArray[np.int64]
    views: NDArray[np.int32]
    rms_px: Float32Array


class ObservationTable(Table):
    """One row an observation. Pixels are kept in float32, the precision of the messages."""

    COLUMNS: ClassVar[Mapping[str, Column]] = {
        "keyframe": Column(np.int32),
        "camera": Column(np.int32),
        "landmark": Column(np.int32),
        "previous": Column(np.intp, (), -1),
        "uv": Column(np.float32, (2,)),
        "sigma_px": Column(np.float32),
        "depth_m": Column(np.float32),
        "outlier": Column(np.bool_),
    }
    keyframe: NDArray[np.int32]
    camera: NDArray[np.int32]
    landmark: NDArray[np.int32]
    previous: IntArray
    uv: Float32Array
    sigma_px: Float32Array
    depth_m: Float32Array
    outlier: BoolArray


class Block(NamedTuple):
    """The rows [begin, end) of one tracks message in the table of observations."""

    camera: int
    begin: int
    end: int
