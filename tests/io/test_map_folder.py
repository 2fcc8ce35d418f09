# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Names of maps that clients give: below the folder, and nothing but maps."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ba_node.backend import Backend
from ba_node.config import Config
from ba_node.io.map_file import is_map, map_name, write_map
from ba_node.io.map_folder import MapPathError, path_in_folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "maps"
    made.mkdir()
    return made


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("site", "site.npz"),
        ("site.npz", "site.npz"),
        ("v1.2", "v1.2.npz"),
        ("a.NPZ", "a.NPZ.npz"),
        (".npz", ".npz.npz"),
    ],
)
def test_the_suffix_is_added(name: str, expected: str, folder: Path) -> None:
    assert map_name(name) == Path(expected)
    assert path_in_folder(name, str(folder), to_write=True) == folder / expected
    assert path_in_folder(str(folder / name), str(folder), to_write=False) == folder / expected


@pytest.mark.parametrize("to_write", [True, False])
@pytest.mark.parametrize(
    "name",
    ["../site", "a/../../site", "/etc/site", "/dev/null", "~/site", "~nobody/../site", "out/site", "loop/site", "."],
)
def test_there_is_no_way_out(name: str, to_write: bool, folder: Path) -> None:
    (folder / "out").symlink_to(folder.parent)
    (folder / "loop").symlink_to(folder / "loop")
    with pytest.raises(MapPathError):
        path_in_folder(name, str(folder), to_write=to_write)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["maps"]


@pytest.mark.parametrize("name", ["", "a\0b", "site/", "x" * 300])
def test_what_is_no_name(name: str, folder: Path) -> None:
    with pytest.raises(MapPathError, match=r"expected the name of a file|File name too long"):
        path_in_folder(name, str(folder), to_write=True)


def test_links_pipes_and_devices_are_refused(folder: Path) -> None:
    (folder / "real.npz").write_text("")
    (folder / "link.npz").symlink_to("real.npz")
    (folder / "nowhere.npz").symlink_to("gone.npz")
    os.mkfifo(folder / "pipe.npz")
    (folder / "folder.npz").mkdir()
    for name, words in (
        ("link", "is a link"),
        ("nowhere", "is a link"),
        ("pipe", "no regular"),
        ("folder", "no regular"),
    ):
        for to_write in (True, False):
            with pytest.raises(MapPathError, match=words):
                path_in_folder(name, str(folder), to_write=to_write)


def test_only_maps_are_overwritten(folder: Path) -> None:
    (folder / "text.npz").write_text("my thesis")
    with pytest.raises(MapPathError, match="is there and no map of ba_node"):
        path_in_folder("text", str(folder), to_write=True)
    assert path_in_folder("text", str(folder), to_write=False).name == "text.npz", "reading says what is wrong with it"
    write_map(folder / "map.npz", Backend(Config()).snapshot())
    assert is_map(folder / "map.npz") and not is_map(folder / "text.npz") and not is_map("/dev/zero")
    assert path_in_folder("map", str(folder), to_write=True) == folder / "map.npz"


def test_the_folder_is_made_refused_or_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert path_in_folder("site", "~/a/b", to_write=False) == tmp_path / "a" / "b" / "site.npz"
    assert not (tmp_path / "a").exists()
    path_in_folder("site", "~/a/b", to_write=True)
    assert (tmp_path / "a" / "b").is_dir()
    assert path_in_folder(f"{tmp_path}/x", "/", to_write=True) == tmp_path / "x.npz"
    with pytest.raises(MapPathError, match=r"node\.map_folder is empty"):
        path_in_folder("site", "", to_write=True)
