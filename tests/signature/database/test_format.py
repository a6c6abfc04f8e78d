"""The formats of a database, written down: a change needs a new number, and old files are still read."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import DatabaseCorrupt, DatabaseError, DatabaseVersion
from signature.database import migrations, open_database, serialize
from signature.database.maintenance import check, copy, merge
from signature.database.protocol import Entry
from signature.database.sqlite import schema
from signature.database.sqlite.database import store
from signature.seen_places import PROFILE_BEARINGS, SIGNATURE_COLUMNS, SeenPlaces
from tests.helpers.databases import (
    assert_holds,
    everything,
    make_entry,
    with_graph_of_grid,
    without_loops,
    without_points,
)

TABLES_OF_5 = "4febdfc79861d299"
TABLES_OF_4 = "426a35821938db4a"
TABLES_OF_3 = "3cd6744c04d08d3b"
TABLES_OF_2 = "8636326504420fd1"
TABLES_OF_1 = """
CREATE TABLE session (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, sensor TEXT NOT NULL, document TEXT NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE grid (session_id INTEGER PRIMARY KEY REFERENCES session(id), height INTEGER NOT NULL, width INTEGER NOT NULL, resolution_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, cells BLOB NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE trajectory (session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL, stamps_ns BLOB NOT NULL, poses BLOB NOT NULL, health BLOB NOT NULL, crc32 INTEGER NOT NULL)
CREATE TABLE submap (id INTEGER PRIMARY KEY, session_id INTEGER NOT NULL REFERENCES session(id), submap_id INTEGER NOT NULL, center_x_m REAL NOT NULL, center_y_m REAL NOT NULL, radius_m REAL NOT NULL, height INTEGER NOT NULL, width INTEGER NOT NULL, resolution_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, cells BLOB NOT NULL, crc32 INTEGER NOT NULL, UNIQUE (session_id, submap_id))
CREATE TABLE signature (session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL, boundary_bins INTEGER NOT NULL, freespace_bins INTEGER NOT NULL, submap_id BLOB NOT NULL, center_m BLOB NOT NULL, boundary BLOB NOT NULL, freespace BLOB NOT NULL, symmetry BLOB NOT NULL, crc32 INTEGER NOT NULL)
"""  # noqa: E501
TABLE_OF_2 = (
    "CREATE TABLE loop (session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " pairs BLOB NOT NULL, measured BLOB NOT NULL, information BLOB NOT NULL, accepted BLOB NOT NULL,"
    " crc32 INTEGER NOT NULL)"
)
LATEST = 5


def entries(version: int) -> list[Entry]:
    """Sessions that a file of a format can hold, with the graphs that follow from their grids."""
    made = [make_entry("monday", 0), make_entry("tuesday", 1, submaps=5)]
    if version < 2:
        made = [without_loops(entry) for entry in made]
    return [without_points(with_graph_of_grid(entry)) for entry in made]


@pytest.fixture(params=[1, 2, 3, 4])
def version(request: pytest.FixtureRequest) -> int:
    """An older format."""
    return int(request.param)


@pytest.fixture
def old(version: int, tmp_path: Path) -> Path:
    """A file of an older format: its tables, the rows that have not changed since, its number."""
    today, path = tmp_path / "today.submaps", tmp_path / "old.submaps"
    store(today, entries(version), keep=False)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA application_id = 0x70633267")
    connection.execute(f"PRAGMA user_version = {version}")
    connection.execute("ATTACH ? AS today", (str(today),))
    statements = TABLES_OF_1.strip().splitlines() + [TABLE_OF_2] * (version >= 2)
    statements += [schema.statements(3)["graph"]] * (version >= 3)
    statements += [schema.statements(4)["points"]] * (version >= 4)
    for statement in statements:
        connection.execute(statement)
        table = statement.split()[2]
        connection.execute(f"INSERT INTO main.{table} SELECT * FROM today.{table}")
    connection.commit()
    connection.close()
    today.unlink()
    return path


def test_the_tables_are_unchanged() -> None:
    """If this fails, files of users exist that the change cannot read: see `migrations.FORMAT`."""

    def digest(version: int) -> str:
        tables = migrations.tables_of(version, schema.TABLES)
        return hashlib.sha256(json.dumps(tables, sort_keys=True).encode()).hexdigest()[:16]

    assert (migrations.FORMAT, digest(5)) == (LATEST, TABLES_OF_5)
    assert (digest(4), digest(3), digest(2)) == (TABLES_OF_4, TABLES_OF_3, TABLES_OF_2)
    assert list(schema.statements(1).values()) == TABLES_OF_1.strip().splitlines()
    assert schema.statements(2)["loop"] == TABLE_OF_2


def test_a_stored_graph_is_as_it_was(tmp_path: Path) -> None:
    """The bytes of a row of format 3, written down: files of today must be readable tomorrow."""
    store(tmp_path / "x.submaps", [make_entry("monday", 0)], keep=False)
    with contextlib.closing(sqlite3.connect(tmp_path / "x.submaps")) as connection:
        columns = ", ".join(schema.COLUMNS["graph"][1:-1])
        row = connection.execute(f"SELECT {columns} FROM graph").fetchone()
        (path_m,) = connection.execute("SELECT path_m FROM graph").fetchone()
    x = np.arange(3) - 1 / 3
    assert row == (
        3,
        2,
        6,
        struct.pack("<6d", x[0], 1.0, x[1], 1.0, x[2], 1.0),
        b"\0\1\0",
        struct.pack("<3i", 1, 2, 3),
        struct.pack("<4i", 0, 1, 0, 2),
        struct.pack("<2d", 1.0, 2.0),
        struct.pack("<3q", 0, 3, 6),
    )
    assert zlib.decompress(path_m) == struct.pack("<12f", *x[[0, 0, 1, 0, 0, 2]], *[1.0] * 6)


@pytest.mark.fault(44)
def test_a_file_of_an_older_format_is_read_where_it_stands(old: Path, version: int) -> None:
    before = old.read_bytes()
    old.chmod(0o444)
    assert check(old) == ()
    with open_database(old) as database:
        assert database.leave_out_damaged() == ()
        for entry in entries(version):
            assert_holds(database, entry)
    assert old.read_bytes() == before
    assert list(old.parent.iterdir()) == [old]


@pytest.mark.fault(44)
def test_writing_to_a_file_of_an_older_format_makes_it_one_of_today_and_keeps_the_old(
    old: Path, version: int
) -> None:
    before = old.read_bytes()
    store(old, [make_entry("friday", 5)], keep=True)
    assert old.read_bytes()[60:64] == LATEST.to_bytes(4, "big")
    assert check(old) == ()
    with open_database(old) as database:
        for entry in (*entries(version), make_entry("friday", 5)):
            assert_holds(database, entry)
    backup = old.with_name(f"old.submaps.format{version}")
    assert sorted(old.parent.iterdir()) == [old, backup] and backup.read_bytes() == before
    assert check(backup) == ()
    store(old, [make_entry("saturday", 6)], keep=True)
    assert backup.read_bytes() == before


def test_a_copy_of_an_older_format_is_what_would_be_written_today(
    old: Path, version: int, tmp_path: Path
) -> None:
    store(tmp_path / "today.submaps", entries(version), keep=False)
    copy(old, tmp_path / "copied.submaps")
    merge([old], tmp_path / "merged.submaps")
    for name in ("copied", "merged"):
        assert (tmp_path / f"{name}.submaps").read_bytes() == (tmp_path / "today.submaps").read_bytes()
    assert everything(old) == everything(tmp_path / "today.submaps")


@pytest.mark.fault(44)
def test_a_refused_session_leaves_a_file_of_an_older_format_as_it_is(old: Path) -> None:
    before = old.read_bytes()
    with pytest.raises(DatabaseError, match="another session named 'monday'"):
        store(old, [make_entry("monday", 9)], keep=True)
    assert old.read_bytes() == before and list(old.parent.iterdir()) == [old]


@pytest.mark.fault(43)
def test_damage_in_a_file_of_an_older_format_is_found(old: Path, tmp_path: Path) -> None:
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


def test_a_stored_isovist_is_as_it_was() -> None:
    """The bytes of a row of format 5, written down."""
    ranges = np.arange(2 * PROFILE_BEARINGS).reshape(2, PROFILE_BEARINGS)
    columns = np.arange(2 * SIGNATURE_COLUMNS).reshape(2, SIGNATURE_COLUMNS)
    row = serialize.isovist_row(SeenPlaces(sight_m=5.0, ranges=ranges, signatures=columns))
    assert (row["count"], row["bearings"], row["columns"], row["sight_m"]) == (2, 48, 111, 5.0)
    assert zlib.decompress(row["ranges"]) == bytes(range(96))
    assert zlib.decompress(row["seen"])[:4] == bytes((0, 111, 1, 112))


def test_what_is_seen_from_the_places_of_an_older_file_is_stored_by_a_copy(old: Path, tmp_path: Path) -> None:
    with open_database(old) as database:
        assert database.seen_places("monday") is None
    store(old, [make_entry("friday", 5)], keep=True)
    copy(old, tmp_path / "copied.submaps")
    with open_database(old) as part, open_database(tmp_path / "copied.submaps") as whole:
        assert part.seen_places("monday") is None and part.seen_places("friday") is not None
        table, grid, seen = whole.signatures("tuesday"), whole.grid("tuesday"), whole.seen_places("tuesday")
    assert seen is not None
    expected = SeenPlaces.of(grid, table.center_m, 5.0)
    assert np.array_equal(seen.ranges, expected.ranges)
    assert np.array_equal(seen.signatures, expected.signatures)


@pytest.mark.fault(43)
def test_a_damaged_graph_is_made_anew(tmp_path: Path) -> None:
    path, good = tmp_path / "x.submaps", tmp_path / "good.submaps"
    session_map, signatures, origin = make_entry("monday", 0)
    store(path, [(session_map, signatures, origin)], keep=False)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE graph SET pixels = zeroblob(length(pixels))")
        connection.commit()
    (problem,) = copy(path, good, recover=True)
    assert (problem.where, problem.what) == ("graph 1", "wrong checksum")
    assert check(good) == ()
    with open_database(good) as database:
        assert_holds(database, with_graph_of_grid((session_map, signatures, origin)))


def rewrite_document(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the document of the only session in a database, with its checksum."""
    connection = sqlite3.connect(path)
    columns = schema.COLUMNS["session"]
    values = connection.execute(f"SELECT {', '.join(columns)} FROM session").fetchone()
    row = dict(zip(columns, values, strict=True))
    document = json.loads(row["document"])
    change(document)
    row["document"] = json.dumps(document)
    crc = serialize.row_crc(list(row.values()))
    connection.execute("UPDATE session SET document = ?, crc32 = ?", (row["document"], crc))
    connection.commit()
    connection.close()


def test_a_setting_that_was_removed_is_read_if_its_value_is_the_one_now_fixed(tmp_path: Path) -> None:
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)
    rewrite_document(path, lambda d: d["config"]["signature"].update(occupied_percent=65))
    assert check(path) == ()
    store(path, [make_entry("tuesday", 1)], keep=True)  # the settings count as the same
    with open_database(path) as database:
        assert {info.name for info in database.sessions()} == {"monday", "tuesday"}
    other = tmp_path / "y.submaps"
    store(other, [make_entry("monday", 0)], keep=False)
    rewrite_document(other, lambda d: d["config"]["signature"].update(occupied_percent=50))
    with open_database(other) as database, pytest.raises(DatabaseVersion, match="occupied_percent"):
        database.sessions()


@pytest.mark.fault(44)
def test_settings_of_the_future_are_refused_by_name_and_left_alone(tmp_path: Path) -> None:
    """The format is the same, but a session was made with a setting that this version does not know."""
    path = tmp_path / "x.submaps"
    store(path, [make_entry("monday", 0)], keep=False)

    def from_the_future(document: dict[str, Any]) -> None:
        document["config"]["partition"]["fractal"] = 3
        document["versions"]["pc2grid"] = "9.1.0"

    rewrite_document(path, from_the_future)
    before = path.read_bytes()
    words = r"'monday' was made by pc2grid 9\.1\.0 with the setting partition\.fractal"
    with open_database(path) as database, pytest.raises(DatabaseVersion, match=words):
        database.sessions()
    with pytest.raises(DatabaseVersion, match=words):
        store(path, [make_entry("tuesday", 1)], keep=True)
    assert path.read_bytes() == before
    (problem,) = check(path)
    assert "partition.fractal" in problem.what
