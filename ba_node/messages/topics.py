# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""List topics, services and actions, each declared once: for the node, the player, replays and docs/topics.md."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Delivery(enum.Enum):
    """Quality of service, in the words of docs/topics.md."""

    RELIABLE = "reliable"
    LATCHED = "latched"
    LATCHED_OR_NOT = "latched or not"
    BEST_EFFORT = "best effort"


class Direction(enum.Enum):
    """What the node does with a topic."""

    TAKEN = "taken"
    PUBLISHED = "published"
    # Worked out only while somebody subscribes.
    ON_DEMAND = "published on demand"


@dataclass(frozen=True)
class Topic:
    """A topic.

    Attributes:
        name: of an input relative to the namespace, of an output below the node's name; with a slash, shared by all of
            ROS.
        type_name: ``package/msg/Type``.
        direction: seen from the node.
        delivery: quality of service.
        text: what it holds.
    """

    name: str
    type_name: str
    direction: Direction
    delivery: Delivery
    text: str

    @property
    def is_shared(self) -> bool:
        """Return True if all of ROS shares it."""
        return self.name.startswith("/")

    @property
    def given_name(self) -> str:
        """Return the name by which the node asks ROS for it."""
        own = self.direction is not Direction.TAKEN and not self.is_shared
        return f"~/{self.name}" if own else self.name


@dataclass(frozen=True)
class Command:
    """A service or an action below the node's name."""

    type_name: str
    text: str


_IN, _OUT, _SIDE = Direction.TAKEN, Direction.PUBLISHED, Direction.ON_DEMAND
_RELIABLE, _LATCHED = Delivery.RELIABLE, Delivery.LATCHED
TF, TF_STATIC, DIAGNOSTICS, CLOCK = "/tf", "/tf_static", "/diagnostics", "/clock"

_ALL = (
    Topic(
        "keyframes",
        "ba_msgs/msg/Keyframe",
        _IN,
        _RELIABLE,
        "Pose of the body at every keyframe, as the front-end has it.",
    ),
    Topic(
        "feature_tracks",
        "ba_msgs/msg/FeatureTracks",
        _IN,
        _RELIABLE,
        "What one camera saw in one keyframe; one message a camera.",
    ),
    Topic("landmark_guesses", "ba_msgs/msg/LandmarkGuesses", _IN, _RELIABLE, "Optional: first positions of points."),
    Topic(
        "camera_rig",
        "ba_msgs/msg/CameraRig",
        _IN,
        _LATCHED,
        "Cameras and where they sit on the body. Sent once is enough.",
    ),
    Topic(
        "camera_info",
        "sensor_msgs/msg/CameraInfo",
        _IN,
        Delivery.LATCHED_OR_NOT,
        "Instead of a rig: one camera at the body's origin.",
    ),
    Topic(
        "refined_keyframes",
        "ba_msgs/msg/RefinedKeyframes",
        _OUT,
        _RELIABLE,
        "Poses of the window after each solve, by id.",
    ),
    Topic(
        "pose",
        "geometry_msgs/msg/PoseStamped",
        _OUT,
        _RELIABLE,
        "The same, one message a keyframe with the keyframe's stamp.",
    ),
    Topic("path", "nav_msgs/msg/Path", _OUT, _LATCHED, "Poses of all keyframes kept, newest `output.path_max_poses`."),
    Topic(
        "points",
        "sensor_msgs/msg/PointCloud2",
        _OUT,
        _LATCHED,
        "The map: x, y, z (m), rms_px (float32), views (uint32).",
    ),
    Topic(
        "report",
        "ba_msgs/msg/SolverReport",
        _OUT,
        _RELIABLE,
        "How each solve went, failed and skipped ones too; without a solve, what was turned away.",
    ),
    Topic(
        "pose_with_covariance",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        _SIDE,
        _RELIABLE,
        (
            "As `~/pose`, with a covariance against what the solve held fixed; with a robust loss its standard"
            " deviations are 1.2 to 1.5 times too small, see docs/frames.md. Only while subscribed."
        ),
    ),
    Topic(
        "markers",
        "visualization_msgs/msg/MarkerArray",
        _SIDE,
        _LATCHED,
        "Frusta, links between keyframes, residual colours. Only while subscribed.",
    ),
    Topic(TF, "tf2_msgs/msg/TFMessage", _OUT, _RELIABLE, "`map -> odom`, see docs/frames.md. Needs tf2_msgs."),
    Topic(
        DIAGNOSTICS,
        "diagnostic_msgs/msg/DiagnosticArray",
        _OUT,
        _RELIABLE,
        "How the node fares, once a second, see docs/diagnostics.md.",
    ),
    Topic(
        TF_STATIC,
        "tf2_msgs/msg/TFMessage",
        _IN,
        _LATCHED,
        "Where the cameras sit on the body, with `frames.extrinsics: tf_static`. Needs tf2_msgs.",
    ),
    Topic(CLOCK, "rosgraph_msgs/msg/Clock", _IN, Delivery.BEST_EFFORT, "The time, with `use_sim_time: true`."),
)
TOPICS = {topic.name: topic for topic in _ALL}
# What a recording holds for a replay, and what a solve gives: type by name.
INPUT_TYPES = {one.name: one.type_name for one in _ALL if one.direction is _IN and not one.is_shared}
OUTPUT_TYPES = {one.name: one.type_name for one in _ALL if one.direction is _OUT and not one.is_shared}
CAMERAS = tuple(name for name in INPUT_TYPES if TOPICS[name].delivery is not _RELIABLE)
CAMERA_TYPES = tuple(INPUT_TYPES[name] for name in CAMERAS)
LATCHED_OUTPUTS = tuple(name for name in OUTPUT_TYPES if TOPICS[name].delivery is _LATCHED)
ON_DEMAND = tuple(one.name for one in _ALL if one.direction is _SIDE)

SERVICES = {
    "reset": Command("std_srvs/srv/Trigger", "Forget the map and begin anew; the cameras stay."),
    "pause": Command(
        "std_srvs/srv/SetBool",
        "`data: true`: ignore keyframes, tracks and guesses, and count them; `data: false`: go on.",
    ),
    "save_map": Command("ba_msgs/srv/SaveMap", "Write all that is known to a file, see docs/map_format.md."),
    "load_map": Command("ba_msgs/srv/LoadMap", "Put what a file holds in the place of all that is known."),
}
ACTIONS = {
    "optimize": Command(
        "ba_msgs/action/Optimize", "Refine all keyframes and points that are kept; feedback after each iteration."
    )
}
