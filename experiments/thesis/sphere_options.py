# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare every choice in a problem of points on a sphere once, and name the sizes that the thesis measures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ba_node.config import Checked, ConfigError, option


@dataclass(frozen=True)
class SphereOptions(Checked):
    """What to make. A value of the wrong type or out of range raises ConfigError."""

    seed: int = option(0, "Seed of every random number.", within=(0, 2**32 - 1))
    images: int = option(10, "Number of images, each with a camera of its own.", within=(2, 10_000))
    points: int = option(253, "Number of points, each seen in two images or more.", within=(10, 1_000_000))
    observations: int = option(
        0,
        "Number of observations, a random choice of what is visible; 0 for all of it.",
        within=(0, 100_000_000),
    )
    radius: float = option(500.0, "Radius of the sphere, in units of length.", within=(1e-3, 1e6))
    focal_px: float = option(350.0, "Mean focal length; as a number it is best below the radius.", within=(10.0, 1e5))
    camera_spread: float = option(
        1.0, "How much f, k1 and k2 differ between images; 0: one camera took all.", within=(0.0, 10.0)
    )
    near: float = option(1.6, "Least distance of a camera from the centre, in radii.", within=(1.05, 100.0))
    far: float = option(2.0, "Largest distance of a camera from the centre, in radii.", within=(1.05, 100.0))
    cone_deg: float = option(
        15.0,
        "Cameras lie within this angle of one axis: the larger, the fewer images see a point; 180 for all round.",
        within=(1.0, 180.0),
    )
    tilt_deg: float = option(15.0, "Largest angle between optical axis and ray to the centre.", within=(0.0, 30.0))
    min_image_points: int = option(
        20, "An image with fewer observations is dropped, and another one taken.", within=(6, 1_000_000)
    )
    min_image_area: float = option(
        0.25, "So is one whose observations span a smaller share of 800 x 600 px.", within=(0.0, 0.95)
    )
    noise_px: float = option(0.17, "Standard deviation of the Gaussian noise on u and v.", within=(0.0, 100.0))
    outlier_share: float = option(0.0, "Share of observations displaced by 10 to 60 px.", within=(0.0, 0.9))
    start_rotation_deg: float = option(1.0, "Error of a rotation at the start, about each axis.", within=(0.0, 90.0))
    start_translation: float = option(
        0.01, "Error of a translation at the start, along each axis, in radii.", within=(0.0, 10.0)
    )
    start_point: float = option(0.015, "Error of a point at the start, along each axis, in radii.", within=(0.0, 10.0))
    start_focal: float = option(
        0.01, "Error of a focal length at the start, as a share of it; k1 and k2 start at 0.", within=(0.0, 0.5)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.near > self.far:
            raise ConfigError(f"near = {self.near:g} is above far = {self.far:g}: cameras lie between the two")
        if 0 < self.observations < 2 * self.points:
            raise ConfigError(
                f"observations = {self.observations}: {self.points} points seen in two images each need"
                f" {2 * self.points}; raise it, or 0 for all that is visible"
            )


def _like_thesis(
    images: int, points: int, cone_deg: float, start: tuple[float, float], outlier_share: float = 0.02
) -> SphereOptions:
    """Return a sphere of section 5.1: the axis within 30 degrees, all that is visible observed.

    ``start``: errors of rotations (deg) and of points (radii) at the start.
    """
    return SphereOptions(
        images=images,
        points=points,
        tilt_deg=30.0,
        cone_deg=cone_deg,
        start_rotation_deg=start[0],
        start_point=start[1],
        outlier_share=outlier_share,
    )


# The sizes of section 5.3.1 and of Tables 5.1 to 5.4. The cone in which cameras lie is chosen by the number of
# observations (1326, 1834, 28 991, 228 658 and 1 477 513; it comes out within 1 %), the errors at the start by those
# that are printed: RMSE of cameras 75.57, 44.14, 42.07 and 26.42, of points 14.01, 11.78, 6.00 and 9.08, and the
# objective 2.44e5 of the first. That one ends at an objective that noise alone explains: 25.2 with 2652 rows and 842
# parameters less the gauge means a noise of 0.17 px and no outliers.
PRESETS: dict[str, SphereOptions] = {
    "10-253": _like_thesis(10, 253, 49.0, (2.033, 0.01646), outlier_share=0.0),
    "10-289": _like_thesis(10, 289, 27.0, (4.605, 0.0164)),
    "50-1000": _like_thesis(50, 1000, 14.25, (2.11, 0.01348)),
    "100-4000": _like_thesis(100, 4000, 16.5, (2.242, 0.00687)),
    "500-5000": _like_thesis(500, 5000, 10.75, (1.345, 0.01043)),
}
# Observations that the thesis has of each.
PRINTED_OBSERVATIONS = {"10-253": 1326, "10-289": 1834, "50-1000": 28_991, "100-4000": 228_658, "500-5000": 1_477_513}


def preset(name: str) -> SphereOptions:
    """Return one of the sizes that the thesis measures, by ``images-points``.

    Raises:
        ConfigError: there is no such size.
    """
    if name not in PRESETS:
        raise ConfigError(f"preset {name!r} does not exist: choose one of {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[name])
