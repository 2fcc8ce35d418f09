# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Name the outputs that are not made by ``outputs.py``: for those who look, and for all of ROS."""

from __future__ import annotations

# Below the node's name; worked out only while someone subscribes.
SIDE_TYPES = {
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "markers": "visualization_msgs/msg/MarkerArray",
}
# With names that all of ROS shares.
SHARED_TYPES = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
TF_STATIC = "/tf_static"
