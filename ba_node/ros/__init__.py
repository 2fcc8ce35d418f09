# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the back-end as a ROS 2 node; the only place that imports rclpy and message packages."""
