# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put together what belongs to one time: images of several topics, and the odometry at it. Live and offline alike."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.images import depth_of, grey_of
from ba_node.front_end.records import Images

# Images of each mode, the leading one first, by the ends of their topics' names; camera_info lies beside each.
MODES = {
    "stereo": ("left/image_raw", "right/image_raw"),
    "rgbd": ("rgb/image_raw", "depth/image_raw"),
    "mono": ("image_raw",),
}
MASK = "mask"
# Part of the names of topics of rectified images (image_proc, stereo_image_proc, depth cameras).
RECTIFIED = "image_rect"
# Images further apart are never of one time, ns; what is nearer but not near enough, the front-end says.
MAX_APART_NS = 50_000_000
# Share of the first camera's period within which an image of another is near one of it.
NEAR = 0.75
# A pose so near is that of a time; stamps are rounded in files. Between poses further apart nothing is known.
_SAME_NS, _GAP_NS = 100_000, 1_000_000_000
# Poses between others so far apart miss what a vehicle does there.
_SPARSE_NS = 300_000_000


class Frame(NamedTuple):
    """Images of one time, by stream."""

    stamp_ns: int  # of the first stream
    messages: dict[str, Any]
    skew_ns: int  # stamp of the second stream less that of the first


def cameras_of(mode: str) -> tuple[str, ...]:
    """Return the images of a mode that have a camera in the rig."""
    return tuple(name for name in MODES[mode] if not name.startswith("depth"))


def images_of(frame: Frame, mode: str) -> Images:
    """Return what a frame shows; depth and mask belong to its first image.

    Raises:
        FrontEndError: an image cannot be read.
    """
    grey = tuple(grey_of(frame.messages[name]) for name in cameras_of(mode))
    depth = depth_of(frame.messages[MODES[mode][1]]) if mode == "rgbd" else None
    mask = grey_of(frame.messages[MASK]) > 0 if MASK in frame.messages else None
    return Images(frame.stamp_ns, grey, depth, frame.skew_ns, mask)


