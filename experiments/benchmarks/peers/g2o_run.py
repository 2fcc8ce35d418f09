# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run g2o's Levenberg-Marquardt on problems with fixed, undistorted cameras (the camera that its wheel has)."""

from __future__ import annotations

import importlib.metadata
import re

import g2opy as g2o
import numpy as np

from experiments.benchmarks.peers.capture import captured
from experiments.benchmarks.peers.frames import bal_cameras, optical_poses, optical_uv
from experiments.benchmarks.problem_file import Case, write_state
from experiments.benchmarks.trace import Recorder, arguments

# Of a line that it prints: chi-square after the iteration, seconds since the first began.
_ROW = re.compile(rb"chi2= *(\S+).*cumTime= *(\S+)")


def _build(case: Case, huber: float | None) -> g2o.SparseOptimizer:
    bal = case.bal
    if np.any(bal.cameras[:, 7:]):
        raise SystemExit("g2o: its camera has no distortion")
    optimizer = g2o.SparseOptimizer()
    optimizer.set_algorithm(g2o.OptimizationAlgorithmLevenberg(g2o.BlockSolverSE3(g2o.LinearSolverEigenSE3())))
    rotation, translation = optical_poses(bal)
    n = len(bal.cameras)
    vertices = []
    for i in range(n):
        vertex = g2o.VertexSE3Expmap()
        vertex.set_id(i)
        vertex.set_estimate(g2o.SE3Quat(rotation[i], translation[i]))
        vertex.set_fixed(i < case.n_fixed)
        optimizer.add_vertex(vertex)
        vertices.append(vertex)
    for j, point in enumerate(bal.points):
        vertex = g2o.VertexPointXYZ()
        vertex.set_id(n + j)
        vertex.set_marginalized(True)
        vertex.set_estimate(point)
        optimizer.add_vertex(vertex)
        vertices.append(vertex)
    for camera, point, uv in zip(bal.camera_index.tolist(), bal.point_index.tolist(), optical_uv(bal), strict=True):
        edge = g2o.EdgeSE3ProjectXYZ()
        edge.set_vertex(0, vertices[n + point])
        edge.set_vertex(1, vertices[camera])
        edge.set_measurement(uv)
        edge.set_information(np.identity(2))
        edge.fx = edge.fy = bal.cameras[camera, 6]
        edge.cx = edge.cy = 0.0
        if huber is not None:
            edge.set_robust_kernel(g2o.RobustKernelHuber(huber))
        optimizer.add_edge(edge)
    return optimizer


def main() -> None:
    """Solve."""
    args, case = arguments(__doc__ or "")
    recorder = Recorder()
    optimizer = _build(case, args.scale if args.loss == "huber" else None)
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    recorder.add(0.5 * optimizer.active_robust_chi2())
    optimizer.set_verbose(True)
    with captured(2) as printed:
        optimizer.optimize(args.iterations)
    setup, value = recorder.trace[0]
    # It has no relative tolerance: what comes after the others would have stopped is left out.
    for row in filter(None, map(_ROW.search, printed)):
        before, value = value, 0.5 * float(row[1])
        recorder.trace.append((setup + float(row[2]), value))
        if before - value <= args.tolerance * before:
            break
    recorder.write(
        args.trace,
        importlib.metadata.version("g2opy"),
        f"{len(recorder.trace) - 1} iterations counted",
        total_s=recorder.trace[-1][0],
    )
    n = len(case.bal.cameras)
    poses = [optimizer.vertex(i).estimate() for i in range(n)]
    rotation = np.array([pose.rotation().matrix() for pose in poses])
    translation = np.array([pose.translation() for pose in poses])
    points = np.array([optimizer.vertex(n + j).estimate() for j in range(len(case.bal.points))])
    write_state(args.state, bal_cameras(rotation, translation, case.bal.cameras[:, 6:]), points)


if __name__ == "__main__":
    main()
