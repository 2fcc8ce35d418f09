# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""rclpy's logger raises when the severity of a call site changes: no source may have such a site."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from typing import Any

import pytest

from ba_node.ros.log import Severity, Throttle, log, printable

ROOT = Path(__file__).resolve().parents[2]
SEVERITIES = {"debug", "info", "warning", "warn", "error", "fatal", "critical"}


def changing_sites(source: str) -> list[int]:
    """Return the lines where the severity of a logger is chosen by anything but the name of the method that is called.

    That is: a method of a logger that is not called where it is named (chosen by a condition, kept in a dictionary or a
    variable, handed on), one that is looked up by its name, and ``log(text, severity)`` with a severity that varies.
    """
    tree = ast.parse(source)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return [node.lineno for node in ast.walk(tree) if isinstance(node, ast.expr) and _changes(node, called)]


def _changes(node: ast.expr, called: set[int]) -> bool:
    if isinstance(node, ast.Attribute):
        return node.attr in SEVERITIES and _is_logger(node.value) and id(node) not in called
    if not isinstance(node, ast.Call):
        return False
    if isinstance(node.func, ast.Name) and node.func.id in ("getattr", "methodcaller") and node.args:
        names = {word.value for word in ast.walk(node) if isinstance(word, ast.Constant)}
        return _is_logger(node.args[0]) or bool(names & SEVERITIES)
    if isinstance(node.func, ast.Attribute) and node.func.attr == "log" and len(node.args) > 1:
        return _is_logger(node.func.value) and not isinstance(node.args[1], (ast.Attribute, ast.Constant))
    return False


def _is_logger(node: ast.expr) -> bool:
    return "log" in ast.unparse(node).lower().replace("dialog", "")


@pytest.mark.parametrize(
    "source",
    [
        "(log.info if ok else log.warning)(text)",
        "(node.get_logger().info if ok else node.get_logger().warning)(text)",
        "say = logger.info if ok else logger.error\nsay(text)",
        "{True: log.info, False: log.error}[ok](text)",
        "getattr(self.get_logger(), name)(text)",
        "getattr(self._out, 'warning')(text)",
        "for write in (log.debug, log.warn): write(text)",
        "functools.partial(self._logger.warning, text)()",
        "threading.Timer(1.0, node.get_logger().error)",
        "node.get_logger().log(text, severity)",
        "node.get_logger().log(text, LoggingSeverity.INFO if ok else LoggingSeverity.WARN)",
        "operator.methodcaller(name)(log)\nmethodcaller('info', text)(log)",
    ],
)
def test_the_walk_finds_what_it_looks_for(source: str) -> None:
    assert changing_sites(source), source


@pytest.mark.parametrize(
    "source",
    [
        "log.info(text)",
        "parser.error",
        "self.host.log(Notice('a', text))",
        "logger.log(text, Severity.INFO)",
        "e.error",
    ],
)
def test_the_walk_finds_nothing_else(source: str) -> None:
    assert not changing_sites(source)


@pytest.mark.slow
def test_no_source_has_such_a_site() -> None:
    paths = [path for folder in ("ba_node", "launch", "experiments") for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(paths) > 150
    found = [f"{path.relative_to(ROOT)}:{line}" for path in paths for line in changing_sites(path.read_text())]
    assert not found, found


class Strict:
    """A logger that is as strict as rclpy's."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._severity: dict[int, str] = {}

    def _write(self, severity: str, text: str) -> None:
        site = sys._getframe(2).f_lineno
        if self._severity.setdefault(site, severity) != severity:
            raise ValueError("Logger severity cannot be changed between calls.")
        text.encode()
        self.lines.append(f"{severity}: {text}")

    def info(self, text: str) -> None:
        self._write("info", text)

    def warning(self, text: str) -> None:
        self._write("warning", text)

    def error(self, text: str) -> None:
        self._write("error", text)

    def get_logger(self) -> Strict:
        return self


def test_any_severity_in_any_order() -> None:
    node = Strict()
    for severity in (*Severity, *reversed(Severity), *Severity):
        log(node, severity, "a")
    assert [line[0] for line in node.lines] == list("iweewiiwe")
    log(node, Severity.INFO, "name \udcff of a file")
    assert node.lines[-1] == "info: name \\udcff of a file"
    assert printable("name \udcff") == "name \\udcff"


def test_a_log_that_raises_is_survived(capsys: pytest.CaptureFixture[str]) -> None:
    class Broken:
        def get_logger(self) -> Any:
            raise RuntimeError("no log")

    log(Broken(), Severity.WARNING, "what I wanted to say")
    assert capsys.readouterr().err == "warning: what I wanted to say (not in the log: no log)\n"


def test_lets_each_key_through_once_a_period() -> None:
    throttle = Throttle(5.0)
    passed = [(key, t) for t in range(12) for key in ("a", "b") if throttle.passes(key, float(t))]
    assert passed == [("a", 0), ("b", 0), ("a", 5), ("b", 5), ("a", 10), ("b", 10)]


def test_remembers_a_bounded_number_of_keys() -> None:
    throttle = Throttle(5.0, max_keys=2)
    assert all(throttle.passes(key, 0.0) for key in ("a", "b", "c"))
    assert not throttle.passes("c", 1.0)
    assert throttle.passes("a", 1.0), "the oldest key was forgotten to make room"
