# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn a BAL problem into what a front-end would have sent: its images one after the other, as keyframes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ba_node.core.geometry import inverse, quaternion_from_matrix, so3_exp
from ba_node.io.bal import BalError, BalProblem
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement

START_NS = 1_000_000_000
STEP_NS = 100_000_000
FIXED_FRAME = "map"
_MAX_CAMERAS = 2**16
# diag(1, -1, -1) as x y z w: a BAL camera looks down -z with y up, an optical frame along z with y down.
_HALF_TURN = (1.0, 0.0, 0.0, 0.0)


def timeline(bal: BalProblem) -> Iterator[tuple[str, int, Measurement]]:
    """Yield topic, stamp in ns and measurement: the rig, then of each image its keyframe, guesses and tracks.

    Ids are the indices in the file, stamps 0.1 s apart. A point is guessed with the first image that sees it; points
    that no image sees are not sent.

    Raises:
        BalError: more cameras than a message can number, or a focal length that is not positive.
    """
    n_cameras = len(bal.cameras)
    if n_cameras > _MAX_CAMERAS:
        raise BalError(f"{n_cameras} cameras: a recording can number {_MAX_CAMERAS}")
    bad = np.flatnonzero(bal.cameras[:, 6] <= 0.0)
    if len(bad):
        raise BalError(f"camera {bad[0]}: f = {bal.cameras[bad[0], 6]:g} px: expected > 0")
    yield "camera_rig", START_NS, rig(bal)
    rotation, position = inverse(so3_exp(bal.cameras[:, :3]), bal.cameras[:, 3:6])
    orientation = quaternion_from_matrix(rotation)
    order = np.argsort(bal.camera_index, kind="stable")
    bounds = np.searchsorted(bal.camera_index[order], np.arange(n_cameras + 1))
    sent = np.zeros(len(bal.points), dtype=bool)
    for image in range(n_cameras):
        stamp_ns = START_NS + STEP_NS * image
        rows = order[bounds[image] : bounds[image + 1]]
        seen = bal.point_index[rows]
        yield "keyframes", stamp_ns, Keyframe(0, image, stamp_ns, FIXED_FRAME, position[image], orientation[image])
        new = np.unique(seen[~sent[seen]])
        if len(new):
            sent[new] = True
            yield "landmark_guesses", stamp_ns, LandmarkGuesses(0, new.astype(np.uint64), bal.points[new])
        uv = bal.observations[rows] * (1.0, -1.0)
        yield "feature_tracks", stamp_ns, FeatureTracks(0, image, image, seen.astype(np.uint64), uv)


def rig(bal: BalProblem) -> CameraRig:
    """Return a rig with one camera for each image, all at the origin of the body (which is the BAL camera)."""
    n = len(bal.cameras)
    f = bal.cameras[:, 6]
    return CameraRig(
        frame_id="bal_camera",
        names=tuple(f"camera_{image}" for image in range(n)),
        models=("plumb_bob",) * n,
        intrinsics=np.stack([f, f, np.zeros(n), np.zeros(n)], axis=1),
        distortion=tuple(np.array([k1, k2, 0.0, 0.0, 0.0]) for k1, k2 in bal.cameras[:, 7:]),
        image_size=np.zeros((n, 2), dtype=np.int64),
        position=np.zeros((n, 3)),
        orientation=np.tile(_HALF_TURN, (n, 1)),
    )
