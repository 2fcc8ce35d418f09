# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Whoever asks `ba_front_end` or `ba_adapter` is answered, whatever is asked, and both go on."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from rcl_interfaces.msg import Parameter, ParameterValue

from ba_node.messages.factory import header_message
from ba_node.ros import qos
from ba_node.ros.message_factory import RclpyFactory, message_class

pytestmark = pytest.mark.dds
StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
_ASK_AGAIN_S = 0.5


def senseless(service: str) -> list[dict[str, Any]]:
    """Return the fields of requests that ask for what is not there, or make no sense."""
    parameter = Parameter(name="max_features", value=ParameterValue(type=42))
    unknown = Parameter(name="nobody", value=ParameterValue(type=2, integer_value=5))
    changed = Parameter(name="max_features", value=ParameterValue(type=2, integer_value=500))
    asked: dict[str, list[dict[str, Any]]] = {
        "set_parameters": [{"parameters": [one]} for one in (parameter, unknown, changed)],
        "set_parameters_atomically": [{"parameters": [changed, parameter]}, {"parameters": [unknown]}],
        "get_parameters": [{"names": ["nobody", ""]}],
        "get_parameter_types": [{"names": ["nobody"]}],
        "describe_parameters": [{"names": ["nobody", "use_sim_time"]}],
        "list_parameters": [{"prefixes": ["a.b"], "depth": 2**64 - 1}],
        "get_type_description": [{"type_name": "no/such/Type", "type_hash": "RIHS01_0"}],
        "change_state": [
            {"transition": Transition(id=99)},
            {"transition": Transition(label="fly")},
            {"transition": Transition(label="configure")},  # it is active
        ],
    }
    return asked.get(service, [])


def _service(kind: str) -> Any:
    """Return the class of a service, ``package/srv/Type``."""
    package, folder, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


class Asker:
    """Asks all services that a node has."""

    def __init__(self, peer: Any, node: str) -> None:
        self.peer, self.node = peer, node
        found: dict[str, Any] = {}

        def there() -> bool:
            if node in peer.node.get_node_names():
                found.update(peer.node.get_service_names_and_types_by_node(node, "/"))
            return f"/{node}/set_parameters" in found and f"/{node}/get_type_description" in found

        peer.until(there, f"the services of {node}")
        self.kinds = {name: _service(kinds[0]) for name, kinds in found.items()}
        self.clients = {name: peer.node.create_client(kind, name) for name, kind in self.kinds.items()}
        for name in self.clients:
            self._be_found(name)

    def _be_found(self, name: str) -> None:
        """Ask until the node has found the client: what it answers before that is lost."""
        began, futures = time.monotonic(), list[Any]()

        def answered() -> bool:
            if self.clients[name].service_is_ready() and len(futures) < 1 + (time.monotonic() - began) / _ASK_AGAIN_S:
                futures.append(self.clients[name].call_async(self.kinds[name].Request()))
            return any(future.done() for future in futures)

        self.peer.until(answered, f"a first answer of {name}")

    def ask(self) -> dict[str, list[Any]]:
        """Ask each service all at once; return its answers when all have come."""
        futures = {
            name: [
                self.clients[name].call_async(kind.Request(**fields))
                for fields in [{}, *senseless(name.rpartition("/")[2])]
            ]
            for name, kind in self.kinds.items()
        }
        self.peer.until(lambda: all(one.done() for some in futures.values() for one in some), "all answers")
        return {name: [one.result() for one in some] for name, some in futures.items()}


@pytest.mark.slow
def test_the_front_end_answers_while_it_tracks(start_node: StartNode, make_peer: MakePeer) -> None:
    pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")
    node, peer = start_node("--ros-args", "-p", "mode:=mono", program="ba_node.ros.front_end.main:main"), make_peer()
    asker = Asker(peer, "ba_front_end")
    images = peer.node.create_publisher(message_class("sensor_msgs/msg/Image"), "image_raw", qos.reliable(100))
    infos = peer.node.create_publisher(message_class("sensor_msgs/msg/CameraInfo"), "camera_info", qos.reliable(100))
    peer.until(lambda: images.get_subscription_count() and infos.get_subscription_count(), "the node to subscribe")
    k = [200.0, 0.0, 160.0, 0.0, 200.0, 120.0, 0.0, 0.0, 1.0]
    infos.publish(message_class("sensor_msgs/msg/CameraInfo")(width=320, height=240, k=k))
    noise = np.random.default_rng(1).integers(0, 255, (20, 240, 320), dtype=np.uint8)
    factory = RclpyFactory()
    for i, pixels in enumerate(noise):
        header = header_message(factory, 10**18 + i * 10**8, "camera")
        data = factory.array(pixels.reshape(-1))
        images.publish(
            message_class("sensor_msgs/msg/Image")(
                header=header, width=320, height=240, step=320, encoding="mono8", data=data
            )
        )
    answers = asker.ask()
    assert len(answers) >= 12, sorted(answers)
    assert [one.success for one in answers["/ba_front_end/change_state"]] == [False] * 4
    results = [one.results[0] for one in answers["/ba_front_end/set_parameters"][1:]]
    assert [one.successful for one in results] == [False] * 3, results
    assert answers["/ba_front_end/get_state"][0].current_state.label == "active"
    peer.until(lambda: "20 images" in node.err, "the log")
    assert node.stop() == 0, node.err


@pytest.mark.slow
def test_the_adapter_answers(start_node: StartNode, make_peer: MakePeer) -> None:
    arguments = ("--from", "vins_mono", "--ros-args", "-r", "feature:=points")
    node, peer = start_node(*arguments, program="ba_node.ros.tools.adapter:main"), make_peer()
    answers = Asker(peer, "ba_adapter").ask()
    assert len(answers) >= 7, sorted(answers)
    results = [one.results[0] for one in answers["/ba_adapter/set_parameters"][1:]]
    assert [one.successful for one in results] == [False] * 3, results
    assert not any(one.result.successful for one in answers["/ba_adapter/set_parameters_atomically"][1:])
    peer.until(lambda: "nobody publishes /points" in node.err, "the log")
    assert node.stop() == 0, node.err
