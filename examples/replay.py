# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Refine a recording in a program of your own, without a middleware: python examples/replay.py RECORDING.mcap.

`ba replay` does the same and writes files; here each estimate is at hand as it comes.
"""

import sys

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Estimate
from ba_node.io.bag_reader import BagReader
from ba_node.measurements import Keyframe


def main(recording):
    backend = Backend(Config().with_values({"window.max_keyframes": 15}))
    odometry = {}
    with BagReader(recording) as reader:
        stream = (measurement for _, _, measurement in reader.measurements())
        for event in backend.replay(stream):
            if isinstance(event, Estimate):
                report = event.report
                print(f"solve {report.solve_count}: {report.status.name}, {len(event.refined)} keyframes refined")
            elif isinstance(event, Keyframe):  # one that was taken in
                odometry[event.keyframe_id] = event.position
    trajectory = backend.estimate().trajectory
    for number, position in zip(trajectory.keyframe_id, trajectory.position, strict=True):
        print(f"keyframe {number}: from {odometry[number].round(3).tolist()} to {position.round(3).tolist()}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/replay.py RECORDING")
    main(*sys.argv[1:])
