# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Files that are whole or not there, whoever else writes, is killed, plants links, or fills the disk."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ba_node.io import files
from ba_node.io.files import FileKindError, FolderInUseError, locked_folder, open_regular, whole_file, write_json


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with whole_file(path) as stream:
        stream.write(b"one")
        assert not path.exists()
        assert len(names(tmp_path)) == 1
    assert path.read_bytes() == b"one"
    with pytest.raises(ValueError, match="two"), whole_file(path) as stream:
        stream.write(bytes(int("two")))
    assert (names(tmp_path), path.read_bytes()) == (["a.txt"], b"one")
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask


def test_writers_at_once_do_not_mix(tmp_path: Path) -> None:
    path, together = tmp_path / "a.bin", threading.Barrier(8)

    def write(digit: int) -> None:
        with whole_file(path) as stream:
            together.wait()
            for _ in range(500):
                stream.write(bytes([digit]) * 100)
            together.wait()

    threads = [threading.Thread(target=write, args=(digit,)) for digit in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    data = path.read_bytes()
    assert len(data) == 50_000 and len(set(data)) == 1
    assert names(tmp_path) == ["a.bin"]


def test_planted_links_are_not_written_through(tmp_path: Path) -> None:
    """A link under the old, predictable name of the unfinished file, and one under the name itself."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / ".a.txt.partial").symlink_to(precious)
    (tmp_path / "a.txt").symlink_to(precious)
    with whole_file(tmp_path / "a.txt") as stream:
        stream.write(b"new")
    assert precious.read_text() == "mine"
    assert (tmp_path / "a.txt").read_text() == "new" and not (tmp_path / "a.txt").is_symlink()


@pytest.mark.parametrize("target", ["pipe", "link", "folder"])
def test_devices_pipes_and_folders_are_not_replaced(target: str, tmp_path: Path) -> None:
    path = tmp_path / target
    if target == "pipe":
        os.mkfifo(path)
    elif target == "link":
        path.symlink_to("/dev/null")
    else:
        path.mkdir()
    with pytest.raises(OSError, match=r"no regular file|Is a directory") as caught, whole_file(path):
        pytest.fail("it was opened")
    assert caught.value.filename == str(path)
    assert names(tmp_path) == [target]


KILLED = """
import os, signal, sys
from ba_node.io.files import whole_file

with whole_file(sys.argv[1]) as stream:
    stream.write(b"x" * 100_000)
    print("begun", flush=True)
    sys.stdin.read()
"""


@contextmanager
def writing(path: Path) -> Iterator[subprocess.Popen[str]]:
    """Have a process write a file that it does not finish before its input ends."""
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        yield process


def test_what_a_killed_process_left_is_cleaned_up_by_the_next(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    with writing(path) as process:
        process.kill()
    (left,) = names(tmp_path)
    assert left.startswith(".a.bin.") and left.endswith(".partial")
    (tmp_path / ".other.bin.0.partial").touch()
    (tmp_path / ".a.bin.1.partial").symlink_to("/dev/null")
    with writing(path) as process:
        (alive,) = set(names(tmp_path)) - {left, ".other.bin.0.partial", ".a.bin.1.partial"}
        write_json(path, {"a": 1})
        assert alive in names(tmp_path), "what another process writes is left alone"
        assert left not in names(tmp_path)
        process.communicate("", timeout=60)
    assert process.returncode == 0
    assert path.read_bytes() == b"x" * 100_000
    assert names(tmp_path) == [".a.bin.1.partial", ".other.bin.0.partial", "a.bin"]


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    """The limit of the size of files stands in for it: EFBIG in the place of ENOSPC."""
    script = textwrap.dedent("""
        import sys
        from ba_node.io.files import whole_file
        try:
            with whole_file(sys.argv[1]) as stream:
                for _ in range(100):
                    stream.write(b"x" * 10_000)
        except OSError as error:
            print(error.errno, error.filename)
    """)

    path = tmp_path / "a.bin"
    run = subprocess.run(
        ["sh", "-c", 'ulimit -f 50; exec "$@"', "sh", sys.executable, "-c", script, str(path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.split() == [str(errno.EFBIG), str(path)], run
    assert names(tmp_path) == []


@pytest.mark.parametrize(("place", "call"), [(os, "fsync"), (Path, "replace")])
def test_every_failure_names_the_file(
    place: object, call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(place, call, full)
    with pytest.raises(OSError, match="No space left") as caught, whole_file(tmp_path / "a", durable=True) as stream:
        stream.write(b"x")
    assert caught.value.filename == str(tmp_path / "a")
    assert names(tmp_path) == []


def test_a_folder_is_for_one_process(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    script = (
        "import sys; from pathlib import Path; from ba_node.io.files import locked_folder\n"
        "with locked_folder(Path(sys.argv[1])): print('mine', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", script, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "mine\n"
        with pytest.raises(FolderInUseError, match="another process writes its results there"), locked_folder(folder):
            pytest.fail("it was locked twice")
        process.kill()
    with locked_folder(folder):
        assert names(folder) == [], "a lock leaves nothing behind"


def test_a_folder_that_was_made_for_nothing_goes_again(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for folder in (tmp_path / "a" / "b", tmp_path / "old"):
        with pytest.raises(FileNotFoundError), locked_folder(folder):
            (folder / "none").unlink()
        assert names(tmp_path) == ["old"]
    (tmp_path / "old" / "result").touch()
    with pytest.raises(FileNotFoundError), locked_folder(tmp_path / "old"):
        (tmp_path / "none").unlink()
    assert names(tmp_path) == ["old"]


def test_a_folder_where_a_file_is_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    for folder in (tmp_path / "a", tmp_path / "a" / "b" / "c"):
        with pytest.raises(NotADirectoryError, match="is no folder: results need one") as caught, locked_folder(folder):
            pytest.fail("there is no such folder")
        assert caught.value.filename == str(tmp_path / "a")


def test_only_regular_files_are_opened_to_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/stdin")):
        if path.exists() and not path.is_file():
            with pytest.raises(FileKindError, match="it is no regular file"):
                open_regular(path, 100)
    with pytest.raises(IsADirectoryError):
        open_regular(tmp_path, 100)
    (tmp_path / "a").write_bytes(b"12345")
    with open_regular(tmp_path / "a", 5) as stream:
        assert stream.read() == b"12345"
    with pytest.raises(FileKindError, match="5 bytes are more than the limit of 4"):
        open_regular(tmp_path / "a", 4)


def test_what_was_begun_can_be_discarded_at_once(tmp_path: Path) -> None:
    with whole_file(tmp_path / "b"):
        pass
    with pytest.raises(FileNotFoundError), whole_file(tmp_path / "a"):
        files.discard_partials()
    assert names(tmp_path) == ["b"]
