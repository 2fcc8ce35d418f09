# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""`ba view`, with foxglove-sdk's server and a client of its own."""

from __future__ import annotations

import asyncio
import json
import struct
import threading
from pathlib import Path
from typing import Any

import pytest

from ba_node.cli.main import main
from ba_node.io.bag_reader import BagReader
from ba_node.io.parameters import NODE_NAME
from ba_node.offline.recording import record
from ba_node.offline.view import ViewError, ViewOptions, serve, view
from experiments.synthetic import SyntheticOptions, generate

pytest.importorskip("foxglove", reason="needs foxglove-sdk")
websocket = pytest.importorskip("tornado.websocket", reason="needs tornado")
_MESSAGE = 1


async def listen(address: str, wanted: int) -> tuple[dict[str, dict[str, Any]], dict[str, list[bytes]]]:
    """Subscribe to all channels; return these by topic, and so many messages."""
    client = await websocket.websocket_connect(address, subprotocols=["foxglove.sdk.v1"])
    channels: dict[str, dict[str, Any]] = {}
    topics: dict[int, str] = {}
    got: dict[str, list[bytes]] = {}
    while sum(map(len, got.values())) < wanted:
        received = await asyncio.wait_for(client.read_message(), 30.0)
        assert received is not None
        if isinstance(received, str):
            told = json.loads(received)
            if told["op"] != "advertise":
                continue
            for channel in told["channels"]:
                number = channel["id"]
                channels[channel["topic"]], topics[number] = channel, channel["topic"]
                ask = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": number}]}
                await client.write_message(json.dumps(ask))
        elif received[0] == _MESSAGE:
            number, _ = struct.unpack_from("<IQ", received, 1)
            got.setdefault(topics[number], []).append(received[13:])
    client.close()
    return channels, got


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a recording and the folder of its replay."""
    folder = tmp_path_factory.mktemp("view")
    data = generate(SyntheticOptions(seed=5, keyframes=5, length_m=10.0, path="line", tracks=50))
    record(folder / "in.mcap", data.timeline())
    assert main(["replay", str(folder / "in.mcap"), "--out", str(folder / "out"), "--no-report"]) == 0
    return folder / "in.mcap", folder / "out"


@pytest.mark.slow
def test_a_client_of_foxglove_gets_the_messages_with_their_definitions(results: tuple[Path, Path]) -> None:
    addresses: list[str] = []
    ready = threading.Event()

    def tell(address: str) -> None:
        addresses.append(address)
        ready.set()

    bag, out = results
    # Rounds enough for a client to come in the middle.
    options = ViewOptions(port=0, rate=20.0, rounds=40)
    thread = threading.Thread(target=view, args=([bag, out], options, tell), daemon=True)
    thread.start()
    assert ready.wait(30.0)
    channels, got = asyncio.run(listen(addresses[0], 60))
    with BagReader(bag) as before, BagReader(out / "refined.mcap") as after:
        assert set(channels) == set(before.topics) | set(after.topics)
        for reader in (before, after):
            sent: dict[str, set[bytes]] = {}
            for channel, _, data in reader.raw():
                sent.setdefault(channel.topic, set()).add(data)
                shown = channels[channel.topic]
                assert (shown["encoding"], shown["schemaName"]) == ("cdr", channel.type_name)
                assert (shown["schemaEncoding"], shown["schema"]) == ("ros2msg", channel.definition)
            for topic in reader.topics:
                assert set(got.get(topic, [])) <= sent[topic]
    assert {"/keyframes", f"/{NODE_NAME}/points", f"/{NODE_NAME}/path"} <= set(got)
    thread.join(60.0)


def test_a_port_that_cannot_be_is_said(results: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(results[1]), "--port", "80000"]) == 2
    assert "--port 80000: expected 0 to 65535" in capsys.readouterr().err


def test_a_port_that_is_taken_is_said(results: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    with serve(ViewOptions(port=0)) as (_, address):
        port = address.rpartition(":")[2]
        with pytest.raises(ViewError, match=f"port {port}: "), serve(ViewOptions(port=int(port))):
            pass
    assert main(["view", str(results[1]), "--port", "0", "--rate", "0", "--rounds", "2"]) == 0
    with BagReader(results[1] / "refined.mcap") as reader:
        assert f"{2 * reader.message_count} messages sent" in capsys.readouterr().out
    assert main(["view", str(results[1]), "--rate", "-1"]) == 2
    assert "expected 0 or more" in capsys.readouterr().err
