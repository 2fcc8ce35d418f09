# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare errors with covariances over many runs: ``python -m experiments.consistency --runs 200``.

Each run is a line in OUT/nees.jsonl, written as soon as it is known: what is there already is not run again. The table
at the end goes to OUT/nees.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.consistency.runs import CASES, Case, Nees, interval, run

_HEAD = "| sensor | loss | sigma_px claimed | newest keyframe | middle of the path | last window | points |"


def main(argv: Sequence[str] | None = None) -> int:
    """Run what is missing and write the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.consistency", description=__doc__)
    parser.add_argument("--runs", type=int, default=200, help="runs of each case (default: 200)")
    parser.add_argument("--only", default="", help="cases whose name holds this, for example stereo_cauchy")
    parser.add_argument("--out", type=Path, default=Path("out/consistency"), help="folder for the results")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    cases = [case for case in CASES if args.only in case.name]
    results = _read(args.out / "nees.jsonl")
    with (args.out / "nees.jsonl").open("a", encoding="utf-8") as file:
        for seed in range(args.runs):
            for case in cases:
                if (case.name, seed) not in results:
                    results[case.name, seed] = run(case, seed)
                    line = {"case": case.name, "seed": seed, **dataclasses.asdict(results[case.name, seed])}
                    file.write(json.dumps(line) + "\n")
                    file.flush()
    table = _table(cases, results, args.runs)
    (args.out / "nees.md").write_text(table, encoding="utf-8")
    print(table)
    return 0


def _read(path: Path) -> dict[tuple[str, int], Nees]:
    if not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    names = [field.name for field in dataclasses.fields(Nees)]
    return {(line["case"], line["seed"]): Nees(*(line[name] for name in names)) for line in lines}


def _table(cases: Sequence[Case], results: dict[tuple[str, int], Nees], runs: int) -> str:
    low, high = interval(runs, 6)
    lines = [f"Mean NEES over {runs} runs; 95 % interval of 6 degrees of freedom: {low:.2f} to {high:.2f}.", "", _HEAD]
    lines.append("|" + "---|" * (_HEAD.count("|") - 1))
    for case in cases:
        of = np.array([dataclasses.astuple(results[case.name, seed]) for seed in range(runs)])
        means = " | ".join(f"{mean:.2f}" for mean in np.nanmean(of, axis=0))
        slides = "" if case.old_keyframes == "fix" else f", {case.old_keyframes}"
        lines.append(f"| {case.sensor}{slides} | {case.loss} | {case.claim:g} x | {means} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
