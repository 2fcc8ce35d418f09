# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Every client gets an answer, whatever raises on the way to it: faults are put into a running node one by one."""

from __future__ import annotations

import builtins
import contextlib
import functools
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from ba_msgs.action import Optimize
from ba_msgs.srv import LoadMap, SaveMap
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.action import ActionClient
from std_srvs.srv import SetBool, Trigger

from ba_node.core.result import Status
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.ros.harness import NodeProcess, Peer

pytestmark = pytest.mark.dds

KEYFRAMES = 6
# Beside the node of the module.
ALONE = ("--ros-args", "-r", "__ns:=/alone")
# Where a fault can be put: module, what of it, and what it then raises. A file of the name in a folder arms it.
FAULTS = {
    "reset": ("ba_node.backend", "Backend.reset", "RuntimeError"),
    "estimate": ("ba_node.backend", "Backend.estimate", "RuntimeError"),
    "exit": ("ba_node.backend", "Backend.reset", "SystemExit"),
    "interrupt": ("ba_node.backend", "Backend.reset", "KeyboardInterrupt"),
    "post": ("ba_node.ros.worker.inbox", "Inbox.post", "MemoryError"),
    "path": ("ba_node.ros.components.services", "path_in_folder", "RecursionError"),
    "snapshot": ("ba_node.backend", "Backend.snapshot", "MemoryError"),
    "write": ("ba_node.ros.components.services", "write_map", "ZeroDivisionError"),
    "disk": ("ba_node.ros.components.services", "write_map", "OSError"),
    "write_exit": ("ba_node.ros.components.services", "write_map", "SystemExit"),
    "thread": ("threading", "Thread.start", "RuntimeError"),
    "counts": ("ba_node.scene.map_content", "MapContent.sizes", "IndexError"),
    "read": ("ba_node.ros.components.services", "load_map", "MemoryError"),
    "take_over": ("ba_node.backend", "Backend.take_over", "KeyError"),
    "known": ("ba_node.backend.archive", "MapState.sizes", "ValueError"),
    "logger": ("rclpy.impl.rcutils_logger", "RcutilsLogger.log", "ValueError"),
    "copy": ("ba_node.window.full", "take_snapshot", "IndexError"),
    "options": ("ba_node.window.full", "options", "KeyError"),
    "solve": ("ba_node.window.full", "Optimization.solve", "FloatingPointError"),
    "solve_exit": ("ba_node.window.full", "Optimization.solve", "SystemExit"),
    "figures": ("ba_node.window.full", "Optimization.statistics", "TypeError"),
    "merge": ("ba_node.backend", "Backend.merge", "AssertionError"),
    "state": ("rclpy.action.server", "ServerGoalHandle._update_state", "RuntimeError"),
    "feedback": ("rclpy.action.server", "ServerGoalHandle.publish_feedback", "RuntimeError"),
    "objection": ("ba_node.ros.components.optimize", "Optimize._objection", "RuntimeError"),
    "parameters": ("ba_node.config", "Config.with_values", "RuntimeError"),
    "response": ("ba_msgs.srv", "SaveMap.Response.__init__", "AssertionError"),
    "components": ("ba_node.ros.components.inputs", "Inputs.__init__", "RuntimeError"),
    "cleanup": ("ba_node.ros.worker.worker", "Worker.stop", "RuntimeError"),
    "solver": ("ba_node.ros.worker.worker", "Worker._guard", "SystemExit"),
}
PARTLY: dict[str, Callable[[Any, Any], bool]] = {
    # Not where rclpy makes an empty response, nor its own lines of debugging.
    "response": lambda _, options: bool(options),
    "logger": lambda arguments, _: bool(arguments[2] >= 20),
    # Not what work beside solves tells at its end, which may be of the call before.
    "post": lambda arguments, _: getattr(arguments[1], "__name__", "") == "guarded",
}


def _owner(module: str, place: str) -> tuple[Any, str]:
    """Return what has the function at a place, and its name there."""
    *path, last = place.split(".")
    return functools.reduce(getattr, path, importlib.import_module(module)), last


@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_has_a_place(fault: str) -> None:
    assert callable(getattr(*_owner(*FAULTS[fault][:2])))


def put_faults(folder: str) -> None:
    """Put all faults in, to be armed by files."""
    for name, place in FAULTS.items():
        _put(Path(folder), name, *place)


