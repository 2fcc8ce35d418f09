# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba record` beside `ba play`, over a real middleware."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ba_node.io.bag_reader import BagReader
from ba_node.offline.recording import record
from experiments.synthetic import SyntheticOptions, generate

pytestmark = pytest.mark.dds
BA = [sys.executable, "-m", "ba_node.cli.main"]


def recorder(out: Path, *options: str) -> subprocess.Popen[str]:
    return subprocess.Popen([*BA, "record", "--out", str(out), *options], stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_what_is_played_is_recorded(tmp_path: Path, domain: int) -> None:  # noqa: ARG001
    bag, out = tmp_path / "scene.mcap", tmp_path / "again.mcap"
    data = generate(SyntheticOptions(seed=5, keyframes=6, length_m=10.0, path="line", tracks=50, guesses=True))
    record(bag, data.timeline(), data.truth)
    process = recorder(out, "--topics", "ground_truth/pose")
    played = subprocess.run(
        [*BA, "play", str(bag), "--wait", "60"],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "nobody listens" not in played.stderr
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 0, error
    with BagReader(bag) as before, BagReader(out) as after:
        assert set(after.topics) == set(before.topics)
        for topic in before.topics:
            sent, got = ([data for _, _, data in reader.raw([topic])] for reader in (before, after))
            assert got == sent, topic
        assert next(channel for channel, _, _ in after.raw(["/camera_rig"])).is_latched
        assert len(list(after.measurements())) == len(list(before.measurements()))


@pytest.mark.slow
def test_nothing_to_record_is_said(tmp_path: Path, domain: int) -> None:  # noqa: ARG001
    process = recorder(tmp_path / "none.mcap", "--duration", "1")
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "no message came: expected topics of ba_msgs/msg/Keyframe" in error.splitlines()[-1]
    assert not (tmp_path / "none.mcap").exists()
    (tmp_path / "mine.mcap").write_bytes(b"mine")
    process = recorder(tmp_path / "mine.mcap", "--duration", "1")
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "mine.mcap: File exists: what was recorded is not written over, give another name" in error
    assert (tmp_path / "mine.mcap").read_bytes() == b"mine"


@pytest.mark.slow
def test_what_a_back_end_publishes_is_left_out(tmp_path: Path, domain: int) -> None:  # noqa: ARG001
    given, kind = "/robot/ba_node/pose_with_covariance", "geometry_msgs/msg/PoseWithCovarianceStamped"
    program = f"""
import time, rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
rclpy.init()
back_end = rclpy.create_node("ba_node", namespace="/robot")
localizer = rclpy.create_node("localizer", namespace="/robot")
nodes = [(back_end, "{given}"), (localizer, "/robot/pose_prior"), (localizer, "/robot/localizer/pose_prior")]
publishers = [node.create_publisher(PoseWithCovarianceStamped, topic, 10) for node, topic in nodes]
print("ready", flush=True)
while True:
    for publisher in publishers:
        publisher.publish(PoseWithCovarianceStamped())
    time.sleep(0.05)
"""
    beside = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert beside.stdout is not None
    try:
        assert beside.stdout.readline() == "ready\n"
        for out, options in (("inputs.mcap", ()), ("named.mcap", ("--topics", given))):
            process = recorder(tmp_path / out, "--duration", "6", *options)
            _, error = process.communicate(timeout=60)
            assert process.returncode == 0, error
            with BagReader(tmp_path / out) as reader:
                taken = {topic for topic in reader.topics if reader.topics[topic] == kind}
            others = {"/robot/pose_prior", "/robot/localizer/pose_prior"}
            assert taken == (others | {given} if options else others)
    finally:
        beside.kill()
        beside.communicate()
