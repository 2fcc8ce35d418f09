# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the results of replays: each figure is data and layout as plotly.js takes them.

The first run has the colours of before and after; where several stand side by side each has a colour of its own.
Colours are those of Okabe and Ito, told apart by colour-blind readers.
"""

from __future__ import annotations

import base64
import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import AbsoluteError, absolute_error
from ba_node.offline import viewpoint
from ba_node.offline.page import Figure
from ba_node.offline.run_folder import BINS, PARALLAX_DEG, Comparison, Run

TRUTH, BEFORE, CLOUD = "#000000", "#D55E00", "#9AA0A6"
COLOURS = ("#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442")
_BAD = {"HELD": "#E69F00", "FAILED": "#D55E00", "SKIPPED": "#9AA0A6"}
# Points that are drawn at most, in space and from above, and residuals.
_POINTS, _ABOVE, _ARROWS, _CAMERAS = 100_000, 6_000, 3_000, 4
# Length of a drawn residual: the 90th percentile takes this share of the image's width.
_ARROW_SHARE = 0.02


def figures(runs: Sequence[Run]) -> list[Figure]:
    """Return all figures that there is something to draw for."""
    shown = [_ShownRun(run, COLOURS[n % len(COLOURS)], several=len(runs) > 1) for n, run in enumerate(runs)]
    found = [make(shown) for make in _FIGURES]
    return [figure for figure in found if figure.data]


def trajectory_figures(comparison: Comparison) -> tuple[list[Figure], str]:
    """Return the way from above and the error over time, and in words how large the error is."""
    shown = _Shown(comparison, COLOURS[0])
    found = [figure for figure in (_above([shown]), _over_time([shown])) if figure.data]
    if shown.after is None:
        return found, "Trajectory before and after adjustment"
    change = f"{shown.after.translation.rmse:.3f} m"
    if shown.before is not None:
        change = f"{shown.before.translation.rmse:.3f} m before, {change} after adjustment"
    return found, f"Trajectory error (RMSE, {comparison.kind} alignment): {change}"


class _Shown:
    """Trajectories and cloud in their colour, with their errors."""

    body_from_camera: FloatArray | None = None

    def __init__(self, comparison: Comparison, colour: str, *, several: bool = False) -> None:
        self.poses, self.colour, self.several = comparison, colour, several
        self.before, self.after = (self._error(poses) for poses in (comparison.before, comparison.after))

    def _error(self, poses: Poses | None) -> AbsoluteError | None:
        if poses is None or self.poses.truth is None:
            return None
        try:
            return absolute_error(poses, self.poses.truth, self.poses.kind)
        except EvaluationError:
            return None

    def name(self, what: str) -> str:
        return f"{self.poses.name}: {what}" if self.several else what

    def seconds(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        return np.asarray((stamp_ns - self.poses.after.stamp_ns[0]) * 1e-9)

    @property
    def cloud(self) -> FloatArray:
        """Return the points that all but 1 % along each axis span: strays must not shrink the picture."""
        cloud = _aligned(self.poses.cloud, self.after)
        if not len(cloud):
            return cloud
        low, high = np.percentile(cloud, [0.5, 99.5], axis=0)
        return np.asarray(cloud[((cloud >= low) & (cloud <= high)).all(axis=1)])

    @property
    def up(self) -> FloatArray:
        """Return which way is up in the picture, (3,)."""
        up = viewpoint.upwards(self.poses.after, self.body_from_camera)
        return up if self.after is None else np.asarray(self.after.alignment.rotation @ up)

    @property
    def paths(self) -> list[tuple[str, FloatArray, str, str]]:
        """Return name, positions, colour and dash of the trajectories, in the frame of the truth if there is one."""
        of = self.poses
        found = []
        if of.truth is not None and self.after is not None:
            found.append(("reference", of.truth.position, TRUTH, "dot"))
        if of.before is not None and not self.several:
            found.append(("before", _aligned(of.before.position, self.before), BEFORE, "dash"))
        name = "estimate" if of.before is None else "after"
        return [*found, (name, _aligned(of.after.position, self.after), self.colour, "solid")]


class _ShownRun(_Shown):
    """A run in its colour."""

    def __init__(self, run: Run, colour: str, *, several: bool) -> None:
        super().__init__(run, colour, several=several)
        self.run, self.details = run, run.details
        self.body_from_camera = run.details.get("body_from_camera")
        self.solve_s = self.seconds(run.details["solve_stamp_ns"])


def _aligned(points: FloatArray, error: AbsoluteError | None) -> FloatArray:
    return points if error is None else error.alignment.apply(points)


def line(x: Any, y: Any, name: str, colour: str, **more: Any) -> dict[str, Any]:
    """Return a trace of lines and markers."""
    style: dict[str, Any] = {"line": {"color": colour, "width": 1.8}, "marker": {"color": colour, "size": 4}}
    return (
        {"type": "scatter", "mode": "lines+markers", "x": np.asarray(x, float), "y": np.asarray(y, float), "name": name}
        | style
        | more
    )


def _above(shown: Sequence[_Shown]) -> Figure:
    data: list[dict[str, Any]] = []
    across, up, turned = viewpoint.page(shown[0].up, [path for one in shown for _, path, _, _ in one.paths])
    for number, one in enumerate(shown):
        cloud = _few(one.cloud, _ABOVE)
        if len(cloud) and number == 0:
            style = {"mode": "markers", "marker": {"color": CLOUD, "size": 3, "opacity": 0.6}, "hoverinfo": "skip"}
            data.append(line(cloud[:, across], cloud[:, up], "map", CLOUD, **style))
        for name, path, colour, dash in one.paths:
            if name != "reference" or number == 0:
                drawn = line(path[:, across], path[:, up], one.name(name), colour)
                data.append(drawn | {"line": {"color": colour, "width": 2, "dash": dash}})
    layout = {name: {"title": f"{'xyz'[axis]} [m]"} for name, axis in (("xaxis", across), ("yaxis", up))}
    layout["yaxis"] |= {"scaleanchor": "x"} | ({"autorange": "reversed"} if turned else {})
    return Figure("above", "From above", "Trajectories, and points of the map.", data, layout)


def _space(shown: Sequence[_Shown]) -> Figure:
    data: list[dict[str, Any]] = []
    for number, one in enumerate(shown):
        cloud = _few(one.cloud, _POINTS)
        for name, path, colour, dash in one.paths:
            if name != "reference" or number == 0:
                style = {"mode": "lines", "line": {"color": colour, "width": 5, "dash": dash}}
                data.append(_in_space(path, one.name(name)) | style)
        if len(cloud):
            marker = {"color": CLOUD if number == 0 else one.colour, "size": 1.5, "opacity": 0.6}
            data.append(_in_space(cloud, one.name("map")) | {"mode": "markers", "marker": marker, "hoverinfo": "skip"})
    vertical = viewpoint.seen_from(shown[0].up)[2]
    sign, name = -1 if shown[0].up[vertical] < 0.0 else 1, "xyz"[vertical]
    camera: dict[str, Any] = {"up": dict.fromkeys("xyz", 0) | {name: sign}}
    camera["eye"] = {"x": 1.3, "y": -1.3, "z": 1.3} | {name: 1.3 * sign}
    axes = {f"{axis}axis": {"title": f"{axis} [m]"} for axis in "xyz"}
    note = f" {_POINTS} of its points are drawn." if any(len(one.poses.cloud) > _POINTS for one in shown) else ""
    text = f"Drag to turn. Strays of the map, one point in a hundred along each axis, are left out.{note}"
    return Figure("space", "In space", text, data, {"scene": axes | {"aspectmode": "data", "camera": camera}})


def _in_space(points: FloatArray, name: str) -> dict[str, Any]:
    return {"type": "scatter3d", "name": name} | dict(zip("xyz", points.T, strict=True))


def _over_time(shown: Sequence[_Shown]) -> Figure:
    data = []
    for one in shown:
        for name, error, colour in (("before", one.before, BEFORE), ("after", one.after, one.colour)):
            if error is not None and not (name == "before" and one.several):
                data.append(line(one.seconds(error.stamp_ns), error.translation_m, one.name(name), colour))
    layout = {"xaxis": {"title": "time [s]"}, "yaxis": {"title": "position error [m]", "type": "log"}}
    text = "Distance of each keyframe to the reference, after SE(3) alignment."
    if not data:
        for one in shown:
            after, before = one.poses.after, one.poses.before
            if before is not None and len(before) == len(after):
                moved = np.linalg.norm(after.position - before.position, axis=1)
                data.append(line(one.seconds(after.stamp_ns), moved, one.name("moved"), one.colour))
        layout["yaxis"] = {"title": "moved by [m]", "rangemode": "tozero"}
        text = "No reference to compare with: how far the adjustment moved each keyframe."
    return Figure("error", "Error over time", text, data, layout)


def _of_solves(shown: Sequence[_ShownRun], what: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return a figure of each solve: before it, unless several runs are shown, and after it; 0 is none."""
    data = []
    for one in shown:
        for name, colour in (("before", BEFORE), ("after", one.colour))[one.several :]:
            values = one.details[f"{what}_{name}"] if len(one.solve_s) else np.empty(0)
            if values.any():
                data.append(line(one.solve_s, np.where(values > 0.0, values, np.nan), one.name(name), colour))
    return data, {"xaxis": {"title": "time [s]"}, "yaxis": {"type": "log"}}


