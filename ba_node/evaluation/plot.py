# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw a trajectory before and after, the truth, and the map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import Kind
from ba_node.evaluation.metrics import TrajectoryError, absolute_error

# Okabe-Ito colours, told apart by colour-blind readers.
_TRUTH, _BEFORE, _AFTER, _CLOUD = "#000000", "#D55E00", "#0072B2", "#8C8C8C"


@dataclass(frozen=True)
class Comparison:
    """What is drawn."""

    before: Poses | None  # trajectory of the front-end; None to show that after adjustment alone
    after: Poses  # trajectory after adjustment
    truth: Poses | None  # reference, None if there is none
    cloud: FloatArray  # (n, 3) points of the map, in the frame of ``after``, m; may be empty
    kind: Kind = "se3"  # alignment of both trajectories to the truth


def draw(target: Path | IO[bytes], comparison: Comparison) -> None:
    """Write a PNG, to a file or a stream: the site from above on the left, the error over time on the right.

    The same input gives the same bytes with the same version of matplotlib.

    Raises:
        EvaluationError: a trajectory cannot be compared with the truth.
    """
    # Slow to import, and needed here only; the canvas is Agg, so no display is asked for.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    truth = comparison.truth
    before, after = (
        None if poses is None or truth is None else absolute_error(poses, truth, comparison.kind)
        for poses in (comparison.before, comparison.after)
    )
    figure = Figure(figsize=(12.0, 5.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    above, over_time = figure.subplots(1, 2, width_ratios=(1.7, 1.0))
    _draw_site(above, comparison, before, after)
    if after is not None:
        _draw_errors(over_time, before, after)
        change = f"{after.translation.rmse:.3f} m"
        if before is not None:
            change = f"{before.translation.rmse:.3f} m before, {change} after adjustment"
        title = f"Trajectory error (RMSE, {comparison.kind} alignment): {change}"
    else:
        _draw_moved(over_time, comparison)
        title = "Trajectory before and after adjustment"
    figure.legend(
        *above.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, markerscale=1.5
    )
    figure.suptitle(title, fontsize=13)
    figure.savefig(target, format="png", metadata={"Software": None})


def _draw_site(
    axes: Any, comparison: Comparison, before: TrajectoryError | None, after: TrajectoryError | None
) -> None:
    path = _aligned(comparison.after.position, after)
    across, up = ground_axes(path)
    cloud = _aligned(comparison.cloud, after)
    if len(cloud):
        axes.scatter(
            cloud[:, across], cloud[:, up], s=5.0, c=_CLOUD, alpha=0.7, linewidths=0, label="map", rasterized=True
        )
    paths = [path]
    if comparison.before is not None:
        before_path = _aligned(comparison.before.position, before)
        paths.append(before_path)
        axes.plot(before_path[:, across], before_path[:, up], ".--", color=_BEFORE, lw=1.3, ms=4.0, label="before")
    if comparison.truth is not None:
        truth = comparison.truth.position
        paths.append(truth)
        axes.plot(truth[:, across], truth[:, up], "-", color=_TRUTH, lw=3.0, alpha=0.35, label="truth")
    name = "estimate" if comparison.before is None else "after"
    axes.plot(path[:, across], path[:, up], ".-", color=_AFTER, lw=1.3, ms=5.0, label=name)
    axes.set_aspect("equal")
    _frame_site(axes, np.concatenate(paths)[:, [across, up]], cloud[:, [across, up]])
    axes.set_xlabel(f"{'xyz'[across]} [m]")
    axes.set_ylabel(f"{'xyz'[up]} [m]")
    axes.set_title("From above", fontsize=11)


def ground_axes(path: FloatArray) -> tuple[int, int]:
    """Return the two axes along which a path (n, 3) goes most: those of the ground, whatever the frame is."""
    spread = np.ptp(path, axis=0) if len(path) else np.zeros(3)
    # Of equal ones the first: z is up in most frames.
    first, second = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    return first, second


def _aligned(points: FloatArray, error: TrajectoryError | None) -> FloatArray:
    return points if error is None else error.alignment.apply(points)


def _frame_site(axes: Any, paths: FloatArray, cloud: FloatArray) -> None:
    """Show the paths (n, 2) and what all but 1 % of the cloud (m, 2) spans: strays must not shrink the picture."""
    corners = np.percentile(cloud, [0.5, 99.5], axis=0) if len(cloud) else np.empty((0, 2))
    shown = np.concatenate([paths, corners])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = 0.04 * float(np.max(high - low)) + 0.1
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)


def _draw_errors(axes: Any, before: TrajectoryError | None, after: TrajectoryError) -> None:
    start = after.stamp_ns[0] if before is None else before.stamp_ns[0]
    for error, colour, style in ((before, _BEFORE, ".--"), (after, _AFTER, ".-")):
        if error is None:
            continue
        axes.plot((error.stamp_ns - start) / 1e9, error.translation_m, style, color=colour, lw=1.3, ms=5.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("position error [m]")
    axes.set_title("Error of each keyframe", fontsize=11)
    axes.grid(alpha=0.3)


def _draw_moved(axes: Any, comparison: Comparison) -> None:
    """Show how far each keyframe was moved, where there is nothing to compare with."""
    after, before = comparison.after, comparison.before
    if before is not None and len(before) == len(after):
        moved = np.linalg.norm(after.position - before.position, axis=1)
        axes.plot((after.stamp_ns - after.stamp_ns[0]) / 1e9, moved, ".-", color=_AFTER, lw=1.3, ms=5.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("moved by [m]")
    axes.set_title("What the adjustment moved", fontsize=11)
    axes.grid(alpha=0.3)
