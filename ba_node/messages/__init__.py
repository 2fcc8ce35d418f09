# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Turn messages into arrays and back, whoever made them: rclpy or a bag."""
