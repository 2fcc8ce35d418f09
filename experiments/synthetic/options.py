# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare every choice in a synthetic recording once, with unit, range and meaning.

``ba synth`` is a loop over its fields, as the other tools are over those of ``config/``.
"""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.config import Checked, ConfigError, option


@dataclass(frozen=True)
class SyntheticOptions(Checked):
    """What to record. A value of the wrong type or out of range raises ConfigError."""

    seed: int = option(0, "Seed of every random number.", within=(0, 2**32 - 1))
    keyframes: int = option(60, "Number of keyframes.", within=(2, 100_000))
    landmarks: int = option(4000, "Points on the surfaces of the world.", within=(10, 1_000_000))
    path: str = option(
        "loop",
        "loop: a figure of eight around two blocks, through the passage between them; line: down a street.",
        choices=("loop", "line"),
    )
    length_m: float = option(52.0, "Length of the path; the site of a loop scales with it.", within=(10.0, 10_000.0))
    keyframe_rate_hz: float = option(4.0, "Keyframes a second.", within=(0.01, 1000.0))

    baseline_m: float = option(0.12, "Distance of the stereo cameras; 0 for one camera.", within=(0.0, 10.0))
    look_deg: float = option(0.0, "Where the cameras look from ahead, positive to the left.", within=(-180.0, 180.0))
    width_px: int = option(640, "Width of an image.", within=(16, 16_384))
    height_px: int = option(480, "Height of an image.", within=(16, 16_384))
    fov_deg: float = option(85.0, "Horizontal field of view before k1, k2, ... act.", within=(10.0, 150.0))
    distortion: str = option(
        "none",
        "Lens: none (plumb_bob with zeros), plumb_bob or equidistant, with coefficients as of real lenses.",
        choices=("none", "plumb_bob", "equidistant"),
    )

    max_range_m: float = option(20.0, "Points farther away are not tracked.", within=(1.0, 10_000.0))
    noise_px: float = option(0.5, "Standard deviation of the Gaussian noise on u and v.", within=(0.0, 100.0))
    outlier_share: float = option(0.03, "Share of observations displaced by 10 to 60 px.", within=(0.0, 0.9))
    send_sigma: bool = option(True, "Publish noise_px as sigma_px; without it the receiver assumes 1 px.")
    depth_share: float = option(
        0.0, "Share of the first camera's observations that come with a depth.", within=(0.0, 1.0)
    )
    depth_noise: float = option(0.01, "Standard deviation of a measured depth, as a share of it.", within=(0.0, 0.3))

    tracks: int = option(250, "Most tracks followed at a time.", within=(8, 100_000))
    track_loss: float = option(
        0.05, "Chance that a point is lost from one keyframe to the next though visible.", within=(0.0, 1.0)
    )
    max_track_keyframes: int = option(0, "A track ends after this many keyframes; 0 for no limit.", within=(0, 100_000))
    min_track_keyframes: int = option(2, "Tracks seen in fewer keyframes are not published.", within=(1, 100_000))
    reobserve: bool = option(
        True, "A point that is seen again keeps its track id, as after a loop closure; otherwise it gets a new one."
    )
    ids: str = option(
        "sequential",
        "Keyframe and track ids: counted from 0, or spread over all of uint64 including both ends.",
        choices=("sequential", "random64"),
    )
    guesses: bool = option(False, "Publish first positions of the points, in the drifted frame.")
    guess_noise: float = option(
        0.05, "Standard deviation of such a position, as a share of the distance.", within=(0.0, 1.0)
    )

    drift_rotation_deg: float = option(
        1.5, "Random walk of the published orientation, about each axis.", unit="deg/sqrt(m)", within=(0.0, 90.0)
    )
    drift_translation: float = option(
        0.06, "Random walk of the published position, along each axis.", unit="m/sqrt(m)", within=(0.0, 10.0)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_track_keyframes > self.keyframes:
            raise ConfigError(
                f"min_track_keyframes = {self.min_track_keyframes} but keyframes = {self.keyframes}:"
                " no track could be published; lower it"
            )
        if 0 < self.max_track_keyframes < self.min_track_keyframes:
            raise ConfigError(
                f"max_track_keyframes = {self.max_track_keyframes} is below min_track_keyframes ="
                f" {self.min_track_keyframes}: no track could be published; raise it, or 0 for no limit"
            )
