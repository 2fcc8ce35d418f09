# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Bundle-adjustment back-end for ROS 2."""

__version__ = "0.2.0"
