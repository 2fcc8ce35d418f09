# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Real data: which files, how to know them again, and the stereo odometry of KITTI as a problem.

Nothing of them is part of the project: they are read from a folder that the user names.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ba_node.core.cameras import Model
from ba_node.core.problem import Cameras, Observations, Problem, State

LADYBUG, KITTI = "ladybug-49", "kitti"


class DataError(ValueError):
    """A data set that is not there."""


@dataclass(frozen=True)
class DataSet:
    """One data set."""

    files: tuple[str, ...]  # where it may be below the folder of data sets; the first one that is there is read
    sha256: str  # of the text as it is published, of the first file
    sizes: tuple[int, int, int]  # cameras, points, observations; of KITTI keyframes, points, stereo observations
    source: str  # where to get it
    needed: bool = False  # False if experiments go on without it

    def path(self, folder: Path) -> Path | None:
        """Return the file, None if it is not there."""
        return next((folder / name for name in self.files if (folder / name).is_file()), None)

    def find(self, folder: Path) -> Path:
        """Return the file.

        Raises:
            DataError: it is not there; the message says where to get it.
        """
        path = self.path(folder)
        if path is None:
            wanted = Path(self.files[0]).name
            raise DataError(
                f"{folder}: the file {wanted} is not there: take {self.source} and say with --data in which folder"
                " it is"
            )
        return path

    def left_out(self, name: str, folder: Path) -> str:
        """Return in words that experiments go on without it."""
        return f"{name}, as {folder} has no {Path(self.files[0]).name}; it comes with {self.source}"

    def check(self, path: Path, sizes: tuple[int, int, int]) -> None:
        """Raise DataError unless a file that was read has the sizes."""
        if sizes != self.sizes:
            raise DataError(
                f"{path}: {sizes[0]} cameras, {sizes[1]} points and {sizes[2]} observations: expected {self.sizes[0]},"
                f" {self.sizes[1]} and {self.sizes[2]}, the data set of the experiments"
            )


def _gtsam(name: str, sha256: str, sizes: tuple[int, int, int]) -> DataSet:
    file = f"{name}-pre.txt"
    source = f"{file} from examples/Data of https://github.com/borglab/gtsam"
    return DataSet((f"gtsam-dubrovnik-small/{file}", file), sha256, sizes, source)


DATA_SETS: dict[str, DataSet] = {
    LADYBUG: DataSet(
        (
            "ladybug-49-7776/problem-49-7776-pre.txt",
            *(f"problem-49-7776-pre.txt{suffix}" for suffix in ("", ".bz2", ".gz")),
        ),
        "96ca2845519d89d0727953d983427ab38a42c54991cd4d73e46a4221da3c61b4",
        (49, 7776, 31_843),
        "problem-49-7776-pre.txt.bz2 from the Ladybug data sets of https://grail.cs.washington.edu/projects/bal/",
        needed=True,
    ),
    "dubrovnik-1-1": _gtsam(
        "dubrovnik-1-1", "fea608ed1dc1143a94107195b612de3c0cbdd00f20be98f688673d8ce8194fe0", (1, 1, 1)
    ),
    "dubrovnik-3-7": _gtsam(
        "dubrovnik-3-7", "e16143478ff45b9e2dd151b2b153fa494455c2355a8381f68169ffa0f9be3fbc", (3, 7, 19)
    ),
    "dubrovnik-3-7-18": _gtsam(
        "dubrovnik-3-7-18", "921acc1df66c35dfd8f94f8534e69168ff639511bd47a548e4a1ba1fbde240e1", (3, 7, 18)
    ),
    KITTI: DataSet(
        ("kitti-stereo-vo/VO_stereo_factors_large.txt", "VO_stereo_factors_large.txt"),
        "cf8ef07229696d5132d6a861ae2bbddf833405f94650a69fd6dc3bd2a611199d",
        (26, 2634, 8189),
        "VO_calibration.txt, VO_camera_poses_large.txt and VO_stereo_factors_large.txt from examples/Data of"
        " https://github.com/borglab/gtsam",
    ),
}


def read_kitti(path: Path) -> Problem:
    """Return the stereo odometry: poses of the left camera, two cameras with known parameters, first pose held.

    Points begin where the first keyframe that sees them has them. Each stereo observation is one of each camera, with
    the v that both share.

    Args:
        path: of VO_stereo_factors_large.txt; the two other files lie beside it.
    """
    fx, fy, _, cx, cy, baseline = np.loadtxt(path.with_name("VO_calibration.txt"))
    poses = np.loadtxt(path.with_name("VO_camera_poses_large.txt"))
    rows = np.loadtxt(path)
    DATA_SETS[KITTI].check(path, (len(poses), len(np.unique(rows[:, 1])), len(rows)))
    world_from_camera = poses[:, 1:].reshape(-1, 4, 4)
    rotation = np.swapaxes(world_from_camera[:, :3, :3], 1, 2)
    translation = -(rotation @ world_from_camera[:, :3, 3:])[..., 0]
    rows = rows[np.argsort(rows[:, 1], kind="stable")]
    keyframe = np.searchsorted(poses[:, 0], rows[:, 0])
    _, first, point = np.unique(rows[:, 1], return_index=True, return_inverse=True)
    place = world_from_camera[keyframe[first]]
    points = (place[:, :3, :3] @ rows[first, 5:8, None])[..., 0] + place[:, :3, 3]
    n = 2 * len(rows)
    params = np.zeros((2, 12))
    params[:, :4] = fx, fy, cx, cy
    cameras = Cameras(
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        translation=np.array([[0.0, 0.0, 0.0], [-baseline, 0.0, 0.0]]),
        model=np.full(2, Model.RATIONAL, dtype=np.uint8),
        params=params,
    )
    observations = Observations(
        keyframe=np.repeat(keyframe, 2),
        camera=np.tile([0, 1], len(rows)),
        point=np.repeat(point.reshape(-1), 2),
        uv=rows[:, [2, 4, 3, 4]].reshape(n, 2),
        sigma_px=np.ones(n),
        depth_m=np.empty(0),
        depth_sigma_m=np.empty(0),
    )
    fixed = np.arange(len(poses)) == 0
    return Problem(State(rotation, translation, points, np.empty((0, 3))), fixed, cameras, observations)
