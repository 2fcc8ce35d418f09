# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What `ba track` and `ba run` say of recordings that are sound, and yet not what a user took them for."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from ba_node.cli.main import main
from ba_node.estimate import Transform
from ba_node.io.rig_file import rig_yaml
from tests.front_end import world

pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")

FEW = ["--track", "max_features=200"]


def folder(path: Path, poses: list[Transform], sides: tuple[str, ...] = ("left", "right")) -> Path:
    """Write what a rig sees from each pose, by number; of one camera too, whose folder has no sides."""
    rig = world.rig(len(sides))
    for index, side in enumerate(sides):
        below = path / side if len(sides) > 1 else path
        below.mkdir(parents=True, exist_ok=True)
        for i, pose in enumerate(poses):
            cv2.imwrite(str(below / f"{i:06d}.png"), world.render(rig, index, pose).grey)
    (path / "rig.yaml").write_text(rig_yaml(rig, "own")[0])
    return path


def test_how_long_the_camera_stood_still(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    way = world.drive(6)
    source = folder(tmp_path / "source", way[:3] + 12 * way[2:3] + way[3:])
    assert main(["track", str(source), str(tmp_path / "out.mcap"), *FEW]) == 0
    text, errors = capsys.readouterr()
    assert "stood still" in text and "in 13 of 18 images, 1.2 s" in text and errors == ""


@pytest.mark.parametrize(
    ("sides", "code", "words"),
    [
        (("left", "right"), 3, "the camera did not move enough in 5 images (0.4 s) for a second keyframe"),
        (("left",), 2, "the camera did not move enough in 5 images (0.4 s) for a map to begin"),
    ],
)
def test_a_camera_that_never_moves(
    sides: tuple[str, ...], code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = folder(tmp_path / "source", 5 * world.drive(1), sides)
    assert main(["track", str(source), str(tmp_path / "out.mcap"), *FEW]) == code
    assert words in capsys.readouterr().err
