# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""SQLite recordings that hold nothing where something is expected."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from ba_node.io.bag_reader import BagReader
from ba_node.io.bag_topics import BagError
from tests.fuzz.targets import seeds


@pytest.mark.parametrize("column", ["name", "type", "serialization_format"])
def test_topic_without_a_name_or_type_is_no_traceback(column: str, tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    path.write_bytes(seeds()["sqlite"][0])
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA writable_schema = ON")
        database.execute("UPDATE sqlite_master SET sql = replace(sql, 'NOT NULL', '') WHERE name = 'topics'")
        database.execute("PRAGMA writable_schema = RESET")
        database.execute(f"UPDATE topics SET {column} = NULL")
    database.close()
    with pytest.raises(BagError, match=r"damaged|no topic|expected"), BagReader(path) as reader:
        list(reader.measurements())
