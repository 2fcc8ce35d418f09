# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Start programs quickly: a process that has imported the node, and forks for each that a test starts.

Python and ROS take seconds to import. What is forked is a process like any other, with signals, exit code and output of
its own. A function of a test can prepare it, where a test wants a fault or a slow solver in it.
"""

from __future__ import annotations

import array
import faulthandler
import functools
import importlib
import json
import os
import selectors
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
# A request is one message of a socket that keeps messages apart.
_MAX_REQUEST = 2**20


def name_of(function: Callable[..., Any]) -> str:
    """Return where a function stands, as ``folder/file.py:name`` or ``module:name``."""
    code = function.__code__
    return f"{code.co_filename}:{function.__name__}"


def resolve(name: str) -> Callable[..., Any]:
    """Return the function of a name."""
    place, _, function = name.rpartition(":")
    if place.endswith(".py"):
        place = ".".join(Path(place).resolve().relative_to(ROOT).with_suffix("").parts)
    found: Callable[..., Any] = getattr(importlib.import_module(place), function)
    return found


def _run(request: dict[str, Any]) -> None:
    """Be the program, in the forked process; ends it."""
    os.environ.clear()
    os.environ.update(request["environ"])
    sys.argv = ["ba_node", *request["arguments"]]
    if request["prepare"]:
        resolve(request["prepare"])(**request["options"])
    raise SystemExit(resolve(request["program"])())


def serve(listener: socket.socket) -> None:
    """Fork until the other side of the listener goes."""
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    while True:
        for key, _ in selector.select():
            if key.fileobj is listener:
                data, descriptors, _, _ = socket.recv_fds(listener, _MAX_REQUEST, 3)
                if not data:
                    return
                answer = socket.socket(fileno=descriptors[2])
                child = os.fork()
                if child == 0:
                    selector.close()
                    listener.close()
                    for number, descriptor in zip((1, 2), descriptors, strict=False):
                        os.dup2(descriptor, number)
                    for descriptor in descriptors[:2]:
                        os.close(descriptor)
                    answer.close()
                    _run(json.loads(data))
                for descriptor in descriptors[:2]:
                    os.close(descriptor)
                answer.sendall(array.array("i", [child]).tobytes())
                selector.register(os.pidfd_open(child), selectors.EVENT_READ, functools.partial(_end, child, answer))
            else:
                selector.unregister(key.fileobj)
                key.data()
                os.close(key.fd)


def _end(child: int, answer: socket.socket) -> None:
    """Tell the code of a program that has ended."""
    _, status = os.waitpid(child, 0)
    answer.sendall(array.array("i", [os.waitstatus_to_exitcode(status)]).tobytes())
    answer.close()


if __name__ == "__main__":
    faulthandler.enable()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for module in ("ba_node.ros.main", "ba_node.ros.tools.adapter", "tests.ros.harness"):
        importlib.import_module(module)
    # All else that is imported when the node is configured.
    from ba_node.messages.topics import TOPICS
    from ba_node.ros.message_factory import message_class

    for topic in TOPICS.values():
        message_class(topic.type_name)
    serve(socket.socket(fileno=int(sys.argv[1])))
