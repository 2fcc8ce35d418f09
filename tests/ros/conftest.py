# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the tests with ROS share: a domain of their own, the node as a process, and a node to talk to it."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RclpyParameter

from ba_node.measurements import FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.messages import conversion
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES, TOPICS
from ba_node.ros import qos
from ba_node.ros.convert import RclpyFactory, message_class
from ba_node.ros.tools.domain import free_domain, isolation
from ba_node.synthetic import SyntheticData

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 30.0
FACTORY = RclpyFactory()
_ASK_AGAIN_S = 0.5
_SLOW_SOLVE = """
import sys, time
from ba_node import backend

def solve(self, on_iteration):
    print("solving", flush=True)
    while on_iteration(None):
        time.sleep(0.01)

backend.Backend.solve = solve
backend.Backend.ready = property(lambda self: len(self.scene.keyframes) > 0)
from ba_node.ros.main import main
sys.exit(main())
"""


@pytest.fixture(scope="session")
def domain() -> Iterator[int]:
    """Keep these tests away from every other ROS program."""
    with pytest.MonkeyPatch.context() as patch:
        number = free_domain()
        for name, value in isolation(number).items():
            patch.setenv(name, value)
        yield number


class NodeProcess:
    """The node, as a process of its own."""

    def __init__(self, *arguments: str, python: str | None = None) -> None:
        code = ["-c", python] if python else ["-m", "ba_node.ros.main"]
        self.process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", *code, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), "RCUTILS_COLORIZED_OUTPUT": "0"},
        )
        self.out, self.err = "", ""
        self._readers = [threading.Thread(target=self._read, args=(name,)) for name in ("out", "err")]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str) -> None:
        stream = self.process.stdout if name == "out" else self.process.stderr
        assert stream is not None
        for line in stream:
            setattr(self, name, getattr(self, name) + line)
        stream.close()

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Return the exit code; if it does not come in time, fail with the stacks of all threads."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGABRT)
            self.process.wait()
            pytest.fail(f"the node did not end in {timeout_s} s:\n{self.out}\n{self.err}")
        for reader in self._readers:
            reader.join(timeout_s)
        return code

    def stop(self, number: int = signal.SIGINT, timeout_s: float = TIMEOUT_S) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait(timeout_s)

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def kill(self) -> None:
        if self.alive:
            self.process.kill()
        self.wait()


