# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn the messages of a source into keyframes, tracks, guesses and a rig: the same core live and for recordings.

Poses and features are paired by their stamps, the nearest within a tolerance. Where a source sends every image, one is
taken as a keyframe when

- the median over the tracks shared with the last keyframe of the angle between the two rays to their point is
  ``parallax_deg`` or more (without points, of the angle that they have moved in the image), or
- the share of tracks that the last keyframe did not have is ``new_share`` or more, or
- the source says so itself.

All that is left out is counted in ``counted`` by reason, and told in ``notes``.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.core import cameras, geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages.adapters.misread import misread
from ba_node.messages.adapters.sources import Extrinsic, Features, LayoutError, Pose, Source, mismatch

# Images that wait for their pose or for the rig, and poses that wait for their image.
MAX_WAITING = 200
_NO_RIG = "nothing tells the cameras: give them with --rig FILE"
# Tracks and keyframes that are remembered; a guess that is sent twice does no harm.
_MAX_KNOWN = 200_000
# A pose so much older than the newest is of another session, ns.
_BACK_NS = 1_000_000_000
# How far a calibration may move before it is said: focal length and principal point by fx; m; rad.
_MOVED = (0.005, 0.01, 0.01)
# Points of known ids that lie in other directions (median) are other points, rad.
_ELSEWHERE = 0.17
# Pixels that a camera_info of the source's own camera leaves between its points and its pixels, median, px.
_MAX_DISAGREEMENT_PX = 2.0
# Fewest points that tell a focal length, and the one that is taken where they do not, px.
_FIT_POINTS, _FOCAL_PX = 8, 460.0


@dataclass(frozen=True)
class AdapterOptions:
    """What a user may say."""

    tolerance_s: float = 1e-3  # stamps of a pose and its features differ by no more than this, s
    parallax_deg: float = 1.0  # from the last keyframe to the next, deg
    new_share: float = 0.4  # of an image's tracks, which make it a keyframe
    rig: CameraRig | None = None  # the cameras, instead of what the source says of them


@dataclass
class _Last:
    """The keyframe before."""

    ids: FloatArray
    at: FloatArray  # (3,) body, m
    features: Features


