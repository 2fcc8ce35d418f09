# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""One module a solver; each runs in a process of its own and writes a trace (see trace.py)."""
