# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The solver's thread and what feeds it. Nothing here calls ROS."""
