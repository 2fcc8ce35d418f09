# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Give readers and back-end broken input: the long form of tests/fuzz.

Each target runs in a process of its own. No input may raise anything but an error of this package that speaks of its
input, take more than 10 s, or more than 1 GB. What does is kept in OUT/TARGET/crash-* (or current, oom-*); run it again
with --repeat FILE --only TARGET.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz import files, targets
from tests.fuzz.worker import GUIDED

# Quarters of the messages that each target takes.
_SHARE = {"stream": 2, "drive": 1, "cdr": 1}
# A process ends after so many and the next goes on from its corpus: the fuzzer itself grows by some kB a run.
_ROUND = 20_000


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
    what = "messages" if of_streams else "files"
    count = -(-args.messages * _SHARE[name] // 4) if of_streams else -(-args.files // len(files.READERS))
    print(f"{name:12} {count:7} {what} ...", end=" ", flush=True)
    began, done, runs, peak_mb = time.monotonic(), 0, 0, 0
    while done < count:
        result = _round(name, min(_ROUND, count - done), args.out / name, args.seed + done)
        if result.returncode != 0:
            text = result.stdout + result.stderr
            trace = text[text.rfind("Traceback") :].split("\n\n")[0] if "Traceback" in text else text[-1000:]
            head = f"FAULT after {time.monotonic() - began:.0f} s (code {result.returncode}); see {args.out / name}"
            print(head, *trace.splitlines()[-8:], sep="\n    ", flush=True)
            return False
        taken, of_round, peak = (int(word) for word in result.stdout.split()[-3:])
        done, runs, peak_mb = done + taken, runs + of_round, max(peak_mb, peak)
    print(f"{runs} runs, {time.monotonic() - began:.0f} s, at most {peak_mb} MB", flush=True)
    return True


def _round(name: str, count: int, out: Path, seed: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tests.fuzz.worker", name, "--count", str(count), "--seed", str(seed)]
    return subprocess.run([*command, "--out", str(out)], capture_output=True, text=True, errors="replace", check=False)


if __name__ == "__main__":
    sys.exit(main())
