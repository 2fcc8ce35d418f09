# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the back-end on a thread of its own, fed by the inbox. Nothing here calls ROS.

The worker takes everything that waits, gives it to the back-end, and solves at most once: keyframes that came while
it was solving are solved together with the newest of them. With no message for ``node.settle_time_s`` the newest
keyframe counts as complete with what has arrived.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from types import FrameType

from ba_node.backend import Backend, Check, ClockWatch, Work
from ba_node.estimate import Estimate, Iteration, Refinement, SolveReport, Status
from ba_node.measurements import Keyframe
from ba_node.messages.report import QueueReport
from ba_node.ros.worker.inbox import Arrival, Command, Inbox
from ba_node.ros.worker.keyframe_accounts import KeyframeAccounts
from ba_node.ros.worker.latency import Budget, Lag

# Estimates that wait for a busy executor; the next one replaces it.
_MAX_OUTPUTS = 20
# A report on what was turned away goes out without a solve, but not more often.
_REPORT_PERIOD_S = 1.0
# What is done beside solves waits for so long at a time, and in all for this share of its time and as long as that:
# where solves follow each other at once it must get on too.
_GIVES_WAY_S, _WAITS = 0.2, 0.9
# Where Python's imports are written.
_IMPORTS = "<frozen importlib._bootstrap>"
# Texts that begin alike say the same.
_HEAD = 40
# Falling behind for this long is warned about.
_PATIENCE_S = 5.0


@dataclass(frozen=True)
class Notice:
    """Something to log."""

    key: str  # what it is about; the reader may limit how often each is logged
    text: str  # one line, or several with a traceback
    is_error: bool = False  # a fault of ours, not of the input


@dataclass(frozen=True)
class Outcome:
    """What a solve gave; or what has been turned away since the last one, when there is no solve to tell it."""

    report: SolveReport  # of the solve, or of the last one
    queue: QueueReport  # what has become of keyframes so far
    stamp_ns: int  # of the newest keyframe, ns
    estimate: Estimate | None = None  # what the solve gave; None without one


Output = Outcome | Notice
# Gets the poses of a solve, and when its newest keyframe came in, by the worker's clock, s.
Leave = Callable[[Refinement, float], None]


