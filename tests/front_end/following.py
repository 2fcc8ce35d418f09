# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the front-end over images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ba_node.config.front_end import FrontEndOptions
from ba_node.estimate import Transform
from ba_node.front_end import FrontEnd, Images, Tracked

OPTIONS = FrontEndOptions(max_features=300)
PLAIN = dataclasses.replace(OPTIONS, stereo_align=False)


def follow(front_end: FrontEnd, frames: Sequence[Images], odometry: Sequence[Transform] | None = None) -> list[Tracked]:
    given: Sequence[Transform | None] = odometry or [None] * len(frames)
    return [front_end.process(one, pose) for one, pose in zip(frames, given, strict=True)]
