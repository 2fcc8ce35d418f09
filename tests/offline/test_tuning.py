# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.config import Config, declarations
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import TopicChoice
from ba_node.io.parameters import read_parameters
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from ba_node.offline import tuning
from ba_node.offline.measure import Measured, MeasureError, Question, is_held_out, measure
from ba_node.offline.recording import record
from ba_node.offline.study import score_of
from ba_node.offline.tuning import chosen, grid, preset

pytest.importorskip("optuna", reason="needs Optuna: pip install ba_node[tune]")

BAGS = Path(__file__).resolve().parents[2] / "bags"
MONO, STEREO = BAGS / "mono_loop.mcap", BAGS / "stereo_loop.mcap"
# A configuration that nobody wants, and the parameters that make it so.
BAD: dict[str, object] = {
    "window.max_keyframes": 4,
    "window.max_fixed_keyframes": 0,
    "tracks.outlier_px": 1.5,
    "solver.loss_scale_px": 10.0,
    "solver.max_iterations": 2,
}


def measured(bag: Path, objective: str, values: Mapping[str, object]) -> Measured:
    config = Config().with_values(values)
    return measure(Question((str(bag),), config, TopicChoice(), objective))  # type: ignore[arg-type]


def settings(values: Mapping[str, object]) -> list[str]:
    return [word for name, value in values.items() for word in ("--set", f"{name}={value}")]


@pytest.fixture
def truthless(tmp_path: Path) -> Path:
    """Write mono_loop without its truth."""
    path = tmp_path / "truthless.mcap"
    write(path, keep=lambda track_ids: np.ones(len(track_ids), bool))
    return path


def write(path: Path, keep: object) -> None:
    kinds = {Keyframe: "keyframes", FeatureTracks: "feature_tracks", CameraRig: "camera_rig"}

    def timeline() -> list[tuple[str, int, Measurement]]:
        with BagReader(MONO) as reader:
            found = [(kinds[type(one)], stamp, one) for _, stamp, one in reader.measurements() if type(one) in kinds]
        return [(topic, stamp, thinned(one)) for topic, stamp, one in found]

    def thinned(one: Measurement) -> Measurement:
        if not isinstance(one, FeatureTracks):
            return one
        rows = keep(one.track_id)  # type: ignore[operator]
        sigma, depth = (values[rows] if len(values) else values for values in (one.sigma_px, one.depth_m))
        return dataclasses.replace(one, track_id=one.track_id[rows], uv=one.uv[rows], sigma_px=sigma, depth_m=depth)

    record(path, timeline())


