# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find where the clock that stamps keyframes was set while a recording went on.

A recording has two times of each keyframe: its stamp, and when it was written. With ``t`` and ``s`` these, and ``a``
the pace of the recording (1, or what it was played at when it was made), ``r = dt - a ds`` is how much longer a
keyframe took to arrive than the one before. A pause or a slow keyframe leaves nothing of it in the end; a clock that is
set leaves a step in the sum of r, at a keyframe that came when it was due.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.io.bag_reader import BagReader
from ba_node.measurements import Keyframe, Measurement

# Keyframes on either side whose medians are compared, and how many are needed.
_SIDE, _LEAST = 9, 5
# The smallest step that is told, s, and how many times the usual difference in delay it is.
_STEP_S, _USUAL = 0.1, 10.0
# Part of the step by which the keyframe may have come early or late, and which it has to take at once.
_ON_TIME, _AT_ONCE = 0.5, 0.5
_NS = 1e-9


def with_clock_watched(
    measurements: Iterable[tuple[str, int, Measurement]], reader: BagReader
) -> Iterator[tuple[str, int, Measurement]]:
    """Yield all measurements; then ``reader.warnings`` says where the clock was set."""
    seen: dict[tuple[int, int], tuple[int, int]] = {}
    for topic, time_ns, one in measurements:
        if isinstance(one, Keyframe):
            seen.setdefault((one.session_id, one.keyframe_id), (one.stamp_ns, time_ns))
        yield topic, time_ns, one
    words = []
    for session in dict.fromkeys(key[0] for key in seen):
        own = {key[1]: times for key, times in seen.items() if key[0] == session}
        stamp_ns, time_ns = np.array(list(own.values()), np.int64).T
        for at, step_s in clock_steps(_NS * (stamp_ns - stamp_ns[0]), _NS * (time_ns - time_ns[0])):
            where = "forward" if step_s > 0.0 else "back"
            words.append(f"{where} by {abs(step_s):.4g} s at keyframe {list(own)[at]} ({_NS * stamp_ns[at]:.3f} s)")
    if words:
        more = f", and {len(words) - 1} times more" if len(words) > 1 else ""
        reader.warnings["clock_step"] = (
            f"the stamps of the keyframes jump {words[0]}{more}, while the recording goes on: the clock was set; set it"
            " before the front-end starts, or restart that with a higher session_id"
        )


def clock_steps(stamp_s: FloatArray, time_s: FloatArray) -> list[tuple[int, float]]:
    """Return before which keyframes stamps (n,) step against the times of their arrival (n,), and by how much, s."""
    stamp, time = np.diff(stamp_s), np.diff(time_s)
    if len(stamp) < 2 * _LEAST or not (stamp > 0.0).any():
        return []
    pace = float(np.median(time[stamp > 0.0] / stamp[stamp > 0.0]))
    late = time - pace * stamp
    delay = np.append(0.0, np.cumsum(late))
    least = max(_STEP_S, _USUAL * float(np.median(np.abs(late))))
    found: list[tuple[int, float]] = []
    for k in range(_LEAST, len(delay) - _LEAST + 1):
        step = float(np.median(delay[k : k + _SIDE]) - np.median(delay[max(k - _SIDE, 0) : k]))
        is_step = abs(step) > least and late[k - 1] / step > _AT_ONCE
        if is_step and pace > 0.0 and abs(time[k - 1] - np.median(time)) < _ON_TIME * abs(step):
            found.append((k, -step / pace))
    return found
