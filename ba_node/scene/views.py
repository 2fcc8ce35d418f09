# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Who saw what: find the views of landmarks, and what keyframes see.

All observations stand in one table in order of arrival. Each row knows the previous row of the same landmark and each
landmark its last, so that the views of some landmarks are found in as many steps as there are, however large the map
is. The C++ kernels take these steps where they are built; numpy takes as many as the longest track has views.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.arrays import FloatArray, IntArray, ranges
from ba_node.scene.records import Block, Keyframes, Landmarks, ObservationTable


class Views:
    """The three tables, and questions to them whose cost does not depend on their size."""

    def __init__(self) -> None:
        self.keyframes = Keyframes()  # table, in order of arrival; see ``MapTables.order``
        self.landmarks = Landmarks()  # table, in order of arrival
        self.observations = ObservationTable()  # table, in order of arrival
        self.blocks: list[list[Block]] = []  # per keyframe row, its rows in ``observations``
        self._scratch: IntArray = np.empty((2, 0), np.intp)

    def cameras_of(self, keyframe_row: int) -> set[int]:
        """Return the indices of the cameras that delivered for a keyframe."""
        return {block.camera for block in self.blocks[keyframe_row]}

    def rows_of(self, keyframe_row: int) -> IntArray:
        """Return the rows of the observations by a keyframe."""
        bounds = np.array([block[1:] for block in self.blocks[keyframe_row]], np.intp).reshape(-1, 2)
        return ranges(*bounds.T)

    def numbers(self, rows: NDArray[np.integer[Any]], listed: IntArray) -> IntArray:
        """Return the place of each of some rows of keyframes or landmarks in a list of different ones, -1 if in none.

        Its cost does not depend on the size of the table.
        """
        scratch = self._cleared()
        scratch[listed] = np.arange(len(listed))
        found = scratch.take(rows)
        scratch[listed] = -1
        return found

    def distinct(self, rows: NDArray[np.integer[Any]]) -> IntArray:
        """Return the different ones among rows of keyframes or landmarks, ascending; its cost is likewise."""
        scratch, at = self._cleared(), np.arange(len(rows))
        scratch[rows] = at
        found: IntArray = np.sort(rows[scratch.take(rows) == at]).astype(np.intp)
        scratch[found] = -1
        return found

    def views_of(self, landmarks: IntArray, newest: int | None = None) -> IntArray:
        """Return the rows of all observations of some landmarks, or of the newest of each.

        The C++ kernels give them by landmark, in order of arrival; without them they are in no particular order.
        """
        if native.kernels is not None:
            columns = self.landmarks.last, self.observations.previous
            rows: IntArray = native.kernels.views_of(*columns, landmarks, -1 if newest is None else newest)
            return rows
        found: list[IntArray] = []
        front = self.landmarks.last[landmarks]
        front = front[front >= 0]
        while len(front) and (newest is None or len(found) < newest):
            found.append(front)
            front = self.observations.previous[front]
            front = front[front >= 0]
        return np.concatenate(found) if found else np.empty(0, np.intp)

    def seen_by(self, keyframes: IntArray) -> IntArray:
        """Return the landmarks that some keyframes see, by track id."""
        bounds = [bound for row in keyframes.tolist() for block in self.blocks[row] for bound in block[1:]]
        blocks = np.array(bounds, np.intp).reshape(-1, 2)
        if native.kernels is None:
            landmarks = self.distinct(self.observations.landmark[ranges(*blocks.T)])
        else:
            landmarks = native.kernels.distinct_landmarks(self.observations, *blocks.T, self._cleared())
        return landmarks[np.argsort(self.landmarks.track_id[landmarks])]

    def inliers_by_keyframe(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Return the keyframes of those of some observations that are no outliers, and how many each has."""
        if native.kernels is not None:
            keyframes, counts = native.kernels.inliers_by_keyframe(self.observations, rows, self._cleared())
            return keyframes, counts
        keyframe = self.observations.keyframe.take(rows[~self.observations.outlier.take(rows)])
        keyframes = self.distinct(keyframe)
        return keyframes, np.bincount(self.numbers(keyframe, keyframes), minlength=len(keyframes))

    def gather(
        self, rows: IntArray, keyframes: IntArray, landmarks: IntArray, kernels: str = "auto"
    ) -> tuple[IntArray, IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
        """Return those of some observations of listed landmarks that are by listed keyframes.

        Returns:
            Row, number of the keyframe, camera, number of the landmark, uv (n, 2) px, sigma px, depth m (0,) where none
            was measured; sorted by landmark, keyframe, camera, as they are listed.
        """
        table = self.observations
        if kernels != "numpy" and native.kernels is not None:
            scratch = self._cleared(0), self._cleared(1)
            return native.kernels.gather(table, rows, (keyframes, landmarks), scratch)  # type: ignore[no-any-return]
        keyframe = self.numbers(table.keyframe.take(rows), keyframes)
        rows, keyframe = rows[keyframe >= 0], keyframe[keyframe >= 0]
        landmark = self.numbers(table.landmark.take(rows), landmarks)
        camera = table.camera.take(rows).astype(np.intp)
        order = _in_order(camera, keyframe, landmark)
        rows = rows.take(order)
        depth = table.depth_m.take(rows).astype(float)
        return (
            rows,
            keyframe.take(order),
            camera.take(order),
            landmark.take(order),
            table.uv.take(rows, axis=0).astype(float),
            table.sigma_px.take(rows).astype(float),
            np.empty(0) if np.isnan(depth).all() else depth,
        )

    def _cleared(self, which: int = 0) -> IntArray:
        """Return numbers for each row of keyframes or landmarks, all -1; whoever writes to some puts them back."""
        size = max(len(self.keyframes), len(self.landmarks))
        if size > self._scratch.shape[1]:
            self._scratch = np.full((2, 2 * size), -1)
        cleared: IntArray = self._scratch[which]
        return cleared


def _in_order(camera: IntArray, keyframe: IntArray, landmark: IntArray) -> IntArray:
    """Return in which order observations are sorted by landmark, keyframe, camera; mostly they come so."""
    place = camera + (1 + camera.max(initial=0)) * (keyframe + (1 + keyframe.max(initial=0)) * landmark)
    return np.arange(len(place)) if (place[1:] > place[:-1]).all() else np.argsort(place, kind="stable")
