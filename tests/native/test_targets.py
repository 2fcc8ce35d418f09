# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The kernels as compiled for several processors: they agree, and each stays within what its processor has."""

from __future__ import annotations

import ast
import dataclasses
import os
import re
import shutil
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ba_node import native
from ba_node.config import SolverOptions
from ba_node.core import native_kernels
from ba_node.core.consensus import agreeing
from ba_node.core.factors import RelativePoses
from ba_node.core.linear import PcgLimits
from ba_node.core.native_kernels import NativeFactorSum
from ba_node.core.problem import Problem
from ba_node.core.triangulation import rays_of, triangulate
from tests.core.conftest import Spec, make

pytestmark = pytest.mark.skipif(native.kernels is None, reason="the C++ kernels are not built")

PROBLEMS = {
    "pinhole": Spec(distorted=False, start_error=0.02),
    "distorted": Spec(start_error=0.02),
    "depth": Spec(depth=True, stereo=True, start_error=0.02),
    "own intrinsics": Spec(free_intrinsics=True, start_error=0.02),
    "tracks": Spec(distorted=False, track=3, points=125, start_error=0.02),
    "stereo tracks": Spec(stereo=True, depth=True, track=4, points=83, keyframes=7, start_error=0.02),
}
Quantities = dict[str, np.ndarray]


@pytest.fixture(autouse=True)
def _restore() -> Iterator[None]:
    before = native.kernels.target()
    yield
    native.kernels.use_target(before)


def solution(x: np.ndarray | None) -> np.ndarray:
    """Return a copy of a solution that has to be there."""
    assert x is not None
    return x.copy()


def of_kernels(problem: Problem, threads: int = 1) -> Quantities:
    """Return everything that the kernels say about a problem at its start, and after one step."""
    kernels = native_kernels.make(
        problem, SolverOptions(loss="huber", loss_scale_px=1.5, kernels="native", threads=threads)
    )
    kernel = kernels._kernel  # type: ignore[attr-defined]
    out: Quantities = {"objective": np.array(kernels.linearise(problem.start))}
    out["d_c"], out["d_p"] = kernels.diagonals()
    system = kernels.reduce(1e-3 * out["d_c"] + 1e-3, 1e-3 * out["d_p"] + 1e-3)
    out |= {"rhs": system.rhs.copy(), "S": system.dense().copy(), "sparse S": system.sparse().toarray()}
    out["x"] = solution(system.solve_dense())
    assert isinstance(system, native_kernels.NativeSystem)
    system.factor_size(10**6, 1e9)
    out["sparse x"] = solution(system.solve_sparse())
    ones = np.ones_like(out["d_c"])
    for kind in ("none", "schur_block", "schur_diag", "b_block", "b_diag"):
        for formed in (True, False):
            # So few steps that rounding has no room to grow, and no test of when to stop is met.
            found = system.solve_pcg(kind, ones, PcgLimits(t_eps=1e-300, max_iterations=4), formed=formed)
            assert found is not None
            out[f"pcg {kind} {formed}"] = solution(found.x)
    out["product"] = kernel.product(out["x"])
    out["diagonal blocks"] = kernel.diagonal_blocks()
    _, out["step_p"], reduction = system.back_substitute(out["x"])
    moved = kernels.step(problem.start, system, out["x"], 2)
    state = moved.state
    out |= {
        "moved points": state.points.copy(),
        "rotation": state.rotation.copy(),
        "translation": state.translation.copy(),
    }
    out["numbers"] = np.array([kernels.gradient_norm, reduction, moved.predicted, moved.damping, moved.objective])
    out["linearised ahead"] = np.array(kernels.linearise(state))
    out["rhs after"] = kernels.reduce(out["d_c"], out["d_p"]).rhs.copy()
    return out


def of_functions() -> Quantities:
    """Return what the kernels say that keep nothing."""
    problem, _ = make(Spec(stereo=True, start_error=0.02))
    rays = rays_of(problem)
    found = triangulate(rays, problem.n_points, "native")
    out = {"points": found.points, "parallax": found.parallax_rad}
    out["agreeing"] = agreeing(rays, problem.n_points, 6.0, "native").astype(float)
    out["residuals"] = native_kernels.residual_norms(problem, problem.start, "native")
    state = problem.start
    n = problem.n_keyframes
    pairs = np.array([(i, i + 1) for i in range(n - 1)])
    rotation = state.rotation[pairs[:, 0]] @ state.rotation[pairs[:, 1]].transpose(0, 2, 1)
    shift = np.full((n - 1, 3), 0.1)
    factors = RelativePoses(pairs, rotation, shift, np.tile(np.eye(6), (n - 1, 1, 1)), "cauchy", 0.5)
    total = NativeFactorSum([factors], problem.fixed)
    terms = total.linearise(state)
    out["factors"] = np.array([total.value(state), terms.value])
    out |= {"factor gradient": terms.gradient, "factor blocks": terms.pairs.blocks}
    return out


