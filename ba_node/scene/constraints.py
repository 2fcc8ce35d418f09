# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what is known beside pixels in one session: relative poses, priors of poses and points, gravity.

Each is checked by itself as it comes; what it names (keyframes, tracks) may come later. Covariances are kept by the
order of the tangent, rotation (rad) before translation (m), see ``core/geometry.py``. All that is absolute, poses and
positions by stamp and landmark priors, is in one frame fixed to the world, the first that is named; fixes of a
receiver are in east, north, up about the first of them (or ``priors.origin_*``).
"""

from __future__ import annotations

import bisect
import copy
import importlib
from dataclasses import dataclass

import numpy as np

from ba_node.arrays import FloatArray, IdArray
from ba_node.core import geometry
from ba_node.core.priors import root_information
from ba_node.measurements import GlobalFix, GravityDirection, LandmarkPriors, PosePrior, RelativePose, TrackMerge
from ba_node.scene import ingest
from ba_node.scene.rejections import RejectionLog

# Frame of the fixes of a receiver where none is named.
ENU = "enu"
# Entries of a covariance in the order of ROS (x, y, z, rotations) by the order of the tangent.
_TANGENT = np.array([3, 4, 5, 0, 1, 2])
_SYMMETRIC = 1e-6
_STRANGE_M = 1e7
# Variances below this, m^2 and rad^2, are a mistake: nothing is measured to 1e-12.
_LEAST_VARIANCE = 1e-24
# How many times the smallest the largest may be, for the inverse to hold both.
_MOST_RATIO = 1e12
# Absolute measurements that are kept, the newest: keyframes may never come.
_MOST = 200_000


@dataclass(frozen=True)
class RelativeMeasure:
    """A measured pose of one keyframe in another."""

    rotation: FloatArray  # (3, 3) body at the first from body at the second
    position: FloatArray  # (3,) the same, m
    # (6, 6) square root of the information on rotation about the axes of the second body, translation along the first's
    root: FloatArray
    is_loop: bool


@dataclass(frozen=True)
class Absolute:
    """A position in the world, of the body or of an antenna, and perhaps an orientation of the body."""

    stamp_ns: int
    position: FloatArray  # (3,) m
    rotation: FloatArray | None  # (3, 3) world from body; None: unknown
    covariance: (
        FloatArray  # (6, 6), rotation about the axes of the body, or (3, 3) of the position alone; zero: not told
    )
    of_antenna: bool  # of the antenna, not the body

    @property
    def source(self) -> int:
        """Return what it is from: 0 for poses, 1 for a receiver."""
        return int(self.of_antenna)


class Constraints:
    """What is known beside pixels.

    Attributes:
        relative: by the ids of both keyframes.
        relative_of: the keys of these by the id of each keyframe.
        gravity: by id of the keyframe: down (3,) in the body, unit; standard deviation, rad.
        landmarks: by track id: position (3,) in the world, m; covariance (3, 3), m^2.
        absolute: by stamp, oldest first.
        merges: pairs of tracks that are the same point, still to be joined; the first goes on under the second's id.
        renamed: tracks that were joined, by the id that they had: the one that they go on under.
        steps: covariance (6, 6) of the step from the keyframe before, by id of the keyframe.
        unchecked: relative poses that the map was not compared with yet; refused: those that it cannot meet.
        steps_precise: the front-end's steps turned out to be more precise than stated; the map is still to follow.
        adjusted_at: how many keyframes there were when the map was last bent.
        asked_at: and when it was last asked whether the map has left the world.
        grown_at: and when all of it was last refined as it had grown.
        compared_at: and when what came of keyframes was last compared with it, see window/outvoted.py.
        judged_at: and when what is absolute was last judged, see window/receiver.py.
        scatter: what that found, how many times as much as stated by source.
        left_out: likewise, stretches that jumped: source, first and last stamp (ns).
        seams: ids of keyframes with which the front-end began anew: no step leads there from the one before.
        map_from_world: rotation (3, 3) and translation (3,) m; None until enough is known.
        world_frame: name of the frame that all that is absolute is in; empty before the first.
        origin: (3,) latitude, longitude (deg), altitude (m) of the origin of east, north, up; None before a fix.
    """

    def __init__(self) -> None:
        self.relative: dict[tuple[int, int], RelativeMeasure] = {}
        self.relative_of: dict[int, list[tuple[int, int]]] = {}
        self.gravity: dict[int, tuple[FloatArray, float]] = {}
        self.landmarks: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.absolute: list[Absolute] = []
        self.merges: list[tuple[int, int]] = []
        self.renamed: dict[int, int] = {}
        self.steps: dict[int, FloatArray] = {}
        self.unchecked: list[tuple[int, int]] = []
        self.refused: set[tuple[int, int]] = set()
        self.steps_precise = False
        self.adjusted_at = 0
        self.asked_at = 0
        self.grown_at = 0
        self.judged_at = 0
        self.compared_at = 0
        self.scatter: dict[int, float] = {}
        self.left_out: list[tuple[int, int, int]] = []
        self.seams: set[int] = set()
        self.map_from_world: tuple[FloatArray, FloatArray] | None = None
        self.world_frame = ""
        self.origin: FloatArray | None = None

    def clone(self) -> Constraints:
        """Return the same, to which later ones are not added."""
        other = Constraints()
        vars(other).update({name: copy.copy(value) for name, value in vars(self).items()})
        return other

    def add_relative(self, measured: RelativePose, log: RejectionLog) -> None:
        """Take in a relative pose; the first between two keyframes stays."""
        key = measured.from_keyframe_id, measured.to_keyframe_id
        name = f"relative pose of keyframe {key[1]} in {key[0]}"
        if key[0] == key[1]:
            log.reject("bad_factor", f"{name}: expected two keyframes")
            return
        pose = _pose(name, measured.position, measured.orientation, log)
        covariance = positive_covariance(name, measured.covariance, 6, log)
        if pose is None or covariance is None:
            return
        if key in self.relative or key[::-1] in self.relative:
            log.notice("repeated_factor")
            return
        # A turn about the axes of the first body is one about those of the second, seen from there.
        turn = np.eye(6)
        turn[:3, :3] = pose.rotation.T
        covariance = turn @ covariance[np.ix_(_TANGENT, _TANGENT)] @ turn.T
        root = root_information(covariance)
        self.put_relative(key, RelativeMeasure(pose.rotation, pose.position, root, measured.is_loop))
        self.unchecked.append(key)

    def put_relative(self, key: tuple[int, int], measured: RelativeMeasure) -> None:
        """Take in a relative pose that is sound, by the ids of both keyframes."""
        self.relative[key] = measured
        for one in key:
            self.relative_of.setdefault(one, []).append(key)

    def add_step(self, keyframe_id: int, covariance: FloatArray, log: RejectionLog) -> None:
        """Take in the covariance of the step to a keyframe; one that cannot be is counted, and its step has none."""
        if len(covariance):
            known = positive_covariance(f"step to keyframe {keyframe_id}", covariance, 6, log)
            if known is not None:
                self.steps[keyframe_id] = known[np.ix_(_TANGENT, _TANGENT)]

    def add_merge(self, merge: TrackMerge, log: RejectionLog) -> None:
        """Take in pairs of tracks that are the same point."""
        malformed = merge.malformed or _lengths(merge.track_id, merge.same_as)
        if malformed:
            log.reject("malformed", f"merge of tracks: {malformed}")
            return
        for pair in zip(merge.track_id.tolist(), merge.same_as.tolist(), strict=True):
            one, other = (self.name_of(track) for track in pair)
            if one == other or (one, other) in self.merges:
                log.notice("repeated_factor")
                continue
            self.merges.append((one, other))

    def name_of(self, track: int) -> int:
        """Return the id that a track goes on under."""
        while track in self.renamed:
            track = self.renamed[track]
        return track

    def names_of(self, tracks: IdArray) -> IdArray:
        """Return the ids that tracks go on under."""
        if not self.renamed:
            return tracks
        known = np.isin(tracks, np.fromiter(self.renamed, np.uint64, len(self.renamed)))
        out = tracks.copy()
        out[known] = [self.name_of(track) for track in tracks[known].tolist()]
        return out

    def add_gravity(self, measured: GravityDirection, log: RejectionLog) -> None:
        """Take in a direction of gravity; the first at a keyframe stays."""
        name, down = f"gravity at keyframe {measured.keyframe_id}", np.asarray(measured.down, float)
        length = float(np.linalg.norm(down)) if down.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0.0):
            log.reject("bad_factor", f"{name}: down = {down}, expected three finite numbers, not all zero")
        elif not (np.isfinite(measured.sigma_rad) and measured.sigma_rad > 0.0):
            log.reject("bad_covariance", f"{name}: sigma_rad = {measured.sigma_rad}, expected > 0")
        elif measured.keyframe_id in self.gravity:
            log.notice("repeated_factor")
        else:
            self.gravity[measured.keyframe_id] = down / length, float(measured.sigma_rad)

    def add_landmarks(self, priors: LandmarkPriors, log: RejectionLog) -> None:
        """Take in places of points; the last of a track counts."""
        malformed = priors.malformed or _lengths(priors.track_id, priors.position, priors.covariance)
        if malformed:
            log.reject("malformed", f"landmark priors: {malformed}")
            return
        if not self._same_world("landmark priors", priors.frame_id, log):
            return
        for track, position, covariance in zip(
            priors.track_id.tolist(), priors.position, priors.covariance, strict=True
        ):
            name = f"prior of track {track}"
            known = positive_covariance(name, covariance, 3, log)
            if known is None:
                continue
            if not _finite(position):
                log.reject("bad_factor", f"{name}: position {position} m, expected finite")
                continue
            self.landmarks[self.name_of(track)] = np.array(position), known

    def add_pose(self, prior: PosePrior, log: RejectionLog) -> None:
        """Take in a pose of the body in the world."""
        name = f"pose prior at {prior.stamp_ns * 1e-9:.3f} s"
        pose = _pose(name, prior.position, prior.orientation, log)
        covariance = positive_covariance(name, prior.covariance, 6, log)
        if pose is None or covariance is None or not self._same_world(name, prior.frame_id, log):
            return
        turn = np.eye(6)
        turn[:3, :3] = pose.rotation.T
        covariance = turn @ covariance[np.ix_(_TANGENT, _TANGENT)] @ turn.T
        self._insert(Absolute(prior.stamp_ns, pose.position, pose.rotation, covariance, of_antenna=False))

    def add_fix(self, fix: GlobalFix, log: RejectionLog) -> None:
        """Take in a fix of a receiver."""
        name, place = f"fix at {fix.stamp_ns * 1e-9:.3f} s", np.asarray(fix.geodetic, float)
        if not fix.is_fix:
            log.notice("no_fix")
            return
        if not _finite(place) or abs(place[0]) > 90.0 or abs(place[1]) > 180.0:
            log.reject("bad_factor", f"{name}: latitude, longitude, altitude {place}, expected within 90, 180 deg")
            return
        if not place[:2].any():
            log.reject("bad_factor", f"{name}: latitude 0, longitude 0: the receiver has no place yet")
            return
        told = np.asarray(fix.covariance, float)
        covariance = positive_covariance(name, told, 3, log) if told.any() else np.zeros((3, 3))
        if covariance is None or not self._same_world(name, ENU, log):
            return
        try:
            pymap3d = importlib.import_module("pymap3d")
        except ImportError:
            log.reject("no_geo", f"{name}: needs pymap3d: pip install ba_node[geo]")
            log.warn("no_geo", "fixes of GNSS are left out: pymap3d is missing; pip install ba_node[geo]")
            return
        self.origin = place if self.origin is None else self.origin
        position = np.array(pymap3d.geodetic2enu(*place, *self.origin), float)
        if np.linalg.norm(position) > _STRANGE_M:
            log.reject("bad_factor", f"{name}: {np.linalg.norm(position):.0f} m from the first one")
            return
        self._insert(Absolute(fix.stamp_ns, position, None, covariance, of_antenna=True))

    def put_before(self, older: Constraints, seam: int, log: RejectionLog) -> None:
        """Take in what was known of an older session, whose map this one's is now; ``seam`` is its first keyframe."""
        if older.world_frame and self.world_frame not in ("", older.world_frame):
            lost = len(self.absolute) + len(self.landmarks)
            log.reject("other_world", f"priors in frame {self.world_frame!r}, expected {older.world_frame!r}", lost)
            self.absolute, self.landmarks, self.map_from_world = [], {}, None
        for name in ("relative", "relative_of", "gravity", "landmarks", "steps"):
            setattr(self, name, {**getattr(self, name), **getattr(older, name)})
        self.unchecked, self.merges = older.unchecked + self.unchecked, older.merges + self.merges
        self.refused, self.seams = self.refused | older.refused, self.seams | older.seams | {seam}
        self.steps.pop(seam, None)
        self.absolute = sorted(older.absolute + self.absolute, key=lambda one: one.stamp_ns)[-_MOST:]
        renamed, self.renamed = self.renamed, dict(older.renamed)
        self.renamed |= {track: other for track, other in renamed.items() if self.name_of(other) != track}
        self.world_frame = older.world_frame or self.world_frame
        self.origin = self.origin if older.origin is None else older.origin
        self.map_from_world = older.map_from_world or self.map_from_world
        self.asked_at = 0
        self.judged_at = 0
        self.compared_at = 0

    def forget(self, keyframes: IdArray, oldest_ns: int) -> None:
        """Drop what belongs to keyframes that were forgotten; ``oldest_ns`` is the stamp of the oldest that is left."""
        gone = set(keyframes.tolist())
        self._drop([key for key in self.relative if not gone.isdisjoint(key)])
        self.gravity = {key: value for key, value in self.gravity.items() if key not in gone}
        self.steps = {key: value for key, value in self.steps.items() if key not in gone}
        self.seams -= gone
        self.absolute = [one for one in self.absolute if one.stamp_ns >= oldest_ns]
        for name in ("adjusted_at", "judged_at", "compared_at"):
            setattr(self, name, max(0, getattr(self, name) - len(gone)))

    def end(self, keyframes: IdArray, tracks: IdArray, span_ns: tuple[int, int], log: RejectionLog) -> None:
        """Give up what names keyframes that never came; count what lies outside the time of all, or has no track."""
        log.notice("unpaired", sum(not span_ns[0] <= one.stamp_ns <= span_ns[1] for one in self.absolute))
        log.notice("unpaired", len(set(self.landmarks).difference(tracks.tolist())) if self.landmarks else 0)
        known = set(keyframes.tolist())
        never = [key for key in self.relative if not known.issuperset(key)]
        for key in never:
            missing = next(one for one in key if one not in known)
            log.reject("unknown_keyframe", f"relative pose of keyframe {key[1]} in {key[0]}: {missing} never came")
        self._drop(never)
        for one in [one for one in self.gravity if one not in known]:
            log.reject("unknown_keyframe", f"gravity at keyframe {one}, which never came")
            del self.gravity[one]

    def leaves_out(self, one: Absolute) -> bool:
        """Return whether an absolute measurement belongs to a stretch that jumped."""
        return any(source == one.source and since <= one.stamp_ns <= to for source, since, to in self.left_out)

    def _drop(self, keys: list[tuple[int, int]]) -> None:
        """Forget relative poses."""
        for key in keys:
            del self.relative[key]
            for one in key:
                self.relative_of[one].remove(key)
        self.relative_of = {one: left for one, left in self.relative_of.items() if left}
        self.unchecked = [key for key in self.unchecked if key in self.relative]

    def _insert(self, one: Absolute) -> None:
        bisect.insort(self.absolute, one, key=lambda known: known.stamp_ns)
        del self.absolute[:-_MOST]

    def _same_world(self, name: str, frame_id: str, log: RejectionLog) -> bool:
        frame = ingest.plain_name(frame_id)
        self.world_frame = self.world_frame or frame
        if frame == self.world_frame and frame:
            return True
        expected = f"{self.world_frame!r} as what came first" if self.world_frame else "a name"
        log.reject("other_world", f"{name} is in frame {frame!r}, expected {expected}")
        return False