def _objective(shown: Sequence[_ShownRun]) -> Figure:
    text = "The cost at its start and at its end."
    return Figure("objective", "Objective of each solve", text, *_of_solves(shown, "objective"))


def _held_out(shown: Sequence[_ShownRun]) -> Figure:
    text = "Median residual [px] of tracks that took no part in a solve, by the front-end's poses and by the solution."
    return Figure("held_out", "Tracks held out", text, *_of_solves(shown, "held_out_px"))


def _arrows(shown: Sequence[_ShownRun]) -> Figure:
    """Draw the residuals of the first run as vectors, for each camera; on images those of one keyframe."""
    details = shown[0].details
    images = {camera: details[f"image_{camera}"] for camera in range(_CAMERAS) if f"image_{camera}" in details}
    cameras = sorted(images) or np.unique(details["camera"])[:_CAMERAS].tolist()
    chosen = np.isin(details["camera"], cameras)
    if images:
        chosen &= details["keyframe"] == details["shown_keyframe"]
    uv, error, outlier = details["uv"][chosen], details["error"][chosen], details["outlier"][chosen]
    text, scale = "Predicted minus measured", 1.0
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    if len(uv):
        length = float(np.percentile(np.linalg.norm(error[~outlier], axis=1), 90)) if (~outlier).any() else 1.0
        scale = max(1.0, round(_ARROW_SHARE * float(np.ptp(uv[:, 0])) / max(length, 1e-3)))
    for place, camera in enumerate(cameras if len(uv) else ()):
        own = details["camera"][chosen] == camera
        axis = str(place + 1) if place else ""
        for left_out, name, colour in (
            (False, "inliers", "#E69F00" if images else shown[0].colour),
            (True, "outliers", BEFORE),
        ):
            rows = _few(np.flatnonzero(own & (outlier == left_out)), _ARROWS // len(cameras))
            end = uv[rows] + (1.0 if left_out else scale) * error[rows]
            x, y = (_segments(uv[rows, k], end[:, k]) for k in (0, 1))
            drawn = line(x, y, name, colour, mode="lines", xaxis=f"x{axis}", yaxis=f"y{axis}")
            drawn |= {"line": {"color": colour, "width": 1.3}, "showlegend": place == 0, "legendgroup": name}
            data.append(drawn | {"visible": "legendonly" if left_out else True})
        layout |= _image_axes(axis, place, camera, len(cameras), uv)
    if images:
        text += ", in the keyframe that sees the most"
        layout["images"] = [_picture(images[camera], place) for place, camera in enumerate(cameras)]
    text += f"; inliers {scale:g} times as long as they are. A click on outliers shows them."
    text += f" Of {shown[0].run.name}." if len(shown) > 1 else ""
    return Figure("residuals", "Reprojection errors in the image", text, data, layout, wide=True)


def _image_axes(axis: str, place: int, camera: int, count: int, uv: FloatArray) -> dict[str, Any]:
    """Return the axes of one image of several side by side."""
    low, high = uv.min(axis=0), uv.max(axis=0)
    domain = [place / count, (place + 1) / count - (0.04 if count > 1 else 0.0)]
    across = {"title": f"u [px], camera {camera}", "domain": domain, "range": [float(low[0]), float(high[0])]}
    down = {"title": "v [px]" if place == 0 else "", "anchor": f"x{axis}", "scaleanchor": f"x{axis}"}
    return {f"xaxis{axis}": across, f"yaxis{axis}": down | {"range": [float(high[1]), float(low[1])]}}


def _picture(grey: NDArray[np.uint8], place: int) -> dict[str, Any]:
    """Return an image (h, w) as plotly.js lays it below a figure; pixel 0 is its centre."""
    from PIL import Image  # noqa: PLC0415  # comes with matplotlib

    packed = io.BytesIO()
    Image.fromarray(grey).save(packed, "JPEG", quality=75)
    height, width = grey.shape
    axis = str(place + 1) if place else ""
    source = f"data:image/jpeg;base64,{base64.b64encode(packed.getvalue()).decode()}"
    size = {"x": -0.5, "y": -0.5, "sizex": width, "sizey": height, "sizing": "stretch", "layer": "below"}
    return {"source": source, "xref": f"x{axis}", "yref": f"y{axis}", "yanchor": "top", **size}


def _segments(begin: FloatArray, end: FloatArray) -> FloatArray:
    return np.stack([begin, end, np.full(len(begin), np.nan)], axis=1).ravel()


def _histogram(shown: Sequence[_ShownRun]) -> Figure:
    data = []
    middle, width = 0.5 * (BINS[1:] + BINS[:-1]), BINS[1] - BINS[0]
    for one in shown:
        count = one.details["histogram"]
        if count.sum():
            density = count / (count.sum() * width)
            steps = {"line": {"shape": "hvh", "color": one.colour}, "fill": "none" if one.several else "tozeroy"}
            data.append(line(middle, density, one.name("inliers"), one.colour, mode="lines") | steps)
    if data:
        gauss = np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi)
        data.append(line(middle, gauss, "Gaussian", TRUTH, mode="lines") | {"line": {"color": TRUTH, "dash": "dot"}})
    layout = {"xaxis": {"title": "residual along u and v [sigma]"}, "yaxis": {"title": "density"}}
    text = "Wider than the Gaussian: sigma_px is too small, or the calibration is off; narrower: it is too large."
    return Figure("histogram", "Residuals against the Gaussian", text, data, layout)


