# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node, over a real middleware."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ba_msgs.srv import LoadMap, SaveMap
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import SetBool, Trigger

from ba_node.estimate import Status
from ba_node.io.map_file import read_map
from ba_node.messages.topics import SERVICES
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

pytestmark = pytest.mark.dds

StartNode = Callable[..., Any]
MakePeer = Callable[..., Any]
KEYFRAMES = 8
INACTIVE = ("--ros-args", "-p", "node.autostart:=false")


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=12.0, path="line", outlier_share=0.0))


@pytest.fixture
def start_node(start_node: StartNode, tmp_path: Path) -> StartNode:
    """Return a function that starts a node whose maps are in the folder of the test."""

    def start(*arguments: str, **options: Any) -> Any:
        return start_node("--ros-args", "-p", f"node.map_folder:={tmp_path}", *arguments, **options)

    return start


@pytest.fixture
def peer(make_peer: MakePeer) -> Any:
    made = make_peer()
    made.advertise()
    made.listen()
    return made


def _forget(peer: Any) -> None:
    for messages in peer.received.values():
        messages.clear()


def _reset(peer: Any) -> Any:
    return peer.call(Trigger, "ba_node/reset", Trigger.Request())


def _pause(peer: Any, data: bool) -> Any:
    return peer.call(SetBool, "ba_node/pause", SetBool.Request(data=data))


def _save(peer: Any, path: Path | str) -> Any:
    return peer.call(SaveMap, "ba_node/save_map", SaveMap.Request(path=str(path)))


def _load(peer: Any, path: Path | str) -> Any:
    return peer.call(LoadMap, "ba_node/load_map", LoadMap.Request(path=str(path)))


@pytest.mark.slow
def test_reset_forgets_the_map_and_says_so(start_node: StartNode, peer: Any, scene: SyntheticData) -> None:
    node = start_node()
    peer.connect()
    peer.play_keyframes(scene, *range(4))
    peer.until(lambda: peer.received["path"] and len(peer.received["path"][-1].poses) == 4, "a path of 4")
    answer = _reset(peer)
    assert (answer.success, answer.message) == (True, "forgot 4 keyframes; the next keyframe begins a new map")
    peer.until(lambda: len(peer.received["path"][-1].poses) == 0, "an empty path")
    peer.until(lambda: peer.received["points"][-1].width == 0, "an empty cloud")
    peer.until(lambda: peer.received["report"][-1].reason == "reset: the map is empty", "a report on it")
    assert peer.received["report"][-1].status == Status.SKIPPED
    _forget(peer)
    # The same keyframes of the same session are news again.
    peer.play_keyframes(scene, *range(3))
    peer.until(lambda: peer.received["path"] and len(peer.received["path"][-1].poses) == 3, "a path of 3")
    assert node.stop() == 0


def test_data_is_ignored_and_counted_while_paused(start_node: StartNode, peer: Any, scene: SyntheticData) -> None:
    start_node()
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    assert _pause(peer, True).message == "paused: keyframes and tracks are ignored and counted"
    assert _pause(peer, True).message.endswith("(as before)")
    peer.publish_keyframes(scene, 3, 4)
    # What is asked for after data on another connection may overtake it: keyframes 5 and on end the pause.
    assert _pause(peer, False).message == "running"
    peer.play_keyframes(scene, *range(5, KEYFRAMES))
    last = peer.received["report"][-1]
    rejected = dict(zip(last.rejected_reason, last.rejected_count, strict=True))
    assert rejected.get("paused", 0) > 0, rejected
    ids = [int(key) for message in peer.received["refined_keyframes"] for key in message.keyframe_id]
    assert {5, 6, 7} <= set(ids)


@pytest.mark.slow
def test_a_saved_map_goes_on_in_another_node(
    start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path
) -> None:
    first = start_node()
    peer.connect()
    peer.play_keyframes(scene, *range(5))
    path = tmp_path / "site.npz"
    saved = _save(peer, path)
    assert saved.success, saved.message
    assert saved.message == f"{path}: 5 keyframes, {saved.landmarks} landmarks, {saved.observations} observations"
    with np.load(path) as arrays:
        assert len(arrays["keyframes/position"]) == saved.keyframes == 5
        assert len(arrays["observations/uv"]) == saved.observations > 500
        positions = arrays["keyframes/position"]
    assert first.stop() == 0

    _forget(peer)
    second = start_node()
    loaded = _load(peer, path)
    assert (loaded.success, loaded.keyframes, loaded.landmarks) == (True, 5, saved.landmarks), loaded.message
    assert loaded.session_id == 0
    peer.connect()
    peer.until(lambda: peer.received["path"] and len(peer.received["path"][-1].poses) == 5, "the path of the map")
    shown = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in peer.received["path"][-1].poses]
    np.testing.assert_array_equal(shown, positions)
    peer.play_keyframes(scene, *range(5, KEYFRAMES))
    assert Status(peer.received["report"][-1].status).usable
    peer.until(lambda: len(peer.received["path"][-1].poses) == KEYFRAMES, "the path of all")
    assert second.stop() == 0


