# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Declare every option once: name, type, default, unit, range, choices, meaning, live or read-only.

The YAML file, the table in docs/parameters.md, the descriptors of the ROS node and ``--set`` on the command line are
loops over :func:`declarations`, the tables in docs/methods.md and ``ba solve --set`` over the options of
:class:`SolverOptions`; nothing repeats a default.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TypeVar, get_type_hints

from ba_node.config.declaration import (
    Checked,
    ConfigError,
    Parameter,
    Value,
    declared,
    option,
    split_assignment,
    unknown,
)
from ba_node.config.estimation import (
    CalibrationConfig,
    FactorsConfig,
    GuardConfig,
    OdometryConfig,
    SceneConfig,
    TracksConfig,
    WindowConfig,
)
from ba_node.config.node import DiagnosticsConfig, FramesConfig, NodeConfig, OutputConfig
from ba_node.config.solver import METHOD_LOSSES, PLATEAUS, SolverConfig, SolverOptions

__all__ = [
    "METHOD_LOSSES",
    "PLATEAUS",
    "CalibrationConfig",
    "Checked",
    "Config",
    "ConfigError",
    "DiagnosticsConfig",
    "FactorsConfig",
    "FramesConfig",
    "GuardConfig",
    "OdometryConfig",
    "OutputConfig",
    "Parameter",
    "SceneConfig",
    "SolverConfig",
    "SolverOptions",
    "TracksConfig",
    "Value",
    "declarations",
    "declared",
    "find",
    "option",
    "parse_assignment",
    "split_assignment",
    "unknown",
]

Group = TypeVar("Group")


def _defaults(group: type[Group]) -> Group:
    """Return a group of parameters with the defaults of the node."""
    return group(**{p.name.partition(".")[2]: p.default for p in declared(group, "node")})


@dataclass(frozen=True)
class Config:
    """All parameters, in groups. Immutable; a change makes a new one with :meth:`with_values`."""

    window: WindowConfig = field(default_factory=WindowConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    factors: FactorsConfig = field(default_factory=FactorsConfig)
    solver: SolverConfig = field(default_factory=lambda: _defaults(SolverConfig))
    guard: GuardConfig = field(default_factory=GuardConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    node: NodeConfig = field(default_factory=NodeConfig)
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)

    @property
    def checks_setup(self) -> bool:
        """Return True if a set-up that contradicts the tracks holds solves: not if it is what is to be refined."""
        return self.guard.check_setup and not self.calibration.wanted

    def values(self) -> dict[str, Value]:
        """Return every parameter by its full name, in declaration order."""
        return {p.name: _get(self, p.name) for p in declarations()}

    def with_values(self, changes: Mapping[str, object]) -> Config:
        """Return a copy with the named parameters changed, or raise ConfigError and change nothing."""
        groups: dict[str, dict[str, Value]] = {}
        for name, value in changes.items():
            parameter = find(name)
            group, key = parameter.name.split(".")
            groups.setdefault(group, {})[key] = parameter.check(value)
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
        own = METHOD_LOSSES.get(self.solver.method)
        if own is not None and self.solver.loss not in ("auto", own):
            raise ConfigError(
                f"parameter solver.loss = {self.solver.loss!r}: method {self.solver.method!r} is named after the loss"
                f" {own!r}; leave solver.loss at 'auto', or take method 'local_dinm', which has any"
            )


def _get(config: Config, name: str) -> Value:
    group, key = name.split(".")
    value: Value = getattr(getattr(config, group), key)
    return value


_DECLARATIONS = tuple(
    parameter for group in fields(Config) for parameter in declared(get_type_hints(Config)[group.name], group.name)
)
_BY_NAME = {parameter.name: parameter for parameter in _DECLARATIONS}
_BY_ALIAS = {
    f"{parameter.name.partition('.')[0]}.{alias}": parameter
    for parameter in _DECLARATIONS
    for alias in parameter.aliases
}


def declarations() -> tuple[Parameter, ...]:
    """Return every parameter of the node, in the order of the groups."""
    return _DECLARATIONS


def find(name: str) -> Parameter:
    """Return a parameter of the node by its full name or by one that it had before; raise ConfigError if it is none."""
    parameter = _BY_NAME.get(name) or _BY_ALIAS.get(name)
    if parameter is None:
        raise ConfigError(unknown(name, _BY_NAME))
    return parameter


def parse_assignment(text: str) -> tuple[str, Value]:
    """Read ``name=value`` as given on a command line, in the type of the parameter.

    Raises:
        ConfigError: there is no ``=``, no such parameter, or the value cannot be read.
    """
    name, value = split_assignment(text, "window.max_keyframes=10")
    parameter = find(name)
    return parameter.name, parameter.read(value)
