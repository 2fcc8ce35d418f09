# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read what rtabmap_odom (`odom_info` with `odom`) and rtabmap_slam (`mapData`) publish, as their sources have it.

Ids of ``odom_info`` are words of the local map (F2M odometry). A feature that matched none has an id too, which the
next image gives to another one; so a row counts only if its word is in the local map (if that is told), and if it was
matched, as an inlier. Its lists are there only with ``Odom/FillInfoData``, cameras only with local bundle adjustment.
After a reset the covariance of ``odom`` is 9999, and words begin anew; while it is lost, its pose is null.

Ids of ``mapData`` are words of the vocabulary: two features of one image may have the same one, and are left out.
Poses of its nodes are the odometry's. A node comes again when somebody subscribes, and may come without its words.

Images of several cameras lie side by side in one, pixels are those of rectified images, ``k`` is that of ``p``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from ba_node.arrays import BoolArray, FloatArray
from ba_node.measurements import CameraRig
from ba_node.messages.adapters.sources import (
    ODOMETRY,
    Features,
    Input,
    LayoutError,
    Piece,
    Pose,
    Source,
    nowhere,
    pose,
    xyz,
    xyzw,
)
from ba_node.messages.conversion import rig_from_parts
from ba_node.messages.factory import NS_PER_S, stamp_ns_from_message

BODY, FIXED = "base_link", "odom"
# What rtabmap says of a pose that has nothing to do with the one before.
BAD_COVARIANCE = 9999.0
_F2F = 1


class Rtabmap(Source):
    """``rtabmap_odom``: every image; keyframes of its own are taken too."""

    inputs = (
        Input("odom", ODOMETRY, "pose"),
        Input("odom_info", "rtabmap_msgs/msg/OdomInfo", "features"),
    )
    every_image = True
    max_id = 2**31

    def __init__(self, cameras: int = 1) -> None:
        super().__init__(cameras)
        self._session = 0
        self._begun = False
        self._width = 0

    def read(self, name: str, message: Any) -> Iterator[Piece]:
        """Yield what a message says."""
        if name == "odom":
            if not xyzw(message.pose.pose.orientation).any():  # publish_null_when_lost
                raise LayoutError("the odometry is lost", "lost")
            bad = message.pose.covariance[0] >= BAD_COVARIANCE
            self._session += bool(bad and self._begun)
            self._begun = self._begun or not bad
            yield pose(message, self._session)
            return
        if _list(message, "lost", False):
            raise LayoutError("the odometry is lost", "lost")
        for models in _list(message, "local_bundle_models")[-1:]:
            cameras = [model.camera_info for model in models.models]
            yield from self._rig(cameras, [model.local_transform for model in models.models])
        yield self._features(message)

    def _rig(self, cameras: Sequence[Any], places: Sequence[Any]) -> Iterator[CameraRig]:
        rig = rig_of(cameras, places)
        if rig is not None:
            self.cameras, self._width = len(rig), int(rig.image_size[0, 0])
            yield rig

    def _features(self, info: Any) -> Features:
        ids = np.array(info.words_keys, np.float64).reshape(-1)
        if not len(ids):
            is_f2f = _list(info, "type", 0) == _F2F
            why = "F2F odometry has no ids: Odom/Strategy 0" if is_f2f else "set Odom/FillInfoData true"
            raise LayoutError(f"no words: {why}", "no_words")
        if len(info.words_values) != len(ids):
            raise LayoutError(f"{len(ids)} words_keys and {len(info.words_values)} words_values")
        uv, camera = side_by_side(info.words_values, self.cameras, self._width)
        known, point = _in_local_map(info, ids)
        matches, inliers = (np.array(_list(info, name)) for name in ("word_matches", "word_inliers"))
        agrees = np.isin(ids, inliers) | (~np.isin(ids, matches) if len(matches) or not len(inliers) else False)
        return Features(
            stamp_ns_from_message(info.header.stamp),
            ids,
            uv,
            camera,
            normalised=nowhere(len(ids), 2),
            point=point,
            wrong={
                "ambiguous_word": repeated(ids, camera),
                "not_in_the_local_map": ~known,
                "outlier_of_the_source": ~agrees,
            },
            is_keyframe=bool(_list(info, "key_frame_added", False)),
        )


