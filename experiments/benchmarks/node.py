# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Play keyframes into the node over DDS at a steady rate, and say how late results are and how long others wait."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message

from ba_node.config import OutputConfig
from ba_node.estimate import Cloud, Estimate, Poses, SolveReport, Status
from ba_node.measurements import FeatureTracks
from ba_node.messages import conversion
from ba_node.messages.outputs import output_messages
from ba_node.messages.topics import INPUT_TYPES, OUTPUT_TYPES, TOPICS, WHOLE_MAP
from ba_node.ros import qos
from ba_node.ros.message_factory import RclpyFactory, message_class
from experiments.demo.domain import free_domain, isolation
from experiments.synthetic import SyntheticOptions, generate

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parents[1]
_PROBE = FOLDER / "node_probe.py"
_FACTORY = RclpyFactory()
_CALL_PERIOD_S = 0.03
_IDLE_S = 4.0  # before the first keyframe, for the node's probe


@dataclass(frozen=True)
class Case:
    """What the front-end sees, and how much of it a window holds."""

    about: str  # in words
    tracks: int  # points that each image of the stereo pair sees
    track_keyframes: int  # keyframes after which a track ends; 0: it goes on, and comes back when its point does
    landmarks: int  # points of the world, for each keyframe
    fixed: int  # older keyframes that take part with fixed poses


CASES = {
    "window": Case("20 keyframes, 1500 points, 15 000 observations, 2 keyframes fixed", 375, 8, 60, 2),
    "wide": Case("20 keyframes, 900 points that come back, 23 000 observations, 20 keyframes fixed", 750, 0, 30, 20),
}


class Peer:
    """A front-end and a listener in one: publishes serialised messages, notes when reports come, calls a service."""

    def __init__(self, topics: list[str]) -> None:
        rclpy.init(args=[])
        self.node = Node("peer", start_parameter_services=False, enable_rosout=False)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.inputs = {
            topic: self.node.create_publisher(message_class(kind), topic, qos.profile(TOPICS[topic]))
            for topic, kind in INPUT_TYPES.items()
            if topic != "camera_info"
        }
        self.reports: list[Any] = []
        self.received_s: dict[int, float] = {}
        self.calls_ms: list[float] = []
        for topic in topics:
            cls = message_class(OUTPUT_TYPES[topic])
            profile = qos.profile(TOPICS[topic]) if topic in WHOLE_MAP else qos.reliable(qos.OUTPUT_DEPTH)
            if topic == "report":
                self.node.create_subscription(cls, "ba_node/report", self._note, profile)
            else:
                self.node.create_subscription(cls, f"ba_node/{topic}", lambda _: None, profile, raw=True)
        self.client = self.node.create_client(GetParameters, "ba_node/get_parameters")

    def _note(self, report: Any) -> None:
        self.reports.append(report)
        self.received_s[report.newest_keyframe_id] = time.monotonic()

    def connect(self) -> None:
        """Wait for the node."""
        end = time.monotonic() + 60.0
        while not (self.client.service_is_ready() and all(p.get_subscription_count() for p in self.inputs.values())):
            if time.monotonic() > end:
                raise TimeoutError("no node within 60 s")
            self.executor.spin_once(timeout_sec=0.1)

    def call(self) -> None:
        """Ask for a parameter, and note how long the answer takes."""
        begin = time.monotonic()
        future = self.client.call_async(GetParameters.Request(names=["solver.method"]))
        future.add_done_callback(lambda _: self.calls_ms.append(1e3 * (time.monotonic() - begin)))


