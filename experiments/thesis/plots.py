# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of an experiment, from its records alone."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from experiments.thesis.experiments import Experiment

Record = Mapping[str, Any]
Records = Mapping[str, Record]
Plot = Callable[[Experiment, Records], Figure]

# Okabe-Ito colours, told apart by colour-blind readers; then the same dashed.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_STYLES = ("-", "--", ":")
# Below this share objectives are the same.
_LEVEL = 1e-9
_MEASURED, _PREDICTED = "#D55E00", "#0072B2"


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display."""
    figure = Figure(figsize=(width, height), dpi=80, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes with the same version of matplotlib."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _title(figure: Figure, text: str) -> None:
    """Write a title that is not wider than the figure."""
    figure.suptitle("\n".join(textwrap.wrap(text, int(9.5 * figure.get_figwidth()))))


def style(index: int) -> dict[str, Any]:
    """Return how the curve of a number is drawn."""
    return {"color": COLOURS[index % len(COLOURS)], "ls": _STYLES[index // len(COLOURS) % len(_STYLES)], "lw": 1.4}


def curves(experiment: Experiment, records: Records) -> Figure:
    """Draw objective, what it is above the lowest one, and norm of the gradient, against steps taken and time."""
    figure = new_figure(13.0, 12.5)
    axes = figure.subplots(3, 2, sharey="row", sharex="col")
    runs = {label: record for label, record in records.items() if len(record.get("trace", ())) > 1}
    lowest = _lowest(runs)
    for index, (label, record) in enumerate(runs.items()):
        rows = [row for row in record["trace"] if row["accepted"]]
        best = lowest[record["options"]["loss"]]
        objective, gradient = (np.array([row[n] or math.nan for row in rows]) for n in ("objective", "gradient_norm"))
        above = np.maximum((objective - best) / best, _LEVEL) if best > 0.0 else np.full(len(rows), math.nan)
        for line, values in zip(axes, (objective, above, gradient), strict=True):
            line[0].plot(range(len(rows)), values, label=label, **style(index))
            line[1].plot([row["time_s"] for row in rows], values, label=label, **style(index))
    names = ("objective", "objective above the lowest of its loss, share", "norm of the gradient")
    for line, name in zip(axes, names, strict=True):
        for axis in line:
            axis.set_yscale("log")
            axis.grid(visible=True, alpha=0.3)
        line[0].set_ylabel(name)
    for axis, unit in zip(axes[-1], ("steps taken", "processor time [s]"), strict=True):
        axis.set_xlabel(unit)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    _title(figure, experiment.heading)
    return figure


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
        axis.loglog(tau, remainder, "o-", color=COLOURS[0], label=label)
        axis.loglog(tau, remainder[4] * (tau / tau[4]) ** 2, "--", color=COLOURS[1], label="slope 2")
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
        axis.loglog(x, y, marker="o", label=f"{kind}: N^{exponent:.2f}", **style(index))
    axis.set(xlabel="observations N", ylabel="processor time [s]", title=experiment.heading)
    axis.grid(visible=True, which="both", alpha=0.3)
    axis.legend(frameon=False)
    return figure


def pcg(experiment: Experiment, records: Records) -> Figure:
    """Draw the PCG steps of every linear solve; what follows a comma in a label is dashed in the colour before it."""
    figure = new_figure(9.0, 5.0)
    axis = figure.subplots()
    kinds = list(dict.fromkeys(label.split(",")[0] for label in records))
    for label, record in records.items():
        steps = [row["linear_iterations"] for row in record["trace"][1:]]
        colour = COLOURS[kinds.index(label.split(",")[0]) % len(COLOURS)]
        axis.plot(range(1, len(steps) + 1), steps, color=colour, ls="--" if "," in label else "-", lw=1.4, label=label)
    axis.set(yscale="log", xlabel="step tried", ylabel="PCG steps of its linear solve")
    axis.grid(visible=True, alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", frameon=False)
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
                axis.semilogy(steps, values, label=label.removesuffix(", cured"), **style(index))
                if name == "s":
                    axis.semilogy(steps[broken], values[broken], "x", color=COLOURS[index], ms=4.0)
        for axis, name in zip(line, ("C, worst block", "B, worst block", "S"), strict=True):
            axis.set_title(f"{name}, {'with the cure' if below else 'without'}", fontsize=10)
            axis.grid(visible=True, alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("step tried")
    for line in axes:
        line[0].set_ylabel("condition, damping included")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
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
            axis.plot(x, y, marker="o", ms=4.0, label=method, **style(index))
    for axis, (_, title) in zip(axes, names, strict=True):
        axis.set(yscale="log", xlabel="outliers [%]", ylabel=title)
        axis.grid(visible=True, which="both", alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
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
}
