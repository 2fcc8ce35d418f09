# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold the error of recordings."""

from __future__ import annotations


class BagError(ValueError):
    """A recording that cannot be read or written: empty, truncated, not MCAP, without the topics that are needed."""


class EmptyBagError(BagError):
    """A file of a recording that is whole and holds no message, as a recorder may leave the last of several."""
