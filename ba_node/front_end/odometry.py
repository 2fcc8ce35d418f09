# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold an odometry against what images see by themselves, and name what is wrong with it.

Between two keyframes images tell the turn and the direction of the way without the odometry, with depths its length
too. What explains both for most steps is looked for among the mistakes that are made: stamps that are off, inverted
poses, another frame of the body, positions and orientations of two frames, another unit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IntArray
from ba_node.core import geometry
from ba_node.estimate import Transform
from ba_node.front_end.rectify import IdealRig

Say = Callable[[str, str], None]
# Steps between keyframes and poses that are kept, the fewest steps that tell anything, and that
# tell of a difference without a name.
_STEPS, _POSES, _FEWEST, _MANY = 100, 4000, 5, 8
# Features that have moved by so much beside the turn (median), px, tell the direction of the way.
_CLEAR_PX = 8.0
# An odometry that goes no farther while features move stands still, m; one that goes so far, or turns so much, rad,
# while no feature moves does not.
_STILL_M, _AWAY_M, _AWAY_RAD = 0.001, 1.0, 0.05
# Images in a row that tell so.
_STILL_IMAGES = 5
# What sound odometry and images differ by (median): turns, rad and as a share of the turn; directions, rad.
_TURN, _TURN_SHARE, _DIRECTION = 0.015, 0.15, 0.25
# Lengths that differ by more than this factor are not those of one unit. Nothing that carries cameras is so fast, m/s.
_LENGTH, _FAST = 1.25, 60.0
# Stamps are tried with these differences, s; one explains what is seen if no more than so much is left of the errors,
# which are no noise if they are more than this, and count as no more than that, rad.
_SHIFTS = np.round(np.arange(-1.0, 1.001, 0.02), 2)
_LEFT, _NOISE, _MOST, _LEAST_SHIFT_S = 0.5, 0.003, 0.1, 0.03
# x right, y down, z ahead of optical frames, from x ahead, y left, z up of bodies.
_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_NAMED_RAD = 0.26


@dataclass(frozen=True)
class Step:
    """The way from one keyframe to the next as images see it."""

    motion: Transform  # camera before from camera now; 1 long unless there are depths
    has_length: bool
    parallax_px: float  # by how much features moved beside the turn (median)


def step_of(rig: IdealRig, motion: Transform, before: FloatArray, now: FloatArray, *, has_length: bool) -> Step:
    """Return a step, of camera now from camera before and where features are in both images, (n, 2) px."""
    turned = rig.pixels(rig.rays(before) @ motion.rotation.T)
    moved = np.linalg.norm(now - turned, axis=1)
    parallax_px = float(np.nanmedian(moved)) if np.isfinite(moved).any() else 0.0
    return Step(motion.inverse(), has_length, parallax_px)


@dataclass(frozen=True)
class _Ways:
    """Steps, as rows: turns and ways of the camera in the axes of the one before."""

    turn: FloatArray  # (n, 3, 3) camera before from camera now
    way: FloatArray  # (n, 3) m, or 1 long
    clear: BoolArray  # (n,) True where the direction is told

    def errors(self, turn: FloatArray, way: FloatArray) -> tuple[float, float]:
        """Return the median differences of turns and of directions to those of an odometry, rad; 0 where unknown."""
        off = np.linalg.norm(geometry.so3_log(np.swapaxes(self.turn, 1, 2) @ turn), axis=1)
        far = self.clear & (np.linalg.norm(way, axis=1) > _STILL_M)
        a, b = _unit(self.way[far]), _unit(way[far])
        angle = np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))
        return float(np.median(off)), float(np.median(angle)) if len(angle) else 0.0


