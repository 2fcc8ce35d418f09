# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep the correction map -> odom: what a solve found, gated and smoothed (REP-105).

The front-end's pose of a keyframe in its own fixed frame is ``odom_from_body``; the refined one is ``map_from_body``.
The correction is what leads from one to the other at the newest keyframe::

    map_from_odom = map_from_body * inverse(odom_from_body)

Its size is measured where the body is, not at the origin of odom, from which a small turn is a long way: how far the
solve moves and turns the newest keyframe against where the correction before would have put it.

A correction beyond the gate, as a loop closure or a wrong solve makes it, is held back until as many solves in a row
agree with it (within the gate, at their own newest keyframe). Smoothing moves and turns the published body by a share
``1 - exp(-dt / time constant)`` of what is left, dt between the stamps of the newest keyframes: no clock is read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.config import FramesConfig
from ba_node.core import geometry
from ba_node.estimate import Transform

_S = 1e-9


@dataclass(frozen=True)
class Move:
    """How far a solve moves the correction at the newest keyframe (m, rad), and whether that is held back."""

    distance_m: float = 0.0
    angle_rad: float = 0.0
    held: bool = False

    def statistics(self) -> dict[str, Any]:
        """Return it by the names of a report."""
        return {"correction_m": self.distance_m, "correction_rad": self.angle_rad, "correction_held": self.held}


class MapCorrection:
    """The correction of one session."""

    def __init__(self, transforms: tuple[Transform, ...] = (), agreeing: int = 0, stamp_ns: int = 0) -> None:
        """Start without one, or with what :meth:`state` gave."""
        # map from odom, gated and smoothed; None before the first update
        self.published: Transform | None = transforms[0] if transforms else None
        self._target: Transform | None = transforms[1] if transforms else None
        self._candidate: Transform | None = transforms[2] if len(transforms) > 2 else None
        self._agreeing = agreeing
        self._stamp_ns = stamp_ns

    def state(self) -> tuple[tuple[Transform, ...], int, int]:
        """Return all that is known: transforms, how many solves agree, the newest stamp (ns)."""
        known = (self.published, self._target, self._candidate)
        return tuple(one for one in known if one is not None), self._agreeing, self._stamp_ns

    def update(self, config: FramesConfig, found: Transform, body: Transform, stamp_ns: int) -> Move:
        """Take in the correction found at the newest keyframe, and the front-end's pose of it, odom from body."""
        if self._target is None or self.published is None:
            self._target = self.published = found
            self._stamp_ns = stamp_ns
            return Move()
        distance, angle = _apart(self._target.after(body), found.after(body))
        if _beyond(config, distance, angle) and not self._confirmed(config, found, body):
            return Move(distance, angle, held=True)
        self._target, self._candidate = found, None
        self.published = self._smoothed(config.smoothing_s, body, stamp_ns)
        self._stamp_ns = max(stamp_ns, self._stamp_ns)
        return Move(distance, angle)

    def _confirmed(self, config: FramesConfig, found: Transform, body: Transform) -> bool:
        agrees = self._candidate is not None and not _beyond(
            config, *_apart(self._candidate.after(body), found.after(body))
        )
        self._agreeing = self._agreeing + 1 if agrees else 0
        self._candidate = found
        return self._agreeing >= config.gate_confirmations

    def _smoothed(self, time_constant_s: float, body: Transform, stamp_ns: int) -> Transform:
        assert self.published is not None and self._target is not None
        if time_constant_s <= 0.0:
            return self._target
        share = -np.expm1(-max(stamp_ns - self._stamp_ns, 0) * _S / time_constant_s)
        now, wanted = self.published.after(body), self._target.after(body)
        turn = geometry.so3_log(now.rotation.T @ wanted.rotation)
        rotation = geometry.nearest_rotation(now.rotation @ geometry.so3_exp(share * turn))
        moved = Transform(rotation, now.translation + share * (wanted.translation - now.translation))
        return moved.after(body.inverse())


def _apart(a: Transform, b: Transform) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    *axis, cosine = geometry.quaternion_from_matrix(a.rotation.T @ b.rotation).tolist()
    return math.dist(a.translation, b.translation), 2.0 * math.atan2(math.hypot(*axis), cosine)


def _beyond(config: FramesConfig, distance_m: float, angle_rad: float) -> bool:
    return 0.0 < config.gate_m < distance_m or 0.0 < config.gate_rad < angle_rad
