# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep processes of a demo or a test among themselves: a ROS domain that nobody else uses, on this machine only."""

from __future__ import annotations

import os
import socket

# Domains whose ports stay below the range from which Linux takes ports at random.
_DOMAINS = range(1, 101)
# Of the DDS-RTPS specification, 9.6.1: unicast discovery of the first participant in domain d is at 7410 + 250 d.
_PORT_BASE, _PORT_GAIN = 7410, 250


class DomainError(ValueError):
    """No ROS domain is free."""


def free_domain() -> int:
    """Return a ROS_DOMAIN_ID in which no participant runs on this machine.

    Raises:
        DomainError: all are taken.
    """
    domains = list(_DOMAINS)
    start = os.getpid() % len(domains)
    for domain in domains[start:] + domains[:start]:
        if all(_is_free(_PORT_BASE + _PORT_GAIN * domain + 2 * participant) for participant in range(3)):
            return domain
    raise DomainError(
        f"no ROS domain from {domains[0]} to {domains[-1]} is free on this machine: end other ROS programs"
    )


def isolation(domain: int) -> dict[str, str]:
    """Return the environment variables that keep a process in a domain and on this machine."""
    return {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
