# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Track the images of a recording or a folder, and write what comes of it as a recording of keyframes and tracks.

The back-end runs along: what it refines goes back to the tracker, as it does live. The recording holds what the tracker
told, not what was refined.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.config.front_end import FrontEndOptions
from ba_node.core import geometry
from ba_node.estimate import Poses, Transform
from ba_node.front_end import FrontEnd, Images, State, Tracked
from ba_node.front_end.images import read_mask
from ba_node.front_end.streams import OdometryBuffer
from ba_node.io.trajectory import read_tum
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, LandmarkGuesses, Measurement
from ba_node.offline.image_times import far_off
from ba_node.offline.images import ImageRequest, ImageSource, open_images
from ba_node.offline.recording import record

_TRUTH = "poses.txt"
_FIRST_STEP = "the first step, 1 long"
# Nothing moves for so long where the camera stands, ns.
_STOOD_NS = 1_000_000_000


class TrackError(ValueError):
    """Images of which no recording comes."""


@dataclass(frozen=True)
class TrackRequest:
    """What to do with the images."""

    images: ImageRequest = field(default_factory=ImageRequest)
    options: FrontEndOptions = field(default_factory=FrontEndOptions)
    mask: Path | None = None  # a picture, black where nothing is to be looked at
    odometry: Path | None = None  # TUM file of fixed frame from body
    config: Config = field(default_factory=Config)  # of the back-end that runs along


