# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw a solve: where its keyframes look, which were free and which held, how well they fit, who sees the same.

One list of lines for each namespace, always with id 0, so that every message replaces the one before:

===========  ===================================================================================
``free``     keyframes that the solve refined, from green to red by their reprojection error
``fixed``    keyframes that it held, blue
``older``    the other keyframes of the map, grey
``links``    between keyframes that see common points, the brighter the more
===========  ===================================================================================

Lines are thousands of points: the arrays are the message (see ``cdr.py``).
"""

from __future__ import annotations

import numpy as np

from ba_node.arrays import FloatArray, IntArray
from ba_node.config import OutputConfig
from ba_node.core import geometry
from ba_node.estimate import Estimate, Poses, WindowView
from ba_node.messages.cdr import Cdr

NAMESPACES = ("free", "fixed", "older", "links")
# Values of visualization_msgs/Marker.
_LINE_LIST, _ADD, _DELETE, _DELETE_ALL = 5, 0, 2, 3
_WIDTH_M = {"free": 0.01, "fixed": 0.01, "older": 0.005, "links": 0.003}
_BLUE, _GREY, _UNKNOWN = (0.25, 0.5, 1.0, 1.0), (0.6, 0.6, 0.6, 0.6), (1.0, 0.0, 1.0, 1.0)
# From the centre to the corners, and around.
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]]).ravel()
# Opacity of a link with hardly a common point.
_FAINTEST = 0.05


def marker_array(estimate: Estimate, config: OutputConfig, *, clear: bool) -> bytes:
    """Return a ``visualization_msgs/MarkerArray`` of an estimate with its view.

    ``clear`` takes away everything that was drawn before, as another map begins.

    Raises:
        ConversionError: the seconds of the stamp exceed 32 bits.
    """
    view = estimate.view
    assert view is not None
    lines = _lines(estimate, view, config)
    out = Cdr()
    out.pack("I", len(lines) + clear)
    if clear:
        _marker(out, estimate, "", _DELETE_ALL, np.empty((0, 3)), np.empty((0, 4)))
    for name, (points, colours) in lines.items():
        _marker(out, estimate, name, _ADD if len(points) else _DELETE, points, colours)
    return out.data()


def no_markers(estimate: Estimate) -> bytes:
    """Return a ``visualization_msgs/MarkerArray`` that takes everything away that was drawn before."""
    out = Cdr()
    out.pack("I", 1)
    _marker(out, estimate, "", _DELETE_ALL, np.empty((0, 3)), np.empty((0, 4)))
    return out.data()


def _lines(estimate: Estimate, view: WindowView, config: OutputConfig) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return the ends of lines (n, 3), m, and their colours (n, 4) for each namespace."""
    refined = estimate.refined
    limit = config.markers_max_keyframes
    newest = np.arange(len(refined)) >= len(refined) - limit
    others = estimate.trajectory[~np.isin(estimate.trajectory.keyframe_id, refined.keyframe_id)]
    older = others[-(limit - len(refined)) :] if len(refined) < limit else others[:0]
    free, fixed = newest & view.free, newest & ~view.free
    most = np.argsort(-view.shared, kind="stable")[: config.markers_max_links]
    drawn = most[newest[view.links[most]].all(axis=1)]
    return {
        "free": _frusta(refined[free], view, config, _by_error(view.rms_px[free], config.markers_rms_px)),
        "fixed": _frusta(refined[fixed], view, config, np.array([_BLUE])),
        "older": _frusta(older, view, config, np.array([_GREY])),
        "links": _links(refined, view, drawn),
    }


def _frusta(poses: Poses, view: WindowView, config: OutputConfig, colour: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lines of all cameras of some keyframes; colour (n, 4), or (1, 4) for all."""
    centre = view.frusta[:, :1]
    in_body = (centre + config.markers_frustum_m * (view.frusta - centre))[:, _EDGES].reshape(-1, 3)
    rotation = geometry.matrix_from_quaternion(poses.orientation)
    points = in_body @ np.swapaxes(rotation, 1, 2) + poses.position[:, None, :]
    colours = np.broadcast_to(colour[:, None, :], (len(poses), len(in_body), 4))
    return points.reshape(-1, 3), colours.reshape(-1, 4)


def _links(poses: Poses, view: WindowView, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    points = poses.position[view.links[rows]].reshape(-1, 3)
    colours = np.ones((len(points), 4))
    share = view.shared[rows] / max(int(view.shared.max(initial=1)), 1)
    # Squared: nearly all keyframes of a window share something, and what matters would not stand out.
    colours[:, 3] = np.repeat(_FAINTEST + (1.0 - _FAINTEST) * share * share, 2)
    return points, colours


def _by_error(rms_px: FloatArray, red_px: float) -> FloatArray:
    """Return green for 0, yellow for half and red for all of ``red_px``; magenta where the error is not known."""
    share = np.clip(rms_px / red_px, 0.0, 1.0)
    colours = np.stack([np.minimum(1.0, 2.0 * share), np.minimum(1.0, 2.0 - 2.0 * share)], axis=1)
    out = np.concatenate([colours, np.zeros_like(colours[:, :1]), np.ones_like(colours[:, :1])], axis=1)
    out[np.isnan(rms_px)] = _UNKNOWN
    return out


def _marker(out: Cdr, estimate: Estimate, name: str, action: int, points: FloatArray, colours: FloatArray) -> None:
    """Append a ``visualization_msgs/Marker``, field by field in the order of its definition."""
    out.header(estimate.stamp_ns, estimate.frame_id)
    out.text(name)
    out.pack("iii", 0, _LINE_LIST, action)
    # pose, scale (x: width of the lines)
    out.pack("7d", 0, 0, 0, 0, 0, 0, 1)
    out.pack("3d", _WIDTH_M.get(name, 0.0), 0, 0)
    # colour, lifetime, frame_locked
    out.pack("4f", 1, 1, 1, 1)
    out.pack("iI?", 0, 0, False)
    out.sequence(points.astype("<f8"))
    out.sequence(colours.astype("<f4"))
    out.text("")
    # texture: header, format, data; uv_coordinates, text, mesh_resource
    out.header(0, "")
    out.text("")
    out.pack("II", 0, 0)
    out.text("")
    out.text("")
    # mesh_file: name, data; mesh_use_embedded_materials
    out.text("")
    out.pack("I?", 0, False)
