# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write files: recordings, maps, rigs, problems and models of other tools, trajectories, clouds."""
