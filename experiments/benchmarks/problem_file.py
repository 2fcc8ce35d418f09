# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Hold a problem as every solver gets it: a BAL problem, how many poses are fixed, and whether intrinsics are free.

The file is binary and native-endian, so that reading takes neither time nor memory worth counting: six int64 (magic,
cameras, points, observations, fixed cameras, parameters a camera), then int32 camera index and point index of every
observation, then float64 image coordinates, cameras (9 each, as in BAL) and points. Observations are sorted by point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ba_node.core.problem import Problem, State
from ba_node.io.bal import BalProblem, to_problem

FloatArray = NDArray[np.float64]

MAGIC = 0x4241_4C31


@dataclass(frozen=True)
class Case:
    """A problem to solve."""

    bal: BalProblem  # start values and observations, sorted by point
    n_fixed: int  # the first so many cameras are held
    size: int  # free parameters a camera: 6 (pose) or 9 (pose, f, k1, k2)


def sorted_by_point(bal: BalProblem) -> BalProblem:
    """Return the problem with its observations sorted by point, stable."""
    order = np.argsort(bal.point_index, kind="stable")
    return replace(
        bal,
        camera_index=bal.camera_index[order],
        point_index=bal.point_index[order],
        observations=bal.observations[order],
    )


def write_case(path: Path, case: Case) -> None:
    """Write a case."""
    bal = case.bal
    head = (MAGIC, len(bal.cameras), len(bal.points), len(bal.observations), case.n_fixed, case.size)
    with path.open("wb") as stream:
        for array, kind in (
            (head, np.int64),
            (bal.camera_index, np.int32),
            (bal.point_index, np.int32),
            (bal.observations, np.float64),
            (bal.cameras, np.float64),
            (bal.points, np.float64),
        ):
            np.ascontiguousarray(array, dtype=kind).tofile(stream)


def read_case(path: Path) -> Case:
    """Read a case.

    Raises:
        ValueError: the file is no case.
    """
    with path.open("rb") as stream:
        head = np.fromfile(stream, np.int64, 6)
        if len(head) < 6 or head[0] != MAGIC:
            raise ValueError(f"{path}: not a problem of the benchmarks: remove it, and it is made again")
        _, n_cam, n_pt, n_obs, n_fixed, size = (int(value) for value in head)
        camera = np.fromfile(stream, np.int32, n_obs).astype(np.intp)
        point = np.fromfile(stream, np.int32, n_obs).astype(np.intp)
        uv = np.fromfile(stream, np.float64, 2 * n_obs).reshape(n_obs, 2)
        cameras = np.fromfile(stream, np.float64, 9 * n_cam).reshape(n_cam, 9)
        points = np.fromfile(stream, np.float64, 3 * n_pt).reshape(n_pt, 3)
    return Case(BalProblem(cameras, points, camera, point, uv), n_fixed, size)


def case_problem(case: Case) -> Problem:
    """Return the case in the terms of ba_node; fixed intrinsics become those of the cameras."""
    problem = to_problem(case.bal)
    problem.fixed[: case.n_fixed] = True
    if case.size == 9:
        return problem
    start, cameras, observations = problem.start, problem.cameras, problem.observations
    intrinsics = case.bal.cameras[:, 6:]
    own = intrinsics[:1]
    if not (intrinsics == own).all():
        own, camera_of = np.unique(intrinsics, axis=0, return_inverse=True)
        observations = replace(observations, camera=camera_of.reshape(-1)[observations.keyframe].astype(np.intp))
        cameras = replace(
            cameras,
            rotation=np.repeat(cameras.rotation, len(own), axis=0),
            translation=np.repeat(cameras.translation, len(own), axis=0),
            model=np.repeat(cameras.model, len(own)),
        )
    params = np.zeros((len(own), 12))
    params[:, 0] = params[:, 1] = own[:, 0]
    params[:, 4:6] = own[:, 1:]
    return replace(
        problem,
        start=State(start.rotation, start.translation, start.points, np.empty((0, 3))),
        cameras=replace(cameras, params=params),
        observations=observations,
    )


def write_state(path: Path, cameras: FloatArray, points: FloatArray) -> None:
    """Write a solution: float64 cameras (n, 9), as in BAL, then points (m, 3)."""
    with path.open("wb") as stream:
        np.ascontiguousarray(cameras, dtype=np.float64).tofile(stream)
        np.ascontiguousarray(points, dtype=np.float64).tofile(stream)


def read_state(path: Path, case: Case) -> Case:
    """Return the case with a solution as its start.

    Raises:
        ValueError: the file has another size.
    """
    values = np.fromfile(path, np.float64)
    n_cam, n_pt = len(case.bal.cameras), len(case.bal.points)
    if len(values) != 9 * n_cam + 3 * n_pt:
        raise ValueError(f"{path}: {len(values)} numbers, expected {9 * n_cam + 3 * n_pt}")
    cameras, points = values[: 9 * n_cam].reshape(n_cam, 9), values[9 * n_cam :].reshape(n_pt, 3)
    return replace(case, bal=replace(case.bal, cameras=cameras, points=points))
