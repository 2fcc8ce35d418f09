# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Maps on the command line: saved by a replay, looked into, exported, gone on from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ba_node.cli.main import main
from ba_node.io.files import locked_folder
from ba_node.io.map_file import is_map
from ba_node.io.trajectory import read_tum
from ba_node.measurements import Keyframe
from ba_node.offline.recording import record
from experiments.synthetic import SyntheticOptions, generate
from tests.ply import read_ply


def replay(bag: Path, out: Path, *options: str) -> int:
    return main(["replay", str(bag), "--out", str(out), "--no-report", *options])


@pytest.fixture(scope="module")
def saved(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    assert replay(bag, folder / "out", "--save-map", str(folder / "site.npz")) == 0
    return folder / "site.npz"


def test_info(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(saved)]) == 0
    told = dict(line.split("  ", 1) for line in capsys.readouterr().out.splitlines())
    assert told["session"].strip() == "0"
    assert (told["frame of the map"].strip(), told["frame of the input"].strip()) == ("map", "odom")
    assert told["cameras"].strip() == "2"
    assert told["keyframes"].strip().startswith("8, 8 refined, 1.8 s, ")


def test_export_gives_what_the_replay_gave(saved: Path, tmp_path: Path) -> None:
    tum, ply = tmp_path / "a.tum", tmp_path / "a.ply"
    assert main(["map", "export", str(saved), "--tum", str(tum), "--ply", str(ply)]) == 0
    assert tum.read_bytes() == (saved.parent / "out" / "trajectory.tum").read_bytes()
    assert ply.read_bytes() == (saved.parent / "out" / "points.ply").read_bytes()
    assert len(read_tum(tum)) == 8
    points, frame = read_ply(ply)
    assert (len(points) > 50, frame) == (True, "map")


def test_the_suffix_is_added(bag: Path, tmp_path: Path) -> None:
    assert replay(bag, tmp_path / "out", "--save-map", str(tmp_path / "site")) == 0
    assert is_map(tmp_path / "site.npz")
    assert not (tmp_path / "site").exists()


def test_two_replays_into_one_folder_are_refused(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with locked_folder(tmp_path / "out"):
        assert replay(bag, tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert f"ba: error: {tmp_path / 'out'}: another process writes its results there" in error
    assert error.count("\n") == 1
    assert replay(bag, tmp_path / "out") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "none.npz"], "ba: error: none.npz: cannot be opened: No such file or directory"),
        (["info", "{saved}", "--tum", "a"], "info writes nothing"),
        (["export", "{saved}"], "export writes what --tum and --ply name"),
        (["export", "{saved}", "--tum", "none/a.tum"], "there is no folder none"),
        (["info", __file__], "not a map: expected an .npz file of ba_node"),
    ],
)
def test_errors_are_one_line(
    saved: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", *(word.format(saved=saved) for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_map_that_holds_the_recording_already_stays_as_it_is(
    saved: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same recording again brings nothing new: it is said how much is known, and the map is written."""
    assert replay(bag, tmp_path / "first") == 0
    n = len(read_tum(tmp_path / "first" / "trajectory.tum"))
    capsys.readouterr()
    again = tmp_path / "again.npz"
    assert replay(bag, tmp_path / "out", "--load-map", str(saved), "--save-map", str(again)) == 3
    told = capsys.readouterr()
    assert f"in the loaded map      {n} keyframes of the recording already" in told.out
    words = "all keyframes of the recording are in the loaded map already; the poses of that map stand"
    assert f"nothing was refined: {words}" in told.err
    assert "18446744073709551615" not in told.err
    for name in ("trajectory.tum", "points.ply"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "first" / name).read_bytes(), name
    assert again.exists()


def test_two_halves_with_a_map_between_give_the_whole(tmp_path: Path) -> None:
    options = SyntheticOptions(seed=5, keyframes=8, landmarks=600, tracks=60, path="line", length_m=10.0)
    data = generate(options)
    first, second = list(data.timeline()), list(data.timeline())
    cut = next(i for i, (_, _, m) in enumerate(first) if isinstance(m, Keyframe) and m.keyframe_id == 4)
    record(tmp_path / "whole.mcap", data.timeline(), data.truth)
    record(tmp_path / "a.mcap", first[:cut], data.truth)
    record(tmp_path / "b.mcap", second[:1] + second[cut:], data.truth)
    middle = str(tmp_path / "middle.npz")
    assert replay(tmp_path / "whole.mcap", tmp_path / "whole") == 0
    assert replay(tmp_path / "a.mcap", tmp_path / "a", "--save-map", middle) == 0
    assert replay(tmp_path / "b.mcap", tmp_path / "b", "--load-map", middle) == 0
    for name in ("trajectory.tum", "points.ply"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


def test_the_final_solve_is_the_same_each_time(bag: Path, tmp_path: Path, saved: Path) -> None:
    for name in ("a", "b"):
        assert replay(bag, tmp_path / name, "--final-optimize", "--save-map", str(tmp_path / f"{name}.npz")) == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes() != saved.read_bytes()
    assert (tmp_path / "a" / "trajectory.tum").read_bytes() == (tmp_path / "b" / "trajectory.tum").read_bytes()
    once, all_of_it = (
        json.loads((folder / "report.json").read_text()) for folder in (saved.parent / "out", tmp_path / "a")
    )
    assert all_of_it["solves"] == once["solves"] + 1
    assert all_of_it["rms_px_without_outliers"]["refined"] <= once["rms_px_without_outliers"]["refined"] * 1.01


def test_a_map_that_cannot_be_loaded_ends_the_replay(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(bag, tmp_path / "out", "--load-map", str(tmp_path / "none.npz")) == 2
    assert "none.npz: cannot be opened" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert replay(bag, tmp_path / "out", "--save-map", str(tmp_path / "none" / "a.npz")) == 2
    assert "there is no folder" in capsys.readouterr().err
