# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Do the work of the commands: replay, track, check, tune, solve, convert, report, and on many recordings."""
