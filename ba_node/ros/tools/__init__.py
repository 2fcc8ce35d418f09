# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Programs beside the node: players, listeners and converters."""
