# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The action of the node, over a real middleware."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from ba_msgs.action import Optimize
from ba_msgs.srv import SaveMap
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient
from std_srvs.srv import Trigger

from ba_node.core.result import Status
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
KEYFRAMES = 12
# No solve of everything but those that are asked for.
SMALL_WINDOW = (
    *("--ros-args", "-p", "window.max_keyframes:=4", "-p", "window.max_fixed_keyframes:=2"),
    *("-p", "factors.adjust_m:=0.0"),
)


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=12.0, path="line"))


class Client:
    """Sends goals, and keeps the feedback."""

    def __init__(self, peer: Any) -> None:
        self.peer = peer
        self.feedback: list[Any] = []
        self._client = ActionClient(peer.node, Optimize, "ba_node/optimize")

    def send(self, **goal: Any) -> Any:
        """Send a goal and return its handle."""
        self.peer.until(self._client.server_is_ready, "the action")
        sent = self._client.send_goal_async(
            Optimize.Goal(**goal), feedback_callback=lambda message: self.feedback.append(message.feedback)
        )
        self.peer.until(sent.done, "an answer to the goal")
        return sent.result()

    def result(self, future: Any) -> Any:
        self.peer.until(future.done, "a result")
        return future.result()

    def close(self) -> None:
        self._client.destroy()


@pytest.fixture
def peer(make_peer: Callable[..., Any]) -> Any:
    made = make_peer()
    made.advertise()
    made.listen("report", "refined_keyframes", "path")
    return made


@pytest.fixture
def client(peer: Any) -> Iterator[Client]:
    made = Client(peer)
    yield made
    made.close()


@pytest.mark.slow
def test_everything_is_refined_with_feedback(
    start_node: StartNode, peer: Any, client: Client, scene: SyntheticData
) -> None:
    node = start_node(*SMALL_WINDOW)
    peer.connect()
    peer.play_keyframes(scene, *range(KEYFRAMES))
    handle = client.send(method="lma_cd", max_iterations=8)
    assert handle.accepted
    response = client.result(handle.get_result_async())
    result = response.result
    assert response.status == GoalStatus.STATUS_SUCCEEDED
    assert result.success, result.reason
    assert Status(result.status).usable
    assert (result.method, result.keyframes, result.followed_keyframes) == ("lma_cd", KEYFRAMES - 1, 0)
    assert 0 < result.iterations <= 8
    assert result.objective_after < result.objective_before
    assert result.rms_px_after < result.rms_px_before
    assert result.elapsed_s > 0.0
    peer.until(lambda: len(client.feedback) == result.iterations + 1, "all feedback")
    assert [row.iteration for row in client.feedback] == list(range(result.iterations + 1))
    objectives = [row.objective for row in client.feedback]
    assert objectives[0] == pytest.approx(result.objective_before)
    assert objectives[-1] == pytest.approx(result.objective_after)
    assert all(b <= a for a, b in itertools.pairwise(objectives))
    peer.until(lambda: len(peer.received["refined_keyframes"][-1].keyframe_id) == KEYFRAMES, "poses of all keyframes")
    peer.until(lambda: peer.received["report"][-1].method == "lma_cd", "a report")
    # And again: a goal that is done makes room.
    assert client.result(client.send().get_result_async()).status == GoalStatus.STATUS_SUCCEEDED
    assert node.stop() == 0


@pytest.mark.slow
def test_one_at_a_time_and_cancel(
    start_node: StartNode, peer: Any, client: Client, scene: SyntheticData, gates: Any
) -> None:
    node = start_node(*SMALL_WINDOW, **gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(6))
    before = [p.pose.position.x for p in peer.received["path"][-1].poses]
    gates.shut("optimize")
    handle = client.send()
    peer.until(lambda: gates.waits("optimize"), "the solve")
    assert not client.send().accepted
    cancelling = handle.cancel_goal_async()
    peer.until(cancelling.done, "an answer to the cancel")
    assert len(cancelling.result().goals_canceling) == 1
    assert gates.waits("optimize"), "it was answered during the solve"
    gates.open("optimize")
    response = client.result(handle.get_result_async())
    assert response.status == GoalStatus.STATUS_CANCELED
    assert (response.result.success, response.result.status) == (False, Status.SKIPPED)
    assert response.result.reason == "cancelled; the map is as it was"
    peer.play_keyframes(scene, 6)
    after = [p.pose.position.x for p in peer.received["path"][-1].poses]
    np.testing.assert_array_equal(after[:2], before[:2])
    assert node.stop() == 0
    assert "goal of ~/optimize rejected: another goal is at work" in node.err + node.out


