# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What is said about cameras, frames and units is wrong; poses and pixels are good."""

from __future__ import annotations

import dataclasses

import numpy as np

from ba_node.core import geometry
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe
from experiments.robustness.faults.recording import FloatArray, Recording, rows_of

# Coefficients of a real lens (k1 k2 p1 p2 k3), that of a EuRoC camera.
_DISTORTION = np.array([-0.28340811, 0.07395907, 0.00019359, 0.0000176187, 0.0])


def baseline_reversed(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Put the second camera on the other side of the first."""

    def change(rig: CameraRig) -> CameraRig:
        position = rig.position.copy()
        position[1] = 2.0 * position[0] - position[1]
        return dataclasses.replace(rig, position=position)

    return recording.changed(CameraRig, change)


def cameras_swapped(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Give the images of each of the two cameras to the other; the first keeps what depth there is."""
    return recording.changed(
        FeatureTracks, lambda image: dataclasses.replace(image, camera_index=1 - image.camera_index)
    )


def extrinsics_inverted(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Give camera-from-body where body-from-camera is asked for."""

    def change(rig: CameraRig) -> CameraRig:
        rotation, position = geometry.inverse(geometry.matrix_from_quaternion(rig.orientation), rig.position)
        orientation = geometry.quaternion_from_matrix(rotation)
        return dataclasses.replace(rig, position=position, orientation=orientation)

    return recording.changed(CameraRig, change)


def axes_confused(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Give the cameras the axes of the body (x ahead) in the place of optical ones (z ahead)."""
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    return recording.changed(
        CameraRig, lambda rig: dataclasses.replace(rig, orientation=np.tile(identity, (len(rig), 1)))
    )


def camera_turned(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Turn the last camera of the rig message by some degrees about a random axis."""
    axis = rng.normal(size=3)
    turn = geometry.so3_exp(np.radians(amount) * axis / np.linalg.norm(axis))

    def change(rig: CameraRig) -> CameraRig:
        orientation = rig.orientation.copy()
        rotation = geometry.matrix_from_quaternion(orientation[-1]) @ turn
        orientation[-1] = geometry.quaternion_from_matrix(rotation)
        return dataclasses.replace(rig, orientation=orientation)

    return recording.changed(CameraRig, change)


def all_turned(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Turn all cameras of the rig message by some degrees about the axis that the first looks along."""
    turn = geometry.so3_exp(np.radians([0.0, 0.0, amount]))

    def change(rig: CameraRig) -> CameraRig:
        rotation, position = geometry.matrix_from_quaternion(rig.orientation), rig.position
        about = rotation[0] @ turn @ rotation[0].T
        orientation = geometry.quaternion_from_matrix(about @ rotation)
        return dataclasses.replace(
            rig, orientation=orientation, position=position[:1] + (position - position[:1]) @ about.T
        )

    return recording.changed(CameraRig, change)


def poses_w_first(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Write the quaternions of the poses with w first."""
    return recording.changed(
        Keyframe, lambda keyframe: dataclasses.replace(keyframe, orientation=np.roll(keyframe.orientation, 1))
    )


def poses_optical(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Publish poses of a body whose z looks ahead, where its x is asked for."""
    optical = np.array([0.5, -0.5, 0.5, -0.5])

    def change(keyframe: Keyframe) -> Keyframe:
        rotation = geometry.matrix_from_quaternion(keyframe.orientation) @ geometry.matrix_from_quaternion(optical)
        return dataclasses.replace(keyframe, orientation=geometry.quaternion_from_matrix(rotation))

    return recording.changed(Keyframe, change)


def baseline_off(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the distance of the second camera from the first."""

    def change(rig: CameraRig) -> CameraRig:
        position = rig.position.copy()
        position[1] = position[0] + amount * (position[1] - position[0])
        return dataclasses.replace(rig, position=position)

    return recording.changed(CameraRig, change)


def sigma_off(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the stated standard deviation of image coordinates."""
    return recording.changed(FeatureTracks, lambda image: dataclasses.replace(image, sigma_px=amount * image.sigma_px))


def steps_scaled(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the positions of the keyframes."""
    return recording.changed(
        Keyframe, lambda keyframe: dataclasses.replace(keyframe, position=amount * keyframe.position)
    )


def depth_in_mm(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply depths, by 1000 where they are in millimetres."""
    return recording.changed(FeatureTracks, lambda image: dataclasses.replace(image, depth_m=amount * image.depth_m))


def poses_inverted(recording: Recording, _amount: float, _rng: np.random.Generator) -> Recording:
    """Publish body-from-world where world-from-body is asked for."""

    def change(keyframe: Keyframe) -> Keyframe:
        rotation = geometry.matrix_from_quaternion(keyframe.orientation)
        back, position = geometry.inverse(rotation, keyframe.position)
        return dataclasses.replace(keyframe, position=position, orientation=geometry.quaternion_from_matrix(back))

    return recording.changed(Keyframe, change)


def focal_off(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Multiply the focal lengths in the rig message."""
    return recording.changed(
        CameraRig, lambda rig: dataclasses.replace(rig, intrinsics=rig.intrinsics * [amount, amount, 1.0, 1.0])
    )


def roi_ignored(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Take pixels of a region of the sensor, with its corner at (amount, 0.6 amount) px; K is of the whole sensor."""
    size = recording.sound.rig.image_size[0].astype(float)
    corner = np.round([amount, 0.6 * amount])
    end = np.minimum(corner + np.round(0.7 * size), size)

    def change(image: FeatureTracks) -> FeatureTracks:
        inside = ((image.uv >= corner) & (image.uv <= end - 1.0)).all(axis=1)
        return _with_pixels(rows_of(image, inside), image.uv[inside] - corner)

    return recording.changed(FeatureTracks, change)


def roi_given(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Take pixels of a region that CameraInfo names."""
    width, height = recording.sound.rig.image_size[0].tolist()
    x, y = round(amount), round(0.6 * amount)
    region = {
        "x_offset": x,
        "y_offset": y,
        "width": min(round(0.7 * width), width - x),
        "height": min(round(0.7 * height), height - y),
    }
    return dataclasses.replace(roi_ignored(recording, amount, rng), camera_info={"roi": region})


def binning_ignored(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Take pixels of an image that the camera has made smaller; K is of the whole sensor."""

    def change(image: FeatureTracks) -> FeatureTracks:
        return dataclasses.replace(_with_pixels(image, image.uv / amount), sigma_px=image.sigma_px / amount)

    return recording.changed(FeatureTracks, change)


def binning_given(recording: Recording, amount: float, rng: np.random.Generator) -> Recording:
    """Take pixels of a smaller image as CameraInfo says."""
    said = {"binning_x": int(amount), "binning_y": int(amount)}
    return dataclasses.replace(binning_ignored(recording, amount, rng), camera_info=said)


def rectified_with_distortion(recording: Recording, amount: float, _rng: np.random.Generator) -> Recording:
    """Give the distortion of the lens although the images are rectified; ``amount`` scales its coefficients."""
    return recording.changed(
        CameraRig,
        lambda rig: dataclasses.replace(
            rig, models=("plumb_bob",) * len(rig), distortion=(amount * _DISTORTION,) * len(rig)
        ),
    )


def _with_pixels(image: FeatureTracks, uv: FloatArray) -> FeatureTracks:
    return dataclasses.replace(image, uv=uv.astype(np.float32).astype(np.float64))
