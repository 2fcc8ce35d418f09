# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Side-by-side runs of ba_node and its peers on the same problems; see docs/performance.md."""
