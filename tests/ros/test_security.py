# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy, compared with what the running node has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.dds

POLICY = Path(__file__).resolve().parents[2] / "config" / "sros2" / "ba_node.policy.xml"
# Used with some parameters only.
OPTIONAL = {"/clock", "/tf_static"}


def _allowed(kind: str, how: str) -> set[str]:
    """Return the names that the policy allows, resolved as for a node without a namespace."""
    (profile,) = ElementTree.parse(POLICY).getroot().iter("profile")
    assert (profile.get("ns"), profile.get("node")) == ("/", "ba_node")
    found = [name.text or "" for block in profile.iter(kind) if block.get(how) == "ALLOW" for name in block]
    assert found and len(found) == len(set(found))
    return {name.replace("~", "/ba_node") if name[0] in "~/" else f"/{name}" for name in found}


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
        assert names(of) <= may, f"{of}: not in {POLICY.name}: {sorted(names(of) - may)}"
    # Those of nodes in other namespaces that still end are not its own.
    services = look.get_service_names_and_types_by_node("ba_node", "/")
    served = {name.split("/_action/")[0] for name, _ in services if "/_action/" in name}
    assert served == _allowed("actions", "execute")
