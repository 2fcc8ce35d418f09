# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Two faults at once, and faults on other lenses, ways and by other amounts: no harm, and some causes in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from experiments.robustness.faults.spoil import spoiled_by
from tests.cases.conftest import Replay, harmless
from tests.cases.test_siblings import write


@dataclass(frozen=True)
class Combined:
    """A recording: faults with their amounts, what it is made of, and a pattern that the words have to show."""

    faults: tuple[tuple[str, float | None], ...]
    rig: str
    seed: int
    changes: Mapping[str, Any]
    named: str = ""


LOOP = {"path": "loop", "length_m": 30.0, "keyframes": 60}
GOOD = {"drift_rotation_deg": 0.02, "drift_translation": 0.002}
CASES = (
    Combined((("focal_slightly_off", 1.05), ("outliers_uniform", 0.2)), "stereo", 801, {}, "scale of focal"),
    Combined((("focal_slightly_off", 0.95), ("outliers_moving", 0.2)), "mono", 802, {"path": "loop"}, "focal"),
    Combined((("focal_slightly_off", 0.9),), "stereo", 803, {"distortion": "equidistant", "fov_deg": 120.0}, "focal"),
    Combined(
        (("focal_slightly_off", 1.1),),
        "mono",
        804,
        {"distortion": "equidistant", "fov_deg": 120.0, "path": "loop"},
        "focal",
    ),
    Combined((("depth_slightly_off", 0.95), ("outliers_uniform", 0.2)), "rgbd", 805, {}, "depth_m"),
    Combined((("depth_slightly_off", 1.1),), "rgbd", 806, {"distortion": "equidistant", "fov_deg": 110.0}, "depth_m"),
    Combined(
        (("baseline_off", 1.07), ("outliers_jumping", 0.2)), "stereo", 807, {"path": "loop"}, "scale of focal|baseline"
    ),
    Combined((("camera_turned", 0.3), ("outliers_uniform", 0.2)), "stereo", 808, {}, ""),
    Combined(
        (("camera_turned", 1.0),),
        "stereo",
        809,
        {"distortion": "equidistant", "fov_deg": 120.0, "path": "loop"},
        "camera 1",
    ),
    Combined((("sigma_off", 10.0), ("outliers_uniform", 0.3)), "mono", 810, {}, ""),
    Combined((("sigma_off", 10.0), ("outliers_moving", 0.3)), "rgbd", 811, {}, ""),
    Combined((("sigma_off", 0.1), ("outliers_jumping", 0.2)), "stereo", 812, {}, ""),
    Combined((("one_keyframe_far", 5.0), ("outliers_moving", 0.3)), "stereo", 813, {}, ""),
    Combined(
        (("one_keyframe_far", 60.0),), "mono", 814, {"distortion": "equidistant", "fov_deg": 120.0, "path": "loop"}, ""
    ),
    Combined((("ids_reused", None),), "mono", 815, {"path": "loop", "look_deg": 90.0}, ""),
    Combined((("stands_still", 15.0), ("wrong_ids", 3.0)), "mono", 816, {}, ""),
    Combined((("stands_still", 30.0), ("outliers_uniform", 0.3)), "mono", 817, {}, ""),
    Combined((("stops_midway", 20.0), ("outliers_moving", 0.4)), "stereo", 818, {}, ""),
    Combined((("pure_rotation", 5.0), ("outliers_uniform", 0.2)), "mono", 819, {}, ""),
    Combined((("pure_rotation", 8.0),), "mono", 2, {}, ""),
    Combined((("pure_rotation", 12.0),), "stereo", 820, {}, ""),
    Combined((("pure_rotation", 8.0),), "rgbd", 821, {}, ""),
    Combined((("few_points", 6.0),), "rgbd", 822, {}, ""),
    Combined((("few_points", 12.0),), "mono", 823, {"path": "loop"}, ""),
    Combined((("few_points", 10.0),), "stereo", 824, {"distortion": "equidistant", "fov_deg": 120.0}, ""),
    Combined((("focal_slightly_off", 1.1), ("clock_set_back", 120.0)), "stereo", 825, {}, "scale of focal"),
    Combined((("roi_ignored", 40.0),), "mono", 826, {"path": "loop"}, "region"),
    Combined((("duplicates", 0.05), ("one_stamp_zero", None)), "rgbd", 827, {}, ""),
    Combined((("outliers_moving", 0.6),), "rgbd", 828, {"path": "loop"}, ""),
    Combined((("outliers_moving", 0.5),), "stereo", 829, {"look_deg": 90.0}, ""),
    Combined((("outliers_moving", 0.5),), "mono", 830, {"path": "loop"}, ""),
    Combined((("extrinsics_inverted", None), ("outliers_uniform", 0.3)), "stereo", 831, {}, "invert"),
    Combined((("steps_scaled", 1.08), ("outliers_uniform", 0.1)), "stereo", 832, {"path": "loop"}, "scale"),
    Combined((("depth_in_mm", 1000.0), ("stands_still", 15.0)), "rgbd", 833, {}, "millimetres"),
    Combined((("hardly_moves", 3.0), ("outliers_uniform", 0.1)), "mono", 834, {}, ""),
    Combined((("far_points", 2.0),), "rgbd", 835, {}, ""),
    Combined((("outliers_jumping", 0.6),), "mono", 836, {}, ""),
    Combined((("sigma_off", 0.02), ("focal_slightly_off", 1.05)), "rgbd", 837, {}, ""),
    Combined((("poses_inverted", None), ("outliers_moving", 0.3)), "mono", 838, {"path": "loop"}, "invert"),
    Combined((("focal_slightly_off", 1.05),), "mono", 839, {"look_deg": 90.0}, "focal"),
    Combined((("focal_slightly_off", 0.93),), "rgbd", 840, {"path": "loop"}, "focal"),
    Combined((("rectified_with_distortion", 0.5),), "mono", 841, {"path": "loop"}, "rectified though a distortion"),
    Combined((("steps_scaled", 0.95),), "stereo", 842, {}, "scale"),
    Combined((("baseline_reversed", None), ("stands_still", 15.0)), "stereo", 851, {}, "baseline|swapped"),
    Combined((("swapped_midway", None), ("outliers_uniform", 0.2)), "stereo", 852, {"path": "loop"}, "swapped"),
    Combined((("depth_mm_midway", 1000.0), ("stops_midway", 12.0)), "rgbd", 853, {}, "millimetres"),
    Combined((("extrinsics_inverted", None),), "mono", 854, {"path": "loop", "look_deg": 90.0}, "invert"),
    Combined((("clock_set_back", 7.0), ("outliers_jumping", 0.2)), "rgbd", 855, {"path": "loop"}, "stamp|clock"),
    Combined((("camera_turned", 2.0), ("outliers_moving", 0.2)), "stereo", 856, {"path": "loop"}, "camera 1"),
    Combined((("one_stamp_zero", None), ("one_keyframe_far", 20.0)), "rgbd", 857, {}, "stamp"),
    Combined((("stands_still", 25.0), ("depth_in_mm", 1000.0)), "rgbd", 858, {"look_deg": -60.0}, "millimetres"),
    Combined((("camera_turned", 0.5),), "stereo", 902, {"baseline_m": 0.6}, "camera 1"),
    Combined((("baseline_reversed", None),), "stereo", 903, {"baseline_m": 0.05, "look_deg": 90.0}, "baseline|swapped"),
    Combined((("extrinsics_inverted", None),), "rgbd", 904, {"look_deg": 45.0, **LOOP}, "invert"),
    Combined(
        (("clock_set_back", 11.0),),
        "mono",
        905,
        {"ids": "random64", "distortion": "equidistant", "fov_deg": 120.0},
        "stamp|clock",
    ),
    Combined((("all_turned", 5.0),), "rgbd", 906, GOOD, "camera 0 does not fit"),
    Combined((("all_turned", -8.0), ("outliers_uniform", 0.1)), "mono", 907, {}, "camera 0 does not fit"),
    Combined((("depth_slightly_off", 1.02),), "rgbd", 908, GOOD, "scale of depth_m"),
    Combined((("steps_scaled", 1.04),), "stereo", 909, GOOD, "scale of the front-end's steps"),
    Combined((("outliers_moving", 0.65),), "mono", 904, {}, ""),
    Combined((("pure_rotation", 6.0),), "mono", 904, {"distortion": "equidistant", "fov_deg": 120.0}, ""),
    Combined((("ids_reused", None), ("outliers_uniform", 0.15)), "rgbd", 906, {}, r"\bids?\b"),
    Combined((("few_points", 5.0),), "rgbd", 903, {"outlier_share": 0.1, **LOOP}, ""),
    Combined((("wrong_ids", 8.0),), "mono", 903, {"ids": "random64"}, ""),
    Combined((("stands_still", 35.0),), "mono", 902, {"keyframes": 60, "path": "loop", "length_m": 30.0}, ""),
    Combined((("region_midway", 40.0),), "mono", 7500, {}, "region|camera 0 does not fit"),
    Combined((("region_midway", 40.0),), "rgbd", 2803, {}, r"region .* of camera 0 from stamp 17\S+ s on"),
    # Too few points are seen by three keyframes around the change: all images together tell it.
    Combined((("region_midway", 40.0),), "mono", 8500, {"look_deg": 90.0}, "region of interest .* of camera 0 from"),
    Combined((("region_midway", 15.0),), "mono", 9504, {"look_deg": 90.0}, "another region of interest"),
    Combined((("region_midway", 40.0),), "mono", 8701, {"look_deg": 90.0, **LOOP}, "region of interest .* of camera 0"),
    Combined(
        (("region_midway", 20.0),), "stereo", 9507, {"look_deg": 90.0, **LOOP}, "region of interest .* of camera 1"
    ),
    Combined(
        (("zoomed_midway", 1.2),), "mono", 8700, {"look_deg": 90.0}, "a solution was held|solutions are held|focal"
    ),
    Combined((("zoomed_midway", 1.2),), "mono", 8700, {"look_deg": 90.0, **LOOP}, "focal length of camera 0 from"),
    Combined((("zoomed_midway", 1.05),), "stereo", 9508, {"look_deg": 90.0}, "zoomed"),
    Combined(
        (("zoomed_midway", 1.2), ("outliers_uniform", 0.3)), "mono", 9510, {"look_deg": 90.0, **LOOP}, "focal length"
    ),
    Combined((("outliers_uniform", 0.2), ("zoomed_midway", 1.12)), "stereo", 8007, {}, "focal length of camera 0 from"),
    Combined((("zoomed_midway", 1.15), ("outliers_uniform", 0.2)), "stereo", 11002, {"look_deg": 90.0}, "zoomed"),
    Combined((("region_midway", 12.0),), "stereo", 11013, {"look_deg": 90.0}, "another region of interest"),
    Combined((("baseline_off", 0.98),), "stereo", 11122, {}, "baseline"),
    # What moves is neither another unit of depths nor a zoom, and where it carries a solution along that is given up.
    Combined((("outliers_moving", 0.35),), "rgbd", 11405, {}, r"(?s)\A(?!.*another unit).*move"),
    Combined((("outliers_moving", 0.3),), "mono", 11408, {"look_deg": 90.0}, r"(?s)\A(?!.*focal length of camera)"),
    Combined((("outliers_moving", 0.6),), "stereo", 11210, {"look_deg": 90.0, **LOOP}, "carried|most tracks move"),
    Combined((("zoomed_midway", 1.1),), "stereo", 7501, LOOP, "focal length"),
    Combined((("zoomed_midway", 1.2),), "mono", 7502, {}, "focal length"),
    Combined((("ids_midway", 1.0),), "stereo", 7503, {}, r"track ids stand for other points|\bids?\b"),
    Combined((("ids_midway", 1.0),), "mono", 7603, {**LOOP, "keyframes": 50}, "track ids stand for other points"),
    Combined((("index_midway", None),), "stereo", 7504, {}, "camera 1 come as"),
    Combined((("falls_silent", 1.0),), "stereo", 7505, {}, "no tracks came of camera 1 after"),
    Combined((("falls_silent", 0.0),), "stereo", 7506, LOOP, "no tracks came of camera 0 after"),
    # The odometry of seed 0 is better than most.
    Combined((("few_points", 12.0),), "mono", 0, {}, ""),
    Combined((("few_points", 20.0),), "mono", 1, {"drift_rotation_deg": 1.5, "drift_translation": 0.06}, ""),
    Combined((("focal_slightly_off", 0.9),), "mono", 2, {}, "focal"),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", CASES, ids=lambda case: f"{case.seed}-{'-'.join(name for name, _ in case.faults)}-{case.rig}"
)
def test_no_harm(case: Combined, tmp_path: Path, run: Replay) -> None:
    recording = spoiled_by(case.faults, case.rig, case.seed, **case.changes)
    outcome = run(write(tmp_path, recording))
    harmless(outcome.errors(recording.truth), 0.85, len(recording.keyframes))
    if case.named:
        outcome.tells(case.named)