def _put(folder: Path, name: str, module: str, place: str, kind: str) -> None:
    owner, last = _owner(module, place)
    real = getattr(owner, last)

    @functools.wraps(real)
    def call(*arguments: Any, **options: Any) -> Any:
        armed = name not in PARTLY or PARTLY[name](arguments, options)
        if armed and (folder / name).exists():
            if name != "logger":
                (folder / name).unlink()
            raise getattr(builtins, kind)(f"put in: {name}")
        return real(*arguments, **options)

    setattr(owner, last, call)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults")


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=10.0, path="line", outlier_share=0.0))


class Client:
    """Talks to a node, and knows how to put a fault into it."""

    def __init__(self, node: Any, peer: Any, folder: Path) -> None:
        self.node, self.peer, self.folder = node, peer, folder
        self.action = ActionClient(peer.node, Optimize, "ba_node/optimize")

    def arm(self, fault: str) -> None:
        (self.folder / fault).touch()

    def disarm(self) -> None:
        for file in self.folder.iterdir():
            if file.name in FAULTS:
                file.unlink(missing_ok=True)

    def call(self, service: str) -> Any:
        kind, request = {
            "reset": (Trigger, Trigger.Request()),
            "pause": (SetBool, SetBool.Request(data=False)),
            "save_map": (SaveMap, SaveMap.Request(path="site")),
            "load_map": (LoadMap, LoadMap.Request(path="kept")),
        }[service]
        return self.peer.call(kind, f"ba_node/{service}", request)

    def send_goal(self, **goal: Any) -> Any:
        self.peer.until(self.action.server_is_ready, "the action")
        sent = self.action.send_goal_async(Optimize.Goal(**goal))
        self.peer.until(sent.done, "an answer to the goal")
        return sent.result()

    def optimize(self, **goal: Any) -> Any:
        handle = self.send_goal(**goal)
        assert handle.accepted
        result = handle.get_result_async()
        self.peer.until(result.done, "a result")
        return result.result()

    def change(self, number: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=number))
        return bool(self.peer.call(ChangeState, "ba_node/change_state", request).success)

    def state(self) -> str:
        return str(self.peer.call(GetState, "ba_node/get_state", GetState.Request()).current_state.label)


@pytest.fixture(scope="module")
def shared(domain: int, folder: Path, scene: SyntheticData) -> Iterator[Client]:  # noqa: ARG001
    """Return a client of a node that outlives all faults of this module."""
    arguments = ("--ros-args", "-p", f"node.map_folder:={folder}")
    with (
        contextlib.closing(NodeProcess(*arguments, prepare=put_faults, folder=str(folder))) as node,
        contextlib.closing(Peer()) as peer,
    ):
        peer.advertise()
        peer.play(scene)
        client = Client(node, peer, folder)
        assert client.peer.call(SaveMap, "ba_node/save_map", SaveMap.Request(path="kept")).success
        yield client


@pytest.fixture
def client(shared: Client) -> Iterator[Client]:
    yield shared
    shared.disarm()
    # Whatever was put in, the node goes on, and has its map.
    assert shared.call("load_map").success
    assert shared.node.alive


@pytest.mark.parametrize(
    ("service", "fault"),
    [
        *(("reset", fault) for fault in ("reset", "estimate", "exit", "interrupt", "post")),
        *(("save_map", fault) for fault in ("path", "snapshot", "write", "disk", "write_exit", "thread", "counts")),
        *(("save_map", fault) for fault in ("post", "response")),
        *(("load_map", fault) for fault in ("path", "read", "thread", "take_over", "known", "estimate", "post")),
    ],
)
def test_a_service_answers_whatever_raises(service: str, fault: str, client: Client) -> None:
    client.arm(fault)
    answer = client.call(service)
    if (service, fault) == ("reset", "estimate") or (service, fault) == ("load_map", "estimate"):
        assert answer.success, "it was done; what fails is to publish it"
        return
    assert not answer.success
    assert f"put in: {fault}" in answer.message, answer.message
    assert not (client.folder / fault).exists()
    assert client.call(service).success, "and then as ever"


@pytest.mark.parametrize("service", ["reset", "pause", "save_map", "load_map"])
def test_a_log_that_raises_keeps_nobody_waiting(service: str, client: Client) -> None:
    client.arm("logger")
    assert client.call(service).success
    assert client.optimize(max_iterations=1).result.reason


@pytest.mark.parametrize(
    "fault", ["copy", "options", "solve", "solve_exit", "figures", "merge", "state", "thread", "post", "feedback"]
)
def test_a_goal_gets_a_result_whatever_raises(fault: str, client: Client) -> None:
    client.arm(fault)
    response = client.optimize(max_iterations=2)
    if fault == "feedback":
        assert response.status == GoalStatus.STATUS_SUCCEEDED, "feedback is lost, the result is not"
    else:
        assert response.status == GoalStatus.STATUS_ABORTED
        assert (response.result.success, response.result.status) == (False, Status.FAILED)
        assert f"put in: {fault}" in response.result.reason
    assert not (client.folder / fault).exists()
    again = client.optimize(max_iterations=2)
    assert again.result.success, again.result.reason