@pytest.mark.slow
def test_what_cannot_be_saved_or_loaded_is_told(
    start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path
) -> None:
    node = start_node()
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "link.npz").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.npz")
    for path, reason in (
        (tmp_path / "none" / "a.npz", "cannot write .*: No such file or directory; nothing was saved"),
        (tmp_path / "text.npz" / "a.npz", "cannot write .*: Not a directory; nothing was saved"),
        (tmp_path / "folder.npz", "is no regular file"),
        (tmp_path / "pipe.npz", "is no regular file"),
        (tmp_path / "link.npz", "is a link"),
        (tmp_path / "text", "text.npz is there and no map of ba_node: it is not overwritten"),
        ("/dev/null", "leads elsewhere: expected a file below node.map_folder"),
        ("../a", "leads elsewhere"),
        ("", "path = '': expected the name of a file"),
    ):
        answer = _save(peer, path)
        assert (answer.success, answer.keyframes) == (False, 0)
        assert re.search(reason, answer.message), answer.message
    assert (tmp_path / "text.npz").read_text() == "hello"

    good = tmp_path / "good.npz"
    assert _save(peer, "good").message.startswith(f"{good}: 3 keyframes")
    assert _save(peer, good).success, "a map may be replaced"
    newer = good.read_bytes().replace(b'"version": 2', b'"version": 3')
    (tmp_path / "newer.npz").write_bytes(newer)
    (tmp_path / "cut.npz").write_bytes(good.read_bytes()[:-1000])
    np.savez(tmp_path / "foreign.npz", a=np.zeros(3))
    for path, reason in (
        (tmp_path / "none.npz", "cannot be opened: No such file or directory; the map is as before"),
        (tmp_path / "folder.npz", "is no regular file"),
        (tmp_path / "pipe.npz", "is no regular file"),
        (tmp_path / "link.npz", "is a link"),
        (tmp_path / "text", "not a map: expected an .npz file"),
        (tmp_path / "foreign.npz", "not a map: it has no map.json"),
        (tmp_path / "cut.npz", "cut off or damaged"),
        (tmp_path / "newer.npz", "damaged: Bad CRC-32|format version 3"),
        ("/dev/zero", "leads elsewhere"),
        ("", "expected the name of a file"),
    ):
        answer = _load(peer, path)
        assert (answer.success, answer.keyframes) == (False, 0)
        assert re.search(reason, answer.message), answer.message
    # The map is as it was.
    peer.play_keyframes(scene, 3)
    peer.until(lambda: len(peer.received["path"][-1].poses) == 4, "the path of the map and one more")
    assert node.stop() == 0


@pytest.mark.slow
def test_an_answer_does_not_wait_for_a_solve(
    start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path, gates: Any
) -> None:
    node = start_node(**gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    gates.shut("solver")
    peer.publish_keyframes(scene, 3)
    peer.until(lambda: gates.waits("solver"), "a solve")
    n_reports = len(peer.received["report"])
    saving = peer.send(SaveMap, "ba_node/save_map", SaveMap.Request(path=str(tmp_path / "a.npz")))
    second = _save(peer, tmp_path / "b.npz")
    assert second.message == "another map is being saved or loaded: try again when that is done"
    got = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=["window.max_keyframes"]))
    assert got.values[0].integer_value == 20
    assert _pause(peer, True).success
    assert _pause(peer, False).success
    assert gates.waits("solver"), "all that was answered during the solve"
    assert not saving.done()
    assert len(peer.received["report"]) == n_reports
    gates.open("solver")
    peer.until(saving.done, "the map to be saved between two solves")
    assert saving.result().keyframes == 4
    assert _save(peer, tmp_path / "b.npz").success
    assert node.stop() == 0


@pytest.mark.slow
def test_inactive_or_not_there(start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path) -> None:
    start_node(*INACTIVE)
    names = {f"/ba_node/{name}" for name in SERVICES}

    def offered() -> set[str]:
        return names & {name for name, _ in peer.node.get_service_names_and_types()}

    assert peer.change_state(number=Transition.TRANSITION_CONFIGURE)
    peer.until(lambda: offered() == names, "services of a configured node")
    assert _save(peer, tmp_path / "empty.npz").message.endswith("0 keyframes, 0 landmarks, 0 observations")
    assert _load(peer, tmp_path / "empty.npz").success
    assert _reset(peer).message.startswith("forgot 0 keyframes")
    assert peer.change_state(number=Transition.TRANSITION_ACTIVATE)
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    assert peer.change_state(number=Transition.TRANSITION_DEACTIVATE)
    assert _save(peer, tmp_path / "three.npz").keyframes == 3
    assert peer.change_state(number=Transition.TRANSITION_CLEANUP)
    # The clients of the peer count as such in the graph, so they are asked instead.
    peer.until(lambda: not any(peer.offers(f"ba_node/{name}") for name in SERVICES), "services to go")
    assert peer.offers("ba_node/change_state")


