# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Keep what a report shows and no other file of a replay holds, and read the folder of a replay again."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node import __version__
from ba_node.arrays import FloatArray
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import Kind
from ba_node.io.files import whole_file
from ba_node.io.parameters import configure
from ba_node.io.ply import PlyError, read_ply
from ba_node.io.trajectory import read_tum
from ba_node.offline.session_record import SessionRecord

DETAILS = "details.npz"
# Fields of a solve's report that are kept, one entry a solve.
SOLVES = (
    *("newest_keyframe_id", "reason", "iterations", "keyframes", "landmarks", "observations", "inlier_share"),
    *("objective_before", "objective_after", "rms_px_before", "rms_px_after", "parallax_deg"),
    *("held_out_px_before", "held_out_px_after", "weakest_m", "correction_m"),
)
# Residuals that are kept one by one, and the bins of all of them, in sigmas along u and v.
_SAMPLE = 20_000
BINS = np.linspace(-6.0, 6.0, 97)
# Of larger files only this much at either end is hashed.
_HASHED = 2**26


class RunError(ValueError):
    """A folder that holds no results of a replay."""


@dataclass(frozen=True)
class Comparison:
    """A trajectory beside others, and the map."""

    name: str  # what it is called beside others
    before: Poses | None  # the front-end's trajectory; None to show that after adjustment alone
    after: Poses  # after adjustment
    truth: Poses | None  # reference, if there is one
    cloud: FloatArray  # (n, 3) points of the map, in the frame of ``after``, m
    kind: Kind  # alignment of both trajectories to the reference


@dataclass(frozen=True)
class Run(Comparison):
    """The results of a replay."""

    report: dict[str, Any]  # content of report.json
    details: dict[str, NDArray[Any]]  # see :func:`write_details`
    parameters: dict[str, object]  # by full name


def shown_keyframe(record: SessionRecord) -> int:
    """Return the place of the keyframe, oldest first, that has the most residuals."""
    seen = record.summary.observed.keyframe
    return int(np.argmax(np.bincount(seen))) if len(seen) else 0


def write_details(folder: Path, record: SessionRecord, images: Mapping[int, NDArray[np.uint8]]) -> None:
    """Write the figures of each solve, a summary and a sample of the residuals, and images, to details.npz.

    ``images`` are those of :func:`shown_keyframe`, by camera, (h, w) grey; all residuals in them are kept.
    """
    seen = record.summary.observed
    reports = [report for _, report in record.solves]
    columns: dict[str, NDArray[Any]] = {name: np.array([getattr(one, name) for one in reports]) for name in SOLVES}
    columns["status"] = np.array([report.status.name for report in reports])
    columns["solve_stamp_ns"] = np.array([stamp_ns for stamp_ns, _ in record.solves], dtype=np.int64)
    good = np.isfinite(seen.error[:, 0])
    scaled = (seen.error / seen.sigma_px[:, None])[good & ~seen.outlier].ravel()
    columns["histogram"] = np.histogram(np.clip(scaled, BINS[0], BINS[-1]), BINS)[0]
    rows = np.flatnonzero(good)
    shown = rows[seen.keyframe[rows] == shown_keyframe(record)]
    rows = rows[np.linspace(0, max(len(rows) - 1, 0), min(len(rows), _SAMPLE)).astype(np.intp)]
    rows = np.union1d(rows, shown)
    columns["body_from_camera"] = record.summary.body_from_camera
    columns["shown_keyframe"] = np.array(shown_keyframe(record))
    columns |= {f"image_{camera}": image for camera, image in images.items()}
    for name in ("error", "uv", "camera", "keyframe", "outlier"):
        column = getattr(seen, name)[rows]
        columns[name] = column.astype(np.float32) if column.dtype == np.float64 else column
    columns["views"] = np.bincount(seen.views) if len(seen.views) else np.zeros(1, np.intp)
    parallax = seen.parallax_deg[np.isfinite(seen.parallax_deg)]
    columns["parallax"] = np.histogram(np.clip(parallax, 0.0, 90.0), PARALLAX_DEG)[0]
    with whole_file(folder / DETAILS) as stream:
        np.savez_compressed(stream, **columns)  # type: ignore[arg-type]


PARALLAX_DEG = np.concatenate([[0.0], np.geomspace(0.05, 90.0, 41)])


def read_run(folder: Path, name: str = "") -> Run:
    """Read the results of a replay.

    Raises:
        RunError: there are none, or of another version.
    """
    try:
        report = json.loads((folder / "report.json").read_text())
        with np.load(folder / DETAILS, allow_pickle=False) as file:
            details = dict(file)
        truth = folder / "ground_truth.tum"
        return Run(
            name or folder.name,
            read_tum(folder / "trajectory_input.tum"),
            read_tum(folder / "trajectory.tum"),
            read_tum(truth) if truth.is_file() else None,
            read_ply(folder / "points.ply")[0],
            "se3",
            report,
            details,
            dict(configure(folder / "effective.yaml", {}).values()),
        )
    except FileNotFoundError as error:
        raise RunError(f"{folder}: no results of ba replay, there is no {Path(error.filename).name} in it") from None
    except (OSError, KeyError, PlyError, json.JSONDecodeError) as error:
        raise RunError(f"{folder}: no results of ba replay, or of an older version: {error}") from None


def recording_facts(paths: Sequence[Path]) -> dict[str, Any]:
    """Return which files a recording consists of: name, bytes, SHA-256 of each (of large ones, of their two ends)."""
    files = []
    for path in sorted(file for one in paths for file in (one.iterdir() if one.is_dir() else [one]) if file.is_file()):
        size, digest = path.stat().st_size, hashlib.sha256()
        with path.open("rb") as stream:
            digest.update(stream.read(_HASHED))
            if size > 2 * _HASHED:
                stream.seek(-_HASHED, 2)
            digest.update(stream.read(_HASHED))
        whole = "sha256" if size <= 2 * _HASHED else "sha256_of_first_and_last_64_MiB"
        files.append({"name": path.name, "bytes": size, whole: digest.hexdigest()})
    return {"files": files}


def versions(kernels: str) -> Mapping[str, str]:
    """Return what the results were made with."""
    return {
        "ba_node": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "kernels": kernels,
        "machine": f"{platform.system()} {platform.machine()}",
    }
