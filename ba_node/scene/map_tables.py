# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The tables of one map, and what keeps them consistent: order, indices, links between views, forgetting."""

from __future__ import annotations

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.config import SceneConfig
from ba_node.core import geometry
from ba_node.scene.records import Block
from ba_node.scene.tables import Growing, IdIndex
from ba_node.scene.views import Views

# 2^64 over the golden ratio: its multiples, modulo 2^64, are all different and spread evenly.
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
# Keyframes that are looked at first for one that was refined.
_NEAR = 64


class MapTables(Views):
    """Keyframes, landmarks and who saw what."""

    def __init__(self, config: SceneConfig) -> None:
        super().__init__()
        self.config = config  # how much is kept
        self._keyframe_rows: dict[int, int] = {}
        self._landmark_rows = IdIndex()
        self._order, self._places = Growing(np.intp), Growing(np.intp)
        # The place in the order of time from which on keyframes that took part in no solve have to be moved.
        self._unsettled = 0

    @property
    def order(self) -> IntArray:
        """Return the keyframe rows by (stamp, arrival), oldest first; it stays as it is when others come."""
        return self._order.values

    @property
    def newest_ns(self) -> int:
        """Return the stamp of the newest keyframe, the least there is without any."""
        return int(self.keyframes.stamp_ns[self.order[-1]]) if len(self.keyframes) else np.iinfo(np.int64).min

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
        return self._places.values

    def by_time(self, keyframes: IntArray) -> IntArray:
        """Return rows of keyframes, oldest first."""
        return self.order[np.sort(self.places()[keyframes])]

    def split(self, landmarks: IntArray, since: IntArray) -> IntArray:
        """Give the older views of some tracks landmarks of their own: their ids have become another point's.

        What was known of a landmark stays with its older views, under an id that nobody has; the track keeps the newer
        ones and has no position.

        Landmarks are (n,) rows, all different, each with older views; ``since`` is the place in the order of time of
        the first keyframe whose views stay.

        Returns:
            (n,) rows of the landmarks of the older views.
        """
        table, observations = self.landmarks, self.observations
        rows = np.sort(self.views_of(landmarks))
        of = self.numbers(observations.landmark[rows], landmarks)
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

    def join(self, landmark: int, into: int) -> bool:
        """Give the views of one landmark to another; False, and nothing changes, if one image sees both."""
        observations = self.observations
        rows = [self.views_of(np.array([one])) for one in (landmark, into)]
        seen = [set(zip(observations.keyframe[r].tolist(), observations.camera[r].tolist(), strict=True)) for r in rows]
        if landmark == into or seen[0] & seen[1]:
            return False
        table = self.landmarks
        if not table.has_position[into]:
            table.position[into], table.has_position[into] = table.position[landmark], table.has_position[landmark]
        table.has_position[landmark] = table.has_guess[landmark] = False
        both = np.sort(np.concatenate(rows))
        observations.landmark[rows[0]] = into
        # What was an outlier of the one may fit the other.
        observations.outlier[both] = False
        self._link_rows(both, np.array([landmark, into]))
        table.changed(np.array([landmark, into]))
        self._see(np.array([into]), int(table.last_seen[landmark]))
        return True

    def put_before(self, older: MapTables) -> None:
        """Put the rows of an older map in front; of a track that both know the older place counts, where it has one.

        No keyframe is in both.
        """
        n_kf, n_obs = len(older.keyframes), len(older.observations)
        number = older.find_landmarks(self.landmarks.track_id)
        new = number < 0
        number[new] = len(older.landmarks) + np.arange(np.count_nonzero(new))
        shifted = {"keyframe": self.observations.keyframe + n_kf, "landmark": number[self.observations.landmark]}
        keyframes, landmarks = older.keyframes.clone(), older.landmarks.clone()
        observations = older.observations.clone()
        keyframes.append(len(self.keyframes), **self.keyframes.columns())
        landmarks.append(int(np.count_nonzero(new)), **self.landmarks.columns(new))
        observations.append(len(self.observations), **(self.observations.columns() | shifted))
        both = number[~new]
        unplaced = ~landmarks.has_position[both]
        for name in ("position", "has_position"):
            getattr(landmarks, name)[both[unplaced]] = getattr(self.landmarks, name)[~new][unplaced]
        landmarks.last_seen[both] = np.maximum(landmarks.last_seen[both], self.landmarks.last_seen[~new])
        self.keyframes, self.landmarks, self.observations = keyframes, landmarks, observations
        own = [[Block(b.camera, b.begin + n_obs, b.end + n_obs) for b in blocks] for blocks in self.blocks]
        self.blocks = [*(list(blocks) for blocks in older.blocks), *own]
        self.index()
        # What was an outlier of the one may fit the other.
        self.observations.outlier[self.views_of(both)] = False

    def moved(self, keyframes: IntArray | None = None) -> None:
        """Note that keyframes have other poses, or are refined or no longer; all by default."""
        if keyframes is None:
            self.keyframes.changed()
            self._unsettled = 0
        elif len(keyframes):
            self.keyframes.changed(keyframes)
            self._unsettled = min(self._unsettled, int(self.places()[keyframes].min()))

    def propagate_corrections(self) -> None:
        """Move keyframes that took part in no solve by the correction of their predecessor.

        So the relative motion comes from the front-end and the anchor from the refined map (before the first refined
        keyframe, from that one). Done anew before each use, from the oldest on that was :meth:`moved` since.
        """
        table = self.keyframes
        begin, self._unsettled = self._unsettled, len(table)
        if begin >= len(table) or table.refined[self.order[begin:]].all():
            return
        if begin == len(table) - 1 and begin and table.refined[self.order[begin - 1]]:  # as of most keyframes
            rows, anchors = self.order[begin:], self.order[begin - 1 : begin]
        else:
            before = self._refined_before(begin)
            if before < 0:
                begin = 0
            rows = self.order[begin:]
            refined = table.refined[rows]
            if before < 0 and not refined.any():
                return
            at = np.maximum.accumulate(np.where(refined, np.arange(begin, len(table)), before))
            anchor = np.where(at < 0, begin + int(np.argmax(refined)), at)
            rows, anchors = rows[~refined], self.order[anchor[~refined]]
        rotation, translation = self.corrections(anchors)
        moved = geometry.compose(rotation, translation, table.input_rotation[rows], table.input_position[rows])
        table.rotation[rows], table.position[rows] = moved
        table.changed(rows)

    def _refined_before(self, place: int) -> int:
        """Return the place of the last refined keyframe before a place in the order of time, -1 if there is none."""
        size = _NEAR
        while place > 0:
            begin = max(0, place - size)
            found = np.flatnonzero(self.keyframes.refined[self.order[begin:place]])
            if len(found):
                return begin + int(found[-1])
            place, size = begin, 2 * size
        return -1

    def forget_solutions(self, since: int = 0) -> None:
        """Put keyframes back to where the front-end has them; forget where points are and which views are outliers.

        ``since``: only keyframes from this place in the order of time on, and points that these or later ones see.
        """
        table, rows = self.keyframes, self.order[since:]
        table.rotation[rows], table.position[rows] = table.input_rotation[rows], table.input_position[rows]
        table.refined[rows] = False
        self.moved(rows)
        seen = np.zeros(len(self.landmarks), bool)
        seen[self.observations.landmark[np.isin(self.observations.keyframe, rows)]] = True
        if not since:
            seen[:] = True
        self.landmarks.has_position[seen] = False
        self.landmarks.changed()
        self.observations.outlier[seen[self.observations.landmark]] = False

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

    def _rows_of(self, track_ids: IdArray) -> IntArray:
        """Return the landmark row of each track (all different), making rows for new ones."""
        rows = self._landmark_rows.find(track_ids)
        new = rows < 0
        if not new.any():
            return rows
        rows[new] = self.landmarks.append(int(np.count_nonzero(new)), track_id=track_ids[new])
        self._landmark_rows.insert(track_ids[new], rows[new])
        return rows

    def _see(self, landmarks: IntArray, stamp_ns: int) -> None:
        self.landmarks.last_seen[landmarks] = np.maximum(self.landmarks.last_seen[landmarks], stamp_ns)

    def _limit_keyframes(self) -> IdArray:
        """Forget the oldest keyframes with their observations once there is too much of either; return their ids.

        A tenth at once, so that the cost is spread; the two newest stay.
        """
        table, config, n_drop = self.keyframes, self.config, 0
        if len(table) > config.max_keyframes:
            n_drop = len(table) - config.max_keyframes + config.max_keyframes // 10
        if len(self.observations) > config.max_observations:
            excess = len(self.observations) - config.max_observations + config.max_observations // 10
            seen = np.cumsum(np.bincount(self.observations.keyframe, minlength=len(table))[self.order])
            n_drop = max(n_drop, 1 + int(np.searchsorted(seen, excess)))
        n_drop = min(n_drop, len(table) - 2)
        if n_drop <= 0:
            return table.keyframe_id[:0]
        forgotten = table.keyframe_id[self.order[:n_drop]]
        keep = np.ones(len(table), bool)
        keep[self.order[:n_drop]] = False
        self._drop_keyframes(keep)
        return forgotten

    def _drop_keyframes(self, keep: BoolArray) -> None:
        """Forget all keyframes but those marked, with their observations."""
        self._drop_observations(keep[self.observations.keyframe])
        renumbered = self.keyframes.keep(keep)
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
        table = self.keyframes
        self._keyframe_rows = {key: row for row, key in enumerate(table.keyframe_id.tolist())}
        self._order = Growing(np.intp, np.argsort(table.stamp_ns, kind="stable"))
        self._places = Growing(np.intp, np.argsort(self.order))
        self.moved()

    def _index_newest(self) -> None:
        """Find the place of the keyframe of the last row, which is new."""
        table, row = self.keyframes, len(self.keyframes) - 1
        place, stamp_ns = row, table.stamp_ns[row]
        if row and stamp_ns < table.stamp_ns[self.order[-1]]:
            place = int(np.searchsorted(table.stamp_ns[self.order], stamp_ns, side="right"))
        self._keyframe_rows[int(table.keyframe_id[row])] = row
        if place == row:
            self._order.extend(np.array([row]))
            self._places.extend(np.array([row]))
        else:
            self._order = Growing(np.intp, np.insert(self.order, place, row))
            self._places = Growing(np.intp, np.argsort(self.order))
        self.moved(np.array([row]))

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
        count = np.bincount(self.numbers(landmark, landmarks), minlength=len(landmarks))
        self.landmarks.views[landmarks] = count
        self.landmarks.changed(landmarks)
