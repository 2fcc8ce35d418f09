# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold the error of recordings."""

from __future__ import annotations


class BagError(ValueError):
    """A recording that cannot be read or written: empty, truncated, not MCAP, without the topics that are needed."""
