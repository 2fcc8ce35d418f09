# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Our errors beside those of evo, which runs as a process of its own on the same files."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ba_node.cli.main import main
from ba_node.core.geometry import matrix_from_quaternion, quaternion_from_matrix, so3_exp
from ba_node.estimate import Poses
from ba_node.io.reference import read_pair, read_poses
from ba_node.io.trajectory import read_tum, write_tum

EVO = {name: Path(sys.executable).with_name(f"evo_{name}") for name in ("ape", "rpe")}
ALIGN = {"none": (), "se3": ("-a",), "sim3": ("-a", "-s")}
STATISTICS = ("rmse", "mean", "median", "min", "max", "std", "sse")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a walk of 300 poses at 10 Hz, and an estimate at 5 Hz that drifts in place, turn and scale."""
    rng, path = np.random.default_rng(7), tmp_path_factory.mktemp("evo")
    n = 300
    turns = np.cumsum(rng.normal(0.0, 0.05, (n, 3)), axis=0)
    rotation = so3_exp(turns)
    position = np.cumsum((rotation @ np.array([0.2, 0.0, 0.0])[:, None])[..., 0], axis=0)
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(n, dtype=np.int64)
    reference = _poses(stamps, position, rotation)
    off = so3_exp(np.cumsum(rng.normal(0.0, 0.004, (n, 3)), axis=0))
    frame = so3_exp(np.array([[0.3, -0.2, 1.0]]))[0]
    drifted = 1.04 * position + np.cumsum(rng.normal(0.0, 0.01, (n, 3)), axis=0)
    estimate = _poses(
        stamps + rng.integers(-4_000_000, 4_000_000, n), drifted @ frame.T + [5.0, 1.0, -2.0], frame @ rotation @ off
    )
    write_tum(path / "reference.tum", reference)
    write_tum(path / "estimate.tum", estimate[np.arange(0, n, 2)])
    _write_kitti(path / "reference.kitti", reference)
    _write_kitti(path / "estimate.kitti", estimate)
    lines = (
        f"{stamp},{','.join(map(repr, [*p, q[3], *q[:3]]))},0,0,0"
        for stamp, p, q in zip(stamps.tolist(), position.tolist(), reference.orientation.tolist(), strict=True)
    )
    (path / "reference.csv").write_text("\n".join(["#timestamp, p_RS_R_x [m], ...", *lines, ""]))
    return path


def _poses(stamps: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> Poses:

    ids = np.arange(len(stamps), dtype=np.uint64)
    return Poses(ids, stamps, position, quaternion_from_matrix(rotation))


def _write_kitti(path: Path, poses: Poses) -> None:
    matrix = np.concatenate([matrix_from_quaternion(poses.orientation), poses.position[..., None]], axis=2)
    path.write_text("".join(" ".join(map(repr, row)) + "\n" for row in matrix.reshape(-1, 12).tolist()))


def evo(folder: Path, program: str, form: str, files: tuple[str, str], *options: str) -> dict[str, float]:
    """Return the statistics of evo for (reference, estimate)."""
    result = folder / "evo.zip"
    result.unlink(missing_ok=True)
    command = [
        str(EVO[program]),
        form,
        *(str(folder / name) for name in files),
        *options,
        "--save_results",
        str(result),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=120, env=os.environ | {"HOME": str(folder)})
    with zipfile.ZipFile(result) as archive:
        found: dict[str, float] = json.loads(archive.read("stats.json"))
    return found


def ours(folder: Path, files: tuple[str, str], *options: str) -> dict[str, dict[str, float]]:
    assert main(["evaluate", *(str(folder / name) for name in reversed(files)), *options,
                 "--json", str(folder / "ours.json")]) == 0  # fmt: skip
    found: dict[str, dict[str, float]] = json.loads((folder / "ours.json").read_text())
    return found


def assert_equal(found: dict[str, float], theirs: dict[str, float], what: str) -> None:
    for name in STATISTICS:
        assert found[name] == pytest.approx(theirs[name], rel=1e-6, abs=1e-6), f"{what}: {name}"


@pytest.mark.skipif(not EVO["ape"].exists(), reason="needs evo: pip install evo")
@pytest.mark.slow
@pytest.mark.parametrize("align", ALIGN)
@pytest.mark.parametrize(
    ("form", "files"),
    [
        ("tum", ("reference.tum", "estimate.tum")),
        ("kitti", ("reference.kitti", "estimate.kitti")),
        ("euroc", ("reference.csv", "estimate.tum")),
    ],
)
def test_absolute_and_relative_errors_are_those_of_evo(
    folder: Path, form: str, files: tuple[str, str], align: str
) -> None:
    found = ours(folder, files, "--align", align, "--interval", "3")
    for relation, unit in (("trans_part", "translation_m"), ("angle_deg", "rotation_deg")):
        theirs = evo(folder, "ape", form, files, *ALIGN[align], "-r", relation)
        assert_equal(found[unit], theirs, f"ape {form} {align} {relation}")
        theirs = evo(folder, "rpe", form, files, *ALIGN[align], "-r", relation, "-d", "3", "-u", "f")
        assert_equal(found[f"relative_{unit}"], theirs, f"rpe {form} {align} {relation}")


@pytest.mark.skipif(not EVO["rpe"].exists(), reason="needs evo: pip install evo")
@pytest.mark.slow
@pytest.mark.parametrize("unit", ["frames", "m"])
@pytest.mark.parametrize("pairs", [(), ("--all-pairs",)])
def test_relative_errors_over_an_interval_are_those_of_evo(folder: Path, unit: str, pairs: tuple[str, ...]) -> None:
    files = ("reference.tum", "estimate.tum")
    found = ours(folder, files, "--align", "sim3", "--interval", "5", "--unit", unit, *pairs)
    options = (*ALIGN["sim3"], "-d", "5", "-u", unit[0], *(["--all_pairs"] if pairs else []))
    for relation, name in (("trans_part", "relative_translation_m"), ("angle_deg", "relative_rotation_deg")):
        assert_equal(found[name], evo(folder, "rpe", "tum", files, *options, "-r", relation), f"{unit} {pairs}")


def test_formats_give_the_same_trajectory(folder: Path) -> None:

    tum = read_tum(folder / "reference.tum")
    euroc = read_poses(folder / "reference.csv")
    kitti, stamped = read_pair(folder / "reference.kitti", folder / "reference.tum")
    assert (kitti.stamp_ns == stamped.stamp_ns).all()
    for other in (euroc, kitti):
        assert (other.stamp_ns == tum.stamp_ns).all()
        np.testing.assert_allclose(other.position, tum.position, atol=1e-12)
        np.testing.assert_allclose(
            matrix_from_quaternion(other.orientation), matrix_from_quaternion(tum.orientation), atol=1e-12
        )


def test_intervals_by_hand(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two trajectories on a line, the one 1 % longer, and turned at the end."""
    stamps = 1_000_000_000 * np.arange(11, dtype=np.int64)
    position = np.stack([np.arange(11.0), np.zeros(11), np.zeros(11)], axis=1)
    still = np.tile(np.eye(3), (11, 1, 1))
    turned = still.copy()
    turned[10] = so3_exp(np.array([[0.0, 0.0, np.pi / 2]]))[0]
    write_tum(tmp_path / "r.tum", _poses(stamps, position, still))
    write_tum(tmp_path / "e.tum", _poses(stamps, 1.01 * position, turned))
    options = ("--align", "none", "--interval", "5", "--csv", str(tmp_path / "e.csv"))
    found = ours(tmp_path, ("r.tum", "e.tum"), *options)
    assert found["relative_translation_m"]["rmse"] == pytest.approx(0.05, abs=1e-12)
    assert found["relative_translation_m"]["count"] == 2
    assert found["relative_rotation_deg"]["max"] == pytest.approx(90.0, abs=1e-9)
    assert (tmp_path / "e.csv").read_text().startswith("error,rmse,mean,median,min,max,std,sse,count\ntranslation_m,")
    assert main(["evaluate", str(tmp_path / "e.tum"), str(tmp_path / "r.tum"), "--align", "none",
                 "--interval", "50", "--unit", "m"]) == 2  # fmt: skip
    assert "interval 50 m: no two of the 11 poses, over 10.1 m, are so far apart" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path / "e.tum"), str(folder / "reference.kitti")]) == 2
    assert "11 and 300 poses, of which one file has no stamps (KITTI)" in capsys.readouterr().err


def test_reference_is_a_topic_of_a_recording(capsys: pytest.CaptureFixture[str]) -> None:
    bag = Path(__file__).resolve().parents[2] / "bags" / "stereo_loop.mcap"
    assert main(["evaluate", str(bag), str(bag)]) == 0
    assert "60 of 60 poses have a partner" in capsys.readouterr().out
    assert main(["evaluate", str(bag), str(bag), "--reference-topic", "/nothing"]) == 2
    assert "topics of poses: " in capsys.readouterr().err
