"""Formats of a database, written down: who changes them must raise the number and bring old files along."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from pathlib import Path

import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError, DatabaseVersion
from signature.database import codec, open_database, schema
from signature.database.sqlite import store
from signature.database.upkeep import check, copy, merge
from tests.test_database import assert_holds, everything, make_entry, without_loops

TABLES_OF_2 = "8636326504420fd1"
TABLES_OF_1 = """
CREATE TABLE session (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, sensor TEXT NOT NULL, document TEXT NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE grid (session_id INTEGER PRIMARY KEY REFERENCES session(id), height INTEGER NOT NULL, width INTEGER NOT NULL, resolution_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, cells BLOB NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE trajectory (session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL, stamps_ns BLOB NOT NULL, poses BLOB NOT NULL, health BLOB NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE submap (id INTEGER PRIMARY KEY, session_id INTEGER NOT NULL REFERENCES session(id), submap_id INTEGER NOT NULL, center_x_m REAL NOT NULL, center_y_m REAL NOT NULL, radius_m REAL NOT NULL, height INTEGER NOT NULL, width INTEGER NOT NULL, resolution_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, cells BLOB NOT NULL, crc32 INTEGER NOT NULL, UNIQUE (session_id, submap_id))
CREATE TABLE signature (session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL, boundary_bins INTEGER NOT NULL, freespace_bins INTEGER NOT NULL, submap_id BLOB NOT NULL, center_m BLOB NOT NULL, boundary BLOB NOT NULL, freespace BLOB NOT NULL, symmetry BLOB NOT NULL, crc32 INTEGER NOT NULL)
"""  # noqa: E501


def entries() -> list:
    """Sessions that a file of format 1 can hold."""
    return [without_loops(make_entry("monday", 0)), without_loops(make_entry("tuesday", 1, submaps=5))]


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file as the first format had it: its tables, the rows that have not changed since, its number."""
    today, path = tmp_path / "today.submaps", tmp_path / "old.submaps"
    store(today, entries(), keep=False)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA application_id = 0x70633267")
    connection.execute("PRAGMA user_version = 1")
    connection.execute("ATTACH ? AS today", (str(today),))
    for statement in TABLES_OF_1.strip().splitlines():
        connection.execute(statement)
        table = statement.split()[2]
        connection.execute(f"INSERT INTO main.{table} SELECT * FROM today.{table}")
    connection.commit()
    connection.close()
    today.unlink()
    return path


def test_the_tables_are_as_they_were() -> None:
    """If this fails, files of users exist that the change cannot read: see `schema.FORMAT`."""
    digest = hashlib.sha256(json.dumps(schema.TABLES, sort_keys=True).encode()).hexdigest()[:16]
    assert (schema.FORMAT, digest) == (2, TABLES_OF_2)
    assert list(schema.statements(1).values()) == TABLES_OF_1.strip().splitlines()


@pytest.mark.fault(44)
def test_a_file_of_format_1_is_read_where_it_stands(old: Path) -> None:
    before = old.read_bytes()
    old.chmod(0o444)
    assert check(old) == ()
    with open_database(old) as database:
        assert database.leave_out_damaged() == ()
        for entry in entries():
            assert_holds(database, entry)
    assert old.read_bytes() == before
    assert list(old.parent.iterdir()) == [old]


@pytest.mark.fault(44)
def test_writing_to_a_file_of_format_1_makes_it_one_of_2_and_keeps_the_old(old: Path) -> None:
    before = old.read_bytes()
    store(old, [make_entry("friday", 5)], keep=True)
    assert old.read_bytes()[60:64] == (2).to_bytes(4, "big")
    assert check(old) == ()
    with open_database(old) as database:
        for entry in (*entries(), make_entry("friday", 5)):
            assert_holds(database, entry)
    backup = old.with_name("old.submaps.format1")
    assert sorted(old.parent.iterdir()) == [old, backup] and backup.read_bytes() == before
    assert check(backup) == ()
    store(old, [make_entry("saturday", 6)], keep=True)
    assert backup.read_bytes() == before


def test_a_copy_of_format_1_is_what_would_be_written_today(old: Path, tmp_path: Path) -> None:
    store(tmp_path / "today.submaps", entries(), keep=False)
    copy(old, tmp_path / "copied.submaps")
    merge([old], tmp_path / "merged.submaps")
    for name in ("copied", "merged"):
        assert (tmp_path / f"{name}.submaps").read_bytes() == (tmp_path / "today.submaps").read_bytes()
    assert everything(old) == everything(tmp_path / "today.submaps")


@pytest.mark.fault(44)
def test_a_refused_session_leaves_a_file_of_format_1_as_it_is(old: Path) -> None:
    before = old.read_bytes()
    with pytest.raises(DatabaseError, match="another session named 'monday'"):
        store(old, [make_entry("monday", 9)], keep=True)
    assert old.read_bytes() == before and list(old.parent.iterdir()) == [old]


@pytest.mark.fault(43)
def test_damage_in_a_file_of_format_1_is_found(old: Path, tmp_path: Path) -> None:
    connection = sqlite3.connect(old)
    connection.execute("UPDATE trajectory SET count = count + 1 WHERE session_id = 2")
    connection.commit()
    connection.close()
    (problem,) = check(old)
    assert (problem.where, problem.what) == ("trajectory 2", "wrong checksum")
    with open_database(old) as database, pytest.raises(DatabaseCorrupt, match="wrong checksum"):
        database.trajectory("tuesday")
    assert copy(old, tmp_path / "good.submaps", recover=True) == (problem,)
    with open_database(tmp_path / "good.submaps") as database:
        assert [info.name for info in database.sessions()] == ["monday"]


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    connection = sqlite3.connect(path)
    columns = schema.COLUMNS["session"]
    values = connection.execute(f"SELECT {', '.join(columns)} FROM session").fetchone()
    row = dict(zip(columns, values, strict=True))
    document = json.loads(row["document"])
    document["config"]["partition"]["fractal"] = 3
    document["versions"]["pc2grid"] = "9.1.0"
    row["document"] = json.dumps(document)
    crc = codec.row_crc(list(row.values()))
    connection.execute("UPDATE session SET document = ?, crc32 = ?", (row["document"], crc))
    connection.commit()
    connection.close()
    before = path.read_bytes()
    words = r"'monday' was made by pc2grid 9\.1\.0 with the setting partition\.fractal"
    with open_database(path) as database, pytest.raises(DatabaseVersion, match=words):
        database.sessions()
    with pytest.raises(DatabaseVersion, match=words):
        store(path, [make_entry("tuesday", 1)], keep=True)
    assert path.read_bytes() == before
    (problem,) = check(path)
    assert "partition.fractal" in problem.what
