# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Copy a scene into plain arrays and facts, and build a scene from them that goes on as the first would have.

What follows from the rest (links between the views of a landmark, counts of views, ids to rows) is not copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.config import SceneConfig
from ba_node.core.cameras import N_PARAMS, Model
from ba_node.core.problem import Cameras
from ba_node.measurements import FeatureTracks
from ba_node.scene import ingest, saved_constraints
from ba_node.scene.map_content import (
    MapContent,
    prefixed,
    require,
    require_all,
    require_index,
    require_rotations,
    require_unique,
    within,
)
from ba_node.scene.records import Block, Keyframes, Landmarks, ObservationTable
from ba_node.scene.rejections import NOTES_KEPT, NOTICES, REASONS, WARNINGS, RejectionLog
from ba_node.scene.scene import Scene
from ba_node.scene.tables import Column, Table

_DERIVED = ("last", "views", "previous")
_TABLES: dict[str, type[Table]] = {"keyframes": Keyframes, "landmarks": Landmarks, "observations": ObservationTable}
_CAMERAS = {
    "rotation": Column(np.float64, (3, 3)),
    "translation": Column(np.float64, (3,)),
    "model": Column(np.uint8),
    "params": Column(np.float64, (N_PARAMS,)),
}
_BLOCKS = {name: Column(np.int64) for name in ("keyframe", "camera", "begin", "end")}
_PENDING = {"keyframe_id": Column(np.uint64), "camera": Column(np.int64), "count": Column(np.int64)}
_PENDING_ROWS = {
    "track_id": Column(np.uint64),
    "uv": Column(np.float64, (2,)),
    "sigma_px": Column(np.float64),
    "depth_m": Column(np.float64),
}
# Nothing that was ever published lies farther out: a refined pose or point, a number of a camera, a stamp.
_MAX_REFINED_M = 2 * ingest.MAX_POSITION_M
_MAX_POINT_M = 1e15
_MAX_PARAMETER = 1e9
_STAMP_END_NS = 2**31 * 10**9


def take(scene: Scene) -> MapContent:
    """Return a copy of all that a scene holds; later changes of the scene do not reach it."""
    arrays: dict[str, NDArray[Any]] = {}
    for group, kind in _TABLES.items():
        arrays |= prefixed(group, ((name, getattr(getattr(scene, group), name)) for name in _saved(kind)))
    for group, cameras in (("cameras", scene.cameras), ("next_cameras", scene.next_cameras)):
        if cameras is not None:
            arrays |= prefixed(group, ((name, getattr(cameras, name)) for name in _CAMERAS))
    blocks = [(row, *block) for row, of_row in enumerate(scene.blocks) for block in of_row]
    arrays |= prefixed("blocks", zip(_BLOCKS, np.array(blocks, np.int64).reshape(-1, len(_BLOCKS)).T, strict=True))
    arrays |= _pending_arrays(scene.pending)
    facts = {
        "session_id": scene.session_id,
        "frame_id": scene.frame_id,
        "rejected": dict(sorted(scene.log.rejected.items())),
        "notices": dict(sorted(scene.log.notices.items())),
        "rejection_notes": list(scene.log.notes),
        "warnings": dict(scene.log.warnings),
    }
    beside = saved_constraints.take(scene.constraints)
    return MapContent(arrays | beside.arrays, facts | beside.facts)


def build(content: MapContent, config: SceneConfig) -> Scene:
    """Return a scene with this content.

    Raises:
        MapError: it is not a whole and consistent map.
    """
    session_id = content.fact("session_id", (int, type(None)))
    require(session_id is None or 0 <= session_id < 2**32, f"session_id = {session_id}, expected 32 bits")
    scene = Scene(config, session_id)
    scene.frame_id = content.fact("frame_id", str)
    scene.cameras, scene.next_cameras = _cameras(content, "cameras"), _cameras(content, "next_cameras")
    columns = {group: content.columns(group, _saved(kind)) for group, kind in _TABLES.items()}
    n = {group: len(next(iter(found.values()))) for group, found in columns.items()}
    _check_keyframes(columns["keyframes"])
    _check_landmarks(columns["landmarks"])
    _check_observations(columns["observations"], n, 0 if scene.cameras is None else len(scene.cameras.model))
    for group, found in columns.items():
        getattr(scene, group).append(n[group], **found)
    scene.blocks = _blocks(content, columns["observations"], n)
    scene.pending = _pending(content, session_id)
    _restore_log(content, scene)
    saved_constraints.restore(content, scene.constraints)
    scene.index()
    return scene


