# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the tests with ROS share: a domain of their own, nodes, peers and gates that go when a test ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from experiments.demo.domain import free_domain, isolation
from tests.ros.harness import Gates, NodeProcess, Peer


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """Keep these tests away from every other ROS program."""
    with pytest.MonkeyPatch.context() as patch:
        number = free_domain()
        for name, value in isolation(number).items():
            patch.setenv(name, value)
        yield number


@pytest.fixture
def start_node(domain: int) -> Iterator[Callable[..., NodeProcess]]:  # noqa: ARG001
    """Return a function that starts a node with the given arguments."""
    started: list[NodeProcess] = []

    def start(*arguments: str, **options: Any) -> NodeProcess:
        started.append(NodeProcess(*arguments, **options))
        return started[-1]

    yield start
    for node in started:
        node.close()


@pytest.fixture
def make_peer(domain: int) -> Iterator[Callable[..., Peer]]:  # noqa: ARG001
    """Return a function that makes a peer."""
    made: list[Peer] = []

    def make(**options: Any) -> Peer:
        made.append(Peer(**options))
        return made[-1]

    yield make
    for peer in made:
        peer.close()


@pytest.fixture
def gates(tmp_path: Path) -> Gates:
    folder = tmp_path / "gates"
    folder.mkdir()
    return Gates(folder)
