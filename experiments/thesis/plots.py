# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of an experiment, from its records alone."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.figures import COLOURS, curve, new_figure, spread
from experiments.thesis import sketches
from experiments.thesis.experiments import Experiment

Record = Mapping[str, Any]
Records = Mapping[str, Record]
Plot = Callable[[Experiment, Records], Figure]

# Below this share objectives are the same.
_LEVEL = 1e-9
_MEASURED, _PREDICTED = "#D55E00", "#0072B2"


def _title(figure: Figure, text: str) -> None:
    """Write a title that is not wider than the figure."""
    figure.suptitle("\n".join(textwrap.wrap(text, int(9.5 * figure.get_figwidth()))))


def _legend(figure: Figure, axis: Any) -> None:
    """Write one legend for all plots, below them; its lines are long enough to show the dashes."""
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False, handlelength=4.0)


def curves(experiment: Experiment, records: Records) -> Figure:
    """Draw objective, what it is above the lowest one, and norm of the gradient, against steps taken and time."""
    runs = {label: record for label, record in records.items() if len(record.get("trace", ())) > 1}
    lowest = _lowest(runs)
    groups = spread(list(runs))
    figure = new_figure(13.0, 0.5 + 12.0 * len(groups))
    grid = figure.subplots(3 * len(groups), 2, sharey="row", sharex="col", squeeze=False)
    names = ("objective", "objective above the lowest of its loss, share", "norm of the gradient")
    for number, group in enumerate(groups):
        axes = grid[3 * number : 3 * number + 3]
        for index, label in enumerate(group):
            _curve(axes, runs[label], lowest, index, label)
        for line, name in zip(axes, names, strict=True):
            for axis in line:
                axis.set_yscale("log")
                axis.grid(visible=True, alpha=0.3)
            line[0].set_ylabel(name)
        for axis, unit in zip(axes[-1], ("steps taken", "processor time [s]"), strict=True):
            axis.set_xlabel(unit)
            axis.tick_params(labelbottom=True)
        axes[0, 1].legend(*axes[0, 0].get_legend_handles_labels(), loc="upper right", ncols=2, handlelength=4.0)
    _title(figure, experiment.heading)
    return figure


def _curve(axes: Any, record: Record, lowest: Mapping[str, float], index: int, label: str) -> None:
    """Draw one run as the n-th curve of six plots (3, 2)."""
    rows = [row for row in record["trace"] if row["accepted"]]
    best = lowest[record["options"]["loss"]]
    objective, gradient = (np.array([row[n] or math.nan for row in rows]) for n in ("objective", "gradient_norm"))
    above = np.maximum((objective - best) / best, _LEVEL) if best > 0.0 else np.full(len(rows), math.nan)
    style = curve(index, every=7)
    for line, values in zip(axes, (objective, above, gradient), strict=True):
        line[0].plot(range(len(rows)), values, label=label, **style)
        line[1].plot([row["time_s"] for row in rows], values, label=label, **style)


def _lowest(runs: Records) -> dict[str, float]:
    """Return the lowest objective of all runs with the same loss."""
    out: dict[str, float] = {}
    for record in runs.values():
        values = [row["objective"] for row in record["trace"] if row["objective"] is not None]
        loss = record["options"]["loss"]
        out[loss] = min([*values, out.get(loss, math.inf)])
    return out


def taylor(experiment: Experiment, records: Records) -> Figure:
    """Draw the remainder of the Taylor series against the step."""
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    for label, record in records.items():
        tau, remainder = (np.array(record["data"][name]) for name in ("tau", "remainder"))
        axis.loglog(tau, remainder, label=label, **curve(0))
        axis.loglog(tau, remainder[4] * (tau / tau[4]) ** 2, label="slope 2", **curve(1))
    axis.set(xlabel="τ", ylabel="|F(u + τδ) - F(u) - τJδ|", title=experiment.heading)
    axis.grid(visible=True, which="both", alpha=0.3)
    axis.legend(frameon=False)
    return figure


