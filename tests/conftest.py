# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Fixtures that several folders of tests use."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from ba_node.cli import main as command_line
from ba_node.estimate import Cloud, Estimate, Poses, SolveReport, Status
from ba_node.io.bag_reader import BagReader
from ba_node.io.trajectory import read_tum
from ba_node.measurements import (
    CameraRig,
    FeatureTracks,
    GlobalFix,
    GravityDirection,
    Keyframe,
    LandmarkGuesses,
    LandmarkPriors,
    Measurement,
    PosePrior,
    RelativePose,
    TrackMerge,
)
from ba_node.messages.report import LatencyReport, QueueReport, Report

_ROOT = Path(__file__).resolve().parent.parent

# Of a package that was installed elsewhere the experiments are those beside its tests.
command_line.ROOT = _ROOT

# The same examples in every run, and no verdict by the clock: a loaded machine is not a fault.
settings.register_profile("ba_node", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("ba_node")


# Folders whose tests take longest, which are begun first: so that all processes end at about the same time.
_LONG = ("cases", "check", "window", "offline", "backend", "cli", "front_end")
# By how much processes give way to the one that talks over DDS, which waits most of its time.
_GIVING_WAY = 5
# After how many seconds a slow test counts as hanging: on a slow, loaded machine one takes ten times what it should.
_SLOW_TIMEOUT_S = 1200
_begun = pytest.StashKey[bool]()


def _talks(item: pytest.Item) -> bool:
    return item.get_closest_marker("dds") is not None or _ROOT / "tests" / "ros" in item.path.parents


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Group tests for pytest-xdist: a process runs all that talk over DDS, and each other file as a whole.

    Two nodes that start at the same time are slow to find each other; what the tests of a file share is made once.
    Slow tests get more time than the ``timeout`` of pyproject.toml.
    """
    for item in items:
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.timeout(_SLOW_TIMEOUT_S))
    if not config.pluginmanager.hasplugin("xdist"):
        return

    def rank(item: pytest.Item) -> int:
        folder = item.path.relative_to(_ROOT / "tests").parts[0]
        return -1 if _talks(item) else _LONG.index(folder) if folder in _LONG else len(_LONG)

    items.sort(key=rank)
    for item in items:
        item.add_marker(pytest.mark.xdist_group("dds" if _talks(item) else str(item.path)))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let a process that does not begin with DDS give way to the one that does."""
    if hasattr(item.config, "workerinput") and not item.config.stash.setdefault(_begun, False):
        item.config.stash[_begun] = True
        os.nice(0 if _talks(item) else _GIVING_WAY)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of data sets that are not part of the repository, or skip the test."""
    folder = _ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the data sets in ../shared/data, which are not part of the repository")
    return folder


@dataclass(frozen=True)
class Case:
    """A small recording that once went wrong.

    Attributes:
        bag: the file.
    """

    bag: Path

    @property
    def measurements(self) -> list[Measurement]:
        """Return all that is in it, in the order of the recording."""
        with BagReader(self.bag) as reader:
            return [measurement for _, _, measurement in reader.measurements()]

    @property
    def truth(self) -> Poses:
        """Return the true poses, numbered from 0."""
        return read_tum(self.bag.with_suffix(".truth.tum"))


@pytest.fixture(scope="session")
def case() -> Callable[[str], Case]:
    """Return what gives a recording of ../shared/cases by its name, or skips the test."""

    def find(name: str) -> Case:
        path = _ROOT.parent / "shared" / "cases" / f"{name}.mcap"
        if not path.is_file():
            pytest.skip(f"needs {path.name} in ../shared/cases, which is not part of the repository")
        return Case(path)

    return find


@pytest.fixture
def keyframe() -> Keyframe:
    return Keyframe(
        session_id=3,
        keyframe_id=2**64 - 1,
        stamp_ns=1_700_000_000_123_456_789,
        frame_id="map",
        position=np.array([1.5, -2.25, 1e-300]),
        orientation=np.array([0.1, -0.2, 0.3, 0.9273618495495704]),
    )


@pytest.fixture
def tracks() -> FeatureTracks:
    return FeatureTracks(
        session_id=3,
        keyframe_id=2**64 - 1,
        camera_index=65535,
        track_id=np.array([0, 2**53 + 1, 2**64 - 1], dtype=np.uint64),
        uv=np.array([[0.5, -1.25], [640.0, 479.75], [np.nan, 3.0]]),
        sigma_px=np.array([0.5, 1.0, 2.0]),
        depth_m=np.array([np.nan, 4.5, np.inf]),
    )


@pytest.fixture
def guesses() -> LandmarkGuesses:
    return LandmarkGuesses(3, np.array([7, 2**63], dtype=np.uint64), np.array([[1.0, 2.0, 3.0], [0.1, -0.2, 1e30]]))


@pytest.fixture
def beside_pixels() -> list[Measurement]:
    """Return one of each that is known beside pixels."""
    pose = np.array([1.0, -2.0, 0.5]), np.array([0.0, 0.6, 0.0, 0.8])
    ids, others = np.array([7, 2**63], dtype=np.uint64), np.array([1, 2], dtype=np.uint64)
    covariance = np.arange(36.0) + 1e-3
    return [
        RelativePose(3, 5, 2**64 - 1, True, *pose, covariance),
        LandmarkPriors(3, "enu", ids, np.arange(6.0).reshape(2, 3), np.arange(18.0).reshape(2, 3, 3)),
        TrackMerge(3, ids, others),
        GravityDirection(3, 5, np.array([0.0, 0.1, -9.8]), 0.02),
        PosePrior(1_700_000_000_123_456_789, "enu", *pose, covariance),
        GlobalFix(1_700_000_000_123_456_789, "gps", np.array([48.1, 11.5, 520.0]), np.arange(9.0), True),
    ]


@pytest.fixture
def rig() -> CameraRig:
    return CameraRig(
        frame_id="base_link",
        names=("left_optical", "right_optical"),
        models=("plumb_bob", "equidistant"),
        intrinsics=np.array([[700.1, 701.2, 320.3, 240.4], [500.5, 501.6, 310.7, 230.8]]),
        distortion=(np.array([0.1, -0.2, 0.001, 0.002, 0.3]), np.array([0.01, 0.02, 0.03, 0.04])),
        image_size=np.array([[640, 480], [0, 0]]),
        position=np.array([[0.0, 0.0, 0.0], [0.12, -0.01, 0.02]]),
        orientation=np.array([[0.5, -0.5, 0.5, -0.5], [0.0, 0.0, 0.0, 1.0]]),
    )


def make_poses(n: int, seed: int) -> Poses:
    rng = np.random.default_rng(seed)
    orientation = rng.normal(size=(n, 4))
    orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    return Poses(
        keyframe_id=rng.integers(0, 2**64, size=n, dtype=np.uint64),
        stamp_ns=1_700_000_000_000_000_001 + 100_000_000 * np.arange(n, dtype=np.int64),
        position=rng.normal(size=(n, 3)),
        orientation=orientation,
    )


def make_cloud(n: int, seed: int) -> Cloud:
    rng = np.random.default_rng(seed)
    return Cloud(
        track_id=rng.integers(0, 2**64, size=n, dtype=np.uint64),
        position=rng.normal(scale=10.0, size=(n, 3)),
        rms_px=rng.random(n).astype(np.float32),
        views=rng.integers(2, 20, size=n, dtype=np.int32),
    )


@pytest.fixture
def report() -> SolveReport:
    """Return a report with a value of its own in every field, so that two that were swapped are told apart."""
    return SolveReport(
        session_id=3,
        solve_count=2**63 + 1,
        newest_keyframe_id=2**64 - 1,
        status=Status.MAX_ITERATIONS,
        reason="reached 12 iterations",
        method="local_dinm",
        warnings=("baseline of camera 1 reversed",),
        inlier_share=0.93,
        parallax_deg=4.5,
        held_out_px_before=2.25,
        held_out_px_after=0.625,
        weakest_m=0.031,
        weakest_rad=0.0021,
        held_keyframes=3,
        iterations=12,
        accepted_iterations=9,
        linear_iterations=345,
        objective_before=1234.5,
        objective_after=678.9,
        gradient_norm=1e-3,
        rms_px_before=1.02,
        rms_px_after=0.35,
        keyframes=20,
        fixed_keyframes=4,
        landmarks=1500,
        observations=15_000,
        outliers=17,
        factors=5021,
        outvoted_factors=5022,
        rejected={"unknown_camera": 2, "malformed": 5},
        solve_time_s=0.025,
        correction_m=0.25,
        correction_rad=0.0125,
        correction_held=True,
        adjustments=5011,
        merged_tracks=5019,
    )


@pytest.fixture
def whole_report(report: SolveReport) -> Report:
    """Return a report of all three parts, as ``report``."""
    queue = QueueReport(
        queue_wait_s=0.75,
        dropped=6,
        coalesced=8,
        received=61,
        solved=44,
        dropped_keyframes=11,
        rejected_keyframes=10,
        waiting=1,
        rejected={"unreadable": 4},
        warnings=("falling behind",),
    )
    latency = LatencyReport(
        latency_p50_s=0.015,
        latency_p95_s=0.031,
        latency_max_s=0.047,
        stamp_latency_p50_s=0.115,
        stamp_latency_p95_s=0.131,
        stamp_latency_max_s=0.147,
    )
    return Report(report, queue, latency)


@pytest.fixture
def estimate(report: SolveReport) -> Estimate:
    trajectory = make_poses(12, seed=1)
    return Estimate(
        stamp_ns=int(trajectory.stamp_ns[-1]),
        frame_id="map",
        refined=trajectory[-5:],
        trajectory=trajectory,
        cloud=make_cloud(100, seed=2),
        report=report,
    )
