# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare how images become keyframes and tracks: options of ``ba track``, ``ba run`` and the node ``ba_front_end``."""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.config.declaration import Checked, Choice, option


@dataclass(frozen=True)
class FrontEndOptions(Checked):
    """Options of the front-end. A value of the wrong type or out of range raises ConfigError."""

    max_features: int = option(800, "Most features that are followed at a time.", within=(50, 10_000))
    patch_px: int = option(21, "Side of the square of pixels that is compared around a feature.", within=(7, 63))
    max_error_px: float = option(
        2.0, "A feature farther than this from where its point should appear is an outlier.", within=(0.1, 100.0)
    )
    sigma_px: float = option(
        0.15, "Least standard deviation of a feature; noise and blur come on top.", within=(0.01, 10.0)
    )
    keyframe_parallax_px: float = option(
        16.0,
        "An image becomes a keyframe when features have moved this far since the last one (median), turning left out.",
        within=(1.0, 1000.0),
    )
    keyframe_min_shared: float = option(
        0.6, "Or when a smaller share of the last keyframe's features is still seen.", within=(0.0, 1.0)
    )
    min_points: int = option(
        15, "Fewest features that must agree with a pose; with less the image is lost.", within=(6, 1000)
    )
    max_lost: int = option(
        10, "After so many images in a row without a pose a new session begins.", within=(1, 100_000)
    )
    max_gap_s: float = option(
        2.0,
        "A new session begins where stamps are further apart and what was seen before is not found again.",
        within=(0.01, 1e6),
    )
    max_skew_s: float = option(
        0.005, "Left and right image, or image and depth, whose stamps differ by more are no pair.", within=(0.0, 1.0)
    )
    stereo_align: bool = option(
        True,
        "Learn from the images how the second camera is turned against the rig (a tenth of a degree is a pixel of"
        " disparity), and correct what it sees by that.",
    )
    stereo_yaw_px: float = option(
        0.0, "What to begin with: all disparities are too small by this.", within=(-20.0, 20.0)
    )
    stereo_roll_px: float = option(
        0.0, "Likewise, times the distance below the image's centre by the focal length.", within=(-20.0, 20.0)
    )
    min_depth_m: float = option(0.2, "Depths of a depth camera nearer than this are not taken.", within=(1e-3, 1e3))
    max_depth_m: float = option(
        0.0, "Depths of a depth camera beyond this are not taken; 0 takes all.", within=(0.0, 1e4)
    )
    depth_scale: float = option(
        1.0,
        "Depths of a depth camera times this are m: 0.2 for pictures of 16 bits in which 5000 is 1 m (TUM's), where"
        " 1000 is taken for it.",
        within=(1e-6, 1e6),
    )


MODES = (
    Choice("auto", "by the first image topics that are there"),
    Choice("stereo", "left/image_raw, right/image_raw"),
    Choice("rgbd", "rgb/image_raw, depth/image_raw"),
    Choice("mono", "image_raw"),
)


@dataclass(frozen=True)
class FrontEndNodeOptions(Checked):
    """Options of the node. A value of the wrong type or out of range raises ConfigError."""

    mode: str = option("auto", "What images there are.", choices=MODES)
    rectified: bool = option(
        False, "Images are rectified: p of camera_info is their camera; so it is for topics image_rect."
    )
    rig_file: str = option("", "YAML of the rig, in any form of ba rig, in place of camera_info and /tf_static.")
    base_frame: str = option("", "Body frame, to which /tf_static tells the way; empty: the first camera.")
    odom_frame: str = option("odom", "Fixed frame of the keyframes, and of the odometry where it comes by TF.")
    odometry: str = option(
        "none",
        "Steps from elsewhere: topic odometry, or TF from odom_frame.",
        choices=("none", "topic", "tf"),
    )
    publish_tf: bool = option(True, "Publish odom_frame -> body, unless the odometry comes from elsewhere.")
    mask_file: str = option("", "Picture of the first camera's size, black where nothing is to be looked at.")
    mask_topic: bool = option(False, "Wait for a mask of each image on the topic mask (mono8, 0: do not look).")
    queue_depth: int = option(50, "Images of a topic that may wait.", within=(2, 1000))
    autostart: bool = option(True, "Configure and activate at start.")
