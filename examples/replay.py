# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine a recording in a program of your own, without a middleware: python examples/replay.py RECORDING.mcap.

`ba replay` does the same and writes files; here each estimate is at hand as it comes.
"""

import sys

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io.mcap import BagReader
from ba_node.measurements import Keyframe


def main(recording):
    backend = Backend(Config().with_values({"window.max_keyframes": 15}))
    odometry = {}
    with BagReader(recording) as reader:
        for _, _, measurement in reader.measurements():
            if backend.completes(measurement):  # a keyframe begins, so the one before has all its tracks
                tell(backend.solve())
            backend.add(measurement)
            if isinstance(measurement, Keyframe):
                odometry[measurement.keyframe_id] = measurement.position
    backend.flush(final=True)
    while backend.ready:
        tell(backend.solve())
    estimate = backend.estimate()
    for number, position in zip(estimate.trajectory.keyframe_id, estimate.trajectory.position, strict=True):
        print(f"keyframe {number}: from {odometry[number].round(3).tolist()} to {position.round(3).tolist()}")
    print(f"{len(estimate.trajectory)} keyframes, {len(estimate.cloud)} points, rms {backend.rms_px():.3f} px")


def tell(estimate):
    report = estimate.report
    print(f"solve {report.solve_count}: {report.status.name}, {report.observations} observations: {report.reason}")


if __name__ == "__main__":
    main(sys.argv[1])
