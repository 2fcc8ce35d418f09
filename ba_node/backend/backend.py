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

    for event in backend.replay(recording):
        if isinstance(event, Estimate):
            write(event)

When more keyframes came at once than a window holds, a solve takes the oldest half a window of them, and ``ready``
stays True until the newest is reached. Tracks that come late take part from the next solve on; they make their keyframe
due again if it was not refined without them. A higher session id begins a new map with the same rig, and so do
keyframes far older than the newest, as when a recording is played again; their session id stays as the front-end has
it. One that is odd is held until others tell what it was, see ``scene/sessions.py``; then several are taken in at once.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from ba_node.backend import archive
from ba_node.backend.current_map import CurrentMap
from ba_node.backend.summary import MapEnded
from ba_node.backend.worse import amiss, keep_lengths, wrong_at_the_end
from ba_node.check.departure import deviates
from ba_node.check.watch import Check, SetUpWatch
from ba_node.config import Config
from ba_node.core.problem import Cameras
from ba_node.estimate import Estimate, Extras, Iteration, Refinement, SolveReport
from ba_node.measurements import CameraRig, Keyframe, Measurement
from ba_node.scene import ingest
from ba_node.scene.candidates import Admitted, Begin, Decision, refuse_lone
from ba_node.scene.map_content import MapContent
from ba_node.scene.scene import Scene
from ba_node.scene.sessions import Sessions
from ba_node.window import adjustment, full, guard, joining, precision, quality
from ba_node.window.attempt import Following

Work = adjustment.Adjustment | precision.Study  # what may run beside solves


