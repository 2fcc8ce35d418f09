# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give readers and back-end broken input: the long form of tests/fuzz.

Each target runs in a process of its own. No input may raise anything but an error of this package that speaks of its
input, take more than 10 s, or more than 1 GB. What does is kept in OUT/TARGET/crash-* (or timeout-*, oom-*); run it
again with --repeat FILE --only TARGET.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz import targets
from tests.fuzz.worker import GUIDED


def main(argv: Sequence[str] | None = None) -> int:
    """Fuzz every target."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--messages", type=int, default=200_000, help="messages in all (default: 200000)")
    parser.add_argument("--files", type=int, default=50_000, help="files in all (default: 50000)")
    parser.add_argument("--only", nargs="+", choices=targets.NAMES, default=targets.NAMES, metavar="TARGET")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--repeat", type=Path, metavar="FILE", help="run the targets on one file")
    args = parser.parse_args(argv)
    if args.repeat:
        for name in args.only:
            targets.run(name, args.repeat.read_bytes())
        return 0
    print(
        "guided by coverage (atheris)"
        if GUIDED
        else "drawn by hypothesis; for guidance by coverage: .venv/bin/pip install -r tests/fuzz/requirements.txt",
        flush=True,
    )
    failed = [name for name in args.only if not _fuzz(name, args)]
    print(f"faults in: {', '.join(failed)}" if failed else "no fault")
    return 1 if failed else 0


def _fuzz(name: str, args: argparse.Namespace) -> bool:
    of_streams = name in targets.STREAMS
    names = [other for other in args.only if (other in targets.STREAMS) == of_streams]
    count = -(-(args.messages if of_streams else args.files) // len(names))
    what = "messages" if of_streams else "files"
    print(f"{name:12} {count:7} {what} ...", end=" ", flush=True)
    out = args.out / name
    began = time.monotonic()
    command = [sys.executable, "-m", "tests.fuzz.worker", name, "--count", str(count), "--out", str(out)]
    result = subprocess.run(
        [*command, "--seed", str(args.seed)], capture_output=True, text=True, errors="replace", check=False
    )
    took = time.monotonic() - began
    if result.returncode == 0:
        _, runs, peak_mb = result.stdout.split()[-3:]
        print(f"{runs} runs, {took:.0f} s, at most {peak_mb} MB", flush=True)
        return True
    (out / "log.txt").write_text(result.stdout + result.stderr)
    tail = [line for line in result.stderr.splitlines() if line.strip()][-12:]
    print(f"FAULT after {took:.0f} s (code {result.returncode}); see {out}", *tail, sep="\n    ", flush=True)
    return False


if __name__ == "__main__":
    sys.exit(main())
