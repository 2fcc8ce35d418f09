# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep what is known of the current session: rig, keyframes, observations, landmarks."""
