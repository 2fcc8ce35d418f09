# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""The file of a map: bit for bit, whole or not there, and nothing else is taken for one."""

from __future__ import annotations

import contextlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io.map_file import VERSION, MapFileError, load_map, read_map, write_map
from ba_node.scene.map_content import MapContent
from experiments.synthetic import SyntheticOptions, generate

DTYPES = st.sampled_from(["u8", "i8", "i4", "u1", "f4", "f8", "?"]).map(np.dtype)
ARRAYS = hnp.arrays(DTYPES, hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
FACTS = st.dictionaries(st.text("xyz", min_size=1, max_size=4), JSON, max_size=4)


@pytest.fixture(scope="module")
def content() -> MapContent:
    options = SyntheticOptions(keyframes=4, landmarks=100, tracks=12, length_m=10.0, path="line", ids="random64")
    backend = Backend(Config())
    for _, _, measurement in generate(options).timeline():
        backend.add(measurement)
    backend.solve()
    return backend.snapshot()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("maps")


@pytest.fixture(scope="module")
def data(content: MapContent, folder: Path) -> bytes:
    write_map(folder / "good.npz", content)
    return (folder / "good.npz").read_bytes()


def loaded(path: Path) -> MapContent:
    backend = Backend(Config())
    backend.take_over(load_map(path, Config().scene))
    return backend.snapshot()


def same(a: MapContent, b: MapContent) -> bool:
    def bits(content: MapContent) -> dict[str, Any]:
        return {name: (array.dtype, array.shape, array.tobytes()) for name, array in content.arrays.items()}

    return bits(a) == bits(b) and repr(a.facts) == repr(b.facts)


def rewritten(data: bytes, path: Path, **members: bytes | None) -> Path:
    """Write the file again with some members replaced (by their names with _ for what is no letter) or left out."""
    path.with_suffix(".old").write_bytes(data)
    with zipfile.ZipFile(path.with_suffix(".old")) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            key = name.replace("/", "_").replace(".", "_")
            replaced = members.get(key, old.read(name))
            if replaced is not None:
                new.writestr(name, replaced)
    return path


@given(st.dictionaries(st.sampled_from(["a", "b/c", "b/d", "e/0/f"]), ARRAYS), FACTS)
def test_every_bit_comes_back(folder: Path, arrays: dict[str, Any], facts: dict[str, Any]) -> None:
    written = MapContent(arrays, facts)
    write_map(folder / "any.npz", written)
    assert same(read_map(folder / "any.npz"), written)


def test_a_loaded_map_is_written_with_the_same_bytes(folder: Path, data: bytes) -> None:
    write_map(folder / "again.npz", loaded(folder / "good.npz"))
    assert (folder / "again.npz").read_bytes() == data


def test_numpy_alone_reads_it(folder: Path, data: bytes, content: MapContent) -> None:
    (folder / "plain.npz").write_bytes(data)
    with np.load(folder / "plain.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["keyframes/position"], content.arrays["keyframes/position"])
        head = json.loads(arrays["map.json"])
    assert (head["format"], head["version"], head["session_id"]) == ("ba_node map", VERSION, 0)


def test_what_numpy_writes_compressed_is_read(folder: Path, data: bytes, content: MapContent) -> None:
    path = folder / "packed.npz"
    np.savez_compressed(path, **content.arrays)  # type: ignore[arg-type]
    with zipfile.ZipFile(path, "a") as archive, zipfile.ZipFile(folder / "good.npz") as good:
        archive.writestr("map.json", good.read("map.json"))
    assert len(data) > 0
    assert same(loaded(path), content)


def test_version_1_is_read(folder: Path, content: MapContent) -> None:
    path = folder / "first.npz"
    before = {name.replace("observations/", "sightings/"): array for name, array in content.arrays.items()}
    np.savez(path, **before)  # type: ignore[arg-type]
    head = {"format": "ba_node map", "version": 1, "written_by": "ba_node 0.2.0", **content.facts}
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("map.json", json.dumps(head))
    assert "sightings/uv" in before
    assert same(loaded(path), content)


@settings(max_examples=300)
@given(st.data())
def test_damage_is_noticed_or_harmless(folder: Path, data: bytes, content: MapContent, draw: st.DataObject) -> None:
    position = draw.draw(st.integers(0, len(data) - 1))
    bit = draw.draw(st.integers(0, 7))
    damaged = bytearray(data)
    damaged[position] ^= 1 << bit
    path = folder / "damaged.npz"
    path.write_bytes(damaged)
    with contextlib.suppress(MapFileError):
        found = loaded(path)
        assert same(found, content), f"bit {bit} of byte {position} changed the map"


@given(st.data())
def test_a_file_that_is_cut_off_is_refused(folder: Path, data: bytes, draw: st.DataObject) -> None:
    path = folder / "cut.npz"
    path.write_bytes(data[: draw.draw(st.integers(0, len(data) - 1))])
    with pytest.raises(MapFileError, match=r"cut off or damaged|not a map"):
        read_map(path)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"map_json": None}, "not a map: it has no map.json"),
        ({"map_json": b"{}"}, "not a map: map.json does not say format"),
        ({"map_json": b"["}, "damaged: Expecting value"),
        ({"map_json": b'{"format": "ba_node map", "version": "1"}'}, "version = '1', expected a number"),
        (
            {"map_json": b'{"format": "ba_node map", "version": 3, "written_by": "ba_node 9"}'},
            r"format version 3, written by ba_node 9; this ba_node reads up to 2: update",
        ),
        ({"map_json": b'{"format": "ba_node map", "version": 1}'}, "damaged: session_id = None, expected int or None"),
        ({"keyframes_position_npy": None}, "damaged: keyframes/position is missing"),
        ({"keyframes_position_npy": b"no array"}, "damaged: the magic string is not correct"),
    ],
)
def test_each_refusal_says_why(folder: Path, data: bytes, members: dict[str, bytes | None], message: str) -> None:
    with pytest.raises(MapFileError, match=message):
        load_map(rewritten(data, folder / "bad.npz", **members), Config().scene)


