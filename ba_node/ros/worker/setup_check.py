# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check set-ups on a thread of its own, so that no keyframe waits for it. Nothing here calls ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ba_node.backend import Check
    from ba_node.ros.worker.inbox import Inbox


def on_a_thread(inbox: Inbox) -> Callable[[Check], None]:
    """Return what runs a check elsewhere; its result comes to the solver's thread as a command."""

    def begin(check: Check) -> None:
        def run() -> None:
            check.run()
            inbox.post(lambda backend: backend.take_check(check))

        # Not a daemon: Python must not end while the kernels run.
        threading.Thread(target=run, name="setup_check", daemon=False).start()

    return begin
