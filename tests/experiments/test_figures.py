# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""No two curves of a plot look alike, to colour-blind readers either."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.benchmarks import plots as bench
from experiments.figures import COLOURS, MOST_CURVES, curve, spread
from experiments.thesis import plots
from experiments.thesis.experiments import Experiment

# What is left of linear RGB for those without red, green or blue cones (Machado et al. 2009, severity 1).
SIGHT = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
XYZ_OF_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
# Differences of CIE 1976: 2.3 is just seen, and these are small areas side by side.
LEAST_DIFFERENCE, LEAST_FROM_WHITE = 15.0, 30.0


def lab(colour: Any, sight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a colour as L*, a*, b* to a reader."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = XYZ_OF_RGB @ np.clip(sight @ linear, 0.0, 1.0) / WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


def difference(one: Any, other: Any, sight: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(lab(one, sight) - lab(other, sight)))


@pytest.mark.parametrize("reader", SIGHT)
def test_colours_are_told_apart(reader: str) -> None:
    for one, other in itertools.combinations(COLOURS, 2):
        found = difference(one, other, SIGHT[reader])
        assert found > LEAST_DIFFERENCE, f"{one} and {other}, {reader}: {found:.1f}"
    for colour in COLOURS:
        assert difference(colour, "white", SIGHT[reader]) > LEAST_FROM_WHITE, colour


@pytest.mark.parametrize("channel", ["color", "ls", "marker"])
def test_each_channel_alone_tells_curves_apart(channel: str) -> None:
    assert len({str(curve(index)[channel]) for index in range(MOST_CURVES)}) == MOST_CURVES


def test_too_many_curves_are_spread_over_plots_of_one_size() -> None:
    assert [len(group) for group in spread(range(9))] == [5, 4]
    assert [len(group) for group in spread(range(27))] == [7, 7, 7, 6]
    assert spread("abc") == [["a", "b", "c"]]
    assert spread([]) == [[]]


def assert_told_apart(figure: Figure, least: int) -> None:
    """Fail where two named curves of a plot have nearly the same colour, the same dashes or the same marker."""
    most = 0
    for axes in figure.axes:
        lines = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
        most = max(most, len(lines))
        for one, other in itertools.combinations(lines, 2):
            named = f"{one.get_label()} and {other.get_label()}"
            for reader, sight in SIGHT.items():
                found = difference(one.get_color(), other.get_color(), sight)
                assert found > LEAST_DIFFERENCE, f"{named}, {reader}: {found:.1f}"
            assert one._dash_pattern != other._dash_pattern, named  # type: ignore[attr-defined]
            assert one.get_marker() != other.get_marker(), named
    assert most >= least, f"{most} curves in the fullest plot"


def run(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    rows = [
        {
            "accepted": True,
            "objective": 10.0 + value,
            "gradient_norm": value,
            "time_s": float(k),
            "linear_iterations": k + 1,
        }
        for k, value in enumerate(np.sort(rng.random(20))[::-1])
    ]
    conditions = {"plain": [1.0, 0.0], **{f"condition_{name}": [10.0, 20.0 + seed] for name in "cbs"}}
    errors = {"rmse_cameras": 1.0 + seed, "median_points": 2.0}
    figures = {"observations": 10.0 * (1 + seed), "seconds": 1.0 + seed}
    return {
        "trace": rows,
        "options": {"loss": "squared"},
        "data": {"conditions": conditions},
        "truth_after": errors,
        "figures": figures,
    }


@pytest.mark.parametrize(
    ("plot", "labels", "least"),
    [
        ("curves", [f"method {index}" for index in range(7)], 7),
        ("curves", [f"method {index}" for index in range(9)], 5),
        ("pcg", [f"M{index}{end}" for end in ("", ", as it stands") for index in range(5)], 5),
        ("conditions", [f"M{index}{end}" for end in ("", ", cured") for index in range(5)], 5),
        ("shares", [f"{share} %, M{index}" for share in (0, 10) for index in range(5)], 5),
        ("growth", [f"{kind}, {size}" for kind in ("numpy", "native") for size in (1, 2)], 2),
    ],
)
def test_curves_of_the_thesis(plot: str, labels: list[str], least: int) -> None:
    records = {label: run(index) for index, label in enumerate(labels)}
    assert_told_apart(plots.PLOTS[plot](Experiment("9.9", "an experiment", (), ()), records), least)


def test_curves_of_the_benchmarks() -> None:
    peers = [
        "ceres dense",
        "ceres sparse",
        "ceres iterative",
        "pycolmap",
        "rootba sc",
        "rootba qr",
        "gtsam",
        "g2o",
        "scipy",
    ]
    solvers = ["ba_node", "ba_node 2 threads", "ba_node numpy", *peers]
    keys = ("tau 1e-02", "tau 1e-04", "gap 1e-03", "gap 1e-04", "gap 1e-06", "peak_mb")
    problems = [
        {
            "observations": size,
            "solvers": {
                name: {"start_mb": 1.0, **dict.fromkeys(keys, 2.0 + i + size)} for i, name in enumerate(solvers)
            },
        }
        for size in (10, 20)
    ]
    shown = bench.groups(solvers)
    assert {name for group in shown for name in group} == set(solvers)
    assert all(group[:2] == ["ba_node", "ba_node 2 threads"] for group in shown)
    assert_told_apart(bench.profiles(problems), 6)
    assert_told_apart(bench.growth(bench.fit_growth(problems, ["window", "window"])), 6)
