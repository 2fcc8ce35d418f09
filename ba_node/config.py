# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare every parameter once: name, default, unit, range, choices, meaning, live or read-only.

The YAML file, the table in docs/parameters.md, the descriptors of the ROS node and ``--set`` on the
command line are loops over :func:`declarations`; nothing repeats a default.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, cast, get_type_hints

Value = bool | int | float | str

# What core/methods.py and core/choices.py declare, as this file imports nothing; a test compares them.
METHODS = ("auto", "lma_cd", "bal", "inm", "tnm", "dinm", "adinm", "local_dinm", "irls_huber", "irls_tq")
LOSSES = ("squared", "huber", "truncated_quadratic", "cauchy", "geman_mcclure", "auto")
BACKENDS = ("auto", "native", "numpy")
LINEAR_SOLVERS = ("auto", "cholesky", "dense", "sparse", "pcg")
CHEIRALITY = ("keep", "constant", "drop")
POSES_OF = ("body", "camera")
EXTRINSICS = ("camera_rig", "tf_static")


class ConfigError(ValueError):
    """A parameter that is unknown, of the wrong type, out of range, or in conflict with another."""


@dataclass(frozen=True)
class Parameter:
    """One declared parameter.

    Attributes:
        name: full name, for example ``window.max_keyframes``.
        kind: bool, int, float or str.
        default: value when nothing is set.
        doc: what it does, one sentence.
        unit: physical unit, empty if it has none.
        minimum: smallest allowed number, None if unbounded.
        maximum: largest allowed number, None if unbounded.
        choices: allowed strings, empty if any.
        live: True if a change takes effect at the next solve, False if only at start.
    """

    name: str
    kind: type
    default: Value
    doc: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = True

    def check(self, value: object) -> Value:
        """Return the value in the declared type, or raise ConfigError. An int is accepted for a float."""
        if self.kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if type(value) is not self.kind:
            raise ConfigError(
                f"parameter {self.name} = {value!r}: expected {self.kind.__name__},"
                f" got {type(value).__name__} (default {self.default!r})"
            )
        if self.choices and value not in self.choices:
            raise ConfigError(f"parameter {self.name} = {value!r}: choose one of {', '.join(self.choices)}")
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            self._check_range(value)
        assert isinstance(value, (bool, int, float, str))
        return value

    def _check_range(self, value: float) -> None:
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if not math.isfinite(value) or not low <= value <= high:
            raise ConfigError(
                f"parameter {self.name} = {value!r}: expected a number in [{low:g}, {high:g}]"
                f"{' ' + self.unit if self.unit else ''}"
            )