def _tracks(shown: Sequence[_ShownRun]) -> Figure:
    data = []
    for one in shown:
        views, parallax = one.details["views"], one.details["parallax"]
        length = np.arange(len(views))
        style = {"marker": {"color": one.colour}, "legendgroup": one.run.name, "name": one.run.name}
        data.append({"type": "bar", "x": length[2:], "y": views[2:], **style, "showlegend": False})
        edges = np.maximum(PARALLAX_DEG, 0.03)
        middle = np.sqrt(edges[1:] * edges[:-1])
        bar = {"x": middle, "width": np.diff(edges), "y": parallax, "xaxis": "x2", "yaxis": "y2"}
        data.append({"type": "bar", **bar, **style, "showlegend": len(shown) > 1})
    layout = {
        "xaxis": {"title": "observations of a track", "domain": [0.0, 0.46]},
        "yaxis": {"title": "tracks"},
        "xaxis2": {"title": "parallax [deg]", "type": "log", "domain": [0.54, 1.0], "anchor": "y2"},
        "yaxis2": {"anchor": "x2"},
        "barmode": "group",
    }
    text = "Long tracks with parallax hold a map together; below a degree distances are not told."
    return Figure("tracks", "Tracks: length and parallax", text, data, layout)


def _health(shown: Sequence[_ShownRun]) -> Figure:
    data = []
    for one in shown:
        if len(one.solve_s):
            data.append(line(one.solve_s, 100.0 * one.details["inlier_share"], one.name("inliers [%]"), one.colour))
        if len(one.solve_s) and not one.several:
            style = {"line": {"color": "#56B4E9", "dash": "dash"}, "yaxis": "y2", "marker": {"size": 3}}
            data.append(line(one.solve_s, one.details["parallax_deg"], one.name("parallax"), "#56B4E9") | style)
        for status, colour in _BAD.items():
            rows = one.details["status"] == status
            if rows.any():
                marker = {"color": colour, "symbol": "x", "size": 10}
                words = [f"{status}: {reason}" for reason in one.details["reason"][rows].tolist()]
                drawn = line(one.solve_s[rows], np.full(rows.sum(), 100.0), one.name(status.lower()), colour)
                data.append(drawn | {"mode": "markers", "marker": marker, "text": words, "hoverinfo": "text"})
    layout = {
        "xaxis": {"title": "time [s]", "domain": [0.0, 0.9]},
        "yaxis": {"title": "inliers [%]", "range": [0, 105]},
        "yaxis2": {
            "title": "parallax [deg]",
            "overlaying": "y",
            "side": "right",
            "showgrid": False,
            "rangemode": "tozero",
        },
    }
    text = "Share of a window's observations that agree with its solution, median parallax, and what the guard held."
    return Figure("health", "Health of each window", text, data, layout)


