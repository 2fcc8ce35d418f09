# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold what a solve gives back, as arrays: the neutral form of the output messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import BoolArray, FloatArray, IdArray, IntArray
from ba_node.core import geometry
from ba_node.core.result import Iteration, Status
from ba_node.measurements import Keyframe

__all__ = [
    "Cloud",
    "Correction",
    "Estimate",
    "Extras",
    "Iteration",
    "Poses",
    "Refinement",
    "SolveReport",
    "Status",
    "Transform",
    "WindowView",
    "World",
]


@dataclass(frozen=True)
class Poses:
    """Poses of keyframes, oldest first."""

    keyframe_id: IdArray  # (n,) uint64
    stamp_ns: NDArray[np.int64]  # (n,) int64, ns
    position: FloatArray  # (n, 3) body in the fixed frame, m
    orientation: FloatArray  # (n, 4) fixed frame from body, unit quaternion x y z w

    @classmethod
    def of(cls, keyframes: Sequence[Keyframe]) -> Poses:
        """Return the poses of keyframes as a front-end has sent them, in their order."""
        return cls(
            np.array([keyframe.keyframe_id for keyframe in keyframes], dtype=np.uint64),
            np.array([keyframe.stamp_ns for keyframe in keyframes], dtype=np.int64),
            np.array([keyframe.position for keyframe in keyframes]).reshape(-1, 3),
            np.array([keyframe.orientation for keyframe in keyframes]).reshape(-1, 4),
        )

    def __len__(self) -> int:
        return len(self.keyframe_id)

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> Poses:
        """Return some of the poses."""
        return Poses(self.keyframe_id[rows], self.stamp_ns[rows], self.position[rows], self.orientation[rows])


@dataclass(frozen=True)
class Cloud:
    """Points of the map."""

    track_id: IdArray  # (n,) uint64
    position: FloatArray  # (n, 3) in the fixed frame, m
    rms_px: NDArray[np.float32]  # (n,) root mean square reprojection error per coordinate, px
    views: NDArray[np.int32]  # (n,) number of observations

    def __len__(self) -> int:
        return len(self.track_id)


@dataclass(frozen=True)
class SolveReport:
    """How a solve went: the fields of ``ba_msgs/SolverReport`` that the back-end knows, which documents them."""

    session_id: int = 0
    solve_count: int = 0
    newest_keyframe_id: int = 0
    status: Status = Status.SKIPPED
    reason: str = ""
    warnings: tuple[str, ...] = ()
    method: str = ""
    iterations: int = 0
    accepted_iterations: int = 0
    linear_iterations: int = 0
    objective_before: float = 0.0
    objective_after: float = 0.0
    gradient_norm: float = 0.0
    rms_px_before: float = 0.0
    rms_px_after: float = 0.0
    keyframes: int = 0
    fixed_keyframes: int = 0
    landmarks: int = 0
    observations: int = 0
    outliers: int = 0
    factors: int = 0
    outvoted_factors: int = 0
    inlier_share: float = 0.0
    parallax_deg: float = 0.0
    held_out_px_before: float = 0.0
    held_out_px_after: float = 0.0
    weakest_m: float = 0.0
    weakest_rad: float = 0.0
    held_keyframes: int = 0
    rejected: Mapping[str, int] = field(default_factory=dict)
    solve_time_s: float = 0.0
    correction_m: float = 0.0
    correction_rad: float = 0.0
    correction_held: bool = False
    adjustments: int = 0
    merged_tracks: int = 0


@dataclass(frozen=True)
class Transform:
    """A rigid transform: rotation (3, 3), translation (3,) m."""

    rotation: FloatArray
    translation: FloatArray

    def after(self, other: Transform) -> Transform:
        """Return the transform that applies ``other`` first, then this one."""
        parts = geometry.compose(self.rotation, self.translation, other.rotation, other.translation)
        return Transform(*parts)

    def inverse(self) -> Transform:
        """Return the inverse."""
        return Transform(*geometry.inverse(self.rotation, self.translation))


