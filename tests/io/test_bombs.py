# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Small files that are made to take all memory or all time: each ends in one line of error, soon and small.

Every command runs in a process of its own, which tells how much memory it took at most.
"""

from __future__ import annotations

import bz2
import gzip
import io
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from ba_node.config import Config, ConfigError
from ba_node.io import ros_types
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.bag_writer import BagWriter
from ba_node.io.bal import BalError, read_bal
from ba_node.io.map_file import MapFileError, read_map, write_map
from ba_node.io.mcap_index import MAGIC
from ba_node.io.parameters import configure, read_parameters
from ba_node.io.reference import TRUTH_TOPIC
from ba_node.io.trajectory import TrajectoryError, read_tum
from ba_node.offline.recording import TRUTH_TYPE, record
from ba_node.offline.replay import replay
from ba_node.scene.map_content import MapContent
from experiments.synthetic import SyntheticOptions, generate

MAX_MB = 1000
RUN = """
import re, sys
from pathlib import Path
from ba_node.cli.main import main
code = main(sys.argv[1:])
# Of this program alone: getrusage has that of the one that started it where that was larger.
print("peak", int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) // 1024, file=sys.stderr)
sys.exit(code)
"""


def zeros(mb: int) -> bytes:
    return bytes(mb << 20)


def chunk(compression: str, data: bytes, size: int) -> bytes:
    builder = RecordBuilder()
    Chunk(compression, data, 1, 0, 0, size).write(builder)
    return MAGIC + bytes(builder.end())  # type: ignore[no-untyped-call]


def zstd_of(mb: int) -> bytes:
    """Return a zstd frame of zeros that does not say how many."""
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return b"".join([*(packer.compress(zeros(64)) for _ in range(mb // 64)), packer.flush()])


def npz_of(path: Path, mb: int, name: str) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open(name, "w", force_zip64=True) as member:
        for _ in range(mb):
            member.write(zeros(1))


def yaml_aliases() -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    return "\n".join(lines) + "\n"


Make = Callable[[Path], None]
REPLAY = ("replay", "{}", "--out", "{}.out")
BOMBS: dict[str, tuple[tuple[str, ...], str, Make, str]] = {
    "chunk that says 4 GB": (
        REPLAY,
        ".mcap",
        lambda p: _write(p, chunk("zstd", zstd_of(64), 2**32)),
        "claims to be 4096 MB",
    ),
    "chunk of 1 GB that says 100 MB": (
        REPLAY,
        ".mcap",
        lambda p: _write(p, chunk("zstd", zstd_of(1024), 100 << 20)),
        "more than 100 MB come out",
    ),
    "chunk of lz4": (
        REPLAY,
        ".mcap",
        lambda p: _write(p, chunk("lz4", lz4.frame.compress(zeros(512)), 1 << 20)),
        "come out of it",
    ),
    "chunk that says its frame is 1 TB": (
        REPLAY,
        ".mcap",
        lambda p: _write(p, chunk("zstd", zstd_frame_that_claims(2**40), 1 << 20)),
        "no message",
    ),
    "chunk of a million records of nothing": (
        REPLAY,
        ".mcap",
        lambda p: _write(p, chunk("zstd", zstandard.compress(bytes(9 << 21)), 9 << 21)),
        "is damaged",
    ),
    "packed recording": (REPLAY, ".mcap.zstd", lambda p: _write(p, zstd_of(1024)), "cannot be unpacked: more than"),
    "bz2": (("solve", "{}"), ".bz2", lambda p: _write(p, bz2.compress(zeros(64))), "more than 16 MB come out of it"),
    "bz2 of lines": (("convert", "{}", "{}.mcap"), ".bz2", lambda p: _write(p, bz2.compress(b"0\n" * 2**24)), "16 MB"),
    "gz": (("solve", "{}"), ".gz", lambda p: _write(p, gzip.compress(zeros(256))), "come out of it"),
    "map": (("map", "info", "{}"), ".npz", lambda p: npz_of(p, 512, "a.npy"), "its members claim 512 MB"),
    "head of a map": (("map", "info", "{}"), ".npz", lambda p: npz_of(p, 512, "map.json"), "its members claim 512 MB"),
    "aliases": (("params", "{}"), ".yaml", lambda p: _write(p, yaml_aliases().encode()), "alias *a0: aliases are not"),
}


def zstd_frame_that_claims(size: int) -> bytes:
    return struct.pack("<IBQ", 0xFD2FB528, 0b11100000, size) + zstandard.compress(b"x")[6:]


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_ends_in_a_line_soon_and_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    command, suffix, make, words = BOMBS[name]
    path = tmp_path / f"bomb{suffix}"
    make(path)
    if command[0] == "params":
        with pytest.raises(ConfigError, match=r"alias \*a0: aliases are not read"):
            read_parameters(path)
        command = ("replay", "none.mcap", "--out", "{}.out", "--params", "{}")
    arguments = [word.format(path) for word in command]
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    line = [sys.executable, "-c", RUN, *arguments]
    run = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 2, run.stderr
    error, peak = run.stderr.strip().splitlines()
    assert error.startswith(f"ba: error: {path}: "), error
    assert words in error
    assert int(peak.split()[1]) < MAX_MB


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [*a]\n", r"alias \*a: aliases are not read, as in ROS"),
        ("a:\n  b: 1\n  c: 2\n  b: 3\n", r"line 4: 'b' is in line 2 already: put them together"),
        ("{a: 1, a: 2}\n", r"line 1: 'a' is in line 1 already"),
        ("/**:\n  ros__parameters: hello\n", r"/\*\*: ros__parameters = 'hello': expected a mapping"),
        ("/**:\n  ros__parameters: [1, 2]\n", "expected a mapping"),
        ("[" * 5000, "nested too deep"),
        ("{a: " * 2000, "nested too deep|not YAML"),
        ("solver.max_iterations: 1" + ":1" * 5000, "a value of 10001 characters"),
        ("x: 2026-99-99\n", "not YAML"),
        ("x: " + "9" * 900 + "\n", "x"),
        ("\x00\x01", "not YAML"),
        ("x: !!python/object/apply:os.system [ls]\n", "not YAML"),
    ],
)
def test_strange_parameters_are_an_error(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words) as caught:
        configure(path, {})
    assert str(path) in str(caught.value)


def test_a_device_is_no_file(tmp_path: Path) -> None:
    for read, error in ((read_parameters, ConfigError), (read_tum, TrajectoryError), (read_bal, BalError)):
        with pytest.raises(error, match="/dev/zero: cannot be read: it is no regular file"):
            read("/dev/zero")
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(BagError, match="it is no regular file"), BagReader(tmp_path / "pipe.mcap"):
        pass


@pytest.mark.parametrize("stamp", ["1e400000000", "-1e999999", "1e-400000000", "9" * 100_000, "inf", "nan", "1e19"])
def test_stamps_that_are_no_times(tmp_path: Path, stamp: str) -> None:
    path = tmp_path / "t.tum"
    path.write_text(f"{stamp} 0 0 0 0 0 0 1\n")
    if stamp == "1e-400000000":
        assert read_tum(path).stamp_ns.tolist() == [0]
        return
    with pytest.raises(TrajectoryError, match=r"t\.tum:1: stamp '.*expected finite seconds"):
        read_tum(path)


def test_words_and_lines_of_a_text_are_found_without_a_list_of_all(tmp_path: Path) -> None:
    path = tmp_path / "p.txt"
    path.write_text("1 1 1\n\n0 0 1.5 x\n")
    with pytest.raises(BalError, match="line 3: 'x' is not a number"):
        read_bal(path)
    path.write_text("1 1 1\n0 0 1.5 2\n" + "0\n" * 5)
    with pytest.raises(BalError, match="truncated"):
        read_bal(path)
    path.write_text("1 1 1\n0 7 1.5 2\n" + "0\n" * 12)
    with pytest.raises(BalError, match="line 2: point index 7"):
        read_bal(path)


DEFINITIONS = {
    "40 000 fields": "\n".join(f"float64 x{i}" for i in range(40_000)),
    "3000 fields": "\n".join(f"float64 x{i}" for i in range(3000)),
    "an array of many messages": f"a/E[300000] x\n{'=' * 80}\nMSG: a/E\nint8 A=1\n",
    "an array of many texts": "string[4000000] x",
    "nests for ever": f"a/E x\n{'=' * 80}\nMSG: a/E\na/E y\n",
    "doubles 24 times": "a/T0 x\n"
    + "".join(f"{'=' * 80}\nMSG: a/T{i}\na/T{i + 1} x\na/T{i + 1} y\n" for i in range(24))
    + f"{'=' * 80}\nMSG: a/T24\nint8 x\n",
    "1 MB of comment": f"# {'x' * 2**20}\nint8 x",
}


@pytest.mark.parametrize("name", DEFINITIONS)
def test_definitions_that_make_endless_code_are_refused(name: str) -> None:
    with pytest.raises(ros_types.TypeMismatchError, match="the definition of 'a/msg/B'"):
        ros_types.decoder("a/msg/B", DEFINITIONS[name])


def test_a_definition_may_be_long() -> None:
    text = "\n".join(f"float64 x{i}" for i in range(300))
    assert ros_types.decoder("a/msg/Long", text)(b"\x00\x01\x00\x00" + bytes(2400)).x299 == 0.0


def test_a_truth_without_orientation_costs_the_comparison_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = generate(SyntheticOptions(keyframes=5, landmarks=400, tracks=50, length_m=10.0))
    text = ros_types.schema_text(TRUTH_TYPE)
    cut = text.replace("geometry_msgs/Quaternion orientation\n", "")
    assert cut != text
    genuine = ros_types.schema_text
    with monkeypatch.context() as patch:
        patch.setattr(ros_types, "schema_text", lambda name: cut if name == TRUTH_TYPE else genuine(name))
        record(tmp_path / "in.mcap", data.timeline(), data.truth)
    report = replay(tmp_path / "in.mcap", tmp_path / "out", Config())
    assert report["keyframes"] == 5
    line = report["bag_warnings"]["ground_truth"]
    assert line in report["attention"]
    assert line.startswith("no comparison with the truth in the recording: ")
    assert f"/{TRUTH_TOPIC}: geometry_msgs/msg/Pose has no field orientation" in line


def test_sequences_that_claim_more_than_there_is_cost_themselves(tmp_path: Path) -> None:
    data = generate(SyntheticOptions(keyframes=4, landmarks=400, tracks=50, length_m=10.0))
    record(tmp_path / "in.mcap", data.timeline())
    with BagReader(tmp_path / "in.mcap") as reader:
        messages = list(reader.messages())
    with BagWriter(tmp_path / "bad.mcap") as bag:
        for i, (topic, kind, time, raw) in enumerate(messages):
            at = raw.find(struct.pack("<I", 50))
            huge = raw[:at] + struct.pack("<I", 2**32 - 1) + raw[at + 4 :]
            bag.write(topic, kind, huge if topic == "/feature_tracks" and i % 2 else raw, time)
    with BagReader(tmp_path / "bad.mcap") as reader:
        list(reader.measurements())
        assert set(reader.rejected) == {"undecodable"}


def test_maps_of_numpy_with_objects_or_absurd_shapes(tmp_path: Path) -> None:
    path = tmp_path / "m.npz"
    for header in (
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776, 1099511627776), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -2), }",
        "{'descr': [('a', '<f8', (100000, 100000))], 'fortran_order': False, 'shape': (1,), }",
    ):
        npy = io.BytesIO()
        text = f"{header}\n".encode()
        npy.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(16))
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("map.json", '{"format": "ba_node map", "version": 1}')
            file.writestr("a.npy", npy.getvalue())
        with pytest.raises(MapFileError, match=r"m\.npz: damaged"):
            read_map(path)
    write_map(path, MapContent({"a": np.zeros(3)}, {}))
    assert read_map(path).arrays["a"].shape == (3,)