class RtabmapMap(Source):
    """``rtabmap_slam``: the nodes of its map."""

    inputs = (Input("mapData", "rtabmap_msgs/msg/MapData", "pose"), Input("mapData", "", "features"))
    max_id = 2**31

    def read(self, name: str, message: Any) -> Iterator[Piece]:
        """Yield what a message says."""
        del name
        for node in message.nodes:
            yield from self._node(node)

    def _node(self, node: Any) -> Iterator[Piece]:
        ids = np.array(node.word_id_keys, np.float64).reshape(-1)
        rows = np.array(node.word_id_values, np.int64).reshape(-1)
        n = len(node.word_kpts)
        if not len(ids) or not n:
            return  # of the graph alone
        if len(rows) != len(ids) or ((rows < 0) | (rows >= n)).any():
            raise LayoutError(f"node {node.id}: {len(ids)} words, {len(rows)} indices, {n} keypoints do not fit")
        rig = rig_of(node.data.left_camera_info, node.data.local_transform)
        if rig is not None:
            yield rig
        width = 0 if rig is None else int(rig.image_size[0, 0])
        uv, camera = side_by_side(node.word_kpts, 1 if rig is None else len(rig), width)
        point = points(node.word_pts) if len(node.word_pts) == n else nowhere(n, 3)
        stamp_ns = round(node.stamp * NS_PER_S)
        at = node.pose
        yield Pose(stamp_ns, FIXED, xyz(at.position), xyzw(at.orientation), int(node.id), int(node.map_id))
        yield Features(
            stamp_ns,
            ids,
            uv[rows],
            camera[rows],
            normalised=nowhere(len(ids), 2),
            point=point[rows],
            point_in_body=True,
            # That of a disparity is good near and bad far away.
            has_depth=not len(_list(node.data, "right_camera_info")),
            wrong={"no_word": ids <= 0, "ambiguous_word": repeated(ids, camera[rows])},
        )


def _list(message: Any, name: str, default: Any = ()) -> Any:
    """Return a field that versions, or recordings that were thinned out, may lack."""
    return getattr(message, name, default)


def _in_local_map(info: Any, ids: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Return which words are in the local map, (n,), and their points, (n, 3); without a local map all may be."""
    keys, values = np.array(_list(info, "local_map_keys"), np.float64), _list(info, "local_map_values")
    if len(values) != len(keys):
        raise LayoutError(f"{len(keys)} local_map_keys and {len(values)} local_map_values")
    if not len(keys):
        return np.ones(len(ids), bool), nowhere(len(ids), 3)
    order = np.argsort(keys, kind="stable")
    row = order[np.searchsorted(keys, ids, sorter=order).clip(max=len(keys) - 1)]
    known = keys[row] == ids
    return known, np.where(known[:, None], points(values)[row], np.nan)


def rig_of(cameras: Sequence[Any], places: Sequence[Any]) -> CameraRig | None:
    """Return the rig of CameraInfos and transforms body from camera; None without cameras, or with unknown places."""
    if not len(cameras) or len(places) != len(cameras):
        return None
    poses = [SimpleNamespace(position=place.translation, orientation=place.rotation) for place in places]
    rig = rig_from_parts(BODY, cameras, poses)
    return dataclasses.replace(rig, names=tuple(name or f"camera{i}" for i, name in enumerate(rig.names)))


def side_by_side(keypoints: Sequence[Any], cameras: int, width: int) -> tuple[FloatArray, Any]:
    """Return pixels (n, 2) and camera (n,) of keypoints in an image of several cameras side by side."""
    uv = np.array([(k.pt.x, k.pt.y) for k in keypoints], np.float64).reshape(-1, 2)
    camera = np.zeros(len(uv), np.int64)
    if cameras > 1 and width:
        camera = np.clip(np.nan_to_num(uv[:, 0] // width), 0, cameras - 1).astype(np.int64)
        uv[:, 0] -= camera * width
    return uv, camera


def points(values: Sequence[Any]) -> FloatArray:
    """Return points, (n, 3)."""
    return np.array([(p.x, p.y, p.z) for p in values], np.float64).reshape(-1, 3)


def repeated(ids: FloatArray, camera: Any) -> BoolArray:
    """Return the rows whose id another row of the same camera has too."""
    _, row, count = np.unique(np.column_stack([camera, ids]), axis=0, return_inverse=True, return_counts=True)
    return np.asarray(count[row.reshape(-1)] > 1, bool)
