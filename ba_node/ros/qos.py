# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the quality of service of every topic."""

from __future__ import annotations

from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

# Bursts that one solve sends: one pose for each keyframe of a window.
OUTPUT_DEPTH = 1000
LATCHED_OUTPUTS = ("path", "points")
LATCHED_INPUTS = ("camera_rig", "camera_info")


def reliable(depth: int) -> Any:
    """Return a profile that repeats lost messages and keeps nothing for late subscribers."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
    )


def lossless() -> Any:
    """Return a profile that keeps every message until all subscribers have acknowledged it."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE
    )


def latched(depth: int = 1) -> Any:
    """Return a profile whose last messages reach subscribers that come later."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def for_input(topic: str, depth: int) -> tuple[Any, ...]:
    """Return the profiles to subscribe to an input with, one subscription for each.

    A latched subscription alone does not match a camera driver, which publishes camera_info volatile and often best
    effort; a best-effort one alone misses what was latched before the node came. Cameras are taken from both.
    """
    if topic in LATCHED_INPUTS:
        return latched(), qos_profile_sensor_data
    return (reliable(depth),)


def for_output(topic: str) -> Any:
    """Return the profile to publish an output with."""
    return latched() if topic in LATCHED_OUTPUTS else reliable(OUTPUT_DEPTH)
