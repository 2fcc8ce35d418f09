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


def altered(tmp_path: Path, *statements: str) -> Path:
    path = tmp_path / "a.db3"
    path.write_bytes(seeds()["sqlite"][0])
    with sqlite3.connect(path) as database:
        for statement in statements:
            database.execute(statement)
    database.close()
    return path


@pytest.mark.parametrize(
    "statements",
    [
        (  # a few bytes a row, of which reading makes 950 MB
            "CREATE TABLE more(id INTEGER PRIMARY KEY, topic_id INT, timestamp INT, data AS (zeroblob(950000000)))",
            "INSERT INTO more(id, topic_id, timestamp) SELECT id, topic_id, timestamp FROM messages",
            "DROP TABLE messages",
            "ALTER TABLE more RENAME TO messages",
        ),
        (
            "ALTER TABLE messages RENAME TO rows",
            "CREATE VIEW messages AS SELECT id, topic_id, timestamp, zeroblob(950000000) AS data FROM rows",
        ),
        (
            "ALTER TABLE topics RENAME TO rows",
            "CREATE VIEW topics AS SELECT * FROM rows",
        ),
    ],
)
def test_what_is_made_up_as_it_is_read_is_refused(statements: tuple[str, ...], tmp_path: Path) -> None:
    with (
        pytest.raises(BagError, match=r"a view, or has columns that are reckoned: expected a table of values"),
        BagReader(altered(tmp_path, *statements)),
    ):
        pass


def test_a_message_of_no_recording_is_passed_over_by_its_size(tmp_path: Path) -> None:
    path = altered(tmp_path, "UPDATE messages SET data = zeroblob(140000000) WHERE id = 2")
    with BagReader(path) as reader:
        read = sum(1 for _ in reader.messages())
        assert read == reader.message_count - 1
        assert reader.rejected == {"corrupt": 1}
        assert "message 2 has 133 MB: expected 128 MB at most" in reader.rejection_notes[0]


def test_messages_of_a_topic_that_is_not_there_are_counted(tmp_path: Path) -> None:
    with BagReader(altered(tmp_path, "UPDATE messages SET topic_id = 99 WHERE id > 3")) as reader:
        assert reader.rejected == {"corrupt": 1}
        assert (
            f"{reader.message_count - 3} of {reader.message_count} messages name a topic" in reader.rejection_notes[0]
        )
        assert sum(1 for _ in reader.messages()) == 3
