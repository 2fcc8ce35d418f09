# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run GTSAM's Levenberg-Marquardt: one factor an observation, its own analytic derivatives."""

from __future__ import annotations

import gtsam
import numpy as np

from experiments.benchmarks.peers.frames import bal_cameras, optical_poses, optical_uv
from experiments.benchmarks.problem_file import Case, write_state
from experiments.benchmarks.trace import Recorder, arguments


def _pose(rotation: np.ndarray, translation: np.ndarray) -> gtsam.Pose3:
    """Return world from camera, which is what GTSAM keeps."""
    return gtsam.Pose3(gtsam.Rot3(rotation), translation).inverse()


def _build(case: Case, huber: float | None) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    bal = case.bal
    rotation, translation = optical_poses(bal)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    if huber is not None:
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber), noise)
    n = len(bal.cameras)
    calibrations = []
    for i in range(n):
        f, k1, k2 = bal.cameras[i, 6:]
        pose = _pose(rotation[i], translation[i])
        if case.size == 9:
            values.insert(i, gtsam.PinholeCameraCal3Bundler(pose, gtsam.Cal3Bundler(f, k1, k2, 0.0, 0.0)))
        else:
            values.insert(i, pose)
            calibrations.append(gtsam.Cal3DS2(f, f, 0.0, 0.0, 0.0, k1, k2))
        if i < case.n_fixed and case.size == 6:
            graph.add(gtsam.NonlinearEqualityPose3(i, pose))
    for j, point in enumerate(bal.points):
        values.insert(n + j, point)
    for camera, point, uv in zip(bal.camera_index.tolist(), bal.point_index.tolist(), optical_uv(bal), strict=True):
        if case.size == 9:
            graph.add(gtsam.GeneralSFMFactorCal3Bundler(uv, noise, camera, n + point))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3DS2(uv, noise, camera, n + point, calibrations[camera]))
    return graph, values


def _solution(case: Case, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
    n = len(case.bal.cameras)
    rotation, translation = np.empty((n, 3, 3)), np.empty((n, 3))
    intrinsics = case.bal.cameras[:, 6:].copy()
    for i in range(n):
        if case.size == 9:
            camera = values.atPinholeCameraCal3Bundler(i)
            pose, own = camera.pose().inverse(), camera.calibration()
            intrinsics[i] = own.fx(), own.k1(), own.k2()
        else:
            pose = values.atPose3(i).inverse()
        rotation[i], translation[i] = pose.rotation().matrix(), pose.translation()
    points = np.array([values.atPoint3(n + j) for j in range(len(case.bal.points))])
    return bal_cameras(rotation, translation, intrinsics), points


def main() -> None:
    """Solve."""
    args, case = arguments(__doc__ or "")
    recorder = Recorder()
    graph, values = _build(case, args.scale if args.loss == "huber" else None)
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setMaxIterations(args.iterations)
    params.setRelativeErrorTol(args.tolerance)
    params.setAbsoluteErrorTol(0.0)
    n = len(case.bal.cameras)
    ordering = gtsam.Ordering()
    for key in [*range(n, n + len(case.bal.points)), *range(n)]:
        ordering.push_back(key)
    params.setOrdering(ordering)
    params.iterationHook = lambda _iteration, _before, after: recorder.add(after)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    recorder.add(optimizer.error())
    result = optimizer.optimize()
    version = getattr(gtsam, "__version__", "")
    recorder.write(args.trace, version, f"{optimizer.iterations()} iterations")
    write_state(args.state, *_solution(case, result))


if __name__ == "__main__":
    main()