def _saved(kind: type[Table]) -> dict[str, Column]:
    return {name: column for name, column in kind.COLUMNS.items() if name not in _DERIVED}


def _cameras(content: MapContent, group: str) -> Cameras | None:
    if not any(name.startswith(f"{group}/") for name in content.arrays):
        return None
    found = content.columns(group, _CAMERAS)
    require(len(found["model"]), f"{group}: no camera in it")
    require_rotations(found["rotation"], f"{group}/rotation")
    translation, limit = found["translation"], _MAX_REFINED_M
    require_all(within(translation, limit), f"{group}/translation", translation, f"at most {limit:g} m")
    known = np.array([int(model) for model in Model])
    require_all(np.isin(found["model"], known), f"{group}/model", found["model"], f"one of {known.tolist()}")
    good = within(found["params"], _MAX_PARAMETER) & (found["params"][:, :2] > 0).all(axis=1)
    require_all(good, f"{group}/params", found["params"], f"at most {_MAX_PARAMETER:g}, with fx, fy > 0")
    return Cameras(**{name: np.array(values) for name, values in found.items()})


def _check_keyframes(found: Mapping[str, NDArray[Any]]) -> None:
    require_unique(found["keyframe_id"], "keyframes/keyframe_id")
    stamp_ns = found["stamp_ns"]
    good = (stamp_ns >= -_STAMP_END_NS) & (stamp_ns < _STAMP_END_NS)
    require_all(good, "keyframes/stamp_ns", stamp_ns, "seconds of 32 bits, as messages have")
    for prefix in ("", "input_"):
        require_rotations(found[f"{prefix}rotation"], f"keyframes/{prefix}rotation")
        position = found[f"{prefix}position"]
        limit = ingest.MAX_POSITION_M if prefix else _MAX_REFINED_M
        require_all(within(position, limit), f"keyframes/{prefix}position", position, f"at most {limit:g} m")


def _check_landmarks(found: Mapping[str, NDArray[Any]]) -> None:
    require_unique(found["track_id"], "landmarks/track_id")
    for name in ("position", "guess"):
        good = within(found[name], _MAX_POINT_M) | ~found[f"has_{name}"]
        require_all(good, f"landmarks/{name}", found[name], f"at most {_MAX_POINT_M:g} m where has_{name}")


def _check_observations(found: Mapping[str, NDArray[Any]], n: Mapping[str, int], n_cameras: int) -> None:
    for name, limit in (("keyframe", n["keyframes"]), ("landmark", n["landmarks"]), ("camera", n_cameras)):
        require_index(found[name], limit, f"observations/{name}")
    require_all(
        within(found["uv"], ingest.MAX_PIXEL), "observations/uv", found["uv"], f"at most {ingest.MAX_PIXEL:g} px"
    )
    sigma, depth = found["sigma_px"], found["depth_m"]
    good = (sigma > 0) & (sigma <= ingest.SIGMA_RANGE[1])
    require_all(good, "observations/sigma_px", sigma, f"a number > 0, at most {ingest.SIGMA_RANGE[1]:g}")
    good = np.isnan(depth) | ((depth > 0) & (depth <= ingest.DEPTH_RANGE_M[1]))
    require_all(good, "observations/depth_m", depth, f"NaN or a number > 0, at most {ingest.DEPTH_RANGE_M[1]:g}")
    where = found["keyframe"].astype(np.int64) * max(n_cameras, 1) + found["camera"]
    require_unique(where * max(n["landmarks"], 1) + found["landmark"], "observations: keyframe, camera and landmark")


