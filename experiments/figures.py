# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""How curves are told apart in every picture of the experiments: by colour, by dashes and by marker."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, TypeVar

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Okabe and Ito (2008) without yellow, which is pale on white: told apart by colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DASHES = ("-", (0, (5, 1.5)), (0, (6, 1.5, 1, 1.5)), (0, (1, 1)), (0, (3, 1)), (0, (9, 2)), (0, (6, 1, 1, 1, 1, 1)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
# A plot with more curves than this cannot be read: spread them over several.
MOST_CURVES = len(COLOURS)

Item = TypeVar("Item")


def curve(index: int, every: int | None = None) -> dict[str, Any]:
    """Return colour, dashes and marker of the n-th curve of a plot, for ``Axes.plot``.

    Args:
        index: below MOST_CURVES.
        every: distance of the markers along a curve of many points; None for one at each point.
    """
    style = {"color": COLOURS[index], "ls": _DASHES[index], "marker": _MARKERS[index], "lw": 1.4, "ms": 5.0}
    # Curves that lie on each other have their markers at other places.
    return style if every is None else {**style, "markevery": (index * every // MOST_CURVES, every)}


def spread(items: Sequence[Item]) -> list[list[Item]]:
    """Return the items in as few groups, of about the same size, as plots with MOST_CURVES take."""
    groups = max(1, -(-len(items) // MOST_CURVES))
    size = -(-len(items) // groups) or 1
    return [list(items[begin : begin + size]) for begin in range(0, len(items), size)] or [[]]


def new_figure(width: float, height: float, dpi: int = 80) -> Figure:
    """Return an empty figure, inches wide and high, that needs no display."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def png(figure: Figure) -> bytes:
    """Return a figure as PNG; the same figure gives the same bytes with the same version of matplotlib."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
