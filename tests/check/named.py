# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Mistakes of ``set_ups.WRONG``, and what is said of each."""

from __future__ import annotations

import pytest

# Mistake -> modes in which it shows, and what the likely mistake says.
NAMED: dict[str, tuple[tuple[str, ...], str]] = {
    "baseline reversed": (("stereo",), "baseline of camera 1 reversed"),
    "rig swapped": (("stereo",), "cameras 0 and 1 swapped"),
    "tracks swapped": (("stereo",), "cameras 0 and 1 swapped"),
    "extrinsics inverted": (("stereo", "mono"), "extrinsics inverted: body_from_camera holds camera-from-body"),
    "axes missing": (("stereo", "mono"), "axes confused: body_from_camera is that of a frame that looks along x"),
    "axes twice": (("stereo", "mono"), "axes confused: body_from_camera turns into the optical frame twice"),
    "extrinsics in mm": (("stereo",), "body_from_camera in millimetres"),
    "extrinsics in cm": (("stereo",), "body_from_camera in centimetres|baseline of camera 1 in centimetres"),
    "no baseline": (("stereo",), "baseline of camera 1 missing"),
    "poses inverted": (("stereo", "mono"), "^poses inverted: they hold body-from-world"),
    "poses of camera": (("stereo", "mono"), "^poses are of the camera, given as of the body"),
    "camera from world": (("stereo", "mono"), "^poses inverted and of the camera"),
    "poses of optical body": (("stereo", "mono"), "the poses are of a body whose z looks forward"),
    "poses in mm": (("stereo", "rgbd"), "poses in millimetres"),
    "poses in cm": (("stereo", "rgbd"), "poses in centimetres"),
    "poses in km": (("stereo", "mono", "rgbd"), "positions of the poses in kilometres"),
    "poses with w first": (("stereo", "mono"), "quaternions of the poses with w first"),
    "left-handed": (("stereo", "mono"), "poses are in left-handed axes: y points to the right"),
    "left-handed, z": (("stereo",), "poses are in left-handed axes: z points down"),
    "forward-right-down": (("stereo", "mono"), r"^poses are of a body with y to the right and z down"),
    "orientations clockwise": (("stereo", "mono"), "^orientations of the poses turn clockwise"),
    "compass headings": (("stereo", "mono"), "^orientations of the poses are compass headings"),
    "headings from north": (
        ("stereo", "mono"),
        "orientations of the poses count from another axis than their positions",
    ),
    "orientations north-east-down": (("stereo", "mono"), "^orientations of the poses are in north-east-down"),
    "positions north-east": (("stereo", "mono"), "^x and y of the poses exchanged"),
    "positions with another y": (("stereo", "mono"), "^y of the poses has another sign in their positions"),
    "poses as steps": (("stereo", "mono"), "^poses hold the step from the keyframe before"),
    "no positions": (("stereo", "mono"), "^position of the poses is not filled in"),
    "no orientations": (("stereo", "mono"), "^orientation of the poses is not filled in"),
    "OpenGL cameras": (("stereo", "mono"), "^optical axes confused: .* as in OpenGL"),
    "camera 1 against camera 0": (("stereo",), "^body_from_camera of camera 1 is its pose from camera 0"),
    "camera 1 from camera 0": (("stereo",), "^body_from_camera of camera 1 is camera 1 from camera 0"),
    "looks to the other side": (("stereo", "mono"), "^cameras look to the other side"),
    "camera 1 upside down": (("stereo",), "^images upside down: .* of camera 1 alone"),
    "camera 0 upside down": (("stereo",), "^images upside down: .* of camera 0 alone"),
    "camera 1 mirrored": (("stereo",), "^images mirrored: left and right are exchanged, of camera 1 alone"),
    "k of camera 1 halved": (("stereo",), "^k of camera 1 is that of an image 2 times as small"),
    "k of camera 0 doubled": (("stereo",), "^k of camera 0 is that of an image 2 times as large"),
    "turned 1 about y": (("stereo",), "camera 1 does not fit its place on the body by about 1 degree,"),
    "turned 1 about x": (("stereo",), "camera 1 does not fit its place on the body by about 1 degree,"),
    "turned 2 about z": (("stereo",), "camera 1 does not fit its place on the body by about 2 degrees"),
    "turned 0.5 about x": (("stereo",), "camera 1 does not fit its place on the body by about 0.5 degrees"),
    "focal 1.2": (("stereo", "mono"), r"focal length off by a factor of about 1\.(1[6-9]|2[0-4])"),
    "focal 0.8": (("stereo", "mono"), r"focal length off by a factor of about 0\.(7[7-9]|8[0-3])"),
    "focal 0.5": (("stereo", "mono"), r"focal length off by a factor of about 0\.(4[7-9]|5[0-3])"),
    "fx alone": (("stereo", "mono"), "fx and fy differ by a factor of 1.30"),
    "focal of camera 1": (("stereo",), "focal length of camera 1 off by a factor of about 1.2"),
    "principal point of camera 1, v": (("stereo",), "principal point of camera 1"),
    "principal point of camera 1, u": (("stereo",), "principal point of camera 1 off by about (29|30|31) px"),
    "region": (("stereo", "mono"), "region of interest not applied"),
    "binning": (("stereo", "mono"), "binning not applied: k is that of an image 2 times as large"),
    "k of a smaller image": (("stereo", "mono"), "k is that of a smaller image"),
    "not rectified": (("stereo", "mono"), "images not rectified though no distortion is given"),
    "rectified": (("stereo", "mono"), "images rectified though a distortion is given"),
    "fisheye given": (("stereo", "mono"), "images rectified though the model of a fisheye lens is given"),
    "plumb_bob given": (("mono",), "^distortion_model is not that of the coefficients: .* as those of equidistant"),
    "other signs of d": (("mono",), "^coefficients of the distortion with other signs"),
    "depth in mm": (("rgbd",), "depth_m in millimetres"),
    "depth in cm": (("rgbd",), "depth_m in centimetres"),
    "depth in km": (("rgbd",), "depth_m in kilometres"),
    "depth times 1.1": (("rgbd",), r"scale of depth_m: it is 1\.(09|1[0-2]?) times"),
    "depth along rays": (("rgbd",), "^depth_m is the distance from the camera along the ray"),
    "depth of other points": (("rgbd",), "^depth_m is of other points: of another image"),
    "inverse depth": (("rgbd",), "depth_m holds inverse depths"),
    "normalised": (("stereo", "mono"), "image coordinates are not in pixels"),
    "ids of each camera": (("stereo",), "track ids of cameras 0 and 1 do not name the same points"),
    "slots": (("stereo", "mono"), "ids reused"),
    "ids modulo 200": (("stereo", "mono", "rgbd"), "ids reused"),
    "rows for ids": (("stereo", "mono", "rgbd"), "ids reused"),
    "mirrored": (("stereo", "mono", "rgbd"), "images mirrored: left and right are exchanged"),
    "upside down": (("stereo", "mono"), "images upside down"),
    "u and v swapped": (("stereo", "mono"), "u and v swapped"),
    "tracks a keyframe late": (("stereo", "mono"), "^tracks are sent with the keyframe_id of the keyframe after"),
    "tracks a keyframe early": (("rgbd",), "^tracks are sent with the keyframe_id of the keyframe before"),
    "principal point 10 px": (
        ("stereo", "mono"),
        r"principal point wrong: the tracks fit \((319|320|321), (239|240|241)\)",
    ),
    "focal 1.05": (("stereo",), r"focal length off by a factor of about 1\.0[456]"),
    "sigma times 100": (("mono",), r"sigma_px is 50 px, the tracks scatter by about 0\.[45]\d? px"),
    "sigma over 100": (("stereo",), r"sigma_px is 0\.005 px, the tracks scatter by about 0\.[45]\d? px"),
    "stamps in us": (("mono",), "stamps in another unit.*microseconds"),
    "stamps in ms": (("mono",), "stamps in another unit.*milliseconds"),
}
# The quick tests do with one rig. These are told by adjustments of seconds, in which all cameras change alike: with one
# camera, and with one amount and one lens of what is adjusted alike.
ADJUSTED = ("focal 0.8", "focal 0.5", "fx alone", "binning", "not rectified", "rectified", "fisheye given")
ALIKE = ("focal 0.5", "other signs of d", "fisheye given", "principal point of camera 1, u")
CASES = [
    pytest.param(
        wrong,
        mode,
        marks=[pytest.mark.slow] if wrong in ALIKE or mode != ("mono" if wrong in ADJUSTED else modes[0]) else [],
    )
    for wrong, (modes, _) in NAMED.items()
    for mode in modes
]
