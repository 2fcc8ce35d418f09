# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay of whole recordings: run once, then looked at from many sides."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from ba_node.config import Config
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.bag_reader import BagReader
from ba_node.io.bal import read_bal
from ba_node.io.model import from_bal
from ba_node.io.trajectory import read_tum
from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages.outputs import POINT_DTYPE
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES
from ba_node.offline.convert import timeline
from ba_node.offline.recording import record
from ba_node.offline.replay import replay
from experiments.synthetic import SyntheticOptions, generate
from tests.ply import read_ply

BAGS = sorted((Path(__file__).resolve().parents[2] / "bags").glob("*.mcap"))
REPRODUCIBLE = ("trajectory.tum", "trajectory_input.tum", "points.ply", "refined.mcap", "effective.yaml", "details.npz")


@dataclasses.dataclass(frozen=True)
class Run:
    """A replayed recording: its path, the folder with the results, the report."""

    bag: Path
    out: Path
    report: dict[str, Any]


@pytest.fixture(scope="module", params=BAGS, ids=lambda path: path.stem)
def shipped(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Run:
    out = tmp_path_factory.mktemp(request.param.stem)
    return Run(request.param, out, replay(request.param, out, Config()))


def test_there_are_recordings() -> None:
    assert len(BAGS) >= 1
    assert sum(path.stat().st_size for path in BAGS) < 3_000_000


def test_error_is_below_a_quarter(shipped: Run) -> None:
    """By the numbers of the report, and by those of the written files."""
    error = shipped.report["trajectory_error_m"]
    assert error["refined"] < 0.25 * error["input"], error
    read = {name: read_tum(shipped.out / f"{name}.tum") for name in ("trajectory", "trajectory_input", "ground_truth")}
    kind = "se3"
    for name, expected in (("trajectory", error["refined"]), ("trajectory_input", error["input"])):
        assert _rmse(read[name], read["ground_truth"], kind) == pytest.approx(expected, rel=1e-9)


def _rmse(estimate: Any, truth: Any, kind: Any) -> float:
    return absolute_error(estimate, truth, kind).translation.rmse


def test_second_replay_gives_the_same_bytes(shipped: Run, tmp_path: Path) -> None:
    replay(shipped.bag, tmp_path, Config())
    for name in REPRODUCIBLE:
        assert (tmp_path / name).read_bytes() == (shipped.out / name).read_bytes(), name


@pytest.mark.slow
def test_every_keyframe_is_refined(shipped: Run) -> None:
    report = shipped.report
    trajectory = read_tum(shipped.out / "trajectory.tum")
    assert report["keyframes_refined"] == report["keyframes"] == len(trajectory)
    assert report["rejected"] == report["bag_rejected"] == {}
    assert np.isfinite(trajectory.position).all()
    assert np.diff(trajectory.stamp_ns).min() > 0
    assert read_tum(shipped.out / "trajectory_input.tum").stamp_ns.tolist() == trajectory.stamp_ns.tolist()


@pytest.mark.slow
def test_report_adds_up(shipped: Run) -> None:
    report = json.loads((shipped.out / "report.json").read_text())
    points, frame_id = read_ply(shipped.out / "points.ply")
    assert report == json.loads(json.dumps(shipped.report))
    assert report["landmarks"] == len(points)
    assert report["frame_id"] == frame_id
    assert report["solves"] == report["keyframes"] == sum(report["solves_by_status"].values())
    assert "FAILED" not in report["solves_by_status"]
    assert report["solver_time_s"] == 0.0, "no clock was given"
    # Gaussian noise of 0.5 px in two directions has the median length 0.589; fitted points take up some of it.
    assert 0.45 < report["median_px"]["refined"] < 0.62


@pytest.mark.slow
def test_refined_recording_is_what_a_node_publishes(shipped: Run) -> None:
    with BagReader(shipped.out / "refined.mcap") as reader:
        # The last two are there once priors or GNSS tell where the map lies in the world.
        named = {topic: kind for topic, kind in OUTPUT_TYPES.items() if topic not in ("map_in_world", "world_origin")}
        assert reader.topics == {f"/ba_node/{topic}": kind for topic, kind in named.items()}
        messages = [(topic, time, reader.decode(topic, data)) for topic, _, time, data in reader.messages()]
    reports = [message for topic, _, message in messages if topic.endswith("/report")]
    assert len(reports) == shipped.report["solves"]
    assert {(message.solve_time_s, message.queue_wait_s) for message in reports} == {(0.0, 0.0)}
    refined = [(time, message) for topic, time, message in messages if topic.endswith("/refined_keyframes")]
    assert all(time == message.stamp_ns.max() for time, message in refined)
    poses: dict[int, list[float]] = {}
    for _, message in refined:
        poses |= dict(zip(message.stamp_ns.tolist(), message.position.reshape(-1, 3).tolist(), strict=True))
    trajectory = read_tum(shipped.out / "trajectory.tum")
    np.testing.assert_array_equal([poses[stamp] for stamp in trajectory.stamp_ns.tolist()], trajectory.position)
    cloud = [message for topic, _, message in messages if topic.endswith("/points")][-1]
    points, _ = read_ply(shipped.out / "points.ply")
    assert bytes(cloud.data) == points.astype(POINT_DTYPE).tobytes()


@pytest.mark.slow
def test_effective_parameters_are_written(shipped: Run, tmp_path: Path) -> None:
    config = Config().with_values({"window.max_keyframes": 6, "solver.max_iterations": 2, "factors.adjust_m": 0.0})
    report = replay(shipped.bag, tmp_path, config)
    tree = yaml.safe_load((tmp_path / "effective.yaml").read_text())["/**"]["ros__parameters"]
    assert tree["window"]["max_keyframes"] == 6
    assert tree["tracks"]["outlier_px"] == Config().tracks.outlier_px
    assert report["iterations"] <= 2 * report["solves"]
    with BagReader(tmp_path / "refined.mcap") as reader:
        largest = max(
            reader.decode("/ba_node/report", data).keyframes for *_, data in reader.messages(["/ba_node/report"])
        )
    assert largest <= 6


def small(**options: Any) -> SyntheticOptions:
    fixed: dict[str, Any] = {"keyframes": 8, "landmarks": 600, "tracks": 60, "path": "line", "length_m": 10.0}
    return SyntheticOptions(**(fixed | options))


def session(number: int, **options: Any) -> Iterator[tuple[str, int, Measurement]]:
    """Yield a small recording as a session of its own, later than those with smaller numbers."""
    for topic, stamp_ns, measurement in generate(small(**options)).timeline():
        later = stamp_ns + number * 100_000_000_000
        if isinstance(measurement, Keyframe):
            yield topic, later, dataclasses.replace(measurement, session_id=number, stamp_ns=later)
        elif isinstance(measurement, (FeatureTracks, LandmarkGuesses)):
            yield topic, later, dataclasses.replace(measurement, session_id=number)
        else:
            yield topic, later, measurement


@pytest.mark.slow
def test_older_sessions_go_to_folders_of_their_own(tmp_path: Path) -> None:
    bag = tmp_path / "two.mcap"
    record(bag, [*session(3, seed=1), *session(7, seed=2, keyframes=6)])
    report = replay(bag, tmp_path / "out", Config())
    alone = tmp_path / "alone.mcap"
    record(alone, session(3, seed=1))
    replay(alone, tmp_path / "alone", Config())
    old = tmp_path / "out" / "session_3"
    assert report["session_id"] == 7
    assert report["keyframes"] == 6
    assert [(entry["session_id"], entry["keyframes"]) for entry in report["older_sessions"]] == [(3, 8)]
    assert report["older_sessions"][0]["rms_px"]["refined"] > 0.0
    for name in ("trajectory.tum", "trajectory_input.tum", "points.ply"):
        assert (old / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


def test_bad_messages_are_told_and_cost_nothing_else(tmp_path: Path) -> None:
    def spoilt() -> Iterator[tuple[str, int, Measurement]]:
        for topic, stamp_ns, measurement in generate(small()).timeline():
            yield topic, stamp_ns, measurement
            if isinstance(measurement, Keyframe):
                yield topic, stamp_ns, measurement
            if isinstance(measurement, FeatureTracks) and measurement.camera_index == 0:
                nan = dataclasses.replace(measurement, uv=np.full_like(measurement.uv, np.nan), camera_index=1)
                yield topic, stamp_ns, nan

    bag, clean = tmp_path / "spoilt.mcap", tmp_path / "clean.mcap"
    record(bag, spoilt())
    record(clean, generate(small()).timeline())
    report = replay(bag, tmp_path / "spoilt", Config())
    replay(clean, tmp_path / "clean", Config())
    assert report["rejected"]["duplicate_keyframe"] == 8
    assert report["rejected"]["non_finite"] > 8
    assert any("u = nan" in note for note in report["rejection_notes"])
    for name in ("trajectory.tum", "points.ply"):
        assert (tmp_path / "spoilt" / name).read_bytes() == (tmp_path / "clean" / name).read_bytes(), name


@pytest.mark.slow
def test_truncated_recording_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    bag = tmp_path / "cut.mcap"
    # Large enough for two chunks, of which the second is cut.
    record(bag, generate(small(keyframes=30, landmarks=6000, tracks=1500)).timeline())
    whole = bag.read_bytes()
    bag.write_bytes(whole[: 9 * len(whole) // 10])
    report = replay(bag, tmp_path / "out", Config())
    assert report["bag_rejected"], "the damage is counted"
    assert report["bag_notes"]
    assert 10 <= report["keyframes_refined"] == report["keyframes"] < 30


@pytest.mark.slow
def test_forgotten_keyframes_stay_in_the_trajectory(tmp_path: Path) -> None:
    bag = tmp_path / "long.mcap"
    record(bag, generate(small(keyframes=24, length_m=20.0)).timeline())
    config = Config().with_values({"scene.max_keyframes": 10, "window.max_keyframes": 5})
    report = replay(bag, tmp_path / "out", config)
    assert report["keyframes"] == report["keyframes_refined"] == 24
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")) == 24


@pytest.mark.slow
def test_kitti_stereo(shared_data: Path, tmp_path: Path) -> None:
    report = replay(shared_data / "kitti-stereo-vo" / "kitti_stereo.mcap", tmp_path, Config())
    assert report["keyframes_refined"] == report["keyframes"] == 26
    assert report["rms_px"]["input"] == pytest.approx(1.021, abs=5e-4)
    assert report["rms_px"]["refined"] <= 0.40


@pytest.mark.slow
def test_ladybug_as_a_recording(shared_data: Path, tmp_path: Path) -> None:
    bag = tmp_path / "ladybug.mcap"
    record(bag, timeline(from_bal(read_bal(shared_data / "ladybug-49-7776" / "problem-49-7776-pre.txt"))))
    with BagReader(bag) as reader:
        names = ("camera_rig", "keyframes", "feature_tracks", "landmark_guesses")
        assert set(reader.topics.values()) == {INPUT_TYPES[name] for name in names}
    report = replay(bag, tmp_path / "out", Config())
    trajectory = read_tum(tmp_path / "out" / "trajectory.tum")
    assert report["keyframes_refined"] == len(trajectory) == 49
    assert np.isfinite(trajectory.position).all()
    assert np.isfinite(trajectory.orientation).all()
    assert report["rms_px"]["input"] == pytest.approx(5.1715, rel=1e-3)
    # The rms of all is ruled by the few observations that are wrong; intrinsics are those of the file.
    assert report["median_px"]["refined"] < 0.4 * report["median_px"]["input"]


def test_a_recording_in_which_all_poses_come_first_is_refined_whole(tmp_path: Path) -> None:
    """As when topics were merged one after the other: more keyframes wait at once than a window holds."""
    bag = tmp_path / "sorted.mcap"
    rows = list(generate(small(keyframes=30, length_m=40.0, landmarks=2000)).timeline())
    first = min(stamp_ns for _, stamp_ns, _ in rows)
    ranks = {
        topic: rank for rank, topic in enumerate(("feature_tracks", "landmark_guesses", "keyframes", "camera_rig"))
    }
    order = sorted(rows, key=lambda row: -ranks[row[0]])
    record(bag, [(topic, first + place, measurement) for place, (topic, _, measurement) in enumerate(order)])
    report = replay(bag, tmp_path / "out", Config().with_values({"window.max_keyframes": 8}))
    assert report["keyframes_refined"] == report["keyframes"] == 30
