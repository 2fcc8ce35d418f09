# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings by the table of other front-ends' fields are read, refined towards the truth, and each trap is met."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.io.trajectory import read_tum
from ba_node.measurements import FeatureTracks, Keyframe
from ba_node.messages.adapters import SOURCES, Adapter, AdapterOptions
from tests.messages.adapters import field_table, layouts
from tests.messages.adapters.field_table import Seen
from tests.messages.adapters.layouts import Sent

# Keyframes of 24 images: chosen of those that send every one, all but the last 8 of the late one.
LEAST = {"openvins": 6, "vins_fusion": 16, "vins_mono": 6, "rtabmap": 6, "rtabmap_map": 24}


def drive(source: str) -> list[Seen]:
    """Return the drive, without a lens where a source tells rectified pixels."""
    return field_table.drive(lens=not source.startswith("rtabmap"))


def distances(path: Path, seen: list[Seen]) -> Any:
    """Return how far positions of a trajectory are from the truth, m; both begin in one place."""
    told = read_tum(path)
    stamps = np.array([one.stamp_ns for one in seen])
    rows = np.abs(stamps[:, None] - told.stamp_ns).argmin(axis=0)
    assert np.abs(stamps[rows] - told.stamp_ns).max() < 1000
    return np.linalg.norm(told.position - np.array([seen[row].true[1] for row in rows]), axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("source", LEAST)
def test_a_recording_is_read_and_every_keyframe_refined(
    source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = drive(source)
    bag = layouts.write(tmp_path / "bag", getattr(field_table, source)(seen))
    out, refined = tmp_path / "out.mcap", tmp_path / "replay"
    assert main(["convert", str(bag), str(out), "--from", source]) == 0, capsys.readouterr().err
    assert main(["replay", str(out), "--out", str(refined), "--final-optimize", "--no-report"]) == 0
    report = json.loads((refined / "report.json").read_text())
    assert report["keyframes_refined"] == report["keyframes"] >= LEAST[source]
    before, after = (distances(refined / name, seen) for name in ("trajectory_input.tum", "trajectory.tum"))
    assert after.mean() <= 1.1 * before.mean(), f"{before.mean():.4f} -> {after.mean():.4f} m"


def feed(source: str, messages: list[Sent], cameras: int = 1) -> tuple[Adapter, list[Any]]:
    """Give an adapter the messages that are on its topics."""
    adapter = Adapter(SOURCES[source](cameras), AdapterOptions())
    names = {one.name for one in SOURCES[source].inputs}
    taken = [(sent.topic.rpartition("/")[2], sent.message) for sent in messages]
    return adapter, [one for name, message in taken if name in names for _, _, one in adapter.take(name, message)]


def clouds(messages: list[Sent]) -> list[Any]:
    return [sent.message for sent in messages if sent.type_name == layouts.CLOUD]


def unseen_by_camera_0(messages: list[Sent], adapter: Adapter, out: list[Any]) -> None:
    zero = sum(channel.values[2] == 0.0 for cloud in clouds(messages) for channel in cloud.channels)
    assert adapter.counted["not_seen_by_camera_0"] == zero > 100
    assert all((one.uv > 0.0).all() for one in out if isinstance(one, FeatureTracks))


def keyframes_are_chosen(_messages: list[Sent], adapter: Adapter, out: list[Any]) -> None:
    assert adapter.images == field_table.COUNT
    sent = [one for one in out if isinstance(one, Keyframe)]
    assert 4 <= len(sent) <= 20


def camera_0_alone(_messages: list[Sent], _adapter: Adapter, out: list[Any]) -> None:
    assert {one.camera_index for one in out if isinstance(one, FeatureTracks)} == {0}


def stamps_pair(messages: list[Sent], adapter: Adapter, _out: list[Any]) -> None:
    stamps = [sent.message.header.stamp.nanosec for sent in messages if "keyframe" in sent.topic]
    apart = np.abs(np.diff(stamps)[::2])
    assert 0 < apart.max() <= 240
    assert adapter.sent == 16 and not adapter.counted["no_pose"]


def ids_are_exact(messages: list[Sent], adapter: Adapter, out: list[Any]) -> None:
    assert not adapter.counted["inexact_id"]
    told = {int(channel.values[4]) for cloud in clouds(messages) for channel in cloud.channels}
    assert {int(key) for one in out if isinstance(one, FeatureTracks) for key in one.track_id} == told


def ids_are_divided(_messages: list[Sent], _adapter: Adapter, out: list[Any]) -> None:
    tracks = next(one for one in out if isinstance(one, FeatureTracks))
    assert tracks.track_id.tolist() == drive("vins_mono")[0].ids.tolist()


def words_of_the_local_map_alone(_messages: list[Sent], adapter: Adapter, out: list[Any]) -> None:
    assert adapter.counted["not_in_the_local_map"] == 6 * field_table.COUNT
    assert max(int(one.track_id.max()) for one in out if isinstance(one, FeatureTracks)) < 100_000


def words_come_again(_messages: list[Sent], adapter: Adapter, out: list[Any]) -> None:
    """A word that two features of one image share is left out; the others tie all nodes to each other."""
    assert adapter.counted["ambiguous_word"] > 0
    first, last = (one.track_id for one in out if isinstance(one, FeatureTracks) if one.keyframe_id in (1, 16))
    assert len(np.intersect1d(first, last)) > 20


@pytest.mark.parametrize(
    ("source", "trap"),
    [
        ("openvins", unseen_by_camera_0),
        ("openvins", keyframes_are_chosen),
        ("openvins", camera_0_alone),
        ("vins_fusion", camera_0_alone),
        ("vins_fusion", stamps_pair),
        ("vins_fusion", ids_are_exact),
        ("vins_mono", keyframes_are_chosen),
        ("vins_mono", ids_are_divided),
        ("rtabmap", words_of_the_local_map_alone),
        ("rtabmap", keyframes_are_chosen),
        ("rtabmap_map", words_come_again),
    ],
)
def test_traps(source: str, trap: Callable[[list[Sent], Adapter, list[Any]], None]) -> None:
    cameras = 2 if trap is ids_are_divided else 1
    extra = {"cameras": cameras} if cameras > 1 else {}
    messages = list(getattr(field_table, source)(drive(source), **extra))
    adapter, out = feed(source, messages, cameras)
    trap(messages, adapter, out)


@pytest.mark.parametrize(
    ("source", "spoil", "words"),
    [
        # VINS-Fusion does not publish the tracker's topic.
        ("vins_mono", lambda _: list(field_table.vins_fusion(drive("vins_fusion"))), "(--from vins_fusion)"),
        # An OpenVINS that was recorded without subscribing to all it tells.
        (
            "openvins",
            lambda sent: [one for one in sent if "extrinsic" not in one.topic],
            "no loop_extrinsic (nav_msgs/msg/Odometry)",
        ),
        ("rtabmap", lambda sent: _emptied(sent, 0), "Odom/FillInfoData"),
        ("rtabmap", lambda sent: _emptied(sent, 1), "Odom/Strategy 0"),
    ],
)
def test_what_cannot_be_read_names_the_trap(
    source: str,
    spoil: Callable[[list[Sent]], list[Sent]],
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    messages = spoil(list(getattr(field_table, source)(drive(source))))
    bag = layouts.write(tmp_path / "bag", messages)
    assert main(["convert", str(bag), str(tmp_path / "out.mcap"), "--from", source]) == 2
    told = capsys.readouterr().err
    assert words in told and told.count("\n") == 1, told


def test_a_lens_that_was_made_up_is_no_camera_info() -> None:
    """An extrinsic that comes after the first image has its camera made of the rays of that one, once."""
    adapter, out = feed("vins_mono", list(field_table.vins_mono(drive("vins_mono"))))
    assert adapter.sent >= 6 and len(out) > 6
    assert adapter.notes["camera"].startswith("no camera_info: the source's undistorted points are taken")


def _emptied(messages: list[Sent], kind: int) -> list[Sent]:
    """Return messages without words, as odometry of a kind (0 F2M, 1 F2F) leaves them."""
    for sent in messages:
        if sent.topic.endswith("odom_info"):
            sent.message.words_keys, sent.message.words_values = np.zeros(0, np.int32), []
            sent.message.type = kind
    return messages
