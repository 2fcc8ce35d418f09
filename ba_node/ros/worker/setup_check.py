# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Check set-ups on a thread of its own, so that no keyframe waits for it. Nothing here calls ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ba_node.check.diagnosis import Diagnosis
    from ba_node.ros.worker.inbox import Inbox
    from ba_node.scene.scene import Scene


def on_a_thread(inbox: Inbox) -> Callable[[Scene, Callable[[], Diagnosis]], None]:
    """Return what does the work of a check elsewhere; its result comes to the solver's thread as a command."""

    def begin(scene: Scene, work: Callable[[], Diagnosis]) -> None:
        def run() -> None:
            found = work()
            inbox.post(lambda backend: backend.take_check(scene, found))

        # Not a daemon: Python must not end while the kernels run.
        threading.Thread(target=run, name="setup_check", daemon=False).start()

    return begin