def recording(args: argparse.Namespace, case: Case) -> list[list[tuple[str, Any]]]:
    """Return the messages of each keyframe, (topic, message), the rig before the first."""
    n = args.warm_up + round(args.seconds * args.rate)
    options = SyntheticOptions(
        seed=1,
        keyframes=n,
        length_m=0.5 * n,
        tracks=case.tracks,
        max_track_keyframes=case.track_keyframes,
        reobserve=not case.track_keyframes,
        landmarks=case.landmarks * n,
    )
    data = generate(options)
    begin_ns = time.time_ns() + 10**9
    frames: list[list[tuple[str, Any]]] = [[("camera_rig", conversion.input_message(_FACTORY, data.rig, 0)[1])]]
    for k, (keyframe, tracks) in enumerate(zip(data.keyframes, data.tracks, strict=True)):
        stamp_ns = begin_ns + round(k * 1e9 / args.rate)
        frame = dataclasses.replace(keyframe, stamp_ns=stamp_ns)
        messages = [("keyframes", conversion.input_message(_FACTORY, frame)[1])]
        messages += [("feature_tracks", conversion.input_message(_FACTORY, t, stamp_ns, "camera")[1]) for t in tracks]
        frames.append(messages)
    return [[(topic, serialize_message(message)) for topic, message in frame] for frame in frames]


def play(peer: Peer, frames: list[list[tuple[str, Any]]], args: argparse.Namespace) -> dict[int, float]:
    """Send each keyframe when it is due; return when each was sent, s."""
    for topic, data in frames[0]:
        peer.inputs[topic].publish(data)
    sent: dict[int, float] = {}
    begin, next_call = time.monotonic() + _IDLE_S, 0.0
    while len(sent) < len(frames) - 1 or time.monotonic() < begin + len(sent) / args.rate + 1.0:
        now = time.monotonic()
        k = len(sent)
        if k < len(frames) - 1 and now >= begin + k / args.rate:
            sent[k] = now
            if k == args.warm_up:
                peer.calls_ms.clear()
            for topic, data in frames[k + 1]:
                peer.inputs[topic].publish(data)
        if now >= next_call:
            next_call = now + _CALL_PERIOD_S
            peer.call()
        peer.executor.spin_once(timeout_sec=0.002)
    return sent


def row(name: str, values: Any, unit: str = "ms") -> str:
    """Return a line of the table."""
    values = np.asarray(values, float)
    if not len(values):
        return f"| {name} | - | - | - | 0 |"
    p50, p95 = np.percentile(values, [50, 95])
    return f"| {name}, {unit} | {p50:.1f} | {p95:.1f} | {values.max():.1f} | {len(values)} |"


def conversion_times() -> list[str]:
    """Return lines on how long the conversions take that run on the executor's thread."""
    rng = np.random.default_rng(0)

    def poses(n: int) -> Poses:
        return Poses(np.arange(n, dtype=np.uint64), np.arange(n), rng.normal(size=(n, 3)), rng.normal(size=(n, 4)))

    n = 200_000
    cloud = Cloud(np.arange(n, dtype=np.uint64), rng.normal(size=(n, 3)), np.ones(n, "f4"), np.ones(n, "i4"))
    estimate = Estimate(0, "map", poses(40), poses(1000), cloud, SolveReport(status=Status.CONVERGED))
    node = Node("converter", start_parameter_services=False, enable_rosout=False)
    lines = []
    for topic, kind in OUTPUT_TYPES.items():
        publisher = node.create_publisher(message_class(kind), f"~/{topic}", qos.profile(TOPICS[topic]))

        def build_and_publish(topic: str = topic, publisher: Any = publisher) -> None:
            for _, _, message in output_messages(_FACTORY, estimate, OutputConfig(), {topic}):
                publisher.publish(message)

        lines.append(row(f"build and publish {topic}", times_ms(build_and_publish)))
    tracks = FeatureTracks(0, 0, 0, np.arange(1000, dtype=np.uint64), rng.normal(size=(1000, 2)), np.ones(1000))
    message = conversion.input_message(_FACTORY, tracks, 0, "camera")[1]
    kind = INPUT_TYPES["feature_tracks"]
    lines.append(row("take 1000 tracks", times_ms(lambda: conversion.measurement_from_message(kind, message))))
    node.destroy_node()
    return lines