@pytest.mark.parametrize("target", ["avx2", "avx512"])
@pytest.mark.parametrize("name", [*PROBLEMS, "functions"])
def test_targets_agree_to_rounding(name: str, target: str) -> None:
    if target not in native.kernels.targets():
        pytest.skip(f"this processor or this build has no {target}")
    results = []
    for each in ("baseline", target):
        native.kernels.use_target(each)
        results.append(of_functions() if name == "functions" else of_kernels(make(PROBLEMS[name])[0]))
    for quantity, expected in results[0].items():
        found = results[1][quantity]
        largest = float(np.abs(expected).max(initial=1e-300))
        off = float(np.abs(found - expected).max(initial=0.0)) / largest
        assert off < 1e-9, f"{quantity}: {off:.1e} of {largest:.3g} between baseline and {target}"


@pytest.mark.parametrize("target", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_any_number_of_threads_gives_the_same_bits(name: str, target: str) -> None:
    if target not in native.kernels.targets():
        pytest.skip(f"this processor or this build has no {target}")
    native.kernels.use_target(target)
    problem, _ = make(dataclasses.replace(PROBLEMS[name], keyframes=8, points=400))
    one, three = (of_kernels(problem, threads) for threads in (1, 3))
    for quantity, expected in one.items():
        assert three[quantity].tobytes() == expected.tobytes(), quantity


def started(value: str) -> tuple[str, str]:
    """Return the target that a process with BA_NODE_SIMD takes, and what it prints on stderr."""
    command = [sys.executable, "-c", "from ba_node import native; print(native.kernels.target())"]
    done = subprocess.run(
        command, env={**os.environ, native.VARIABLE: value}, capture_output=True, text=True, check=True
    )
    return done.stdout.strip(), done.stderr


def test_the_environment_chooses_the_target() -> None:
    supported = native.kernels.targets()
    assert supported[-1] == "baseline"
    for name in ("", *supported):
        assert started(name) == (name or supported[0], "")


def test_an_unknown_target_is_said_and_passed_over() -> None:
    widest = native.kernels.targets()[0]
    taken, said = started("avx3")
    assert taken == widest
    assert f"BA_NODE_SIMD = 'avx3': known are baseline, avx2, avx512; taking {widest}" in said


def test_a_target_that_the_processor_lacks_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    class Old:
        used: list[str] = []  # noqa: RUF012
        use_target = used.append

        @staticmethod
        def targets() -> tuple[str, ...]:
            return ("avx2", "baseline")

    monkeypatch.setattr(native, "kernels", Old)
    with pytest.warns(
        RuntimeWarning, match="BA_NODE_SIMD = 'avx512': this processor or this build lacks it; taking avx2"
    ):
        assert native.choose_target("avx512") == "avx2"
    assert Old.used == ["avx2"]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("objdump") is None, reason="no objdump")
def test_wide_instructions_stay_in_the_functions_of_their_target() -> None:
    # Names of template arguments count: a function of the standard library for a type of a target is that target's. So
    # are vectors of registers of 64 bytes (Dv8_d), which AVX-512 alone has.
    library = Path(native.kernels.__file__)
    listing = subprocess.run(
        ["objdump", "-d", "--no-show-raw-insn", str(library)], capture_output=True, text=True, check=True
    ).stdout
    if "4avx2" not in listing:
        pytest.skip("built for one target alone, or stripped")
    wide = re.compile(r"%[yz]mm|\bv[a-z0-9]+[sp]d\b")
    name, found, counted = "", set(), 0
    for line in listing.splitlines():
        if line.endswith(">:"):
            name = line[line.index("<") + 1 : -2]
            counted += 1
        elif not re.search("4avx2|6avx512|^_ZNSt6vectorI.*Dv8_d", name) and wide.search(line):
            found.add(name)
    assert counted > 500, f"{counted} functions read"
    assert not found


def test_the_stub_has_what_the_module_has() -> None:
    def public(names: list[str]) -> set[str]:
        return {name for name in names if not name.startswith("_")}

    tree = ast.parse((Path(native.__file__).parent / "_kernels.pyi").read_text())
    functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef) and not node.bases}
    assert public(dir(native.kernels)) == functions | set(classes)
    for name, node in classes.items():
        stubbed = [each.name for each in node.body if isinstance(each, ast.FunctionDef)]
        assert public(dir(getattr(native.kernels, name))) == public(stubbed), name


@pytest.mark.parametrize("lacking", ["use_target", "loosest"])
def test_kernels_of_another_version_are_left_alone(lacking: str) -> None:
    old = types.ModuleType("_kernels")
    old.__file__ = "_kernels.so"
    old.__dict__.update({name: one for name, one in vars(native.kernels).items() if name[0] != "_" and name != lacking})
    with pytest.warns(RuntimeWarning, match=r"_kernels.so was built from another version .* install ba_node again"):
        assert native.usable(old) is None
    setattr(old, lacking, None)
    assert native.usable(old) is old