def track(
    path: Path,
    out: Path,
    request: TrackRequest,
    clock: Callable[[], float] = lambda: 0.0,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> dict[str, Any]:
    """Track images; write the recording; return what there is to tell.

    Raises:
        BagError: there are no images, or nothing tells their rig.
        FrontEndError: the rig cannot be used, or a library is missing.
        TrackError: no keyframe came of the images.
        OSError: a file cannot be read or written.
    """
    poses = None if request.odometry is None else _poses(request.odometry)
    with open_images(path, dataclasses.replace(request.images, poses=poses)) as source:
        run = _Run(source, request, clock).track(progress)
        if not run.keyframes:
            why = "; ".join(run.notes) or "no image could be used"
            raise TrackError(f"{path}: no keyframe came of {source.total} images: {why}")
        truth = _truth(path, source, run)
        count = record(out, run.timeline(), truth, as_it_came=True)
        return run.report() | {"source": path.name, "messages": count, "truth": truth is not None}


def _poses(path: Path) -> OdometryBuffer:
    """Return the poses of an odometry, fixed frame from body, in a TUM file, whose lines may be in any order."""
    poses = read_tum(path)
    buffer = OdometryBuffer(len(poses))
    rotation = geometry.matrix_from_quaternion(poses.orientation)
    for row in np.argsort(poses.stamp_ns, kind="stable"):
        buffer.add(int(poses.stamp_ns[row]), Transform(rotation[row], poses.position[row]))
    return buffer


class _Run:
    """One pass over the images."""

    def __init__(self, source: ImageSource, request: TrackRequest, clock: Callable[[], float]) -> None:
        self.source, self.request = source, request
        self.rig: CameraRig = source.rig
        self.notes: list[str] = []
        self.stamps: list[int] = []  # of all images
        self.keyframes: list[Keyframe] = []
        self.measurements: list[tuple[int, Measurement]] = []
        self.states: Counter[str] = Counter()
        self._still: dict[int, list[int]] = {}  # stamps of images in which nothing moves, by that of the first of them
        self.busy_s = 0.0
        self._scales: dict[int, str] = {}  # what lengths are those of, by session
        self._clock = clock
        self._front_end: FrontEnd | None = None
        self._backend = Backend(request.config)

    def track(self, progress: Callable[[int, int], None]) -> _Run:
        """Track all images; say what was left out."""
        for done, (images, odometry) in enumerate(self.source.read(), start=1):
            self._take(images, odometry)
            progress(done, self.source.total)
        self.notes += self.source.warnings.values()
        if _FIRST_STEP in self._scales.values():
            self.notes += filter(None, [self.source.unused_odometry()])
        left = _left_out(self.source)
        if left:
            self.notes.append(left)
        if self.states[State.LOST.value]:
            self.notes.append(f"{self.states[State.LOST.value]} of {len(self.stamps)} images have no pose")
        told = self._front_end is not None and "ahead" in self._front_end.counts
        self.notes += filter(None, ["" if told else far_off(self.stamps), self._one_place()])
        return self

    def _one_place(self) -> str:
        """Return in words that the camera did not move enough for a second keyframe; empty if it did."""
        front_end, count = self._front_end, len(self.stamps)
        if front_end is None or count < 2 or self.states[State.LOST.value]:
            return ""
        seen = f"{count} images ({(self.stamps[-1] - self.stamps[0]) / 1e9:.1f} s)"
        if not self.keyframes and front_end.waits:
            return (
                f"the camera did not move enough in {seen} for a map to begin: one alone has to be carried along, as"
                " turning tells no depth"
            )
        if len(self.keyframes) == 1 and self.states[State.STARTING.value] == 0:
            far = f"{self.request.options.keyframe_parallax_px:g} px (keyframe_parallax_px)"
            return (
                f"the camera did not move enough in {seen} for a second keyframe: features stay within {far} of where"
                " they were, and one keyframe gives nothing to refine"
            )
        return ""

    def _take(self, images: Images, odometry: Transform | None) -> None:
        """Track images."""
        began = self._clock()
        front_end = self._front_end or self._begin(images)
        tracked = front_end.process(images, odometry)
        self.busy_s += self._clock() - began
        if tracked.keyframe is not None:
            self._scales.setdefault(tracked.session_id, _scale_of(images, front_end.scale))
        if tracked.still_since_ns is not None:
            self._still.setdefault(tracked.still_since_ns, []).append(images.stamp_ns)
        self.stamps.append(images.stamp_ns)
        self.states[tracked.state.value] += 1
        self.notes += [note for note in tracked.notes if note not in self.notes]
        self._add(tracked, front_end)

    def _begin(self, images: Images) -> FrontEnd:
        """Make the tracker; a rig that does not say how large its images are learns it from the first."""
        sizes = [self.rig.image_size[i] if self.rig.image_size[i].all() else grey.shape[::-1]
                 for i, grey in enumerate(images.grey)]  # fmt: skip
        size = np.array(sizes, dtype=np.int64)
        if len(size) == len(self.rig):
            self.rig = dataclasses.replace(self.rig, image_size=size)
        mask = None if self.request.mask is None else read_mask(self.request.mask)
        self._front_end = FrontEnd(self.rig, self.request.options, mask=mask)
        self._backend.add(self.rig)
        return self._front_end

    def _add(self, tracked: Tracked, front_end: FrontEnd) -> None:
        """Keep what came of images, and refine the tracker's map."""
        if tracked.again:
            self.keyframes, self.measurements = [], []
            self._backend.reset()
        for measurement in tracked.measurements():
            if isinstance(measurement, Keyframe):
                self.keyframes.append(measurement)
            self.measurements.append((self.keyframes[-1].stamp_ns, measurement))
            self._backend.add(measurement)
        if tracked.measurements():
            self._backend.flush()
            estimate = self._backend.solve()
            if estimate is not None and estimate.report.status.usable:
                front_end.refine(estimate.refined, estimate.cloud)

    def timeline(self) -> Iterator[tuple[str, int, Measurement]]:
        """Yield topic, stamp and measurement of all that is to be recorded."""
        yield "camera_rig", self.measurements[0][0], self.rig
        topics = {Keyframe: "keyframes", FeatureTracks: "feature_tracks", LandmarkGuesses: "landmark_guesses"}
        for stamp_ns, measurement in self.measurements:
            yield topics[type(measurement)], stamp_ns, measurement

    @property
    def scale_from(self) -> str:
        """Return in words what lengths are those of; where sessions differ, of each kind how many are so."""
        kinds = Counter(self._scales[number] for number in dict.fromkeys(one.session_id for one in self.keyframes))
        return "; ".join(f"{words} ({count} sessions)" if len(kinds) > 1 else words for words, count in kinds.items())

    def report(self) -> dict[str, Any]:
        """Return what there is to tell."""
        tracks = [one for _, one in self.measurements if isinstance(one, FeatureTracks)]
        front_end = self._front_end
        assert front_end is not None
        turn = front_end.alignment
        stood = [stamps for stamps in self._still.values() if stamps[-1] - stamps[0] >= _STOOD_NS]
        learned = None if turn is None or len(self.rig) < 2 else [*turn[0].tolist(), *turn[1].tolist()]
        return {
            "mode": self.source.mode,
            "scale_from": self.scale_from,
            "images": len(self.stamps),
            "keyframes": len(self.keyframes),
            "sessions": len({one.session_id for one in self.keyframes}),
            "tracks": len(np.unique(np.concatenate([one.track_id for one in tracks]))),
            "observations": sum(len(one.track_id) for one in tracks),
            "states": dict(self.states),
            "stood_images": sum(len(stamps) for stamps in stood),
            "stood_s": sum(stamps[-1] - stamps[0] for stamps in stood) / 1e9,
            "stereo_turn_px": learned,
            "time_per_image_s": self.busy_s / max(len(self.stamps), 1),
            "left_out": dict(self.source.counted),
            "causes": front_end.counts,
            "notes": self.notes,
        }


def _scale_of(images: Images, scale: str) -> str:
    """Return in words what the lengths of a map are those of, by ``FrontEnd.scale`` and its first images."""
    if scale == "measured":
        return "measured depths" if images.depth_m is not None else "the baseline of the cameras"
    return _FIRST_STEP if scale == "free" else "the odometry: one camera cannot tell whether it is right"


def _left_out(source: ImageSource) -> str:
    """Return which images were left out by the reader, in words."""
    parts = [
        f"{count} images: {reason}{' (' + source.notes[reason] + ')' if reason in source.notes else ''}"
        for reason, count in sorted(source.counted.items())
    ]
    return "left out " + "; ".join(parts) if parts else ""


def _truth(path: Path, source: ImageSource, run: _Run) -> Poses | None:
    """Return the true poses of keyframes from a folder in KITTI's layout: a line an image, world from first camera."""
    file = path / _TRUTH
    if not path.is_dir() or not file.exists() or source.rig.position[0].any():
        return None
    values = np.array(file.read_text().split(), dtype=np.float64)
    if len(values) != 12 * source.total or source.total != len(run.stamps):
        why = f"{len(values)} numbers, expected 12 for each of {source.total} images"
        if len(values) == 12 * source.total:
            why = f"a line for each of {source.total} images, of which {len(run.stamps)} were taken"
        run.notes.append(f"{file}: {why}: left aside")
        return None
    matrix = values.reshape(-1, 3, 4)
    stamps: Sequence[int] = run.stamps
    rows = np.array([bisect_left(stamps, one.stamp_ns) for one in run.keyframes])
    ids = np.array([one.keyframe_id for one in run.keyframes], dtype=np.uint64)
    rotation = geometry.nearest_rotation(matrix[rows, :, :3])
    orientation = geometry.quaternion_from_matrix(rotation)
    return Poses(ids, np.array(stamps, dtype=np.int64)[rows], matrix[rows, :, 3], orientation)
