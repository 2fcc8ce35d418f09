# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings as rosbag2 leaves them: folders, splits, SQLite, packed by file, by message or not at all."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import Writer as RosbagsWriter

from ba_node.cli.main import main
from ba_node.config import Config
from ba_node.io import ros_types
from ba_node.io.bag_files import find_files
from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from ba_node.io.bag_writer import BagWriter
from ba_node.measurements import CameraRig
from ba_node.offline.recording import record
from ba_node.offline.replay import replay
from experiments.synthetic import SyntheticOptions, generate

Message = tuple[str, str, int, bytes]


@pytest.fixture(scope="module")
def single(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of one file."""
    path = tmp_path_factory.mktemp("single") / "all.mcap"
    data = generate(SyntheticOptions(keyframes=12, landmarks=600, tracks=60, length_m=10.0, seed=4))
    record(path, data.timeline(), data.truth)
    return path


def messages_of(path: Path | list[Path]) -> list[Message]:
    with BagReader(path) as reader:
        found = list(reader.messages())
        assert not reader.rejected
        assert reader.message_count == len(found)
    return found


def write_folder(path: Path, messages: list[Message], plugin: StoragePlugin, mode: CompressionMode) -> Path:
    writer = RosbagsWriter(path, version=9, storage_plugin=plugin)
    if mode != CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, data in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros_types.typestore())
            writer.write(connections[topic], time, data)
    return path


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_folders_of_rosbag2_hold_the_same(
    tmp_path: Path, single: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    expected = messages_of(single)
    folder = write_folder(tmp_path / "bag", expected, plugin, mode)
    found = messages_of(folder)
    assert sorted(found, key=lambda m: (m[2], m[0])) == sorted(expected, key=lambda m: (m[2], m[0]))
    assert [m[2] for m in found] == sorted(m[2] for m in found)
    assert messages_of(folder / "metadata.yaml") == found
    (file,) = [f for f in folder.iterdir() if f.suffix != ".yaml"]
    assert messages_of(file) == found, "the file by itself"
    with BagReader(folder) as reader:
        assert sum(isinstance(m, CameraRig) for _, _, m in reader.measurements()) == 1
    with RosbagsReader(folder) as theirs:
        assert theirs.message_count == len(found)
        assert isinstance(theirs.connections[0].ext, ConnectionExtRosbag2)


def test_sqlite_gives_the_same_replay(tmp_path: Path, single: Path) -> None:
    folder = write_folder(tmp_path / "bag", messages_of(single), StoragePlugin.SQLITE3, CompressionMode.NONE)
    reports = [replay(bag, tmp_path / name, Config()) for bag, name in ((single, "a"), (folder, "b"))]
    assert (tmp_path / "a" / "trajectory.tum").read_bytes() == (tmp_path / "b" / "trajectory.tum").read_bytes()
    assert [report["attention"] for report in reports] == [[], []]


def split(folder: Path, messages: list[Message], parts: int, names: str = "part_{}.mcap") -> list[Path]:
    folder.mkdir()
    paths = []
    size = -(-len(messages) // parts)
    for i in range(parts):
        paths.append(folder / names.format(i))
        with BagWriter(paths[-1]) as bag:
            for topic, kind, time, data in messages[i * size : (i + 1) * size]:
                bag.write(topic, kind, data, time)
    return paths


def write_metadata(folder: Path, names: list[str], **facts: Any) -> None:
    content = {"version": 9, "storage_identifier": "mcap", "relative_file_paths": names, **facts}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": content}))


def test_parts_are_joined_in_any_order(tmp_path: Path, single: Path) -> None:
    expected = messages_of(single)
    paths = split(tmp_path / "bag", expected, 12)
    assert messages_of(tmp_path / "bag") == expected
    assert messages_of(paths[::-1]) == expected
    write_metadata(tmp_path / "bag", [path.name for path in paths[::-1]])
    assert messages_of(tmp_path / "bag") == expected
    # Numbers are sorted as numbers.
    assert [path.name for path in find_files([tmp_path / "bag"]).paths] == [path.name for path in paths[::-1]]
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert [path.name for path in find_files([tmp_path / "bag"]).paths] == [path.name for path in paths]


def test_one_part_of_several_says_so(tmp_path: Path, single: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = split(tmp_path / "bag", messages_of(single), 2)
    write_metadata(tmp_path / "bag", [path.name for path in paths])
    report = replay(paths[0], tmp_path / "out", Config())
    assert "is one of 2 files of a recording: give its folder" in report["bag_warnings"]["split"]
    assert report["attention"] == list(report["bag_warnings"].values())
    assert main(["replay", str(paths[1]), "--out", str(tmp_path / "out")]) == 2
    assert "no topic of type ba_msgs/msg/CameraRig" in capsys.readouterr().err
    assert main(["replay", *map(str, paths[::-1]), "--out", str(tmp_path / "out"), "--no-report"]) == 0


def test_missing_parts_are_named(tmp_path: Path, single: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = split(tmp_path / "bag", messages_of(single), 3)
    write_metadata(tmp_path / "bag", [path.name for path in paths])
    paths[1].unlink()
    with BagReader(tmp_path / "bag") as reader:
        assert "1 of its 3 files are missing: part_1.mcap" in reader.warnings["missing_files"]
    assert main(["check", str(tmp_path / "bag"), "--json", str(tmp_path / "found.json")]) == 3
    words = "1 of its 3 files are missing: part_1.mcap"
    assert words in capsys.readouterr().err
    assert words in json.loads((tmp_path / "found.json").read_text())["warnings"][0]
    assert main(["check", str(tmp_path / "bag"), str(paths[0]), "--json", str(tmp_path / "found.json")]) == 3
    assert words in json.loads((tmp_path / "found.json").read_text())["recordings"][0]["note"]
    for path in (paths[0], paths[2]):
        path.unlink()
    with pytest.raises(BagError, match="none of the files that its"), BagReader(tmp_path / "bag"):
        pass


def test_numbers_that_are_left_out_are_named(tmp_path: Path, single: Path) -> None:
    paths = split(tmp_path / "bag", messages_of(single), 4)
    words = r"part_0\.mcap and its like: number 1, number 2 not among the 2 files: results have gaps"
    paths[1].unlink()
    paths[2].unlink()
    for given in ([paths[0], paths[3]], [tmp_path / "bag"]):
        assert re.fullmatch(words, find_files(given).warnings["missing_files"])
    # More than four digits may be a time of day, and one file has no gap.
    for path, name in ((paths[0], "run_120000.mcap"), (paths[3], "run_121000.mcap")):
        path.rename(tmp_path / name)
    assert not find_files(sorted(tmp_path.glob("*.mcap"))).warnings


def test_a_damaged_part_costs_itself(tmp_path: Path, single: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = split(tmp_path / "bag", messages_of(single), 3)
    paths[1].write_bytes(b"")
    with BagReader(tmp_path / "bag") as reader:
        assert reader.rejected == {"unreadable_file": 1}
        assert "part_1.mcap: the file is empty" in reader.rejection_notes[0]
        assert len(list(reader.messages())) > 0
    assert main(["check", str(tmp_path / "bag")]) == 3
    told = capsys.readouterr().err
    assert "turned away: 1 unreadable_file" in told and "part_1.mcap: the file is empty" in told


def test_a_folder_of_several_recordings_is_refused(tmp_path: Path, single: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(single, tmp_path / name)
    with pytest.raises(BagError, match=r"a\.mcap and b\.mcap are of the same time: give one"), BagReader(tmp_path):
        pass


def shifted(messages: list[Message], seconds: float) -> list[Message]:
    return [(topic, kind, time + round(1e9 * seconds), data) for topic, kind, time, data in messages]


def write(path: Path, messages: list[Message]) -> Path:
    with BagWriter(path) as bag:
        for topic, kind, time, data in messages:
            bag.write(topic, kind, data, time)
    return path


def test_several_recordings_are_not_mixed(tmp_path: Path, single: Path) -> None:
    first = messages_of(single)
    data = generate(SyntheticOptions(keyframes=4, landmarks=600, tracks=60, length_m=10.0, baseline_m=0.3, seed=5))
    record(tmp_path / "other.mcap", data.timeline())
    other = messages_of(tmp_path / "other.mcap")
    drive_0 = write(tmp_path / "drive_0.mcap", first)
    for name, messages, words in (
        ("drive_1.mcap", first, r"drive_0\.mcap and drive_1\.mcap are of the same time: give one of them"),
        ("drive_1.mcap", shifted(other, 100.0), r"drive_0\.mcap and drive_1\.mcap have different cameras: give one"),
        (
            "tour.mcap",
            shifted(first, 100.0),
            r"two recordings by their names, .* NAME_0, NAME_1, \.\.\. or lie",
        ),
    ):
        path = write(tmp_path / name, messages)
        with pytest.raises(BagError, match=words), BagReader([drive_0, path]):
            pass
        path.unlink()
    (tmp_path / "folder").mkdir()
    with pytest.raises(BagError, match="a folder is a recording by itself: give it alone"):
        find_files([drive_0, tmp_path / "folder"])
    # Two recorders at a time, each with topics of its own, have made one recording; and a file may be given twice.
    split_by_topic = [[m for m in first if ("camera" in m[0]) is cameras] for cameras in (True, False)]
    paths = [write(tmp_path / f"part_{i}.mcap", messages) for i, messages in enumerate(split_by_topic)]
    assert sorted(messages_of(paths)) == sorted(first)
    assert messages_of([drive_0, drive_0]) == first


def test_files_of_one_metadata_may_have_any_name(tmp_path: Path, single: Path) -> None:
    folder = tmp_path / "bag"
    paths = [path.rename(folder / name) for path, name in zip(split(folder, messages_of(single), 2), "ab", strict=True)]
    write_metadata(folder, ["a", "b"])
    assert messages_of(paths) == messages_of(single)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"storage_identifier": "leveldb"}, "storage 'leveldb' is not read: convert it"),
        ({"compression_format": "lz4", "compression_mode": "FILE"}, "compression_format 'lz4' is not read"),
    ],
)
def test_what_is_not_read_is_named(
    tmp_path: Path, single: Path, capsys: pytest.CaptureFixture[str], facts: dict[str, str], words: str
) -> None:
    shutil.copy(single, tmp_path / "all.mcap")
    write_metadata(tmp_path, ["all.mcap"], **facts)
    assert main(["replay", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("text", ["a: &a [*a]", "nothing", "rosbag2_bagfile_information: 3", "[" * 3000])
def test_broken_metadata_is_told_and_passed_over(tmp_path: Path, single: Path, text: str) -> None:
    shutil.copy(single, tmp_path / "all.mcap")
    (tmp_path / "metadata.yaml").write_text(text)
    with BagReader(tmp_path) as reader:
        assert "all recordings in its folder are taken" in reader.warnings["metadata"]
        assert len(list(reader.messages())) == len(messages_of(single))


def test_packed_files_are_read_once(tmp_path: Path, single: Path) -> None:
    data = single.read_bytes()
    (tmp_path / "all.mcap.zstd").write_bytes(zstandard.compress(data))
    assert messages_of(tmp_path) == messages_of(single)
    (tmp_path / "all.mcap").write_bytes(data)
    assert messages_of(tmp_path) == messages_of(single)
    (tmp_path / "all.mcap").unlink()
    for broken, words in ((zstandard.compress(data)[:-100], "nothing comes out of its"), (data, "cannot be unpacked")):
        (tmp_path / "all.mcap.zstd").write_bytes(broken)
        with pytest.raises(BagError, match=rf"{tmp_path}/all\.mcap\.zstd: {words}"), BagReader(tmp_path):
            pass


def test_a_packed_message_that_is_damaged_costs_itself(tmp_path: Path, single: Path) -> None:
    messages = messages_of(single)
    with BagWriter(tmp_path / "m.mcap") as bag:
        for i, (topic, kind, time, data) in enumerate(messages):
            packed = zstandard.compress(data)
            bag.write(topic, kind, packed[:-4] if i == 20 else packed, time)
    with BagReader(tmp_path / "m.mcap") as reader:
        found = list(reader.messages())
        assert reader.rejected == {"undecodable": 1}
    assert found == messages[:20] + messages[21:]


def test_a_rig_that_comes_last_is_there_for_all(tmp_path: Path, single: Path) -> None:
    messages = messages_of(single)
    last = [(t, k, messages[-1][2], d) if "camera" in t else (t, k, time, d) for t, k, time, d in messages]
    last.sort(key=lambda m: "camera" in m[0])
    split(tmp_path / "bag", last, 3)
    for bag, name in ((single, "a"), (tmp_path / "bag", "b")):
        report = replay(bag, tmp_path / name, Config())
        assert report["attention"] == []
    assert (tmp_path / "a" / "trajectory.tum").read_bytes() == (tmp_path / "b" / "trajectory.tum").read_bytes()
    with BagReader(tmp_path / "bag") as reader:
        found = [m for _, _, m in reader.measurements()]
        assert isinstance(found[0], CameraRig)
        assert sum(isinstance(m, CameraRig) for m in found) == 1
        rigs = [(topic, data) for topic, _, _, data in messages if "camera" in topic]
        assert reader.late_cameras() == rigs[:1]
    with BagReader(single) as reader:
        assert reader.late_cameras() == []


def test_cameras_of_a_loaded_map_are_used(tmp_path: Path, single: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = messages_of(single)
    keyframe_times = sorted({time for topic, _, time, _ in messages if topic == "/keyframes"})
    middle = keyframe_times[6]
    early = [m for m in messages if m[2] < middle]
    late = [m for m in messages if m[2] >= middle and "camera" not in m[0]]
    for name, some in (("first", early), ("rest", late)):
        with BagWriter(tmp_path / f"{name}.mcap") as bag:
            for topic, kind, time, data in some:
                bag.write(topic, kind, data, time)
    first, rest, saved = (str(tmp_path / name) for name in ("first.mcap", "rest.mcap", "map.npz"))
    assert main(["replay", first, "--out", str(tmp_path / "a"), "--no-report", "--save-map", saved]) == 0
    assert main(["replay", rest, "--out", str(tmp_path / "b")]) == 2
    assert "CameraRig or sensor_msgs/msg/CameraInfo" in capsys.readouterr().err
    assert main(["replay", rest, "--out", str(tmp_path / "b"), "--no-report", "--load-map", saved]) == 0
    assert " of 12 refined" in capsys.readouterr().out
