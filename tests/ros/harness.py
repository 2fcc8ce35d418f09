# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What the tests with ROS work with: the node as a process, and a node to talk to it."""

from __future__ import annotations

import array
import atexit
import dataclasses
import functools
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RclpyParameter

from ba_node.measurements import Measurement
from ba_node.messages import conversion
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES, TOPICS, WHOLE_MAP
from ba_node.ros import qos
from ba_node.ros.message_factory import RclpyFactory, message_class
from experiments.synthetic import SyntheticData
from tests.ros.zygote import name_of

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 30.0
FACTORY = RclpyFactory()
_ASK_AGAIN_S = 0.5


class Zygote:
    """Starts programs by forking, see ``zygote.py``."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-m", "tests.ros.zygote", str(theirs.fileno())]
        self._process = subprocess.Popen(command, cwd=ROOT, pass_fds=[theirs.fileno()])
        theirs.close()

    def start(self, request: dict[str, Any], out: int, err: int) -> tuple[int, socket.socket]:
        """Start a program; return its process and where its exit code will come."""
        answer, theirs = socket.socketpair()
        socket.send_fds(self._socket, [json.dumps(request).encode()], [out, err, theirs.fileno()])
        theirs.close()
        return array.array("i", answer.recv(4))[0], answer

    def close(self) -> None:
        self._socket.close()
        self._process.wait(TIMEOUT_S)


@functools.cache
def zygote() -> Zygote:
    """Return the one of this session."""
    made = Zygote()
    atexit.register(made.close)
    return made


class NodeProcess:
    """The node, or another program, as a process of its own.

    Args:
        arguments: of its command line.
        prepare: a function of a module, called in the process with the options before the program is.
        program: where its main function is.
        options: of ``prepare``; what JSON can hold.
    """

    def __init__(
        self,
        *arguments: str,
        prepare: Callable[..., None] | None = None,
        program: str = "ba_node.ros.main:main",
        **options: Any,
    ) -> None:
        request = {
            "arguments": arguments,
            "environ": {**os.environ, "RCUTILS_COLORIZED_OUTPUT": "0"},
            "prepare": name_of(prepare) if prepare else "",
            "program": program,
            "options": options,
        }
        pipes = {name: os.pipe() for name in ("out", "err")}
        self.pid, self._answer = zygote().start(request, pipes["out"][1], pipes["err"][1])
        for _, write in pipes.values():
            os.close(write)
        self.out, self.err = "", ""
        self._code: int | None = None
        self._readers = [threading.Thread(target=self._read, args=(name, pipes[name][0])) for name in pipes]
        for reader in self._readers:
            reader.start()

    def _read(self, name: str, descriptor: int) -> None:
        with os.fdopen(descriptor, encoding="utf-8", errors="replace") as stream:
            for line in stream:
                setattr(self, name, getattr(self, name) + line)

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Return the exit code; if it does not come in time, fail with the stacks of all threads."""
        code = self._poll(timeout_s)
        if code is None:
            os.kill(self.pid, signal.SIGABRT)
            self._poll(None)
            pytest.fail(f"the node did not end in {timeout_s} s:\n{self.out}\n{self.err}")
        for reader in self._readers:
            reader.join(timeout_s)
        return code

    def _poll(self, timeout_s: float | None) -> int | None:
        """Return the exit code, None if it does not come in time."""
        if self._code is None and select.select([self._answer], [], [], timeout_s)[0]:
            (self._code,) = array.array("i", self._answer.recv(4))
            self._answer.close()
        return self._code

    def stop(self, number: int = signal.SIGINT, timeout_s: float = TIMEOUT_S) -> int:
        """Send a signal and return the exit code."""
        self.send_signal(number)
        return self.wait(timeout_s)

    def send_signal(self, number: int) -> None:
        if self.alive:
            os.kill(self.pid, number)

    @property
    def alive(self) -> bool:
        return self._poll(0.0) is None

    def close(self) -> None:
        self.send_signal(signal.SIGKILL)
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
            profile = qos.profile(TOPICS[topic]) if topic in WHOLE_MAP else qos.reliable(qos.OUTPUT_DEPTH)
            self.node.create_subscription(cls, f"ba_node/{topic}", take, profile)

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
        topic, message = conversion.input_message(FACTORY, measurement, stamp_ns, "camera")
        self.publishers[topic].publish(message)

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

    def publish_keyframes(self, data: SyntheticData, *rows: int) -> None:
        """Publish the rig and some keyframes of a recording at once."""
        self.publish(data.rig)
        for row in rows:
            self.publish(data.keyframes[row])
            for image in data.tracks[row]:
                self.publish(image, data.keyframes[row].stamp_ns)

    def play_keyframes(self, data: SyntheticData, *rows: int) -> None:
        """Publish the rig and some keyframes of a recording, each when the one before was reported."""
        reports = self.received["report"]
        for row in rows:
            self.publish_keyframes(data, row)
            self._await_any(reports, data.keyframes[row].keyframe_id)

    def _await_any(self, reports: list[Any], key: int) -> None:
        self.until(lambda: any(report.newest_keyframe_id == key for report in reports), f"a report on {key}")

    def refined_ids(self) -> set[int]:
        """Return the keyframes that have come back so far."""
        return {int(key) for message in self.received["refined_keyframes"] for key in message.keyframe_id}

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

    def change_state(self, label: str = "", number: int = 0) -> bool:
        """Ask for a transition; return whether it was made."""
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        return bool(self.call(ChangeState, "ba_node/change_state", request).success)

    def offers(self, service: str) -> bool:
        """Return True if the node has a service that was called before."""
        return service in self._clients and bool(self._clients[service].service_is_ready())

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def solve_until_stopped() -> None:
    """Have solves go on until they are stopped, and say when one has begun."""

    def solve(self: Any, on_iteration: Callable[[Any], bool], on_poses: object) -> None:  # noqa: ARG001
        print("solving", flush=True)
        while on_iteration(None):
            time.sleep(0.01)

    backend = importlib.import_module("ba_node.ros.node").Backend
    backend.solve = solve
    backend.ready = property(lambda self: len(self.scene.keyframes) > 0)