class OdometryWatch:
    """Takes the odometry of each image and the steps between keyframes; says what contradicts them."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._stamps: deque[int] = deque(maxlen=_POSES)
        self._poses: deque[Transform] = deque(maxlen=_POSES)
        self._keyframe: tuple[int, Transform] | None = None
        self._steps: deque[tuple[int, int, Step]] = deque(maxlen=_STEPS)
        self._count, self._next, self._standing = 0, _FEWEST, 0
        self._is_named = False  # what is wrong with its ways was said

    def image(self, stamp_ns: int, odometry: Transform, *, stands: bool) -> None:
        """Take the odometry of an image; it ``stands`` if no feature has moved since the last keyframe."""
        if self._stamps and stamp_ns <= self._stamps[-1]:
            self._stamps.clear()
            self._poses.clear()
        self._stamps.append(stamp_ns)
        self._poses.append(odometry)
        self._standing = self._standing + 1 if stands and self._keyframe is not None else 0
        if self._standing < _STILL_IMAGES or self._keyframe is None:
            return
        moved = self._keyframe[1].inverse().after(odometry)
        far, turn = float(np.linalg.norm(moved.translation)), _angle(moved.rotation)
        if far > _AWAY_M or turn > _AWAY_RAD:
            words = (
                f"images stand still while the odometry went {far:.2f} m and turned by {np.degrees(turn):.1f} degrees"
            )
            self._say("odometry_moves", f"{words}: check that both are of one time and one robot")
            self._is_named = True

    def keyframe(self, stamp_ns: int, odometry: Transform, step: Step | None, body: Transform) -> None:
        """Take a keyframe and the step to it from the one before; ``body`` is body from camera."""
        before, self._keyframe = self._keyframe, (stamp_ns, odometry)
        if before is None or step is None or stamp_ns <= before[0]:
            return
        self._steps.append((before[0], stamp_ns, step))
        self._count += 1
        if self._count >= self._next:
            self._next = 1 + self._count * 3 // 2
            self._examine(body)

    def forget(self) -> None:
        """Begin another session: no step leads there."""
        self._keyframe, self._standing = None, 0

    def _examine(self, body: Transform) -> None:
        """Say what is wrong by all steps that are kept."""
        at = np.array([entry[:2] for entry in self._steps], dtype=np.int64)
        steps = [entry[2] for entry in self._steps]
        motions = [step.motion for step in steps]
        clear = np.array([step.parallax_px >= _CLEAR_PX for step in steps])
        ways = _Ways(np.array([m.rotation for m in motions]), np.array([m.translation for m in motions]), clear)
        poses = _Poses(np.array(self._stamps), list(self._poses), body)
        turn, way = poses.steps(at)
        length = np.linalg.norm(way, axis=1)
        if clear.sum() >= _FEWEST and np.median(length[clear]) < _STILL_M:
            words = f"the odometry stands still while images move, in {int(clear.sum())} steps between keyframes"
            self._say("odometry_still", f"{words}: check its topic, and whether its wheels are driven")
            return
        self._compare_lengths(ways, length, at, all(step.has_length for step in steps))
        cause, words = self._difference(ways, poses, at, (turn, way))
        if cause and not self._is_named:
            self._is_named = True
            self._say(cause, words)

    def _compare_lengths(self, ways: _Ways, length: FloatArray, at: IntArray, measured: bool) -> None:
        if measured and ways.clear.sum() >= _FEWEST:
            seen = np.linalg.norm(ways.way[ways.clear], axis=1)
            factor = float(np.median(length[ways.clear] / np.maximum(seen, 1e-9)))
            if not 1.0 / _LENGTH < factor < _LENGTH:
                why = "are they millimetres?" if 700.0 < factor < 1400.0 else "check its unit, and the rig's baseline"
                words = f"the odometry's steps are {factor:.3g} times as long as those that images see"
                self._say("odometry_unit", f"{words} ({len(seen)} steps): {why}")
            return
        speed = float(np.median(length / (1e-9 * (at[:, 1] - at[:, 0]))))
        if speed > _FAST:
            words = f"the odometry moves at {speed:.0f} m/s (median of {len(length)} steps)"
            self._say("odometry_unit", f"{words}: its lengths, and the map's, must be metres; are they millimetres?")

    def _difference(
        self, ways: _Ways, poses: _Poses, at: IntArray, given: tuple[FloatArray, FloatArray]
    ) -> tuple[str, str]:
        """Return what explains turns and ways better than the odometry as it is, and words; empty if it is sound."""
        limit = _TURN + _TURN_SHARE * float(np.median(_angles(ways.turn))), _DIRECTION
        errors = ways.errors(*given)
        sound = _fits(errors, limit)
        words = (
            f"odometry and images differ by {np.degrees(errors[0]):.1f} degrees in turns and"
            f" {np.degrees(errors[1]):.0f} in directions (median of {len(at)} steps)"
        )
        for cause, explained, why in [] if sound else _explanations(ways, poses, at, given):
            if _fits(explained, limit):
                return cause, f"{words}: {why}"
        shift_s = _shift(ways, poses, at)
        if shift_s:
            late = "later" if shift_s > 0.0 else "earlier"
            words = f"the odometry's stamps seem to be {abs(shift_s):.2f} s {late} than those of the images"
            return "odometry_stamps", f"{words} ({len(at)} steps): set the clocks right, or correct the stamps"
        if sound or len(at) < _MANY:
            return "", ""
        return "odometry_differs", f"{words}: check its frames (child_frame_id, /tf_static, --base), stamps and rate"


@dataclass(frozen=True)
class _Poses:
    """Poses of the odometry by time."""

    stamps: IntArray  # (n,) ns, rising
    poses: list[Transform]  # fixed frame from body
    body: Transform  # from camera

    def at(self, stamps: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return rotations and positions of the body at times within those of the poses."""
        begin = self.stamps[0]
        times, wanted = 1e-9 * (self.stamps - begin), 1e-9 * (stamps - begin)
        i = np.clip(np.searchsorted(times, wanted) - 1, 0, max(len(times) - 2, 0))
        j = np.minimum(i + 1, len(times) - 1)
        share = np.clip((wanted - times[i]) / np.maximum(times[j] - times[i], 1e-9), 0.0, 1.0)[:, None]
        R = np.array([pose.rotation for pose in self.poses])
        t = np.array([pose.translation for pose in self.poses])
        between = geometry.so3_log(np.swapaxes(R[i], 1, 2) @ R[j])
        return R[i] @ geometry.so3_exp(share * between), t[i] + share * (t[j] - t[i])

    def steps(self, at: IntArray, shift_ns: int = 0, *, inverted: bool = False) -> tuple[FloatArray, FloatArray]:
        """Return turns and ways of the camera between pairs of times (n, 2), ns."""
        R, t = self.at((at + shift_ns).reshape(-1))
        if inverted:
            R, t = geometry.inverse(R, t)
        R, t = geometry.compose(R, t, self.body.rotation[None], self.body.translation[None])
        before, after = (R[0::2], t[0::2]), (R[1::2], t[1::2])
        back = np.swapaxes(before[0], 1, 2)
        return back @ after[0], np.einsum("nij,nj->ni", back, after[1] - before[1])

    def axes(self, at: IntArray) -> FloatArray:
        """Return fixed frame from camera at the beginning of each step, rotations (n, 3, 3)."""
        return self.at(at[:, 0])[0] @ self.body.rotation