@pytest.mark.slow
def test_who_waits_at_cleanup_is_answered(
    start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path, gates: Any
) -> None:
    node = start_node(**gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    gates.shut("solver")
    peer.publish_keyframes(scene, 3)
    peer.until(lambda: gates.waits("solver"), "a solve")
    saving = peer.send(SaveMap, "ba_node/save_map", SaveMap.Request(path=str(tmp_path / "a.npz")))
    # Requests of one client keep their order, those of two do not: so the node has the one before.
    assert _save(peer, tmp_path / "b.npz").message.startswith("another map is being saved")
    assert peer.change_state(number=Transition.TRANSITION_DEACTIVATE)
    assert peer.change_state(number=Transition.TRANSITION_CLEANUP)
    peer.until(saving.done, "an answer")
    assert saving.result().message == "the node was cleaned up meanwhile"
    # The service lingers so that the answer is heard; a configured node has one of its own.
    peer.until(lambda: not peer.offers("ba_node/save_map"), "the service to go")
    assert peer.change_state(number=Transition.TRANSITION_CONFIGURE)
    assert _save(peer, tmp_path / "b.npz").message.endswith("0 keyframes, 0 landmarks, 0 observations")
    gates.open("solver")
    assert node.stop() == 0
    assert not (tmp_path / "a.npz").exists()


@pytest.mark.slow
def test_a_file_is_written_to_the_end(
    start_node: StartNode, peer: Any, scene: SyntheticData, tmp_path: Path, gates: Any
) -> None:
    node = start_node(**gates.options)
    peer.connect()
    peer.play_keyframes(scene, *range(3))
    gates.shut("map file")
    peer.send(SaveMap, "ba_node/save_map", SaveMap.Request(path=str(tmp_path / "a.npz")))
    peer.until(lambda: gates.waits("map file"), "the file")
    node.send_signal(signal.SIGINT)
    peer.until(lambda: "stopped" in node.out, "the end of all but the file")
    gates.open("map file")
    assert node.wait() == 0, node.err
    assert gates.passed("map file")
    assert len(read_map(tmp_path / "a.npz").arrays["keyframes/position"]) == 3


@pytest.mark.slow
def test_a_map_is_saved_at_the_end_and_loaded_at_the_start(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData, tmp_path: Path
) -> None:
    """The second run goes on where the first has ended, in the same session."""
    kept = ("-p", "node.load_map:=site", "-p", "node.save_map:=site")
    for first, last in ((0, 4), (4, KEYFRAMES)):
        node, peer = start_node(*kept), make_peer()
        peer.advertise()
        peer.listen("report")
        peer.connect()
        peer.play_keyframes(scene, *range(first, last))
        peer.close()
        assert node.stop() == 0
        assert ("no file" in node.err) == (first == 0), node.err
        saved = read_map(tmp_path / "site.npz").arrays
        assert saved["keyframes/keyframe_id"].tolist() == [one.keyframe_id for one in scene.keyframes[:last]]
        assert saved["keyframes/refined"].all()
    node, peer = start_node(*kept), make_peer()
    peer.listen("points")
    peer.until(lambda: peer.received["points"], "the map of the runs before")
    assert peer.received["points"][0].width > 50
    assert node.stop() == 0
    assert len(read_map(tmp_path / "site.npz").arrays["keyframes/keyframe_id"]) == KEYFRAMES


def test_an_empty_map_is_not_saved(start_node: StartNode, peer: Any, tmp_path: Path) -> None:
    node = start_node("-p", "node.save_map:=site")
    peer.until(lambda: "activate: done" in node.err, "the node")
    assert node.stop() == 0
    assert not list(tmp_path.glob("*.npz"))
    assert "node.save_map: the map is empty" in node.err


def test_a_node_does_not_begin_with_a_damaged_map(start_node: StartNode, peer: Any, tmp_path: Path) -> None:
    """Said in one line; the node stays unconfigured."""
    (tmp_path / "site.npz").write_bytes(b"PK\x03\x04 and no more")
    kept = ("-p", "node.load_map:=site", "-p", "node.save_map:=other")
    node = start_node(*kept)
    peer.until(lambda: "from where it can" in node.err, "the refusal")
    refused = [line for line in node.err.splitlines() if "configure refused" in line]
    assert len(refused) == 1
    assert "node.load_map: " in refused[0] and "give another file, or none" in refused[0]
    assert "Traceback" not in node.err
    node.stop()
    assert [path.name for path in tmp_path.iterdir()] == ["site.npz"]