def _param(default: Value, doc: str, **details: Any) -> Any:
    """Declare a field of one of the groups below as a parameter."""
    return field(default=default, metadata={"doc": doc, **details})


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes and tracks take part in a solve."""

    max_keyframes: int = _param(
        20, "Newest keyframes whose poses are refined in each solve.", minimum=2, maximum=100_000
    )
    max_fixed_keyframes: int = _param(
        20,
        "Older keyframes that see the window's points and take part with fixed poses; most shared tracks first.",
        minimum=0,
        maximum=100_000,
    )
    max_landmarks: int = _param(
        5000,
        "Points in a solve; beyond it those with the fewest observations are left out.",
        minimum=10,
        maximum=10_000_000,
    )


@dataclass(frozen=True)
class SceneConfig:
    """What is remembered."""

    max_keyframes: int = _param(
        5000, "Keyframes kept; beyond it the oldest are forgotten.", minimum=10, maximum=10_000_000
    )
    max_landmarks: int = _param(
        500_000,
        "Tracks kept; beyond it those seen longest ago are forgotten.",
        minimum=100,
        maximum=100_000_000,
    )
    max_reorder_s: float = _param(
        10.0,
        "Keyframes whose stamps are further than this before the newest begin a new session, as when the clock is set"
        " back, and one alone is rejected; closer ones are sorted in. One this far ahead waits for the next. 0: never.",
        unit="s",
        minimum=0.0,
        maximum=1e9,
    )
    max_pending: int = _param(
        200,
        "Track messages that wait for their keyframe or the rig; beyond it the oldest are rejected.",
        minimum=1,
        maximum=100_000,
    )


@dataclass(frozen=True)
class TracksConfig:
    """How tracks become points, and when an observation is not believed."""

    min_parallax_deg: float = _param(
        1.0,
        "Smallest angle between two viewing rays of a track for it to be triangulated.",
        unit="deg",
        minimum=0.0,
        maximum=90.0,
    )
    max_triangulation_px: float = _param(
        12.0,
        "Largest reprojection error, in sigmas, of a view that agrees where a point begins; half of it for two views.",
        unit="px",
        minimum=0.1,
        maximum=1e6,
    )
    outlier_px: float = _param(
        6.0,
        "Observations beyond this many sigmas (at least 4.4 x the median) sit out the next solve; 0 keeps all.",
        unit="px",
        minimum=0.0,
        maximum=1e6,
    )
    depth_sigma_ratio: float = _param(
        0.02,
        "Standard deviation of a measured depth, as a share of the depth.",
        minimum=1e-6,
        maximum=10.0,
    )


@dataclass(frozen=True)
class OdometryConfig:
    """How much the front-end's own steps from keyframe to keyframe count in a solve."""

    enabled: bool = _param(True, "Let the steps count; they give one camera its scale, and hold what images do not.")
    sigma_m: float = _param(
        0.001, "Standard deviation of a step's translation along each axis at rest.", unit="m", minimum=0.0, maximum=1e6
    )
    sigma_m_per_m: float = _param(
        0.01, "The same, added for each metre of the step.", unit="m/m", minimum=0.0, maximum=1e6
    )
    sigma_rad: float = _param(
        0.001, "Standard deviation of a step's rotation about each axis at rest.", unit="rad", minimum=0.0, maximum=1e3
    )
    sigma_rad_per_m: float = _param(
        0.003, "The same, added for each metre of the step.", unit="rad/m", minimum=0.0, maximum=1e3
    )
    sigma_rad_per_rad: float = _param(
        0.01, "The same, added for each radian of the step.", unit="rad/rad", minimum=0.0, maximum=1e3
    )
    max_inflation: float = _param(
        10.0,
        "Standard deviations grow up to this many times where well-determined keyframes show the steps to be worse.",
        minimum=1.0,
        maximum=1e6,
    )
    loss_scale: float = _param(
        1.0,
        "Where Cauchy's loss leaves the square, in standard deviations: steps that are off by far more count little.",
        minimum=1e-3,
        maximum=1e6,
    )


@dataclass(frozen=True)
class SolverConfig:
    """How a window is solved."""

    method: str = _param(
        "auto",
        "Named method. See docs/methods.md.",
        choices=METHODS,
    )
    linear_solver: str = _param(
        "auto",
        "How the reduced system is solved; auto takes what costs least. Methods with a trust region always take pcg.",
        choices=LINEAR_SOLVERS,
    )
    backend: str = _param(
        "auto",
        "Kernels: native (C++), numpy, or auto, which takes native where it is built.",
        choices=BACKENDS,
    )
    threads: int = _param(
        1,
        "Threads of the C++ kernels, 0 for one a core. Results are the same, bit for bit, for any number;"
        " one leaves the other cores to the front-end.",
        minimum=0,
        maximum=256,
    )
    loss: str = _param(
        "auto", "Robust loss on each residual; auto: that of an irls_* method, Cauchy's for all others.", choices=LOSSES
    )
    loss_scale_px: float = _param(
        2.0,
        "Residual, in units of sigma, where the robust loss leaves the square.",
        unit="px",
        minimum=1e-6,
        maximum=1e6,
    )
    max_iterations: int = _param(12, "Cap on outer iterations of a solve.", minimum=1, maximum=100_000)
    max_linear_iterations: int = _param(500, "Cap on PCG steps in one outer iteration.", minimum=1, maximum=1_000_000)
    function_tolerance: float = _param(
        1e-3,
        "Stop when an accepted step lowers the objective by less than this share.",
        minimum=0.0,
        maximum=1.0,
    )
    gradient_tolerance: float = _param(
        1e-9,
        "Stop when the norm of the gradient falls below this.",
        minimum=0.0,
        maximum=1e12,
    )
    cheirality: str = _param(
        "constant",
        "Points on or behind the camera plane: keep their plain residual, give them a constant cost, or drop them.",
        choices=CHEIRALITY,
    )


