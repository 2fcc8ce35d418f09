# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run one target until it has taken so many messages or files; guided by coverage where atheris is installed.

An input that raises is kept as OUT/crash-*, one that takes more than 10 s of the processor as OUT/current, one that
makes the process larger than 1 GB as OUT/oom-*; each ends the process with a code other than 0.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

TIMEOUT_S, LIMIT_MB = 10, 1024
GUIDED = importlib.util.find_spec("atheris") is not None
_ROUND = 500


def main() -> int:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("--count", type=int, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    (_guided if GUIDED else _drawn)(args)
    return 0


def _until(run: Callable[[str, bytes], int], args: argparse.Namespace) -> Callable[[bytes], None]:
    """Return what runs a target and ends the process when it has taken enough, or with the first fault."""
    taken = runs = 0
    current = args.out / "current"

    def one(data: bytes) -> None:
        nonlocal taken, runs
        current.write_bytes(data)
        # Of processor time, as another process may keep this one waiting; the signal ends it, in native code too.
        signal.setitimer(signal.ITIMER_PROF, TIMEOUT_S)
        try:
            taken += run(args.name, data)
        except BaseException:
            kept = args.out / f"crash-{hashlib.sha1(data).hexdigest()}"
            kept.write_bytes(data)
            traceback.print_exc()
            print(f"\n\nkept as {kept}", file=sys.stderr, flush=True)
            os._exit(1)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        runs += 1
        if taken >= args.count:
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(f"{taken} {runs} {peak_mb}", flush=True)
            os._exit(0)

    return one


def _guided(args: argparse.Namespace) -> None:
    import atheris  # noqa: PLC0415

    # What is imported in this block counts its branches.
    with atheris.instrument_imports(include=["ba_node"]):
        from tests.fuzz import targets  # noqa: PLC0415
    corpus = args.out / "corpus"
    corpus.mkdir(exist_ok=True)
    for data in targets.seeds()[args.name]:
        (corpus / hashlib.sha1(data).hexdigest()).write_bytes(data)
    options = {
        "seed": args.seed,
        # For what waits for ever; the limit of what works is of processor time, above.
        "timeout": 30 * TIMEOUT_S,
        "rss_limit_mb": LIMIT_MB,
        "max_len": 200_000,
        "verbosity": 0,
        "artifact_prefix": f"{args.out}/",
    }
    given = [f"-{key}={value}" for key, value in options.items()]
    atheris.Setup([sys.argv[0], *given, str(corpus)], _until(targets.run, args))
    atheris.Fuzz()


def _drawn(args: argparse.Namespace) -> None:
    from hypothesis import HealthCheck, Phase, given, seed, settings  # noqa: PLC0415

    from tests.fuzz import targets  # noqa: PLC0415
    from tests.fuzz.mutation import mutated  # noqa: PLC0415

    one = _until(targets.run, args)
    options: dict[str, Any] = {
        "max_examples": _ROUND,
        "deadline": None,
        "database": None,
        "phases": (Phase.generate,),
        "suppress_health_check": list(HealthCheck),
    }

    def run(data: bytes) -> None:
        one(data)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        assert peak_mb < LIMIT_MB, f"{peak_mb} MB"

    for turn in range(args.seed, sys.maxsize):
        seed(turn)(settings(**options)(given(mutated(args.name))(run)))()


if __name__ == "__main__":
    sys.exit(main())
