# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process of its own, over a real middleware."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.parameter import Parameter as RclpyParameter
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Status
from ba_node.measurements import CameraRig, Keyframe
from ba_node.messages import conversion
from ba_node.messages.factory import stamp_ns_from_message
from ba_node.messages.topics import OUTPUT_TYPES
from ba_node.ros.message_factory import RclpyFactory
from experiments.synthetic import SyntheticData, SyntheticOptions, generate
from tests.ros.harness import NodeProcess, Peer, solve_until_stopped

pytestmark = pytest.mark.dds


StartNode = Callable[..., Any]


MakePeer = Callable[..., Any]


KEYFRAMES = 12


@pytest.fixture(scope="module")
def scene() -> SyntheticData:
    return generate(SyntheticOptions(seed=3, keyframes=KEYFRAMES, length_m=12.0, path="line", outlier_share=0.0))


def _of_camera(keyframe: Keyframe, rig: CameraRig) -> Keyframe:
    """Return a keyframe with the pose of camera 0, which is the body where there is no rig."""
    turn, at = geometry.compose(
        geometry.matrix_from_quaternion(keyframe.orientation),
        keyframe.position,
        geometry.matrix_from_quaternion(rig.orientation[0]),
        rig.position[0],
    )
    return dataclasses.replace(keyframe, position=at, orientation=geometry.quaternion_from_matrix(turn))


def _newest(peer: Any) -> int | None:
    """Return the keyframe of the last report."""
    reports = peer.received["report"]
    return int(reports[-1].newest_keyframe_id) if reports else None


def _in_solve(peer: Any) -> int:
    """Return the number of keyframes that took part in the last solve."""
    reports = peer.received["report"]
    return int(reports[-1].keyframes + reports[-1].fixed_keyframes) if reports else 0


def _play(peer: Any, scene: SyntheticData) -> None:
    """Publish a scene, each keyframe when the one before was solved, and wait until every one came back."""
    peer.publish(scene.rig)
    for keyframe, tracks in zip(scene.keyframes, scene.tracks, strict=True):
        peer.publish(keyframe)
        for image in tracks:
            peer.publish(image, keyframe.stamp_ns)
        peer.until(lambda key=keyframe.keyframe_id: _newest(peer) == key, f"a report on {keyframe.keyframe_id}")
    wanted = {keyframe.keyframe_id for keyframe in scene.keyframes}
    peer.until(lambda: peer.refined_ids() >= wanted, f"keyframes {sorted(wanted)}")


def _burst(peer: Any, scene: SyntheticData) -> None:
    """Publish a scene at once, and wait until every keyframe came back."""
    for _, stamp_ns, measurement in scene.timeline():
        peer.publish(measurement, stamp_ns)
    wanted = {keyframe.keyframe_id for keyframe in scene.keyframes}
    peer.until(lambda: peer.refined_ids() >= wanted, f"keyframes {sorted(wanted)}")


def _position_rms(positions: Any, truth: Any) -> float:
    return float(np.sqrt(np.mean(np.sum((positions - truth) ** 2, axis=1))))


def _rejected(peer: Any) -> dict[str, int]:
    if not peer.received["report"]:
        return {}
    last = peer.received["report"][-1]
    return dict(zip(last.rejected_reason, (int(n) for n in last.rejected_count), strict=True))


@pytest.fixture(scope="class", params=[_play, _burst])
def played(
    domain: int,  # noqa: ARG001
    request: pytest.FixtureRequest,
    scene: SyntheticData,
) -> Iterator[tuple[NodeProcess, Peer]]:
    """Return a node that has solved a scene, and who listens to it."""
    with contextlib.closing(NodeProcess()) as node, contextlib.closing(Peer()) as peer:
        peer.advertise()
        peer.listen()
        peer.connect()
        request.param(peer, scene)
        # In a burst a keyframe may overtake its tracks, which then take part in the next solve.
        peer.until(lambda: _in_solve(peer) == KEYFRAMES, "a solve with all keyframes")
        yield node, peer


