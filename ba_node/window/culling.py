# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Take out redundant keyframes (``scene.redundant_share``), so that a map grows with what is new and not with time.

A keyframe that has left the window is redundant where so large a share of the points that it agrees with is seen by
three others at least (Mur-Artal et al., *ORB-SLAM*, IEEE Transactions on Robotics 2015, VI-E). They are looked at some
at a time, oldest first, each with those before it taken out already. What a factor beside pixels names stays, as does a
keyframe with which a session begins; a step whose covariance the front-end told leads over those that go.
"""

from __future__ import annotations

import numpy as np

from ba_node.config import Config
from ba_node.scene.scene import Scene
from ba_node.window.old_keyframes import window_size

# So many others have to see a point; so many keyframes are looked at together; views of a point that are looked at.
_OTHERS, _TOGETHER, _VIEWS = 3, 10, 50
# A keyframe that agrees with fewer points than this is not judged.
_LEAST_POINTS = 10


def cull(scene: Scene, config: Config) -> None:
    """Take redundant keyframes out that have left the window and were not looked at yet."""
    share, end = config.scene.redundant_share, len(scene.keyframes) - window_size(scene, config)
    if share <= 0.0:
        return
    first = max(1, int(np.searchsorted(scene.keyframes.stamp_ns[scene.order], scene.culled_ns, side="right")))
    if end - first < _TOGETHER:
        return
    candidates = scene.order[first:end]
    scene.culled_ns = int(scene.keyframes.stamp_ns[candidates[-1]])
    known = scene.constraints
    named = known.relative_of.keys() | known.gravity.keys() | known.seams
    gone: list[int] = []
    for row in candidates.tolist():
        if int(scene.keyframes.keyframe_id[row]) not in named and _seen_by_others(scene, row, gone) >= share:
            gone.append(row)
    scene.log.notice("redundant", len(gone))
    if gone:
        scene.take_out(np.array(gone, np.intp))


def _seen_by_others(scene: Scene, row: int, gone: list[int]) -> float:
    """Return of which share of its points enough others see each; ``gone`` are keyframes that count no more."""
    table = scene.observations
    own = scene.rows_of(row)
    landmarks = scene.distinct(table.landmark[own[~table.outlier[own]]])
    landmarks = landmarks[scene.landmarks.has_position[landmarks]]
    if len(landmarks) < _LEAST_POINTS:
        return 0.0
    views = scene.views_of(landmarks, _VIEWS)
    keyframe = table.keyframe[views]
    views = views[~table.outlier[views] & ~np.isin(keyframe, [row, *gone])]
    number = scene.numbers(table.landmark[views], landmarks)
    pairs = np.unique(number * len(scene.keyframes) + table.keyframe[views])
    others = np.bincount(pairs // len(scene.keyframes), minlength=len(landmarks))
    return float(np.mean(others >= _OTHERS))
