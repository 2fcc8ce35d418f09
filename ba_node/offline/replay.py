# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the back-end on a recording, without a middleware: the same recording gives the same bytes every time.

Every keyframe is solved once, when the next one begins, so nothing depends on how fast the machine is. Times are in
report.json alone.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ba_node import native
from ba_node.backend import Backend, MapEnded, MapSummary
from ba_node.config import Config
from ba_node.estimate import Estimate, Extras, Poses
from ba_node.evaluation.alignment import EvaluationError
from ba_node.evaluation.metrics import absolute_error
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import TopicChoice
from ba_node.io.bag_writer import BagWriter
from ba_node.io.files import locked_folder, whole_file, write_json
from ba_node.io.map_file import load_map, map_name, write_map
from ba_node.io.parameters import NODE_NAME, parameters_yaml
from ba_node.io.ply import write_ply
from ba_node.io.ros_types import ROSBAGS_FACTORY
from ba_node.io.trajectory import write_tum
from ba_node.measurements import CameraRig, FeatureTracks, Keyframe, Measurement
from ba_node.messages.outputs import output_messages
from ba_node.messages.topics import LATCHED_OUTPUTS, OUTPUT_TYPES, WHOLE_MAP
from ba_node.offline.attention import attention
from ba_node.offline.keyframe_images import images_of
from ba_node.offline.recording import arriving, placed, read_truth
from ba_node.offline.run_folder import recording_facts, shown_keyframe, versions, write_details
from ba_node.offline.session_record import SessionRecord

# Topics that hold the whole map: written again only when it has grown by this share, or a long recording would
# leave a file that grows with the square of its length.
_GROWTH = 0.02


class ReplayError(ValueError):
    """A recording that leaves nothing to write."""


@dataclass(frozen=True)
class Watch:
    """What a replay takes from outside."""

    clock: Callable[[], float] = lambda: 0.0  # seconds, for the times in report.json alone
    # called with the number of messages read and of all messages
    progress: Callable[[int, int], None] = lambda _done, _total: None


@dataclass(frozen=True)
class MapOptions:
    """What is done before and after the recording."""

    load: Path | None = None  # map to begin with; the recording must go on in its session
    optimize: bool = False  # refine everything of the newest session at the end
    covariance: bool = False  # and work out how precise all poses and points are then
    save: Path | None = None  # file for the map of the newest session
    # which topics of the recording are taken, where several are possible
    topics: TopicChoice = field(default_factory=TopicChoice)
    by: Callable[..., Any] | None = None  # what solves everything at the end in place of solver.solve


def replay(
    bag: Path | Sequence[Path],
    out: Path,
    config: Config,
    watch: Watch = Watch(),
    options: MapOptions = MapOptions(),
) -> dict[str, Any]:
    """Replay a recording and write the results; return the content of report.json.

    The newest session's files go to ``out``, those of older sessions to ``out/session_<id>``, with a number behind
    where an id comes again. report.json is written last: where it stands, all others are whole.

    The recording is a file, a folder, or its files in any order.

    Raises:
        BagError: the recording cannot be read.
        FolderInUseError: another process writes into the folder.
        MapFileError: the map cannot be loaded.
        ReplayError: it holds no keyframe that can be used.
        OSError: a file cannot be written.
    """
    with contextlib.ExitStack() as stack:
        reader = stack.enter_context(BagReader(bag, options.topics))
        stack.enter_context(locked_folder(out))
        (out / "report.json").unlink(missing_ok=True)
        with BagWriter(out / "refined.mcap") as writer:
            run = _Run(config, writer, watch)
            if options.load is not None:
                run.load(options.load)
            messages = arriving(reader.measurements(options.load is not None), run.backend)
            run.read(placed(messages, reader, config.frames), reader.message_count)
            run.backend.extras = Extras(covariance=options.covariance, points=options.covariance)
            run.end(options.optimize, options.by)
            if not run.sessions:
                raise ReplayError(f"{reader.path}: {_nothing_to_use(run)}{_why(reader, run)}")
            if run.sessions[-1].summary.cameras == 0:
                refused = run.sessions[-1].summary.refused_rig or "none came"
                raise ReplayError(f"{reader.path}: no camera rig that can be used: {refused}")
        truth = read_truth(reader)
        report = {
            "bag": reader.path.name,
            "kernels": native.description(config.solver.kernels),
            **_write(out, run.sessions, truth, _images(reader, run)),
        }
        report |= {"topics_taken": reader.taken, "topics_left": reader.left, "cameras_adjusted": run.camera_notes}
        report["bag_warnings"] = dict(reader.warnings)
        report["bag_rejected"] = dict(sorted(reader.rejected.items()))
        report["bag_notes"] = list(reader.rejection_notes)
        report["known_already"] = len(run.known_already)
        if run.backend.map.calibration is not None:
            report["calibration"] = run.backend.map.calibration.as_dicts()
            report["cameras_refined"] = run.backend.map.calibration.lines()
        report["recording"] = recording_facts(reader.paths)
        report["versions"] = versions(report["kernels"])
        report["attention"] = attention(report)
        if options.covariance:
            _write_covariances(out / "covariance.npz", run.sessions[-1].last)
        if options.save is not None:
            write_map(map_name(options.save), run.backend.snapshot())
        with whole_file(out / "effective.yaml") as file:
            file.write(parameters_yaml(config, comments=False).encode())
        write_json(out / "report.json", report)
    return report


