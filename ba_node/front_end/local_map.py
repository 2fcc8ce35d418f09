# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Remember points that were seen: a patch each, in the keyframe that it was cut from, and how far away it was there.

A point is anchored to a keyframe: it moves with it when that is refined. Its distance is kept as inverse depth
``w = 1 / Z``, in which errors of disparities are Gaussian and infinity is an ordinary value, with the slant of its
surface, which is linear in the image too: ``w(p) = w + s_x p_x + s_y p_y`` is a plane. So where a patch appears in
another camera (R, t from the anchor) is a homography, which matters: a road seen from a car that has moved by 2 m is
bent by a third of a pixel over a patch.

    m(p) = R K^-1 [x + p, 1] + t w(p),   W(p) = pi(m(p)) = W(0) + A p / (1 + g p),   A = dW/dp (0),   g = d log m_z / dp
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.estimate import Transform
from ba_node.front_end.patches import Floats
from ba_node.front_end.rectify import IdealRig

# Inverse depths below this are as good as zero, 1/m.
_FAR = 1e-4
# Most points, and how many there is room for at first.
_MOST, _ROOM = 6_000, 7_000
_COLUMNS = ("track_id", "anchor", "uv", "inverse_depth", "sigma", "slant", "last_seen")


@dataclass
class Warp:
    """Where patches appear in an image."""

    uv: FloatArray  # (n, 2) px, NaN behind the camera
    affine: FloatArray  # (n, 2, 2) A
    bend: FloatArray  # (n, 2) g, 1/px
    depth: FloatArray  # (n,) m in that camera

    @property
    def scale(self) -> FloatArray:
        """Return how much larger patches appear than in their anchor: (n,)."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(np.nan_to_num(self.affine)))))


class LocalMap:
    """Points by row; a row keeps its number until :meth:`forget`."""

    def __init__(self, rig: IdealRig, side: int) -> None:
        self._rig = rig
        self.track_id: IdArray = np.empty(0, np.uint64)
        self._patch: Floats = np.empty((_ROOM, side + 2, side + 2), np.float32)  # of rows to come too: they are large
        self.anchor: IntArray = np.empty(0, np.intp)  # keyframe, by its place in the lists below
        self.uv = np.empty((0, 2))  # in the anchor's image, px
        self.inverse_depth = np.empty(0)  # 1/m, in the anchor; NaN while unknown
        self.sigma = np.empty(0)  # of it, 1/m
        self.slant = np.empty((0, 2))  # s, 1/m a px
        self.last_seen: IntArray = np.empty(0, np.intp)  # keyframe, by its place
        self.keyframe_id: list[int] = []
        self.rotation = np.empty((0, 3, 3))  # map from camera of keyframes
        self.position = np.empty((0, 3))
        self._next_id = 1

    def __len__(self) -> int:
        return len(self.track_id)

    @property
    def patch(self) -> Floats:
        """Return the patch of each point, cut from its anchor's image: (n, side + 2, side + 2)."""
        return self._patch[: len(self)]

    @property
    def known(self) -> BoolArray:
        """Return which points have a depth: (n,)."""
        return np.isfinite(self.inverse_depth)

    def add_keyframe(self, keyframe_id: int, camera_from_map: Transform) -> int:
        """Add a keyframe; return its place."""
        pose = camera_from_map.inverse()
        self.keyframe_id.append(keyframe_id)
        self.rotation = np.concatenate([self.rotation, pose.rotation[None]])
        self.position = np.concatenate([self.position, pose.translation[None]])
        return len(self.keyframe_id) - 1

    def add(self, keyframe: int, uv: FloatArray, patch: Floats) -> IntArray:
        """Add points of unknown depth that a keyframe sees; return their rows."""
        n, before = len(uv), len(self)
        place, nowhere = np.full(n, keyframe, np.intp), np.full(n, np.nan)
        ids = np.arange(self._next_id, self._next_id + n, dtype=np.uint64)
        self._next_id += n
        for name, new in zip(_COLUMNS, (ids, place, uv, nowhere, nowhere, np.zeros((n, 2)), place), strict=True):
            setattr(self, name, np.concatenate([getattr(self, name), new]))
        while len(self) > len(self._patch):
            self._patch = np.concatenate([self._patch, np.empty_like(self._patch)])
        self._patch[before : len(self)] = patch
        return np.arange(before, len(self))

    def place(self, rows: IntArray, inverse_depth: FloatArray, sigma: FloatArray, slant: FloatArray) -> None:
        """Set how far points are from their anchors."""
        self.inverse_depth[rows], self.sigma[rows], self.slant[rows] = inverse_depth, sigma, slant

    def move(self, rows: IntArray, keyframe: int, uv: FloatArray, patch: Floats) -> None:
        """Give points another anchor, from which they are seen better; :meth:`place` them next."""
        self.anchor[rows], self.uv[rows], self._patch[rows] = keyframe, uv, patch

    def points(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return positions in the map (n, 3), m, and one standard deviation of each by its depth, a vector (n, 3)."""
        w = np.maximum(self.inverse_depth[rows], _FAR)
        ray = np.einsum("nij,nj->ni", self.rotation[self.anchor[rows]], self._rig.rays(self.uv[rows]))
        position = self.position[self.anchor[rows]] + ray / w[:, None]
        return position, ray * (self.sigma[rows] / (w * w))[:, None]

    def warp(self, rows: IntArray, camera_from_map: Transform, unknown: float = 0.0) -> Warp:
        """Return where points appear from a camera; those of unknown depth as at the inverse depth ``unknown``."""
        anchor = self.anchor[rows]
        R = camera_from_map.rotation @ self.rotation[anchor]
        t = self.position[anchor] @ camera_from_map.rotation.T + camera_from_map.translation
        w = self.inverse_depth[rows]
        w = np.where(np.isfinite(w), np.maximum(w, 0.0), unknown)
        m = np.einsum("nij,nj->ni", R, self._rig.rays(self.uv[rows])) + t * w[:, None]
        by_p = R[:, :, :2] / self._rig.focal + t[:, :, None] * self.slant[rows][:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(m[:, 2:] > 1e-3, m[:, :2] / m[:, 2:], np.nan)
            affine = (by_p[:, :2] - flat[:, :, None] * by_p[:, 2:]) * (self._rig.focal / m[:, 2])[:, None, None]
            depth = m[:, 2] / np.maximum(w, _FAR)
            bend = by_p[:, 2] / m[:, 2:]
        return Warp(self._rig.focal * flat + self._rig.centre, affine, bend, depth)

    def seen_at(self, rows: IntArray, camera_from_map: Transform, unknown: float = 0.0) -> FloatArray:
        """Return where points appear from a camera as :meth:`warp` does, alone: (n, 2) px, NaN behind it."""
        anchor = self.anchor[rows]
        t = self.position @ camera_from_map.rotation.T + camera_from_map.translation
        w = self.inverse_depth[rows]
        w = np.where(np.isfinite(w), np.maximum(w, 0.0), unknown)
        R = (camera_from_map.rotation @ self.rotation)[anchor].transpose(1, 2, 0)
        x, y = ((self.uv[rows] - self._rig.centre) / self._rig.focal).T
        u, v, z = R[:, 0] * x + R[:, 1] * y + R[:, 2] + t[anchor].T * w
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(z > 1e-3, np.stack([u, v]) / z, np.nan)
        return np.asarray(self._rig.focal * flat.T + self._rig.centre)

    def triangulate(
        self, rows: IntArray, uv: FloatArray, sigma: FloatArray, camera_from_map: Transform, error_px: float
    ) -> BoolArray:
        """Measure how far points are by a camera's motion since their anchors; return those that are wrong: (n,).

        They are seen at uv (n, 2), px, with standard deviations (n,), px, and taken where they fit to so many px.
        """
        anchor = self.anchor[rows]
        R = camera_from_map.rotation @ self.rotation[anchor]
        t = self.position[anchor] @ camera_from_map.rotation.T + camera_from_map.translation
        # q m_z = m_xy with m = R ray + t w, q the ray of now: two equations A w = B.
        q = self._rig.rays(uv)[:, :2]
        turned = np.einsum("nij,nj->ni", R, self._rig.rays(self.uv[rows]))
        A = q * t[:, 2:] - t[:, :2]
        B = turned[:, :2] - q * turned[:, 2:]
        squared = np.maximum((A * A).sum(axis=1), 1e-18)
        w = (A * B).sum(axis=1) / squared
        error = np.linalg.norm(B - A * w[:, None], axis=1) * self._rig.focal
        sigma_w = 2.0 * np.hypot(sigma, 0.3) / (self._rig.focal * np.sqrt(squared))
        good = (error < error_px) & (w > 0.0) & (sigma_w < 0.3 * w)
        good &= ~(self.sigma[rows] < sigma_w)
        self.place(rows[good], w[good], sigma_w[good], np.zeros((int(good.sum()), 2)))
        return np.asarray((error > 3.0 * error_px) | ((w < 0.0) & (sigma_w < 0.1 * np.abs(w))))

    def refine(self, track_id: IdArray, position: FloatArray) -> None:
        """Take positions (n, 3) of points in the map, m."""
        order = np.argsort(track_id, kind="stable")
        at = order[np.clip(np.searchsorted(track_id[order], self.track_id), 0, len(order) - 1)]
        rows = np.flatnonzero(track_id[at] == self.track_id)
        anchor = self.anchor[rows]
        ahead = np.einsum("nj,nj->n", position[at[rows]] - self.position[anchor], self.rotation[anchor][:, :, 2])
        rows, ahead = rows[ahead > 1e-3], ahead[ahead > 1e-3]
        w = 1.0 / ahead
        known = self.known[rows]
        self.slant[rows] *= np.where(known, w / np.where(known, np.maximum(self.inverse_depth[rows], _FAR), 1.0), 0.0)[
            :, None
        ]
        self.inverse_depth[rows] = w
        self.sigma[rows] = np.where(known, self.sigma[rows], 0.1 * w)

    def forget(self) -> IntArray:
        """Forget points that were seen longest ago, if there are too many; return the new row of each, -1 of none."""
        n = len(self)
        new = np.arange(n)
        if n <= _MOST:
            return new
        keep = np.sort(np.argsort(-self.last_seen, kind="stable")[: _MOST * 3 // 4])
        new = np.full(n, -1)
        new[keep] = np.arange(len(keep))
        self._patch[: len(keep)] = self._patch[keep]
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[keep])
        return new
