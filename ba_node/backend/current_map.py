# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""One map and what solves have made of it; another takes its place when a session begins."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from collections.abc import Iterable
from typing import Any

import numpy as np

from ba_node import window
from ba_node.arrays import FloatArray, IdArray, IntArray
from ba_node.backend.summary import MapSummary, summary_of
from ba_node.backend.whole_map import MapCloud, MapPoses, poses_of
from ba_node.check import two_view
from ba_node.check.diagnosis import Diagnosis
from ba_node.check.watch import of_all
from ba_node.config import Config
from ba_node.core import geometry
from ba_node.core.calibration import Calibration
from ba_node.estimate import Correction, Estimate, Extras, Poses, Refinement, SolveReport, Status, Transform, World
from ba_node.measurements import Keyframe
from ba_node.scene.scene import Scene
from ba_node.window import arrival, culling, full, guard, old_keyframes, precision, quality, view
from ba_node.window.attempt import Following, attempt
from ba_node.window.correction import MapCorrection, Move
from ba_node.window.trust import Trust

# The front-end's frame where neither it nor the parameters name one.
_ODOM_FRAME = "odom"
# Keyframes from which it is learned how many cameras deliver.
_LEARN_FROM = 5


def can_examine() -> bool:
    """Return True where OpenCV is installed, which :meth:`CurrentMap.examine` needs."""
    return two_view.available()


class Completion:
    """What is known of the newest keyframe and of the cameras that delivered for those before it.

    Attributes:
        newest: id of the newest keyframe that came, None before the first.
        closed: True if it counts as complete with what has come.
        delivered: cameras that delivered for each of the last keyframes before it.
    """

    def __init__(self, newest: int | None = None, closed: bool = False, delivered: Iterable[int] = ()) -> None:
        self.newest, self.closed = newest, closed
        self.delivered = deque(delivered, maxlen=_LEARN_FROM)

    def begin(self, scene: Scene, keyframe_id: int) -> None:
        """Take a keyframe that the scene has now for the newest."""
        if self.newest is not None:
            row = scene.find_keyframe(self.newest)
            self.delivered.append(0 if row is None else len(scene.cameras_of(row)))
        self.newest, self.closed = keyframe_id, False

    def row(self, scene: Scene) -> int | None:
        """Return the row of the newest keyframe, None if there is none."""
        return None if self.newest is None else scene.find_keyframe(self.newest)

    def due(self, scene: Scene) -> IntArray:
        """Return the rows of complete keyframes that were not solved."""
        due = ~scene.keyframes.solved
        newest = self.row(scene)
        if newest is not None and not self._complete(scene, newest):
            due[newest] = False
        return due.nonzero()[0]

    def _complete(self, scene: Scene, row: int) -> bool:
        if self.closed:
            return True
        expected = max(self.delivered, default=0) or (len(scene.cameras.model) if scene.cameras is not None else 1)
        return len(scene.cameras_of(row)) >= expected