def rehearse(measurements: Sequence[Measurement], config: Config, watch: Watch = Watch()) -> list[SessionRecord]:
    """Replay measurements and write nothing; return what each session gave."""
    run = _Run(config, None, watch)
    run.read(measurements, len(measurements))
    run.end(optimize=False)
    return run.sessions


class _Run:
    """One pass over the measurements; what comes out is written if there is a writer."""

    def __init__(self, config: Config, writer: BagWriter | None, watch: Watch) -> None:
        self.backend = Backend(config, clock=watch.clock)
        self.sessions: list[SessionRecord] = []
        self._config = config
        self._writer = writer
        self._watch = watch
        self.counted: Counter[type] = Counter()
        self.known_already: set[int] = set()
        self._known: set[int] = set()
        self._inputs: dict[int, Keyframe] = {}
        self._written = 0
        self.camera_notes: list[str] = []
        self.frames: tuple[str, ...] = ()  # of the cameras

    def load(self, path: Path) -> None:
        """Begin with a map."""
        self.backend.take_over(load_map(path, self._config.scene))
        inputs = self.backend.map.input_keyframes()
        self._known = {keyframe.keyframe_id for keyframe in inputs}
        self._inputs = {keyframe.keyframe_id: keyframe for keyframe in inputs}

    def read(self, measurements: Iterable[Measurement], total: int) -> None:
        for event in self.backend.replay(self._counting(measurements, total)):
            if isinstance(event, Estimate):
                self._record(event)
            elif isinstance(event, Keyframe):
                if event.keyframe_id in self._known and event.session_id == self.backend.map.session_id:
                    self.known_already.add(event.keyframe_id)
                self._inputs.setdefault(event.keyframe_id, event)
            else:
                self._map_ended(event)

    def _counting(self, measurements: Iterable[Measurement], total: int) -> Iterator[Measurement]:
        for done, measurement in enumerate(measurements, start=1):
            self.counted[type(measurement)] += 1
            if isinstance(measurement, CameraRig):
                self.frames = self.frames or measurement.names
                self.camera_notes += [note for note in measurement.notes if note not in self.camera_notes]
            yield measurement
            self._watch.progress(done, total)

    def end(self, optimize: bool, by: Callable[..., Any] | None = None) -> None:
        """End the newest session, after a solve of everything if that is wanted."""
        estimate = self.backend.optimize(by) if optimize else None
        if estimate is not None:
            self._record(estimate)
        if not self.sessions and self.backend.map.keyframe_count:
            # A loaded map to which the recording added nothing.
            self._begin(self.backend.estimate())
        self._close(self.backend.map.summary())

    def _map_ended(self, ended: MapEnded) -> None:
        self._close(ended.summary)
        self._known = set()
        if ended.replaced and self.sessions:
            self.sessions.pop()

    def _record(self, estimate: Estimate) -> None:
        if not self.sessions or self.sessions[-1].map_index != estimate.map_index:
            self._begin(estimate)
        self.sessions[-1].add(estimate, self.backend.map)
        if len(estimate.trajectory) >= (1.0 + _GROWTH) * self._written:
            self._written = len(estimate.trajectory)
            self._write(estimate, OUTPUT_TYPES)
        else:
            self._write(estimate, OUTPUT_TYPES.keys() - set(WHOLE_MAP))

    def _begin(self, estimate: Estimate) -> None:
        session_id = self.backend.map.session_id
        self.sessions.append(SessionRecord(session_id, estimate, inputs=self._inputs))
        self._written = 0

    def _close(self, summary: MapSummary) -> None:
        """End a session: its whole map is written once more if the last estimate was not."""
        record = self.sessions[-1] if self.sessions else None
        if record is not None and not record.closed:
            record.close(summary)
            if len(record.last.trajectory) > self._written:
                self._write(record.last, WHOLE_MAP)
        self._inputs = {}

    def _write(self, estimate: Estimate, wanted: Container[str]) -> None:
        if self._writer is None:
            return
        timeless = dataclasses.replace(estimate, report=dataclasses.replace(estimate.report, solve_time_s=0.0))
        for topic, kind, message in output_messages(ROSBAGS_FACTORY, timeless, self._config.output, wanted):
            time_ns = max(0, estimate.stamp_ns)
            self._writer.write(f"/{NODE_NAME}/{topic}", kind, message, time_ns, latched=topic in LATCHED_OUTPUTS)


