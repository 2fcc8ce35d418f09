# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.writer import Writer

from ba_node.cli import main as command_line
from ba_node.cli import params
from ba_node.cli.main import COMMANDS, GROUPS, main


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert f"example:\n  ba {command}" in text
    assert "--json FILE" in text


@pytest.mark.parametrize("command", ["demo", "synth", "steps", "sphere", "robustness", "thesis"])
def test_commands_of_a_checkout_say_so_elsewhere(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command_line, "ROOT", tmp_path)
    for arguments in ([command], [command, "--help"]):
        assert refused(capsys, *arguments) == (
            f"ba: error: {command} needs a checkout of the repository: experiments are not installed\n"
        )


def test_overview_names_every_command_and_is_fast() -> None:
    began = time.perf_counter()
    run = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "ba_node.cli.main", "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert all(f"    {command} " in run.stdout for command in COMMANDS)
    assert [line[:-1] for line in run.stdout.splitlines() if line[:-1] in GROUPS] == [*GROUPS]
    slow = [name for name in ("numpy", "scipy", "rosbags", "mcap", "rclpy") if f"| {name}\n" in run.stderr]
    assert not slow, f"ba --help imports {slow}, {time.perf_counter() - began:.2f} s"


@pytest.mark.parametrize(
    ("line", "among"),
    [
        ("ba re", ["replay"]),
        ("ba replay --fi", ["--final-optimize"]),
        ("ba evaluate a.tum b.tum --align s", ["se3", "sim3"]),
    ],
)
def test_a_shell_completes_commands_options_and_values(line: str, among: list[str], tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    place = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "_ARGCOMPLETE_SHELL": "bash"}
    environment = {**os.environ, **asked, **place}
    subprocess.run([sys.executable, "-m", "ba_node.cli.main"], env=environment, check=True, timeout=60)
    assert set(among) <= {word.strip() for word in answer.read_text().splitlines()}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "the following arguments are required: COMMAND; see ba --help"),
        (["replya"], "invalid choice: 'replya'"),
        (["replay", "x.mcap"], "the following arguments are required: --out; see ba replay --help"),
        (["evaluate", "a.tum", "b.tum", "--align", "affine"], "invalid choice: 'affine'"),
    ],
)
def test_wrong_command_line_is_one_line(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.startswith("ba: error: ")
    assert words in error
    assert error.count("\n") == 1


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must end with code 2; return its one line of error."""
    code = main(arguments)
    error = capsys.readouterr().err
    assert code == 2, f"exit code {code}: {error}"
    assert error.startswith("ba: error: ")
    assert error.count("\n") == 1, f"not one line: {error!r}"
    return error


def test_bad_recordings_are_named(tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out")
    empty, text = tmp_path / "empty.mcap", tmp_path / "text.mcap"
    empty.write_bytes(b"")
    text.write_text("not a recording")
    stub = tmp_path / "stub.mcap"
    stub.write_bytes(bag.read_bytes()[:60])
    for path in (empty, text, stub, tmp_path / "missing.mcap", tmp_path):
        assert str(path) in refused(capsys, "replay", str(path), "--out", out)
    assert not (tmp_path / "out" / "report.json").exists()


def test_recording_without_keyframes_names_what_is_missing(
    tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(bag), "--out", str(tmp_path / "out"), "--no-report"]) == 0
    capsys.readouterr()
    outputs = tmp_path / "out" / "refined.mcap"
    error = refused(capsys, "replay", str(outputs), "--out", str(tmp_path / "again"))
    assert "ba_msgs/msg/Keyframe" in error
    assert "/ba_node/refined_keyframes" in error
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("window.max_keyframe=3", "did you mean 'window.max_keyframes'?"),
        ("outlier_px=3", "did you mean 'tracks.outlier_px'?"),
        ("max_keyframes=3", "did you mean 'window.max_keyframes' or 'scene.max_keyframes'?"),
        ("outlierpx=3", "did you mean 'tracks.outlier_px'?"),
        ("foo=1", "parameter 'foo' does not exist; ba params lists all"),
        ("window.max_keyframes=many", "expected int"),
        ("window.max_keyframes=1", "expected a number in [2, 100000]"),
        ("solver.loss=l1", "choose one of squared, huber"),
        ("window.max_keyframes", "expected name=value"),
    ],
)
def test_bad_settings_are_explained(
    setting: str, words: str, tmp_path: Path, bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in refused(capsys, "replay", str(bag), "--out", str(tmp_path / "out"), "--set", setting)
    assert not (tmp_path / "out").exists()


def test_interrupt_ends_with_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(params, "run", interrupted)
    assert main(["params"]) == 130
    assert capsys.readouterr().err == "ba: interrupted\n"


def unread(*arguments: str) -> int:
    """Return the exit code of ``ba``, which has to say nothing of it, where nobody reads what it prints."""
    command = [sys.executable, "-m", "ba_node.cli.main", *arguments]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=buffered) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        return process.wait(60)


def test_a_reader_that_goes_away_does_not_change_the_code(tmp_path: Path) -> None:
    """As in ``ba replay ... | head``: it was 0 whatever had come out."""
    words = tmp_path / "words.mcap"  # nothing that a back-end could use
    with words.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/words", "cdr", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"\0\1\0\0\1\0\0\0\0")
        writer.finish()  # type: ignore[no-untyped-call]
    assert main(["info", str(words)]) == unread("info", str(words)) == 3


def test_a_reader_that_goes_away_while_there_is_more_to_print_ends_the_work() -> None:
    assert unread("params") == 141


def test_faults_of_our_own_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def faulty(_: object) -> int:
        raise ValueError("a fault")

    monkeypatch.setattr(params, "run", faulty)
    with pytest.raises(ValueError, match="a fault"):
        main(["params"])


def test_missing_ros_is_named() -> None:
    script = "import sys; sys.modules['rclpy'] = None; from ba_node.cli.main import main; sys.exit(main(['play', 'x']))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert run.stderr.startswith("ba: error: import of rclpy halted")
    assert run.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ["convert", "a.mcap", "a.mcap"],
        ["cut", "a.mcap", "--out", "./a.mcap", "--start", "1"],
        ["merge", "b.mcap", "a.mcap", "--out", "a.mcap"],
        ["track", "a.mcap", "link.mcap"],
        ["info", "a.mcap", "--json", "a.mcap"],
        ["cut", "folder", "--out", "folder/part_0.mcap"],
        ["rig", "b.mcap", "a.mcap", "--out", "c.yaml", "./a.mcap"],
        ["solve", "a.mcap", "--out", "link.mcap"],
        ["solve", "model", "--out", "model/"],
        ["convert", "model", "model"],
        ["map", "export", "a.mcap", "--ply", "a.mcap"],
        ["evaluate", "a.mcap", "b.mcap", "--csv", "b.mcap"],
        ["track", "folder", "out.mcap", "--rig", "a.mcap", "--json", "a.mcap"],
    ],
)
def test_what_is_read_is_not_written_over(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("a.mcap", "b.mcap", "folder/part_0.mcap", "model/cameras.bin")
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"months of work")
    (tmp_path / "link.mcap").symlink_to("a.mcap")
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "that is read, and would be lost: write to another name" in error and error.count("\n") == 1
    assert all((tmp_path / name).read_bytes() == b"months of work" for name in names)


def test_an_empty_name_is_no_folder(capsys: pytest.CaptureFixture[str]) -> None:
    """As of a variable of a script that is not set."""
    for line in (["replay", "", "--out", "out"], ["info", ""]):
        with pytest.raises(SystemExit) as left:
            main(line)
        assert left.value.code == 2
        assert "an empty name: expected a file or folder" in capsys.readouterr().err