@dataclass(frozen=True)
class Correction:
    """Where the front-end's fixed frame stands in the map, as published: map from odom."""

    odom_frame: str  # name of the front-end's fixed frame
    position: FloatArray  # (3,) of its origin, m
    orientation: FloatArray  # (4,) unit quaternion x y z w


@dataclass(frozen=True)
class World:
    """Where the map lies in a frame that is fixed to the world."""

    frame_id: str  # name of that frame
    position: FloatArray  # (3,) of the map's origin, m
    orientation: FloatArray  # (4,) world from map, unit quaternion x y z w
    # (3,) latitude, longitude (deg, WGS 84), altitude over the ellipsoid (m) of its origin; None without GNSS
    geodetic: FloatArray | None = None


@dataclass(frozen=True)
class WindowView:
    """What there is to see of a solve; rows as in ``Estimate.refined``."""

    free: BoolArray  # (n,) True where the pose was free, False where it was fixed
    rms_px: FloatArray  # (n,) root mean square residual per coordinate of each keyframe, px; NaN without observations
    links: IntArray  # (m, 2) pairs of keyframes that see common points
    shared: IntArray  # (m,) number of their common points
    # (n_cam, 5, 3) what each camera sees, in the body: its centre, then the corners at a depth of 1 m
    frusta: FloatArray


@dataclass(frozen=True)
class Extras:
    """What a solve is to work out beside the estimate, for those who look at it."""

    covariance: bool = False
    view: bool = False
    points: bool = False  # covariances of the points too, by a solve of everything


@dataclass(frozen=True)
class Refinement:
    """The poses of a solve: they leave before all else that comes of it."""

    stamp_ns: int  # stamp of the newest keyframe, ns
    frame_id: str  # name of the map's frame
    session_id: int
    poses: Poses | None  # of the keyframes in the solve, free and fixed, oldest first; None if it was not taken
    correction: Correction | None  # of the front-end's fixed frame; None before the first usable solve of a session
    map_index: int  # number of the map
    replaces_map: bool = True  # see ``Estimate.replaces_map``


@dataclass(frozen=True)
class Estimate:
    """What is published after a solve.

    That of a map shares with the one before what has not changed; path and cloud are put together when somebody looks
    at them (``backend/whole_map.py``), and stay as they were, whatever becomes of the map.
    """

    stamp_ns: int  # stamp of the newest keyframe, ns
    frame_id: str  # name of the map's frame
    refined: Poses  # poses of the keyframes in the solve, free and fixed, oldest first
    trajectory: Poses  # poses of all keyframes that are kept, oldest first, the newest estimate of each
    cloud: Cloud  # all points that are kept
    report: SolveReport  # how the solve went
    # of the front-end's fixed frame; None before the first usable solve of a session
    correction: Correction | None = None
    # (n_refined, 6, 6) x, y, z (m), rotation about X, Y, Z (rad) of the map's frame; NaN where unknown, 0 for poses
    # that were fixed. None if it was not asked for, or the solve is not usable.
    covariance: FloatArray | None = None
    # (n_cloud, 3, 3) m^2, of the points; NaN where unknown. None unless a solve of everything was asked for it.
    point_covariance: FloatArray | None = None
    view: WindowView | None = None  # what there is to see; None likewise
    world: World | None = None  # where the map lies in the world; None as long as that is not known
    map_index: int = 0  # number of the map; another one has another, whatever the session ids

    @property
    def replaces_map(self) -> bool:
        """Return True if the map is another than before: after a solve, a held one too, and when all was forgotten."""
        return self.report.status.usable or self.report.status is Status.HELD or len(self.trajectory) == 0

    @property
    def refinement(self) -> Refinement:
        """Return the poses that it refines."""
        poses = self.refined if self.report.status.usable else None
        where = self.stamp_ns, self.frame_id, self.report.session_id
        return Refinement(*where, poses, self.correction, self.map_index, self.replaces_map)