def _images(reader: BagReader, run: _Run) -> dict[int, NDArray[np.uint8]]:
    """Return images of the keyframe of the newest session that has the most residuals."""
    record = run.sessions[-1]
    poses = record.last.trajectory
    place = shown_keyframe(record)
    return images_of(reader, int(poses.stamp_ns[place]), run.frames) if place < len(poses) else {}


def _write(
    out: Path, sessions: list[SessionRecord], truth: Poses | None, images: dict[int, NDArray[np.uint8]]
) -> dict[str, Any]:
    """Write the files of every session; return the summary of the newest, with those of the older ones in it."""
    folders = [*(out / name for name in _folder_names(sessions[:-1])), out]
    for folder, record in zip(folders, sessions, strict=True):
        folder.mkdir(exist_ok=True)
        write_tum(folder / "trajectory.tum", record.trajectory)
        write_tum(folder / "trajectory_input.tum", record.input_trajectory)
        write_ply(folder / "points.ply", record.last.cloud, record.last.frame_id)
        write_details(folder, record, images if record is sessions[-1] else {})
    summaries = [record.as_dict() | _against(truth, record) for record in sessions]
    for folder, entry in zip(folders[:-1], summaries, strict=False):
        entry["folder"] = folder.name
    if truth is not None:
        write_tum(out / "ground_truth.tum", truth)
    return {**summaries[-1], "older_sessions": summaries[:-1]}


def _write_covariances(path: Path, last: Estimate) -> None:
    """Write the covariances of all poses (x, y, z, rotation about X, Y, Z) and points (x, y, z) of the map by id."""
    found = (last.covariance, last.point_covariance)
    poses, points = (np.empty((0, n, n)) if one is None else one for one, n in zip(found, (6, 3), strict=True))
    with whole_file(path) as file:
        np.savez_compressed(
            file,
            keyframe_id=last.refined.keyframe_id[: len(poses)],
            pose=poses,
            track_id=last.cloud.track_id[: len(points)],
            point=points,
        )


def _against(truth: Poses | None, record: SessionRecord) -> dict[str, Any]:
    """Return the error against the truth in the recording before and after, if it has one that can be compared."""
    if truth is None:
        return {}
    try:
        errors = {
            name: absolute_error(poses, truth).translation.rmse
            for name, poses in (("input", record.input_trajectory), ("refined", record.trajectory))
        }
    except EvaluationError as error:
        return {"trajectory_error_m": None, "trajectory_error_note": str(error)}
    return {"trajectory_error_m": errors}


def _folder_names(sessions: list[SessionRecord]) -> Iterator[str]:
    """Yield the name of each session's folder; a session that began anew under its id gets a number behind."""
    times: Counter[int] = Counter()
    for record in sessions:
        times[record.session_id] += 1
        again = times[record.session_id]
        yield f"session_{record.session_id}" + (f"_{again}" if again > 1 else "")


def _nothing_to_use(run: _Run) -> str:
    """Say what there was of each kind of message, as no keyframe could be used."""
    counts = [run.counted[kind] for kind in (Keyframe, FeatureTracks, CameraRig)]
    reason = f"none of {counts[0]} keyframes can be used" if counts[0] else "it holds no keyframes"
    return f"{reason} (tracks messages: {counts[1]}, camera rigs: {counts[2]})"


def _why(reader: BagReader, run: _Run) -> str:
    reason = reader.rejection_notes[-1] if reader.rejection_notes else run.backend.map.summary().rejection_cause
    return f": {reason}" if reason else ""
