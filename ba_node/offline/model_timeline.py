# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn a reconstruction into what a front-end would have sent: its frames one after the other, as keyframes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ba_node.core.cameras import Model
from ba_node.core.geometry import inverse, quaternion_from_matrix
from ba_node.io.model import ModelError, Reconstruction
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement

FIXED_FRAME, BODY_FRAME = "map", "body"
_MAX_CAMERAS = 2**16


def timeline(model: Reconstruction) -> Iterator[tuple[str, int, Measurement]]:
    """Yield topic, stamp in ns and measurement: the rig, then of each frame its keyframe, guesses and tracks.

    Ids are the indices in the model. A point is guessed with the first frame that sees it; points that no image sees
    are not sent. No image may see a point twice.

    Raises:
        ModelError: more cameras than a message can number, or a focal length that is not positive.
    """
    n_cameras = len(model.lens)
    if n_cameras > _MAX_CAMERAS:
        raise ModelError(f"{n_cameras} cameras: a recording can number {_MAX_CAMERAS}")
    focal = model.cameras.params[:, :2].min(axis=1, initial=np.inf)
    if (focal <= 0.0).any():
        camera = int(np.argmax(focal <= 0.0))
        raise ModelError(f"camera {camera}: f = {focal[camera]:g} px: expected > 0")
    yield "camera_rig", int(model.stamp_ns.min(initial=2**62)), rig(model)
    rotation, position = inverse(model.rotation, model.translation)
    orientation = quaternion_from_matrix(rotation)
    order = np.lexsort((model.camera, model.frame))
    bounds = np.searchsorted(model.frame[order], np.arange(len(rotation) + 1))
    sent = np.zeros(len(model.points), dtype=bool)
    for frame in np.argsort(model.stamp_ns, kind="stable").tolist():
        stamp_ns = int(model.stamp_ns[frame])
        rows = order[bounds[frame] : bounds[frame + 1]]
        yield "keyframes", stamp_ns, Keyframe(0, frame, stamp_ns, FIXED_FRAME, position[frame], orientation[frame])
        new = np.unique(model.point[rows][~sent[model.point[rows]]])
        if len(new):
            sent[new] = True
            yield "landmark_guesses", stamp_ns, LandmarkGuesses(0, new.astype(np.uint64), model.points[new])
        for camera in np.unique(model.camera[rows]).tolist():
            of = rows[model.camera[rows] == camera]
            ids = model.point[of].astype(np.uint64)
            yield "feature_tracks", stamp_ns, FeatureTracks(0, frame, camera, ids, model.uv[of])


def rig(model: Reconstruction) -> CameraRig:
    """Return the cameras as a rig."""
    names, coefficients = zip(*map(_named, model.cameras.model, model.cameras.params), strict=True)
    rotation, position = inverse(model.cameras.rotation, model.cameras.translation)
    return CameraRig(
        frame_id=BODY_FRAME,
        names=tuple(f"camera_{number}" for number in range(len(names))),
        models=names,
        intrinsics=model.cameras.params[:, :4],
        distortion=coefficients,
        image_size=model.size.astype(np.int64),
        position=position,
        orientation=quaternion_from_matrix(rotation),
    )


def _named(model: np.uint8, params: np.ndarray) -> tuple[str, np.ndarray]:
    """Return distortion model and coefficients as CameraInfo has them."""
    if model == Model.EQUIDISTANT:
        return "equidistant", params[4:8]
    return ("rational_polynomial", params[4:12]) if params[9:12].any() else ("plumb_bob", params[4:9])
