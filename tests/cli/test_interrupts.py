# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""A signal ends ``ba`` with a code of its own and one line, whenever it comes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from ba_node.cli import interrupts

# Of a process: which signals it handles.
_TERMINATION = 1 << (signal.SIGTERM - 1)
BA = (sys.executable, "-m", "ba_node.cli.main")
WORDS = {signal.SIGINT: "ba: interrupted\n", signal.SIGTERM: "ba: terminated\n"}


def start(*words: str) -> subprocess.Popen[str]:
    """Start ``ba``, with SIGINT as in a terminal even if this test runs in the background."""
    return subprocess.Popen(
        ["env", "--default-signal=INT,TERM", *BA, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def handles(process: subprocess.Popen[str]) -> bool:
    """Return True once the process has its handlers: Python leaves SIGTERM to the system."""
    try:
        lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return False
    caught = next((line.split()[1] for line in lines if line.startswith("SigCgt")), "0")
    return bool(int(caught, 16) & _TERMINATION)


def interrupted_at(moment_s: float, number: signal.Signals, words: Sequence[str]) -> tuple[int, str, bool]:
    """Send a signal so long after the handlers are there; return code, stderr, and whether it came before the end."""
    process = start(*words)
    try:
        while not handles(process) and process.poll() is None:
            time.sleep(0.0005)
        time.sleep(moment_s)
        in_time = process.poll() is None
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, err, in_time


def length_s(words: Sequence[str]) -> float:
    """Return how long a command takes once it has its handlers."""
    process = start(*words)
    while not handles(process) and process.poll() is None:
        time.sleep(0.0005)
    began = time.monotonic()
    process.communicate(timeout=60)
    assert process.returncode == 0
    return time.monotonic() - began


def check(moments: Sequence[float], number: signal.Signals, words: Sequence[str], out: Path) -> int:
    """Interrupt a command at each moment; return how many came in time."""
    count = 0
    for moment_s in moments:
        code, err, in_time = interrupted_at(moment_s, number, words)
        # What came when all was done changes nothing.
        is_done = code == 0 and "ba: interrupted" not in err
        assert is_done or (code, err) == (128 + number, WORDS[number]), f"at {moment_s:.4f} s: {code}, {err}"
        assert not is_done or moment_s > 0.2 * moments[-1], f"at {moment_s:.4f} s of {moments[-1]:.4f}"
        left = [path.name for path in out.rglob("*") if path.name.endswith(".partial")] if out.exists() else []
        assert not left, f"at {moment_s:.4f} s"
        if (out / "report.json").exists():
            json.loads((out / "report.json").read_text())
        count += in_time and not is_done
    return count


def test_a_signal_at_a_few_moments(bag: Path, tmp_path: Path) -> None:
    words = ["replay", str(bag), "--out", str(tmp_path / "out"), "--no-report"]
    whole = length_s(words)
    moments = [whole * share for share in (0.0, 0.3, 0.7)]
    assert check(moments, signal.SIGINT, words, tmp_path / "out") >= 2
    assert check(moments[1:2], signal.SIGTERM, words, tmp_path / "out") == 1


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_thirty_moments(number: signal.Signals, bag: Path, tmp_path: Path) -> None:
    words = ["replay", str(bag), "--out", str(tmp_path / "out")]
    whole = length_s(words)
    moments = [whole * share / 29 for share in range(30)]
    assert check(moments, number, words, tmp_path / "out") >= 15


@pytest.mark.parametrize("words", [["--help"], ["params"], ["nonsense"], ["solve", "none.txt"]])
def test_codes_are_the_same_without_a_signal(words: list[str]) -> None:
    process = start(*words)
    out, err = process.communicate(timeout=60)
    assert process.returncode == (2 if words[0] in ("nonsense", "solve") else 0)
    assert len(out) > 100 if process.returncode == 0 else err.count("\n") == 1


def test_only_the_program_takes_signals_over(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not interrupts.begun() and not interrupts.is_program()
    for argv, expected in ((["/usr/bin/ba", "replay"], True), (["bar"], False), (["pytest", "ba"], False)):
        monkeypatch.setattr(sys, "argv", argv)
        assert interrupts.is_program() == expected


@pytest.mark.slow
def test_a_full_disk_names_the_file(bag: Path, tmp_path: Path) -> None:
    """The limit of the size of files stands in for it."""
    out = tmp_path / "out"
    limited = ["sh", "-c", 'ulimit -f 4; exec "$@"', "sh", *BA, "replay", str(bag), "--out", str(out)]
    run = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (2, f"ba: error: {out / 'refined.mcap'}: File too large\n")
    assert not out.exists()


@pytest.mark.slow
def test_an_interrupt_of_all_processes_is_one_line(bag: Path, tmp_path: Path) -> None:
    """As Ctrl-C in a terminal: it reaches the workers too. Trials that are done stay."""
    pytest.importorskip("distributed")
    words = ["tune", str(bag), "--out", str(tmp_path), "--trials", "500", "--jobs", "2"]
    process = subprocess.Popen(
        ["env", "--default-signal=INT,TERM", *BA, *words],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    end = time.monotonic() + 120.0
    while not (tmp_path / "tuned.yaml").exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.endswith("others too does not show\nba: interrupted\n"), err
    assert (tmp_path / "tuned.yaml").is_file()


@pytest.mark.parametrize(("words", "code"), [(["info", "{bag}"], 0), (["info", "none.mcap"], 2)])
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_no_code(words: list[str], code: int, closed: str, bag: Path) -> None:
    line = " ".join([*BA, *(word.format(bag=bag) for word in words), closed])
    ended = subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == code, ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_full_standard_output_is_named(bag: Path) -> None:
    with Path("/dev/full").open("w") as full:
        line = [*BA, "info", str(bag)]
        ended = subprocess.run(line, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (2, "ba: error: standard output: No space left on device\n")
