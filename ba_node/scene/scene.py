# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what is known in one session: rig, keyframes, landmarks and who saw what.

Messages may come in any order and more than once. Tracks wait for their keyframe and for the rig; guesses are kept raw.
What contradicts or cannot be used is counted in ``log`` and leaves the scene as it was.

All observations stand in one table in order of arrival. Each row knows the previous row of the same landmark and each
landmark its last, so that the views of some landmarks are found in as many vector steps as the longest track has views,
however large the map is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ba_node.core import geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.scene import ingest
from ba_node.scene.frame_names import plain
from ba_node.scene.records import Block, Keyframes, Landmarks, ObservationTable
from ba_node.scene.rejections import WARNINGS, RejectionLog
from ba_node.scene.tables import BoolArray, FloatArray, IdArray, IdIndex, IntArray

if TYPE_CHECKING:
    from ba_node.config import SceneConfig
    from ba_node.core.problem import Cameras
    from ba_node.scene.candidates import Refusal

# 2^64 over the golden ratio: its multiples, modulo 2^64, are all different and spread evenly.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


class Scene:
    """What is known in one session. All methods leave it consistent; none raises on bad data.

    Attributes:
        session_id: the session, None before the first message that names one.
        frame_id: name of the fixed frame.
        cameras: the rig, None before it came.
        refused_rig: why the last rig that was refused was, empty if none was.
        keyframes: table, in order of arrival; see ``order``.
        landmarks: table, in order of arrival.
        observations: table, in order of arrival.
        blocks: per keyframe row, its rows in ``observations``.
        log: what was turned away.
    """

    def __init__(self, config: SceneConfig, session_id: int | None = None) -> None:
        """Start empty."""
        self.config = config
        self.session_id = session_id
        self.frame_id = ""
        self.cameras: Cameras | None = None
        self.next_cameras: Cameras | None = None
        self.refused_rig = ""
        self.keyframes = Keyframes()
        self.landmarks = Landmarks()
        self.observations = ObservationTable()
        self.blocks: list[list[Block]] = []
        self.log = RejectionLog()
        self.pending: list[FeatureTracks] = []
        self._keyframe_rows: dict[int, int] = {}
        self._reused: set[int] = set()
        self._landmark_rows = IdIndex()
        self._order: IntArray | None = None

    @property
    def order(self) -> IntArray:
        """Return the keyframe rows by (stamp, arrival), oldest first."""
        if self._order is None:
            self._order = np.argsort(self.keyframes.stamp_ns, kind="stable")
        return self._order

    @property
    def landmark_order(self) -> IntArray:
        """Return the landmark rows by track id."""
        return self._landmark_rows.rows

    def find_keyframe(self, keyframe_id: int) -> int | None:
        """Return the row of a keyframe, None if it is not known."""
        return self._keyframe_rows.get(keyframe_id)

    def find_keyframes(self, keyframe_ids: IdArray) -> IntArray:
        """Return the row of each keyframe, -1 where it is not known."""
        return np.array([self._keyframe_rows.get(key, -1) for key in keyframe_ids.tolist()], np.intp)

    def find_landmarks(self, track_ids: IdArray) -> IntArray:
        """Return the row of each track, -1 where it is not known."""
        return self._landmark_rows.find(track_ids)

    def places(self) -> IntArray:
        """Return the place of each row of keyframes in the order of time."""
        place = np.empty(len(self.order), np.intp)
        place[self.order] = np.arange(len(place))
        return place

    def cameras_of(self, keyframe_row: int) -> set[int]:
        """Return the indices of the cameras that delivered for a keyframe."""
        return {block.camera for block in self.blocks[keyframe_row]}

    def views_of(self, landmarks: IntArray, newest: int | None = None) -> IntArray:
        """Return the rows of all observations of some landmarks, or of the newest of each, in no particular order."""
        found: list[IntArray] = []
        front = self.landmarks.last[landmarks]
        front = front[front >= 0]
        while len(front) and (newest is None or len(found) < newest):
            found.append(front)
            front = self.observations.previous[front]
            front = front[front >= 0]
        return np.concatenate(found) if found else np.empty(0, np.intp)

    def add(self, measurement: Measurement) -> None:
        """Take in a measurement of this session (or a rig); what cannot be used is counted."""
        if isinstance(measurement, CameraRig):
            self._set_rig(measurement)
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
        else:
            self._add_guesses(measurement)

    def usable(self, measurement: Keyframe | FeatureTracks | LandmarkGuesses) -> bool:
        """Return True if anything of a measurement passes the checks it can be given by itself; count nothing."""
        log = RejectionLog()
        if isinstance(measurement, Keyframe):
            return ingest.keyframe_pose(measurement, log) is not None
        if isinstance(measurement, FeatureTracks):
            return ingest.clean_tracks(measurement, log) is not None
        return ingest.clean_guesses(measurement, log) is not None

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
        mine = [tracks for tracks in other.pending if other.find_keyframe(tracks.keyframe_id) is None]
        other.pending = [tracks for tracks in other.pending if other.find_keyframe(tracks.keyframe_id) is not None]
        self.pending += mine

    def split(self, landmarks: IntArray, since: IntArray) -> IntArray:
        """Give the older views of some tracks landmarks of their own: their ids have become another point's.

        What was known of a landmark stays with its older views, under an id that nobody has; the track keeps the newer
        ones and has no position.

        Args:
            landmarks: (n,) rows, all different, each with older views.
            since: (n,) place in the order of time of the first keyframe whose views stay.

        Returns:
            (n,) rows of the landmarks of the older views.
        """
        table, observations = self.landmarks, self.observations
        number = np.full(len(table), -1)
        number[landmarks] = np.arange(len(landmarks))
        rows = np.sort(self.views_of(landmarks))
        of = number[observations.landmark[rows]]
        old = self.places()[observations.keyframe[rows]] < since[of]
        known = {name: getattr(table, name)[landmarks] for name in ("position", "guess", "has_position", "has_guess")}
        ids = self._unknown_ids(len(landmarks))
        added = table.append(len(landmarks), track_id=ids, last_seen=table.last_seen[landmarks], **known)
        self._landmark_rows.insert(ids, added)
        table.position[landmarks] = table.guess[landmarks] = np.nan
        table.has_position[landmarks] = table.has_guess[landmarks] = False
        observations.landmark[rows[old]] = added[of[old]]
        self._link_rows(rows, np.concatenate([landmarks, added]))
        return added

    def end_pending(self) -> None:
        """Give up on everything that still waits."""
        for tracks in self.pending:
            self._reject_waiting(tracks)
        self.pending = []

    def propagate_corrections(self) -> None:
        """Move keyframes that took part in no solve by the correction of their predecessor.

        So the relative motion comes from the front-end and the anchor from the refined map (before the first refined
        keyframe, from that one). Done anew before each use: corrections change with every solve.
        """
        order, table = self.order, self.keyframes
        refined = table.refined[order]
        if refined.all() or not refined.any():
            return
        at = np.arange(len(order))
        anchor = np.maximum.accumulate(np.where(refined, at, -1))
        anchor = np.where(anchor < 0, int(np.argmax(refined)), anchor)
        rows, anchors = order[~refined], order[anchor[~refined]]
        rotation, translation = self.corrections(anchors)
        moved = geometry.compose(rotation, translation, table.input_rotation[rows], table.input_position[rows])
        table.rotation[rows], table.position[rows] = moved

    def forget_solutions(self) -> None:
        """Put keyframes back to where the front-end has them; forget where points are and which views are outliers."""
        table = self.keyframes
        table.rotation[:], table.position[:] = table.input_rotation, table.input_position
        table.refined[:] = False
        self.landmarks.has_position[:] = False
        self.observations.outlier[:] = False

    def corrections(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the transform from the front-end's fixed frame to the refined map, as it is at some keyframes."""
        table = self.keyframes
        back = geometry.inverse(table.input_rotation[rows], table.input_position[rows])
        return geometry.compose(table.rotation[rows], table.position[rows], *back)

    def index(self) -> None:
        """Find anew what follows from the tables: the rows of ids, and which observations belong to a landmark."""
        self._index_keyframes()
        self._landmark_rows = IdIndex()
        self._landmark_rows.insert(self.landmarks.track_id, np.arange(len(self.landmarks)))
        self._link()

    def _set_rig(self, rig: CameraRig) -> None:
        cameras = ingest.rig_cameras(rig, self.log)
        if cameras is None:
            self.refused_rig = self.log.notes[-1].rpartition("; dropped")[0]
            return
        if self.cameras is not None and _same(cameras, self.cameras):
            return
        if len(self.observations):
            # The rig has no session of its own: it may belong to a session that is about to begin.
            self.next_cameras = cameras
            self.log.reject("rig_changed", f"another camera rig ({len(rig)} cameras) in session {self.session_id}")
            return
        self.cameras = cameras
        self.log.notice("adjusted_camera", len(rig.notes))
        self._place_pending()

    def _add_keyframe(self, keyframe: Keyframe) -> None:
        known = self._keyframe_rows.get(keyframe.keyframe_id)
        pose = ingest.keyframe_pose(keyframe, self.log) if known is None else None
        if known is not None:
            self._reject_known(keyframe, known)
        if pose is None:
            return
        if len(self.keyframes) and keyframe.stamp_ns < self.keyframes.stamp_ns.max():
            self.log.notice("reordered")
        ingest.check_stamp(keyframe, self.keyframes, self.log)
        self.frame_id = self.frame_id or plain(keyframe.frame_id)
        row = self.keyframes.append(
            1,
            keyframe_id=keyframe.keyframe_id,
            stamp_ns=keyframe.stamp_ns,
            input_rotation=pose.rotation,
            input_position=pose.position,
            rotation=pose.rotation,
            position=pose.position,
        )
        self._keyframe_rows[keyframe.keyframe_id] = int(row[0])
        self.blocks.append([])
        self._order = None
        if len(self.keyframes) > self.config.max_keyframes:
            self._forget_keyframes()
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
            self._see(rows[new], int(self.keyframes.stamp_ns.max()))
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
        landmarks = self._rows_of(tracks.track_id)
        new = self._unseen(row, tracks, landmarks)
        landmarks = landmarks[new]
        added = self.observations.append(
            len(landmarks),
            keyframe=row,
            camera=tracks.camera_index,
            landmark=landmarks,
            previous=self.landmarks.last[landmarks],
            uv=tracks.uv[new],
            sigma_px=tracks.sigma_px[new],
            depth_m=tracks.depth_m[new],
        )
        if len(added) or tracks.camera_index not in self.cameras_of(row):
            begin = len(self.observations) - len(added)
            self.blocks[row].append(Block(tracks.camera_index, begin, begin + len(added)))
        if len(added) and not self.keyframes.refined[row]:
            # It was held out of earlier solves for want of observations.
            self.keyframes.solved[row] = False
        self.landmarks.last[landmarks] = added
        self.landmarks.views[landmarks] += 1
        self._see(landmarks, int(self.keyframes.stamp_ns[row]))
        self._limit_landmarks()

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

    def _rows_of(self, track_ids: IdArray) -> IntArray:
        """Return the landmark row of each track (all different), making rows for new ones."""
        rows = self._landmark_rows.find(track_ids)
        new = rows < 0
        rows[new] = self.landmarks.append(int(np.count_nonzero(new)), track_id=track_ids[new])
        self._landmark_rows.insert(track_ids[new], rows[new])
        return rows

    def _see(self, landmarks: IntArray, stamp_ns: int) -> None:
        self.landmarks.last_seen[landmarks] = np.maximum(self.landmarks.last_seen[landmarks], stamp_ns)

    def _unseen(self, row: int, tracks: FeatureTracks, landmarks: IntArray) -> BoolArray:
        """Return which landmarks this camera has not seen in this keyframe yet; count the others."""
        seen = np.zeros(len(self.landmarks), bool)
        for block in self.blocks[row]:
            if block.camera == tracks.camera_index:
                seen[self.observations.landmark[block.begin : block.end]] = True
        repeated = np.flatnonzero(seen[landmarks])
        if len(repeated):
            where = f"keyframe {tracks.keyframe_id}, camera {tracks.camera_index}"
            what = f"track {tracks.track_id[repeated[0]]} is known in {where}"
            self.log.reject("duplicate_observation", what, len(repeated))
        return ~seen[landmarks]

    def _forget_keyframes(self) -> None:
        """Forget the oldest keyframes with their observations: a tenth at once, so that the cost is spread."""
        table = self.keyframes
        n_drop = len(table) - self.config.max_keyframes + self.config.max_keyframes // 10
        keep = np.ones(len(table), bool)
        keep[self.order[:n_drop]] = False
        self._drop_observations(keep[self.observations.keyframe])
        renumbered = table.keep(keep)
        self.observations.keyframe[:] = renumbered[self.observations.keyframe]
        self.blocks = [blocks for blocks, kept in zip(self.blocks, keep, strict=True) if kept]
        self._index_keyframes()

    def _limit_landmarks(self) -> None:
        """Forget the landmarks seen longest ago, ties by row, once there are too many; again a tenth at once."""
        table, limit = self.landmarks, self.config.max_landmarks
        if len(table) <= limit:
            return
        n_drop = len(table) - limit + limit // 10
        keep = np.ones(len(table), bool)
        keep[np.argsort(table.last_seen, kind="stable")[:n_drop]] = False
        self._drop_observations(keep[self.observations.landmark])
        renumbered = table.keep(keep)
        self._landmark_rows.renumber(renumbered)
        self.observations.landmark[:] = renumbered[self.observations.landmark]

    def _drop_observations(self, keep: BoolArray) -> None:
        """Forget observations and link the others anew. Landmark numbers are still the old ones."""
        before = np.concatenate([[0], np.cumsum(keep)])
        self.blocks = [
            [Block(b.camera, int(before[b.begin]), int(before[b.end])) for b in blocks] for blocks in self.blocks
        ]
        self.observations.keep(keep)
        self._link()

    def _index_keyframes(self) -> None:
        self._keyframe_rows = {int(k): row for row, k in enumerate(self.keyframes.keyframe_id)}
        self._order = None

    def _unknown_ids(self, n: int) -> IdArray:
        """Return n ids that no track has, spread over all there are."""
        ids: IdArray = np.empty(0, np.uint64)
        begin = 1
        while len(ids) < n:
            spread = np.arange(begin, begin + 2 * n, dtype=np.uint64) * _GOLDEN
            ids = np.concatenate([ids, spread[self._landmark_rows.find(spread) < 0]])
            begin += 2 * n
        return ids[:n]

    def _link(self) -> None:
        self._link_rows(np.arange(len(self.observations)), np.arange(len(self.landmarks)))

    def _link_rows(self, rows: IntArray, landmarks: IntArray) -> None:
        """Find anew which observations belong to some landmarks: ``rows``, ascending, are all that they have."""
        landmark = self.observations.landmark[rows]
        order = rows[np.argsort(landmark, kind="stable")]
        landmark = self.observations.landmark[order]
        same = landmark[1:] == landmark[:-1]
        self.observations.previous[rows] = -1
        self.observations.previous[order[1:][same]] = order[:-1][same]
        self.landmarks.last[landmarks] = -1
        # Rows ascend within a landmark, so the last write is its newest row.
        self.landmarks.last[landmark] = order
        self.landmarks.views[landmarks] = np.bincount(landmark, minlength=len(self.landmarks))[landmarks]


def _same(a: Cameras, b: Cameras) -> bool:
    return (
        np.array_equal(a.model, b.model)
        and np.array_equal(a.params, b.params)
        and np.array_equal(a.rotation, b.rotation)
        and np.array_equal(a.translation, b.translation)
    )
