# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare what is kept, what takes part in a solve, and when a solution is held back."""

from __future__ import annotations

from dataclasses import dataclass

from ba_node.config.declaration import Choice, Tune, option


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes and tracks take part in a solve."""

    max_keyframes: int = option(
        20,
        "Newest keyframes whose poses are refined in each solve; twice as many of one camera with marginalise.",
        within=(2, 100_000),
        tune=Tune(4, 60, ("accuracy", "latency")),
    )
    max_fixed_keyframes: int = option(
        20,
        "Older keyframes that see the window's points and take part with fixed poses; most shared tracks first.",
        within=(0, 100_000),
        tune=Tune(0, 40, ("accuracy", "latency"), log=False),
    )
    old_keyframes: str = option(
        "fix",
        "What becomes of keyframes that leave the window. See docs/concepts.md.",
        choices=(
            Choice("fix", "those that see the window's points take part with fixed poses"),
            Choice("marginalise", "what they tell of those that stay becomes a prior"),
            Choice("drop", "they take no part"),
        ),
    )
    max_landmarks: int = option(
        5000,
        "Points in a solve; beyond it those with the fewest observations are left out.",
        within=(10, 10_000_000),
        tune=Tune(200, 20_000, ("latency",)),
    )


@dataclass(frozen=True)
class SceneConfig:
    """What is remembered."""

    max_keyframes: int = option(5000, "Keyframes kept; beyond it the oldest are forgotten.", within=(10, 10_000_000))
    max_landmarks: int = option(
        500_000, "Tracks kept; beyond it those seen longest ago are forgotten.", within=(100, 100_000_000)
    )
    max_observations: int = option(
        20_000_000,
        "Observations kept (40 bytes each); beyond it the oldest keyframes are forgotten.",
        within=(1000, 1_000_000_000),
    )
    max_reorder_s: float = option(
        10.0,
        "Keyframes whose stamps are further than this before the newest begin a new session, as when the clock is set"
        " back, and one alone is rejected; closer ones are sorted in. One this far ahead waits for the next. 0: never.",
        within=(0.0, 1e9),
    )
    redundant_share: float = option(
        0.0,
        "A keyframe that has left the window is taken out of the map where three others at least see this share of its"
        " points (0.9 in ORB-SLAM); 0: all are kept.",
        within=(0.0, 1.0),
    )
    join_sessions: bool = option(
        False,
        "Sessions become one map where tracks connect them, by their ids or by merges; the ids of keyframes and tracks"
        " have to be unique over all sessions then.",
    )
    max_pending: int = option(
        200,
        "Track messages that wait for their keyframe or the rig; beyond it the oldest are rejected.",
        within=(1, 100_000),
    )


@dataclass(frozen=True)
class TracksConfig:
    """How tracks become points, and when an observation is an outlier."""

    min_parallax_deg: float = option(
        1.0,
        "Smallest angle between two viewing rays of a track for it to be triangulated.",
        within=(0.0, 90.0),
        tune=Tune(0.1, 5.0),
    )
    max_triangulation_px: float = option(
        12.0,
        "Largest reprojection error, in sigmas, of a view that agrees where a point begins; half of it for two views.",
        within=(0.1, 1e6),
        tune=Tune(3.0, 40.0),
    )
    outlier_px: float = option(
        6.0,
        "Observations beyond this many sigmas (at least 4.4 x the median) sit out the next solve; 0 keeps all.",
        within=(0.0, 1e6),
        tune=Tune(1.5, 20.0),
    )
    depth_sigma_ratio: float = option(
        0.02,
        "Standard deviation of a measured depth, as a share of the depth.",
        within=(1e-6, 10.0),
        tune=Tune(0.003, 0.3, ()),
    )


@dataclass(frozen=True)
class OdometryConfig:
    """How much the front-end's own steps from keyframe to keyframe count in a solve."""

    enabled: bool = option(True, "Let the steps count; they give one camera its scale, and hold what images do not.")
    sigma_m: float = option(
        0.001,
        "Standard deviation of a step's translation along each axis at rest.",
        within=(0.0, 1e6),
        tune=Tune(1e-4, 0.1, ()),
    )
    sigma_m_per_m: float = option(
        0.01, "The same, added for each metre of the step.", within=(0.0, 1e6), tune=Tune(1e-3, 0.3)
    )
    sigma_rad: float = option(
        0.001,
        "Standard deviation of a step's rotation about each axis at rest.",
        within=(0.0, 1e3),
        tune=Tune(1e-4, 0.1, ()),
    )
    sigma_rad_per_m: float = option(
        0.003, "The same, added for each metre of the step.", within=(0.0, 1e3), tune=Tune(3e-4, 0.1)
    )
    sigma_rad_per_rad: float = option(
        0.01, "The same, added for each radian of the step.", within=(0.0, 1e3), tune=Tune(1e-3, 0.3, ())
    )
    max_inflation: float = option(
        10.0,
        "Standard deviations grow up to this many times where well-determined keyframes show the steps to be worse.",
        within=(1.0, 1e6),
    )
    loss_scale: float = option(
        1.0,
        "Where Cauchy's loss leaves the square, in standard deviations: steps that are off by far more count little.",
        within=(1e-3, 1e6),
        tune=Tune(0.3, 10.0, ()),
    )


