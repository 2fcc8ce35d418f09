# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Offer the command line, one short file a command."""

from ba_node.cli import interrupts

if interrupts.is_worker():
    interrupts.leave_to_parent()
elif interrupts.is_program():
    # Before the imports that take time, in which somebody may interrupt.
    interrupts.begin()