class Worker:
    """The solver's thread; from :meth:`start` on the back-end is its alone.

    ``settle_time_s`` is the silence after which the newest keyframe is complete; ``notify`` is called, on this thread,
    when :meth:`outputs` has something new, and ``leave``, on this thread too, with the poses of a solve before the rest
    of it is worked out; the clock (s) is a steady one.
    """

    def __init__(
        self,
        backend: Backend,
        inbox: Inbox,
        settle_time_s: float,
        notify: Callable[[], None],
        leave: Leave,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._backend = backend
        self._inbox = inbox
        self._settle_time_s = settle_time_s
        self._notify, self._leave = notify, leave
        self._clock = clock
        self._outputs: deque[Output] = deque(maxlen=_MAX_OUTPUTS)
        self._done: deque[Command] = deque()  # what takes in work that was done elsewhere
        self._budget = Budget(clock)
        self._keyframes = KeyframeAccounts()
        self._arrivals = ClockWatch()
        self._lag = Lag(_PATIENCE_S)
        self._logged: Counter[str] = Counter()
        self._logged_map = 0
        self._warned: set[str] = set()
        self._logged_of: object = None  # what was turned away when it was looked for last
        # What the last report said of things turned away, when that was, and whether there is more to say.
        self._reported: object = None
        self._reported_s = -_REPORT_PERIOD_S
        self._has_news = False
        self._settled = True
        self._behind = False
        self._at_hand = 0  # keyframes that were fetched and are not in the map yet
        self._failures: Counter[str] = Counter()
        self._has_left = True
        self._resting = threading.Event()  # set while there is nothing to do
        self._thread = threading.Thread(target=self._run, name="solver", daemon=True)

    @property
    def refined(self) -> int:
        """Return how many keyframes took part in a usable solve so far."""
        return self._keyframes.refined

    @property
    def alive(self) -> bool:
        """Return True while the thread works, or before it was started."""
        return self._thread.ident is None or self._thread.is_alive()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> bool:
        """End, after at most the current iteration of a solve; return False if that took longer than the timeout."""
        self._inbox.close()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def check_elsewhere(self, check: Check) -> None:
        """Check a set-up on another thread; what is found comes back as a command."""
        self._elsewhere("setup_check", check.run, lambda: self._inbox.post(lambda backend: backend.take_check(check)))

    def work_elsewhere(self, work: Work) -> None:
        """Do what takes long likewise; what came of it is taken in after the next solve, or in a silence.

        It may take as long as two solves, and a keyframe that came meanwhile would wait for it.
        """

        def done() -> None:
            self._done.append(lambda backend: backend.take_work(work))
            self._inbox.post(lambda _: None)

        self._elsewhere("work", work.run, done)

    def _elsewhere(self, name: str, work: Callable[[], object], then: Callable[[], None]) -> None:
        """Do something on a thread of its own, between solves, and then something else."""
        began_s, waited_s = self._clock(), 0.0

        def give_way(frame: FrameType, *_: object) -> None:
            nonlocal waited_s
            if not self._resting.is_set():
                now_s = self._clock()
                if waited_s <= _GIVES_WAY_S + _WAITS * (now_s - began_s) and not _imports(frame):
                    self._resting.wait(_GIVES_WAY_S)
                    waited_s += self._clock() - now_s

        def between_solves() -> None:
            # Python calls it before and after each function, numpy's too: nothing else stops work that is under way,
            # and after each call of the kernels a solve would wait for it.
            sys.setprofile(give_way)
            try:
                work()
            finally:
                sys.setprofile(None)

        def run() -> None:
            self._guard(between_solves)
            then()

        # Not a daemon: Python must not end while the kernels run.
        threading.Thread(target=run, name=name, daemon=False).start()

    def outputs(self) -> list[Output]:
        """Return what has come out since the last call, oldest first."""
        taken = []
        while self._outputs:
            taken.append(self._outputs.popleft())
        return taken

    def _run(self) -> None:
        while True:
            self._resting.set()
            arrivals = self._inbox.drain(self._patience_s())
            if self._inbox.closed:
                return
            self._resting.clear()
            self._guard(self.step, arrivals)

    def _patience_s(self) -> float | None:
        """Return how long to wait for messages: not while there is more to solve, and for ever once all is said."""
        if self._behind:
            return 0.0
        if not self._settled:
            return self._settle_time_s
        return _REPORT_PERIOD_S if self._has_news else None

    def step(self, arrivals: list[Arrival]) -> None:
        """Take in what arrived (nothing means silence, unless there is more to solve), and solve if there is need."""
        self._at_hand = sum(isinstance(arrival.content, Keyframe) for arrival in arrivals)
        for arrival in arrivals:
            self._at_hand -= isinstance(arrival.content, Keyframe)
            self._guard(self._take, arrival)
        self._settled = not arrivals and not self._behind
        if self._settled:
            self._guard(self._backend.flush)
        self._behind = False
        if solves := self._backend.ready:
            self._guard(self._solve)
        while self._done and (solves or self._settled):
            self._guard(self._command, self._done.popleft())
        self._log_rejections()
        self._guard(self._report_rejections)

    def _take(self, arrival: Arrival) -> None:
        if callable(arrival.content):
            self._command(arrival.content)
            return
        content, backend = arrival.content, self._backend
        backend.refused.clear()
        self._arrivals.came(backend, content, arrival.time_s)
        backend.add(content)
        refused = list(backend.refused)
        if isinstance(content, Keyframe) and all(one is not content for one in refused):
            self._keyframes.take(content.session_id, content.keyframe_id, arrival.time_s)
        for one in refused:
            if one is content:
                self._keyframes.rejected += 1
            else:
                self._keyframes.refuse(one.session_id, one.keyframe_id)

    def _command(self, command: Command) -> None:
        estimate, now_s = command(self._backend), self._clock()
        if estimate is not None and not self._inbox.closed:
            self._poses_leave(now_s, estimate.refinement)
            self._put(self._finished(estimate, now_s, now_s))

    def _solve(self) -> None:
        start_s = self._clock()
        before = self._backend.map.solved_count
        arrived_s = self._arrival_s(start_s)
        self._budget.begin(arrived_s, 1e-3 * self._backend.config.node.latency_budget_ms)
        self._has_left = False
        estimate = self._backend.solve(self._goes_on, functools.partial(self._poses_leave, arrived_s))
        n_solved = self._backend.map.solved_count - before
        lag = self._lag.update(start_s, self._clock(), n_solved, estimate, self._backend.config)
        if lag:
            self._put(Notice("falling_behind", lag))
        # More keyframes than a window holds take several solves; without progress the next try waits for new data.
        self._behind = n_solved > 0 and self._backend.ready
        if estimate is not None and not self._has_left:
            self._poses_leave(arrived_s, estimate.refinement)
        if estimate is not None and self._has_left:  # what was published counts, also if the node has ended meanwhile
            self._put(self._finished(estimate, start_s, arrived_s))

    def _poses_leave(self, arrived_s: float, refinement: Refinement) -> None:
        self._budget.end()
        self._has_left = not self._inbox.closed
        if self._has_left:
            self._leave(refinement, arrived_s)

    def _arrival_s(self, now_s: float) -> float:
        """Return when the keyframe came in that the next solve is for; now if it was solved before."""
        newest = self._backend.due
        arrived_s = None if newest is None else self._keyframes.arrival_s(*newest)
        return now_s if arrived_s is None else arrived_s

    def _goes_on(self, _: Iteration) -> bool:
        return self._budget.allows_more() and not self._inbox.closed

    def _finished(self, estimate: Estimate, start_s: float, arrived_s: float) -> Outcome:
        """Add what only the worker knows."""
        report = estimate.report
        refined = set(estimate.refined.keyframe_id.tolist()) if report.status.usable else set()
        held = {(one.session_id, one.keyframe_id) for one in self._backend.held}
        self._keyframes.close(self._backend.map, refined, held)
        if self._budget.spent and report.status is Status.MAX_ITERATIONS:
            budget_ms = self._backend.config.node.latency_budget_ms
            spent = f"the latency budget of {budget_ms:g} ms was spent after {report.iterations} iterations"
            report = dataclasses.replace(report, reason=spent)
        return Outcome(report, self._queue(start_s - arrived_s), estimate.stamp_ns, estimate)

    def _queue(self, wait_s: float = 0.0) -> QueueReport:
        """Return what has become of keyframes so far; with it all is reported that was turned away."""
        keyframes, inbox = self._keyframes, self._inbox.keyframes
        self._reported, self._has_news = self._turned_away(), False
        return QueueReport(
            queue_wait_s=wait_s,
            dropped=self._inbox.dropped,
            coalesced=keyframes.coalesced,
            received=inbox.received,
            solved=keyframes.solved,
            dropped_keyframes=inbox.dropped + keyframes.forgotten,
            rejected_keyframes=keyframes.rejected,
            waiting=inbox.waiting + self._at_hand + keyframes.waiting,
            rejected=dict(self._failures),
            warnings=self._lag.warnings,
        )

    def _turned_away(self) -> object:
        """Return what a report says of things turned away."""
        known = self._backend.map
        return known.index, dict(known.rejected), known.warnings

    def _report_rejections(self) -> None:
        """Report what was turned away since the last report, if no solve did."""
        now_s = self._clock()
        self._has_news = self._turned_away() != self._reported and bool(
            self._backend.map.rejected or self._backend.map.warnings
        )
        if self._has_news and now_s - self._reported_s >= _REPORT_PERIOD_S:
            self._reported_s = now_s
            self._put(Outcome(self._backend.report, self._queue(), self._backend.map.stamp_ns))

    def _log_rejections(self) -> None:
        before, self._logged_of = self._logged_of, self._turned_away()
        if before == self._logged_of:
            return
        rejected, notices = Counter(self._backend.map.rejected), []
        if self._backend.map.index != self._logged_map:
            self._logged_map, self._logged, self._warned = self._backend.map.index, Counter(), set()
        for reason in sorted(rejected - self._logged):
            notes = (note for note in reversed(self._backend.rejection_notes) if f"({reason} = " in note)
            notices.append(Notice(reason, next(notes, f"{reason} = {rejected[reason]}")))
        self._logged = rejected
        # What is a rejection too has been told with its count.
        heads = tuple(notice.text[:_HEAD] for notice in notices)
        warnings = self._backend.map.warnings
        news = [text for text in warnings if text not in self._warned]
        self._warned = set(warnings)
        notices += [Notice(f"warning {text[:_HEAD]}", text) for text in news if text[:_HEAD] not in heads]
        for notice in notices:
            self._put(notice)

    def _guard(self, action: Callable[..., object], *arguments: object) -> None:
        """Run one step of the work; a fault in it is reported and costs that step only.

        One that would end the thread, as SystemExit does, is none of its business either.
        """
        try:
            action(*arguments)
        except BaseException as error:
            self._failures["internal_error"] += 1
            text = f"internal error, going on: {type(error).__name__}: {error}\n{traceback.format_exc()}"
            self._put(Notice(f"failure {type(error).__name__}", text, is_error=True))

    def _put(self, output: Output) -> None:
        self._outputs.append(output)
        self._notify()


def _imports(frame: FrameType | None) -> bool:
    """Return True if a module is being imported: its lock is held, and a solve that wants it would wait as well."""
    while frame is not None and frame.f_code.co_filename != _IMPORTS:
        frame = frame.f_back
    return frame is not None