def times_ms(action: Any, repeats: int = 50) -> list[float]:
    """Return how long each of some runs took."""
    out = []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        out.append(1e3 * (time.perf_counter() - begin))
    return out


def run(args: argparse.Namespace, case: Case, backend: str) -> list[str]:
    """Play into a node with some kernels; return lines of the table."""
    frames = recording(args, case)
    peer = Peer(args.topics)
    settings = [f"solver.kernels:={backend}", f"window.max_fixed_keyframes:={case.fixed}", *args.set]
    command = [sys.executable, str(_PROBE), "--ros-args", *[word for s in settings for word in ("-p", s)]]
    environ = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    node = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environ)
    try:
        peer.connect()
        sent = play(peer, frames, args)
    finally:
        node.terminate()
        out, _ = node.communicate(timeout=30)
        peer.executor.shutdown()
        peer.node.destroy_node()
    steady = {k: s for k, s in sent.items() if k >= args.warm_up}
    probe = json.loads(next(line for line in out.splitlines() if line.startswith("{")))
    reports = [r for r in peer.reports if r.newest_keyframe_id >= args.warm_up]
    last = reports[-1]
    p50, p95, largest = (1e3 * q for q in (last.latency_p50_s, last.latency_p95_s, last.latency_max_s))
    cpu_s = probe["cpu_s"]
    threads = ", ".join(f"{name} {100 * spent / probe['wall_s']:.1f}" for name, spent in cpu_s.items())
    counts = (
        f"keyframes received {last.received}, solved {last.solved}, coalesced {last.coalesced}, dropped"
        f" {last.dropped_keyframes}, waiting {last.waiting}; CPU of the node"
        f" {100 * sum(cpu_s.values()) / probe['wall_s']:.1f} % of a core ({threads}); before the first keyframe"
        f" {100 * probe['idle_share']:.1f} %, with the benchmark's timer and calls"
    )
    delays = [1e3 * (peer.received_s[k] - s) for k, s in steady.items() if k in peer.received_s]
    return [
        f"| arrival to publication (by the node), ms | {p50:.1f} | {p95:.1f} | {largest:.1f} | last 100 |",
        row("sent to report received", delays),
        row("in the solver", [1e3 * r.solve_time_s for r in reports]),
        row("iterations", [r.iterations for r in reports], "number"),
        row("points", [r.landmarks for r in reports], "number"),
        row("observations", [r.observations for r in reports], "number"),
        row("a callback of the executor late by", probe["late_ms"]),
        row("a service call answered in", peer.calls_ms),
        f"\n{counts}",
    ]


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments.benchmarks.node", description=__doc__)
    parser.add_argument("--rate", type=float, default=10.0, help="keyframes a second (10)")
    parser.add_argument("--seconds", type=float, default=12.0, help="how long, after the window is full (12)")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES, help="what to play (all)")
    parser.add_argument("--warm-up", type=int, default=40, help="keyframes that are not counted (40)")
    parser.add_argument("--backends", nargs="+", default=["native", "numpy"], metavar="NAME")
    parser.add_argument("--topics", nargs="+", default=list(OUTPUT_TYPES), help="outputs to listen to (all)")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME:=VALUE", help="parameters of the node")
    args = parser.parse_args()
    args.topics = list({*args.topics, "report"})
    os.environ.update(isolation(free_domain()))
    head = "| | p50 | p95 | max | n |\n|---|---:|---:|---:|---:|"
    for name, backend in itertools.product(args.cases, args.backends):
        case = CASES[name]
        print(f"\n{name} ({case.about}), {backend} kernels, {args.rate:g} keyframes a second:\n\n{head}", flush=True)
        print("\n".join(run(args, case, backend)), flush=True)
        rclpy.try_shutdown()
    rclpy.init(args=[])
    print(f"\nConversion:\n\n{head}\n" + "\n".join(conversion_times()), flush=True)
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
