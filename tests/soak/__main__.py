# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run back-end and node for long: memory and time a keyframe are bounded, and do not grow.

Exit code 1 if something grows from the middle of a run to its end.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence

from tests.soak import runs
from tests.soak.drive import Drive
from tests.soak.measure import Part, growth

_PARTS = 10


def main(argv: Sequence[str] | None = None) -> int:
    """Run all."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--keyframes", type=int, default=40_000, help="of the back-end (40000)")
    parser.add_argument("--node-keyframes", type=int, default=10_000, help="of the node, 0 for none (10000)")
    args = parser.parse_args(argv)
    failed = []
    for name, drive, count in (
        ("back-end, sessions of 4 rounds", Drive(tracks=150), args.keyframes),
        ("back-end, one session", Drive(tracks=150, session_rounds=0), args.keyframes),
        ("back-end, standing still", Drive(tracks=150, session_rounds=0, still=True), args.keyframes // 4),
    ):
        failed += _show(name, runs.backend(drive, count, count // _PARTS), timed=not drive.still)
    if args.node_keyframes:
        failed += _node(args.node_keyframes)
    print("\n".join(failed) if failed else "nothing grows")
    return 1 if failed else 0


def _show(name: str, parts: Iterator[Part], timed: bool) -> list[str]:
    print(f"{name}:", flush=True)
    seen = []
    for part in parts:
        print(part.row(), flush=True)
        seen.append(part)
    return [f"{name}: {what}" for what in growth(seen, timed)]


def _node(count: int) -> list[str]:
    from experiments.demo.domain import free_domain, isolation  # noqa: PLC0415
    from tests.ros.harness import NodeProcess, Peer  # noqa: PLC0415

    os.environ.update(isolation(free_domain()))
    process, peer = NodeProcess(), Peer()
    try:
        peer.advertise()
        peer.listen()
        peer.connect()
        return _show("node", runs.node(process, peer, Drive(tracks=150), count, count // _PARTS), timed=True)
    finally:
        peer.close()
        process.close()


if __name__ == "__main__":
    sys.exit(main())
