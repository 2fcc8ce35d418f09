# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Does the covariance mean what it says? Monte-Carlo runs whose errors are compared with it (NEES)."""
