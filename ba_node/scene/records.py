# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the columns of the scene's three tables: keyframes, landmarks, and who saw what."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.scene.tables import Table, column

Float32Array = NDArray[np.float32]

_LONG_AGO = np.iinfo(np.int64).min


class Keyframes(Table):
    """One row a keyframe, in order of arrival.

    ``input_*`` is world from body as the front-end gave it, ``rotation`` and ``position`` as far as it is known now;
    ``refined`` tells that the latter took part in a solve and no longer follow the front-end; ``solved`` that a solve
    was made for it with all that matters (see ``Backend``).
    """

    COPIED = ("keyframe_id", "stamp_ns", "rotation", "position")

    keyframe_id: IdArray = column(np.uint64)
    stamp_ns: NDArray[np.int64] = column(np.int64)
    input_rotation: FloatArray = column(np.float64, (3, 3))
    input_position: FloatArray = column(np.float64, (3,))
    rotation: FloatArray = column(np.float64, (3, 3))
    position: FloatArray = column(np.float64, (3,))
    refined: BoolArray = column(np.bool_)
    solved: BoolArray = column(np.bool_)


class Landmarks(Table):
    """One row a track. ``guess`` is as given, in the front-end's fixed frame; ``last`` the newest observation row."""

    COPIED = ("track_id", "position", "has_position", "views", "rms_px")

    track_id: IdArray = column(np.uint64)
    position: FloatArray = column(np.float64, (3,), np.nan)
    guess: FloatArray = column(np.float64, (3,), np.nan)
    has_position: BoolArray = column(np.bool_)
    has_guess: BoolArray = column(np.bool_)
    last: IntArray = column(np.intp, (), -1)
    last_seen: NDArray[np.int64] = column(np.int64, (), _LONG_AGO)
    views: NDArray[np.int32] = column(np.int32)
    rms_px: Float32Array = column(np.float32, (), np.nan)


class ObservationTable(Table):
    """One row an observation. Pixels are kept in float32, the precision of the messages."""

    keyframe: NDArray[np.int32] = column(np.int32)
    camera: NDArray[np.int32] = column(np.int32)
    landmark: NDArray[np.int32] = column(np.int32)
    previous: IntArray = column(np.intp, (), -1)
    uv: Float32Array = column(np.float32, (2,))
    sigma_px: Float32Array = column(np.float32)
    depth_m: Float32Array = column(np.float32)
    outlier: BoolArray = column(np.bool_)


class Block(NamedTuple):
    """The rows [begin, end) of one tracks message in the table of observations."""

    camera: int
    begin: int
    end: int