class Streams:
    """Pairs images of several topics by the nearest stamp, in the order of the first.

    An image of the first topic is decided on once each of the others has an image of that time or later. Without one
    it is left out and counted, unless the other is optional, which is waited for as long as ``patience`` images. An
    image of another topic is counted where the first misses one.

    Args:
        names: of the streams, the leading one first.
        optional: of those, which an image may come without.
        depth: images that may wait on a stream.
        patience: images that may wait for an optional stream.
    """

    def __init__(self, names: tuple[str, ...], optional: frozenset[str], depth: int, patience: int = 3) -> None:
        self.counted: Counter[str] = Counter()  # images left out, by reason
        # By how much the nearest image of a stream was off when one was left out; 0 where there was none.
        self.apart_ns: dict[str, int] = {}
        self._first, *self._others = names
        self._optional, self._patience = optional, patience
        self._last_ns, self._gaps_ns = 0, deque[int](maxlen=2)  # the last stamp of the first, and between those before
        self._waiting: dict[str, deque[tuple[int, Any]]] = {name: deque(maxlen=depth) for name in names}

    def put(self, name: str, stamp_ns: int, message: Any) -> list[Frame]:
        """Take an image; return what is complete now."""
        queue = self._waiting[name]
        if len(queue) == queue.maxlen:
            self.counted[f"overflow of {name}"] += 1
        queue.append((stamp_ns, message))
        return self._complete(self._is_decided)

    def flush(self) -> list[Frame]:
        """Return what is complete when nothing comes any more."""
        return self._complete(lambda _: True)

    def _complete(self, decided: Callable[[int], bool]) -> list[Frame]:
        leading, frames = self._waiting[self._first], []
        while leading and decided(leading[0][0]):
            frame = self._frame(*leading.popleft())
            frames += [] if frame is None else [frame]
        return frames

    def _is_decided(self, stamp_ns: int) -> bool:
        """Return True if no later image can be nearer to this time."""
        for name in self._others:
            queue = self._waiting[name]
            late = bool(queue) and queue[-1][0] >= stamp_ns
            impatient = name in self._optional and len(self._waiting[self._first]) > self._patience
            full = len(self._waiting[self._first]) == self._waiting[self._first].maxlen
            if not (late or impatient or full):
                return False
        return True

    def _frame(self, stamp_ns: int, leading: Any) -> Frame | None:
        self._count_alone(stamp_ns)
        messages, skew_ns = {self._first: leading}, 0
        for place, name in enumerate(self._others):
            queue = self._waiting[name]
            nearest = min(queue, key=lambda entry: abs(entry[0] - stamp_ns), default=None)
            apart_ns = MAX_APART_NS + 1 if nearest is None else nearest[0] - stamp_ns
            if abs(apart_ns) > MAX_APART_NS:
                self.counted[f"no {name}"] += 1
                self.apart_ns[name] = 0 if nearest is None else apart_ns
                if name not in self._optional:
                    return None
                continue
            while queue and queue[0][0] < stamp_ns + apart_ns:
                queue.popleft()  # those before it can be nearest to nothing that comes
            messages[name] = nearest[1] if nearest else None
            skew_ns = apart_ns if place == 0 and name not in self._optional else skew_ns
        return Frame(stamp_ns, messages, skew_ns)

    def _count_alone(self, stamp_ns: int) -> None:
        """Count images of the others since the last of the first that are too far from that and from this one."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        for name in self._others if self._gaps_ns else ():
            near_ns = NEAR * min(self._gaps_ns)
            alone = sum(last_ns + near_ns < at_ns < stamp_ns - near_ns for at_ns, _ in self._waiting[name])
            if alone and name not in self._optional:
                self.counted[f"{name} alone"] += alone
        if last_ns and stamp_ns > last_ns:
            self._gaps_ns.append(stamp_ns - last_ns)


class OdometryBuffer:
    """Poses of the body by time; the newest ``keep`` of them at least half."""

    def __init__(self, keep: int = 2000) -> None:
        self._keep = keep
        self._widest_ns = 0  # between poses of which one between was asked for
        self.span_ns: tuple[int, int] | None = None  # first and last stamp of all that came
        self._stamps: list[int] = []
        self._poses: list[Transform] = []

    def add(self, stamp_ns: int, pose: Transform) -> None:
        """Take in a pose, fixed frame from body; one that is older than the last is passed over."""
        first, last = self.span_ns or (stamp_ns, stamp_ns)
        self.span_ns = min(first, stamp_ns), max(last, stamp_ns)
        if self._stamps and stamp_ns <= self._stamps[-1]:
            if stamp_ns < self._stamps[-1] - 10**9:  # time has gone back
                self._stamps.clear()
                self._poses.clear()
            else:
                return
        self._stamps.append(stamp_ns)
        self._poses.append(pose)
        if len(self._stamps) > self._keep:
            del self._stamps[: self._keep // 2], self._poses[: self._keep // 2]

    @property
    def sparse(self) -> str:
        """Return in words that poses were too far apart for those between that were asked for; empty if not."""
        if self._widest_ns <= _SPARSE_NS:
            return ""
        apart = f"the odometry's poses are up to {self._widest_ns / 1e9:.2f} s apart"
        return f"{apart}: images between have them on a straight way at even speed; give it at 10 Hz or more"

    def covers(self, stamp_ns: int) -> bool:
        """Return True if no later pose is needed to tell the one at a time."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def at(self, stamp_ns: int) -> Transform | None:
        """Return the pose at a time, between its neighbours on a straight way at even speed; None outside."""
        i = bisect_left(self._stamps, stamp_ns)
        for near in (i, i - 1):
            if 0 <= near < len(self._stamps) and abs(self._stamps[near] - stamp_ns) <= _SAME_NS:
                return self._poses[near]
        if i in (0, len(self._stamps)) or self._stamps[i] - self._stamps[i - 1] > _GAP_NS:
            return None
        self._widest_ns = max(self._widest_ns, self._stamps[i] - self._stamps[i - 1])
        before, after = self._poses[i - 1], self._poses[i]
        share = (stamp_ns - self._stamps[i - 1]) / (self._stamps[i] - self._stamps[i - 1])
        turn = geometry.so3_log((before.rotation.T @ after.rotation)[None])[0]
        rotation = before.rotation @ geometry.so3_exp((share * turn)[None])[0]
        return Transform(rotation, (1.0 - share) * before.translation + share * after.translation)


def transform_of(position: Any, orientation: Any) -> Transform:
    """Return a pose or transform of a message."""
    quaternion = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    return Transform(geometry.matrix_from_quaternion(quaternion), np.array([position.x, position.y, position.z]))
