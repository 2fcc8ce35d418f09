# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Look at the command line: words that are nothing to ROS, and parameter files in which nothing is for this node.

ROS itself passes over both without a word, and then parameters have no effect.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml
from rclpy.utilities import remove_ros_args

_ABOUT = {
    "ba_node": "Bundle-adjustment back-end as a ROS 2 node: takes keyframes and feature tracks, publishes refined poses"
    " and points.\n`ba params` prints a FILE with all parameters; `-r __ns:=/robot` puts the node into a namespace.",
    "ba_front_end": "Front-end as a ROS 2 node: takes images, publishes keyframes and feature tracks.",
}
_HELP = {"-h", "--help"}
_FILE_OPTION = "--params-file"
_PARAMETERS = "ros__parameters"


def usage(name: str) -> str:
    """Return what there is to say of a program."""
    words = "[-p NAME:=VALUE]... [--params-file FILE]... [-r FROM:=TO]... [--log-level LEVEL]"
    return f"usage: {name} [--ros-args {words}]\n\n{_ABOUT[name]}\n"


def asks_for_help(arguments: Sequence[str]) -> bool:
    """Return True if the arguments, program first, ask what can be said here."""
    return bool(_HELP.intersection(remove_ros_args(list(arguments))[1:]))


def objection(arguments: Sequence[str]) -> str:
    """Return what is wrong with arguments, program first, that ROS would pass over; empty if nothing is."""
    words = remove_ros_args(list(arguments))[1:]
    if not words:
        return ""
    return f"argument {words[0]!r} is not known; parameters follow --ros-args, as in --ros-args -p solver.threads:=2"


def idle_files(arguments: Sequence[str], node_name: str) -> list[str]:
    """Say of each parameter file in which nothing is for the node of that full name whom it is for."""
    named = [after for word, after in itertools.pairwise(arguments) if word == _FILE_OPTION]
    lines = []
    for name in named:
        sections = list(_sections(yaml.safe_load(Path(name).read_text())))
        if not any(re.fullmatch(_pattern(section), node_name) for section in sections):
            others = ", ".join(sections) or "nobody"
            lines.append(f"{name} has parameters for {others} and none for {node_name}: nothing of it is used")
    return lines


def _sections(tree: object, above: str = "") -> Iterator[str]:
    """Return the names of the nodes that a parameter file speaks to, wildcards included."""
    if not isinstance(tree, Mapping):
        return
    for key, below in tree.items():
        if key == _PARAMETERS:
            yield above
        else:
            yield from _sections(below, f"{above}/{str(key).strip('/')}")


def _pattern(section: str) -> str:
    """Return the regular expression of a name: * stands for one part of it, ** for any number."""
    wild = {"": "", "*": "/[^/]+", "**": "(/[^/]+)*"}
    return "".join(wild.get(part, f"/{re.escape(part)}") for part in section.split("/"))
