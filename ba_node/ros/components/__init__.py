# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The parts of the node, each with its topics, services and timers."""
