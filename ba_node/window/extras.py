# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Work out what somebody looks at beside the estimate: covariances, and what there is to see."""

from __future__ import annotations

from typing import Any

import numpy as np

from ba_node.arrays import IntArray
from ba_node.config import Config
from ba_node.core import methods
from ba_node.core.problem import State
from ba_node.estimate import Extras
from ba_node.scene.scene import Scene
from ba_node.window.covariance import covariances
from ba_node.window.selection import Selection
from ba_node.window.view import view


def work_out(
    wanted: Extras, scene: Scene, config: Config, selection: Selection, state: State, refined: IntArray
) -> dict[str, Any]:
    """Return what is wanted of a solution in the scale of the map, by the names of its fields in Estimate.

    ``refined`` are rows of the keyframes of the estimate, oldest first, and so are the rows of the results.
    """
    places = scene.places()
    place = np.searchsorted(places[refined], places[selection.keyframes])
    found: dict[str, Any] = {}
    if wanted.covariance:
        measured = scene.keyframes.input_position[selection.keyframes]
        found["covariance"] = np.full((len(refined), 6, 6), np.nan)
        found["covariance"][place] = covariances(selection, state, measured, methods.from_config(config.solver))
    if wanted.view:
        good = ~scene.observations.outlier[selection.rows[selection.inlier]]
        found["view"] = view(selection.problem, state, good, place, len(refined))
    return found
