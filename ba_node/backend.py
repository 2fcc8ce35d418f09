# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Take measurements in, give refined estimates out: what the node and the offline tools both use.

A keyframe is complete when as many cameras delivered tracks for it as for the keyframes before it, when a newer one
came, or when :meth:`Backend.flush` says so. The node drains its inbox and then solves once, for the newest::

    for measurement in waiting:
        backend.add(measurement)
    if backend.ready:
        publish(backend.solve())

A replay solves once for every keyframe, however the messages are spaced, just before the next one begins::

    for measurement in recording:
        if backend.completes(measurement):
            write(backend.solve())
        backend.add(measurement)
    backend.flush(final=True)
    while backend.ready:
        write(backend.solve())

When more keyframes came at once than a window holds, a solve takes the oldest half a window of them, and ``ready``
stays True until the newest is reached. Tracks that come late take part from the next solve on; they make their keyframe
due again if it was not refined without them. A higher session id begins a new map with the same rig; the last estimate
of the one before is kept in ``finished``. So do keyframes far older than the newest, as when a recording is played
again; their session id stays as the front-end has it. A keyframe that is odd is held until others tell what it was, see
``scene/sessions.py``; then several are taken in at once, and whoever wants a solve for each of them writes::

    for admitted in backend.admit(measurement):
        if backend.completes(admitted):
            write(backend.solve())
        backend.take(admitted)

Nothing here reads a clock: the caller passes one, for the report alone.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import TYPE_CHECKING, Any

import numpy as np

from ba_node import archive, window
from ba_node.check.watch import SetUpWatch
from ba_node.core import geometry
from ba_node.estimate import Correction, Estimate, Extras, SolveReport, Status
from ba_node.measurements import CameraRig, Keyframe, Measurement
from ba_node.scene import ingest
from ba_node.scene.candidates import Admitted, Begin, Decision, refuse_lone
from ba_node.scene.frame_names import check_name
from ba_node.scene.scene import Scene
from ba_node.scene.sessions import Sessions
from ba_node.window import extras, full, guard, quality
from ba_node.window.attempt import attempt
from ba_node.window.correction import MapCorrection, Transform
from ba_node.window.known import cloud_of, poses_of, taking_part_of
from ba_node.window.trust import Trust

if TYPE_CHECKING:
    from collections.abc import Callable

    from ba_node.check.diagnosis import Diagnosis
    from ba_node.config import Config
    from ba_node.core.problem import Cameras, State
    from ba_node.core.result import Iteration
    from ba_node.scene.map_content import MapContent
    from ba_node.scene.tables import IntArray

__all__ = ["FINISHED_KEPT", "Admitted", "Backend"]

FINISHED_KEPT = 8
_REFUSED_KEPT = 1000
# Keyframes from which it is learned how many cameras deliver.
_LEARN_FROM = 5
_UNSOLVED = "not solved yet"
# The front-end's frame where neither it nor the parameters name one.
_ODOM_FRAME = "odom"


def _no_clock() -> float:
    return 0.0


