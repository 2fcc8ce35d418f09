# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What rclpy lacks or does wrong, and all that reaches into its private parts."""
