# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What has to be looked at after a replay."""

from __future__ import annotations

from typing import Any

from ba_node.offline.attention import attention


def _session(number: int = 0, **changes: Any) -> dict[str, Any]:
    return {
        "session_id": number,
        "solves": 9,
        "solves_by_status": {"CONVERGED": 9},
        "warnings": {},
        "rejected": {},
        **changes,
    }


def _report(*older: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {**_session(**changes), "older_sessions": list(older), "bag_rejected": changes.get("bag_rejected", {})}


def test_sound_data_needs_no_look() -> None:
    assert attention(_report(_session(7))) == []


def test_what_comes_twice_is_harmless() -> None:
    assert attention(_report(rejected={"duplicate_keyframe": 3})) == []


def test_each_thing_is_a_line() -> None:
    held = _session(4, solves_by_status={"CONVERGED": 7, "HELD": 2}, warnings={"held": "step of 60 m"})
    lines = attention(_report(held, rejected={"bad_pose": 1, "duplicate_keyframe": 2}, bag_rejected={"corrupt": 5}))
    assert lines == [
        "step of 60 m",
        "session 4: 2 of 9 solves held: their result was not taken",
        "session 0: turned away: 1 bad_pose",
        "turned away: 5 corrupt",
    ]


def test_a_cause_is_said_once() -> None:
    setup = {"setup": "depth_m in millimetres (over 5 pairs): change depth_m"}
    reason = "the set-up contradicts the tracks: depth_m in millimetres"
    nothing = {"keyframes_refined": 0, "unrefined": reason, "solves_by_status": {"HELD": 8, "SKIPPED": 1}}
    told = "nothing was refined: 8 of 9 solves held; the front-end's poses stand"
    assert attention(_report(warnings=setup, **nothing)) == [setup["setup"], told]
    held = {"held": "a solution was held: too little parallax"}
    assert attention(_report(warnings=held, **{**nothing, "unrefined": "too little parallax"})) == [held["held"], told]
    assert attention(_report(**{**nothing, "unrefined": "one keyframe only", "solves_by_status": {"SKIPPED": 9}})) == [
        "nothing was refined: one keyframe only; the front-end's poses stand"
    ]


def test_keyframes_that_were_left_are_no_fault_by_themselves() -> None:
    assert attention(_report(keyframes_refined=38, unrefined="keyframes 0 to 11: no parallax")) == []


def test_a_result_that_is_worse_than_its_input_is_said() -> None:
    worse = {"median_px": {"input": 0.4, "refined": 0.9}, "bounded_px": {"input": 1.0, "refined": 1.02}}
    assert attention(_report(**worse)) == [
        "the result explains the observations worse than what came in: median residual 0.4 -> 0.9 px"
    ]
    assert attention(_report(rms_px={"input": 2.0, "refined": 28.0})) == [
        "the result explains the observations worse than what came in: rms of all 2 -> 28 px"
    ]
    nothing = {"rms_px": {"input": None, "refined": None}, "median_px": {"input": 0.5, "refined": None}}
    assert attention(_report(**nothing)) == []


def test_one_outlier_that_is_farther_off_is_no_worse_result() -> None:
    """As where a mismatch of 60 px is one of 250 px once its point is well placed."""
    rms = {"rms_px": {"input": 3.1, "refined": 5.1}, "median_px": {"input": 1.2, "refined": 0.6}}
    assert attention(_report(**rms, bounded_px={"input": 2.0, "refined": 1.5})) == []
    worse = "the result explains the observations worse than what came in: rms of all 3.1 -> 5.1 px"
    assert attention(_report(**rms, bounded_px={"input": 1.5, "refined": 1.52})) == [worse]
    assert attention(_report(**rms, bounded_px={"input": None, "refined": None})) == [worse]


def test_a_result_that_explains_little_is_said() -> None:
    """As of five keyframes with wrong extrinsics, which are too few for a check to tell these."""
    of = {"keyframes_refined": 5, "median_px": {"input": 14.2, "refined": 3.4}}
    (line,) = attention(_report(median_sigmas={"input": 47.0, "refined": 11.4}, **of))
    assert "half of it is over 11 sigmas (3.4 px) off" in line and "body_from_camera" in line
    assert attention(_report(median_sigmas={"input": 47.0, "refined": 1.3}, **of)) == []