def _shift(ways: _Ways, poses: _Poses, at: IntArray) -> float:
    """Return by how much the odometry's stamps are later than the images', s; 0 where nothing says so."""
    given = np.minimum(_angles(np.swapaxes(ways.turn, 1, 2) @ poses.steps(at)[0]), _MOST)
    best, left = 0.0, _LEFT
    for shift_s in _SHIFTS:
        by_ns = round(1e9 * float(shift_s))
        there = (at[:, 0] + by_ns >= poses.stamps[0]) & (at[:, 1] + by_ns <= poses.stamps[-1])
        if there.sum() < max(_FEWEST - 1, 0.6 * len(at)) or given[there].mean() < _NOISE:
            continue
        turn, _ = poses.steps(at[there], by_ns)
        off = np.minimum(_angles(np.swapaxes(ways.turn[there], 1, 2) @ turn), _MOST).mean() / given[there].mean()
        if off < left:
            best, left = float(shift_s), float(off)
    return best if abs(best) >= _LEAST_SHIFT_S else 0.0


def _explanations(
    ways: _Ways, poses: _Poses, at: IntArray, given: tuple[FloatArray, FloatArray]
) -> list[tuple[str, tuple[float, float], str]]:
    """Return causes, what they leave of the errors of turns and directions, and words."""
    turn, way = given
    seen_turn, odometry_turn = geometry.so3_log(ways.turn), geometry.so3_log(turn)
    far = ways.clear & (np.linalg.norm(way, axis=1) > _STILL_M)
    a, b = _unit(ways.way[far]), _unit(way[far])
    scale = max(float(np.linalg.norm(seen_turn, axis=1).mean()), 1e-3)
    between = _rotation(np.concatenate([a, seen_turn / scale]), np.concatenate([b, odometry_turn / scale]))
    body = poses.body.rotation
    own = body @ between @ body.T  # in the axes of the body
    angle, axis = _angle(own), geometry.so3_log(own[None])[0]
    named = any(_angle(own.T @ one) < _NAMED_RAD for one in (_OPTICAL, _OPTICAL.T))
    what = (
        "optical axes (z ahead) seem to be taken for those of a body (x ahead), or the reverse"
        if named
        else f"its body frame seems to be turned by {np.degrees(angle):.0f} degrees about"
        f" ({', '.join(f'{v:.1f}' for v in axis / max(float(np.linalg.norm(axis)), 1e-9))}) against the rig's"
    )
    turned = between @ turn @ between.T, way @ between.T
    axes = poses.axes(at)
    in_world = [np.einsum("nij,nj->ni", axes[far], unit) for unit in (a, b)]
    world = _rotation(*in_world)
    moved = np.einsum("nji,nj->ni", axes, np.einsum("nij,nj->ni", axes, way) @ world.T)
    inverted = "its poses seem to be inverted, body from fixed frame; give fixed frame from body"
    frames = (
        f"its positions seem to be of a frame that is turned by {np.degrees(_angle(world)):.0f} degrees against that"
        " of its orientations (ENU and NED?)"
    )
    axes_words = f"{what}; check child_frame_id, /tf_static and --base"
    return [
        ("odometry_inverted", ways.errors(*poses.steps(at, inverted=True)), inverted),
        ("odometry_frames", ways.errors(turn, moved), frames),
        ("odometry_axes", ways.errors(*turned), axes_words),
    ]


def _rotation(to: FloatArray, of: FloatArray) -> FloatArray:
    """Return the rotation that takes vectors (n, 3) to others best."""
    if not len(to):
        return np.eye(3)
    return np.asarray(geometry.nearest_rotation((to.T @ of)[None])[0])


def _fits(errors: tuple[float, float], limit: tuple[float, float]) -> bool:
    return errors[0] <= limit[0] and errors[1] <= limit[1]


def _angle(rotation: FloatArray) -> float:
    return float(_angles(rotation[None])[0])


def _angles(rotation: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(geometry.so3_log(rotation), axis=1))


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