def _blocks(content: MapContent, seen: Mapping[str, NDArray[Any]], n: Mapping[str, int]) -> list[list[Block]]:
    found = content.columns("blocks", _BLOCKS)
    require_index(found["keyframe"], n["keyframes"], "blocks/keyframe")
    begin, end = found["begin"], found["end"]
    require_all(
        (begin >= 0) & (begin <= end) & (end <= n["observations"]), "blocks/begin", begin, "rows of observations"
    )
    order = np.argsort(begin, kind="stable")
    order = order[end[order] > begin[order]]
    length = (end - begin)[order]
    whole = len(order) == 0 or (begin[order[0]] == 0 and bool((begin[order[1:]] == end[order[:-1]]).all()))
    require(whole and length.sum() == n["observations"], "blocks do not cover the rows of observations once each")
    for name in ("keyframe", "camera"):
        stored = np.repeat(found[name][order], length)
        require(np.array_equal(stored, seen[name]), f"blocks/{name} contradicts observations/{name}")
    blocks: list[list[Block]] = [[] for _ in range(n["keyframes"])]
    for row, *block in zip(*(found[name].tolist() for name in _BLOCKS), strict=True):
        blocks[row].append(Block(*block))
    return blocks


def _pending_arrays(pending: list[FeatureTracks]) -> dict[str, NDArray[Any]]:
    heads = {
        "keyframe_id": np.array([tracks.keyframe_id for tracks in pending], np.uint64),
        "camera": np.array([tracks.camera_index for tracks in pending], np.int64),
        "count": np.array([len(tracks.track_id) for tracks in pending], np.int64),
    }
    empty = {name: np.empty((0, *column.shape), column.dtype) for name, column in _PENDING_ROWS.items()}
    rows = {name: np.concatenate([empty[name], *(getattr(tracks, name) for tracks in pending)]) for name in empty}
    return prefixed("pending", heads.items()) | prefixed("pending_rows", rows.items())


def _pending(content: MapContent, session_id: int | None) -> list[FeatureTracks]:
    heads, rows = content.columns("pending", _PENDING), content.columns("pending_rows", _PENDING_ROWS)
    count = heads["count"]
    require_all(count >= 0, "pending/count", count, "a count")
    require(count.sum() == len(rows["track_id"]), f"pending_rows has {len(rows['track_id'])} rows, not {count.sum()}")
    require(session_id is not None or not len(count), "tracks wait, but the map has no session_id")
    waiting = []
    begin = 0
    for key, camera, n in zip(*(heads[name].tolist() for name in _PENDING), strict=True):
        ids, uv, sigma_px, depth_m = (np.array(rows[name][begin : begin + n]) for name in _PENDING_ROWS)
        tracks = FeatureTracks(session_id or 0, key, camera, ids, uv, sigma_px, depth_m)
        clean = ingest.clean_tracks(tracks, RejectionLog())
        require(clean is not None and len(clean.track_id) == n, f"pending_rows: tracks of keyframe {key} are not sound")
        waiting.append(tracks)
        begin += n
    return waiting


def _restore_log(content: MapContent, scene: Scene) -> None:
    for name, known, counter in (("rejected", REASONS, scene.log.rejected), ("notices", NOTICES, scene.log.notices)):
        # A reason of another version of ba_node is dropped: its name could not be explained.
        counter.update({key: n for key, n in content.counts(name).items() if key in known})
    notes = content.fact("rejection_notes", list)
    require(all(isinstance(note, str) for note in notes), "rejection_notes: expected texts")
    scene.log.notes.extend(notes[-NOTES_KEPT:])
    # Maps of the first version have none.
    warnings = content.fact("warnings", dict) if "warnings" in content.facts else {}
    require(all(isinstance(text, str) for text in warnings.values()), "warnings: expected texts")
    scene.log.warnings.update({kind: text for kind, text in warnings.items() if kind in WARNINGS})