class TestPlayed:
    """A node and a peer that go when these tests have seen them: others must not hear their cameras."""

    def test_keyframes_come_back_refined(self, played: tuple[NodeProcess, Peer], scene: SyntheticData) -> None:
        last = played[1].received["refined_keyframes"][-1]
        assert list(last.keyframe_id) == list(range(KEYFRAMES))
        assert last.header.frame_id == "map"
        position = np.asarray(last.position).reshape(-1, 3)
        orientation = np.asarray(last.orientation).reshape(-1, 4)
        np.testing.assert_allclose(np.linalg.norm(orientation, axis=1), 1.0, rtol=1e-9)
        before = _position_rms(scene.odometry.position, scene.truth.position)
        after = _position_rms(position, scene.truth.position)
        assert after < before / 4, f"position error {after:.3f} m after, {before:.3f} m before"

    def test_reports_account_for_every_keyframe(self, played: tuple[NodeProcess, Peer]) -> None:
        reports = played[1].received["report"]
        last = reports[-1]
        assert Status(last.status).usable, last.reason
        assert last.dropped == 0
        assert last.rms_px_after < last.rms_px_before
        assert (last.landmarks > 100, last.observations > 1000) == (True, True)
        counts = [message.solve_count for message in reports]
        assert counts == list(range(1, len(counts) + 1)), "no report is lost"
        assert len(counts) + last.coalesced >= KEYFRAMES, "every keyframe is solved, alone or with others"

    def test_all_outputs_of_a_solve_belong_together(
        self, played: tuple[NodeProcess, Peer], scene: SyntheticData
    ) -> None:
        peer, newest_ns = played[1], scene.keyframes[-1].stamp_ns
        received = peer.received

        def is_there(topic: str) -> bool:
            return bool(received[topic]) and stamp_ns_from_message(received[topic][-1].header.stamp) == newest_ns

        peer.until(lambda: is_there("points") and is_there("path"), "the map after the last solve")
        n_poses = sum(len(message.keyframe_id) for message in received["refined_keyframes"])
        peer.until(lambda: len(received["pose"]) == n_poses, f"{n_poses} poses")
        assert len(received["path"][-1].poses) == KEYFRAMES
        points = received["points"][-1]
        assert [field.name for field in points.fields] == ["x", "y", "z", "rms_px", "views"]
        assert points.width > 100
        assert np.isfinite(np.frombuffer(bytes(points.data), "<f4").reshape(-1, 5)[:, :3]).all()

    def test_who_comes_late_still_gets_the_map(self, played: tuple[NodeProcess, Peer]) -> None:
        with contextlib.closing(Peer()) as late:
            late.listen("points", "path")
            late.until(lambda: late.received["points"] and late.received["path"], "latched points and path")
            peer, width = played[1], late.received["points"][0].width
            # A solve may have followed that the first one has not heard of yet.
            peer.until(lambda: any(map_.width == width for map_ in peer.received["points"]), f"a map of {width} points")

    def test_a_node_that_ends_says_what_it_has_done(self, played: tuple[NodeProcess, Peer]) -> None:
        node, _ = played
        assert node.stop() == 0, node.err
        assert node.out == f"stopped: {KEYFRAMES} keyframes refined\n"


