# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what is known in one session: rig, keyframes, landmarks and who saw what.

Messages may come in any order and more than once. Tracks wait for their keyframe and for the rig; guesses are kept raw.
What contradicts or cannot be used is counted in ``log`` and leaves the scene as it was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, IntArray
from ba_node.config import SceneConfig
from ba_node.core.problem import Cameras
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    GlobalFix,
    GravityDirection,
    Keyframe,
    LandmarkGuesses,
    LandmarkPriors,
    Measurement,
    OfSession,
    OfTime,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.scene import ingest
from ba_node.scene.constraints import Constraints, joined_step
from ba_node.scene.map_tables import MapTables
from ba_node.scene.records import Block
from ba_node.scene.rejections import WARNINGS, Refusal, RejectionLog
from ba_node.scene.still_images import StillImages

# What takes in each kind of what is known beside pixels.
_CONSTRAINTS: dict[type, Callable[[Constraints, Any, RejectionLog], None]] = {
    RelativePose: Constraints.add_relative,
    GravityDirection: Constraints.add_gravity,
    LandmarkPriors: Constraints.add_landmarks,
    TrackMerge: Constraints.add_merge,
    PosePrior: Constraints.add_pose,
    GlobalFix: Constraints.add_fix,
}


class Scene(MapTables):
    """What is known in one session. All methods leave it consistent; none raises on bad data."""

    def __init__(self, config: SceneConfig, session_id: int | None = None) -> None:
        super().__init__(config)
        self.session_id = session_id  # the session, None before the first message that names one
        self.frame_id = ""  # name of the fixed frame
        self.cameras: Cameras | None = None  # the rig, None before it came
        self.given_cameras: Cameras | None = None  # the rig as it came, where it was refined since
        self.next_cameras: Cameras | None = None
        self.image_size: IntArray | None = None  # (n_cam, 2) width and height as the rig has them, px; 0 for unknown
        self.refused_rig = ""  # why the last rig that was refused was, empty if none was
        self.log = RejectionLog()  # what was turned away
        self.memory: object | None = None  # what windows know of keyframes that left them, see window/old_keyframes.py
        # what the front-end's steps' standard deviations of rotation and translation are multiplied by, as was learned
        self.step_shares: tuple[float, float] = (1.0, 1.0)
        self.pending: list[FeatureTracks] = []
        self.constraints = Constraints()  # what is known beside pixels
        self.culled_ns = np.iinfo(np.int64).min  # stamp of the last keyframe that was looked at, see window/culling.py
        self._reused: set[int] = set()
        self._still = StillImages()

    def clone(self) -> Scene:
        """Return a scene of its own with the same content but for what waits and what was turned away."""
        other = Scene(self.config, self.session_id)
        other.frame_id, other.cameras = self.frame_id, self.cameras
        other.refused_rig, other.step_shares = self.refused_rig, self.step_shares
        other.keyframes, other.landmarks = self.keyframes.clone(), self.landmarks.clone()
        other.observations, other.blocks = self.observations.clone(), [list(blocks) for blocks in self.blocks]
        other._index_keyframes()
        other._landmark_rows.insert(other.landmarks.track_id, np.arange(len(other.landmarks)))
        other.constraints = self.constraints.clone()
        return other

    def add(self, measurement: Measurement) -> None:
        """Take in a measurement of this session (or a rig); what cannot be used is counted."""
        if isinstance(measurement, CameraRig):
            self._set_rig(measurement)
            return
        if isinstance(measurement, OfTime):
            _CONSTRAINTS[type(measurement)](self.constraints, measurement, self.log)
            return
        if self.session_id is not None and measurement.session_id != self.session_id:
            if isinstance(measurement, Keyframe) and ingest.keyframe_pose(measurement, self.log) is None:
                return
            what = f"{type(measurement).__name__} of session {measurement.session_id}, the current is {self.session_id}"
            self.log.reject("stale_session", what)
            return
        if self.session_id is None and self.usable(measurement):
            self.session_id = measurement.session_id
        if isinstance(measurement, Keyframe):
            self._add_keyframe(measurement)
        elif isinstance(measurement, FeatureTracks):
            tracks = ingest.clean_tracks(measurement, self.log)
            if tracks is not None:
                self.log.notice("empty_tracks", len(measurement.track_id) == 0)
                self._place(tracks)
        elif isinstance(measurement, LandmarkGuesses):
            self._add_guesses(measurement)
        else:
            _CONSTRAINTS[type(measurement)](self.constraints, measurement, self.log)

    def usable(self, measurement: Keyframe | OfSession) -> bool:
        """Return True if anything of a measurement passes the checks it can be given by itself; count nothing."""
        if isinstance(measurement, Keyframe):
            return ingest.has_pose(measurement)
        log = RejectionLog()
        if isinstance(measurement, FeatureTracks):
            return ingest.clean_tracks(measurement, log) is not None
        return not isinstance(measurement, LandmarkGuesses) or ingest.clean_guesses(measurement, log) is not None

    def refuse(self, refusal: Refusal) -> None:
        """Turn away what was held, and the tracks that wait for it."""
        self.log.reject(refusal.reason, refusal.text)
        refused = refusal.measurement
        if refusal.reason in WARNINGS and isinstance(refused, Keyframe):
            self.log.warn_again(refusal.reason, f"{refusal.text}: turned away", f"keyframe {refused.keyframe_id}")
        key = refused.keyframe_id if isinstance(refused, Keyframe) and refused.session_id == self.session_id else None
        if key is None or key in self._keyframe_rows:
            return
        for tracks in (one for one in self.pending if one.keyframe_id == key):
            what = f"tracks of camera {tracks.camera_index} in keyframe {key}, which was turned away"
            self.log.reject("unknown_keyframe", what)
        self.pending = [tracks for tracks in self.pending if tracks.keyframe_id != key]

    def take_waiting(self, other: Scene) -> None:
        """Take over the tracks that wait in another scene of this session for keyframes that it does not know."""
        self.pending += [tracks for tracks in other.pending if tracks.keyframe_id not in other._keyframe_rows]
        other.pending = [tracks for tracks in other.pending if tracks.keyframe_id in other._keyframe_rows]

    def end_pending(self) -> None:
        """Give up on everything that still waits."""
        for tracks in self.pending:
            self._reject_waiting(tracks)
        self.pending = []
        stamps = self.keyframes.stamp_ns
        span = (int(stamps.min()), int(stamps.max())) if len(stamps) else (0, 0)
        self.constraints.end(self.keyframes.keyframe_id, self.landmarks.track_id, span, self.log)

    def take_out(self, keyframes: IntArray) -> None:
        """Take keyframes (rows, oldest first; not the oldest nor the newest) out of the map; steps lead over them."""
        table, steps, keep = self.keyframes, self.constraints.steps, np.ones(len(self.keyframes), bool)
        for row in keyframes.tolist():
            keep[row], place = False, int(self.places()[row])
            before = next(one for one in self.order[:place][::-1].tolist() if keep[one])
            after = int(self.order[place + 1])
            first, second = steps.get(int(table.keyframe_id[row])), steps.pop(int(table.keyframe_id[after]), None)
            if first is not None and second is not None:
                back = table.input_rotation[before].T
                move = back @ (table.input_position[after] - table.input_position[row])
                steps[int(table.keyframe_id[after])] = joined_step(
                    first, second, back @ table.input_rotation[row], move
                )
        gone = table.keyframe_id[~keep]
        self._drop_keyframes(keep)
        self.constraints.forget(gone, int(table.stamp_ns[self.order[0]]))

    def sessions_of(self, keyframes: IntArray) -> IntArray:
        """Return how many sessions of a map that was joined had begun before each of some keyframes (rows)."""
        if not self.constraints.seams:
            return np.zeros(len(keyframes), np.intp)
        rows = [row for row in map(self.find_keyframe, self.constraints.seams) if row is not None]
        begun = np.sort(self.places()[np.array(rows, np.intp)])
        return np.asarray(np.searchsorted(begun, self.places()[keyframes], side="right"))

    def refine_cameras(self, cameras: Cameras) -> None:
        """Take refined cameras in the place of the rig that came, which stays known as the same one."""
        self.given_cameras = self.given_cameras or self.cameras
        self.cameras = cameras

    def _set_rig(self, rig: CameraRig) -> None:
        cameras = ingest.rig_cameras(rig, self.log)
        if cameras is None:
            self.refused_rig = self.log.notes[-1].rpartition("; dropped")[0]
            return
        if any(known is not None and _same(cameras, known) for known in (self.cameras, self.given_cameras)):
            return
        if len(self.observations):
            # The rig has no session of its own: it may belong to a session that is about to begin.
            self.next_cameras = cameras
            self.log.reject("rig_changed", f"another camera rig ({len(rig)} cameras) in session {self.session_id}")
            return
        self.cameras, self.image_size = cameras, np.asarray(rig.image_size, dtype=np.intp)
        self.log.notice("adjusted_camera", len(rig.notes))
        self._place_pending()

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        known = self._keyframe_rows.get(keyframe.keyframe_id)
        pose = ingest.keyframe_pose(keyframe, self.log) if known is None else None
        if known is not None:
            self._reject_known(keyframe, known)
        if pose is None:
            return
        if keyframe.stamp_ns <= self.newest_ns:
            self.log.notice("reordered", keyframe.stamp_ns < self.newest_ns)
            ingest.check_stamp(keyframe, self.keyframes, self.log)
        self.frame_id = self.frame_id or ingest.plain_name(keyframe.frame_id)
        self.keyframes.append(
            1,
            keyframe_id=keyframe.keyframe_id,
            stamp_ns=keyframe.stamp_ns,
            input_rotation=pose.rotation,
            input_position=pose.position,
            rotation=pose.rotation,
            position=pose.position,
        )
        self._index_newest()
        self.constraints.add_step(keyframe.keyframe_id, keyframe.covariance, self.log)
        self.blocks.append([])
        forgotten = self._limit_keyframes()
        if len(forgotten):
            self.constraints.forget(forgotten, int(self.keyframes.stamp_ns[self.order[0]]))
        self.propagate_corrections()
        self._place_pending()

    def _reject_known(self, keyframe: Keyframe, row: int) -> None:
        """Turn away a keyframe whose id is known, and remember the id if it is another keyframe."""
        name, pose = f"keyframe {keyframe.keyframe_id}", ingest.keyframe_pose(keyframe, RejectionLog())
        table = self.keyframes
        if pose is None or np.array_equal(pose.position, table.input_position[row]):
            self.log.reject("duplicate_keyframe", f"{name} is known already")
            return
        apart_s = abs(keyframe.stamp_ns - int(table.stamp_ns[row])) * 1e-9
        apart_m = float(np.linalg.norm(pose.position - table.input_position[row]))
        what = f"{name} is known already, {apart_s:.3f} s and {apart_m:.3f} m from this one"
        self.log.reject("duplicate_keyframe", what)
        self.log.warn("reused_id", what + ": the first one stays; ids must be unique within a session_id")
        self._reused.add(keyframe.keyframe_id)

    def _add_guesses(self, message: LandmarkGuesses) -> None:
        guesses = ingest.clean_guesses(message, self.log)
        if guesses is None:
            return
        rows = self._rows_of(guesses.track_id)
        new = ~self.landmarks.has_guess[rows]
        self.log.notice("repeated_guess", int(np.count_nonzero(~new)))
        self.landmarks.guess[rows[new]] = guesses.position[new]
        self.landmarks.has_guess[rows[new]] = True
        if len(self.keyframes):
            # Counts as seen now, or a full map would forget it before its first observation comes.
            self._see(rows[new], self.newest_ns)
        self._limit_landmarks()

    def _place(self, tracks: FeatureTracks) -> None:
        """Put clean tracks into the table, or let them wait."""
        row = self._keyframe_rows.get(tracks.keyframe_id)
        if row is None or self.cameras is None:
            self.pending.append(tracks)
            if len(self.pending) > self.config.max_pending:
                self._reject_waiting(self.pending.pop(0))
            return
        if not 0 <= tracks.camera_index < len(self.cameras.model):
            what = f"tracks of camera {tracks.camera_index} in keyframe {tracks.keyframe_id}"
            self.log.reject("unknown_camera", f"{what}: the rig has {len(self.cameras.model)} cameras")
            return
        if tracks.keyframe_id in self._reused and tracks.camera_index in self.cameras_of(row):
            what = f"tracks of camera {tracks.camera_index} in keyframe {tracks.keyframe_id}, an id that came twice"
            self.log.reject("duplicate_observation", what, len(tracks.track_id))
            return
        still = self._still.why(tracks, self.keyframes.input_rotation[row], self.keyframes.input_position[row])
        if still:
            self.log.reject("still_image", still, len(tracks.track_id))
            self.log.warn("still_image", f"{still}; such images are turned away")
            return
        tracks = self._renamed(tracks)
        landmarks = self._rows_of(tracks.track_id)
        new = self._unseen(row, tracks, landmarks)
        which = slice(None) if new.all() else new
        landmarks = landmarks[which]
        added = self.observations.append(
            len(landmarks),
            keyframe=row,
            camera=tracks.camera_index,
            landmark=landmarks,
            previous=self.landmarks.last[landmarks],
            uv=tracks.uv[which],
            sigma_px=tracks.sigma_px[which],
            depth_m=tracks.depth_m[which],
        )
        if len(added) or tracks.camera_index not in self.cameras_of(row):
            begin = len(self.observations) - len(added)
            self.blocks[row].append(Block(tracks.camera_index, begin, begin + len(added)))
        if len(added) and not self.keyframes.refined[row]:
            # It was held out of earlier solves for want of observations.
            self.keyframes.solved[row] = False
        self.landmarks.last[landmarks] = added
        self.landmarks.views[landmarks] += 1
        self.landmarks.changed(landmarks)
        self._see(landmarks, int(self.keyframes.stamp_ns[row]))
        self._limit_landmarks()

    def _renamed(self, tracks: FeatureTracks) -> FeatureTracks:
        """Return tracks under the ids that they go on under; one that so comes twice in the image is turned away."""
        names = self.constraints.names_of(tracks.track_id)
        if names is tracks.track_id:
            return tracks
        kept = np.sort(np.unique(names, return_index=True)[1])
        if len(kept) < len(names):
            what = f"merged tracks in keyframe {tracks.keyframe_id}, camera {tracks.camera_index}"
            self.log.reject("duplicate_observation", f"{what}: one image sees both", len(names) - len(kept))
        rows = {name: getattr(tracks, name)[kept] for name in ("uv", "sigma_px", "depth_m")}
        return dataclasses.replace(tracks, track_id=names[kept], **rows)

    def join_tracks(self, track: int, other: int) -> bool:
        """Let a track go on under the id of another; False (counted) if one image sees both."""
        rows = self.find_landmarks(np.array([track, other], np.uint64))
        if not self.join(int(rows[0]), int(rows[1])):
            self.log.reject("bad_merge", f"tracks {track} and {other}: one image sees both, they are no one point")
            return False
        self.constraints.renamed[track] = other
        return True

    def _place_pending(self) -> None:
        waiting, self.pending = self.pending, []
        for tracks in waiting:
            self._place(tracks)

    def _reject_waiting(self, tracks: FeatureTracks) -> None:
        what = f"tracks of camera {tracks.camera_index} wait for keyframe {tracks.keyframe_id}"
        if tracks.keyframe_id in self._keyframe_rows:
            refused = f"a camera rig that can be used; refused was: {self.refused_rig}"
            waits_for = refused if self.refused_rig else "the camera rig, which never came"
            self.log.reject("pending_overflow", f"{what} and {waits_for}")
        else:
            self.log.reject("unknown_keyframe", f"{what}, which never came")

    def _unseen(self, row: int, tracks: FeatureTracks, landmarks: IntArray) -> BoolArray:
        """Return which landmarks this camera has not seen in this keyframe yet; count the others."""
        known = [
            self.observations.landmark[b.begin : b.end] for b in self.blocks[row] if b.camera == tracks.camera_index
        ]
        if not known:
            return np.ones(len(landmarks), bool)
        seen = np.isin(landmarks, np.concatenate(known))
        repeated = np.flatnonzero(seen)
        if len(repeated):
            where = f"keyframe {tracks.keyframe_id}, camera {tracks.camera_index}"
            what = f"track {tracks.track_id[repeated[0]]} is known in {where}"
            self.log.reject("duplicate_observation", what, len(repeated))
        return ~seen


def _same(a: Cameras, b: Cameras) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))
