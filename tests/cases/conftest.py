# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Run the command on a recording and collect what came of it: code, words, errors."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from ba_node.cli.main import main
from ba_node.estimate import Poses
from experiments.robustness.harm import SessionResult, messages_of, session_results

Replay = Callable[..., "Outcome"]


@dataclass(frozen=True)
class Outcome:
    """A replay that has ended.

    Attributes:
        out: the folder of results.
        code: exit code.
        words: what stderr and report.json tell a user.
        report: report.json; empty if nothing was written.
    """

    out: Path
    code: int
    words: str
    report: dict[str, Any]

    def errors(self, truth: Poses) -> list[SessionResult]:
        """Return the errors of every session."""
        return session_results(self.out, truth)

    def tells(self, *patterns: str) -> None:
        """Assert that each pattern is found in the messages to the user."""
        for pattern in patterns:
            assert re.search(pattern, self.words, re.IGNORECASE), f"{pattern!r} is not in:\n{self.words or 'nothing'}"


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Replay:
    """Return what replays a file by the command line."""

    def replay(bag: Path, *arguments: str) -> Outcome:
        out = tmp_path / "out"
        capsys.readouterr()
        code = main(["replay", str(bag), "--out", str(out), "--no-report", *arguments])
        stderr = capsys.readouterr().err
        path = out / "report.json"
        report: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        lines = [line for line in stderr.splitlines() if line.startswith("ba:")]
        return Outcome(out, code, "\n".join([*lines, messages_of(report) if report else ""]).strip(), report)

    return replay


def harmless(errors: list[SessionResult], least: float, keyframes: int) -> None:
    """Assert that no session became worse, and that enough keyframes were published."""
    published = sum(error.keyframes for error in errors)
    assert published >= least * keyframes, f"{published} of {keyframes} keyframes published"
    for error in errors:
        assert error.harmless, (
            f"{error.folder.name}: {error.input_m:.4f} -> {error.published_m:.4f} m,"
            f" {error.input_deg:.3f} -> {error.published_deg:.3f} deg"
        )