class Backend:
    """The back-end, single-threaded. :meth:`add` and :meth:`solve` raise on no data whatever.

    Attributes:
        config: all parameters; change with :meth:`configure`.
        scene: the current map.
        finished: session id and last estimate of the sessions before, oldest first, the last few.
        solve_count: solves since the beginning.
        map_index: number of the current map; it rises when another takes its place, whatever the session ids.
        jumps: sessions that began although the front-end did not raise the session id.
        jump_note: the last of these in words.
        refused: the last keyframes that were turned away.
        extras: what the next solve is to work out beside the estimate.
        setup: the check of the set-up; while it gives a reason, every solve is held.
        refusal: why the last solve of everything was held, in words; empty if it was not.
    """

    def __init__(self, config: Config, *, clock: Callable[[], float] = _no_clock) -> None:
        """Start with an empty map. ``clock`` returns seconds and only fills ``solve_time_s``."""
        self.config = config
        self.scene = Scene(config.scene)
        self.finished: list[tuple[int, Estimate]] = []
        self.solve_count = 0
        self.map_index = 0
        self.jumps = 0
        self.jump_note = ""
        self.refused: deque[Keyframe] = deque(maxlen=_REFUSED_KEPT)
        self.extras = Extras()
        self.setup = SetUpWatch()
        self.refusal = ""
        self._clock = clock
        self._sessions = Sessions()
        self._current: int | None = None
        self._settled = False
        self._delivered: deque[int] = deque(maxlen=_LEARN_FROM)
        self._report = SolveReport(reason=_UNSOLVED)
        self._correction = MapCorrection()
        self._trust = Trust()

    @property
    def rejected(self) -> Counter[str]:
        """Return what was turned away in this session, by reason (``rejections.REASONS``)."""
        return self.scene.log.rejected

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what somebody has to know or mend, in words."""
        return tuple(self.scene.log.warnings.values())

    @property
    def report(self) -> SolveReport:
        """Return the report of the last solve, with what has been turned away since."""
        counts = dict(sorted(self.rejected.items()))
        return dataclasses.replace(
            self._report, session_id=self.scene.session_id or 0, rejected=counts, warnings=self.warnings
        )

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the newest keyframe, 0 before the first."""
        return int(self.scene.keyframes.stamp_ns[self.scene.order[-1]]) if len(self.scene.order) else 0

    @property
    def notices(self) -> Counter[str]:
        """Return what was unusual but used in this session, by kind (``rejections.NOTICES``)."""
        return self.scene.log.notices

    @property
    def rejection_notes(self) -> deque[str]:
        """Return the last rejections in words, oldest first."""
        return self.scene.log.notes

    @property
    def ready(self) -> bool:
        """Return True if a complete keyframe has not been solved yet."""
        return len(self._due()) > 0

    @property
    def due(self) -> tuple[int, int] | None:
        """Return session and id of the newest keyframe that the next solve is for, None if it is for none."""
        due = self._due()
        reached = self._reached(due, self._end(due))
        session = self.scene.session_id
        if session is None or not len(reached):
            return None
        return session, int(self.scene.keyframes.keyframe_id[reached[-1]])

    def configure(self, config: Config) -> None:
        """Take new parameters, from the next solve and the next measurement on."""
        self.config = config
        self.scene.config = config.scene

    @property
    def held(self) -> list[Keyframe]:
        """Return the keyframes that wait for others to tell what they are."""
        return self._sessions.held

    def completes(self, what: Measurement | Admitted) -> bool:
        """Return True if adding this would begin a new keyframe (or session) while the last one is unsolved."""
        if isinstance(what, CameraRig) or self.scene.keyframes.solved.all():
            return False
        admitted = (what,) if isinstance(what, Admitted) else self._sessions.decide(self.scene, what).admitted
        return any(self._is_new(one) for one in admitted)

    def add(self, measurement: Measurement) -> None:
        """Take in a measurement; what cannot be used is counted in ``rejected``."""
        for admitted in self.admit(measurement):
            self.take(admitted)

    def admit(self, measurement: Measurement) -> tuple[Admitted, ...]:
        """Return what is to be taken in now, in order: nothing while a keyframe is held, several once that is over."""
        decision = self._sessions.decide(self.scene, measurement)
        self._sessions.commit(measurement, decision)
        return self._decided(decision)

    def admit_rest(self) -> tuple[Admitted, ...]:
        """Return what is to be taken in of all that is held, as nothing more will come."""
        decision = self._sessions.end(self.scene)
        self._sessions.commit(None, decision)
        return self._decided(decision)

    def take(self, admitted: Admitted) -> None:
        """Take in what :meth:`admit` returned."""
        measurement = admitted.measurement
        if isinstance(measurement, CameraRig) and self.config.frames.poses_of == "camera":
            measurement = ingest.seen_from_first(measurement)
        if admitted.begins is not None:
            assert isinstance(measurement, Keyframe)
            self._begin(measurement.session_id, admitted.begins)
        if not isinstance(measurement, Keyframe):
            self.scene.add(measurement)
            return
        last, is_new = self._current, self._is_new(admitted)
        self.scene.add(measurement)
        if not is_new or self.scene.find_keyframe(measurement.keyframe_id) is None:
            self.refused.append(measurement)
            return
        named = self.config.frames.odom_frame
        check_name(measurement, named, named or self.scene.frame_id or _ODOM_FRAME, self.scene.log)
        if last is not None:
            self._delivered.append(self._cameras_of(last))
        self._current, self._settled = measurement.keyframe_id, False

    def flush(self, final: bool = False) -> None:
        """Call the newest keyframe complete with what has come, and let a session begin that the front-end asked for.

        Args:
            final: nothing more will come: give up on what waits for its keyframe or for the rig.
        """
        self._settled = True
        if final:
            rest = self.admit_rest()
        else:
            decision = self._sessions.settle(self.scene)
            self._sessions.commit(None, decision)
            rest = self._decided(decision)
        for admitted in rest:
            self.take(admitted)
        if rest:
            self._settled = True
        if final:
            self.scene.end_pending()

    def solve(self, on_iteration: Callable[[Iteration], bool] | None = None) -> Estimate | None:
        """Refine the newest window; None while there is no keyframe.

        Args:
            on_iteration: called with each iteration; returning False ends the solve after it.

        Returns:
            The estimate. After a failed or skipped solve poses and points are as before, and the report says why.
        """
        if len(self.scene.keyframes) == 0:
            return None
        due = self._due()
        end = self._end(due)
        wrong = self.setup.look(self.scene) if self.config.guard.check_setup else ""
        taking_part = window.rows_of(self.scene, self.config, end)
        self.solve_count += 1
        newest = int(self.scene.keyframes.keyframe_id[taking_part[-1]])
        extra: dict[str, Any] = {}
        if wrong:
            self._hold_all()
        selection, state = (None, None) if wrong else self._solve(newest, end, on_iteration)
        if selection is not None:
            taking_part = taking_part_of(self.scene, selection)
            if state is not None:
                self._correct(int(taking_part[-1]))
                extra = extras.work_out(self.extras, self.scene, self.config, selection, state, taking_part)
        self.scene.keyframes.solved[self._reached(due, end)] = True
        return dataclasses.replace(self._estimate(taking_part), **extra)

    def take_check(self, checked: Scene, found: Diagnosis) -> Estimate | None:
        """Take in a check of the set-up that was made elsewhere; return what is known now if it undoes all solves."""
        if checked is not self.scene or not self.setup.take(checked, found):
            return None
        self._hold_all()
        return self.estimate()

    def estimate(self) -> Estimate:
        """Return all that is known, with the report of the last solve."""
        return self._estimate(self.scene.order)

    def merge(self, taken: full.Copy, solved: full.Solved) -> tuple[Estimate, int] | None:
        """Put the result of a solve of everything into the map, see ``window/full.py``.

        Returns:
            What is known now, and how many later keyframes followed; None if the result is of no use or of another map.
        """
        result, self.refusal = solved.result, ""
        if not result.status.usable or not result.state.is_finite():
            return None
        found = taken.outcome(result.state, self.config)
        verdict = guard.judge(self.config, taken.selection, found)
        self.refusal = self.setup.reason(self.scene) or ("" if verdict.odd else verdict.reason)
        if self.refusal:
            self._hold(f"a solve of everything: {self.refusal}")
            return None
        assert found.state is not None
        followed = full.put(self.scene, self.config, taken, found.state)
        if followed is None:
            return None
        self.solve_count += 1
        newest = int(self.scene.order[-1])
        figures = quality.figures(taken.selection, result, found.norms) | dataclasses.asdict(verdict.health)
        report = self._base_report(int(self.scene.keyframes.keyframe_id[newest]))
        self._report = dataclasses.replace(report, **figures)
        self._correct(newest)
        return self.estimate(), followed

    def reset(self) -> None:
        """Forget everything but the cameras and the count of solves: the next keyframe begins a map, in any session."""
        self.finished = []
        self._sessions.reset()
        self._renew(None, self.scene.next_cameras or self.scene.cameras)
        self._report = SolveReport(reason="reset: the map is empty")

    def snapshot(self) -> MapContent:
        """Return a copy of all that is known, for a file; see docs/map_format.md."""
        current = None if self._current is None else self.scene.find_keyframe(self._current)
        delivered = tuple(self._delivered)
        return archive.pack(
            archive.Known(
                self.scene,
                self.finished,
                self._report,
                self._correction,
                current,
                self._settled,
                delivered,
                self.solve_count,
            )
        )

    def take_over(self, known: archive.Known) -> None:
        """Put what a file held in the place of all that is known; parameters stay, and ``solve_count`` if it is higher.

        Keyframes of the same session are taken in from there on; a higher session begins a new map, as always.
        """
        self.scene, self._report, self._correction = known.scene, known.report, known.correction
        self.scene.config = self.config.scene
        self.map_index += 1
        self._sessions.reset(set(self.scene.keyframes.keyframe_id.tolist()))
        self._trust = Trust()
        self.finished = known.finished[-FINISHED_KEPT:]
        self._current = None if known.current is None else int(self.scene.keyframes.keyframe_id[known.current])
        self._settled = known.settled
        self._delivered = deque(known.delivered, maxlen=_LEARN_FROM)
        self.solve_count = max(self.solve_count, known.solve_count)

    def rms_px(self, state: str = "refined") -> float:
        """Return the root mean square reprojection error per coordinate over all observations of the map, px.

        Outliers count too; tracks with fewer than two views do not, nor do points without a position.

        Args:
            state: ``refined``, or ``input`` for the front-end's poses and guesses (without a guess: triangulated).
        """
        return quality.rms_px(self.scene, self.config, state)

    def _solve(
        self, newest: int, end: int, on_iteration: Callable[[Iteration], bool] | None
    ) -> tuple[window.Selection | None, State | None]:
        """Solve the newest window and report; return what was solved, and the solution if it was taken."""
        tried = attempt(self.scene, self.config, end, self._trust, clock=self._clock, on_iteration=on_iteration)
        if isinstance(tried, str):
            self._report = dataclasses.replace(self._base_report(newest), reason=tried)
            return None, None
        selection, (norms, state, _) = tried.selection, tried.found
        for stray in selection.strays:
            text = stray.text(int(self.scene.keyframes.keyframe_id[stray.row]))
            if text:
                self.scene.log.warn("stray", text)
        if tried.held:
            self._hold(tried.held)
            state = None
        elif state is not None:
            norms = window.put(self.scene, selection, state, norms, self.config.tracks, self.config.solver.kernels)
            self.scene.keyframes.refined[list(tried.without)] = False
        figures = quality.figures(selection, tried.result, norms) | dataclasses.asdict(tried.health)
        if tried.held:
            figures |= {"status": Status.HELD, "reason": tried.held}
        self._report = dataclasses.replace(self._base_report(newest), **figures, solve_time_s=tried.solve_time_s)
        return selection, state

    def _hold(self, reason: str) -> None:
        """Say that a solution is held; give up what was taken of a young map if many are."""
        text = f"a solution was held, the front-end's poses stand: {reason}"
        if self._trust.lost and self._young():
            self.scene.forget_solutions()
            self._correction = MapCorrection()
            text = f"solutions are held, and what was taken before is given up: {reason}"
        self.scene.log.warn("held", text)

    def _young(self) -> bool:
        """Return True while no more was refined than two windows hold."""
        return int(np.count_nonzero(self.scene.keyframes.refined)) <= 2 * self.config.window.max_keyframes

    def _hold_all(self) -> None:
        """Report that the set-up is wrong; the front-end's poses stand, and its frame is the map's."""
        newest = int(self.scene.order[-1])
        report = self._base_report(int(self.scene.keyframes.keyframe_id[newest]))
        self._report = dataclasses.replace(report, status=Status.HELD, reason=self.setup.reason(self.scene))
        self._correction = MapCorrection()
        self._correct(newest)

    def _correct(self, row: int) -> None:
        """Let the correction map -> odom follow what was found at a keyframe, and tell its size in the report."""
        self.scene.settle_poses()
        table = self.scene.keyframes
        found = Transform(*self.scene.corrections(np.array(row)))
        body = Transform(table.input_rotation[row], table.input_position[row])
        move = self._correction.update(self.config.frames, found, body, int(table.stamp_ns[row]))
        self._report = dataclasses.replace(
            self._report, correction_m=move.distance_m, correction_rad=move.angle_rad, correction_held=move.held
        )

    def _base_report(self, newest: int) -> SolveReport:
        return SolveReport(
            session_id=self.scene.session_id or 0,
            solve_count=self.solve_count,
            newest_keyframe_id=newest,
            method=self.config.solver.method,
            rejected=dict(sorted(self.rejected.items())),
            warnings=self.warnings,
        )

    def _estimate(self, refined: IntArray) -> Estimate:
        scene = self.scene
        scene.settle_poses()
        trajectory = poses_of(scene, scene.order)
        return Estimate(
            stamp_ns=self.stamp_ns,
            frame_id=self.config.frames.map_frame,
            refined=trajectory[scene.places()[refined]],
            trajectory=trajectory,
            cloud=cloud_of(scene, scene.landmark_order),
            report=self._report,
            correction=self._published(),
            map_index=self.map_index,
        )

    def _published(self) -> Correction | None:
        transform = self._correction.published
        if transform is None:
            return None
        name = self.config.frames.odom_frame or self.scene.frame_id or _ODOM_FRAME
        return Correction(name, transform.translation, geometry.quaternion_from_matrix(transform.rotation))

    def _due(self) -> IntArray:
        """Return the rows of complete keyframes that were not solved."""
        due = ~self.scene.keyframes.solved
        current = None if self._current is None else self.scene.find_keyframe(self._current)
        if current is not None and not self._complete(current):
            due[current] = False
        return np.flatnonzero(due)

    def _end(self, due: IntArray) -> int:
        """Return how many keyframes, oldest first, there are up to the newest that the next solve is to refine."""
        n, size = len(self.scene.order), self.config.window.max_keyframes
        is_due = np.zeros(n, bool)
        is_due[due] = True
        waiting = np.flatnonzero(is_due[self.scene.order])
        # With one solved keyframe at least in the window the newest can be reached at once.
        if not len(waiting) or n - waiting[0] < size or n <= size:
            return n
        return int(waiting[0]) + size // 2

    def _reached(self, due: IntArray, end: int) -> IntArray:
        """Return which keyframes of those that are due stand among the first ``end``, oldest first."""
        is_due = np.zeros(len(self.scene.keyframes), bool)
        is_due[due] = True
        first = self.scene.order[:end]
        return first[is_due[first]]

    def _complete(self, row: int) -> bool:
        if self._settled:
            return True
        cameras = self.scene.cameras
        expected = max(self._delivered, default=0) or (len(cameras.model) if cameras is not None else 1)
        return len(self.scene.cameras_of(row)) >= expected

    def _cameras_of(self, keyframe_id: int) -> int:
        row = self.scene.find_keyframe(keyframe_id)
        return 0 if row is None else len(self.scene.cameras_of(row))

    def _decided(self, decision: Decision) -> tuple[Admitted, ...]:
        for refusal in decision.refused:
            self.scene.refuse(refusal)
            if isinstance(refusal.measurement, Keyframe):
                self.refused.append(refusal.measurement)
        return decision.admitted

    def _is_new(self, admitted: Admitted) -> bool:
        """Return True if a keyframe (or a session) begins with it."""
        one = admitted.measurement
        if not isinstance(one, Keyframe) or admitted.begins is not None:
            return admitted.begins is not None
        of_current = self.scene.session_id in (None, one.session_id)
        return of_current and self.scene.find_keyframe(one.keyframe_id) is None

    def _begin(self, session_id: int, begin: Begin) -> None:
        before = self.scene
        waiting = Scene(self.config.scene, session_id)
        if before.session_id == session_id:
            waiting.take_waiting(before)
        if len(before.keyframes) and not begin.replaces:
            assert before.session_id is not None
            before.end_pending()
            self._report = dataclasses.replace(self._report, rejected=dict(sorted(self.rejected.items())))
            self.finished.append((before.session_id, self._estimate(before.order)))
            del self.finished[:-FINISHED_KEPT]
        self._renew(session_id, before.next_cameras or before.cameras)
        self.scene.pending = waiting.pending
        if begin.replaces:
            refuse_lone(before, self.scene.log)
        if begin.kind:
            self.scene.log.warn(begin.kind, begin.text)
            self.jumps += 1
            self.jump_note = begin.text

    def _renew(self, session_id: int | None, cameras: Cameras | None) -> None:
        self.map_index += 1
        refused, self.scene = self.scene.refused_rig, Scene(self.config.scene, session_id)
        self.scene.cameras, self.scene.refused_rig = cameras, refused
        self._current, self._settled = None, False
        self._delivered.clear()
        self._report = SolveReport(reason=_UNSOLVED)
        self._correction = MapCorrection()
        self._trust = Trust()
