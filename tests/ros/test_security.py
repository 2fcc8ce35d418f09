# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy, compared with what the running node has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from ba_node.ros import qos
from ba_node.ros.message_factory import message_class

pytestmark = pytest.mark.dds

POLICIES = Path(__file__).resolve().parents[2] / "config" / "sros2"
# Used with some parameters only.
OPTIONAL = {"/clock", "/tf_static"}


def _allowed(kind: str, how: str, node: str = "ba_node") -> set[str]:
    """Return the names that the policy of a node allows, resolved as for one without a namespace."""
    (profile,) = ElementTree.parse(POLICIES / f"{node}.policy.xml").getroot().iter("profile")
    assert (profile.get("ns"), profile.get("node")) == ("/", node)
    found = [name.text or "" for block in profile.iter(kind) if block.get(how) == "ALLOW" for name in block]
    assert found and len(found) == len(set(found))
    return {name.replace("~", f"/{node}") if name[0] in "~/" else f"/{name}" for name in found}


@pytest.mark.slow
def test_the_policy_allows_what_the_node_has_and_no_more(
    start_node: Callable[..., Any], make_peer: Callable[..., Any]
) -> None:
    start_node()
    peer = make_peer()
    peer.listen("report")
    peer.advertise()
    peer.connect()
    look = peer.node
    peer.until(lambda: ("ba_node", "/") in look.get_node_names_and_namespaces(), "the name of the node")

    def names(of: str) -> set[str]:
        found = getattr(look, f"get_{of}_names_and_types_by_node")("ba_node", "/")
        return {name for name, _ in found if "/_action/" not in name}

    allowed = {
        "publisher": _allowed("topics", "publish"),
        "subscriber": _allowed("topics", "subscribe"),
        "service": _allowed("services", "reply"),
        "client": set(),
    }
    for of, may in allowed.items():
        peer.until(lambda of=of, may=may: names(of) >= may - OPTIONAL, f"every {of}")
        assert names(of) <= may, f"{of}: not in its policy: {sorted(names(of) - may)}"

    # Those of nodes in other namespaces that still end are not its own.
    def served() -> set[str]:
        services = look.get_service_names_and_types_by_node("ba_node", "/")
        return {name.split("/_action/")[0] for name, _ in services if "/_action/" in name}

    actions = _allowed("actions", "execute")
    peer.until(lambda: served() >= actions, "every action")
    assert served() == actions


@pytest.mark.slow
@pytest.mark.parametrize(
    ("node", "program", "arguments", "topics"),
    [
        (
            "ba_front_end",
            "ba_node.ros.front_end.main:main",
            ("--ros-args", "-p", "odometry:=topic", "-p", "mask_topic:=true"),
            {"left/image_raw": "Image", "right/image_raw/compressed": "CompressedImage", "mask": "Image"},
        ),
        (
            "ba_adapter",
            "ba_node.ros.tools.adapter:main",
            ("--from", "vins_mono"),
            {"feature": "PointCloud", "camera_info": "CameraInfo"},
        ),
    ],
)
def test_the_policies_of_front_ends_allow_what_they_have(
    node: str,
    program: str,
    arguments: tuple[str, ...],
    topics: dict[str, str],
    start_node: Callable[..., Any],
    make_peer: Callable[..., Any],
) -> None:
    """Whatever is there to subscribe to; other modes and sources are allowed too."""
    if node == "ba_front_end":
        pytest.importorskip("poselib", reason="needs poselib: pip install ba_node[front_end]")
    running = start_node(*arguments, program=program)
    peer = make_peer()
    for topic, kind in topics.items():
        made = peer.node.create_publisher(message_class(f"sensor_msgs/msg/{kind}"), topic, qos.reliable(10))
        peer.publishers[topic] = made
    peer.until(lambda: all(p.get_subscription_count() for p in peer.publishers.values()), "subscriptions")

    def names(of: str) -> set[str]:
        return {name for name, _ in getattr(peer.node, f"get_{of}_names_and_types_by_node")(node, "/")}

    expected = {
        "publisher": _allowed("topics", "publish", node),
        "service": _allowed("services", "reply", node),
    }
    for of, may in expected.items():
        peer.until(lambda of=of, may=may: names(of) == may, f"every {of}")
    # A node tells its graph of its endpoints after these have found each other.
    peer.until(lambda: names("subscriber") >= {f"/{topic}" for topic in topics}, "every subscriber")
    taken = names("subscriber")
    assert taken <= _allowed("topics", "subscribe", node), taken - _allowed("topics", "subscribe", node)
    assert running.stop() == 0
