# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the thesis draws to explain: the blocks of J and H of a small problem, and the cap that a camera sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from experiments.figures import COLOURS, new_figure
from experiments.thesis.experiments import Experiment
from experiments.thesis.problems import Posed

Clock = Callable[[], float]
Records = Mapping[str, Mapping[str, Any]]

# Point and image of each observation of Figure 3.2, counted from one.
_SEEN = ((1, 124), (2, 13), (3, 1234), (4, 234), (5, 23), (6, 4))
_IMAGES, _POINTS, _CAMERA_SIZE, _POINT_SIZE = 4, 6, 9, 3
_CAMERA, _POINT, _MIXED = 1, 2, 3


def blocks(_posed: Posed, _settings: Sequence[str], _clock: Clock) -> dict[str, Any]:
    """Return which entries of J and of H are not zero, by what they belong to (Figures 3.2, 3.3)."""
    seen = [(point - 1, int(image) - 1) for point, images in _SEEN for image in str(images)]
    begin = _CAMERA_SIZE * _IMAGES
    jacobian = np.zeros((2 * len(seen), begin + _POINT_SIZE * _POINTS), dtype=int)
    hessian = np.zeros((jacobian.shape[1],) * 2, dtype=int)
    for row, (point, image) in enumerate(seen):
        camera = slice(_CAMERA_SIZE * image, _CAMERA_SIZE * (image + 1))
        own = slice(begin + _POINT_SIZE * point, begin + _POINT_SIZE * (point + 1))
        rows = slice(2 * row, 2 * row + 2)
        jacobian[rows, camera], jacobian[rows, own] = _CAMERA, _POINT
        hessian[camera, camera], hessian[own, own] = _CAMERA, _POINT
        hessian[camera, own] = hessian[own, camera] = _MIXED
    figures = {"fill_of_e": len(seen) / (_IMAGES * _POINTS)}
    return {"figures": figures, "data": {"jacobian": jacobian.tolist(), "hessian": hessian.tolist()}}


def cap(posed: Posed, _settings: Sequence[str], _clock: Clock) -> dict[str, Any]:
    """Return one camera of a sphere, its axis, and which points it sees (Figure 5.1)."""
    state = posed.truth or posed.problem.start
    rotation, points = state.rotation[0], state.points
    centre = -rotation.T @ state.translation[0]
    rows = posed.problem.observations
    seen = np.isin(np.arange(len(points)), rows.point[rows.keyframe == 0])
    # A camera of these problems looks down -z.
    tilt = np.degrees(np.arccos(np.clip(rotation[2] @ centre / np.linalg.norm(centre), -1.0, 1.0)))
    data = {"centre": centre, "axis": -rotation[2], "points": points, "seen": seen.astype(int)}
    figures = {"tilt": float(tilt), "seen": float(seen.sum())}
    return {"figures": figures, "data": {name: np.round(value, 3).tolist() for name, value in data.items()}}


def draw_blocks(experiment: Experiment, records: Records) -> Figure:
    """Draw J beside H: cameras yellow, points green, both blue."""
    data = next(iter(records.values()))["data"]
    figure = new_figure(11.0, 5.5)
    colours = ListedColormap(["white", "#E6C229", "#009E73", "#56B4E9"])
    for axis, name in zip(figure.subplots(1, 2), ("jacobian", "hessian"), strict=True):
        axis.imshow(np.array(data[name]), cmap=colours, vmin=0, vmax=3, interpolation="nearest")
        axis.axvline(_CAMERA_SIZE * _IMAGES - 0.5, color="black", lw=0.5)
        axis.set_title(name.capitalize())
    figure.suptitle(experiment.heading)
    return figure


def draw_cap(experiment: Experiment, records: Records) -> Figure:
    """Draw one camera, its axis, the ray to the centre, and the points, those that it sees apart."""
    data = {name: np.array(value) for name, value in next(iter(records.values()))["data"].items()}
    figure = new_figure(7.0, 6.0)
    space = figure.add_subplot(projection="3d")
    seen = data["seen"] == 1
    space.plot(*data["points"][~seen].T, ".", color="#BBBBBB", ms=3.0, label="not seen")
    space.plot(*data["points"][seen].T, ".", color=COLOURS[1], ms=4.0, label="seen")
    ends = np.stack([data["centre"], data["centre"] + 0.8 * np.linalg.norm(data["centre"]) * data["axis"]])
    space.plot(*ends.T, color=COLOURS[0], label="optical axis")
    space.plot(*np.stack([data["centre"], np.zeros(3)]).T, "--", color="black", lw=0.8, label="ray to the centre")
    space.set_aspect("equal")
    space.legend(frameon=False)
    figure.suptitle(experiment.heading)
    return figure
