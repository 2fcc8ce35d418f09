# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The node under the command line of ROS 2, as a user types it; left out where ros2cli is not installed."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from ba_node.config import Config
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

NO_ROS2 = shutil.which("ros2") is None or importlib.util.find_spec("ros2cli") is None
pytestmark = [
    pytest.mark.dds,
    pytest.mark.slow,
    pytest.mark.skipif(NO_ROS2, reason="ros2cli is not installed (it is not among the wheels)"),
]

NODE = "/ba_node"
KEYFRAMES = 6
TIMEOUT_S = 60.0
# Each command looks for itself: a daemon would outlive the test.
LOOK = ("--no-daemon", "--spin-time", "2")


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=10.0, path="line", outlier_share=0.0))


def _ros2(*words: str, code: int | None = 0) -> str:
    """Run a command of ros2 and return what it prints; again where it did not find the node in its short look."""
    end = time.monotonic() + TIMEOUT_S
    while True:
        run = subprocess.run(["ros2", *words], capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
        told = run.stdout + run.stderr
        if "Node not found" not in told or time.monotonic() > end:
            assert code is None or run.returncode == code, f"ros2 {' '.join(words)}: {told}"
            return told


def _shows(wanted: str, *words: str) -> str:
    """Run a command that shows the graph until it shows what is wanted, and return what it prints."""
    end = time.monotonic() + TIMEOUT_S
    while wanted not in (told := _ros2(*words, code=None)):
        assert time.monotonic() < end, f"ros2 {' '.join(words)}: {told}"
    return told


@pytest.fixture
def played(start_node: Callable[..., Any], make_peer: Callable[..., Any], scene: SyntheticData, tmp_path: Path) -> Any:
    """Return a node that has refined a scene."""
    node, peer = start_node("--ros-args", "-p", f"node.map_folder:={tmp_path}"), make_peer()
    peer.advertise()
    peer.play(scene)
    return node


def test_parameters(played: Any, tmp_path: Path) -> None:
    assert "Integer value is: 20" in _ros2("param", "get", *LOOK, NODE, "window.max_keyframes")
    described = _ros2("param", "describe", *LOOK, NODE, "window.max_keyframes", "solver.loss", "node.inbox_size")
    for words in ("Min value: 2", "Max value: 100000", "one of: squared, huber", "Read only: true"):
        assert words in described
    for value in ("2", "2.5", "1e-3"):
        assert "successful" in _ros2("param", "set", *LOOK, NODE, "solver.loss_scale_px", value)
    assert "Double value is: 0.001" in _ros2("param", "get", *LOOK, NODE, "solver.loss_scale_px")
    for name, value, reason in (
        ("window.max_keyframe", "30", "did you mean 'window.max_keyframes'?"),
        ("window.max_keyframes", "1", "out of range"),
        ("solver.loss", "hubert", "choose one of squared, huber"),
        ("node.inbox_size", "50", "is read-only: start the node with"),
    ):
        assert reason in _ros2("param", "set", *LOOK, NODE, name, value, code=None)
    dump = tmp_path / "dump.yaml"
    dump.write_text(_ros2("param", "dump", *LOOK, NODE))
    values = yaml.safe_load(dump.read_text())[NODE]["ros__parameters"]
    assert set(values) >= {name.split(".")[0] for name in Config().values()}
    loaded = _ros2("param", "load", *LOOK, NODE, str(dump))
    lines = [line for line in loaded.splitlines() if line.startswith("Set parameter")]
    # The last is rclpy's own.
    refused = [line for line in lines if not line.endswith("successful") and "start_type_description" not in line]
    assert len(lines) >= len(Config().values()) and not refused, refused
    assert played.alive


def test_a_node_starts_with_its_own_dump(played: Any, start_node: Callable[..., Any], tmp_path: Path) -> None:
    _ros2("param", "set", *LOOK, NODE, "window.max_keyframes", "7")
    dump = tmp_path / "dump.yaml"
    dump.write_text(_ros2("param", "dump", *LOOK, NODE))
    assert played.stop() == 0
    again = start_node("--ros-args", "--params-file", str(dump))
    assert yaml.safe_load(_ros2("param", "dump", *LOOK, NODE)) == yaml.safe_load(dump.read_text())
    assert again.stop() == 0


def test_lifecycle(played: Any) -> None:
    _shows(NODE, "lifecycle", "nodes", *LOOK)
    assert "active [3]" in _ros2("lifecycle", "get", *LOOK, NODE)
    assert "deactivate [4]" in _ros2("lifecycle", "list", *LOOK, NODE)
    assert "Unknown transition requested" in _ros2("lifecycle", "set", *LOOK, NODE, "configure", code=None)
    for transition, state in (("deactivate", "inactive [2]"), ("cleanup", "unconfigured [1]")):
        assert "successful" in _ros2("lifecycle", "set", *LOOK, NODE, transition)
        assert state in _ros2("lifecycle", "get", *LOOK, NODE)
    assert played.stop() == 0


def test_services_and_action(played: Any, tmp_path: Path) -> None:
    path = tmp_path / "site.npz"
    saved = _ros2("service", "call", f"{NODE}/save_map", "ba_msgs/srv/SaveMap", f"{{path: {path}}}")
    assert "success=True" in saved and f"keyframes={KEYFRAMES}" in saved
    assert "success=True" in _ros2("service", "call", f"{NODE}/pause", "std_srvs/srv/SetBool", "{data: true}")
    goal = (f"{NODE}/optimize", "ba_msgs/action/Optimize", "{method: lma_cd, max_iterations: 5}")
    told = _ros2("action", "send_goal", "--feedback", *goal)
    assert "iteration: 1" in told and "Goal finished with status: SUCCEEDED" in told
    refused = _ros2("action", "send_goal", goal[0], goal[1], "{method: magic}", code=None)
    assert "rejected" in refused
    assert "forgot 6 keyframes" in _ros2("service", "call", f"{NODE}/reset", "std_srvs/srv/Trigger")
    assert "success=True" in _ros2("service", "call", f"{NODE}/load_map", "ba_msgs/srv/LoadMap", f"{{path: {path}}}")
    assert played.stop() == 0


def test_answers_that_warn_and_inform_in_turn(
    start_node: Callable[..., Any], make_peer: Callable[..., Any], scene: SyntheticData, tmp_path: Path
) -> None:
    """A goal while there is no data, a recording, the goal again; a save that fails, then a good one."""
    node, peer = start_node("--ros-args", "-p", f"node.map_folder:={tmp_path}"), make_peer()
    goal = ("action", "send_goal", f"{NODE}/optimize", "ba_msgs/action/Optimize", "{max_iterations: 5}")
    peer.advertise()
    peer.connect()
    assert "Goal finished with status: ABORTED" in _ros2(*goal, code=None)
    peer.play(scene)
    assert "Goal finished with status: SUCCEEDED" in _ros2(*goal)
    save = ("service", "call", f"{NODE}/save_map", "ba_msgs/srv/SaveMap")
    for path, success in (("none/site", False), ("site", True), ("../site", False), ("site", True)):
        assert f"success={success}" in _ros2(*save, f"{{path: {path}}}")
    assert "forgot 6 keyframes" in _ros2("service", "call", f"{NODE}/reset", "std_srvs/srv/Trigger")
    assert "Goal finished with status: ABORTED" in _ros2(*goal, code=None)
    assert node.stop() == 0
    assert "Traceback" not in node.err


def test_pause_and_jump_of_the_clock(played: Any, make_peer: Callable[..., Any], scene: SyntheticData) -> None:
    """After nine seconds without data, and with a clock that is set back by an hour, poses and transforms go on."""
    time.sleep(9.0)
    assert "level" in _ros2("topic", "echo", "--once", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    hour_ns, peer = 3600 * 10**9, make_peer()
    peer.advertise()
    keyframes = tuple(
        dataclasses.replace(k, keyframe_id=k.keyframe_id + 100, stamp_ns=k.stamp_ns - hour_ns) for k in scene.keyframes
    )
    tracks = tuple(
        tuple(dataclasses.replace(image, keyframe_id=image.keyframe_id + 100) for image in images)
        for images in scene.tracks
    )
    peer.listen("report")
    peer.connect()
    # The first alone might be a single wrong stamp: no solve is for it before the second comes.
    later = dataclasses.replace(scene, keyframes=keyframes, tracks=tracks)
    peer.publish_keyframes(later, 0, 1)
    peer.play_keyframes(later, *range(2, KEYFRAMES))
    seconds = keyframes[-1].stamp_ns // 10**9
    told = _shows("transforms:", "topic", "echo", "--once", "/tf", "tf2_msgs/msg/TFMessage")
    found = re.search(r"sec: (\d+)", told)
    assert found is not None and abs(int(found[1]) - seconds) < 300, told
    assert played.stop() == 0


def test_two_robots_in_two_namespaces(
    start_node: Callable[..., Any], make_peer: Callable[..., Any], scene: SyntheticData, tmp_path: Path
) -> None:
    nodes = {}
    for name, count in (("left", KEYFRAMES), ("right", 3)):
        nodes[name] = start_node("--ros-args", "-r", f"__ns:=/{name}", "-p", f"node.map_folder:={tmp_path}")
        peer = make_peer(namespace=name)
        peer.advertise()
        peer.play(dataclasses.replace(scene, keyframes=scene.keyframes[:count], tracks=scene.tracks[:count]))
    for name, count in (("left", KEYFRAMES), ("right", 3)):
        call = ("service", "call", f"/{name}/ba_node/save_map", "ba_msgs/srv/SaveMap", f"{{path: {name}}}")
        assert f"keyframes={count}" in _ros2(*call)
        assert (tmp_path / f"{name}.npz").is_file()
    assert [node.stop() for node in nodes.values()] == [0, 0]


def test_topics(played: Any) -> None:
    for topic in ("/keyframes [ba_msgs/msg/Keyframe]", "/ba_node/path [nav_msgs/msg/Path]"):
        _shows(topic, "topic", "list", "-t", *LOOK)
    info = _shows("Node name: ba_node", "topic", "info", "-v", *LOOK, "/ba_node/points")
    assert "Durability: TRANSIENT_LOCAL" in info
    # Latched, and taken with the quality of service of the publisher.
    path = _shows("poses:", "topic", "echo", "--once", *LOOK, "/ba_node/path")
    assert path.count("pose:") == KEYFRAMES
    assert "level" in _ros2("topic", "echo", "--once", "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    assert played.stop() == 0


@pytest.fixture
def launch(domain: int) -> Iterator[Callable[..., subprocess.Popen[str]]]:  # noqa: ARG001
    """Return a function that launches a file of the package."""
    if "ba_node" not in _ros2("pkg", "list", code=None).split():
        pytest.skip("ros2 does not find the package ba_node")
    started: list[subprocess.Popen[str]] = []

    def start(*words: str) -> subprocess.Popen[str]:
        # Whoever runs the tests in the background has SIGINT ignored, and launch would inherit that.
        command = ["env", "--default-signal=INT", "ros2", "launch", "ba_node", *words]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True))
        return started[-1]

    yield start
    for process in started:
        if process.poll() is None:
            process.terminate()  # launch passes it on
        process.communicate(timeout=TIMEOUT_S)


def test_launch_with_every_argument(
    launch: Callable[..., subprocess.Popen[str]], make_peer: Callable[..., Any], tmp_path: Path
) -> None:
    file = tmp_path / "my.yaml"
    file.write_text("/**:\n  ros__parameters:\n    window.max_keyframes: 9\n")
    arguments = ["namespace:=lane", f"params_file:={file}", "use_sim_time:=true", "autostart:=false", "log_level:=warn"]
    process = launch("ba_node.launch.py", *arguments)
    peer = make_peer(namespace="lane")
    peer.be_found()
    assert "unconfigured [1]" in _ros2("lifecycle", "get", *LOOK, "/lane/ba_node")
    assert "value is: 9" in _ros2("param", "get", *LOOK, "/lane/ba_node", "window.max_keyframes")
    assert "value is: True" in _ros2("param", "get", *LOOK, "/lane/ba_node", "use_sim_time")
    assert "successful" in _ros2("lifecycle", "set", *LOOK, "/lane/ba_node", "configure")
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=TIMEOUT_S)
    assert "process has finished cleanly" in out, out
    assert "configure: done" not in out, "that is below log_level"


def test_launch_plays_a_recording_to_its_end(launch: Callable[..., subprocess.Popen[str]]) -> None:
    out, _ = launch("replay.launch.py", "bag:=mono_loop.mcap", "rate:=10").communicate(timeout=4 * TIMEOUT_S)
    stopped = re.search(r"stopped: (\d+) keyframes refined", out)
    assert stopped is not None and int(stopped[1]) > 0, out
    assert out.count("process has finished cleanly") == 2, out
