# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The states of the managed node, over a real middleware."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetState

from ba_node.measurements import Keyframe
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES
from ba_node.ros.components.publishing import Publishing
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.ros.harness import solve_until_stopped

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = "unconfigured", "inactive", "active", "finalized"
# From where each transition leads where; everything else is refused.
TRANSITIONS = {
    "configure": {UNCONFIGURED: INACTIVE},
    "activate": {INACTIVE: ACTIVE},
    "deactivate": {ACTIVE: INACTIVE},
    "cleanup": {INACTIVE: UNCONFIGURED},
    "shutdown": {UNCONFIGURED: FINALIZED, INACTIVE: FINALIZED, ACTIVE: FINALIZED},
}


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=8, length_m=12.0, path="line", outlier_share=0.0))


def _state(peer: Any) -> str:
    return str(peer.call(GetState, "ba_node/get_state", GetState.Request()).current_state.label)


def _topics(peer: Any) -> set[str]:
    return {name for name, _ in peer.node.get_topic_names_and_types()}


@pytest.mark.slow
def test_starts_active_or_as_told(start_node: StartNode, make_peer: MakePeer) -> None:
    node, peer = start_node(), make_peer()
    peer.until(lambda: _state(peer) == ACTIVE, "autostart")
    assert node.stop() == 0
    node, peer = start_node("--ros-args", "-p", "node.autostart:=false"), make_peer()
    assert _state(peer) == UNCONFIGURED
    assert not {f"/ba_node/{topic}" for topic in OUTPUT_TYPES} & _topics(peer)
    assert node.stop() == 0
    assert node.out.endswith("stopped: 0 keyframes refined\n")


@pytest.mark.slow
def test_every_transition_from_every_state(start_node: StartNode, make_peer: MakePeer) -> None:
    """Also those that make no sense, by name and by number: refused, and the state stays."""
    node, peer = start_node("--ros-args", "-p", "node.autostart:=false"), make_peer()
    numbers = {"configure": Transition.TRANSITION_CONFIGURE, "activate": Transition.TRANSITION_ACTIVATE}
    state = UNCONFIGURED
    walk = ["activate", "deactivate", "cleanup", "nonsense", "configure", "configure", "cleanup", "cleanup"]
    walk += ["configure", "deactivate", "activate", "activate", "configure", "cleanup", "deactivate", "activate"]
    walk += ["deactivate", "cleanup", "configure", "activate", "shutdown", "configure", "activate", "shutdown"]
    for label in walk:
        leads_to = TRANSITIONS.get(label, {}).get(state)
        assert peer.change_state(label) == (leads_to is not None), f"{label} while {state}"
        state = leads_to or state
        for number in (numbers.get(label, Transition.TRANSITION_ACTIVE_SHUTDOWN), 99):
            if leads_to is None and label != "shutdown" and state != ACTIVE:
                assert not peer.change_state(number=number), f"transition {number} while {state}"
        assert _state(peer) == state, label
    words = "refused or failed; the node is unconfigured, from where it can configure or shutdown"
    assert f"transition 'nonsense' was {words}" in node.err
    assert f"transition '99' was {words}" in node.err
    assert "Traceback" not in node.err
    assert node.stop() == 0


