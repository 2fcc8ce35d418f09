# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Replay synthetic recordings, each with a world, a path and noise of its own, and compare errors with covariances.

NEES is ``e' Sigma^-1 e``, 6 on average for a pose. Of points the share is told whose NEES is within 95 % of chi^2 of 3:
those that are far away have errors of another shape, which no mean survives. The map begins at the true pose of its
first keyframe, which is held: the errors of the others are against it, and so is the covariance.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats

from ba_node.arrays import FloatArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.estimate import Estimate, Extras
from ba_node.measurements import FeatureTracks, Keyframe, Measurement
from experiments.synthetic import SyntheticData, SyntheticOptions, generate

SENSORS = ("stereo", "rgbd", "mono")
LOSSES = ("squared", "huber", "cauchy")
CLAIMS = (1.0, 0.5, 2.0)
_NOISE_PX = 0.5
# Cheap, and still a map in which tracks begin and end.
_COMMON = {
    "keyframes": 12,
    "landmarks": 600,
    "tracks": 50,
    "length_m": 10.0,
    "path": "line",
    "noise_px": _NOISE_PX,
    "outlier_share": 0.0,
    "track_loss": 0.1,
    "drift_rotation_deg": 0.2,
    "drift_translation": 0.008,
}
# Four windows of ten.
_SLIDING = {
    "keyframes": 40,
    "length_m": 30.0,
    "landmarks": 800,
    "tracks": 60,
    "track_loss": 0.05,
    "drift_rotation_deg": 0.3,
    "drift_translation": 0.01,
}
_OF_SENSOR: dict[str, dict[str, float]] = {
    "stereo": {"baseline_m": 0.2},
    "rgbd": {"baseline_m": 0.0, "depth_share": 1.0, "depth_noise": 0.02},
    "mono": {"baseline_m": 0.0},
}


@dataclass(frozen=True)
class Case:
    """A sensor, the robust loss of the solver, and how many times the true noise ``sigma_px`` claims to be.

    With ``old_keyframes`` marginalised a window of ten slides over a longer way: see what is told of the last window.
    """

    sensor: str
    loss: str
    claim: float
    old_keyframes: str = "fix"

    @property
    def name(self) -> str:
        """Return its name in files."""
        slides = "" if self.old_keyframes == "fix" else f"_{self.old_keyframes}"
        return f"{self.sensor}_{self.loss}_{self.claim:g}{slides}"


CASES = (
    *(Case(sensor, loss, claim) for sensor in SENSORS for loss in LOSSES for claim in CLAIMS),
    Case("mono", "cauchy", 1.0, "marginalise"),
)


@dataclass(frozen=True)
class Nees:
    """What one run gives; NaN where the covariance is unknown."""

    newest: float  # of the newest keyframe in the solve of everything
    middle: float  # of the one in the middle of the path
    window: float  # of the newest keyframe in the last window
    points: float  # share of the points whose error is within their 95 % ellipsoid


def run(case: Case, seed: int) -> Nees:
    """Replay one recording, refine everything and return the NEES."""
    options: dict[str, Any] = _COMMON | _OF_SENSOR[case.sensor]
    chosen: dict[str, Any] = {"solver.loss": case.loss, "guard.check_setup": False}
    if case.old_keyframes != "fix":
        options |= _SLIDING
        chosen |= {"window.max_keyframes": 10, "window.old_keyframes": case.old_keyframes}
    data = generate(SyntheticOptions(seed=seed, **options))
    backend = Backend(Config().with_values(chosen))
    last = None
    for event in backend.replay(_claimed(measurement, case.claim) for _, _, measurement in data.timeline()):
        last = event if isinstance(event, Estimate) else last
        if isinstance(event, Keyframe) and event.keyframe_id == data.keyframes[-1].keyframe_id:
            backend.extras = Extras(covariance=True, points=True)
    everything = backend.optimize()
    if last is None or last.covariance is None or everything is None:
        return Nees(np.nan, np.nan, np.nan, np.nan)
    path = _of_poses(everything, data)
    return Nees(path[-1], path[len(path) // 2], _of_poses(last, data)[-1], _of_points(everything, data))


def interval(n: int, freedom: int) -> tuple[float, float]:
    """Return where the mean of n NEES lies with a probability of 95 %."""
    low, high = scipy.stats.chi2.ppf([0.025, 0.975], n * freedom)
    return float(low / n), float(high / n)


def _claimed(measurement: Measurement, claim: float) -> Measurement:
    if not isinstance(measurement, FeatureTracks):
        return measurement
    return dataclasses.replace(measurement, sigma_px=np.full(len(measurement.track_id), claim * _NOISE_PX))


def _of_poses(estimate: Estimate, data: SyntheticData) -> FloatArray:
    """Return the NEES of the poses of an estimate, (n,)."""
    assert estimate.covariance is not None
    place = np.searchsorted(data.truth.keyframe_id, estimate.refined.keyframe_id)
    truth, found = data.truth[place], estimate.refined
    turned, wanted = (geometry.matrix_from_quaternion(poses.orientation) for poses in (found, truth))
    turn = geometry.so3_log(turned @ np.swapaxes(wanted, 1, 2))
    error = np.concatenate([found.position - truth.position, turn], axis=1)
    return np.array([_nees(e, covariance) for e, covariance in zip(error, estimate.covariance, strict=True)])


def _of_points(estimate: Estimate, data: SyntheticData) -> float:
    """Return the share of the points within their 95 % ellipsoid; those a track was parted into are left out."""
    assert estimate.point_covariance is not None
    cloud = estimate.cloud
    kept = np.isin(cloud.track_id, data.track_id)
    place = np.searchsorted(data.track_id, cloud.track_id[kept])
    error = cloud.position[kept] - data.landmarks[data.track_landmark[place]]
    each = [_nees(e, covariance) for e, covariance in zip(error, estimate.point_covariance[kept], strict=True)]
    return float(np.mean(np.array(each)[np.isfinite(each)] <= scipy.stats.chi2.ppf(0.95, 3)))


def _nees(error: FloatArray, covariance: FloatArray) -> float:
    if not np.isfinite(covariance).all() or not covariance.any():
        return np.nan
    return float(error @ np.linalg.solve(covariance, error))
