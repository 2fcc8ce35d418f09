# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest

from ba_node.config import SolverOptions
from ba_node.core.objective import Objective
from ba_node.io.colmap import read_colmap, to_colmap, write_colmap
from ba_node.io.model import LENSES as KNOWN
from ba_node.io.model import ModelError, lens_of
from tests.models import LENSES, make_model, objective, pycolmap, written


def ours(path: Path) -> float:
    problem = read_colmap(path).model.problem()
    return Objective(problem, SolverOptions()).value(problem.start)


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_the_objective_is_that_of_colmap(lens: str, tmp_path: Path) -> None:
    assert set(LENSES) == set(KNOWN)
    world = make_model(lens)
    assert ours(written(world, tmp_path / "m")) == pytest.approx(objective(world), rel=1e-9)


@pytest.mark.parametrize("text", [False, True])
def test_a_rig_of_two_cameras_goes_there_and_back(tmp_path: Path, text: bool) -> None:
    world = make_model("OPENCV", cameras_per_rig=2)
    path = written(world, tmp_path / "m", text=text)
    model = read_colmap(path).model
    assert (len(model.rotation), len(model.lens), len(model.uv)) == (5, 2, 1000)
    assert ours(path) == pytest.approx(objective(world), rel=1e-9)
    made = to_colmap(model)
    write_colmap(tmp_path / "again", made, text=text)
    again = pycolmap.Reconstruction(tmp_path / "again")
    assert (again.num_rigs(), again.num_reg_frames(), again.num_reg_images()) == (1, 5, 10)
    assert objective(again) == pytest.approx(objective(world), rel=1e-9)


def test_half_a_pixel_lies_between_colmap_and_ours(tmp_path: Path) -> None:
    world = make_model("PINHOLE")
    model = read_colmap(written(world, tmp_path / "m")).model
    np.testing.assert_allclose(model.cameras.params[0, 2:4], [511.5, 383.5])
    first = world.images[min(world.images)].get_observation_points2D()[0].xy
    np.testing.assert_allclose(model.uv[0], first - 0.5)


def test_a_solution_is_put_into_the_model_that_was_read(tmp_path: Path) -> None:
    world = make_model("SIMPLE_RADIAL", cameras_per_rig=2)
    read = read_colmap(written(world, tmp_path / "m"))
    read.take(read.model, np.zeros(len(read.views), dtype=bool))
    assert objective(read.world) == pytest.approx(objective(world), rel=1e-9)
    assert {image.name for image in read.world.images.values()} == {image.name for image in world.images.values()}
    assert [camera.num_points2D() for camera in read.world.images.values()] == [
        camera.num_points2D() for camera in world.images.values()
    ], "features without a point stay"


@pytest.mark.parametrize("lens", sorted(KNOWN))
def test_the_simplest_lens_is_found(lens: str) -> None:
    family, columns = KNOWN[lens]
    params = np.zeros(12)
    for number, of in enumerate(columns):
        params[list(of)] = number + 1.0
    assert lens_of(family, params) == lens


@pytest.mark.parametrize("text", [False, True])
def test_what_cannot_be_written_leaves_the_older_model(text: bool, tmp_path: Path) -> None:
    world = make_model("PINHOLE")
    path = written(world, tmp_path / "m", text=text)
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    for camera in world.cameras.values():
        camera.params = np.array(camera.params) * 2.0
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
        with pytest.raises(ModelError, match="no room for temporary files"):
            write_colmap(path, world, text=text)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before
    rigs = path / ("rigs.txt" if text else "rigs.bin")
    rigs.unlink()
    rigs.mkdir()
    with pytest.raises(OSError, match=rigs.name):
        write_colmap(path, world, text=text)
    del before[rigs.name]
    assert {file.name: file.read_bytes() for file in path.iterdir() if file != rigs} == before


@pytest.mark.parametrize("part", ["cameras", "images", "points3D", "frames", "rigs"])
@pytest.mark.parametrize("damage", ["cut", "empty", "count"])
def test_damaged_models_are_named(part: str, damage: str, tmp_path: Path) -> None:
    path = written(make_model("PINHOLE"), tmp_path / "m")
    file = path / f"{part}.bin"
    data = file.read_bytes()
    file.write_bytes({"cut": data[: len(data) // 2], "empty": b"", "count": b"\xff" * 5 + b"\0" * 3 + data[8:]}[damage])
    with pytest.raises(ModelError, match=r"m(/\w+\.bin)?: (cannot be read|cut off or damaged)"):
        read_colmap(path)


def test_other_folders_and_cameras_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no model of COLMAP: expected cameras, images, points3D"):
        read_colmap(tmp_path)
    world = make_model("PINHOLE")
    for camera in world.cameras.values():
        camera.model = pycolmap.CameraModelId.FOV
        camera.params = [1280.0, 1280.0, 512.0, 384.0, 0.1]
    with pytest.raises(ModelError, match="camera 1: camera model FOV is not supported: expected one of SIMPLE_PINHOLE"):
        read_colmap(written(world, tmp_path / "fov"))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(ModelError, match="is there already and is no model of COLMAP"):
        write_colmap(tmp_path / "mine", world)
    assert [entry.name for entry in (tmp_path / "mine").iterdir()] == ["letter.txt"]