def _latency(shown: Sequence[_ShownRun]) -> Figure:
    data = []
    for one in shown:
        times = 1e3 * np.array(one.run.report.get("solve_times_s", []))
        if times.any() and len(times) == len(one.solve_s):
            p50, p95 = np.percentile(times, [50, 95])
            name = one.name(f"median {p50:.1f} ms, p95 {p95:.1f} ms")
            data.append(line(one.solve_s, times, name, one.colour, mode="markers"))
    layout: dict[str, Any] = {"showlegend": True, "xaxis": {"title": "time [s]"}}
    layout["yaxis"] = {"title": "time of a solve [ms]", "rangemode": "tozero"}
    caption = "Time in the solver for each keyframe, on the machine of the replay."
    return Figure("latency", "Latency", caption, data, layout)


def _rejected(shown: Sequence[_ShownRun]) -> Figure:
    data: list[dict[str, Any]] = []
    for one in shown:
        counts: Counter[str] = Counter(one.run.report["bag_rejected"])
        counts.update(one.run.report["rejected"])
        counts["outlier"] += one.run.report["outliers"]
        rows = [(reason, count) for reason, count in sorted(counts.items()) if count]
        if rows:
            reasons, values = zip(*rows, strict=True)
            bar = {"type": "bar", "orientation": "h", "x": list(values), "y": list(reasons), "text": list(values)}
            data.append(bar | {"name": one.run.name, "marker": {"color": one.colour}})
    layout = {"xaxis": {"title": "observations or messages"}, "yaxis": {"automargin": True}}
    return Figure("rejected", "Left out, by reason", "What was turned away, and outliers.", data, layout)


def _few(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """Return at most so many rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).astype(np.intp)]


_FIGURES: tuple[Callable[[Sequence[_ShownRun]], Figure], ...] = (
    _above,
    _space,
    _over_time,
    _objective,
    _arrows,
    _histogram,
    _tracks,
    _health,
    _held_out,
    _latency,
    _rejected,
)


def verdicts(report: Mapping[str, Any], details: Mapping[str, NDArray[Any]]) -> list[tuple[str, int]]:
    """Return why solves were not taken, in words, and how many were for each reason; most first."""
    bad = np.isin(details["status"], list(_BAD)) if report["solves"] else np.empty(0, bool)
    words = zip(details["status"][bad].tolist(), details["reason"][bad].tolist(), strict=True)
    return Counter(f"{status}: {reason}" for status, reason in words).most_common(8)
