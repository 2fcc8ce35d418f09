# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""What becomes of the node where rclpy has none of the private parts that it works with."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from ba_msgs.action import Optimize
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient

from ba_node.ros import parameters
from ba_node.ros.rclpy_compat import actions, lifecycle, private
from ba_node.ros.rclpy_compat.private import part
from experiments.synthetic import SyntheticOptions, generate


def test_a_part_that_is_missing_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(private, "get_logger", lambda _: SimpleNamespace(warning=said.append))
    monkeypatch.setattr(private, "_said", set())
    owner = SimpleNamespace(_there={}, _other=3)
    assert part(owner, "_there", dict, "it stands still") is owner._there
    for _ in range(2):
        assert part(owner, "_other", dict, "it stands still") is None
        assert part(owner, "_gone", object, "it falls") is None
    assert said == [
        "this rclpy is not as 7.1 is: no SimpleNamespace._other; it stands still",
        "this rclpy is not as 7.1 is: no SimpleNamespace._gone; it falls",
    ]


def forget_private_parts() -> None:
    for module in (actions, lifecycle, parameters):
        vars(module)["part"] = lambda *_: None


@pytest.mark.slow
@pytest.mark.dds
def test_the_node_works_without_them(start_node: Callable[..., Any], make_peer: Callable[..., Any]) -> None:
    chosen = ("-p", "window.max_keyframes:=7", "-p", "no.such.name:=1")
    node, peer = start_node("--ros-args", *chosen, prepare=forget_private_parts), make_peer()
    peer.advertise()
    peer.play(generate(SyntheticOptions(seed=3, keyframes=6, length_m=10.0, path="line", outlier_share=0.0)))
    values = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=["window.max_keyframes"]))
    assert values.values[0].integer_value == 7
    client = ActionClient(peer.node, Optimize, "ba_node/optimize")
    peer.until(client.server_is_ready, "the action")
    peer.be_found()
    sent = client.send_goal_async(Optimize.Goal())
    peer.until(sent.done, "the goal to be accepted")
    result = sent.result().get_result_async()
    peer.until(result.done, "a result")
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    assert result.result().result.success and result.result().result.keyframes == 5, "all but the first, which is fixed"
    client.destroy()
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    assert not peer.call(ChangeState, "ba_node/change_state", request).success
    peer.until(lambda: "was refused or failed; the node is in an unknown state" in node.err, "the reason")
    assert node.stop() == 0, node.err
    assert "Traceback" not in node.err