@pytest.mark.slow
def test_bad_input_is_counted_and_nothing_is_lost(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    node, peer = start_node("--ros-args", "-p", "scene.max_pending:=2"), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    factory = RclpyFactory()
    good = scene.tracks[0][0]
    message = conversion.input_message(factory, good, 0, "camera")[1]
    message.u = message.u[:-1]
    short_rig = conversion.input_message(factory, scene.rig, 0)[1]
    short_rig.body_from_camera = []
    nan = np.full(3, np.nan)
    storm = [
        dataclasses.replace(good, uv=np.full_like(good.uv, np.nan)),
        dataclasses.replace(good, camera_index=7),
        *[dataclasses.replace(good, keyframe_id=2**64 - 1 - i) for i in range(5)],
        dataclasses.replace(scene.keyframes[0], keyframe_id=999, position=nan),
        scene.keyframes[0],
        good,
    ]
    # Topics have no order among each other: the rig must be there before the tracks of which only two may wait.
    peer.publish(scene.rig)
    peer.publish(scene.keyframes[0])
    for image in scene.tracks[0]:
        peer.publish(image)
    peer.until(lambda: peer.received["report"], "a report on the first keyframe")
    peer.publishers["camera_rig"].publish(short_rig)
    peer.publishers["feature_tracks"].publish(message)
    for measurement in storm:
        peer.publish(measurement)
    _play(peer, scene)
    expected = {
        "bad_pose": 1,
        "bad_rig": 1,
        "duplicate_keyframe": 2,
        # From the storm, and from the scene that is played as a whole after its first keyframe was sent.
        "duplicate_observation": len(good.track_id) + sum(len(image.track_id) for image in scene.tracks[0]),
        "malformed": 1,
        "non_finite": len(good.track_id),
        "unknown_camera": 1,
        "unknown_keyframe": 3,
    }
    peer.until(lambda: _newest(peer) == KEYFRAMES - 1, "the last report")
    assert _rejected(peer) == expected
    assert node.alive
    assert node.stop() == 0
    for words in ("unknown_camera = 1", "keyframe 999", "body_from_camera 0"):
        assert words in node.err, node.err


@pytest.mark.slow
def test_an_unknown_distortion_model_is_named(start_node: StartNode, make_peer: MakePeer, scene: SyntheticData) -> None:
    node, peer = start_node(), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    peer.publish(dataclasses.replace(scene.rig, models=("my_lens", "my_lens")))
    peer.until(lambda: "my_lens" in node.err, "a warning that names the model")
    _play(peer, scene)
    assert _rejected(peer)["unknown_model"] == 1
    assert "plumb_bob" in node.err, "what is supported is said too"


@pytest.mark.parametrize("profile", [10, qos_profile_sensor_data], ids=["volatile", "best_effort"])
def test_a_camera_driver_is_heard(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData, profile: Any
) -> None:
    """Drivers publish camera_info unlatched with every image."""
    del scene
    mono = generate(SyntheticOptions(seed=4, keyframes=4, length_m=10.0, path="line", baseline_m=0.0, tracks=100))
    start_node()
    peer = make_peer()
    peer.advertise()
    del peer.publishers["camera_rig"]
    peer.listen("refined_keyframes", "report")
    camera = peer.node.create_publisher(CameraInfo, "camera_info", profile)
    peer.publishers["camera_info"] = camera
    peer.connect()
    info = conversion.input_message(RclpyFactory(), mono.rig, 0)[1].cameras[0]
    timer = peer.node.create_timer(0.03, lambda: camera.publish(info))
    for _, stamp_ns, measurement in list(mono.timeline())[1:]:
        peer.publish(_of_camera(measurement, mono.rig) if isinstance(measurement, Keyframe) else measurement, stamp_ns)
    wanted = {keyframe.keyframe_id for keyframe in mono.keyframes}
    peer.until(lambda: peer.refined_ids() >= wanted, f"keyframes {sorted(wanted)}")
    peer.node.destroy_timer(timer)
    assert "rig_changed" not in _rejected(peer)


def _set(peer: Any, name: str, value: Any) -> Any:
    parameter: ParameterMessage = RclpyParameter(name, value=value).to_parameter_msg()
    request = SetParameters.Request(parameters=[parameter])
    return peer.call(SetParameters, "ba_node/set_parameters", request).results[0]


@pytest.mark.slow
def test_parameters_over_services(start_node: StartNode, make_peer: MakePeer, scene: SyntheticData) -> None:
    start_node()
    peer = make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    names = list(Config().values())
    values = peer.call(GetParameters, "ba_node/get_parameters", GetParameters.Request(names=names)).values
    assert len(values) == len(names)
    request = DescribeParameters.Request(names=["window.max_keyframes"])
    (descriptor,) = peer.call(DescribeParameters, "ba_node/describe_parameters", request).descriptors
    assert (descriptor.integer_range[0].from_value, descriptor.integer_range[0].to_value) == (2, 100_000)

    refused = _set(peer, "solver.method", "magic")
    assert not refused.successful
    assert "parameter solver.method = 'magic': choose one of auto, " in refused.reason
    assert not _set(peer, "window.max_keyframes", 1).successful
    assert not _set(peer, "node.inbox_size", 100).successful
    senseless = SetParameters.Request(parameters=[ParameterMessage(name="solver.loss", value=ParameterValue(type=42))])
    peer.send(SetParameters, "ba_node/set_parameters", senseless)
    assert _set(peer, "solver.loss_scale_px", 2).successful, "an int is taken for a double"
    # Windows alone: without the whole map, which would be refined as it grows.
    for name, value in (("window.max_keyframes", 3), ("window.max_fixed_keyframes", 0), ("factors.adjust_m", 0.0)):
        result = _set(peer, name, value)
        assert result.successful, result.reason
    _play(peer, scene)
    assert _in_solve(peer) == 3, "the window has the size that was set"


@pytest.mark.slow
def test_starts_with_a_file_and_a_namespace(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData, tmp_path: Any
) -> None:
    file = tmp_path / "params.yaml"
    file.write_text(
        "/**:\n  ros__parameters:\n    window:\n      max_keyframes: 4\n    solver:\n      loss_scale_px: 2\n"
        "    factors:\n      adjust_m: 0.0\n"
    )
    arguments = ["--ros-args", "-r", "__ns:=/car", "--params-file", str(file), "-p", "window.max_fixed_keyframes:=0"]
    node, peer, stranger = start_node(*arguments), make_peer(namespace="car"), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    _play(peer, scene)
    assert _in_solve(peer) == 4
    stranger.until(lambda: ("ba_node", "/car") in stranger.node.get_node_names_and_namespaces(), "the node's name")
    expected = {f"/car/ba_node/{topic}": [kind] for topic, kind in OUTPUT_TYPES.items()}
    types: dict[str, list[str]] = {}

    def all_known() -> bool:
        types.update(stranger.node.get_publisher_names_and_types_by_node("ba_node", "/car"))
        types.update(stranger.node.get_subscriber_names_and_types_by_node("ba_node", "/car"))
        return types.keys() >= {*expected, "/car/keyframes"}

    stranger.until(all_known, "every topic")
    assert {name: types[name] for name in expected} == expected
    assert not [topic for topic in types if topic.startswith(("/ba_node", "/keyframes"))]
    assert node.stop(signal.SIGTERM) == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_during_a_solve(start_node: StartNode, make_peer: MakePeer, number: int) -> None:
    node, peer = start_node(prepare=solve_until_stopped), make_peer()
    peer.advertise()
    peer.connect()
    peer.publish(Keyframe(0, 1, 1, "odom", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])))
    peer.until(lambda: "solving" in node.out, "the solve to begin")
    # The solve goes on until it is stopped: that the node ends at all is the proof.
    assert node.stop(number) == 0, node.err
    assert node.out.endswith("stopped: 0 keyframes refined\n")
    assert "Traceback" not in node.err