@pytest.mark.slow
def test_windows_go_on_and_follow(
    start_node: StartNode, peer: Any, client: Client, scene: SyntheticData, gates: Any
) -> None:
    start_node(*SMALL_WINDOW, **gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(8))
    gates.shut("optimize")
    handle = client.send()
    peer.until(lambda: gates.waits("optimize"), "the solve")
    peer.play_keyframes(scene, *range(8, KEYFRAMES))
    assert gates.waits("optimize"), "windows were solved during it"
    gates.open("optimize")
    result = client.result(handle.get_result_async()).result
    assert (result.success, result.followed_keyframes, result.keyframes) == (True, KEYFRAMES - 8, 7), result.reason
    peer.until(lambda: len(peer.received["refined_keyframes"][-1].keyframe_id) == KEYFRAMES, "poses of all keyframes")
    positions = np.reshape(peer.received["refined_keyframes"][-1].position, (-1, 3))
    error = np.sqrt(np.mean(np.sum((positions - scene.truth.position) ** 2, axis=1)))
    drift = np.sqrt(np.mean(np.sum((scene.odometry.position - scene.truth.position) ** 2, axis=1)))
    assert error < drift / 3, f"{error:.3f} m, the front-end's are {drift:.3f} m off"


@pytest.mark.slow
def test_reset_aborts_it(start_node: StartNode, peer: Any, client: Client, scene: SyntheticData, gates: Any) -> None:
    start_node(*SMALL_WINDOW, **gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(6))
    gates.shut("optimize")
    handle = client.send()
    peer.until(lambda: gates.waits("optimize"), "the solve")
    assert peer.call(Trigger, "ba_node/reset", Trigger.Request()).success
    gates.open("optimize")
    response = client.result(handle.get_result_async())
    assert response.status == GoalStatus.STATUS_ABORTED
    assert (response.result.success, response.result.reason) == (False, "the map was reset or replaced meanwhile")


@pytest.mark.slow
def test_time_is_up(start_node: StartNode, peer: Any, client: Client, scene: SyntheticData) -> None:
    start_node(*SMALL_WINDOW)
    peer.connect()
    peer.play_keyframes(scene, *range(6))
    result = client.result(client.send(time_budget_s=1e-9).get_result_async()).result
    assert (result.success, result.status) == (True, Status.MAX_ITERATIONS)
    assert result.reason == "stopped after 1e-09 s"
    assert result.iterations == 0


def test_goals_that_make_no_sense(start_node: StartNode, peer: Any, client: Client) -> None:
    node = start_node()
    peer.connect()
    assert not client.send(method="guess").accepted
    assert not client.send(time_budget_s=-1.0).accepted
    assert not client.send(time_budget_s=float("nan")).accepted
    response = client.result(client.send().get_result_async())
    assert response.status == GoalStatus.STATUS_ABORTED
    assert response.result.reason == "no camera rig yet: nothing is known about the cameras"
    assert node.stop() == 0
    assert "method = 'guess': choose one of auto, lma_cd" in node.err + node.out
    assert "time_budget_s = -1.0: expected seconds" in node.err + node.out


@pytest.mark.slow
def test_answers_that_warn_and_inform_in_turn(
    start_node: StartNode, peer: Any, client: Client, scene: SyntheticData, tmp_path: Path
) -> None:
    """A goal without data, a recording, the goal again; a save that fails, one that does not, and both again."""
    node = start_node(*SMALL_WINDOW, "-p", f"node.map_folder:={tmp_path}")
    peer.connect()
    statuses = []
    for part in (None, range(6), range(0), range(6, KEYFRAMES)):
        if part:
            peer.play_keyframes(scene, *part)
        elif part is not None:
            assert peer.call(Trigger, "ba_node/reset", Trigger.Request()).success
        statuses.append(client.result(client.send(max_iterations=3).get_result_async()).status)
    failed, done = GoalStatus.STATUS_ABORTED, GoalStatus.STATUS_SUCCEEDED
    assert statuses == [failed, done, failed, done]
    saved = [
        peer.call(SaveMap, "ba_node/save_map", SaveMap.Request(path=path)).success
        for path in ("none/a", "a", "none/a", "a", "../a", "b")
    ]
    assert saved == [False, True, False, True, False, True]
    assert node.stop() == 0
    text = node.err + node.out
    assert text.count("[WARN]") >= 4 and text.count("~/optimize: ") >= 4, text
    assert "Traceback" not in text and "severity" not in text, text


@pytest.mark.slow
@pytest.mark.parametrize("end", ["cleanup", "signal"])
def test_the_node_ends_during_it(
    end: str, start_node: StartNode, peer: Any, client: Client, scene: SyntheticData, gates: Any
) -> None:
    node = start_node(*SMALL_WINDOW, **gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(5))
    gates.shut("optimize")
    handle = client.send()
    peer.until(lambda: gates.waits("optimize"), "the solve")
    if end == "cleanup":
        response = handle.get_result_async()
        for number in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
            request = ChangeState.Request(transition=Transition(id=number))
            assert peer.call(ChangeState, "ba_node/change_state", request).success
        assert client.result(response).result.reason == "the node was cleaned up meanwhile"
        assert client.result(response).status == GoalStatus.STATUS_ABORTED
        gates.open("optimize")
        assert node.stop() == 0
    else:
        node.send_signal(signal.SIGINT)
        peer.until(lambda: "stopped" in node.out, "the end of all but the solve")
        gates.open("optimize")
        assert node.wait() == 0, node.err
        assert gates.passed("optimize"), "Python waits for the solve: to end under its feet would abort"
    assert "internal error" not in node.err + node.out