@pytest.mark.slow
def test_deactivate_holds_the_map_and_cleanup_drops_it(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    node, peer = start_node(), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes", "path")
    peer.connect()
    reports = peer.received["report"]
    peer.publish(scene.rig)
    peer.publish_keyframes(scene, *range(4))
    peer.until(lambda: reports and reports[-1].newest_keyframe_id == 3, "keyframe 3")
    _await_taken(peer)  # a keyframe may be solved before the last of its tracks has come

    assert peer.change_state("deactivate")
    n_reports = len(reports)
    peer.publish_keyframes(scene, *range(4, 5))
    _await_taken(peer)
    assert peer.change_state("activate")
    peer.publish_keyframes(scene, *range(5, 6))
    peer.until(lambda: reports[-1].newest_keyframe_id == 5, "keyframe 5")
    assert 4 not in [report.newest_keyframe_id for report in reports[n_reports:]]
    ignored = dict(zip(reports[-1].rejected_reason, reports[-1].rejected_count, strict=True))
    assert ignored == {"inactive": 1 + len(scene.tracks[4])}
    peer.until(lambda: _refined(peer) == [0, 1, 2, 3, 5], "the map, which is still there")

    assert peer.change_state("deactivate")
    assert peer.change_state("cleanup")
    peer.until(lambda: "/ba_node/report" not in _node_topics(peer), "the outputs to go")
    # Who has not heard yet that the inputs are gone takes them for those that come.
    inputs = peer.publishers.values()
    peer.until(lambda: not any(one.get_subscription_count() for one in inputs), "the inputs to go")
    assert peer.change_state("configure")
    assert peer.change_state("activate")
    peer.connect()
    peer.publish(scene.rig)
    peer.publish_keyframes(scene, *range(6, 8))
    peer.until(lambda: reports[-1].newest_keyframe_id == 7, "keyframe 7")
    peer.until(lambda: _refined(peer) == [6, 7], "a map that was empty")
    assert node.stop() == 0
    assert node.out.endswith("stopped: 7 keyframes refined\n"), "those before the cleanup count too"


def _await_taken(peer: Any) -> None:
    """Wait until the node has taken all that was sent: one message of each topic, at least, between two answers."""
    peer.until(peer.all_acknowledged, "the node to have got what was sent")
    for _ in range(6):
        _state(peer)


def _refined(peer: Any) -> list[int]:
    return [int(key) for key in peer.received["refined_keyframes"][-1].keyframe_id]


def _node_topics(peer: Any) -> set[str]:
    # Its services may be found before its name is.
    peer.until(lambda: "ba_node" in peer.node.get_node_names(), "the node's name")
    return {name for name, _ in peer.node.get_publisher_names_and_types_by_node("ba_node", "/")}


def test_cameras_are_taken_while_inactive(start_node: StartNode, make_peer: MakePeer, scene: SyntheticData) -> None:
    """A front-end latches its rig once, perhaps long before a manager activates the node."""
    start_node("--ros-args", "-p", "node.autostart:=false")
    peer = make_peer()
    assert peer.change_state("configure")
    peer.advertise()
    peer.listen("report")
    peer.connect()
    peer.publish(scene.rig)
    peer.until(peer.publishers["camera_rig"].wait_for_all_acked, "the rig to arrive")
    assert peer.change_state("activate")
    peer.publish_keyframes(scene, *range(3))
    peer.until(lambda: peer.received["report"] and peer.received["report"][-1].landmarks > 0, "points")


@pytest.mark.slow
def test_transitions_during_a_solve(start_node: StartNode, make_peer: MakePeer) -> None:
    node, peer = start_node(prepare=solve_until_stopped), make_peer()
    peer.advertise()
    for count in range(1, 4):
        peer.connect()
        peer.publish(Keyframe(0, 1, 1, "odom", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
        peer.until(lambda count=count: node.out.count("solving") == count, "the solve to begin")
        for label in ("deactivate", "activate", "deactivate", "cleanup", "configure", "activate"):
            assert peer.change_state(label), label
    assert peer.change_state("shutdown")
    assert _state(peer) == FINALIZED
    assert node.stop() == 0, node.err
    assert "Traceback" not in node.err


def fail_once() -> None:
    """Have configure and activate fail the first time."""
    configure = Publishing.__init__
    broken = {"configure", "activate"}

    def once(name: str) -> None:
        if name in broken:
            broken.discard(name)
            raise RuntimeError(f"no {name} today")

    def fragile_configure(self: Any, host: Any) -> None:
        configure(self, host)
        once("configure")

    vars_of: Any = Publishing
    vars_of.__init__, vars_of.activate = fragile_configure, lambda _: once("activate")


@pytest.mark.slow
def test_a_transition_that_fails_is_logged_and_can_be_tried_again(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    node, peer = start_node(prepare=fail_once), make_peer()
    assert _state(peer) == UNCONFIGURED, "the failed autostart leaves the node alive"
    peer.until(lambda: "configure failed: RuntimeError: no configure today" in node.err, "the reason")
    assert not {f"/ba_node/{topic}" for topic in OUTPUT_TYPES} & _node_topics(peer), "what was made is destroyed"
    assert peer.change_state("configure")
    assert not peer.change_state("activate")
    peer.until(lambda: "activate failed: RuntimeError: no activate today" in node.err, "that reason")
    assert _state(peer) == UNCONFIGURED
    assert not {f"/{topic}" for topic in INPUT_TYPES} & _topics(peer)
    assert peer.change_state("configure")
    assert peer.change_state("activate")
    peer.advertise()
    peer.listen("report")
    peer.connect()
    peer.publish(scene.rig)
    peer.publish_keyframes(scene, *range(3))
    peer.until(lambda: peer.received["report"] and peer.received["report"][-1].landmarks > 0, "points")
    assert node.stop() == 0


def test_states_as_numbers(start_node: StartNode, make_peer: MakePeer) -> None:
    start_node("--ros-args", "-p", "node.autostart:=false")
    peer = make_peer()
    answer = peer.call(GetState, "ba_node/get_state", GetState.Request()).current_state
    assert answer.id == State.PRIMARY_STATE_UNCONFIGURED
    assert peer.change_state(number=Transition.TRANSITION_CONFIGURE)
    assert peer.change_state(number=Transition.TRANSITION_ACTIVATE)
    answer = peer.call(GetState, "ba_node/get_state", GetState.Request()).current_state
    assert answer.id == State.PRIMARY_STATE_ACTIVE
