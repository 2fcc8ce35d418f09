# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Find out from the tracks whether a set-up is what it is said to be."""
