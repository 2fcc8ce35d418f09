# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Solve a model of COLMAP or a bundle problem of g2o as a whole.

Free are poses, points, and what is asked for of the cameras, shared as in the model.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.arrays import FloatArray
from ba_node.config import SolverOptions
from ba_node.core.bordered import Shared, Unknown, place_of
from ba_node.core.objective import reprojection_errors, rms_px, squared_errors
from ba_node.core.problem import Cameras, Problem, State
from ba_node.core.shared_focal import solve_cameras
from ba_node.core.solver import solve
from ba_node.estimate import Iteration, Poses
from ba_node.io.colmap import ColmapModel, read_colmap, write_colmap
from ba_node.io.g2o import read_g2o, write_g2o
from ba_node.io.model import LENSES, ModelError, Reconstruction
from ba_node.offline.solve_bal import Solved, middle_if_far

# What of the cameras can be refined: columns of their parameters, and their places in a rig.
FOCAL, PRINCIPAL_POINT, DISTORTION, RIG = "focal", "principal_point", "distortion", "rig"
_COLUMNS = {FOCAL: (0, 1), PRINCIPAL_POINT: (2, 3), DISTORTION: tuple(range(4, 12))}
GROUPS = (FOCAL, PRINCIPAL_POINT, DISTORTION, RIG)
# What COLMAP's own adjuster refines unless it is told otherwise.
DEFAULT_GROUPS = (FOCAL, DISTORTION, RIG)


@dataclass(frozen=True, kw_only=True)
class ModelSolution(Solved):
    """A solved model."""

    model: Reconstruction  # as it was read
    colmap: ColmapModel | None  # the same as COLMAP has it; None for g2o
    cameras: Cameras  # at the end
    unknowns: tuple[Unknown, ...]  # of the cameras

    def refined(self) -> Reconstruction:
        """Return the solution, in the coordinates of the model."""
        return self.model.with_state(moved(self.result.state, self.origin), self.cameras)

    def write(self, path: Path) -> None:
        """Write the model with the solution in its own format; of COLMAP binary, ids and all else are those read.

        What is behind its camera, at the start, so that it took no part, or at the end, is no observation there any
        more, as in COLMAP: no other program could do anything with it.
        """
        if self.colmap is None:
            write_g2o(path, self.refined())
            return
        left_out = np.zeros(len(self.colmap.views), dtype=bool)
        if self.options.cheirality == "drop":
            behind = [np.isnan(reprojection_errors(*end)[:, 0]) for end in self._ends()]
            left_out[np.argsort(self.model.point, kind="stable")] = np.logical_or(*behind)
        self.colmap.take(self.refined(), left_out)
        write_colmap(path, self.colmap.world)

    def attention(self) -> tuple[list[str], bool]:
        """Return what a user has to know, one sentence each, and whether the result has to be looked at for it."""
        before, after = (int(np.isnan(reprojection_errors(*end)[:, 0]).sum()) for end in self._ends())
        dropped = self.options.cheirality == "drop"
        meaning = f"those at the start {'are left out' if dropped else 'count'}"
        return self.told((before, after), len(self.problem.observations), meaning)

    def as_dict(self) -> dict[str, Any]:
        """Return statistics, options and trace for JSON."""
        ids = range(len(self.model.lens)) if self.colmap is None else self.colmap.camera_ids
        problem = self.problem
        sizes = problem.n_keyframes, problem.n_points, len(problem.observations)
        with np.errstate(all="ignore"):  # infinite where the solve failed
            before, after = (rms_px(squared_errors(*end)) for end in self._ends())
        return self.statistics(sizes, (before, after), self.attention()[0]) | {
            "camera_unknowns": len(self.unknowns),
            "camera_models": dict(zip(map(str, ids), self.model.lens, strict=True)),
        }

    def _ends(self) -> list[tuple[Problem, State]]:
        end = replace(self.problem, cameras=self.cameras)
        return [(self.problem, self.problem.start), (end, self.result.state)]


def solve_model(
    path: Path,
    options: SolverOptions,
    groups: Collection[str],
    *,
    clock: Callable[[], float],
    on_iteration: Callable[[Iteration], bool] | None = None,
) -> ModelSolution:
    """Read and solve a model; see :func:`ba_node.core.solver.solve` for the arguments.

    ``groups`` of the cameras' numbers, some of GROUPS, are refined along.

    Raises:
        ModelError: the model cannot be read.
        ProblemError: it holds no well-formed problem.
        ConfigError: cameras cannot be refined with these options.
    """
    began = clock()
    colmap = read_colmap(path) if path.is_dir() else None
    model = read_g2o(path) if colmap is None else colmap.model
    if isinstance(model, Poses):
        raise ModelError(f"{path}: a pose graph, without points and observations: there is nothing to adjust")
    problem = model.problem()
    origin = middle_if_far(problem.start.points)
    problem = replace(problem, start=moved(problem.start, -origin))
    unknowns = tuple(unknowns_of(model, groups))
    ready = clock()
    if unknowns:
        result, end = solve_cameras(problem, Shared(unknowns), options, clock=clock, on_iteration=on_iteration)
        cameras = end.cameras
    else:
        result, cameras = solve(problem, options, clock=clock, on_iteration=on_iteration), problem.cameras
    return ModelSolution(
        source=str(path),
        origin=origin,
        problem=problem,
        result=result,
        options=options,
        setup_s=ready - began,
        solve_s=clock() - ready,
        model=model,
        colmap=colmap,
        cameras=cameras,
        unknowns=unknowns,
    )


def unknowns_of(model: Reconstruction, groups: Collection[str]) -> list[Unknown]:
    """Return what of the cameras is free: those that see nothing, and the first of a rig, stay in place."""
    columns = {column for group in groups if group != RIG for column in _COLUMNS[group]}
    found: list[Unknown] = []
    for camera in np.unique(model.camera).tolist():
        found += [Unknown(camera, of) for of in LENSES[model.lens[camera]][1] if of[0] in columns]
        is_first = (model.cameras.rotation[camera] == np.eye(3)).all() and not model.cameras.translation[camera].any()
        if RIG in groups and not is_first:
            found += place_of(camera)
    return found


def moved(state: State, offset: FloatArray) -> State:
    """Return the same state in a world whose points lie ``offset`` further, (3,)."""
    return replace(state, translation=state.translation - state.rotation @ offset, points=state.points + offset)
