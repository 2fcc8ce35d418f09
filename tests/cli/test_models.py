# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba solve` and `ba convert` on models of other tools."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ba_node.cli import solve as solve_command
from ba_node.cli.main import main
from ba_node.estimate import Poses
from ba_node.io.bag_reader import BagReader
from ba_node.io.bal import read_bal
from ba_node.io.bundler import read_bundler
from ba_node.io.g2o import read_g2o
from ba_node.io.model import Reconstruction
from ba_node.io.ply import read_ply
from ba_node.io.reference import read_poses
from ba_node.offline import solve_model
from ba_node.offline.solver_settings import solver_options
from tests.models import LENSES, adjusted, make_model, objective, pycolmap, written


def solved(path: Path, out: Path, *options: str) -> dict[str, Any]:
    trace = out.with_suffix(".json")
    assert main(["solve", str(path), "--out", str(out), "--json", str(trace), *options]) == 0
    figures: dict[str, Any] = json.loads(trace.read_text())
    return figures


@pytest.mark.slow
@pytest.mark.parametrize("cameras_per_rig", [1, 2])
@pytest.mark.parametrize("lens", sorted(LENSES))
def test_a_model_is_solved_as_far_as_colmap_does(lens: str, cameras_per_rig: int, tmp_path: Path) -> None:
    world = make_model(lens, cameras_per_rig=cameras_per_rig)
    figures = solved(written(world, tmp_path / "model"), tmp_path / "refined")
    assert figures["objective_before"] == pytest.approx(objective(world), rel=1e-9)
    assert figures["objective_after"] <= adjusted(world) * (1.0 + 1e-6)
    again = pycolmap.Reconstruction(tmp_path / "refined")
    assert objective(again) == pytest.approx(figures["objective_after"], rel=1e-9)
    assert len(again.cameras) == 2, "cameras stay shared"


def test_cameras_are_refined_as_asked_for(tmp_path: Path) -> None:
    model = written(make_model("OPENCV"), tmp_path / "model", text=True)
    ends = {
        what: solved(model, tmp_path / "_".join(what), "--refine", *what)
        for what in (("none",), ("focal",), ("focal", "distortion"), ("focal", "distortion", "principal_point"))
    }
    counts = [end["camera_unknowns"] for end in ends.values()]
    assert counts == [0, 4, 12, 16]
    after = [end["objective_after"] for end in ends.values()]
    assert after == sorted(after, reverse=True) and after[0] > 1.05 * after[1] > 0.0
    held = pycolmap.Reconstruction(tmp_path / "none").cameras
    for number, camera in pycolmap.Reconstruction(model).cameras.items():
        np.testing.assert_allclose(held[number].params, camera.params, rtol=1e-12)
    assert solve_model.GROUPS == solve_command._GROUPS


def test_points_behind_a_camera_and_seen_twice_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = make_model("PINHOLE")
    image = world.images[min(world.images)]
    centre, forward = image.projection_center(), image.viewing_direction()
    world.points3D[1].xyz = centre - 2.0 * forward
    twice = image.get_observation_points2D()[3].point3D_id
    free = next(i for i, point in enumerate(image.points2D) if not point.has_point3D())
    image.point2D(free).xy = image.get_observation_points2D()[3].xy + 1.0
    world.add_observation(twice, pycolmap.TrackElement(image.image_id, free))
    model = written(world, tmp_path / "model")
    figures = solved(model, tmp_path / "refined")
    assert figures["problem"]["observations"] == 1001
    again = pycolmap.Reconstruction(tmp_path / "refined")
    assert 990 < again.compute_num_observations() < 1001
    assert objective(again) == pytest.approx(figures["objective_after"], rel=1e-9)
    assert figures["objective_after"] <= adjusted(world) * (1.0 + 1e-6)
    assert any("of points behind their camera at the start" in line for line in figures["attention"])
    capsys.readouterr()
    assert main(["convert", str(model), str(tmp_path / "scene.mcap")]) == 0
    assert "without 1 observations of points that an image saw already" in capsys.readouterr().out


def test_what_ends_behind_its_camera_is_not_written(tmp_path: Path) -> None:
    world = make_model("PINHOLE")
    model = written(world, tmp_path / "model")
    options = solver_options("auto", ["cheirality=drop", "trust_region=none", "max_iterations=2"])
    found = solve_model.solve_model(model, options, ("focal",), clock=lambda: 0.0)
    state = found.result.state
    camera = np.linalg.inv(np.vstack([np.column_stack([state.rotation[0], state.translation[0]]), [0, 0, 0, 1]]))
    points = state.points.copy()
    points[found.model.point[np.flatnonzero(found.model.frame == 0)[0]]] = (camera @ [0.0, 0.0, -2.0, 1.0])[:3]
    result = dataclasses.replace(found.result, state=dataclasses.replace(state, points=points))
    dataclasses.replace(found, result=result).write(tmp_path / "end")
    count = pycolmap.Reconstruction(tmp_path / "end").compute_num_observations()
    assert count < world.compute_num_observations()
    again = solve_model.solve_model(tmp_path / "end", options, (), clock=lambda: 0.0)
    assert again.attention() == ([], False)