@dataclass(frozen=True)
class GuardConfig:
    """When a solution is held back, so that the front-end's poses stand. See docs/concepts.md."""

    check_setup: bool = _param(
        True,
        "Compare rig, poses, depths and intrinsics with the tracks of the first keyframes of a session, and hold all"
        " solves where they contradict each other, with the likely mistake as the reason. See docs/check.md.",
    )
    enabled: bool = _param(
        True, "Hold solutions back that are not determined, not plausible, or no better than the input."
    )
    step_sigma_m: float = _param(
        0.03,
        "What the front-end's step between two keyframes is off at least: standard deviation along each axis.",
        unit="m",
        minimum=1e-6,
        maximum=1e6,
    )
    step_sigma_share: float = _param(
        0.1, "The same, as a share of the length of the step, on top of it.", minimum=1e-6, maximum=10.0
    )
    turn_sigma_rad: float = _param(
        0.02, "The same for its turn, about each axis.", unit="rad", minimum=1e-6, maximum=1.0
    )
    turn_sigma_share: float = _param(0.1, "The same, as a share of the turn, on top of it.", minimum=1e-6, maximum=10.0)
    turn_sigma_rad_per_m: float = _param(
        0.02, "The same, for each metre of the step, on top of it.", unit="rad/m", minimum=0.0, maximum=10.0
    )
    max_sigmas: float = _param(
        5.0,
        "A step of a solution that is this many sigmas off the front-end's, and not borne out by tracks, is held.",
        minimum=0.5,
        maximum=1e6,
    )
    max_typical_sigmas: float = _param(
        2.5, "A solution of which half the steps are this many sigmas off is held.", minimum=0.5, maximum=1e6
    )
    max_scale_error: float = _param(
        0.12,
        "A solution whose steps or turns are all longer or shorter than the front-end's by this share is held.",
        minimum=1e-3,
        maximum=1e6,
    )
    min_inlier_share: float = _param(
        0.4,
        "A solution that fewer of its observations agree with (within tracks.outlier_px) is held.",
        minimum=0.0,
        maximum=1.0,
    )
    min_points: int = _param(5, "A keyframe that sees fewer points of a solve is not refined.", minimum=2, maximum=1000)
    held_out_tracks: int = _param(
        16,
        "Tracks that a solution is tried on, at most one in 128 of which takes no part in it; 0: no trial.",
        minimum=0,
        maximum=10_000,
    )
    max_worse_share: float = _param(
        0.15,
        "A solution that explains these tracks worse than the front-end's poses by this share is held.",
        minimum=0.0,
        maximum=10.0,
    )


@dataclass(frozen=True)
class FramesConfig:
    """Names of frames, and how the correction map -> odom moves. See docs/frames.md."""

    map_frame: str = _param("map", "Frame of everything that is published.", live=False)
    odom_frame: str = _param(
        "", "Frame of the front-end's poses; empty: the header.frame_id of its keyframes.", live=False
    )
    base_frame: str = _param("base_link", "Frame of the body, from which tf_static leads to the cameras.", live=False)
    poses_of: str = _param(
        "body",
        "What poses are of, in and out: the body, or camera 0 of the rig (optical frame).",
        choices=POSES_OF,
        live=False,
    )
    extrinsics: str = _param(
        "camera_rig",
        "Where the cameras sit on the body: as camera_rig says, or as tf_static does, by their frame_id.",
        choices=EXTRINSICS,
        live=False,
    )
    publish_tf: bool = _param(True, "Publish map -> odom on /tf.")
    transform_tolerance: float = _param(
        0.2, "How far ahead of the data map -> odom is stamped.", unit="s", minimum=0.0, maximum=60.0
    )
    publish_period_s: float = _param(
        0.05,
        "How often map -> odom is repeated, between solves too; 0: after solves only.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
        live=False,
    )
    gate_m: float = _param(
        1.0,
        "A solve that moves the newest keyframe further is held back from /tf until others confirm it; 0: never.",
        unit="m",
        minimum=0.0,
        maximum=1e9,
    )
    gate_rad: float = _param(
        0.2, "The same for a solve that turns it further; 0: never.", unit="rad", minimum=0.0, maximum=4.0
    )
    gate_confirmations: int = _param(
        2, "Solves in a row that have to agree with a correction beyond a gate.", minimum=1, maximum=1000
    )
    smoothing_s: float = _param(
        0.0,
        "Time constant, by the stamps of keyframes, with which map -> odom follows corrections; 0: at once.",
        unit="s",
        minimum=0.0,
        maximum=3600.0,
    )


