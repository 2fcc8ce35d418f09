# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read the names of frames as tf2 has them: without the slash that tf of ROS 1 put before them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ba_node.measurements import Keyframe
    from ba_node.scene.rejections import RejectionLog


def plain(frame_id: str) -> str:
    """Return a name that tf2 takes."""
    return frame_id.strip().lstrip("/")


def check_name(keyframe: Keyframe, named: str, taken: str, log: RejectionLog) -> None:
    """Say so if the name of a keyframe's fixed frame is none, or one that tf2 refuses.

    Args:
        keyframe: as it came.
        named: by a parameter, empty if it names none; then an empty name does no harm.
        taken: what is taken for an empty name.
        log: where it is said.
    """
    name = plain(keyframe.frame_id)
    if name == keyframe.frame_id and name:
        return
    log.notice("frame_name")
    if "frame_name" in log.warnings:
        return
    where = f"keyframe {keyframe.keyframe_id}: header.frame_id = {keyframe.frame_id!r}"
    if name:
        log.warn("frame_name", f"{where} is no name for tf2, taken as {name!r}: leave out the slash")
    elif not named:
        log.warn("frame_name", f"{where} names no frame, taken as {taken!r}: name the fixed frame of the poses")