def reprojection(experiment: Experiment, records: Records) -> Figure:
    """Draw measured and predicted points of some images, before above after."""
    images = next(record["images"] for record in records.values() if record.get("images"))
    columns = min(5, len(images))
    blocks = -(-len(images) // columns)
    figure = new_figure(max(3.4 * columns, 9.0), (3.0 if columns > 2 else 4.5) * 2 * blocks)
    axes = figure.subplots(2 * blocks, columns, squeeze=False)
    for index, image in enumerate(images):
        for below, when in enumerate(("before", "after")):
            axis = axes[2 * (index // columns) + below, index % columns]
            measured, predicted = np.array(image["measured"]), np.array(image[when])
            lines = np.stack([measured, predicted], axis=1)
            axis.plot(*lines.transpose(2, 1, 0), color=COLOURS[2], lw=0.8)
            axis.plot(*measured.T, "o", mfc="none", color=_MEASURED, ms=3.5, mew=0.7)
            axis.plot(*predicted.T, ".", color=_PREDICTED, ms=2.5)
            axis.set_title(f"image {image['image']}, {when}", fontsize=9)
            axis.invert_yaxis()
            axis.tick_params(labelsize=7)
    for axis in axes.flat:
        axis.set_visible(axis.has_data())
    _title(figure, f"{experiment.heading} [px]; rings: measured, dots: predicted")
    return figure


def histograms(experiment: Experiment, records: Records) -> Figure:
    """Draw the distributions of reprojection errors and of the gradient's entries, with a Gaussian as wide."""
    figure = new_figure(12.0, 4.5)
    axes = figure.subplots(1, 2)
    record = next(iter(records.values()))
    parts = (
        (record["residuals"], "reprojection error [px]; at the ends all beyond"),
        (record["gradient"]["histogram"], "entry of the gradient; at the ends all beyond"),
    )
    for axis, (found, name) in zip(axes, parts, strict=True):
        edges = np.linspace(found["low"], found["high"], len(found["counts"]) + 1)
        width = edges[1] - edges[0]
        density = np.array(found["counts"]) / (sum(found["counts"]) * width)
        axis.bar(edges[:-1], density, width, align="edge", color=COLOURS[5])
        z = (edges - found["mean"]) / found["sigma"]
        gauss = np.exp(-0.5 * z * z) / (found["sigma"] * math.sqrt(2.0 * math.pi))
        axis.plot(edges, gauss, color=COLOURS[1], label="Gaussian of the same mean and variance")
        axis.set(
            xlabel=name, ylabel="density", yscale="log", ylim=(max(density[density > 0.0].min() / 3.0, 1e-12), None)
        )
        axis.legend(frameon=False, fontsize=8)
    _title(figure, experiment.heading)
    return figure


def layout(experiment: Experiment, records: Records) -> Figure:
    """Draw cameras and points in space, and which blocks of E are not zero."""
    data = next(record["data"] for record in records.values() if "cameras" in record.get("data", {}))
    cameras, points = np.array(data["cameras"]), np.array(data["points"])
    figure = new_figure(12.0, 5.5)
    space = figure.add_subplot(1, 2, 1, projection="3d")
    space.plot(*points.T, ".", color=_PREDICTED, ms=1.5 if len(points) > 1000 else 3.0)
    space.plot(*cameras.T, "^-", color=_MEASURED, ms=4.0, lw=0.6)
    space.set_aspect("equal")
    pattern = figure.add_subplot(1, 2, 2)
    pattern.plot(data["point"], data["image"], ",", color="black")
    pattern.set(xlabel="point", ylabel="image", title="blocks of E", ylim=(len(cameras) - 0.5, -0.5))
    _title(figure, experiment.heading)
    return figure


def growth(experiment: Experiment, records: Records) -> Figure:
    """Draw time against the number of observations, a line for each word before the comma of the labels."""
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    for index, kind in enumerate(dict.fromkeys(label.split(",")[0] for label in records)):
        rows = [record["figures"] for label, record in records.items() if label.split(",")[0] == kind]
        x, y = (np.array([row[name] for row in rows]) for name in ("observations", "seconds"))
        exponent = float(np.polyfit(np.log(x), np.log(y), 1)[0])
        axis.loglog(x, y, label=f"{kind}: N^{exponent:.2f}", **curve(index))
    axis.set(xlabel="observations N", ylabel="processor time [s]", title=experiment.heading)
    axis.grid(visible=True, which="both", alpha=0.3)
    axis.legend(frameon=False)
    return figure


def pcg(experiment: Experiment, records: Records) -> Figure:
    """Draw the PCG steps of every linear solve: labels without a comma on the left, with one on the right.

    Those from other start values are left out.
    """
    records = {label: record for label, record in records.items() if not label.endswith(", mu 1e-4")}
    figure = new_figure(12.0, 5.0)
    axes = figure.subplots(1, 2, sharey=True)
    kinds = list(dict.fromkeys(label.split(",")[0] for label in records))
    for label, record in records.items():
        kind, comma, rest = label.partition(", ")
        axis = axes[1 if comma else 0]
        steps = [row["linear_iterations"] for row in record["trace"][1:]]
        axis.plot(range(1, len(steps) + 1), steps, label=kind, **curve(kinds.index(kind), every=7))
        axis.set_title(rest or "scaled", fontsize=10)
    for axis in axes:
        axis.set(yscale="log", xlabel="step tried")
        axis.grid(visible=True, alpha=0.3)
    axes[0].set_ylabel("PCG steps of its linear solve")
    _legend(figure, axes[0])
    _title(figure, experiment.heading)
    return figure


def conditions(experiment: Experiment, records: Records) -> Figure:
    """Draw the conditions of C, B and S against the steps, without the cure above, with it below; crosses: breaks."""
    figure = new_figure(13.0, 8.0)
    axes = figure.subplots(2, 3, sharey="col", sharex=True)
    for below, line in enumerate(axes):
        chosen = {label: record for label, record in records.items() if label.endswith(", cured") == bool(below)}
        for index, (label, record) in enumerate(chosen.items()):
            columns = record["data"]["conditions"]
            steps = np.arange(1, len(columns["plain"]) + 1)
            broken = np.array(columns["plain"]) == 0.0
            for axis, name in zip(line, "cbs", strict=True):
                values = np.array(columns[f"condition_{name}"])
                axis.semilogy(steps, values, label=label.removesuffix(", cured"), **curve(index, every=12))
                if name == "s":
                    axis.semilogy(steps[broken], values[broken], "x", color=COLOURS[index], ms=4.0)
        for axis, name in zip(line, ("C, worst block", "B, worst block", "S"), strict=True):
            axis.set_title(f"{name}, {'with the cure' if below else 'without'}", fontsize=10)
            axis.grid(visible=True, alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("step tried")
    for line in axes:
        line[0].set_ylabel("condition, damping included")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, handlelength=4.0
    )
    _title(figure, f"{experiment.heading}; crosses: textbook algebra breaks")
    return figure


def shares(experiment: Experiment, records: Records) -> Figure:
    """Draw errors to truth against the share of outliers, which labels begin with, a line for each method."""
    figure = new_figure(11.0, 4.8)
    axes = figure.subplots(1, 2)
    found: dict[str, list[tuple[float, Any]]] = {}
    for label, record in records.items():
        share, _, method = label.partition(" %, ")
        found.setdefault(method, []).append((float(share), record["truth_after"]))
    names = (("rmse_cameras", "RMSE of cameras"), ("median_points", "median error of points"))
    for index, (method, rows) in enumerate(found.items()):
        for axis, (name, _) in zip(axes, names, strict=True):
            x, y = [share for share, _ in rows], [errors[name] for _, errors in rows]
            axis.plot(x, y, label=method, **curve(index))
    for axis, (_, title) in zip(axes, names, strict=True):
        axis.set(yscale="log", xlabel="outliers [%]", ylabel=title)
        axis.grid(visible=True, which="both", alpha=0.3)
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False, handlelength=4.0
    )
    _title(figure, experiment.heading)
    return figure


def bars(experiment: Experiment, records: Records) -> Figure:
    """Draw errors to truth of each case as bars."""
    figure = new_figure(9.0, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    known = {label: record["truth_after"] for label, record in records.items() if "truth_after" in record}
    for axis, (name, title) in zip(
        axes, (("rmse_cameras", "RMSE of cameras"), ("median_points", "median error of points")), strict=True
    ):
        drawn = axis.barh(list(known), [errors[name] for errors in known.values()], color=COLOURS[5])
        axis.bar_label(drawn, fmt="%.3g", padding=3)
        axis.margins(x=0.15)
        axis.set_xlabel(title)
    axes[0].invert_yaxis()
    _title(figure, experiment.heading)
    return figure


PLOTS: dict[str, Plot] = {
    "curves": curves,
    "taylor": taylor,
    "reprojection": reprojection,
    "histograms": histograms,
    "layout": layout,
    "growth": growth,
    "pcg": pcg,
    "conditions": conditions,
    "shares": shares,
    "bars": bars,
    "blocks": sketches.draw_blocks,
    "cap": sketches.draw_cap,
}
