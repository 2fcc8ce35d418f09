# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find where the clock that stamps keyframes was set while they went on coming.

A keyframe has two times: its stamp, and when it came (or was written into a recording). With ``t`` and ``s`` these, and
``a`` the pace at which they come (1, or what a recording was played at), ``r = dt - a ds`` is how much longer a
keyframe took to arrive than the one before. A pause or a slow keyframe leaves nothing of it in the end; a clock that is
set leaves a step in the sum of r, at a keyframe that came when it was due.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import accumulate, pairwise
from statistics import median

from ba_node.backend.backend import Backend
from ba_node.measurements import Keyframe, Measurement
from ba_node.scene.scene import Scene

# Keyframes on either side whose medians are compared, and how many are needed.
_SIDE, _LEAST = 9, 5
# The smallest step that is told, s, and how many times the usual difference in delay it is.
_STEP_S, _USUAL = 0.1, 10.0
# Part of the step by which the keyframe may have come early or late, and which it has to take at once.
_ON_TIME, _AT_ONCE = 0.5, 0.5
# The newest keyframes, among which it is looked for.
_KEPT = 40
_NS = 1e-9


class ClockWatch:
    """The newest keyframes of a map with the times at which they came, and where the clock was set among all."""

    def __init__(self) -> None:
        self._scene: Scene | None = None
        self._came: deque[tuple[int, int, float]] = deque(maxlen=_KEPT)
        self._steps: dict[int, str] = {}  # by the id of the keyframe, in words

    def came(self, backend: Backend, measurement: Measurement, time_s: float) -> None:
        """Take note of what comes, before the back-end has it; warn in its map where the clock was set.

        ``time_s`` is of a clock that nobody sets, s. What comes twice, or is of another session, tells nothing.
        """
        scene = backend.scene
        if scene is not self._scene:
            self._scene, self._steps = scene, {}
            self._came.clear()
        if not isinstance(measurement, Keyframe) or scene.session_id not in (None, measurement.session_id):
            return
        if scene.find_keyframe(measurement.keyframe_id) is not None:
            return
        self._came.append((measurement.keyframe_id, measurement.stamp_ns, time_s))
        ids, stamps, times = zip(*self._came, strict=True)
        for at, step_s in clock_steps([_NS * (one - stamps[0]) for one in stamps], [one - times[0] for one in times]):
            where = "forward" if step_s > 0.0 else "back"
            text = f"{where} by {abs(step_s):.4g} s at keyframe {ids[at]} ({_NS * stamps[at]:.3f} s)"
            self._steps.setdefault(ids[at], text)
        if self._steps:
            first, *others = self._steps.values()
            more = f", and {len(others)} times more" if others else ""
            scene.log.warn(
                "clock_step",
                f"the stamps of the keyframes jump {first}{more}, while they go on coming as before: the clock was set;"
                " set it before the front-end starts, or restart that with a higher session_id",
            )


def clock_steps(stamp_s: Iterable[float], time_s: Iterable[float]) -> list[tuple[int, float]]:
    """Return before which keyframes stamps step against the times of their arrival, and by how much, s."""
    # Of so few numbers, and for every keyframe: a dozen functions of numpy would take several times as long.
    stamp, time = ([after - before for before, after in pairwise(of)] for of in (stamp_s, time_s))
    paces = [dt / ds for ds, dt in zip(stamp, time, strict=True) if ds > 0.0]
    if len(stamp) < 2 * _LEAST or not paces:
        return []
    pace = median(paces)
    late = [dt - pace * ds for ds, dt in zip(stamp, time, strict=True)]
    size = [abs(one) for one in late]
    if max(size) <= _AT_ONCE * _STEP_S:  # none is a jump: nearly always
        return []
    delay = list(accumulate(late, initial=0.0))
    least, usual_s = max(_STEP_S, _USUAL * median(size)), median(time)
    found: list[tuple[int, float]] = []
    for k in range(_LEAST, len(delay) - _LEAST + 1):
        if size[k - 1] <= _AT_ONCE * least:
            continue
        step = median(delay[k : k + _SIDE]) - median(delay[max(k - _SIDE, 0) : k])
        is_step = abs(step) > least and late[k - 1] / step > _AT_ONCE
        if is_step and pace > 0.0 and abs(time[k - 1] - usual_s) < _ON_TIME * abs(step):
            found.append((k, -step / pace))
    return found
