# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the bundle adjuster of COLMAP (its analytic cost, Ceres inside), which chooses its linear solver by size.

It tells no callback about iterations: the trace is read from what Ceres prints, with seven digits.
"""

from __future__ import annotations

import argparse
import re

import numpy as np
import pycolmap

from experiments.benchmarks.peers.capture import captured
from experiments.benchmarks.peers.frames import bal_cameras, optical_poses, optical_uv
from experiments.benchmarks.problem_file import Case, write_state
from experiments.benchmarks.trace import Recorder, arguments

# Of a line of Ceres' table: iteration, cost, ..., seconds since it began.
_ROW = re.compile(rb"^\s*(\d+)\s+(\S+)\s.*\s(\S+)\s*$")


def _reconstruction(case: Case) -> pycolmap.Reconstruction:
    bal = case.bal
    rotation, translation = optical_poses(bal)
    uv = optical_uv(bal)
    world = pycolmap.Reconstruction()
    by_camera = np.argsort(bal.camera_index, kind="stable")
    bounds = np.searchsorted(bal.camera_index[by_camera], np.arange(len(bal.cameras) + 1))
    place = np.empty(len(uv), dtype=np.intp)
    for i in range(len(bal.cameras)):
        rows = by_camera[bounds[i] : bounds[i + 1]]
        place[rows] = np.arange(len(rows))
        f, k1, k2 = bal.cameras[i, 6:]
        camera = pycolmap.Camera(
            model="RADIAL", width=2000, height=2000, params=np.array([f, 0.0, 0.0, k1, k2]), camera_id=i + 1
        )
        world.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(i), keypoints=uv[rows], camera_id=i + 1, image_id=i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation[i]), translation[i])
        world.add_image_with_trivial_frame(image, pose)
    starts = np.searchsorted(bal.point_index, np.arange(len(bal.points) + 1))
    for j, point in enumerate(bal.points):
        track = pycolmap.Track()
        for row in range(starts[j], starts[j + 1]):
            track.add_element(int(bal.camera_index[row]) + 1, int(place[row]))
        world.add_point3D(point, track)
    return world


def _adjuster(case: Case, world: pycolmap.Reconstruction, args: argparse.Namespace) -> pycolmap.BundleAdjustmentOptions:
    free = case.size == 9
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = free
    options.print_summary = False
    ceres = options.ceres
    if args.loss == "huber":
        ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
        ceres.loss_function_scale = args.scale
    solver = ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance = args.iterations, args.tolerance
    solver.gradient_tolerance = solver.parameter_tolerance = 1e-16
    solver.num_threads = args.threads
    solver.minimizer_progress_to_stdout = True
    solver.logging_type = type(solver.logging_type).PER_MINIMIZER_ITERATION
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(case.bal.cameras)):
        config.add_image(i + 1)
        if i < case.n_fixed:
            config.set_constant_rig_from_world_pose(i + 1)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, world)


def main() -> None:
    """Solve."""
    args, case = arguments(__doc__ or "")
    recorder = Recorder()
    world = _reconstruction(case)
    adjuster = _adjuster(case, world, args)
    recorder.add(0.0)
    (setup, _) = recorder.trace.pop()
    with captured(1) as printed:
        summary = adjuster.solve()
    rows = [match for line in printed if (match := _ROW.match(line))]
    recorder.trace = [(setup + float(row[3]), float(row[2])) for row in rows]
    version = f"{pycolmap.__version__} (Ceres {pycolmap.__ceres_version__})"
    recorder.write(args.trace, version, str(summary.termination_type))
    poses = [world.images[i + 1].cam_from_world() for i in range(len(case.bal.cameras))]
    rotation = np.array([pose.rotation.matrix() for pose in poses])
    translation = np.array([pose.translation for pose in poses])
    intrinsics = np.array([world.cameras[i + 1].params[[0, 3, 4]] for i in range(len(poses))])
    points = np.array([world.points3D[j + 1].xyz for j in range(len(case.bal.points))])
    write_state(args.state, bal_cameras(rotation, translation, intrinsics), points)


if __name__ == "__main__":
    main()
