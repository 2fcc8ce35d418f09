# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare what the node ``ba_front_end`` does with topics and frames; how it tracks stands in ``front_end.py``."""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.config.declaration import Checked, Choice, option

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
