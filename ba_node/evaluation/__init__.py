# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Evaluate trajectories: alignment, metrics."""
