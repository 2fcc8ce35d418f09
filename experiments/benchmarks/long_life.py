# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Drive down a corridor without an end, or stand still, and say what a keyframe costs as the map grows.

``python -m experiments.benchmarks.long_life --keyframes 36000``: processor time and memory by number of keyframes. A
corridor is made keyframe by keyframe, so nothing but the back-end's map grows.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ba_node.arrays import FloatArray, IdArray
from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe

# Of the cameras: focal length and half the image, px; metres between them.
_FOCAL, _HALF, _BASELINE = 400.0, np.array([320.0, 240.0]), 0.2
_STEP_M, _RANGE_M, _NEAR_M = 0.5, 8.0, 1.5
_PERIOD_NS = 100_000_000
_NOISE_PX = 0.3
# Points are drawn by sections of the corridor, each from its own seed.
_SECTION_M = 10.0


def rig() -> CameraRig:
    """Return two cameras that look ahead, beside each other; the body is the first."""
    n = 2
    return CameraRig(
        frame_id="base_link",
        names=("left", "right"),
        models=("plumb_bob",) * n,
        intrinsics=np.tile([_FOCAL, _FOCAL, *_HALF], (n, 1)),
        distortion=(np.zeros(5),) * n,
        image_size=np.tile(2 * _HALF, (n, 1)).astype(np.int64),
        position=np.array([[0.0, 0.0, 0.0], [_BASELINE, 0.0, 0.0]]),
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
    )


class Corridor:
    """A stereo camera that moves along z; with ``still`` it stays where it is, and sees the same points."""

    def __init__(self, tracks: int = 140, *, still: bool = False) -> None:
        self._per_section, self._still = round(1.47 * tracks * _SECTION_M / _RANGE_M), still

    def _points(self, section: int) -> FloatArray:
        """Return the points of a section, (n, 3) m, on walls, floor and ceiling."""
        rng = np.random.default_rng([7, section])
        points = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, _SECTION_M], (self._per_section, 3))
        on_wall = rng.random(len(points)) < 0.6
        side = np.where(rng.random(len(points)) < 0.5, -1.0, 1.0)
        points[on_wall, 0], points[~on_wall, 1] = 2.0 * side[on_wall], 1.5 * side[~on_wall]
        return np.asarray(points + np.array([0.0, 0.0, section * _SECTION_M]))

    def frames(self) -> Iterator[tuple[Keyframe, FeatureTracks, FeatureTracks]]:
        """Yield a keyframe and its tracks, without an end."""
        rng, drift, k = np.random.default_rng(1), np.zeros(3), 0
        while True:
            z = 0.0 if self._still else _STEP_M * k
            eye = np.array([0.3 * np.sin(0.05 * z), 0.1 * np.sin(0.03 * z), z])
            drift += 0.0 if self._still else rng.normal(0.0, 0.002, 3)
            upright = np.array([0.0, 0.0, 0.0, 1.0])
            keyframe = Keyframe(0, k, (k + 1) * _PERIOD_NS, "odom", eye + drift, upright)
            first = int((z + _NEAR_M) // _SECTION_M)
            sections = range(first, int((z + _RANGE_M) // _SECTION_M) + 1)
            points = np.concatenate([self._points(section) for section in sections])
            ids = np.arange(len(points), dtype=np.uint64) + np.uint64(first * self._per_section)
            left, right = (self._image(k, camera, points - eye, ids, rng) for camera in (0, 1))
            yield keyframe, left, right
            k += 1

    def _image(self, k: int, camera: int, points: FloatArray, ids: IdArray, rng: np.random.Generator) -> FeatureTracks:
        local = points - [camera * _BASELINE, 0.0, 0.0]
        uv = _FOCAL * local[:, :2] / np.maximum(local[:, 2:], 1e-3) + _HALF
        seen = (local[:, 2] > _NEAR_M) & (local[:, 2] < _RANGE_M) & (np.abs(uv - _HALF) < _HALF).all(axis=1)
        noisy = uv[seen] + rng.normal(0.0, _NOISE_PX, (np.count_nonzero(seen), 2))
        return FeatureTracks(0, k, camera, ids[seen], noisy, np.full(len(noisy), _NOISE_PX))


def resident_mb() -> float:
    """Return the memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks.long_life", description=__doc__)
    parser.add_argument("--keyframes", type=int, default=5000)
    parser.add_argument("--at", type=int, nargs="*", default=[1000, 5000, 10_000, 20_000, 36_000], help="where to tell")
    parser.add_argument("--span", type=int, default=200, help="keyframes of which the mean is told")
    parser.add_argument("--still", action="store_true", help="stand still")
    parser.add_argument("--tracks", type=int, default=140, help="about how many an image shows")
    parser.add_argument("--profile", action="store_true", help="where the time of the last span goes")
    parser.add_argument("--quick", action="store_true", help="solve only what is told: 2 spans before each count")
    parser.add_argument("--optimize", action="store_true", help="time what ~/optimize copies and merges at the end")
    args = parser.parse_args()
    limits = {"scene.max_keyframes": 10**7, "scene.max_landmarks": 10**8}
    backend = Backend(Config().with_values(limits))
    backend.add(rig())
    at = {count for count in (*args.at, args.keyframes) if count <= args.keyframes}
    times, profile = [], cProfile.Profile()
    print("| keyframes | ms a keyframe, mean | median | 95 % | landmarks | observations | MB |")
    print("|---:|---:|---:|---:|---:|---:|---:|", flush=True)
    for count, frame in enumerate(Corridor(args.tracks, still=args.still).frames(), start=1):
        profiled = args.profile and count > args.keyframes - args.span
        began = time.process_time()
        if profiled:
            profile.enable()
        for measurement in frame:
            backend.add(measurement)
        if args.quick and not any(0 <= one - count < 2 * args.span for one in at):
            # As if it had been solved, and the front-end were right.
            backend.scene.keyframes.solved[-1] = backend.scene.keyframes.refined[-1] = True
            continue
        estimate = backend.solve()
        profile.disable()
        times.append(1e3 * (time.process_time() - began))
        assert estimate is not None
        if count in at:
            last = np.array(times[-args.span :])
            sizes = f"{len(backend.scene.landmarks)} | {len(backend.scene.observations)} | {resident_mb():.0f}"
            figures = f"{last.mean():.2f} | {np.median(last):.2f} | {np.percentile(last, 95):.2f}"
            print(f"| {count} | {figures} | {sizes} |", flush=True)
        if count == args.keyframes:
            break
    if args.profile:
        pstats.Stats(profile).sort_stats("tottime").print_stats(45)
    if args.optimize:
        _time_optimization(backend)
    return 0


def _time_optimization(backend: Backend) -> None:
    times = [time.process_time()]
    begin = backend.copied()
    times.append(time.process_time())
    taken = begin()
    times.append(time.process_time())
    assert not isinstance(taken, str), taken
    taken.solve(backend.config.solver, max_iterations=1)
    times.append(time.process_time())
    backend.merge(taken)
    times.append(time.process_time())
    print(
        "copied in {:.2f} s, chosen in {:.2f} s, one iteration in {:.2f} s, merged in {:.2f} s".format(*np.diff(times))
    )


if __name__ == "__main__":
    sys.exit(main())