class Adapter:
    """Converts one stream. Feed it with :meth:`take`, and publish or record what it yields."""

    def __init__(self, source: Source, options: AdapterOptions) -> None:
        self.sent = 0  # keyframes that were sent on
        self.images = 0  # images that came with features
        self.counted: Counter[str] = Counter()  # what was left out, by reason
        self.notes: dict[str, str] = {}  # the newest words on each reason
        self.rig = options.rig
        self._source, self._options = source, options
        self._session, self._source_session = 0, 0
        self._extrinsic: Extrinsic | None = None
        self._lens: CameraRig | None = None
        self._fixed = options.rig is not None  # what the source says of its cameras does not matter
        self._from_rays = False  # pixels are made from normalised points, as no lens is known
        self._rig_sent: CameraRig | None = None
        self._poses: dict[int, Pose] = {}
        self._features: dict[int, Features] = {}
        self._frames: list[tuple[Pose, Features]] = []  # wait for the rig
        self._newest_ns: int | None = None
        self._last: _Last | None = None
        self._points: dict[int, FloatArray] = {}  # where each track was last
        self._keys: set[int] = set()

    @property
    def waits_for_rig(self) -> bool:
        """Return True while images are held back because no cameras are known."""
        return bool(self._frames)

    def take(self, name: str, message: Any) -> Iterator[tuple[str, int, Measurement]]:
        """Take a message of an input; yield topic, stamp (ns) and measurement of what is to be sent on.

        Whatever the message holds, what cannot be used is counted.
        """
        try:
            for piece in self._source.read(name, message):
                if isinstance(piece, Pose | Extrinsic) and not _is_pose(piece):
                    kind = "pose" if isinstance(piece, Pose) else "extrinsic"
                    words = f"position {piece.position} m, quaternion {piece.orientation}"
                    self.leave(f"bad_{kind}", f"{name}: {words}: expected finite, and not zero")
                elif isinstance(piece, Pose):
                    yield from self._pair(piece, self._poses, self._features, "no_features")
                elif isinstance(piece, Features):
                    self.images += 1
                    yield from self._pair(piece, self._features, self._poses, "no_pose")
                else:
                    yield from self._learn(piece)
        except LayoutError as error:
            self.leave(error.reason, f"{name}: {error}")
        except (AttributeError, IndexError, TypeError, ValueError) as error:
            self.leave("malformed", f"{name}: {error}")

    def calibrate(self, rig: CameraRig) -> None:
        """Take a rig for what the source says of its cameras, now and later."""
        self.rig, self._fixed = rig, True
        self._extrinsic = Extrinsic(rig.frame_id, rig.position[0], rig.orientation[0])

    def summary(self) -> str:
        """Return in words what came of the images so far."""
        sessions = f"{self._session + 1} session{'s' if self._session else ''}"
        return f"{self.sent} keyframes of {self.images} images in {sessions}"

    def told(self) -> list[str]:
        """Return a line for each reason why something was left out, with its count and the newest case."""
        return [
            f"{reason} = {self.counted[reason]} ({words})" if reason in self.counted else words
            for reason, words in sorted(self.notes.items())
        ]

    def restart(self) -> None:
        """Begin a new session: ids begin anew."""
        self._session += self.sent > 0
        for waiting in (self._poses, self._features, self._frames, self._points, self._keys):
            waiting.clear()
        self._last, self._newest_ns = None, None

    def finish(self) -> None:
        """Count what still waits when no more messages come."""
        for reason, own, others in (
            ("no_features", self._poses, self._features),
            ("no_pose", self._features, self._poses),
        ):
            if own:
                apart_ns = [min((abs(stamp - other) for other in others), default=-1) for stamp in own]
                self.leave(reason, self._gap(int(np.median(apart_ns))), len(own))
        if self._frames:
            self.leave("no_rig", _NO_RIG, len(self._frames))

    def leave(self, reason: str, words: str, count: int = 1) -> None:
        """Count what is left out."""
        self.counted[reason] += count
        self.notes[reason] = words

    def _learn(self, piece: Extrinsic | CameraRig) -> Iterator[tuple[str, int, Measurement]]:
        """Take in what the source says of its cameras; once both lens and place are known, there is a rig."""
        if self._fixed:
            return
        if isinstance(piece, Extrinsic):
            self._extrinsic = piece
            if self.rig is None and self._frames:
                self._invent_lens(self._frames[-1][1])
        elif piece.malformed:
            self.leave("bad_camera", piece.malformed)
            return
        elif any(one.role == "extrinsic" for one in self._source.inputs):
            self._lens = None if self._from_rays else piece
        else:
            self.rig = piece
        if self._extrinsic is not None and self._lens is not None:
            at = self._extrinsic
            place = at.position[None], at.orientation[None]
            self.rig = dataclasses.replace(self._lens, frame_id=at.frame_id, position=place[0], orientation=place[1])
        if self.rig is not None and self._rig_sent is not None and _moved(self._rig_sent, self.rig):
            words = "the calibration of the source has moved since it was sent: give a rig, or convert a recording"
            self.leave("calibration_moved", words)
        frames, self._frames = (self._frames, []) if self.rig is not None else ([], self._frames)
        for frame in frames:
            yield from self._frame(*frame)

    def _pair(self, piece: Any, own: dict[int, Any], others: dict[int, Any], reason: str) -> Iterator[Any]:
        """Pair a pose with features, or the other way round, or have it wait."""
        limit_ns = self._options.tolerance_s * 1e9
        nearest = min(others, key=lambda stamp_ns: abs(stamp_ns - piece.stamp_ns), default=None)
        if nearest is not None and abs(nearest - piece.stamp_ns) <= limit_ns:
            other = others.pop(nearest)
            pose, features = (piece, other) if isinstance(piece, Pose) else (other, piece)
            yield from self._frame(pose, features)
            return
        own[piece.stamp_ns] = piece
        if len(own) > MAX_WAITING:
            del own[next(iter(own))]
            self.leave(reason, self._gap(-1 if nearest is None else abs(nearest - piece.stamp_ns)))

    def _gap(self, apart_ns: int) -> str:
        """Return in words how far the nearest stamp is off; less than 0 for none."""
        gap = "none came" if apart_ns < 0 else f"the nearest is {apart_ns / 1e6:.3f} ms off"
        return f"{gap}; taken are up to {self._options.tolerance_s * 1e3:g} ms (--tolerance)"

    def _frame(self, pose: Pose, features: Features) -> Iterator[tuple[str, int, Measurement]]:
        """Send on an image with its pose, if it is a keyframe."""
        back = self._newest_ns is not None and pose.stamp_ns < self._newest_ns - _BACK_NS
        if back or pose.session != self._source_session:
            self._source_session = pose.session
            self.restart()
        self._newest_ns = max(pose.stamp_ns, self._newest_ns or pose.stamp_ns)
        key = pose.stamp_ns if pose.key is None else pose.key
        if key in self._keys:
            self.leave("repeated_keyframe", f"keyframe {key} came again")
            return
        features = self._usable(features)
        if wrong := mismatch(features):
            self.leave("not_pixels", wrong)
            return
        if not len(features.ids):
            self.leave("no_tracks", "an image without a track that can be used")
            return
        if self._rig_sent is None:
            self._invent_lens(features)
        if self.rig is None:
            self._frames.append((pose, features))
            if len(self._frames) > MAX_WAITING:
                del self._frames[0]
                self.leave("no_rig", _NO_RIG)
            return
        if wrong := misread(pose, features, self.rig):
            self.leave("misread", wrong)
            return
        if self._is_anew(pose, features):
            self.notes["begun_anew"] = f"track ids are those of other points from {pose.stamp_ns} ns on: a new session"
            self.restart()
        if not self._is_keyframe(pose, features):
            return
        yield from self._send(key, pose, features)

    def _usable(self, features: Features) -> Features:
        """Return the rows that can be used; the others are counted, each by its first reason."""
        ids = features.ids
        inexact = ~((ids >= 0) & (ids < self._source.max_id) & (ids % 1 == 0))
        cameras = len(self.rig) if self.rig is not None else self._source.cameras
        reasons = {
            **features.wrong,
            "inexact_id": inexact,
            "not_finite": ~np.isfinite(features.uv).all(axis=1),
            "unknown_camera": (features.camera < 0) | (features.camera >= cameras),
        }
        good = np.ones(len(ids), bool)
        for reason, wrong in reasons.items():
            if (good & wrong).any():
                self.leave(
                    reason, f"{np.count_nonzero(good & wrong)} of {len(ids)}", int(np.count_nonzero(good & wrong))
                )
            good &= ~wrong
        names = ("ids", "uv", "camera", "normalised", "point")
        return dataclasses.replace(features, wrong={}, **{name: getattr(features, name)[good] for name in names})

    def _invent_lens(self, features: Features) -> None:
        """Make a camera without distortion for the source's normalised points, where its lens is not known."""
        if self._extrinsic is None or self._options.rig is not None or self._from_rays:
            return
        if not np.isfinite(features.normalised).all():
            return
        why = "no camera_info"
        if self.rig is not None:
            error_px = _disagreement_px(self.rig, features)
            if error_px <= _MAX_DISAGREEMENT_PX:
                return
            why = f"camera_info is of another camera, its pixels are {error_px:.1f} px (median) off"
        fits = []
        for rays, pixels in zip(features.normalised.T, features.uv.T, strict=True):
            enough = len(rays) >= _FIT_POINTS and np.ptp(rays) > 0.1
            fits.append(np.polyfit(rays, pixels, 1) if enough else (_FOCAL_PX, 0.0))
        (fx, cx), (fy, cy) = fits if min(fits[0][0], fits[1][0]) > 1.0 else ((_FOCAL_PX, 0.0), (_FOCAL_PX, 0.0))
        one = np.array([[fx, fy, cx, cy]])
        size = np.zeros((1, 2), np.int64)
        place = self._extrinsic.position[None], self._extrinsic.orientation[None]
        self.rig = CameraRig(self._extrinsic.frame_id, ("camera0",), ("",), one, (np.empty(0),), size, *place)
        self._from_rays = True
        self.notes["camera"] = (
            f"{why}: the source's undistorted points are taken, in a camera of fx = {fx:.1f}, fy = {fy:.1f} px"
        )

    def _is_anew(self, pose: Pose, features: Features) -> bool:
        """Return True if points of known ids are seen elsewhere: the source has begun anew and counts from 0."""
        told = np.flatnonzero(np.isfinite(features.point).all(axis=1)).tolist()
        known = [i for i in told if int(features.ids[i]) in self._points]
        if features.point_in_body or len(known) < _FIT_POINTS:
            return False
        before = np.array([self._points[int(features.ids[i])] for i in known])
        angle = _angles(features.point[known] - pose.position, before - pose.position)
        return bool(np.median(angle) > _ELSEWHERE)

    def _is_keyframe(self, pose: Pose, features: Features) -> bool:
        last = self._last
        if last is None or not self._source.every_image or features.is_keyframe or pose.is_keyframe:
            return True
        _, now, before = np.intersect1d(features.ids, last.ids, return_indices=True)
        if 1.0 - len(now) / len(features.ids) >= self._options.new_share:
            return True
        rays = features.point[now] - pose.position, features.point[now] - last.at
        if not np.isfinite(rays[0]).all() or features.point_in_body:
            assert self.rig is not None
            focal = self.rig.intrinsics[features.camera[now], :2]
            moved = np.linalg.norm((features.uv[now] - last.features.uv[before]) / focal, axis=1)
            angle = float(np.median(np.arctan(moved)))
        else:
            angle = float(np.median(_angles(*rays)))
        return bool(np.degrees(angle) >= self._options.parallax_deg)

    def _send(self, key: int, pose: Pose, features: Features) -> Iterator[tuple[str, int, Measurement]]:
        """Yield the rig if it is new, the keyframe, guesses of points that are new, and the tracks of each camera."""
        assert self.rig is not None
        stamp_ns = pose.stamp_ns
        if self._rig_sent is None:
            self._rig_sent = self.rig
            yield "camera_rig", stamp_ns, self.rig
        self._last = _Last(features.ids, pose.position, features)
        for known in (self._keys, self._points):
            if len(known) > _MAX_KNOWN:
                known.clear()
        self._keys.add(key)
        self.sent += 1
        yield (
            "keyframes",
            stamp_ns,
            Keyframe(self._session, key, stamp_ns, pose.frame_id, pose.position, pose.orientation),
        )
        uv, point = features.uv, features.point
        if self._from_rays:
            uv = features.normalised * self.rig.intrinsics[0, :2] + self.rig.intrinsics[0, 2:]
        depth_m = np.empty(0)
        if features.point_in_body:
            depth_m = self._depth_m(features) if features.has_depth else depth_m
            point = point @ geometry.matrix_from_quaternion(pose.orientation).T + pose.position
        ids = features.ids.astype(np.uint64)
        told = np.flatnonzero(np.isfinite(point).all(axis=1))
        new = [i for i in told.tolist() if int(ids[i]) not in self._points]
        self._points.update(zip(ids[told].tolist(), point[told], strict=True))
        if new:
            yield "landmark_guesses", stamp_ns, LandmarkGuesses(self._session, ids[new], point[new])
        for camera in np.unique(features.camera):
            rows = features.camera == camera
            own = depth_m[rows] if len(depth_m) else depth_m
            tracks = FeatureTracks(self._session, key, int(camera), ids[rows], uv[rows], depth_m=own)
            yield "feature_tracks", stamp_ns, tracks

    def _depth_m(self, features: Features) -> FloatArray:
        """Return the depth of points in the body, m, NaN where unknown or behind the camera."""
        assert self.rig is not None
        rotation = geometry.matrix_from_quaternion(self.rig.orientation)[features.camera]
        offset = features.point - self.rig.position[features.camera]
        depth = np.einsum("ni,ni->n", rotation[:, :, 2], offset)
        return np.where(depth > 0.0, depth, np.nan)


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles between vectors (n, 3), rad."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray(np.arccos((np.sum(a * b, axis=1) / lengths.clip(min=1e-12)).clip(-1.0, 1.0)))