def array_bytes(array: np.ndarray, folder: Path) -> bytes:
    np.save(folder / "one.npy", array, allow_pickle=True)
    return (folder / "one.npy").read_bytes()


def test_an_array_that_claims_more_than_it_has_costs_no_memory(folder: Path, data: bytes) -> None:
    honest = array_bytes(np.zeros((4, 3)), folder)
    lie = honest.replace(b"(4, 3), }", b"(4, 9**9)", 1)
    big = honest.replace(b"(4, 3), }          ", b"(40000000000, 3), }", 1)
    assert len({honest, lie, big}) == 3
    for claimed in (lie, big):
        with pytest.raises(MapFileError, match="damaged"):
            read_map(rewritten(data, folder / "lie.npz", keyframes_position_npy=claimed))


def test_pickles_are_not_opened(folder: Path, data: bytes) -> None:
    trap = array_bytes(np.array([{"a": 1}], dtype=object), folder)
    with pytest.raises(MapFileError, match="damaged: an array"):
        read_map(rewritten(data, folder / "trap.npz", keyframes_position_npy=trap))


def test_other_files_are_no_maps(folder: Path) -> None:
    (folder / "text").write_text("hello")
    np.savez(folder / "other.npz", a=np.zeros(3))
    for name, message in (
        ("text", "not a map: expected an .npz file"),
        ("other.npz", "not a map: it has no map.json"),
        ("none", "cannot be opened: No such file"),
        (".", "cannot be opened: Is a directory"),
    ):
        with pytest.raises(MapFileError, match=message):
            read_map(folder / name)


def test_a_write_that_fails_leaves_the_older_file(folder: Path, data: bytes, content: MapContent) -> None:
    path = folder / "kept.npz"
    path.write_bytes(data)
    broken = MapContent({**content.arrays, "last": np.array([object()])}, content.facts)
    with pytest.raises(ValueError, match="Object arrays cannot be saved"):
        write_map(path, broken)
    assert path.read_bytes() == data
    assert not list(folder.glob(".kept*"))


def test_it_is_on_the_disk_before_it_has_its_name(
    folder: Path, content: MapContent, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folder / "synced.npz"
    seen: list[tuple[bool, bool]] = []
    monkeypatch.setattr("os.fsync", lambda _: seen.append((path.exists(), any(folder.glob(".synced.npz.*.partial")))))
    write_map(path, content)
    assert seen == [(False, True), (True, False)]


def test_a_folder_that_is_not_there_is_named(folder: Path, content: MapContent) -> None:
    with pytest.raises(FileNotFoundError):
        write_map(folder / "none" / "a.npz", content)
