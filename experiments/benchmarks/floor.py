# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The least time of an iteration on this machine: its flops at the measured peak, its bytes at the measured bandwidth.

Counted for one exact damped Newton step with dense S (schur.py), n = size x free cameras, N observations of which N_f
by free cameras, k_p of those of point p:

- linearise: residual and Jacobian 120 flops an observation; 2 x 2 x (d (d + 1) / 2 + 3 d + 6 + d + 3) for B, E, C, g;
- eliminate: 60 a point, 18 d an observation for Z = E L^-T, 6 d^2 for each pair of a point's k_p (k_p + 1) / 2;
- solve: n^3 / 3 + 2 n^2; substitute back: 12 d an observation;
- judge: 60 an observation.

Bytes: each observation is read (24), its E (24 d) is written once and read twice, S (8 n^2) is written and read.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ba_node import native
from experiments.benchmarks.problem_file import Case
from experiments.benchmarks.solvers import ROOT

_SIZE = 1024
_COPIED = 64_000_000
# Above this many unknowns S is not dense, and the count does not hold.
_MAX_DENSE = 3000


@dataclass(frozen=True)
class Peak:
    """What one core does: double-precision flops (1e9 / s) in a matrix product, and bytes (1e9 / s) in a copy."""

    gflops: float
    gbytes_s: float


def flops(case: Case) -> dict[str, float]:
    """Return the flops of one iteration by part: linearise, eliminate, solve, judge; NaN where S would not be dense."""
    bal, d = case.bal, case.size
    n = d * (len(bal.cameras) - case.n_fixed)
    n_obs = len(bal.observations)
    free = bal.camera_index >= case.n_fixed
    seen = np.bincount(bal.point_index[free], minlength=len(bal.points)).astype(float)
    n_free_obs = float(free.sum())
    pairs = float(np.sum(seen * (seen + 1.0) / 2.0))
    return {
        "linearise": 156.0 * n_obs + 4.0 * n_free_obs * (d * (d + 1) / 2.0 + 4.0 * d),
        "eliminate": 60.0 * len(bal.points) + 18.0 * d * n_free_obs + 6.0 * d * d * pairs,
        "solve": n**3 / 3.0 + 2.0 * n * n if n <= _MAX_DENSE else np.nan,
        "judge": 60.0 * n_obs + 12.0 * d * n_free_obs,
    }


def work(case: Case) -> tuple[float, float]:
    """Return flops and bytes of one iteration; NaN where S would not be dense."""
    bal, d = case.bal, case.size
    n = d * (len(bal.cameras) - case.n_fixed)
    n_free_obs = float((bal.camera_index >= case.n_fixed).sum())
    return sum(flops(case).values()), 24.0 * len(bal.observations) + 72.0 * d * n_free_obs + 16.0 * n * n


def floor_s(case: Case, peak: Peak) -> float:
    """Return the least time of an iteration, s."""
    flops, size = work(case)
    return max(flops / (1e9 * peak.gflops), size / (1e9 * peak.gbytes_s))


def measure() -> Peak:
    """Measure one core, in a process of its own, as the number of threads is fixed when numpy is loaded.

    Where our kernels use AVX-512, so that the product uses it too: OpenBLAS takes AVX2 on processors newer than itself.
    """
    wide = native.kernels is not None and native.kernels.target() == "avx512"
    found = [_measured(kind) for kind in ([{}, {"OPENBLAS_CORETYPE": "SkylakeX"}] if wide else [{}])]
    return max(found, key=lambda peak: peak.gflops)


def _measured(environment: dict[str, str]) -> Peak:
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    command = [sys.executable, "-m", "experiments.benchmarks.floor"]
    whole = {**os.environ, **one, **environment}
    done = subprocess.run(command, cwd=ROOT, env=whole, capture_output=True, text=True, check=True)
    return Peak(**json.loads(done.stdout))


def _best_s(work_once: Callable[[], object], repeats: int = 7) -> float:
    best = np.inf
    for _ in range(repeats):
        began = time.perf_counter()
        work_once()
        best = min(best, time.perf_counter() - began)
    return best


def _main() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, _SIZE, _SIZE))
    source, target = np.ones(_COPIED // 8), np.empty(_COPIED // 8)
    gflops = 2e-9 * _SIZE**3 / _best_s(lambda: a @ b)
    gbytes_s = 2e-9 * _COPIED / _best_s(lambda: np.copyto(target, source))
    print(json.dumps({"gflops": gflops, "gbytes_s": gbytes_s}))


if __name__ == "__main__":
    _main()