def _is_pose(piece: Pose | Extrinsic) -> bool:
    finite = np.isfinite(piece.position).all() and np.isfinite(piece.orientation).all()
    return bool(finite and piece.orientation.any())


def _disagreement_px(rig: CameraRig, features: Features) -> float:
    """Return how far the pixels of normalised points are from those that came, median, px."""
    model, params = cameras.parameters(rig.models[0], rig.intrinsics[0], rig.distortion[0])
    rays = np.column_stack([features.normalised, np.ones(len(features.ids))])
    uv = cameras.project(rays, np.full(len(rays), int(model), np.uint8), np.tile(params, (len(rays), 1)))
    return float(np.median(np.linalg.norm(uv - features.uv, axis=1)))


def _moved(before: CameraRig, now: CameraRig) -> bool:
    """Return True if a calibration differs by more than a camera hardly notices."""
    if len(before) != len(now):
        return True
    lens = np.abs(now.intrinsics - before.intrinsics).max() / before.intrinsics[:, :1].max()
    turned = 2.0 * np.arccos(np.abs(np.sum(before.orientation * now.orientation, axis=1)).clip(max=1.0)).max()
    shifted = np.linalg.norm(now.position - before.position, axis=1).max()
    return any(value > limit for value, limit in zip((lens, shifted, turned), _MOVED, strict=True))
