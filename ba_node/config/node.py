# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare frames, what is published, how the node runs, and when it warns."""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.config.declaration import option


@dataclass(frozen=True)
class FramesConfig:
    """Names of frames, and how the correction map -> odom moves. See docs/frames.md."""

    map_frame: str = option("map", "Frame of everything that is published.", live=False)
    odom_frame: str = option(
        "", "Frame of the front-end's poses; empty: the header.frame_id of its keyframes.", live=False
    )
    base_frame: str = option("base_link", "Frame of the body, from which tf_static leads to the cameras.", live=False)
    poses_of: str = option(
        "body",
        "What poses are of, in and out: the body, or camera 0 of the rig (optical frame).",
        choices=("body", "camera"),
        live=False,
    )
    extrinsics: str = option(
        "camera_rig",
        "Where the cameras sit on the body: as camera_rig says, or as tf_static does, by their frame_id.",
        choices=("camera_rig", "tf_static"),
        live=False,
    )
    publish_tf: bool = option(True, "Publish map -> odom on /tf.")
    transform_tolerance: float = option(
        0.2, "How far ahead of the data map -> odom is stamped.", unit="s", within=(0.0, 60.0)
    )
    publish_period_s: float = option(
        0.05,
        "How often map -> odom is repeated, between solves too; 0: after solves only.",
        within=(0.0, 60.0),
        live=False,
    )
    gate_m: float = option(
        1.0,
        "A solve that moves the newest keyframe further is held back from /tf until others confirm it; 0: never.",
        within=(0.0, 1e9),
    )
    gate_rad: float = option(0.2, "The same for a solve that turns it further; 0: never.", within=(0.0, 4.0))
    gate_confirmations: int = option(
        2, "Solves in a row that have to agree with a correction beyond a gate.", within=(1, 1000)
    )
    smoothing_s: float = option(
        0.0,
        "Time constant, by the stamps of keyframes, with which map -> odom follows corrections; 0: at once.",
        within=(0.0, 3600.0),
    )


@dataclass(frozen=True)
class OutputConfig:
    """What is published."""

    path_max_poses: int = option(1000, "Poses in ~/path; the newest are kept.", within=(1, 1_000_000))
    points_max: int = option(200_000, "Points in ~/points; beyond it they are thinned evenly.", within=(1, 50_000_000))
    markers_max_keyframes: int = option(200, "Keyframes drawn in ~/markers; the newest are kept.", within=(1, 10_000))
    markers_max_links: int = option(
        500, "Lines in ~/markers between keyframes; those with most common points are kept.", within=(0, 100_000)
    )
    markers_frustum_m: float = option(0.2, "Depth of the frusta in ~/markers.", within=(1e-3, 1e3))
    markers_rms_px: float = option(
        2.0, "Reprojection error of a keyframe that ~/markers draws in red; 0 is green.", within=(1e-3, 1e6)
    )


@dataclass(frozen=True)
class NodeConfig:
    """How the node runs. Not used offline, except for names."""

    autostart: bool = option(
        True, "Configure and activate at start; false leaves both to `ros2 lifecycle set` or a manager.", live=False
    )
    inbox_size: int = option(
        500,
        "Messages that wait for the solver; beyond it the oldest tracks are dropped and counted.",
        within=(10, 100_000),
        live=False,
    )
    map_folder: str = option(
        "~/.ros/ba_node",
        "Folder that ~/save_map and ~/load_map work in: what clients name is below it. / for any file; empty: both"
        " services refuse.",
        live=False,
    )
    load_map: str = option(
        "", "File below node.map_folder with the map to begin with, if it is there; empty: an empty map.", live=False
    )
    save_map: str = option(
        "", "File below node.map_folder that the map is saved to at cleanup and shutdown; empty: none.", live=False
    )
    queue_depth: int = option(100, "QoS depth of the input subscriptions.", within=(1, 100_000), live=False)
    silence_s: float = option(
        10.0,
        "With no keyframes or tracks for this long, log and /diagnostics name the topics and who publishes there;"
        " 0: never.",
        within=(0.0, 86_400.0),
    )
    log_period_s: float = option(
        5.0,
        "How often one line in the log tells rate, residuals, latency, and what became of the solutions; 0: never.",
        within=(0.0, 86_400.0),
    )
    latency_budget_ms: float = option(
        0.0,
        "Time from arrival of a keyframe to its result that the solver may use up: it ends after an iteration"
        " when another would take longer, but makes one always. 0: no limit. Without effect offline.",
        within=(0.0, 1e6),
    )
    settle_time_s: float = option(
        0.5,
        "With no new message for this long, the newest keyframe is solved with what has arrived.",
        within=(0.01, 3600.0),
        live=False,
    )


@dataclass(frozen=True)
class DiagnosticsConfig:
    """When /diagnostics warns. See docs/diagnostics.md."""

    recent_s: float = option(10.0, "What was dropped or turned away counts for this long.", within=(1.0, 3600.0))
    queue_warn_share: float = option(
        0.5, "Share of node.inbox_size that waits from which on the queue warns.", within=(0.0, 1.0)
    )
    latency_warn_s: float = option(0.2, "95th percentile from arrival to publication that warns.", within=(0.0, 1e6))
    latency_error_s: float = option(1.0, "The same as an error.", within=(0.0, 1e6))
    rms_warn_px: float = option(2.0, "Root mean square residual after a solve that warns.", within=(0.0, 1e6))
    rms_error_px: float = option(10.0, "The same as an error.", within=(0.0, 1e6))
    inliers_warn_share: float = option(
        0.7, "Share of inliers among the observations below which it warns.", within=(0.0, 1.0)
    )
    inliers_error_share: float = option(0.3, "The same as an error.", within=(0.0, 1.0))
    memory_warn_mb: float = option(2000.0, "Memory of the process (resident) that warns.", within=(0.0, 1e9))
    memory_error_mb: float = option(8000.0, "The same as an error.", within=(0.0, 1e9))
