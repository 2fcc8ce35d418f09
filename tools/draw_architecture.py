# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/images/architecture.svg: the rooms of the package by their layers, and the way of one keyframe.

Rooms, what they are for and which others they use come from the code: folders, docstrings, imports. Run it without
arguments to draw, with --check to learn whether the picture is up to date (exit code 1 if not).
"""

from __future__ import annotations

import argparse
import ast
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "ba_node"
PICTURE = ROOT / "docs" / "images" / "architecture.svg"
MADE_BY = "python -m tools.draw_architecture"

# Lowest first; tests/test_layers.py holds the imports against them. The first room of a layer is on the way of a
# keyframe.
LAYERS: dict[str, tuple[str, ...]] = {
    "config": ("native", "config", "licence", "arrays", "kept"),
    "core": ("core",),
    "scene": ("scene", "measurements", "estimate"),
    "window": ("window", "check"),
    "backend": ("backend",),
    "services": ("messages", "io", "evaluation", "front_end"),
    "tools": ("ros", "offline", "cli"),
}
UNSEEN = ("licence", "arrays", "kept")


class Step(NamedTuple):
    """A station of a keyframe: module or folder below ba_node/, what happens there, place across the room, px."""

    module: str
    text: str
    x: int


STEPS = (
    Step("ros/worker/inbox.py", "a message waits in the inbox until the worker takes it", 30),
    Step("messages/conversion.py", "it becomes arrays: Keyframe, FeatureTracks (measurements)", 30),
    Step("backend/backend.py", "the back-end decides on its session, and when to solve", 30),
    Step("scene/ingest.py", "observations go into the tables; bad ones are counted", 66),
    Step("window/selection.py", "a window is chosen: keyframes, points, what is fixed", 102),
    Step("core/solver.py", "damped Gauss-Newton steps on the reduced camera system", 102),
    Step("native", "residuals, Jacobians and the linear solver in C++ (or numpy)", 538),
    Step("window/guard.py", "the solution is compared with what came in: taken or held", 538),
    Step("window/merging.py", "poses and points are put back, outliers classified", 574),
    Step("messages/outputs.py", "the estimate becomes messages", 610),
    Step("ros/components/publishing.py", "they are published, with TF and diagnostics", 610),
)

# Sizes, px.
_SPINE, _SIDE, _GAP, _MARGIN = 640, 172, 10, 20
_HEIGHT, _LEGEND = 68, 440
# Beside the way of a keyframe.
_COLUMNS = max(len(set(rooms) - set(UNSEEN)) for rooms in LAYERS.values()) - 1
_LEFT = _MARGIN + _COLUMNS * (_SIDE + _GAP)
_WIDTH = _LEFT + _SPINE + 2 * _MARGIN + _LEGEND
_STYLE = """
text { font-family: Helvetica, Arial, sans-serif; fill: #1b1b1b; }
.room { font-size: 15px; font-weight: bold; } .what { font-size: 12px; } .uses { font-size: 11px; fill: #5a5a5a; }
.layer { fill: #f1f3f5; } .box { fill: #ffffff; stroke: #8a9099; }
.way { fill: none; stroke: #d55e00; stroke-width: 3; stroke-linejoin: round; }
.stop { fill: #d55e00; } .number { font-size: 12px; font-weight: bold; fill: #ffffff; text-anchor: middle; }
"""


class Box(NamedTuple):
    """A room's place, px: left, top, width, height."""

    x: int
    y: int
    width: int
    height: int


def room_of(path: Path) -> str:
    """Return the module or folder directly below the package that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def uses() -> dict[str, set[str]]:
    """Return, for each room, the other rooms that its files import."""
    found: dict[str, set[str]] = {room: set() for rooms in LAYERS.values() for room in rooms}
    for path in PACKAGE.rglob("*.py"):
        if path.parent == PACKAGE and path.name == "__init__.py":
            continue
        room = room_of(path)
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            module = node.module if isinstance(node, ast.ImportFrom) else None
            for name in names:
                parts = (f"{module}.{name}" if module else name).split(".")
                if parts[0] == "ba_node" and parts[1] in found.keys() - {room}:
                    found[room].add(parts[1])
    return found


def purpose(room: str) -> str:
    """Return the first sentence of what a room says of itself."""
    path = PACKAGE / room / "__init__.py"
    text = ast.get_docstring(ast.parse((path if path.is_file() else PACKAGE / f"{room}.py").read_text())) or ""
    return " ".join(text.partition("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def picture() -> str:
    """Return the picture as SVG."""
    boxes, bands, bottom = _places()
    legend = _legend(_LEFT + _SPINE + 2 * _MARGIN)
    height = max(bottom, _MARGIN + 60 + 44 * len(STEPS))
    used = uses()
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}">',
        f"<title>Rooms of ba_node; drawn by {MADE_BY}</title>",
        f"<style>{_STYLE}</style>",
        f'<rect width="{_WIDTH}" height="{height}" fill="#ffffff"/>',
        *(f'<rect class="layer" x="{b.x}" y="{b.y}" width="{b.width}" height="{b.height}" rx="8"/>' for b in bands),
        *(line for room, box in boxes.items() for line in _room(room, box, sorted(used[room]))),
        *_way(boxes),
        *legend,
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _places() -> tuple[dict[str, Box], list[Box], int]:
    """Return where the rooms and the bands behind a layer are, the highest layer at the top, and where all ends."""
    boxes: dict[str, Box] = {}
    bands = []
    y = _MARGIN
    for rooms in reversed(LAYERS.values()):
        first, *others = (room for room in rooms if room not in UNSEEN)
        boxes[first] = Box(_LEFT, y, _SPINE, _HEIGHT)
        for i, room in enumerate(others, start=1):
            boxes[room] = Box(_LEFT - i * (_SIDE + _GAP), y, _SIDE, _HEIGHT)
        bands.append(Box(_MARGIN - 8, y - 8, _LEFT + _SPINE + 16 - _MARGIN, _HEIGHT + 16))
        y += _HEIGHT + 3 * _GAP
    return boxes, bands, y


def _room(room: str, box: Box, used: Sequence[str]) -> Iterator[str]:
    yield f'<rect class="box" x="{box.x}" y="{box.y}" width="{box.width}" height="{box.height}" rx="6"/>'
    is_side = box.width == _SIDE
    x, wide = (box.x + 8, 24) if is_side else (box.x + 170, 58)
    y = box.y + 18
    name = room if (PACKAGE / room).is_dir() else f"{room}.py"
    yield f'<text class="room" x="{x}" y="{y}">{name}</text>'
    lines = textwrap.wrap(purpose(room), wide, max_lines=3 if is_side else 2, placeholder=" ...")
    for i, line in enumerate(lines, start=1):
        yield f'<text class="what" x="{x}" y="{y + 14 * i + 1}">{escape(line)}</text>'
    if not is_side and used:
        yield f'<text class="uses" x="{x}" y="{y + 44}">uses {escape(", ".join(used))}</text>'


def _way(boxes: dict[str, Box]) -> Iterator[str]:
    """Draw the way of a keyframe with its numbered stops, up or down first and then aside."""
    stops = []
    for step in STEPS:
        box = boxes[step.module.partition("/")[0]]
        stops.append((box.x + step.x, box.y + (52 if step.module == "native" else _HEIGHT // 2)))
    corners = [stops[0]]
    for x, y in stops[1:]:
        corners += [(corners[-1][0], y), (x, y)]
    yield f'<polyline class="way" points="{" ".join(f"{x},{y}" for x, y in corners)}"/>'
    for number, (x, y) in enumerate(stops, start=1):
        yield f'<circle class="stop" cx="{x}" cy="{y}" r="11"/>'
        yield f'<text class="number" x="{x}" y="{y + 4}">{number}</text>'


def _legend(x: int) -> Iterator[str]:
    yield f'<text class="room" x="{x}" y="{_MARGIN + 14}">The way of one keyframe</text>'
    for number, step in enumerate(STEPS, start=1):
        y = _MARGIN + 44 * number
        yield f'<circle class="stop" cx="{x + 11}" cy="{y}" r="11"/>'
        yield f'<text class="number" x="{x + 11}" y="{y + 4}">{number}</text>'
        yield f'<text class="what" x="{x + 32}" y="{y - 3}">{escape(step.text)}</text>'
        yield f'<text class="uses" x="{x + 32}" y="{y + 12}">{escape(step.module)}</text>'
    y = _MARGIN + 44 * (len(STEPS) + 1)
    for i, line in enumerate(
        textwrap.wrap("Each room may use those below its own layer, and of its own layer what it says.", 58)
    ):
        yield f'<text class="uses" x="{x}" y="{y + 14 * i}">{line}</text>'


def main(argv: Sequence[str] | None = None) -> int:
    """Draw or check the picture."""
    parser = argparse.ArgumentParser(description="Draw the rooms of the package.")
    parser.add_argument("--check", action="store_true", help="draw nothing; exit code 1 if the picture is stale")
    args = parser.parse_args(argv)
    text = picture()
    if args.check:
        stale = not PICTURE.is_file() or PICTURE.read_text() != text
        if stale:
            print(f"{PICTURE.relative_to(ROOT)} is stale: run {MADE_BY}")
        return int(stale)
    PICTURE.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
