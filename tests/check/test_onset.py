# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Images that are others from a keyframe on are named, with that keyframe; the map before it stays."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest

from ba_node.backend import Backend
from ba_node.check.onset import check_onset
from ba_node.check.tracks import Tracks
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.cameras import CX, CY
from experiments.synthetic import SyntheticOptions, generate
from experiments.synthetic.world import Path, World
from tests.check.set_ups import recording, seen
from tests.check.test_watch import play

SINCE = 20
Pixels = np.ndarray


def changed(tracks: Tracks, change: Callable[[Pixels], Pixels], first: int, last: int, camera: int = 0) -> Tracks:
    """Return tracks with other pixels, about the principal point, in the images of some keyframes."""
    rows = (tracks.keyframe >= first) & (tracks.keyframe < last) & (tracks.camera == camera)
    centre = tracks.cameras.params[camera, CX : CY + 1]
    uv = tracks.uv.copy()
    uv[rows] = centre + change(uv[rows] - centre)
    return tracks.seen(uv)


CHANGES: dict[str, tuple[Callable[[Pixels], Pixels], str, tuple[float, ...]]] = {
    "zoomed": (lambda px: 1.1 * px, r"focal length of camera 0 from stamp (\S+) s on is (\S+) times", (1.1,)),
    "smaller": (lambda px: 0.8 * px, r"focal length of camera 0 from stamp (\S+) s on is (\S+) times", (0.8,)),
    "region": (
        lambda px: px - [40.0, -25.0],
        r"region of interest .* of camera 0 from stamp (\S+) s on is another, by \((\S+), (\S+)\) px",
        (-40.0, 25.0),
    ),
    "mirrored": (lambda px: px * [-1.0, 1.0], r"images of camera 0 from stamp (\S+) s on are mirrored: left", ()),
}


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("mode", ["mono", "stereo"])
def test_the_keyframe_and_what_it_is_are_named(name: str, mode: str) -> None:
    change, words, truth = CHANGES[name]
    tracks = seen(recording(mode=mode, path="line"), 40)
    found = check_onset(changed(tracks, change, SINCE, 40))
    text = "; ".join(one.causes[0] for one in found.findings)
    match = re.search(words, text)
    assert match, text
    assert float(match[1]) == pytest.approx(tracks.stamp_ns[SINCE] * 1e-9, abs=1e-3)
    assert [one.since_ns for one in found.findings] == [tracks.stamp_ns[SINCE]]
    assert [float(value) for value in match.groups()[1:]] == pytest.approx(truth, rel=0.1)


@pytest.mark.parametrize("mode", ["mono", "stereo", "rgbd"])
@pytest.mark.parametrize("path", ["line", "loop"])
def test_sound_images_are_not_named(mode: str, path: str) -> None:
    assert not check_onset(seen(recording(mode=mode, path=path), 60)).findings


def test_one_image_or_a_jump_of_the_poses_is_no_change() -> None:
    tracks = seen(recording(mode="mono", path="line"), 40)
    assert not check_onset(changed(tracks, CHANGES["zoomed"][0], SINCE, SINCE + 1)).findings
    position = tracks.position.copy()
    position[SINCE:] += 0.5 * (tracks.position[SINCE] - tracks.position[SINCE - 1])
    assert not check_onset(dataclasses.replace(tracks, position=position)).findings
    turn = geometry.so3_exp(np.radians([0.0, 0.0, 3.0]))
    rotation = tracks.rotation.copy()
    rotation[SINCE:] = rotation[SINCE:] @ turn
    assert not check_onset(dataclasses.replace(tracks, rotation=rotation)).findings


def test_the_map_before_it_stays() -> None:
    """From some keyframes before the change on the front-end's steps stand, carried along by the last correction."""
    data = recording(mode="stereo", path="line", keyframes=85, length_m=85.0)
    centre = data.rig.intrinsics[1, 2:4]
    mirrored = [
        (left, dataclasses.replace(right, uv=centre + (right.uv - centre) * [-1.0, 1.0]))
        for left, right in data.tracks[55:]
    ]
    data = dataclasses.replace(data, tracks=(*data.tracks[:55], *mirrored))
    backend = Backend(Config())
    play(backend, data)
    table, order = backend.scene.keyframes, backend.scene.order
    assert "mirrored" in backend.setup.reason(backend.scene)
    refined = table.refined[order]
    kept = int(np.count_nonzero(refined))
    assert 40 <= kept < 55 and refined[:kept].all()
    later = order[kept - 1 :]
    pairs = later[:-1], later[1:]
    solved = geometry.steps_between(table.rotation, table.position, *pairs)
    given = geometry.steps_between(table.input_rotation, table.input_position, *pairs)
    for ours, its in zip(solved, given, strict=True):
        assert np.abs(ours - its).max() < 1e-9
    placed = np.flatnonzero(backend.scene.landmarks.has_position)
    views = backend.scene.views_of(placed)
    assert len(placed) and np.isin(backend.scene.observations.keyframe[views], order[:kept]).all()


@pytest.mark.parametrize(("keyframes", "look_deg"), [(3, 180.0), (6, 90.0), (10, 180.0)])
def test_a_jump_after_a_stand_still_is_no_change(keyframes: int, look_deg: float) -> None:
    """What had no parallax while the camera stood may be anywhere."""

    def motion(world: World, path: Path) -> tuple[World, Path]:
        k = np.arange(len(path.position))
        rows = np.where(k < 20, 0, np.minimum(k[-1], k - 20 + keyframes))
        still = 1e-3 * np.cumsum(np.append(0, np.diff(rows) == 0))
        return world, Path(path.position[rows], path.rotation[rows], path.distance[rows] + still)

    options = SyntheticOptions(keyframes=40, path="line", length_m=20.0, baseline_m=0.0, look_deg=look_deg, tracks=150)
    found = check_onset(seen(generate(options, motion)))
    assert not found.findings, found.summary()