def joined_step(one: FloatArray, other: FloatArray, turn: FloatArray, move: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of two steps in a row from those of each, about the axes of the body it begins at.

    ``turn`` (3, 3) is that of the first step, ``move`` (3,) m the way of the second in the body where the first begins.
    With the rotation phi and the translation t of the steps a and b: ``phi = phi_a + R_a phi_b``, ``t = t_a + R_a t_b -
    [move]x phi_a``.
    """
    first, second = np.eye(6), np.kron(np.eye(2), turn)
    first[3:, :3] = -geometry.hat(move[None])[0]
    return np.asarray(first @ one @ first.T + second @ other @ second.T)


def _pose(name: str, position: FloatArray, orientation: FloatArray, log: RejectionLog) -> ingest.Pose | None:
    position, quaternion = np.asarray(position, float), np.asarray(orientation, float)
    if not _finite(position) or quaternion.shape != (4,) or not ingest.is_rotation(quaternion):
        log.reject("bad_factor", f"{name}: position {position} m, quaternion {quaternion}, expected finite, not zero")
        return None
    return ingest.Pose(geometry.matrix_from_quaternion(quaternion), position)


def positive_covariance(name: str, values: FloatArray, size: int, log: RejectionLog) -> FloatArray | None:
    """Return a covariance (size, size), or None (counted) if it is not positive definite, or its inverse no number.

    Variances so large that they say "not known" are lowered to what still says so, and can be inverted.
    """
    if np.size(values) != size * size:
        log.reject("bad_covariance", f"{name}: {np.size(values)} numbers, expected {size * size}")
        return None
    matrix = np.asarray(values, float).reshape(size, size)
    if np.isfinite(matrix).all() and np.abs(matrix - matrix.T).max() <= _SYMMETRIC * np.abs(matrix).max():
        variances, axes = np.linalg.eigh(0.5 * matrix + 0.5 * matrix.T)
        lowest, most = float(variances[0]), _MOST_RATIO * float(variances[0])
        if lowest > _LEAST_VARIANCE:
            if variances[-1] <= most:
                return np.asarray(0.5 * (matrix + matrix.T))
            scaled = axes * np.sqrt(np.minimum(variances, most))
            return np.asarray(scaled @ scaled.T)
        log.reject("bad_covariance", f"{name}: lowest eigenvalue {lowest:g}, expected > {_LEAST_VARIANCE:g}")
        return None
    log.reject("bad_covariance", f"{name}: {matrix.tolist()}, expected finite and symmetric")
    return None


def _lengths(*arrays: FloatArray | IdArray) -> str:
    """Return in words that arrays are not of one length, empty if they are."""
    lengths = [len(one) for one in arrays]
    return "" if len(set(lengths)) == 1 else f"arrays of {', '.join(map(str, lengths))} rows, expected as many in each"


def _finite(position: FloatArray) -> bool:
    return position.shape == (3,) and bool(np.isfinite(position).all()) and float(np.abs(position).max()) < 1e9
