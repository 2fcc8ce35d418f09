# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Prove on recordings gone wrong that no harm is done: runs, tables and pictures of `ba robustness`."""
