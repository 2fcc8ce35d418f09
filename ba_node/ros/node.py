# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Put the node together: parameters, worker and components, made and destroyed with the states of a managed node.

Everything in this file runs on the executor's thread, but for what leaves as soon as it is known (`_leave`).

============  ==========================================================================================
configure     a new back-end with an empty map, its worker, and all components with their topics
activate      data is taken and results are published
deactivate    the map stays, data is ignored and counted; a solve that runs is finished, not published
cleanup       components are destroyed, the map is saved if asked for, and dropped; a solve ends after its iteration
shutdown      as cleanup, for good
============  ==========================================================================================
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from rclpy.clock import Clock, ClockType

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.estimate import Refinement
from ba_node.ros.components.base import Component, Host
from ba_node.ros.components.definitions import Definitions
from ba_node.ros.components.diagnostics import Diagnostics
from ba_node.ros.components.inputs import Inputs
from ba_node.ros.components.map_transform import MapTransform
from ba_node.ros.components.namesake import Namesake
from ba_node.ros.components.optimize import Optimize
from ba_node.ros.components.publishing import Publishing
from ba_node.ros.components.services import Services
from ba_node.ros.components.side_outputs import SideOutputs
from ba_node.ros.components.silence import Silence, SimulatedTime
from ba_node.ros.components.static_frames import StaticFrames
from ba_node.ros.log import Severity, Throttle, fault, log
from ba_node.ros.parameters import Parameters
from ba_node.ros.rclpy_compat.deferred import DeferredAnswers
from ba_node.ros.rclpy_compat.lifecycle import ManagedNode, RefusedError
from ba_node.ros.worker.inbox import Inbox
from ba_node.ros.worker.kept_map import KeptMap, KeptMapError
from ba_node.ros.worker.worker import Notice, Outcome, Worker

NODE_NAME = "ba_node"
# In the order in which they are made and get estimates; destroyed in reverse. What feeds the worker comes last.
COMPONENTS: tuple[type[Component], ...] = (
    Publishing,
    MapTransform,
    SideOutputs,
    Diagnostics,
    Silence,
    SimulatedTime,
    Definitions,
    Namesake,
    StaticFrames,
    Services,
    Optimize,
    Inputs,
)
_LOG_PERIOD_S = 5.0
# For a worker that is idle; one that solves ends by itself.
_STOP_S = 0.02
# In DDS an answer and the word that its writer has gone come on different ways; the second must not overtake the first.
_LINGER_S = 1.0


