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
    """A topic."""

    # of an input relative to the namespace, of an output below the node's name; with a slash, shared by all of ROS
    name: str
    type_name: str  # ``package/msg/Type``
    text: str  # what it holds
    direction: Direction = Direction.TAKEN  # seen from the node
    delivery: Delivery = Delivery.RELIABLE  # quality of service
    # many publish its type for other ends: in a recording it is taken by its name alone, or where a user says so
    by_name: bool = False

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
_LATCHED = Delivery.LATCHED
TF, TF_STATIC, DIAGNOSTICS, CLOCK = "/tf", "/tf_static", "/diagnostics", "/clock"

_ALL = (
    Topic("keyframes", "ba_msgs/msg/Keyframe", "Pose of the body at every keyframe, as the front-end has it."),
    Topic("feature_tracks", "ba_msgs/msg/FeatureTracks", "What one camera saw in one keyframe; one message a camera."),
    Topic("landmark_guesses", "ba_msgs/msg/LandmarkGuesses", "Optional: first positions of points."),
    Topic("relative_poses", "ba_msgs/msg/RelativePose", "Optional: measured poses of one keyframe in another."),
    Topic("landmark_priors", "ba_msgs/msg/LandmarkPriors", "Optional: points whose places are known."),
    Topic("track_merges", "ba_msgs/msg/TrackMerge", "Optional: tracks that are the same point, as after a loop."),
    Topic("gravity", "ba_msgs/msg/GravityDirection", "Optional: which way is down at a keyframe."),
    Topic(
        "pose_prior",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "Optional: where the body is in a frame fixed to the world; paired by stamp, see docs/factors.md.",
        by_name=True,
    ),
    Topic(
        "gnss",
        "sensor_msgs/msg/NavSatFix",
        "Optional: where an antenna is on the earth; paired by stamp, see docs/factors.md.",
        delivery=Delivery.BEST_EFFORT,
        by_name=True,
    ),
    Topic(
        "camera_rig",
        "ba_msgs/msg/CameraRig",
        "Cameras and where they sit on the body. Sent once is enough.",
        _IN,
        _LATCHED,
    ),
    Topic(
        "camera_info",
        "sensor_msgs/msg/CameraInfo",
        "Instead of a rig: one camera at the body's origin.",
        _IN,
        Delivery.LATCHED_OR_NOT,
    ),
    Topic("refined_keyframes", "ba_msgs/msg/RefinedKeyframes", "Poses of the window after each solve, by id.", _OUT),
    Topic(
        "pose",
        "geometry_msgs/msg/PoseStamped",
        "The same, one message a keyframe with the keyframe's stamp: stamps go back with each solve. For the newest"
        " alone take `~/odometry`.",
        _OUT,
    ),
    Topic("path", "nav_msgs/msg/Path", "Poses of all keyframes kept, newest `output.path_max_poses`.", _OUT, _LATCHED),
    Topic(
        "points",
        "sensor_msgs/msg/PointCloud2",
        "The map: x, y, z (m), rms_px (float32), views (uint32).",
        _OUT,
        _LATCHED,
    ),
    Topic(
        "report",
        "ba_msgs/msg/SolverReport",
        "How each solve went, failed and skipped ones too; without a solve, what was turned away.",
        _OUT,
        _LATCHED,
    ),
    Topic(
        "odometry",
        "nav_msgs/msg/Odometry",
        "Pose of the newest keyframe after each solve, held ones too, for those who steer by it: stamps only rise"
        " within a map. Mean velocity since the keyframe before. Covariances as of `~/pose_with_covariance`, 1e6 where"
        " unknown. Only while subscribed.",
        _SIDE,
    ),
    Topic(
        "map_in_world",
        "geometry_msgs/msg/PoseStamped",
        "Where the map's origin is in the world's frame, once priors or GNSS tell; see docs/factors.md.",
        _OUT,
        _LATCHED,
    ),
    Topic(
        "world_origin",
        "sensor_msgs/msg/NavSatFix",
        "Where the origin of that frame (east, north, up) is on the earth, with GNSS.",
        _OUT,
        _LATCHED,
    ),
    Topic(
        "pose_with_covariance",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "As `~/pose`, with a covariance against what the solve held fixed; after `~/optimize` of the whole path"
        " against the map's first keyframe. See docs/frames.md. Only while subscribed.",
        _SIDE,
    ),
    Topic(
        "markers",
        "visualization_msgs/msg/MarkerArray",
        "Frusta, links between keyframes, residual colours. Only while subscribed.",
        _SIDE,
        _LATCHED,
    ),
    Topic(TF, "tf2_msgs/msg/TFMessage", "`map -> odom`, see docs/frames.md. Needs tf2_msgs.", _OUT),
    Topic(
        DIAGNOSTICS,
        "diagnostic_msgs/msg/DiagnosticArray",
        "How the node fares, once a second, see docs/diagnostics.md.",
        _OUT,
    ),
    Topic(
        TF_STATIC,
        "tf2_msgs/msg/TFMessage",
        "Where the cameras sit on the body, with `frames.extrinsics: tf_static`. Needs tf2_msgs.",
        _IN,
        _LATCHED,
    ),
    Topic(CLOCK, "rosgraph_msgs/msg/Clock", "The time, with `use_sim_time: true`.", _IN, Delivery.BEST_EFFORT),
)
TOPICS = {topic.name: topic for topic in _ALL}
# Of the inputs: it rises when one of their definitions changes in its fields, types or meanings. What is new comes on
# topics of its own and leaves it as it is.
INTERFACE_VERSION = 1
# Of images, as they are and compressed.
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# What a recording holds for a replay, and what a solve gives: type by name.
INPUT_TYPES = {one.name: one.type_name for one in _ALL if one.direction is _IN and not one.is_shared}
OUTPUT_TYPES = {one.name: one.type_name for one in _ALL if one.direction is _OUT and not one.is_shared}
CAMERAS = ("camera_rig", "camera_info")
# Every one comes from a front-end; what else is known beside pixels may come from elsewhere, and more seldom.
CAMERA_TYPES = tuple(INPUT_TYPES[name] for name in CAMERAS)
LATCHED_OUTPUTS = tuple(name for name in OUTPUT_TYPES if TOPICS[name].delivery is _LATCHED)
# Those of them that show the whole map.
WHOLE_MAP = tuple(name for name in LATCHED_OUTPUTS if name != "report")
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
