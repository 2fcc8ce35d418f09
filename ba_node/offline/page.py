# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put figures and tables on one page that needs nothing else: plotly.js and all data are in it, packed."""

from __future__ import annotations

import base64
import gzip
import importlib.util
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.io.files import whole_file, write_csv, write_json

# Beyond it a float32 has steps of more than a centimetre.
_FAR = 1e5


class PageError(ValueError):
    """A page that cannot be made."""


@dataclass(frozen=True)
class Figure:
    """One figure of a page."""

    key: str  # name of its picture
    title: str
    caption: str
    data: list[dict[str, Any]]  # traces, as of plotly.js, with arrays
    layout: dict[str, Any]
    wide: bool = False  # takes the whole width


@dataclass(frozen=True)
class Page:
    """What stands on a page: title, ``head`` (HTML), the figures that have data, ``tail`` (HTML)."""

    title: str
    figures: Sequence[Figure]
    head: str
    tail: str = ""


def write_results(
    out: Path, name: str, content: Mapping[str, Any], table: Sequence[Sequence[object]], page: Page
) -> str:
    """Write NAME.json, NAME.csv and index.html; return their names, or in words why there is no page.

    Raises:
        OSError: a file cannot be written.
    """
    names = write_tables(out, name, content, table)
    try:
        write_page(out / "index.html", page)
    except PageError as error:
        return f"{names}; {error}"
    return f"{names}, index.html"


def write_tables(out: Path, name: str, content: Mapping[str, Any], table: Sequence[Sequence[object]]) -> str:
    """Write NAME.json and NAME.csv; return their names.

    Raises:
        OSError: a file cannot be written.
    """
    write_json(out / f"{name}.json", content)
    write_csv(out / f"{name}.csv", table)
    return f"{name}.json, {name}.csv"


def write_page(path: Path, page: Page) -> None:
    """Write a page.

    Raises:
        PageError: plotly is not installed.
        OSError: the file cannot be written.
    """
    figures = [figure for figure in page.figures if figure.data]
    frames = (
        f"<figure{' class=wide' if figure.wide else ''}><h3>{escape(figure.title)}</h3>"
        f'<figcaption>{escape(figure.caption)}</figcaption><div class="plot" id="plot-{figure.key}"></div></figure>'
        for figure in figures
    )
    data = [{"key": figure.key, "data": figure.data, "layout": figure.layout} for figure in figures]
    parts = {
        "TITLE": escape(page.title),
        "HEAD": page.head,
        "FIGURES": "\n".join(frames),
        "TAIL": page.tail,
        "LIBRARY": _packed(_library()),
        "DATA": _packed(json.dumps(data, separators=(",", ":"), default=_encoded).encode()),
    }
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    text = re.sub(r"@([A-Z]+)@", lambda found: parts[found[1]], template)
    with whole_file(path) as stream:
        stream.write(text.encode())


def _library() -> bytes:
    """Return plotly.js, which comes with plotly."""
    spec = importlib.util.find_spec("plotly")
    if spec is None or spec.origin is None:
        raise PageError("no page of figures without plotly: pip install ba_node[report]")
    return Path(spec.origin).with_name("package_data").joinpath("plotly.min.js").read_bytes()


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


def _encoded(values: np.ndarray) -> dict[str, str]:
    """Return numbers as plotly.js takes them: bytes in base64, of float32 where that is precise enough."""
    values = np.asarray(values, float)
    kind = "f8" if len(values) and np.nanmax(np.abs(values), initial=0.0) > _FAR else "f4"
    return {"dtype": kind, "bdata": base64.b64encode(values.astype(f"<{kind}").tobytes()).decode()}


def html_table(head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    """Return a table; each row has a class and its cells."""
    lines = ["<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"]
    for kind, cells in rows:
        row = "".join(f"<td{' class=text' if len(cell) > 40 else ''}>{escape(cell)}</td>" for cell in cells)
        lines.append(f"<tr class={kind}>{row}</tr>" if kind else f"<tr>{row}</tr>")
    return f"<div class=wrap><table>{''.join(lines)}</table></div>"