class BaNode(ManagedNode):
    """The ROS node: subscribes to keyframes, tracks and cameras, publishes what the worker makes of them.

    Raises:
        ConfigError: a parameter given at start does not exist or has a wrong value.
    """

    def __init__(self, **node_options: Any) -> None:
        """Make the node; :meth:`start` sets it to work."""
        super().__init__(NODE_NAME, **node_options)
        self._settings = Parameters(self, self._reconfigure)
        self._throttle = Throttle(_LOG_PERIOD_S)
        self._host: Host | None = None
        self._components: list[Component] = []
        self._leaving: list[Worker] = []
        self._kept: tuple[KeptMap, Backend] | None = None
        self._saving: threading.Thread | None = None
        self._lingering = ExitStack()
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._linger_timer = self.create_timer(_LINGER_S, self._end_lingering, clock=clock, autostart=False)
        self._refined_before = 0

    @property
    def keyframes_refined(self) -> int:
        """Return how many keyframes have been refined so far."""
        workers = self._leaving if self._host is None else [*self._leaving, self._host.worker]
        return self._refined_before + sum(worker.refined for worker in workers)

    def summary(self) -> str:
        """Return in words what the node has done."""
        return f"{self.keyframes_refined} keyframes refined"

    def start(self) -> None:
        """Configure and activate, if ``node.autostart`` says so; a failure is logged and leaves the node running."""
        if self._settings.config.node.autostart and self.request("configure"):
            self.request("activate")

    def stop(self) -> None:
        """End the worker, during a solve after its current iteration."""
        host = self._host
        self.cleanup()
        if host is not None and host.deferred.left_waiting:
            time.sleep(_LINGER_S)
        if not all(worker.stop() for worker in self._leaving):
            log(self, Severity.ERROR, "the solver did not stop in time, leaving it")
        self._end_saving()

    def configure(self) -> None:
        """Make an empty map and everything that works on it."""
        self.cleanup()
        self._end_lingering()
        self._end_saving()
        config = self._settings.config
        inbox = Inbox(config.node.inbox_size)
        backend = Backend(config, clock=time.perf_counter)
        try:
            kept = KeptMap(config, self._log)
            kept.load(backend)
        except KeptMapError as error:
            raise RefusedError(str(error)) from error
        deferred = DeferredAnswers(self, lambda: worker.alive)
        worker = Worker(
            backend,
            inbox,
            config.node.settle_time_s,
            lambda: deferred.call(self._distribute),
            lambda *poses: self._leave(host, *poses),
        )
        backend.setup.elsewhere = worker.check_elsewhere
        backend.elsewhere = worker.work_elsewhere
        self._host = host = Host(self, config, inbox, worker, deferred, self._log)
        host.at_cleanup.callback(deferred.close)
        worker.start()
        self._kept = kept, backend
        for kind in COMPONENTS:
            self._components.append(kind(host))
        self._settings.check_overrides()

    def activate(self) -> None:
        """Take data and publish."""
        host = self._configured()
        host.active = True
        host.ignoring.discard("inactive")
        for component in self._components:
            component.activate()
        if self._kept is not None and self._kept[0].unseen:
            self._kept[0].unseen = False
            host.inbox.post(lambda backend: backend.estimate())

    def deactivate(self) -> None:
        """Hold the map, and ignore data."""
        host = self._configured()
        with host.leaving:
            host.active = False
        host.ignoring.add("inactive")
        for component in reversed(self._components):
            component.deactivate()

    def cleanup(self) -> None:
        """Drop the map and destroy all components. Does not wait for a solve that runs: its thread ends by itself."""
        if self._host is None:
            return
        host, self._host = self._host, None
        with host.leaving:
            host.active = False
        self._components.clear()
        self._lingering = host.after_cleanup
        self._linger_timer.reset()
        try:
            self._leaving.append(host.worker)
            for worker in [worker for worker in self._leaving if worker.stop(_STOP_S)]:
                self._leaving.remove(worker)
                self._refined_before += worker.refined
            if self._kept is not None:
                (kept, backend), self._kept = self._kept, None
                self._saving = kept.save(backend, host.worker)
        finally:
            host.at_cleanup.close()

    def _end_lingering(self) -> None:
        """Destroy what was left for a moment after the last cleanup."""
        self._linger_timer.cancel()
        self._lingering.close()

    def _end_saving(self) -> None:
        """Wait until the map of the last configuration is on the disk."""
        if self._saving is not None:
            self._saving.join()
            self._saving = None

    def _configured(self) -> Host:
        assert self._host is not None, "rclpy's state machine lets only a configured node do this"
        return self._host

    def _reconfigure(self, config: Config) -> None:
        """Pass on a change of parameters; an unconfigured node takes it when it is configured."""
        host = self._host
        if host is None:
            return
        host.config = config
        host.inbox.post(lambda backend: backend.configure(config))

    def _distribute(self) -> None:
        """Give the components what the worker has made."""
        host = self._host
        if host is None:
            return
        outputs = host.worker.outputs()
        estimates = [output.estimate for output in outputs if isinstance(output, Outcome)]
        newest = next((e for e in reversed(estimates) if e is not None and e.replaces_map), None)
        for output in outputs:
            if isinstance(output, Notice):
                self._log(output)
            elif host.active:
                for component in self._components:
                    with self._surviving(component):
                        component.take_report(output)
                        if output.estimate is not None:
                            component.take(output.estimate, output.estimate is newest)

    def _leave(self, host: Host, refinement: Refinement, arrived_s: float) -> None:
        """Give the components the poses of a solve, on the solver's thread: another would have to wake up first."""
        with host.leaving:
            for component in self._components if host.active else ():
                if type(component).take_poses is not Component.take_poses:
                    with self._surviving(component):
                        component.take_poses(refinement, arrived_s)

    @contextmanager
    def _surviving(self, component: Component) -> Iterator[None]:
        """Give a component what came out; a fault in one must not keep it from the others."""
        try:
            yield
        except Exception as error:
            if not self.context.ok():
                return  # a signal ended the context between two messages
            name = type(component).__name__
            text = f"{name}, going on after an {fault(error)}\n{traceback.format_exc()}"
            self._log(Notice(f"failure {name}", text, is_error=True))

    def _log(self, notice: Notice) -> None:
        """Log a notice, the same one not more often than every few seconds."""
        if self._throttle.passes(notice.key, time.monotonic()):
            log(self, Severity.ERROR if notice.is_error else Severity.WARNING, notice.text)