class Peer:
    """What stands in for the front-end and for whoever listens to the node."""

    def __init__(self, namespace: str = "") -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)
        self.node = Node("peer", namespace=namespace, context=self.context, start_parameter_services=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}

    def advertise(self, depth: int = 1000) -> None:
        """Make a publisher for each input but camera_info."""
        for topic, kind in INPUT_TYPES.items():
            if topic != "camera_info":
                profile = qos.profile(TOPICS[topic], depth)
                self.publishers[topic] = self.node.create_publisher(message_class(kind), topic, profile)

    def listen(self, *topics: str) -> None:
        """Subscribe to outputs of the node; all if none are named."""
        for topic in topics or OUTPUT_TYPES:
            take = self.received[topic].append
            cls = message_class(OUTPUT_TYPES[topic])
            self.node.create_subscription(cls, f"ba_node/{topic}", take, qos.profile(TOPICS[topic]))

    def connect(self) -> None:
        """Wait until the node hears every publisher and is heard by every subscription."""
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values()), "the node to subscribe")
        topics = [s.topic_name for s in self.node.subscriptions]
        self.until(lambda: all(self.node.count_publishers(topic) for topic in topics), "the node to publish")
        self.be_found()

    def be_found(self) -> None:
        """Wait until the node has found all subscriptions and clients that this peer has now.

        That this peer has found the node's side is not enough: what the node publishes or answers before it has found
        the subscription or client in its turn is lost. It finds them in the order in which they were made; so when the
        newest client has an answer, the others have been found too. Requests to that one are repeated until then.
        """
        client = self.node.create_client(GetState, "ba_node/get_state")
        try:
            self.until(client.service_is_ready, "the node")
            futures: list[Any] = []

            def answered() -> bool:
                if len(futures) < 1 + (time.monotonic() - began) / _ASK_AGAIN_S:
                    futures.append(client.call_async(GetState.Request()))
                return any(future.done() for future in futures)

            began = time.monotonic()
            self.until(answered, "the node to find this peer")
        finally:
            self.node.destroy_client(client)

    def publish(self, measurement: Measurement, stamp_ns: int = 0) -> None:
        """Send a measurement on its topic."""
        if isinstance(measurement, Keyframe):
            self.publishers["keyframes"].publish(conversion.keyframe_message(FACTORY, measurement))
        elif isinstance(measurement, FeatureTracks):
            message = conversion.tracks_message(FACTORY, measurement, stamp_ns, "camera")
            self.publishers["feature_tracks"].publish(message)
        elif isinstance(measurement, LandmarkGuesses):
            message = conversion.guesses_message(FACTORY, measurement, stamp_ns, "odom")
            self.publishers["landmark_guesses"].publish(message)
        else:
            self.publishers["camera_rig"].publish(conversion.rig_message(FACTORY, measurement, stamp_ns))

    def play(self, data: SyntheticData, session_id: int = 0) -> None:
        """Publish a recording, each keyframe when the one before was solved; listens to the reports for that."""
        if not any(s.topic_name.endswith("ba_node/report") for s in self.node.subscriptions):
            self.listen("report")
            self.connect()
        self.publish(data.rig)
        for keyframe, images in zip(data.keyframes, data.tracks, strict=True):
            self.publish(dataclasses.replace(keyframe, session_id=session_id))
            for image in images:
                self.publish(dataclasses.replace(image, session_id=session_id), keyframe.stamp_ns)
            self.await_report(session_id, keyframe.keyframe_id)

    def await_report(self, session_id: int, keyframe_id: int) -> None:
        """Wait until the last report is that of a keyframe."""
        reports, wanted = self.received["report"], (session_id, keyframe_id)

        def has_come() -> bool:
            return bool(reports) and (reports[-1].session_id, reports[-1].newest_keyframe_id) == wanted

        self.until(has_come, f"a report on keyframe {keyframe_id}")

    def all_acknowledged(self) -> bool:
        """Return True once the node has received everything that was sent."""
        return all(publisher.wait_for_all_acked() for publisher in self.publishers.values())

    def until(self, condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S) -> None:
        """Take messages until a condition holds."""
        end = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end, f"waited {timeout_s} s in vain for {what}"
            self.executor.spin_once(timeout_sec=0.05)

    def send(self, kind: Any, service: str, request: Any) -> Any:
        """Send a request to a service of the node and return the future of its response."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
            self.be_found()
        self.until(self._clients[service].service_is_ready, f"service {service}")
        return self._clients[service].call_async(request)

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service of the node and return the response."""
        future = self.send(kind, service, request)
        self.until(future.done, f"an answer of {service}")
        return future.result()

    def set(self, name: str, value: Any) -> Any:
        """Set a parameter of the node and return the result."""
        parameter = RclpyParameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[parameter])
        return self.call(SetParameters, "ba_node/set_parameters", request).results[0]

    def offers(self, service: str) -> bool:
        """Return True if the node has a service that was called before."""
        return service in self._clients and bool(self._clients[service].service_is_ready())

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def start_node(domain: int) -> Iterator[Callable[..., NodeProcess]]:  # noqa: ARG001
    """Return a function that starts a node with the given arguments."""
    started: list[NodeProcess] = []

    def start(*arguments: str, **options: Any) -> NodeProcess:
        started.append(NodeProcess(*arguments, **options))
        return started[-1]

    yield start
    for node in started:
        node.kill()


@pytest.fixture
def make_peer(domain: int) -> Iterator[Callable[..., Peer]]:  # noqa: ARG001
    """Return a function that makes a peer."""
    made: list[Peer] = []

    def make(**options: Any) -> Peer:
        made.append(Peer(**options))
        return made[-1]

    yield make
    for peer in made:
        peer.close()


@pytest.fixture
def slow_solve() -> str:
    """Return a program: the node with a solve that goes on until it is stopped, and says when it has begun."""
    return _SLOW_SOLVE


class Gates:
    """Holds the solvers of a node after each iteration, and files before they are written, at gates that are shut."""

    # Threads are known by their names: "solver" solves windows, "optimize" everything, "map file" writes.
    SCRIPT = """
import pathlib, sys, threading, time
from ba_node.core import solver
from ba_node.ros.components import services
from ba_node.ros.main import main

folder, solve, write_map = pathlib.Path({folder!r}), solver.solve, services.write_map

def wait():
    name = threading.current_thread().name
    while (folder / name).exists():
        (folder / (name + ".waits")).touch()
        time.sleep(0.005)

def gated(problem, options, *, on_iteration=None, **others):
    def watch(row):
        wait()
        return on_iteration is None or on_iteration(row)
    return solve(problem, options, on_iteration=watch, **others)

def gated_write(path, content):
    wait()
    write_map(path, content)

solver.solve, services.write_map = gated, gated_write
sys.exit(main(sys.argv))
"""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def script(self) -> str:
        return self.SCRIPT.format(folder=str(self.folder))

    def shut(self, thread: str) -> None:
        (self.folder / thread).touch()

    def open(self, thread: str) -> None:
        (self.folder / thread).unlink()
        (self.folder / f"{thread}.waits").unlink(missing_ok=True)

    def waits(self, thread: str) -> bool:
        """Return True if a solver stands at its gate."""
        return (self.folder / f"{thread}.waits").exists()


@pytest.fixture
def gates(tmp_path: Path) -> Gates:
    folder = tmp_path / "gates"
    folder.mkdir()
    return Gates(folder)