class Backend:
    """The back-end, single-threaded. :meth:`add` and :meth:`solve` raise nothing, whatever the data."""

    def __init__(self, config: Config, *, clock: Callable[[], float] = lambda: 0.0) -> None:
        """Start with an empty map. ``clock`` (s) only fills ``solve_time_s``: no other is read."""
        self.map = CurrentMap(config, Scene(config.scene), 0)  # the current map
        self.solve_count = 0  # solves since the beginning
        self.refused: deque[Keyframe] = deque(maxlen=1000)  # the last keyframes that were turned away
        self.extras = Extras()  # what the next solve is to work out beside the estimate
        self.setup = SetUpWatch()  # the check of the set-up; while it gives a reason, every solve is held
        self.refusal = ""  # why the last solve of everything was held, in words; empty if it was not
        # runs what takes long on another thread, and then gives it to :meth:`take_work`; None: at once
        self.elsewhere: Callable[[Work], None] | None = None
        self._adjusting: adjustment.Adjustment | None = None
        self._clock = clock
        self._sessions = Sessions()
        self._earlier = joining.Earlier()

    @property
    def config(self) -> Config:
        """Return all parameters; they change with :meth:`configure`."""
        return self.map.config

    @property
    def scene(self) -> Scene:
        """Return the tables of the current map."""
        return self.map.scene

    @property
    def report(self) -> SolveReport:
        """Return the report of the last solve, with what has been turned away since."""
        known, counts = self.map, dict(sorted(self.map.rejected.items()))
        return dataclasses.replace(known.report, session_id=known.session_id, rejected=counts, warnings=known.warnings)

    @property
    def rejection_notes(self) -> deque[str]:
        """Return the last rejections in words, oldest first."""
        return self.scene.log.notes

    @property
    def ready(self) -> bool:
        """Return True if a complete keyframe has not been solved yet."""
        return len(self.map.completion.due(self.scene)) > 0

    @property
    def due(self) -> tuple[int, int] | None:
        """Return session and id of the newest keyframe that the next solve is for, None if it is for none."""
        if self.scene.session_id is None or not len(rows := self.map.due()):
            return None
        return self.scene.session_id, int(self.scene.keyframes.keyframe_id[rows[-1]])

    def configure(self, config: Config) -> None:
        """Take new parameters, from the next solve and the next measurement on."""
        self.map.config, self.scene.config = config, config.scene

    @property
    def held(self) -> list[Keyframe]:
        """Return the keyframes that wait for others to tell what they are."""
        return self._sessions.held

    def completes(self, what: Measurement | Admitted) -> bool:
        """Return True if adding this would begin a new keyframe (or session) while the last one is unsolved."""
        if isinstance(what, CameraRig) or self.scene.keyframes.solved.all():
            return False
        admitted = (what,) if isinstance(what, Admitted) else self._sessions.decide(self.scene, what).admitted
        return any(one.is_new(self.scene) for one in admitted)

    def add(self, measurement: Measurement) -> None:
        """Take in a measurement; what cannot be used is counted in ``rejected``."""
        for admitted in self.admit(measurement):
            self.take(admitted)

    def admit(self, measurement: Measurement) -> tuple[Admitted, ...]:
        """Return what is to be taken in now, in order: nothing while a keyframe is held, several once that is over."""
        return self._decided(self._sessions.decide(self.scene, measurement), measurement)

    def admit_rest(self) -> tuple[Admitted, ...]:
        """Return what is to be taken in of all that is held, as nothing more will come."""
        return self._decided(self._sessions.end(self.scene))

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
        is_new = admitted.is_new(self.scene)
        self.scene.add(measurement)
        if not is_new or self.scene.find_keyframe(measurement.keyframe_id) is None:
            self.refused.append(measurement)
            return
        ingest.check_frame(measurement, self.config.frames.odom_frame, self.map.odom_frame, self.scene.log)
        self.map.completion.begin(self.scene, measurement.keyframe_id)

    def flush(self, final: bool = False) -> None:
        """Call the newest keyframe complete with what has come, and let a session begin that the front-end asked for.

        ``final``: nothing more will come, and what waits for its keyframe or for the rig is given up.
        """
        self.map.completion.closed = True
        rest = self.admit_rest() if final else self._decided(self._sessions.settle(self.scene))
        for admitted in rest:
            self.take(admitted)
        if rest:
            self.map.completion.closed = True
        if final:
            self.scene.end_pending()

    def solve(
        self,
        on_iteration: Callable[[Iteration], bool] | None = None,
        on_poses: Callable[[Refinement], None] = lambda _: None,
    ) -> Estimate | None:
        """Return the estimate after a solve of the newest window; None without a keyframe.

        If it fails, all is as before, and the report says why. ``on_iteration`` ends it by returning False;
        ``on_poses`` gets the poses of a solution that is taken, before all else is worked out.
        """
        if len(self.scene.keyframes) == 0:
            return None
        checks, aside = self.config.checks_setup, self.setup.elsewhere is not None
        # What is found elsewhere comes later as it is: nobody waits for it to begin.
        wrong = "" if not checks else self.setup.reason(self.scene) if aside else self._look()
        self.solve_count += 1
        asked: list[Check | None] = []

        def taken(refinement: Refinement) -> None:
            asked.append(amiss(self.scene))
            if asked == [None]:  # else it is taken back at once
                on_poses(refinement)

        estimate = self.map.solve(self.solve_count, wrong, self.extras, Following(self._clock, on_iteration, taken))
        if checks and aside:
            self._look()
        if (study := self.map.begun_study()) is not None:
            self._work(study)
        return estimate if wrong else self.take_check(*(asked or [amiss(self.scene)])) or self.adjust() or estimate

    def _look(self) -> str:
        """Have the set-up checked if that is due; return why solves are held, empty if they are not."""
        return self.setup.look(self.scene, deviates(self.scene))

    def adjust(self, *, final: bool = False) -> Estimate | None:
        """Bend the map and refine all of it, if a loop or what is absolute asks for it, see ``window/adjustment.py``.

        ``final``: nothing more will come. Returns what is known then, None if nothing changed, or not yet.
        """
        if self._adjusting is not None and self._adjusting.scene is self.scene:
            return None
        joined = self._earlier.join(self.scene, self.config, final=final)
        if joined is not None:
            self.map.correct(int(self.scene.order[-1]))
        what = joined or adjustment.due(self.scene, self.config, final=final)
        if what is None:
            return None
        begun = self._adjusting = adjustment.Adjustment(self.scene, what, self.config, self.extras)
        return self._work(begun, at_once=final)

    def _work(self, begun: Work, *, at_once: bool = False) -> Estimate | None:
        if self.elsewhere is not None and not at_once:
            self.elsewhere(begun)
            return None
        begun.run()
        return self.take_work(begun)

    def take_work(self, done: Work) -> Estimate | None:
        """Take in what was run; return what is known then, None if the map stays as it is."""
        if isinstance(done, precision.Study):
            self.map.learn(done)
            return None
        if done is not self._adjusting or done.scene is not self.scene:
            return None
        self._adjusting = None
        why, merged = done.why, None
        if not why and done.taken is not None:
            merged = self.merge(done.taken, done.put, grown=done.due.grown or done.due.quiet)
            why = self.refusal or ("" if merged else "nothing came of a solve of everything")
        elif not why:
            done.put()
            self.map.adjustments += 1
            self.map.correct(int(self.scene.order[-1]))
        done.end(why)
        return None if why else merged[0] if merged else self.estimate()

    def replay(self, stream: Iterable[Measurement]) -> Iterator[Estimate | Keyframe | MapEnded]:
        """Take in a stream to its end, with a solve for every keyframe, just before the next one begins.

        Yields every estimate; every keyframe that the map has now, as it came; and what became of a map when another
        one took its place, before the first keyframe of that.
        """
        for measurement in stream:
            for admitted in self.admit(measurement):
                yield from self._taken(admitted)
        for admitted in self.admit_rest():
            yield from self._taken(admitted)
        self.flush(final=True)
        while self.ready:
            if (estimate := self.solve()) is not None:
                yield estimate
        changed = self._ended()
        if (last := changed if self.setup.reason(self.scene) else self.adjust(final=True) or changed) is not None:
            yield last

    def _taken(self, admitted: Admitted) -> Iterator[Estimate | Keyframe | MapEnded]:
        if self.completes(admitted) and (estimate := self.solve()) is not None:
            yield estimate
        if admitted.begins is not None and (changed := self._ended()):
            yield changed
        before = self.map
        self.take(admitted)
        if self.map is not before:
            yield MapEnded(before.summary(), admitted.begins is not None and admitted.begins.replaces)
        one = admitted.measurement
        if isinstance(one, Keyframe) and self.scene.find_keyframe(one.keyframe_id) is not None:
            yield one

    def _ended(self) -> Estimate | None:
        """Ask what is wrong with a map to which no more comes; return what is known now if that changes it."""
        if (undone := self.take_check(wrong_at_the_end(self.scene, self.config))) is not None:
            return undone
        followed = self.adjust(final=True) if self.map.precision.ask_all(self.scene, self.config) else None
        if keep_lengths(self.scene, self.config):
            self.map.correct(int(self.scene.order[-1]))
            return self.estimate()
        return followed

    def take_check(self, check: Check | None) -> Estimate | None:
        """Take in a check of the set-up that was run elsewhere; return what is known now if it undoes all solves."""
        if check is None or not self.config.checks_setup or check.scene is not self.scene or not self.setup.take(check):
            return None
        self.map.hold_all(self.solve_count, self.setup.reason(self.scene))
        return self.estimate()

    def estimate(self) -> Estimate:
        """Return all that is known, with the report of the last solve."""
        return self.map.estimate()

    def optimize(self, by: full.Solve | None = None) -> Estimate | None:
        """Refine all keyframes and points that are kept; return what is known then, None if nothing came of it."""
        begun = self.begin_optimization()
        if isinstance(begun, str):
            return None
        begun.solve(self.config.solver, by=by)
        return merged[0] if (merged := self.merge(begun)) else None

    def begin_optimization(self) -> full.Optimization | str:
        """Return a solve of everything, to be run on any thread and then merged, or why there is none."""
        return full.take_snapshot(self.scene, self.config, self.extras)

    def copied(self) -> Callable[[], full.Optimization | str]:
        """Return :meth:`begin_optimization` of a copy of the map as it is now, to be called once, on any thread."""
        scene, copies, config, wanted = self.scene, [self.scene.clone()], self.config, self.extras
        return lambda: full.take_snapshot(copies.pop(), config, wanted, scene)

    def is_current(self, optimization: full.Optimization) -> bool:
        """Return True if a solve of everything is of the current map."""
        return optimization.scene is self.scene

    def merge(
        self, optimization: full.Optimization, first: Callable[[], None] = lambda: None, *, grown: bool = False
    ) -> tuple[Estimate, int] | None:
        """Put the result of a solve of everything into the map, see ``window/full.py``.

        ``first`` is done to the map before, once the result is taken. ``grown``: nothing is said if it is not, and what
        shows at a map's end is not asked. Returns what is known now, and how many later keyframes followed, or None.
        """
        taken, result, self.refusal = optimization, optimization.result, ""
        if not result.status.usable or not result.state.is_finite():
            return None
        found = taken.outcome(result.state, self.config)
        verdict = guard.decide(self.config, taken.selection, found)
        wrong = self.setup.reason(self.scene) if self.config.checks_setup else ""
        self.refusal = wrong or ("" if verdict.odd else verdict.reason)
        if self.refusal and not grown:
            self.map.hold(f"a solve of everything: {self.refusal}")
        if self.refusal:
            return None
        assert found.state is not None
        first()
        if taken.calibration is not None:
            self.map.calibrate(taken.calibration)
        followed = full.merge_snapshot(self.scene, self.config, taken, found.state)
        if followed is None:
            return None
        self.solve_count += 1
        self.map.adjustments, newest = self.map.adjustments + 1, int(self.scene.order[-1])
        statistics = quality.statistics(taken.selection, result, found.norms) | verdict.health
        self.map.report = dataclasses.replace(self.map.base_report(self.solve_count, newest), **statistics)
        self.map.correct(newest)
        now = (None if grown else self._ended()) or self.estimate()
        return now if self.setup.reason(self.scene) else self.map.with_covariances(now, taken), followed

    def reset(self) -> None:
        """Forget everything but the cameras and the count of solves: the next keyframe begins a map, in any session."""
        self._earlier = joining.Earlier()
        self._sessions.reset()
        self._renew(None, self.scene.next_cameras or self.scene.cameras)
        self.map.report = SolveReport(reason="reset: the map is empty")

    def snapshot(self) -> MapContent:
        """Return a copy of all that is known, for a file; see docs/map_format.md."""
        known, done = self.map, self.map.completion
        of_newest = done.row(self.scene), done.closed, tuple(done.delivered)
        return archive.pack(archive.MapState(self.scene, known.report, known.correction, *of_newest, self.solve_count))

    def take_over(self, known: archive.MapState) -> None:
        """Put what a file held in the place of all that is known; parameters stay, and ``solve_count`` if it is higher.

        Keyframes of the same session are taken in from there on; a higher session begins a new map, as always.
        """
        self.map = archive.map_of(known, self.config, self.map.index + 1)
        self._earlier = joining.Earlier()
        self._sessions.reset(set(self.scene.keyframes.keyframe_id.tolist()))
        self.solve_count = max(self.solve_count, known.solve_count)

    def _decided(self, decision: Decision, measurement: Measurement | None = None) -> tuple[Admitted, ...]:
        self._sessions.commit(measurement, decision)
        for refusal in decision.refused:
            self.scene.refuse(refusal)
            if isinstance(refusal.measurement, Keyframe):
                self.refused.append(refusal.measurement)
        return decision.admitted

    def _begin(self, session_id: int, begin: Begin) -> None:
        before = self.scene
        waiting = Scene(self.config.scene, session_id)
        if before.session_id == session_id:
            waiting.take_waiting(before)
        if len(before.keyframes) and not begin.replaces:
            assert before.session_id is not None
            before.end_pending()
            self._earlier.keep(before, self.config)
        self._renew(session_id, before.next_cameras or before.cameras)
        self.scene.pending = waiting.pending
        if begin.replaces:
            refuse_lone(before, self.scene.log)
        if begin.kind:
            self.scene.log.warn(begin.kind, begin.text)

    def _renew(self, session_id: int | None, cameras: Cameras | None) -> None:
        scene = Scene(self.config.scene, session_id)
        scene.cameras, scene.refused_rig = cameras, self.scene.refused_rig
        self.map = CurrentMap(self.config, scene, self.map.index + 1)