def shut_gates(folder: str) -> None:
    """Have the solvers of a node wait after each iteration, and files before they are written: see :class:`Gates`."""
    solver = importlib.import_module("ba_node.core.solver")
    services = importlib.import_module("ba_node.ros.components.services")
    solve, write_map = solver.solve, services.write_map

    def wait() -> None:
        name = threading.current_thread().name
        while Path(folder, name).exists():
            Path(folder, f"{name}.waits").touch()
            time.sleep(0.005)
        if Path(folder, f"{name}.waits").exists():
            Path(folder, f"{name}.waits").rename(Path(folder, f"{name}.passed"))

    def gated(problem: Any, options: Any, *, on_iteration: Any = None, **others: Any) -> Any:
        def watch(row: Any) -> bool:
            wait()
            return on_iteration is None or on_iteration(row)

        return solve(problem, options, on_iteration=watch, **others)

    def gated_write(path: Path, content: Any) -> None:
        wait()
        write_map(path, content)

    vars(solver)["solve"], vars(services)["write_map"] = gated, gated_write


class Gates:
    """Holds the solvers of a node after each iteration, and files before they are written, at gates that are shut.

    Threads are known by their names: "solver" solves windows, "optimize" everything, "map file" writes.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def options(self) -> dict[str, Any]:
        """Return what starts a node that has the gates."""
        return {"prepare": shut_gates, "folder": str(self.folder)}

    def shut(self, thread: str) -> None:
        for mark in ("waits", "passed"):
            (self.folder / f"{thread}.{mark}").unlink(missing_ok=True)
        (self.folder / thread).touch()

    def open(self, thread: str) -> None:
        (self.folder / thread).unlink()

    def passed(self, thread: str) -> bool:
        """Return True if a solver has gone on from its gate."""
        return (self.folder / f"{thread}.passed").exists()

    def waits(self, thread: str) -> bool:
        """Return True if a solver stands at its gate."""
        return (self.folder / f"{thread}.waits").exists()
