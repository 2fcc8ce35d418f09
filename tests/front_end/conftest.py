# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A drive through the rendered corridor, and what the front-end's tests say of it."""

from __future__ import annotations

import pytest

from ba_node.estimate import Transform
from ba_node.front_end import Images
from tests.front_end import world


@pytest.fixture(scope="session")
def truth() -> list[Transform]:
    return world.drive(12)


@pytest.fixture(scope="session")
def stereo(truth: list[Transform]) -> list[Images]:
    return [world.images(world.rig(), pose, i) for i, pose in enumerate(truth)]