def test_a_goal_that_cannot_be_judged_is_rejected(client: Client) -> None:
    client.arm("objection")
    assert not client.send_goal().accepted
    assert client.optimize(max_iterations=1).result.success


def test_rclpys_own_services_answer_too(client: Client) -> None:
    senseless = Parameter(name="solver.loss_scale_px", value=ParameterValue(type=42))
    good = Parameter(name="solver.loss_scale_px", value=ParameterValue(type=3, double_value=1.5))
    request = SetParameters.Request(parameters=[senseless])
    (result,) = client.peer.call(SetParameters, "ba_node/set_parameters", request).results
    assert not result.successful and "internal error" in result.reason
    atomic = "ba_node/set_parameters_atomically"
    kind = SetParametersAtomically
    result = client.peer.call(kind, atomic, kind.Request(parameters=[good, senseless])).result
    assert not result.successful and "internal error" in result.reason
    client.arm("parameters")
    result = client.peer.call(kind, atomic, kind.Request(parameters=[good])).result
    assert not result.successful and "put in: parameters" in result.reason
    assert client.peer.call(kind, atomic, kind.Request(parameters=[good])).result.successful
    assert not client.change(99)


def test_transitions_that_raise_are_answered(client: Client) -> None:
    client.arm("cleanup")
    assert client.change(Transition.TRANSITION_DEACTIVATE)
    assert not client.change(Transition.TRANSITION_CLEANUP)
    assert client.state() == "unconfigured"
    client.arm("components")
    assert not client.change(Transition.TRANSITION_CONFIGURE)
    assert client.state() == "unconfigured"
    assert client.change(Transition.TRANSITION_CONFIGURE)
    assert client.change(Transition.TRANSITION_ACTIVATE)


def test_twenty_faults_in_a_row_do_not_end_the_node(client: Client) -> None:
    for _ in range(25):
        client.arm("path")
        assert not client.call("save_map").success


@pytest.fixture
def start_alone(
    start_node: Callable[..., Any], make_peer: Callable[..., Any], tmp_path: Path, scene: SyntheticData
) -> Callable[..., Client]:
    """Return a function that starts a node of its own with options, and returns a client of it.

    It has a folder of its own: the other node would take what is put in for itself.
    """

    def start(**options: Any) -> Client:
        node = start_node(*ALONE, "-p", f"node.map_folder:={tmp_path}", **options)
        peer = make_peer(namespace="alone")
        peer.advertise()
        peer.play(scene)
        return Client(node, peer, tmp_path)

    return start


@pytest.mark.slow
def test_the_solvers_thread_dies(start_alone: Callable[..., Client], tmp_path: Path, scene: SyntheticData) -> None:
    """Whoever waits then is answered, and whoever comes later too."""
    alone = start_alone(prepare=put_faults, folder=str(tmp_path))
    peer = alone.peer
    alone.arm("solver")
    # The round that is under way when the fault is put in may still serve the first.
    messages = [alone.call("reset").message for _ in range(2)]
    assert messages[1] == "the solver's thread has ended: start the node anew"
    assert not alone.call("save_map").success
    response = alone.optimize()
    assert (response.status, response.result.success) == (GoalStatus.STATUS_ABORTED, False)
    assert response.result.reason == "the solver's thread has ended: start the node anew"
    assert alone.call("pause").success
    peer.publish(scene.keyframes[0])
    assert alone.node.stop() == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 15])
def test_who_waits_when_a_signal_comes_is_answered(
    number: int, start_alone: Callable[..., Client], gates: Any, tmp_path: Path
) -> None:
    alone = start_alone(**gates.options)
    node, peer = alone.node, alone.peer
    gates.shut("optimize")
    handle = alone.send_goal()
    result = handle.get_result_async()
    peer.until(lambda: gates.waits("optimize"), "the solve")
    gates.shut("map file")
    saving = peer.send(SaveMap, "ba_node/save_map", SaveMap.Request(path="late"))
    peer.until(lambda: gates.waits("map file"), "the file")
    node.send_signal(number)
    peer.until(lambda: saving.done() and result.done(), "answers")
    assert saving.result().message == result.result().result.reason == "the node was cleaned up meanwhile"
    gates.open("optimize")
    gates.open("map file")
    assert node.wait() == 0, node.err
    assert (tmp_path / "late.npz").exists(), "a file is written to the end"