def fail_in_the_second_solve() -> None:
    backend: Any = Backend
    solve, calls = Backend.solve, []

    def sometimes(self: Any, on_iteration: Any, on_poses: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise RuntimeError("a fault nobody thought of")
        return solve(self, on_iteration, on_poses)

    backend.solve = sometimes


@pytest.mark.slow
def test_a_fault_in_a_solve_does_not_end_the_node(
    start_node: StartNode, make_peer: MakePeer, scene: SyntheticData
) -> None:
    node, peer = start_node(prepare=fail_in_the_second_solve), make_peer()
    peer.advertise()
    peer.listen("report", "refined_keyframes")
    peer.connect()
    for image in scene.tracks[0]:
        peer.publish(image)
    peer.publish(scene.rig)
    peer.publish(scene.keyframes[0])
    peer.until(lambda: peer.received["report"], "a report on the first keyframe")
    peer.publish(scene.keyframes[1])
    for image in scene.tracks[1]:
        peer.publish(image)
    peer.until(lambda: "nobody thought of" in node.err, "the fault")
    _burst(peer, scene)
    assert "RuntimeError: a fault nobody thought of" in node.err
    peer.until(lambda: _rejected(peer).get("internal_error") == 1, "a report that counts the fault")
    assert node.stop() == 0
