# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.measurements import Keyframe
from ba_node.offline import check
from ba_node.offline.recording import record
from tests.check.set_ups import recording

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.mark.parametrize("name", ["stereo_loop", "mono_loop"])
def test_sound(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(BAGS / f"{name}.mcap")]) == 0
    assert "the set-up fits the tracks" in capsys.readouterr().out


def test_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "wrong.mcap"
    data = recording(wrong="baseline reversed", keyframes=12, length_m=12.0)
    record(bag, data.timeline(), data.truth)
    assert main(["check", str(bag), "--json", str(tmp_path / "found.json")]) == 3
    out = capsys.readouterr().out
    assert "likely mistake: baseline of camera 1 reversed" in out
    assert "change: the position in body_from_camera of camera 1 in camera_rig" in out
    session = json.loads((tmp_path / "found.json").read_text())["sessions"][0]
    assert session["findings"][0]["causes"][0].startswith("baseline of camera 1 reversed")
    assert max(map(len, out.splitlines())) <= 100, "columns of a usual terminal"
    assert {row["hypothesis"] for row in session["hypotheses"]} >= {"as given", "free", "cameras 0 and 1 swapped"}

    assert main(["replay", str(bag), "--out", str(tmp_path / "out"), "--no-report"]) == 3
    assert "baseline of camera 1 reversed" in capsys.readouterr().err
    written = [line.split()[1:4] for line in (tmp_path / "out" / "trajectory.tum").read_text().splitlines()]
    given = [line.split()[1:4] for line in (tmp_path / "out" / "trajectory_input.tum").read_text().splitlines()]
    assert written == given


@pytest.mark.slow
def test_poses_of_camera_is_a_parameter(tmp_path: Path) -> None:
    bag = tmp_path / "camera.mcap"
    data = recording(wrong="poses of camera", keyframes=20, length_m=18.0)
    record(bag, data.timeline())
    assert main(["check", str(bag)]) == 3
    assert main(["check", str(bag), "--set", "frames.poses_of=camera"]) == 0


@pytest.mark.slow
def test_a_clock_that_is_set_back_parts_the_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    back_ns = 3600 * 10**9
    data = recording(mode="stereo", keyframes=24, length_m=20.0)
    moved = [
        (topic, time_ns, dataclasses.replace(m, stamp_ns=m.stamp_ns - back_ns))
        if isinstance(m, Keyframe) and m.keyframe_id >= 12
        else (topic, time_ns, m)
        for topic, time_ns, m in data.timeline()
    ]
    record(tmp_path / "back.mcap", moved)
    assert main(["check", str(tmp_path / "back.mcap"), "--json", str(tmp_path / "found.json")]) == 3
    told = capsys.readouterr()
    assert "part 1 of 2: session 0, keyframes 0 to 11, stamps" in told.out
    assert "part 2 of 2: session 0, keyframes 12 to 23, stamps" in told.out
    assert "ba: warning: keyframe 12 is 3599.8 s older" in told.err and "the clock was set back" in told.err
    found = json.loads((tmp_path / "found.json").read_text())["sessions"]
    assert [session["keyframe_ids"] for session in found] == [[0, 11], [12, 23]]
    assert not found[0]["warnings"] and "the clock was set back" in found[1]["warnings"][0]


def test_too_little(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "short.mcap"
    data = recording(mode="mono", keyframes=2, length_m=10.0)
    record(bag, data.timeline())
    assert main(["check", str(bag)]) == 2
    assert "the tracks cannot tell" in capsys.readouterr().out


def test_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "none.mcap")]) == 2
    monkeypatch.setattr(check, "can_examine", lambda: False)
    assert main(["check", str(BAGS / "mono_loop.mcap")]) == 2
    assert "python3-opencv" in capsys.readouterr().err


def test_a_recording_of_which_no_keyframe_can_be_used_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = tmp_path / "unfilled.mcap"
    unfilled = (
        (topic, time_ns, dataclasses.replace(one, orientation=np.zeros(4)) if isinstance(one, Keyframe) else one)
        for topic, time_ns, one in recording(keyframes=4, length_m=10.0).timeline()
    )
    record(bag, unfilled)
    assert main(["check", str(bag)]) == 2
    assert "quaternion [0. 0. 0. 0.], expected finite and not zero" in capsys.readouterr().err
