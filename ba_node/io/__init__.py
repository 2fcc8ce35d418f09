# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write files: MCAP recordings, BAL problems, TUM trajectories, PLY clouds."""