class CurrentMap:
    """The map of one session, with the report, the correction map -> odom and the trust that belong to it.

    Attributes:
        config: all parameters.
        scene: what is known.
        index: number of the map.
        completion: which keyframes are complete.
        report: of the last solve.
        correction: map from odom.
        calibration: what solves of everything found of the cameras, against those that came; None if not asked for.
        adjustments: how often a solve of everything went into it.
        precision: what is known of the front-end's steps.
    """

    def __init__(self, config: Config, scene: Scene, index: int) -> None:
        self.config, self.scene, self.index = config, scene, index
        self.completion = Completion()
        self.report = SolveReport(reason="not solved yet")
        self.correction = MapCorrection()
        self.calibration: Calibration | None = None
        self.adjustments = 0
        self._trust = Trust()
        self.precision = precision.Precision()
        # What is being asked of the front-end's steps, and whether the last solve has asked it.
        self._study: precision.Study | None = None
        self._asks = False

    @property
    def session_id(self) -> int:
        """Return the session, 0 before the first message that names one."""
        return self.scene.session_id or 0

    @property
    def keyframe_count(self) -> int:
        """Return how many keyframes there are."""
        return len(self.scene.keyframes)

    @property
    def solved_count(self) -> int:
        """Return how many keyframes were solved and need no other solve."""
        return int(np.count_nonzero(self.scene.keyframes.solved))

    @property
    def rejected(self) -> Counter[str]:
        """Return what was turned away, by reason (``rejections.REASONS``)."""
        return self.scene.log.rejected

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what somebody has to know or mend, in words."""
        return tuple(self.scene.log.warnings.values())

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the newest keyframe, 0 before the first."""
        return self.scene.newest_ns if self.keyframe_count else 0

    @property
    def odom_frame(self) -> str:
        """Return the name of the front-end's fixed frame."""
        return self.config.frames.odom_frame or self.scene.frame_id or _ODOM_FRAME

    def is_solved(self, session_id: int, keyframe_id: int) -> bool | None:
        """Return whether a keyframe was solved; None if it is not known here."""
        row = self.scene.find_keyframe(keyframe_id) if session_id == self.scene.session_id else None
        return None if row is None else bool(self.scene.keyframes.solved[row])

    @property
    def refined_count(self) -> int:
        """Return how many keyframes took part in a usable solve."""
        return int(np.count_nonzero(self.scene.keyframes.refined))

    def refined_among(self, keyframe_ids: Iterable[int]) -> set[int]:
        """Return which of some keyframes took part in a usable solve."""
        rows = ((key, self.scene.find_keyframe(key)) for key in keyframe_ids)
        return {key for key, row in rows if row is not None and self.scene.keyframes.refined[row]}

    def input_keyframes(self) -> list[Keyframe]:
        """Return the keyframes as the front-end sent them, in order of arrival."""
        table = self.scene.keyframes
        orientation = geometry.quaternion_from_matrix(table.input_rotation)
        rows = zip(table.keyframe_id.tolist(), table.stamp_ns.tolist(), table.input_position, orientation, strict=True)
        return [
            Keyframe(self.session_id, key, stamp_ns, self.scene.frame_id, position, quaternion)
            for key, stamp_ns, position, quaternion in rows
        ]

    def summary(self) -> MapSummary:
        """Return what there is to tell of the map."""
        return summary_of(self.scene, self.config)

    def examine(self) -> Diagnosis | None:
        """Return what the tracks tell about the set-up; None if there is nothing to look at.

        Raises:
            ImportError: OpenCV is missing.
        """
        return of_all(self.scene)

    def due(self) -> IntArray:
        """Return the rows of complete keyframes that were not solved and that the next solve refines, oldest first."""
        due = self.completion.due(self.scene)
        return _reached(self.scene, due, self._end(due))

    def solve(
        self,
        solve_count: int,
        wrong: str,
        wanted: Extras,
        following: Following,
    ) -> Estimate:
        """Refine the newest window; all solutions are held if it is said what is ``wrong``.

        ``wanted`` is worked out beside the estimate.
        """
        culling.cull(self.scene, self.config)
        due = self.completion.due(self.scene)
        end = self._end(due)
        taking_part = window.rows_of(self.scene, self.config, end)
        for text in arrival.parted(self.scene, due):
            self.scene.log.warn("parted", text)
        refined: Poses | None = None
        extra: dict[str, Any] = {}
        if wrong:
            self.hold_all(solve_count, wrong)
        else:
            refined, extra = self._solve((solve_count, taking_part), end, wanted, following)
        self.scene.keyframes.solved[_reached(self.scene, due, end)] = True
        refined = poses_of(self.scene, taking_part) if refined is None else refined
        return dataclasses.replace(self.estimate(refined), **extra)

    def _solve(
        self, which: tuple[int, IntArray], end: int, wanted: Extras, following: Following
    ) -> tuple[Poses | None, dict[str, Any]]:
        """Solve the newest window and report; return its poses, and what is wanted of a solution; None without one.

        ``which`` are the number of the solve and the keyframes of its window, oldest first.
        """
        count, taking_part = which
        newest = int(taking_part[-1])
        tried, moved = attempt(self.scene, self.config, end, self._trust, following), Move()
        if isinstance(tried, str):
            self.report = dataclasses.replace(self.base_report(count, newest), reason=tried)
            return None, {}
        selection, tracks, kernels = tried.selection, self.config.tracks, self.config.solver.kernels
        taken = None if tried.held else tried.found.state
        taking_part = selection.taking_part(self.scene)
        refined: Poses | None = None
        extra: dict[str, Any] = {}
        for stray in selection.strays:
            if text := stray.text(int(self.scene.keyframes.keyframe_id[stray.row])):
                self.scene.log.warn("stray", text)
        if tried.held:
            self.hold(tried.held)
        elif taken is not None:
            window.put_poses(self.scene, selection, taken, tried.without)
            moved = self._correct(int(taking_part[-1]))
            refined = poses_of(self.scene, taking_part)
            following.on_poses(self._refinement(refined))
        norms, state, _ = window.returned(selection, tried.found, tracks, kernels)
        agree = {"inlier_share": guard.inlier_share(selection, norms, self.config)} if tried.health else {}
        quality.note_unbounded(self.scene, self.config, norms)
        if taken is not None and state is not None:
            norms = window.apply(self.scene, selection, state, norms, tracks, kernels)
            rows = selection.keyframes, selection.landmarks, selection.origin
            old_keyframes.note(self.scene, self.config, selection.problem, state, rows)
            if text := arrival.first_jumped(self.scene, self.config):
                self.scene.log.warn("stray", text)
            if self._study is None:
                self._study = self.precision.study(self.scene, self.config, selection, state)
                self._asks = self._study is not None
            extra = view.work_out(wanted, self.scene, self.config, selection, state, taking_part)
        statistics = quality.statistics(selection, tried.result, norms) | tried.health | agree
        statistics |= {"status": Status.HELD, "reason": tried.held} if tried.held else {}
        statistics |= moved.statistics() | {"solve_time_s": tried.solve_time_s}
        self.report = dataclasses.replace(self.base_report(count, newest), **statistics)
        return refined if refined is not None else poses_of(self.scene, taking_part), extra

    def begun_study(self) -> precision.Study | None:
        """Return what the last solve asks of the front-end's steps; None if nothing, or if it was returned before."""
        asks, self._asks = self._asks, False
        return self._study if asks else None

    def learn(self, study: precision.Study) -> None:
        """Take in what was asked of the front-end's steps, if it was of this map."""
        if study is self._study:
            self._study = None
            self.precision.learn(study, self.config)

    def hold(self, reason: str) -> None:
        """Say that a solution is held; give up what was taken of a young map if many are."""
        text = f"a solution was held, the front-end's poses stand: {reason}"
        if self._trust.lost and self._young():
            self._trust.given_up = True
            self.scene.forget_solutions()
            self.correction = MapCorrection()
            self.correct(int(self.scene.order[-1]))
            text = f"solutions are held, and what was taken before is given up: {reason}"
        self.scene.log.warn("held", text)

    def _young(self) -> bool:
        """Return True while no more was refined than two windows hold."""
        return self.refined_count <= 2 * self.config.window.max_keyframes

    def hold_all(self, solve_count: int, reason: str) -> None:
        """Report that the set-up is wrong; the front-end's poses stand, and its frame is the map's."""
        newest = int(self.scene.order[-1])
        self.report = dataclasses.replace(self.base_report(solve_count, newest), status=Status.HELD, reason=reason)
        self.correction = MapCorrection()
        self.correct(newest)

    def correct(self, row: int) -> None:
        """Let the correction map -> odom follow what was found at a keyframe, and tell its size in the report."""
        self.report = dataclasses.replace(self.report, **self._correct(row).statistics())

    def _correct(self, row: int) -> Move:
        self.scene.propagate_corrections()
        table = self.scene.keyframes
        found = Transform(*self.scene.corrections(np.array(row)))
        body = Transform(table.input_rotation[row], table.input_position[row])
        return self.correction.update(self.config.frames, found, body, int(table.stamp_ns[row]))

    def _refinement(self, poses: Poses) -> Refinement:
        where = self.stamp_ns, self.config.frames.map_frame, self.session_id
        return Refinement(*where, poses, self._published(), self.index)

    def base_report(self, solve_count: int, newest: int) -> SolveReport:
        """Return what a report tells of any solve, by the row of its newest keyframe."""
        return SolveReport(
            session_id=self.session_id,
            solve_count=solve_count,
            newest_keyframe_id=int(self.scene.keyframes.keyframe_id[newest]),
            method=self.config.solver.method,
            rejected=dict(sorted(self.rejected.items())),
            warnings=self.warnings,
            adjustments=self.adjustments,
            merged_tracks=len(self.scene.constraints.renamed),
        )

    def rms_px(self, state: str = "refined") -> float:
        """Return the rms of all observations of the map, outliers too, px; see ``quality.rms_px``.

        Outliers count too; tracks with fewer than two views do not, nor do points without a position.
        """
        return quality.rms_px(self.scene, self.config, state)

    def estimate(self, refined: Poses | None = None) -> Estimate:
        """Return all that is known, with the poses that a solve refined, or all."""
        scene = self.scene
        scene.propagate_corrections()
        trajectory = MapPoses.taken(scene)
        return Estimate(
            stamp_ns=self.stamp_ns,
            frame_id=self.config.frames.map_frame,
            refined=trajectory if refined is None else refined,
            trajectory=trajectory,
            cloud=MapCloud.taken(scene),
            report=self.report,
            correction=self._published(),
            world=self.world(),
            map_index=self.index,
        )

    def calibrate(self, found: Calibration) -> None:
        """Take refined cameras for all that follows."""
        self.scene.refine_cameras(found.cameras)
        assert self.scene.given_cameras is not None
        self.calibration = found.since(self.scene.given_cameras)

    def with_covariances(self, estimate: Estimate, taken: full.Optimization) -> Estimate:
        """Return an estimate of everything with the covariances of a solve of everything that was merged."""
        found = taken.covariances
        if found is None:
            return estimate
        poses = _rows_by_id(estimate.refined.keyframe_id, taken.keyframe_id, found.poses)
        points = None if found.points is None else _rows_by_id(estimate.cloud.track_id, taken.track_id, found.points)
        return dataclasses.replace(estimate, covariance=poses, point_covariance=points)

    def world(self) -> World | None:
        """Return where the map lies in the world, None if that is not known."""
        known = self.scene.constraints
        if known.map_from_world is None:
            return None
        rotation, translation = geometry.inverse(*known.map_from_world)
        return World(known.world_frame, translation, geometry.quaternion_from_matrix(rotation), known.origin)

    def _published(self) -> Correction | None:
        transform = self.correction.published
        if transform is None:
            return None
        orientation = geometry.quaternion_from_matrix(transform.rotation)
        return Correction(self.odom_frame, transform.translation, orientation)

    def _end(self, due: IntArray) -> int:
        return _end_of_solve(self.scene, due, self.config.window.max_keyframes)


def _rows_by_id(wanted: IdArray, ids: IdArray, values: FloatArray) -> FloatArray:
    """Return the values of some ids, NaN for those that have none."""
    out = np.full((len(wanted), *values.shape[1:]), np.nan)
    _, here, there = np.intersect1d(wanted, ids, return_indices=True)
    out[here] = values[there]
    return out


def _end_of_solve(scene: Scene, due: IntArray, window_size: int) -> int:
    """Return how many keyframes, oldest first, there are up to the newest that the next solve is to refine."""
    n = len(scene.keyframes)
    first = int(scene.places()[due].min(initial=n))
    # With one solved keyframe at least in the window the newest can be reached at once.
    if first == n or n - first < window_size or n <= window_size:
        return n
    return first + window_size // 2


def _reached(scene: Scene, due: IntArray, end: int) -> IntArray:
    """Return which keyframes of those that are due stand among the first ``end``, oldest first."""
    return scene.by_time(due[scene.places()[due] < end])
