# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare every way in which a recording goes wrong once: what it is, how much of it, and what a user must be told."""

from __future__ import annotations

from experiments.robustness.faults import exposure, midway, motion, setup, stamps, surround, tracks
from experiments.robustness.faults.fault import MONO, RGBD, STEREO, Fault

_TWO = (STEREO,)
_ALL = (STEREO, MONO, RGBD)
# Exit codes: something to look at; the same, or refused.
_LOOK, _REFUSED = (3,), (2, 3)
FAULTS: dict[str, Fault] = {
    # What is said about cameras, frames and units.
    "baseline_reversed": Fault(
        "second camera on the wrong side", setup.baseline_reversed, rigs=_TWO, named=("baseline|swapped",), codes=_LOOK
    ),
    "cameras_swapped": Fault(
        "cameras swapped", setup.cameras_swapped, rigs=_TWO, named=("swapped|baseline",), codes=_LOOK
    ),
    "extrinsics_inverted": Fault(
        "extrinsics inverted",
        setup.extrinsics_inverted,
        rigs=_ALL,
        named=("invert|camera.from.body|axes|body_from_camera",),
        codes=_LOOK,
    ),
    "axes_confused": Fault(
        "body axes given as optical",
        setup.axes_confused,
        rigs=_ALL,
        named=("axes|optical|body_from_camera",),
        codes=_LOOK,
    ),
    "camera_turned": Fault(
        "second camera turned, deg",
        setup.camera_turned,
        amounts=(1.0, 0.5, 3.0, 10.0),
        rigs=_TWO,
        named=(r"camera \S+ .*(degree|\bdeg\b|turned|does not fit)",),
        codes=_LOOK,
    ),
    "depth_in_mm": Fault(
        "depth, times",
        setup.depth_in_mm,
        amounts=(1000.0, 0.001, 100.0),
        rigs=(RGBD,),
        named=("depth",),
        codes=_LOOK,
    ),
    "poses_inverted": Fault(
        "poses inverted", setup.poses_inverted, rigs=_ALL, named=("pose.*invert|invert.*pose",), codes=_LOOK
    ),
    "focal_off": Fault(
        "focal length, times",
        setup.focal_off,
        amounts=(1.2, 0.8, 1.5),
        rigs=_ALL,
        named=("focal",),
        codes=_LOOK,
    ),
    "roi_ignored": Fault(
        "region of interest not said, px",
        setup.roi_ignored,
        amounts=(120.0, 60.0),
        rigs=_ALL,
        named=(r"region|\broi\b|principal",),
        codes=_LOOK,
    ),
    "roi_given": Fault("region of interest said, px", setup.roi_given, amounts=(120.0, 60.0), codes=(0,)),
    "binning_ignored": Fault(
        "binning not said",
        setup.binning_ignored,
        amounts=(2.0, 4.0),
        named=("binning|focal|intrinsics",),
        codes=_LOOK,
    ),
    "binning_given": Fault("binning said", setup.binning_given, amounts=(2.0,), codes=(0,)),
    "rectified_with_distortion": Fault(
        "rectified, distortion given", setup.rectified_with_distortion, named=("rectif|distortion",), codes=_LOOK
    ),
    # Stamps, sessions, frames.
    "clock_set_back": Fault(
        "clock set back, s",
        stamps.clock_set_back,
        amounts=(3600.0, 60.0),
        named=("stamp|clock|session",),
        least=0.95,
    ),
    "one_stamp_zero": Fault("one stamp is zero", stamps.one_stamp_zero, named=("stamp",), codes=_LOOK, least=0.97),
    "one_stamp_future": Fault(
        "one stamp ahead, s",
        stamps.one_stamp_future,
        amounts=(4e8, 86400.0),
        named=("stamp",),
        codes=_LOOK,
        least=0.97,
    ),
    "stamps_in_another_unit": Fault("stamps, divided by", stamps.stamps_in_another_unit, amounts=(1e3, 1e6)),
    "begins_anew": Fault(
        "recording begins anew", stamps.begins_anew, named=("session|stamp|again|duplicate",), least=0.5
    ),
    "session_lowered": Fault(
        "session id lowered by", stamps.session_lowered, amounts=(10.0, 1.0), named=("session",), least=0.95
    ),
    "useless_messages": Fault("useless messages of a higher session", stamps.useless_messages, amounts=(3.0,)),
    "duplicates": Fault(
        "keyframes again, stamps off by, s", stamps.duplicates, amounts=(-3600.0, 0.05, 3600.0), least=0.85
    ),
    "frame_slash": Fault("frame /odom", stamps.frame_slash, named=("frame",), codes=_REFUSED, least=0.0),
    "frame_empty": Fault("frame without a name", stamps.frame_empty, named=("frame",), codes=_REFUSED, least=0.0),
    "frame_changes": Fault("frame renamed midway", stamps.frame_changes, named=("frame",), codes=_LOOK, least=0.5),
    # The front-end errs.
    "ids_reused": Fault("ids reused as places", tracks.ids_reused, named=(r"reuse|\bids?\b",), codes=_LOOK),
    "wrong_ids": Fault("keyframes with wrong ids", tracks.wrong_ids, amounts=(5.0, 1.0, 2.0)),
    "outliers_uniform": Fault("outliers anywhere, share", tracks.outliers_uniform, amounts=(0.3, 0.5, 0.1), rigs=_ALL),
    "outliers_jumping": Fault("tracks jump, share", tracks.outliers_jumping, amounts=(0.3, 0.5, 0.1), rigs=_ALL),
    "outliers_moving": Fault("moving objects, share", tracks.outliers_moving, amounts=(0.3, 0.4, 0.6), rigs=_ALL),
    "one_keyframe_far": Fault(
        "one keyframe off, m",
        tracks.one_keyframe_far,
        amounts=(60.0, 5.0, 1000.0),
        rigs=_ALL,
    ),
    # Little is determined.
    "few_points": Fault("points a keyframe", tracks.few_points, amounts=(2.0, 4.0, 8.0), changes={"track_loss": 0.01}),
    "few_observations": Fault(
        "20 tracks a keyframe on a long path",
        changes={"tracks": 20, "keyframes": 150, "length_m": 100.0, "reobserve": False},
    ),
    "stands_still": Fault(
        "stands still at first, keyframes", motion=motion.stands_still, amounts=(20.0, 30.0), rigs=(MONO, STEREO, RGBD)
    ),
    "stands_still_mismatched": Fault(
        "the same with 2 % mismatches",
        motion=motion.stands_still,
        amounts=(30.0,),
        rigs=_ALL,
        changes={"outlier_share": 0.02},
    ),
    "stops_midway": Fault(
        "stops midway, keyframes", motion=motion.stops_midway, amounts=(20.0,), rigs=(MONO, STEREO, RGBD)
    ),
    "pure_rotation": Fault(
        "turns on the spot, deg a keyframe", motion=motion.pure_rotation, amounts=(3.0, 1.0, 8.0), rigs=(MONO, STEREO)
    ),
    "hardly_moves": Fault(
        "1 mm a keyframe at first, times",
        motion=motion.hardly_moves,
        rigs=(MONO,),
        changes={"guesses": True, "guess_noise": 0.0},
    ),
    "far_points": Fault(
        "all points far, km",
        motion=motion.far_points,
        amounts=(5.0, 1.0),
        changes={"max_range_m": 10_000.0},
    ),
    "optimal_map": Fault(
        "poses and guesses at the truth",
        rigs=(MONO, STEREO),
        changes={
            "guesses": True,
            "guess_noise": 0.0,
            "drift_rotation_deg": 0.0,
            "drift_translation": 0.0,
            "outlier_share": 0.0,
            "noise_px": 0.02,
            "keyframes": 12,
            "length_m": 10.0,
        },
    ),
    # What is nearly right.
    "focal_slightly_off": Fault(
        "focal length slightly off, times", setup.focal_off, amounts=(1.05, 0.95, 1.1, 0.9), rigs=_ALL
    ),
    "depth_slightly_off": Fault(
        "depth slightly off, times", setup.depth_in_mm, amounts=(1.05, 0.95), rigs=(RGBD,), named=("depth",)
    ),
    "baseline_off": Fault("baseline, times", setup.baseline_off, amounts=(1.05, 0.95, 1.1), rigs=_TWO),
    "steps_scaled": Fault("positions of the keyframes, times", setup.steps_scaled, amounts=(1.08, 0.93), rigs=_ALL),
    "sigma_off": Fault("sigma_px, times", setup.sigma_off, amounts=(10.0, 0.1, 4.0), rigs=_ALL),
    # Said wrongly in ways of their own. What is added stands at the end: seeds of tests are counted by place.
    "poses_w_first": Fault("quaternions with w first", setup.poses_w_first, named=("w first",), codes=_LOOK),
    "poses_optical": Fault("poses of a body that looks along z", setup.poses_optical, named=("z looks",), codes=_LOOK),
    "sigma_zero": Fault(
        "sigma_px of zero, share", tracks.sigma_zero, amounts=(0.05, 1.0), named=("sigma",), codes=_LOOK
    ),
    "huge_coordinate": Fault(
        "one coordinate of an image, px",
        tracks.huge_coordinate,
        amounts=(1e9, 1e30),
        named=("out_of_range",),
        codes=_LOOK,
    ),
    "new_ids_twice": Fault("keyframes again under new ids, after s", midway.new_ids_twice, amounts=(0.01, 0.0)),
    # What was right at first no longer is.
    "poses_inverted_midway": Fault(
        "poses inverted from midway on",
        midway.from_midway(setup.poses_inverted),
        named=("poses contradict the tracks|poses inverted",),
        codes=_LOOK,
    ),
    "swapped_midway": Fault(
        "cameras swapped from midway on",
        midway.from_midway(setup.cameras_swapped),
        rigs=_TWO,
        named=("swapped",),
        codes=_LOOK,
    ),
    "smaller_midway": Fault(
        "images smaller from midway on, times",
        midway.from_midway(midway.smaller),
        amounts=(2.0, 1.5),
        named=("binning|region",),
        codes=_LOOK,
    ),
    "depth_mm_midway": Fault(
        "depth in mm from midway on",
        midway.from_midway(setup.depth_in_mm),
        amounts=(1000.0,),
        rigs=(RGBD,),
        named=("millimetres",),
        codes=_LOOK,
    ),
    "region_midway": Fault(
        "region of interest not said from midway on, px",
        midway.from_midway(setup.roi_ignored),
        amounts=(80.0, 40.0),
        rigs=(MONO, STEREO),
        named=("region|camera 0 does not fit",),
        codes=_LOOK,
    ),
    "zoomed_midway": Fault(
        "focal length of the images from midway on, times",
        midway.from_midway(midway.zoomed),
        amounts=(1.1, 1.3),
        rigs=_ALL,
        named=("focal length",),
        codes=_LOOK,
    ),
    "ids_midway": Fault(
        "track ids shifted from midway on",
        midway.from_midway(midway.ids_shifted),
        amounts=(1.0,),
        named=(r"\bids?\b",),
        codes=_LOOK,
    ),
    "index_midway": Fault(
        "camera 1 sent as camera 0 from midway on",
        midway.other_index,
        rigs=_TWO,
        named=("camera 1 come as|under which camera_index",),
        codes=_LOOK,
    ),
    "falls_silent": Fault(
        "camera that falls silent midway",
        midway.falls_silent,
        amounts=(1.0, 0.0),
        rigs=_TWO,
        named=("no tracks came of camera",),
        codes=_LOOK,
    ),
    "rig_changes": Fault(
        "focal length of a second rig, times",
        midway.rig_changes,
        amounts=(1.3, 0.5),
        rigs=_ALL,
        named=("rig_changed",),
        codes=_LOOK,
    ),
    "odometry_freezes": Fault("odometry freezes, keyframes", midway.odometry_freezes, amounts=(3.0, 10.0), rigs=_ALL),
    "numbered_anew": Fault("keyframe ids begin anew, from", midway.numbered_anew, amounts=(1000.0,)),
    "all_turned": Fault(
        "cameras rolled on the body, deg",
        setup.all_turned,
        amounts=(10.0, 5.0),
        rigs=_ALL,
        named=("camera 0 does not fit its place on the body",),
        codes=_LOOK,
        changes={"path": "loop", "length_m": 30.0, "keyframes": 60},
    ),
    "clock_stepped": Fault(
        "clock set forward, s", stamps.clock_stepped, amounts=(3600.0, -0.3), named=("clock",), codes=_LOOK
    ),
    "mirrored_midway": Fault(
        "second camera mirrored from midway on",
        midway.from_midway(midway.mirrored),
        rigs=_TWO,
        named=("mirrored",),
        codes=_LOOK,
    ),
    "second_late": Fault(
        "second camera exposed later, s",
        exposure.second_late,
        amounts=(0.05, 0.02),
        rigs=_TWO,
        named=("camera 1 is not synchronised",),
        codes=_LOOK,
    ),
    "poses_in_mm": Fault(
        "positions of the keyframes in another unit, times",
        setup.steps_scaled,
        amounts=(1000.0, 0.001),
        rigs=(RGBD, STEREO),
        named=("poses in (millimetres|kilometres)",),
        codes=_LOOK,
    ),
    "focal_of_first": Fault(
        "focal length of the first of three cameras, times",
        surround.focal_of_first,
        amounts=(1.2, 1.05),
        rigs=_TWO,
        named=("focal length of camera 0 off .* against those of cameras 1 and 2",),
        codes=_LOOK,
    ),
    "restarts_midway": Fault(
        "front-end begins anew midway, track ids higher by",
        midway.restarts,
        amounts=(1e6, 0.0),
        rigs=_ALL,
        named=("jump|off the front-end's",),
        codes=_LOOK,
    ),
}
