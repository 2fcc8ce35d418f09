# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Front-ends of others: those of examples/, and ba_adapter, into the node over a real middleware."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ba_node.messages.factory import header_message, pose_message
from ba_node.ros import qos
from ba_node.ros.convert import RclpyFactory, message_class
from ba_node.ros.tools import adapter
from ba_node.synthetic import SyntheticData, SyntheticOptions, generate

pytestmark = pytest.mark.dds

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
STUBS = Path(__file__).resolve().parent / "stubs"
FACTORY = RclpyFactory()
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]


def test_the_python_example_feeds_the_node(start_node: StartNode) -> None:
    node = start_node()
    command = [sys.executable, str(EXAMPLES / "front_end.py")]
    run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert run.returncode == 0, run.stdout + run.stderr
    before, after = (float(value) for value in re.findall(r": ([0-9.]+) m from the truth", run.stdout))
    assert after < 0.8 * before, run.stdout
    assert "20 of 20 keyframes came back" in run.stdout
    assert node.stop() == 0


def test_the_cpp_example_compiles_against_the_messages(tmp_path: Path) -> None:
    """And runs, with a stand-in for rclcpp, which the wheels do not bring."""
    prefix = next((p for p in _prefixes() if (p / "include" / "ba_msgs" / "ba_msgs" / "msg").is_dir()), None)
    compiler = shutil.which(os.environ.get("CXX", "c++"))
    if prefix is None or compiler is None:
        pytest.skip("no C++ headers of ba_msgs, or no C++ compiler")
    source = str(EXAMPLES / "front_end.cpp")
    # Those that ba_msgs builds on may stand in another prefix, below which it was laid.
    found = [folder for one in _prefixes() for folder in (one / "include").glob("*") if folder.is_dir()]
    include = [f"-I{folder}" for folder in found]
    command = [compiler, "-std=c++17", "-Wall", "-Werror", source, "-o", "front_end", f"-I{STUBS}", *include]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    assert subprocess.run([tmp_path / "front_end"], check=False).returncode == 0


def test_the_cpp_example_builds_with_rclcpp(tmp_path: Path) -> None:
    header = next((p for p in _prefixes() if (p / "include" / "rclcpp").is_dir()), None)
    if header is None:
        pytest.skip("rclcpp is not installed here (the wheels bring rclpy alone)")
    shutil.copy(EXAMPLES / "front_end.cpp", tmp_path)
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(front_end CXX)\nfind_package(rclcpp REQUIRED)\n"
        "find_package(ba_msgs REQUIRED)\nadd_executable(front_end front_end.cpp)\n"
        "target_link_libraries(front_end rclcpp::rclcpp ${ba_msgs_TARGETS})\n"
    )
    for command in (["cmake", "-S", ".", "-B", "b"], ["cmake", "--build", "b"]):
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr


def _prefixes() -> list[Path]:
    return [Path(sys.prefix), *(Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(":") if p)]


def _cloud(stamp_ns: int, *columns: Any, names: tuple[str, ...] = ("", "", "", "")) -> Any:
    channels = [
        message_class("sensor_msgs/msg/ChannelFloat32")(name=name, values=FACTORY.array(np.asarray(c, np.float32)))
        for name, c in zip(names, columns, strict=True)
    ]
    header = header_message(FACTORY, stamp_ns, "world")
    return message_class("sensor_msgs/msg/PointCloud")(header=header, channels=channels)


def _odometry(keyframe: Any) -> Any:
    message = message_class("nav_msgs/msg/Odometry")(header=header_message(FACTORY, keyframe.stamp_ns, "odom"))
    message.pose.pose = pose_message(FACTORY, keyframe.position, keyframe.orientation)
    return message