@dataclass(frozen=True)
class OutputConfig:
    """What is published."""

    path_max_poses: int = _param(1000, "Poses in ~/path; the newest are kept.", minimum=1, maximum=1_000_000)
    points_max: int = _param(
        200_000, "Points in ~/points; beyond it they are thinned evenly.", minimum=1, maximum=50_000_000
    )
    markers_max_keyframes: int = _param(
        200, "Keyframes drawn in ~/markers; the newest are kept.", minimum=1, maximum=10_000
    )
    markers_max_links: int = _param(
        500, "Lines in ~/markers between keyframes; those with most common points are kept.", minimum=0, maximum=100_000
    )
    markers_frustum_m: float = _param(0.2, "Depth of the frusta in ~/markers.", unit="m", minimum=1e-3, maximum=1e3)
    markers_rms_px: float = _param(
        2.0,
        "Reprojection error of a keyframe that ~/markers draws in red; 0 is green.",
        unit="px",
        minimum=1e-3,
        maximum=1e6,
    )


@dataclass(frozen=True)
class NodeConfig:
    """How the node runs. Not used offline, except for names."""

    autostart: bool = _param(
        True, "Configure and activate at start; false leaves both to `ros2 lifecycle set` or a manager.", live=False
    )
    inbox_size: int = _param(
        500,
        "Messages that wait for the solver; beyond it the oldest tracks are dropped and counted.",
        minimum=10,
        maximum=100_000,
        live=False,
    )
    map_folder: str = _param(
        "~/.ros/ba_node",
        "Folder that ~/save_map and ~/load_map work in: what clients name is below it. / for any file; empty: both"
        " services refuse.",
        live=False,
    )
    queue_depth: int = _param(100, "QoS depth of the input subscriptions.", minimum=1, maximum=100_000, live=False)
    silence_s: float = _param(
        10.0,
        "With no keyframes or tracks for this long, log and /diagnostics name the topics and who publishes there;"
        " 0: never.",
        unit="s",
        minimum=0.0,
        maximum=86_400.0,
    )
    log_period_s: float = _param(
        5.0,
        "How often one line in the log tells rate, residuals, latency, and what became of the solutions; 0: never.",
        unit="s",
        minimum=0.0,
        maximum=86_400.0,
    )
    latency_budget_ms: float = _param(
        0.0,
        "Time from arrival of a keyframe to its result that the solver may use up: it ends after an iteration"
        " when another would take longer, but makes one always. 0: no limit. Without effect offline.",
        unit="ms",
        minimum=0.0,
        maximum=1e6,
    )
    settle_time_s: float = _param(
        0.5,
        "With no new message for this long, the newest keyframe is solved with what has arrived.",
        unit="s",
        minimum=0.01,
        maximum=3600.0,
        live=False,
    )


@dataclass(frozen=True)
class DiagnosticsConfig:
    """When /diagnostics warns. See docs/diagnostics.md."""

    recent_s: float = _param(
        10.0, "What was dropped or turned away counts for this long.", unit="s", minimum=1.0, maximum=3600.0
    )
    queue_warn_share: float = _param(
        0.5, "Share of node.inbox_size that waits from which on the queue warns.", minimum=0.0, maximum=1.0
    )
    latency_warn_s: float = _param(
        0.2, "95th percentile from arrival to publication that warns.", unit="s", minimum=0.0, maximum=1e6
    )
    latency_error_s: float = _param(1.0, "The same as an error.", unit="s", minimum=0.0, maximum=1e6)
    rms_warn_px: float = _param(
        2.0, "Root mean square residual after a solve that warns.", unit="px", minimum=0.0, maximum=1e6
    )
    rms_error_px: float = _param(10.0, "The same as an error.", unit="px", minimum=0.0, maximum=1e6)
    inliers_warn_share: float = _param(
        0.7, "Share of observations that are believed below which it warns.", minimum=0.0, maximum=1.0
    )
    inliers_error_share: float = _param(0.3, "The same as an error.", minimum=0.0, maximum=1.0)
    memory_warn_mb: float = _param(
        2000.0, "Memory of the process (resident) that warns.", unit="MB", minimum=0.0, maximum=1e9
    )
    memory_error_mb: float = _param(8000.0, "The same as an error.", unit="MB", minimum=0.0, maximum=1e9)


