# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Models of COLMAP with noise, made by pycolmap itself, and their objective by its own projection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")

# fx ... and distortion of each camera model, for images of 1024 x 768.
LENSES = {
    "SIMPLE_PINHOLE": [1280.0, 512.0, 384.0],
    "PINHOLE": [1280.0, 1270.0, 512.0, 384.0],
    "SIMPLE_RADIAL": [1280.0, 512.0, 384.0, 0.05],
    "RADIAL": [1280.0, 500.0, 390.0, 0.05, 0.01],
    "OPENCV": [1280.0, 1270.0, 500.0, 390.0, 0.05, 0.01, 0.002, -0.003],
    "FULL_OPENCV": [1280.0, 1270.0, 512.0, 384.0, 0.05, 0.01, 0.002, -0.003, 0.01, 0.02, 0.01, 0.005],
    "OPENCV_FISHEYE": [600.0, 610.0, 512.0, 384.0, 0.02, 0.01, -0.002, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [600.0, 512.0, 384.0, 0.02],
    "RADIAL_FISHEYE": [600.0, 512.0, 384.0, 0.02, 0.003],
}


def make_model(lens: str, *, cameras_per_rig: int = 1, seed: int = 3) -> Any:
    """Return a model of ten images of 100 points with noise; its focal lengths are 1 % off."""
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2 // cameras_per_rig, cameras_per_rig
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, lens), LENSES[lens]
    world = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.rig_from_world_translation_stddev = noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, world)
    for camera in world.cameras.values():
        values = np.array(camera.params)
        values[: len(camera.focal_length_idxs())] *= 1.01
        camera.params = values
    return world


def objective(world: Any) -> float:
    """Return half the sum of squared residuals, by pycolmap's own projection, px^2."""
    total = 0.0
    for image in world.images.values():
        pose = image.cam_from_world()
        for seen in image.get_observation_points2D():
            pixel = image.camera.img_from_cam(pose * world.points3D[seen.point3D_id].xyz)
            total += float(np.sum((pixel - seen.xy) ** 2))
    return 0.5 * total


def adjusted(world: Any) -> float:
    """Return the objective that COLMAP's own bundle adjustment reaches, with what it refines by itself."""
    copy = pycolmap.Reconstruction(world)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    pycolmap.bundle_adjustment(copy, options)
    return objective(copy)


def written(world: Any, path: Path, *, text: bool = False) -> Path:
    """Write a model into a folder."""
    path.mkdir()
    (world.write_text if text else world.write_binary)(path)
    return path
