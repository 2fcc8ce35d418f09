# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a trajectory with a reference: which poses belong together, and how far apart they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ba_node.arrays import FloatArray, IntArray
from ba_node.core.geometry import matrix_from_quaternion, so3_log
from ba_node.estimate import Poses
from ba_node.evaluation.alignment import Alignment, EvaluationError, Kind, align

# Stamps farther apart than two weeks are of no pair.
MAX_DIFFERENCE_S = 1e6


@dataclass(frozen=True)
class Statistics:
    """Summary of non-negative errors, all in their unit. ``std`` is that of the sample itself (divided by n)."""

    rmse: float
    mean: float
    median: float
    max: float
    std: float
    count: int
    min: float
    sse: float  # sum of squares, their unit squared

    @classmethod
    def of(cls, errors: FloatArray) -> Statistics:
        """Summarise errors: (n,) with n > 0."""
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            max=float(np.max(errors)),
            std=float(np.std(errors)),
            count=len(errors),
            min=float(np.min(errors)),
            sse=float(np.sum(errors**2)),
        )


@dataclass(frozen=True)
class Errors:
    """Errors in translation and rotation."""

    translation_m: FloatArray  # (n,) distances
    rotation_deg: FloatArray  # (n,) angles

    @property
    def translation(self) -> Statistics:
        """Return the summary of the distances, m."""
        return Statistics.of(self.translation_m)

    @property
    def rotation(self) -> Statistics:
        """Return the summary of the angles, deg."""
        return Statistics.of(self.rotation_deg)


@dataclass(frozen=True)
class AbsoluteError(Errors):
    """Absolute error of a trajectory after alignment (Sturm et al., IROS 2012), of each pose to its partner."""

    alignment: Alignment  # from the estimate to the reference
    stamp_ns: NDArray[np.int64]  # (n,) of the estimate's poses that have a partner, by time


def associate(
    estimate_ns: NDArray[np.int64], reference_ns: NDArray[np.int64], max_difference_s: float = 0.01
) -> tuple[IntArray, IntArray]:
    """Pair stamps, in any order, that are nearest to each other; those farther apart than the limit are no pair.

    Returns:
        Rows of the estimate and of the reference, by time; each row is in at most one pair, the closest; of
        equal reference stamps the first counts.
    """
    none = np.empty(0, dtype=np.intp)
    if len(estimate_ns) == 0 or len(reference_ns) == 0:
        return none, none
    stamps, order = np.unique(reference_ns, return_index=True)
    after = np.searchsorted(stamps, estimate_ns)
    low, high = np.maximum(after - 1, 0), np.minimum(after, len(stamps) - 1)
    nearer = np.abs(estimate_ns - stamps[low]) <= np.abs(stamps[high] - estimate_ns)
    partner = np.where(nearer, low, high)
    gap = np.abs(estimate_ns - stamps[partner])
    rows = np.flatnonzero(gap <= round(max_difference_s * 1e9))
    # Of those that want the same partner the closest one gets it.
    rows = rows[np.lexsort((gap[rows], partner[rows]))]
    _, first = np.unique(partner[rows], return_index=True)
    rows = rows[first]
    return rows, order[partner[rows]]


@dataclass(frozen=True)
class Paired:
    """Poses of two trajectories that belong together, row by row, the estimate's aligned with the reference's."""

    alignment: Alignment  # from the estimate to the reference
    stamp_ns: NDArray[np.int64]  # (n,) of the estimate, by time
    position: tuple[FloatArray, FloatArray]  # (n, 3) m of the estimate and of the reference
    rotation: tuple[FloatArray, FloatArray]  # (n, 3, 3) fixed frame from body, likewise


def pair(estimate: Poses, reference: Poses, kind: Kind = "se3", max_difference_s: float = 0.01) -> Paired:
    """Pair the poses of two trajectories by stamp, and align the estimate by the positions of the pairs.

    Raises:
        EvaluationError: no pose has a partner, or the pairs cannot be aligned.
    """
    if not 0.0 <= max_difference_s <= MAX_DIFFERENCE_S:
        raise EvaluationError(
            f"largest difference of the stamps of a pair = {max_difference_s:g} s: expected 0 to {MAX_DIFFERENCE_S:g} s"
        )
    rows, partners = associate(estimate.stamp_ns, reference.stamp_ns, max_difference_s)
    if len(rows) == 0:
        raise EvaluationError(
            f"0 of {len(estimate)} poses have a stamp within {max_difference_s:g} s of one of the {len(reference)}"
            f" reference poses: {_span('estimate', estimate)}, {_span('reference', reference)};"
            " compare trajectories of one recording, or raise the allowed difference"
        )
    ours, theirs = estimate[rows], reference[partners]
    try:
        alignment = align(ours.position, theirs.position, kind)
    except EvaluationError as error:
        raise EvaluationError(f"{len(rows)} of {len(estimate)} poses have a partner; {error}") from None
    turned = alignment.rotation @ matrix_from_quaternion(ours.orientation)
    return Paired(
        alignment,
        ours.stamp_ns,
        (alignment.apply(ours.position), theirs.position),
        (turned, matrix_from_quaternion(theirs.orientation)),
    )


def absolute_error(
    estimate: Poses, reference: Poses, kind: Kind = "se3", max_difference_s: float = 0.01
) -> AbsoluteError:
    """Return how far an estimated trajectory is from the reference, paired by stamp, aligned by the pairs' positions.

    Raises:
        EvaluationError: no pose has a partner, or the pairs cannot be aligned.
    """
    return absolute_error_of(pair(estimate, reference, kind, max_difference_s))


def absolute_error_of(paired: Paired) -> AbsoluteError:
    """Return the same of poses that are paired already."""
    translation = np.linalg.norm(paired.position[0] - paired.position[1], axis=1)
    difference = np.swapaxes(paired.rotation[1], -1, -2) @ paired.rotation[0]
    rotation = np.degrees(np.linalg.norm(so3_log(difference), axis=1))
    return AbsoluteError(translation, rotation, paired.alignment, paired.stamp_ns)


def _span(name: str, poses: Poses) -> str:
    if len(poses) == 0:
        return f"the {name} is empty"
    return f"the {name} spans {_seconds(poses.stamp_ns.min())} to {_seconds(poses.stamp_ns.max())} s"


def _seconds(stamp_ns: np.int64) -> str:
    seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
    return f"{seconds}.{rest:09d}"
