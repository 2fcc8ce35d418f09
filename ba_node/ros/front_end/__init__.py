# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The front-end as a node: image topics in, keyframes and tracks out."""
