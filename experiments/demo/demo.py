# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the node in one process, play a recording into it from another, and evaluate its output in this one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.estimate import Cloud, Poses
from ba_node.evaluation.metrics import AbsoluteError, absolute_error
from ba_node.io.bag_reader import BagReader
from ba_node.io.ply import write_ply
from ba_node.io.trajectory import write_tum
from ba_node.measurements import Keyframe
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.offline.pictures import draw_trajectory
from ba_node.offline.recording import read_truth
from ba_node.offline.run_folder import Comparison
from experiments.demo.domain import free_domain, isolation
from experiments.demo.listen import NodeListener

RATE = 2.0
NODE = "/ba_node"
NODE_MODULE = "ba_node.ros.main"
_START_S, _STOP_S, _POINTS_S = 20.0, 10.0, 3.0
# The answer to the last keyframe may take this much longer than the recording does.
_ANSWER_S = 60.0
_LOG_LINES = 15


class DemoError(ValueError):
    """A demo that did not come to its end."""


@dataclass(frozen=True)
class Outcome:
    """What came of a demo."""

    before: Poses  # front-end's poses
    after: Poses  # refined poses
    truth: Poses  # true poses
    cloud: Cloud  # the map
    reports: list[Any]  # ``ba_msgs/SolverReport`` of every solve
    frame_id: str  # name of the frame of the refined poses and the map
    duration_s: float  # from the start of the node to its end


def run(bag: Path, out: Path, say: Callable[[str], None]) -> Outcome:
    """Play a recording into a node of its own and collect the answers; logs of both go to ``out``.

    Raises:
        BagError: the recording cannot be read.
        DemoError: it has no ground truth, or the node or the player fails or does not answer in time.
    """
    inputs, truth, length_s = _read(bag)
    out.mkdir(parents=True, exist_ok=True)
    domain = free_domain()
    environment = isolation(domain)
    os.environ.update(environment)
    began = time.monotonic()
    with NodeListener(NODE, domain) as listener:
        with _Process([NODE_MODULE], out / "node.log", interrupt=True) as node:
            say(f"node started (process {node.pid}, ROS_DOMAIN_ID {domain})")
            _await(listener, lambda: listener.connected, _START_S, (node,), "the node to advertise its topics")
            play = ["ba_node.cli.main", "play", str(bag), "--rate", str(RATE)]
            with _Process(play, out / "play.log", interrupt=False) as player:
                about = f"{len(inputs)} keyframes, {length_s:.0f} s at rate {RATE:g}"
                say(f"playing {bag.name} (process {player.pid}): {about}")
                last = inputs[-1]
                timeout_s = length_s / RATE + _ANSWER_S
                what = f"the refined keyframe {last.keyframe_id}"
                _await(listener, lambda: last.keyframe_id in listener.keyframe_ids, timeout_s, (node, player), what)
            newest_ns = max(keyframe.stamp_ns for keyframe in inputs)
            listener.spin_until(lambda: _has_last_solve(listener, newest_ns), _POINTS_S)
            if not listener.reports:
                raise DemoError(f"the node sent no report; {node.last_words()}")
        after = listener.poses()
        cloud, frame_id = _cloud(listener), listener.points_frame
    return Outcome(Poses.of(inputs), after, truth, cloud, listener.reports, frame_id, time.monotonic() - began)


def write(outcome: Outcome, out: Path) -> dict[str, AbsoluteError]:
    """Write trajectories, cloud and picture; return the errors before and after.

    Raises:
        EvaluationError: the trajectories cannot be compared.
    """
    write_tum(out / "trajectory.tum", outcome.after)
    write_tum(out / "trajectory_input.tum", outcome.before)
    write_tum(out / "ground_truth.tum", outcome.truth)
    write_ply(out / "points.ply", outcome.cloud, outcome.frame_id)
    comparison = Comparison("demo", outcome.before, outcome.after, outcome.truth, outcome.cloud.position, "se3")
    draw_trajectory(out / "trajectory.png", comparison)
    return {
        "before": absolute_error(outcome.before, outcome.truth),
        "after": absolute_error(outcome.after, outcome.truth),
    }


def _read(bag: Path) -> tuple[list[Keyframe], Poses, float]:
    """Return the keyframes, the truth, and the length of a recording, s."""
    with BagReader(bag) as reader:
        keyframes = [measurement for _, _, measurement in reader.measurements() if isinstance(measurement, Keyframe)]
        truth = read_truth(reader)
    if truth is None or not keyframes:
        raise DemoError(
            f"{bag}: no keyframes with ground_truth/pose: take another recording, or make one with ba synth"
        )
    stamps = [keyframe.stamp_ns for keyframe in keyframes]
    return keyframes, truth, (max(stamps) - min(stamps)) * 1e-9


def stop_processes() -> None:
    """End the processes of a demo that is itself about to end."""
    for process in _running.copy():
        process.stop()


_running: list[_Process] = []


class _Process:
    """A Python module that runs with a log of its output. Use it as a context manager: it is over when the block is.

    It ends by itself, unless ``interrupt`` asks for a SIGINT, as of Ctrl-C.
    """

    def __init__(self, module: list[str], log: Path, *, interrupt: bool) -> None:
        self._command = [sys.executable, "-m", *module]
        self._log = log
        self._interrupt = interrupt

    def __enter__(self) -> _Process:
        # Made anew: nothing is written through a link that stands there.
        self._log.unlink(missing_ok=True)
        with self._log.open("xb") as stream:
            # A session of its own: Ctrl-C in the terminal reaches this process alone, which then ends the others.
            self._process = subprocess.Popen(
                self._command, stdout=stream, stderr=subprocess.STDOUT, start_new_session=True
            )
        self.pid = self._process.pid
        _running.append(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.stop(interrupt=self._interrupt or kind is not None)
        if kind is None:
            self.check()

    def stop(self, *, interrupt: bool = True) -> None:
        """Wait for its end, after a SIGINT or without, and not for ever."""
        if self._process.poll() is None and interrupt:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        _running.remove(self)

    @property
    def failed(self) -> bool:
        """Return True once it ended with an error."""
        return self._process.poll() not in (None, 0)

    def check(self) -> None:
        """Raise DemoError if it ended with an error."""
        if self.failed:
            command = " ".join(self._command[1:])
            raise DemoError(f"{command} ended with code {self._process.returncode}: {self.last_words()}")

    def last_words(self) -> str:
        """Return the end of its log."""
        lines = self._log.read_text(errors="replace").splitlines()[-_LOG_LINES:]
        return f"{self._log}: {' | '.join(lines) or 'empty'}"


def _await(
    listener: NodeListener, done: Callable[[], bool], timeout_s: float, processes: tuple[_Process, ...], what: str
) -> None:
    in_time = listener.spin_until(lambda: done() or any(p.failed for p in processes), timeout_s)
    for process in processes:
        process.check()
    if not in_time:
        raise DemoError(f"waited {timeout_s:.0f} s for {what}; {'; '.join(p.last_words() for p in processes)}")


def _has_last_solve(listener: NodeListener, newest_ns: int) -> bool:
    """Return True if points and report of the last solve have come; they are sent after its keyframes."""
    reports = [stamp_ns_from_message(report.header.stamp) for report in listener.reports[-1:]]
    return listener.points_stamp_ns == newest_ns and reports == [newest_ns]


def _cloud(listener: NodeListener) -> Cloud:
    points = listener.points
    return Cloud(
        # The topic has no ids.
        track_id=np.arange(len(points), dtype=np.uint64),
        position=np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64),
        rms_px=points["rms_px"],
        views=points["views"].astype(np.int32),
    )
