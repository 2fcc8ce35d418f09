# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw the figures of a page as PNG with matplotlib: the same traces and layout that plotly.js draws in a browser."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.io.files import whole_file
from ba_node.offline.figures import trajectory_figures
from ba_node.offline.page import Figure
from ba_node.offline.run_folder import Comparison

Progress = Callable[[int, int], None]
_DPI = 110
# Size of one figure, and of one that takes the whole width of a page, inches.
_SIZE, _WIDE = (7.0, 5.4), (12.0, 5.4)
_DASHES = {"dash": "--", "dot": ":"}
_STEPS = {"hv": "steps-post", "hvh": "steps-mid"}
_SYMBOLS = {"x": "x"}


def write_pictures(folder: Path, figures: Sequence[Figure], progress: Progress) -> None:
    """Write each figure as KEY.png into a folder, which is made if there is none.

    ``progress`` is called with how many are done, and how many there are.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(exist_ok=True)
    for done, figure in enumerate(figures, start=1):
        draw(folder / f"{figure.key}.png", [figure])
        progress(done, len(figures))


def draw_trajectory(path: Path, comparison: Comparison) -> None:
    """Draw the way from above and the error over time side by side.

    Raises:
        OSError: the file cannot be written.
    """
    draw(path, *trajectory_figures(comparison))


def draw(path: Path, figures: Sequence[Figure], title: str = "") -> None:
    """Draw figures side by side; the same figures give the same bytes with the same version of matplotlib.

    Raises:
        OSError: the file cannot be written.
    """
    # Slow to import, and needed here only; the canvas is Agg, so no display is asked for.
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure as Sheet  # noqa: PLC0415

    size = _WIDE if len(figures) > 1 or figures[0].wide else _SIZE
    sheet = Sheet(figsize=size, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(sheet)
    ratios = [1.7, *[1.0] * (len(figures) - 1)]
    parts = sheet.subfigures(1, len(figures), squeeze=False, width_ratios=ratios)[0]
    for part, figure in zip(parts, figures, strict=True):
        _draw_figure(part, figure)
    if title:
        sheet.suptitle(title, fontsize=13)
    with whole_file(path) as stream:
        sheet.savefig(stream, format="png", metadata={"Software": None})


def _draw_figure(part: Any, figure: Figure) -> None:
    """Draw one figure: its x axes side by side, further y axes of one of them on its right."""
    layout = figure.layout
    traces = [trace for trace in figure.data if trace.get("visible") != "legendonly"]
    names = sorted({trace.get("xaxis", "x") for trace in figure.data})
    projection = {"projection": "3d"} if "scene" in layout else {}
    columns = dict(zip(names, part.subplots(1, len(names), squeeze=False, subplot_kw=projection)[0], strict=True))
    drawn: dict[tuple[str, str], Any] = {}
    for trace in figure.data:
        x, y = trace.get("xaxis", "x"), trace.get("yaxis", "y")
        if (x, y) not in drawn:
            overlaying = "overlaying" in layout.get(f"yaxis{y[1:]}", {})
            drawn[x, y] = columns[x].twinx() if overlaying else columns[x]
    for picture in layout.get("images", ()):
        _lay_below(columns[picture["xref"]], picture)
    for trace in traces:
        axes = drawn[trace.get("xaxis", "x"), trace.get("yaxis", "y")]
        _TRACES[trace["type"]](axes, trace)
    for (x, y), axes in drawn.items():
        if "scene" in layout:
            _set_space(axes, layout["scene"])
        else:
            _set_axis(axes, "x", layout.get(f"xaxis{x[1:]}", {}))
            _set_axis(axes, "y", layout.get(f"yaxis{y[1:]}", {}))
    labelled = [axes.get_legend_handles_labels() for axes in drawn.values()]
    by_name = {label: handle for handles, labels in labelled for handle, label in zip(handles, labels, strict=True)}
    if len(by_name) > 1 or "showlegend" in layout:
        part.legend(by_name.values(), by_name.keys(), loc="outside lower center", ncols=4, frameon=False)
    part.suptitle(figure.title, fontsize=12)


def _label(trace: dict[str, Any]) -> str:
    """Return how a trace is called in the legend; what begins with _ stays out of it."""
    return trace.get("name", "") if trace.get("showlegend", True) and trace.get("name") else "_"


def _scatter(axes: Any, trace: dict[str, Any]) -> None:
    style, marker = trace.get("line", {}), trace.get("marker", {})
    mode, coordinates = trace.get("mode", "lines"), [trace[axis] for axis in "xyz" if axis in trace]
    shown: dict[str, Any] = {"linestyle": "none"}
    if "lines" in mode:
        shown = {"linestyle": _DASHES.get(style.get("dash", ""), "-"), "linewidth": min(style.get("width", 1.8), 2.2)}
        if style.get("shape") in _STEPS:
            shown["drawstyle"] = _STEPS[style["shape"]]
    if "markers" in mode:
        size = marker.get("size", 4)
        shown |= {
            "marker": _SYMBOLS.get(marker.get("symbol", ""), "o"),
            "markersize": size,
            "markeredgewidth": 0.3 * (size > 6),
        }
        shown |= {"alpha": marker.get("opacity", 1.0)}
    colour = marker.get("color") if mode == "markers" else style.get("color", marker.get("color"))
    axes.plot(*coordinates, color=colour, label=_label(trace), **shown)
    if trace.get("fill") == "tozeroy":
        axes.fill_between(trace["x"], trace["y"], step="mid", color=colour, alpha=0.3, linewidth=0.0)


def _bar(axes: Any, trace: dict[str, Any]) -> None:
    colour, label = trace.get("marker", {}).get("color"), _label(trace)
    if trace.get("orientation") != "h":
        axes.bar(trace["x"], trace["y"], trace.get("width", 0.8), color=colour, label=label, alpha=0.8)
        return
    bars = axes.barh(trace["y"], trace["x"], color=colour, label=label, alpha=0.8)
    axes.bar_label(bars, trace.get("text"), padding=3)


_TRACES = {"scatter": _scatter, "scatter3d": _scatter, "bar": _bar}


def _lay_below(axes: Any, picture: dict[str, Any]) -> None:
    """Lay an image below what is drawn, the middle of its first pixel at 0."""
    from PIL import Image  # noqa: PLC0415  # comes with matplotlib

    data = base64.b64decode(picture["source"].partition(",")[2])
    width, height = picture["sizex"], picture["sizey"]
    axes.imshow(Image.open(io.BytesIO(data)), extent=(-0.5, width - 0.5, height - 0.5, -0.5), cmap="gray")


def _set_axis(axes: Any, name: str, layout: dict[str, Any]) -> None:
    getattr(axes, f"set_{name}label")(layout.get("title", ""))
    if layout.get("type") == "log":
        getattr(axes, f"set_{name}scale")("log")
    elif layout.get("rangemode") == "tozero":
        getattr(axes, f"set_{name}lim")(0.0)
    if "range" in layout:
        getattr(axes, f"set_{name}lim")(*layout["range"])
    if layout.get("autorange") == "reversed":
        getattr(axes, f"invert_{name}axis")()
    if "scaleanchor" in layout:
        axes.set_aspect("equal", adjustable="datalim" if "range" not in layout else "box")
    if layout.get("showgrid", True):
        axes.grid(alpha=0.3)


def _set_space(axes: Any, scene: dict[str, Any]) -> None:
    """Look at a scene as the page does: the same axis upwards, one metre as long along each."""
    up = scene["camera"]["up"]
    vertical = max(up, key=lambda axis: abs(up[axis]))
    axes.view_init(elev=30.0, azim=-60.0, vertical_axis=vertical)
    if up[vertical] < 0:
        getattr(axes, f"invert_{vertical}axis")()
    spans = [np.ptp(getattr(axes, f"get_{axis}lim")()) for axis in "xyz"]
    axes.set_box_aspect(np.maximum(spans, 1e-9))
    for axis in "xyz":
        getattr(axes, f"set_{axis}label")(scene[f"{axis}axis"]["title"])