@pytest.mark.parametrize("bag", [MONO, pytest.param(STEREO, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_tracks_held_out_tell_bad_parameters_from_good_ones(bag: Path) -> None:
    good, bad = (measured(bag, "held_out", values) for values in ({}, BAD))
    assert (good.unit, bad.unit) == ("sigma", "sigma")
    assert bad.error > 1.03 * good.error
    by_truth = measured(bag, "truth", {})
    assert (by_truth.unit, by_truth.held) == ("m", 0)
    assert by_truth.error == pytest.approx({MONO: 0.0082, STEREO: 0.0053}[bag], rel=0.05)


def test_tracks_are_held_out_by_their_ids_and_never_seen() -> None:
    ids = np.arange(80_000, dtype=np.uint64)
    held = is_held_out(ids)
    assert held.mean() == pytest.approx(1 / 8, rel=0.05)
    assert (is_held_out(ids[::3]) == held[::3]).all()


def test_every_range_holds_its_default_and_is_allowed() -> None:
    tuned = [one for one in declarations() if one.tune is not None]
    assert len(tuned) > 10
    for one in tuned:
        assert one.tune is not None and one.kind in (int, float)
        assert one.tune.low <= one.default <= one.tune.high, one.name  # type: ignore[operator]
        for bound in (one.tune.low, one.tune.high):
            one.check(one.kind(bound))
        assert one.tune.low > 0 or not one.tune.log, one.name
        assert set(one.tune.presets) <= {"accuracy", "latency"}
    assert len(preset("latency")) >= 4
    assert [one.name for one in chosen(["window.max_keyframes", "solver.loss"])] == [
        "window.max_keyframes",
        "solver.loss",
    ]


def test_the_score_counts_recordings_alike() -> None:
    assert score_of([0.01, 50.0], [0.02, 100.0]) == pytest.approx(0.5)
    assert score_of([0.01, 200.0], [0.02, 100.0]) == pytest.approx(1.0)


@pytest.mark.slow
def test_a_bad_configuration_is_tuned_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tune"
    names = ",".join(BAD)
    arguments = ["tune", str(MONO), "--out", str(out), "--parameters", names, "--trials", "15"]
    assert main([*arguments, *settings(BAD)]) == 0
    shown = capsys.readouterr()
    assert "no recording is kept for validation" in shown.err
    result = json.loads((out / "tuning.json").read_text())
    assert len(result["trials"]) == 15
    assert result["trials"][0]["score"] == 1.0
    values = read_parameters(out / "tuned.yaml")
    assert values == result["parameters"] | {}
    default, bad, tuned = (measured(MONO, "truth", one).error for one in ({}, BAD, values))
    assert bad - tuned >= 0.9 * (bad - default)
    assert result["recordings"][str(MONO)]["tuned"]["error"] == pytest.approx(tuned, rel=1e-9)
    assert (out / "index.html").stat().st_size > 1_000_000
    # The same command again goes on where it was, and finds nothing left to do.
    assert main([*arguments, *settings(BAD)]) == 0
    assert json.loads((out / "tuning.json").read_text())["trials"] == result["trials"]
    assert main([*arguments, "--set", "window.max_keyframes=9"]) == 2
    assert "holds a search with other start" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(("bag", "objective", "share"), [(STEREO, "truth", 0.9), (MONO, "held_out", 0.8)])
def test_fifty_trials_close_the_gap_to_the_default(bag: Path, objective: str, share: float, tmp_path: Path) -> None:
    out = tmp_path / "tune"
    arguments = ["tune", str(bag), "--out", str(out), "--parameters", ",".join(BAD), "--objective", objective]
    assert main([*arguments, "--trials", "50", *settings(BAD)]) == 0
    values = read_parameters(out / "tuned.yaml")
    default, bad, tuned = (measured(bag, "truth", one).error for one in ({}, BAD, values))
    assert bad - tuned >= share * (bad - default), f"{bad:.4f} -> {tuned:.4f} m, default {default:.4f} m"


@pytest.mark.slow
def test_several_processes_find_as_well_and_one_recording_is_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    out = tmp_path / "tune"
    arguments = ["tune", str(STEREO), str(MONO), "--out", str(out), "--trials", "12", "--jobs", "2"]
    assert main([*arguments, "--parameters", ",".join(BAD), *settings(BAD)]) == 0
    assert "mono_loop (validation)" in capsys.readouterr().out
    result = json.loads((out / "tuning.json").read_text())
    assert result["validation"] == str(MONO)
    assert not result["overfitted"]
    both = result["recordings"][str(MONO)]
    assert both["tuned"]["error"] < 0.5 * both["start"]["error"]


@pytest.mark.slow
def test_nothing_better_leaves_the_start_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tune"
    code = main(["tune", str(MONO), "--out", str(out), "--parameters", "scene.max_keyframes", "--trials", "2"])
    assert code == 2
    assert "has no range in which it is worth tuning; these have: window.max_keyframes" in capsys.readouterr().err
    code = main(["tune", str(MONO), "--out", str(out), "--parameters", "solver.cheirality", "--trials", "3"])
    assert code == 3
    assert "nothing better was found" in capsys.readouterr().err
    assert read_parameters(out / "tuned.yaml") == {}


@pytest.mark.slow
def test_a_limit_of_latency_that_nothing_keeps_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["tune", str(MONO), "--out", str(tmp_path), "--parameters", "window.max_keyframes", "--trials", "2"]
    assert main([*arguments, "--max-latency-ms", "1e-3"]) == 3
    assert "no trial kept within 0.001 ms" in capsys.readouterr().err
    assert main([*arguments, "--max-latency-ms", "0"]) == 2
    assert main([*arguments[:-1], "0"]) == 2


@pytest.mark.slow
def test_without_truth_tracks_that_are_held_out_decide(truthless: Path, tmp_path: Path) -> None:
    out = tmp_path / "sweep"
    arguments = ["sweep", str(truthless), "--out", str(out), "--values", "window.max_keyframes=4,20"]
    assert main([*arguments, "--set", "window.max_fixed_keyframes=0"]) == 0
    few, many = json.loads((out / "sweep.json").read_text())["combinations"]
    assert few["parameters"] == {"window.max_keyframes": 4}
    few, many = (one["recordings"][str(truthless)] for one in (few, many))
    assert few["unit"] == "sigma"
    assert many["error"] < few["error"]


@pytest.mark.slow
def test_neither_truth_nor_tracks_to_hold_out_is_said(
    truthless: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = tmp_path / "few.mcap"
    write(few, keep=lambda track_ids: ~is_held_out(track_ids))
    assert main(["tune", str(few), "--out", str(tmp_path / "tune"), "--trials", "2"]) == 2
    assert "neither ground_truth/pose nor enough tracks to hold out" in capsys.readouterr().err
    assert main(["tune", str(truthless), "--out", str(tmp_path / "tune"), "--objective", "truth"]) == 2
    assert "no ground_truth/pose in it" in capsys.readouterr().err
    assert main(["tune", "--out", str(tmp_path / "tune")]) == 2
    assert "no recording to tune on" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sweep_is_every_combination(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert list(grid({"a": [1, 2], "b": [3, 4]})) == [
        {"a": 1, "b": 3}, {"a": 1, "b": 4}, {"a": 2, "b": 3}, {"a": 2, "b": 4}
    ]  # fmt: skip
    arguments = ["sweep", str(MONO), "--out", str(tmp_path), "--values", "window.max_keyframes=5,20"]
    arguments += ["--set", "factors.adjust_m=0"]  # windows alone differ more
    assert main([*arguments, "--values", "tracks.outlier_px=6"]) == 0
    lines = (tmp_path / "sweep.csv").read_text().splitlines()
    assert lines[0] == "window.max_keyframes,tracks.outlier_px,mono_loop [m],solve p95 [ms]"
    errors = [float(line.split(",")[2]) for line in lines[1:]]
    assert errors[1] == pytest.approx(0.0122, rel=0.05)
    assert errors[0] > 2.0 * errors[1]
    assert main([*arguments, "--values", "tracks.outlier_px=x"]) == 2
    assert "parameter tracks.outlier_px = 'x': expected float" in capsys.readouterr().err


@pytest.mark.slow
def test_a_recording_that_cannot_be_used_is_left_out_and_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(MONO.read_bytes()[:3000])
    arguments = ["--out", str(tmp_path / "sweep"), "--values", "window.max_keyframes=20"]
    assert main(["sweep", str(broken), str(MONO), *arguments]) == 3
    shown = capsys.readouterr()
    assert f"ba: error: {broken}: no message can be read" in shown.err
    assert "mono_loop [m]" in shown.out
    assert main(["sweep", str(broken), *arguments]) == 2


@pytest.mark.slow
def test_an_interrupted_sweep_keeps_what_is_through(tmp_path: Path) -> None:
    values = ",".join(str(n) for n in range(4, 40))
    command = [sys.executable, "-m", "ba_node.cli.main", "sweep", str(MONO), "--out", str(tmp_path)]
    process = subprocess.Popen([*command, "--values", f"window.max_keyframes={values}"], stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60.0
    while not (tmp_path / "sweep.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130, error
    lines = (tmp_path / "sweep.csv").read_text().splitlines()
    assert 2 <= len(lines) < 37
    assert len(json.loads((tmp_path / "sweep.json").read_text())["combinations"]) in {len(lines) - 1, len(lines)}


@pytest.mark.slow
def test_a_combination_that_gives_nothing_is_named_and_stops_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def choosy(question: Question) -> Measured:
        if question.config.window.max_keyframes == 5:
            raise MeasureError("nothing came of it")
        return measure(question)

    monkeypatch.setattr(tuning, "measure", choosy)
    arguments = ["sweep", str(MONO), "--out", str(tmp_path), "--values"]
    assert main([*arguments, "window.max_keyframes=5,20"]) == 3
    shown = capsys.readouterr()
    assert f"ba: error: window.max_keyframes=5, {MONO}: nothing came of it" in shown.err
    assert [line.split(",")[0] for line in (tmp_path / "sweep.csv").read_text().splitlines()[1:]] == ["20"]
    assert main([*arguments, "window.max_keyframes=5"]) == 2
    assert "nothing came of it" in capsys.readouterr().err