def test_one_scene_in_every_format_has_one_objective(bal_file: Path, tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.out", "a.txt", "model", "text", "b.out", "b.bz2")]
    forms = ("bundler", "bal", "colmap", "colmap-text", "bundler", "bal")
    source = bal_file
    for path, form in zip(paths, forms, strict=True):
        assert main(["convert", str(source), str(path), "--to", form]) == 0
        source = path
    before, after = [], []
    for number, path in enumerate([bal_file, *paths]):
        name = tmp_path / f"solved_{number}"
        figures = solved(path, name.with_suffix(path.suffix) if path.suffix else name, "--method", "auto")
        before.append(figures["objective_before"])
        after.append(figures["objective_after"])
    np.testing.assert_allclose(before, before[0], rtol=1e-9)
    assert max(after) < 1e-6 * before[0]
    np.testing.assert_allclose(read_bal(paths[-1]).cameras, read_bal(bal_file).cameras, atol=1e-9)
    assert read_bundler(paths[0]).n_cameras == 4


@pytest.mark.slow
def test_a_recording_becomes_a_model_and_poses(bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(bag), str(tmp_path / "model")]) == 0
    world = pycolmap.Reconstruction(tmp_path / "model")
    assert (world.num_rigs(), world.num_reg_frames(), world.num_reg_images()) == (1, 8, 16)
    assert {(camera.width, camera.height) for camera in world.cameras.values()} == {(640, 480)}
    assert objective(world) / (2.0 * world.compute_num_observations()) < 1.0, "half a px^2 each coordinate, or so"
    assert main(["convert", str(tmp_path / "model"), str(tmp_path / "again.mcap")]) == 0
    assert main(["replay", str(tmp_path / "again.mcap"), "--out", str(tmp_path / "out"), "--no-report"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["keyframes_refined"] == 8
    assert report["rms_px"]["refined"] < 1.02 * report["rms_px"]["input"]
    capsys.readouterr()
    names = [tmp_path / name for name in ("p.tum", "p.kitti", "points.ply")]
    for name in names:
        assert main(["convert", str(bag), str(name)]) == 0
        assert capsys.readouterr().out.startswith(f"{name}: 8 keyframes, 2 cameras, ")
    assert main(["convert", str(names[0]), str(tmp_path / "p.g2o")]) == 0
    assert "stamps" not in capsys.readouterr().out
    assert main(["convert", str(names[1]), str(tmp_path / "again.tum")]) == 0
    assert "stamps are a second apart, as KITTI has none" in capsys.readouterr().out
    tum, kitti, graph = read_poses(names[0]), read_poses(names[1]), read_g2o(tmp_path / "p.g2o")
    assert isinstance(graph, Poses)
    assert len(tum) == len(kitti) == len(graph) == 8
    np.testing.assert_allclose(kitti.position, tum.position, atol=1e-12)
    np.testing.assert_array_equal(graph.position, tum.position)
    np.testing.assert_array_equal(graph.orientation, tum.orientation)


@pytest.mark.slow
def test_a_bundle_problem_of_g2o_is_solved_and_goes_both_ways(bag: Path, tmp_path: Path) -> None:
    model, graph = tmp_path / "model", tmp_path / "scene.g2o"
    for source, target in ((bag, model), (model, graph), (graph, tmp_path / "again.mcap"), (graph, tmp_path / "back")):
        assert main(["convert", str(source), str(target)]) == 0
    figures = solved(graph, tmp_path / "refined.g2o")
    theirs = solved(model, tmp_path / "refined", "--refine", "none")
    assert figures["objective_before"] == pytest.approx(theirs["objective_before"], rel=1e-9)
    # Two images of a rig are free of each other in g2o.
    assert figures["objective_after"] < theirs["objective_after"]
    again = solved(tmp_path / "refined.g2o", tmp_path / "end.g2o")
    assert again["objective_before"] == pytest.approx(figures["objective_after"], rel=1e-9)
    assert objective(pycolmap.Reconstruction(tmp_path / "back")) == pytest.approx(figures["objective_before"], rel=1e-9)
    assert main(["check", str(tmp_path / "again.mcap")]) == 0


def test_the_two_forms_of_g2o_are_the_same_problem(tmp_path: Path) -> None:
    """A camera at x = 2 that looks along z, and one at the origin; sigma is 2 px, so that the information is 0.25."""
    (tmp_path / "cam.g2o").write_text(
        "VERTEX_CAM 0 0 0 0 0 0 0 1 500 500 320 240 0\nVERTEX_CAM 1 2 0 0 0 0 0 1 500 500 320 240 0.1\nFIX 0\n"
        "VERTEX_TRACKXYZ 5 1 0.5 10\nEDGE_PROJECT_P2MC 5 0 371 265 0.25 0 0.25\n"
        "EDGE_PROJECT_P2MC 5 1 270 265 0.25 0 0.25\n"
    )
    (tmp_path / "expmap.g2o").write_text(
        "PARAMS_CAMERAPARAMETERS 7 500 320 240 0.1\nVERTEX_SE3:EXPMAP 0 0 0 0 0 0 0 1\n"
        "VERTEX_SE3:EXPMAP 1 2 0 0 0 0 0 1\nVERTEX_XYZ 5 1 0.5 10\n"
        "EDGE_PROJECT_XYZ2UV:EXPMAP 5 0 7 371 265 0.25 0 0.25\nEDGE_PROJECT_XYZ2UV:EXPMAP 5 1 7 270 265 0.25 0 0.25\n"
    )
    for name in ("cam", "expmap"):
        figures = solved(tmp_path / f"{name}.g2o", tmp_path / f"{name}_refined.g2o")
        assert figures["objective_before"] == pytest.approx(0.5 * 0.25 * 1.0), "one pixel off in one of two images"
        held = read_g2o(tmp_path / f"{name}_refined.g2o")
        assert isinstance(held, Reconstruction)
        assert held.lens == ("SIMPLE_PINHOLE",)
        np.testing.assert_array_equal(held.sigma, 2.0)


def test_points_become_guesses_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\nend_header\n"
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\n{text}1 2 3 40\n4 5 6 50\n")
    for name in ("points.mcap", "model", "b.ply"):
        assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / name)]) == 0
    assert "0 keyframes, 0 cameras, 2 points" in capsys.readouterr().out
    with BagReader(tmp_path / "points.mcap") as reader:
        (guesses,) = (reader.decode(topic, data) for topic, _, _, data in reader.messages())
    assert guesses.position.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    points = dict(sorted(pycolmap.Reconstruction(tmp_path / "model").points3D.items()))
    assert [point.color.tolist() for point in points.values()] == [[40, 255, 255], [50, 255, 255]]
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply")[0], [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("poses.tum", "model"), "poses alone are written as tum, kitti or g2o, not as colmap: there are no points"),
        (("empty.g2o", "a.tum"), "no VERTEX_SE3:QUAT in it"),
        (("bad.g2o", "a.tum"), "bad.g2o: a pose has a quaternion of zeros"),
        (("stereo.g2o", "a.tum"), "stereo.g2o:1: EDGE_PROJECT_P2SC: observations of two images in one are not read"),
        (("bad.ply", "a.mcap"), "bad.ply: no point cloud: expected a PLY header"),
        (("short.ply", "a.mcap"), "short.ply: cut off or damaged: 9 points are not in it"),
        (("none.txt", "a.tum"), "none.txt: cannot be opened"),
        (("empty", "a.tum"), "empty"),
    ],
)
def test_what_cannot_be_converted_is_one_line(
    arguments: tuple[str, str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "poses.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    (tmp_path / "empty.g2o").write_text("FIX 0\n")
    (tmp_path / "stereo.g2o").write_text("EDGE_PROJECT_P2SC 0 1 2 3 4 1 0 0 1 0 1\n")
    (tmp_path / "bad.ply").write_text("1 2 3\n")
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "short.ply").write_text(f"ply\nformat binary_little_endian 1.0\nelement vertex 9\n{axes}end_header\n0")
    (tmp_path / "bad.g2o").write_text("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 0\n")
    (tmp_path / "empty").mkdir()
    source, target = arguments
    assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and words in error, error
    assert not (tmp_path / target).exists()


def test_what_the_formats_do_not_have_is_refused(
    bal_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", str(bal_file), "--refine", "focal"]) == 2
    assert "BAL and Bundler have f, k1, k2 of each image free" in capsys.readouterr().err
    model = written(make_model("OPENCV"), tmp_path / "model")
    assert main(["convert", str(model), str(tmp_path / "a.txt")]) == 2
    assert "camera 0 (OPENCV): BAL and Bundler have cameras of f, k1 and k2 alone" in capsys.readouterr().err
    assert main(["solve", str(model), "--method", "local_dinm"]) == 2
    assert "trust_region = inc: cameras are refined with trust_region = none alone" in capsys.readouterr().err


def test_a_missing_library_is_named(
    bal_file: Path, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = written(make_model("PINHOLE"), tmp_path / "model")
    for name in ("pycolmap", "foxglove"):
        monkeypatch.setitem(sys.modules, name, None)
    for arguments, extra in (
        (["solve", str(model)], "colmap"),
        (["convert", str(model), str(tmp_path / "a.mcap")], "colmap"),
        (["convert", str(bal_file), str(tmp_path / "other")], "colmap"),
        (["view", str(bag)], "view"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert error.endswith(f"pip install ba_node[{extra}]\n") and error.count("\n") == 1, error
    assert main(["convert", str(bal_file), str(tmp_path / "a.out")]) == 0, "other formats need none of them"
