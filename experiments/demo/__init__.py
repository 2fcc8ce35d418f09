# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Show the node at work on the shipped recording: ``ba demo``, ``make demo``."""