@dataclass(frozen=True)
class Config:
    """All parameters, in groups. Immutable; a change makes a new one with :meth:`with_values`."""

    window: WindowConfig = field(default_factory=WindowConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    guard: GuardConfig = field(default_factory=GuardConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    node: NodeConfig = field(default_factory=NodeConfig)
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)

    def values(self) -> dict[str, Value]:
        """Return every parameter by its full name, in declaration order."""
        return {p.name: _get(self, p.name) for p in declarations()}

    def with_values(self, changes: Mapping[str, object]) -> Config:
        """Return a copy with the named parameters changed, or raise ConfigError and change nothing."""
        declared = {p.name: p for p in declarations()}
        groups: dict[str, dict[str, Value]] = {}
        for name, value in changes.items():
            if name not in declared:
                raise ConfigError(unknown(name, list(declared)))
            group, key = name.split(".")
            groups.setdefault(group, {})[key] = declared[name].check(value)
        replaced = {group: dataclasses.replace(getattr(self, group), **keys) for group, keys in groups.items()}
        changed = dataclasses.replace(self, **replaced)
        changed.check()
        return changed

    def check(self) -> None:
        """Raise ConfigError if parameters contradict each other or ROS, each of which is valid by itself."""
        window, scene = self.window.max_keyframes, self.scene.max_keyframes
        if window > scene:
            raise ConfigError(
                f"parameter window.max_keyframes = {window}: more than are kept (scene.max_keyframes = {scene});"
                f" lower the first or raise the second"
            )
        for name in ("map_frame", "odom_frame", "base_frame"):
            frame = str(getattr(self.frames, name))
            if frame.startswith("/"):
                raise ConfigError(
                    f"parameter frames.{name} = {frame!r}: tf2 refuses a name that begins with a slash;"
                    f" take {frame.lstrip('/')!r}"
                )
        if self.solver.method.startswith("irls_") and self.solver.loss == "squared":
            raise ConfigError(
                f"parameter solver.loss = 'squared': method {self.solver.method!r} reweights residuals, which the"
                f" squared loss leaves alone; choose another loss or another method"
            )


def _get(config: Config, name: str) -> Value:
    group, key = name.split(".")
    value: Value = getattr(getattr(config, group), key)
    return value


def unknown(name: str, known: list[str]) -> str:
    """Return what to say of a parameter that does not exist: the one it is most like."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
    return f"parameter {name!r} does not exist; did you mean {near[0]!r}?"


def _parameters() -> Iterator[Parameter]:
    for group in fields(Config):
        cls = get_type_hints(Config)[group.name]
        kinds = get_type_hints(cls)
        for item in fields(cls):
            yield Parameter(
                name=f"{group.name}.{item.name}",
                kind=kinds[item.name],
                default=cast("Value", item.default),
                **item.metadata,
            )


_DECLARATIONS = tuple(_parameters())


def declarations() -> tuple[Parameter, ...]:
    """Return every parameter, in the order of the file."""
    return _DECLARATIONS


def parse_assignment(text: str) -> tuple[str, Value]:
    """Read ``name=value`` as given on a command line, in the type of the parameter.

    Raises:
        ConfigError: there is no ``=``, no such parameter, or the value cannot be read.
    """
    name, separator, raw = text.partition("=")
    if not separator:
        raise ConfigError(f"{text!r}: expected name=value, for example window.max_keyframes=10")
    known = {p.name: p for p in declarations()}
    if name not in known:
        raise ConfigError(unknown(name, list(known)))
    parameter = known[name]
    return name, parameter.check(_read(raw, parameter))


def _read(raw: str, parameter: Parameter) -> Value:
    if parameter.kind is bool:
        if raw.lower() not in ("true", "false"):
            raise ConfigError(f"parameter {parameter.name} = {raw!r}: expected true or false")
        return raw.lower() == "true"
    if parameter.kind is str:
        return raw
    try:
        value: Value = parameter.kind(raw)
    except ValueError:
        raise ConfigError(f"parameter {parameter.name} = {raw!r}: expected {parameter.kind.__name__}") from None
    return value