def _send_as_vins(features: Any, odometry: Any, scene: SyntheticData) -> None:
    """Publish features of all cameras in one cloud, also for an image that is no keyframe, and then the pose."""
    for keyframe, tracks in zip(scene.keyframes, scene.tracks, strict=True):
        ids = np.concatenate([image.track_id.astype(float) for image in tracks])
        cameras = np.concatenate([np.full(len(image.track_id), image.camera_index) for image in tracks])
        uv = np.concatenate([image.uv for image in tracks])
        for stamp_ns in (keyframe.stamp_ns, keyframe.stamp_ns + 10):
            features.publish(_cloud(stamp_ns, ids, cameras, uv[:, 0], uv[:, 1]))
        odometry.publish(_odometry(keyframe))


def test_feature_clouds_and_odometry_reach_the_node(start_node: StartNode, make_peer: MakePeer) -> None:
    size: dict[str, Any] = {"keyframes": 8, "length_m": 10.0, "landmarks": 4000, "tracks": 200}
    scene = generate(SyntheticOptions(seed=3, path="line", outlier_share=0.0, **size))
    node, converter, peer = start_node(), start_node(program="ba_node.ros.tools.adapter:main"), make_peer()
    peer.listen("report", "refined_keyframes")
    profile = qos.reliable(100)
    features = peer.node.create_publisher(message_class("sensor_msgs/msg/PointCloud"), "features", profile)
    odometry = peer.node.create_publisher(message_class("nav_msgs/msg/Odometry"), "odometry", profile)
    rig = peer.node.create_publisher(message_class("ba_msgs/msg/CameraRig"), "camera_rig", qos.latched())
    peer.publishers = {"features": features, "odometry": odometry, "camera_rig": rig}
    peer.connect()
    peer.publish(scene.rig)
    wanted = {keyframe.stamp_ns for keyframe in scene.keyframes}
    for _ in range(5):  # what is sent before the converter and the node have found each other is lost
        _send_as_vins(features, odometry, scene)
        with contextlib.suppress(AssertionError):
            peer.until(lambda: peer.refined_ids() >= wanted and peer.received["report"][-1].landmarks > 100, "all", 6.0)
            break
    assert peer.refined_ids() == wanted
    last = peer.received["refined_keyframes"][-1]
    truth = dict(zip([k.stamp_ns for k in scene.keyframes], scene.truth.position, strict=True))
    position = np.asarray(last.position).reshape(-1, 3)
    error = np.linalg.norm(position - [truth[int(key)] for key in last.keyframe_id], axis=1).max()
    drift = np.linalg.norm(scene.odometry.position - scene.truth.position, axis=1).max()
    assert error < drift / 2, f"{error:.3f} m from the truth, {drift:.3f} m before"
    assert converter.stop() == 0, converter.err
    assert re.fullmatch(r"stopped: \d+ keyframes sent on, dropped: nothing\n", converter.out), converter.out
    assert node.stop() == 0


def test_channels_are_found_by_name_and_bad_rows_are_counted() -> None:
    counted: Counter[str] = Counter()
    names = ("v", "u", "camera", "id")
    cloud = _cloud(7, [4, 4, 4, 4], [3, 3, 3, 3], [0, 1, 0, 0.5], [1, 2, 2.0**24, 5], names=names)
    first, second = adapter.tracks_from_cloud(cloud, 2, counted)
    assert (first.session_id, first.keyframe_id, first.camera_index, first.track_id.tolist()) == (2, 7, 0, [1])
    assert (second.camera_index, second.track_id.tolist(), second.uv.tolist()) == (1, [2], [[3.0, 4.0]])
    assert counted == {"inexact_id": 2}


@pytest.mark.parametrize("columns", [([1], [0], [2]), ([1, 2], [0], [2], [3]), ()])
def test_channels_that_do_not_fit_are_named(columns: Any) -> None:
    cloud = _cloud(7, *columns, names=("",) * len(columns))
    with pytest.raises(adapter.FeatureError, match="expected id, camera, u, v"):
        adapter.tracks_from_cloud(cloud, 0, Counter())


def test_what_waits_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adapter, "MAX_WAITING", 3)
    waiting: dict[int, Any] = {}
    assert [adapter.keep(waiting, stamp, SimpleNamespace()) for stamp in range(5)] == [0, 0, 0, 1, 1]
    assert list(waiting) == [2, 3, 4]
