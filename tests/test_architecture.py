# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The picture of the rooms is as the code is, and names what is there."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools import draw_architecture as draw

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text()


def test_the_picture_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert draw.main(["--check"]) == 0, capsys.readouterr().out


def test_every_room_is_in_the_picture() -> None:
    texts = {str(element.text) for element in ElementTree.parse(draw.PICTURE).iter() if element.tag.endswith("text")}
    rooms = {draw.room_of(path) for path in draw.PACKAGE.rglob("*.py")} - {"__init__", *draw.UNSEEN}
    assert rooms == {name.removesuffix(".py") for name in texts & {*rooms, *(f"{room}.py" for room in rooms)}}


def test_a_keyframe_passes_modules_that_are_there() -> None:
    first = [rooms[0] for rooms in draw.LAYERS.values()]
    for step in draw.STEPS:
        assert (draw.PACKAGE / step.module).exists(), f"{step.module}: no such module"
        assert step.module.partition("/")[0] in first, "stops are in the wide rooms of the picture"
    numbers = [int(number) for number in re.findall(r"^(\d+)\. ", PAGE, re.MULTILINE)]
    assert numbers == list(range(1, len(draw.STEPS) + 1)), "a paragraph a stop"


def test_the_page_names_what_is_there() -> None:
    table = PAGE.partition("## Where to change what")[2]
    names = re.findall(r"`([a-z_]+/[a-z_./]*)`", table)
    assert len(names) >= 10
    missing = [name for name in names if not any((folder / name).exists() for folder in (draw.PACKAGE, ROOT))]
    assert missing == []


def test_every_room_lies_within_the_picture() -> None:
    drawn = ElementTree.fromstring(draw.picture())
    _, _, width, height = map(float, drawn.attrib["viewBox"].split())
    boxes = [one.attrib for one in drawn if one.attrib.get("class") == "box"]
    assert len(boxes) == len({room for rooms in draw.LAYERS.values() for room in rooms} - {*draw.UNSEEN})
    for box in boxes:
        left, top = float(box["x"]), float(box["y"])
        assert left >= 0.0 and left + float(box["width"]) <= width, box
        assert top >= 0.0 and top + float(box["height"]) <= height, box