@dataclass(frozen=True)
class FactorsConfig:
    """What is known beside pixels and steps: relative poses, priors, gravity, loops. See docs/factors.md."""

    enabled: bool = option(True, "Let what comes on their topics count.")
    loss_scale: float = option(
        3.0,
        "Where Cauchy's loss leaves the square, in standard deviations: what contradicts the rest by far pulls little.",
        within=(1e-3, 1e6),
    )
    gnss_sigma_m: float = option(
        5.0, "Standard deviation of a fix of GNSS that tells no covariance.", within=(1e-4, 1e6)
    )
    antenna_x_m: float = option(0.0, "Where the antenna is on the body.", within=(-1e3, 1e3))
    antenna_y_m: float = option(0.0, "The same, y.", within=(-1e3, 1e3))
    antenna_z_m: float = option(0.0, "The same, z.", within=(-1e3, 1e3))
    align_m: float = option(
        10.0,
        "How far the path has to spread (standard deviation) before map and world are aligned by positions alone; at"
        " least five times the noise of these. With measured orientations at once.",
        within=(0.0, 1e6),
    )
    adjust_max_keyframes: int = option(
        3000,
        "Maps of more keyframes are bent alone then, and not refined as a whole (~/optimize does that).",
        within=(0, 10_000_000),
    )
    adjust_m: float = option(
        0.3,
        "A loop or priors that move a keyframe further begin a solve of everything; 0: never, nor as a map grows.",
        within=(0.0, 1e6),
    )


_KEPT_OR_NOT = (
    Choice("fixed", "as given"),
    Choice("refined", "refined over the whole map by a solve of everything, as far as the data tell"),
)


@dataclass(frozen=True)
class CalibrationConfig:
    """What of the cameras a solve of everything refines. See docs/calibration.md."""

    intrinsics: str = option("fixed", "fx, fy, cx, cy and two coefficients of distortion.", choices=_KEPT_OR_NOT)
    extrinsics: str = option("fixed", "Where the cameras sit on the body.", choices=_KEPT_OR_NOT)
    time_offset: str = option("fixed", "How much later than stamped the images were taken.", choices=_KEPT_OR_NOT)
    intrinsics_sigma: float = option(
        0.03, "Standard deviation of the given fx, fy, cx and cy, as a share of fx.", within=(1e-6, 1.0)
    )
    distortion_sigma: float = option(
        0.05, "Standard deviation of the given coefficients of distortion.", within=(1e-6, 10.0)
    )
    rotation_sigma_rad: float = option(
        0.03, "Standard deviation of the given rotation of a camera on the body.", within=(1e-6, 1.0)
    )
    position_sigma_m: float = option(
        0.03, "Standard deviation of the given position of a camera on the body.", within=(1e-6, 10.0)
    )
    time_sigma_s: float = option(
        0.05, "Standard deviation of an offset of the stamps of the images.", within=(1e-6, 10.0)
    )

    @property
    def wanted(self) -> bool:
        """Return True if anything is to be refined."""
        return "refined" in (self.intrinsics, self.extrinsics, self.time_offset)


@dataclass(frozen=True)
class GuardConfig:
    """When a solution is held back, so that the front-end's poses stand. See docs/concepts.md."""

    check_setup: bool = option(
        True,
        "Compare rig, poses, depths and intrinsics with the tracks of the first keyframes of a session, and hold all"
        " solves where they contradict each other, with the likely mistake as the reason. See docs/check.md.",
    )
    enabled: bool = option(
        True, "Hold solutions back that are not determined, not plausible, or no better than the input."
    )
    step_sigma_m: float = option(
        0.03,
        "What the front-end's step between two keyframes is off at least: standard deviation along each axis.",
        within=(1e-6, 1e6),
    )
    step_sigma_share: float = option(
        0.1, "The same, as a share of the length of the step, on top of it.", within=(1e-6, 10.0)
    )
    turn_sigma_rad: float = option(0.02, "The same for its turn, about each axis.", within=(1e-6, 1.0))
    turn_sigma_share: float = option(0.1, "The same, as a share of the turn, on top of it.", within=(1e-6, 10.0))
    turn_sigma_rad_per_m: float = option(
        0.02, "The same, for each metre of the step, on top of it.", within=(0.0, 10.0)
    )
    max_sigmas: float = option(
        5.0,
        "A step of a solution that is this many sigmas off the front-end's, and not borne out by tracks, is held.",
        within=(0.5, 1e6),
    )
    max_typical_sigmas: float = option(
        2.5, "A solution of which half the steps are this many sigmas off is held.", within=(0.5, 1e6)
    )
    max_scale_error: float = option(
        0.12,
        "A solution whose steps or turns are all longer or shorter than the front-end's by this share is held.",
        within=(1e-3, 1e6),
    )
    min_inlier_share: float = option(
        0.4,
        "A solution that fewer of its observations agree with (within tracks.outlier_px) is held.",
        within=(0.0, 1.0),
    )
    min_points: int = option(
        5,
        "A keyframe that sees fewer points of a solve is not refined; one camera without depths needs twice as many.",
        within=(2, 1000),
    )
    held_out_tracks: int = option(
        16,
        "Tracks that a solution is tried on, at most one in 128 of which takes no part in it; 0: no trial.",
        within=(0, 10_000),
    )
    max_worse_share: float = option(
        0.15,
        "A solution that explains these tracks worse than the front-end's poses by this share is held.",
        within=(0.0, 10.0),
    )
