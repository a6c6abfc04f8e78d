"""The tables of a `*.submaps` file, and the checks of a file before anything is read from it."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from pc2grid.errors import DatabaseCorrupt, DatabaseVersion, NotADatabase
from signature.database.migrations import FORMAT, tables_of
from signature.database.protocol import APPLICATION_ID
from signature.database.serialize import SALVAGE

_CONVERTED = (".mcap", ".bag", ".db3", ".yaml", ".yml", ".pcd", ".ply", ".obj", ".stl")
CONVERT = "make one with `pc2grid convert LOG -o BUILDING.submaps`"

DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""What SQLite raises for damaged content: the second where its message would quote bytes that are no text."""

# Every row ends with the crc32 of its other columns: SQLite itself does not notice a flipped bit in a blob.
# Units are in the names; *_m metres, *_ns nanoseconds. Arrays are little-endian, row by row.
TABLES = {
    "session": "id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, sensor TEXT NOT NULL,"
    " document TEXT NOT NULL, crc32 INTEGER NOT NULL",
    "grid": "session_id INTEGER PRIMARY KEY REFERENCES session(id), height INTEGER NOT NULL,"
    " width INTEGER NOT NULL, resolution_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL,"
    " cells BLOB NOT NULL, crc32 INTEGER NOT NULL",
    "trajectory": "session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " stamps_ns BLOB NOT NULL, poses BLOB NOT NULL, health BLOB NOT NULL, crc32 INTEGER NOT NULL",
    "loop": "session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " pairs BLOB NOT NULL, measured BLOB NOT NULL, information BLOB NOT NULL, accepted BLOB NOT NULL,"
    " crc32 INTEGER NOT NULL",
    # The junction graph as `pc2grid.submaps.junction_graph.GraphArrays`; without nodes, none was stored.
    "graph": "session_id INTEGER PRIMARY KEY REFERENCES session(id), nodes INTEGER NOT NULL,"
    " edges INTEGER NOT NULL, points INTEGER NOT NULL, center_m BLOB NOT NULL, kind BLOB NOT NULL,"
    " pixels BLOB NOT NULL, ends BLOB NOT NULL, length_m BLOB NOT NULL, path_start BLOB NOT NULL,"
    " path_m BLOB NOT NULL, crc32 INTEGER NOT NULL",
    # The points in space (`pc2grid.model.PointMap`); a session without any has a row of none.
    "points": "session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " voxel_m REAL NOT NULL, origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, origin_z_m REAL NOT NULL,"
    " voxels BLOB NOT NULL, within BLOB NOT NULL, crc32 INTEGER NOT NULL",
    # What is seen from each place (`signature.seen_places.SeenPlaces`); without places, none was stored.
    "isovist": "session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " bearings INTEGER NOT NULL, columns INTEGER NOT NULL, sight_m REAL NOT NULL, ranges BLOB NOT NULL,"
    " seen BLOB NOT NULL, crc32 INTEGER NOT NULL",
    "submap": "id INTEGER PRIMARY KEY, session_id INTEGER NOT NULL REFERENCES session(id),"
    " submap_id INTEGER NOT NULL, center_x_m REAL NOT NULL, center_y_m REAL NOT NULL, radius_m REAL NOT NULL,"
    " height INTEGER NOT NULL, width INTEGER NOT NULL, resolution_m REAL NOT NULL,"
    " origin_x_m REAL NOT NULL, origin_y_m REAL NOT NULL, cells BLOB NOT NULL, crc32 INTEGER NOT NULL,"
    " UNIQUE (session_id, submap_id)",
    # One row holds all signatures of a session: a search reads all of them.
    "signature": "session_id INTEGER PRIMARY KEY REFERENCES session(id), count INTEGER NOT NULL,"
    " boundary_bins INTEGER NOT NULL, freespace_bins INTEGER NOT NULL, submap_id BLOB NOT NULL,"
    " center_m BLOB NOT NULL, boundary BLOB NOT NULL, freespace BLOB NOT NULL, symmetry BLOB NOT NULL,"
    " crc32 INTEGER NOT NULL",
}
ONE_EACH = ("grid", "trajectory", "loop", "graph", "points", "isovist", "signature")
"""The tables in which every session has exactly one row."""

# What the checksum covers: all columns except itself and the row's own number.
COLUMNS = {
    name: tuple(
        column.split()[0]
        for column in columns.split(", ")
        if column.split()[0] not in ("crc32", "UNIQUE", "submap_id)")
        and not (name == "submap" and column[:3] == "id ")
    )
    for name, columns in TABLES.items()
}


def statements(version: int = FORMAT) -> dict[str, str]:
    """The statement that creates each table of a format: table -> SQL."""
    return {name: f"CREATE TABLE {name} ({columns})" for name, columns in tables_of(version, TABLES).items()}


def version_of(connection: sqlite3.Connection) -> int:
    """The format of the file that is open."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    return int(version)


def initialise(connection: sqlite3.Connection) -> None:
    """Turn an empty file into a database of this format."""
    connection.execute("PRAGMA page_size = 4096")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version = {FORMAT}")
    for statement in statements().values():
        connection.execute(statement)


def inspect_header(path: Path) -> None:
    """Examine the first 100 bytes of a file, before SQLite opens it.

    Raises NotADatabase (missing, empty, another kind of file, another program's SQLite file),
    DatabaseVersion, DatabaseCorrupt (shorter than it says).
    """
    try:
        with path.open("rb") as file:
            header = file.read(100)
            size = file.seek(0, 2)
    except FileNotFoundError:
        raise NotADatabase(f"{path}: no such database", hint=CONVERT) from None
    except IsADirectoryError:
        raise NotADatabase(f"{path}: is a folder, not a submap database", hint=CONVERT) from None
    except (OSError, ValueError) as error:
        raise NotADatabase(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not header:
        raise NotADatabase(f"{path}: empty file, a database that was never filled", hint=CONVERT)
    if not header.startswith(b"SQLite format 3\0"):
        raise NotADatabase(
            f"{path}: not a pc2grid database",
            hint=f"make one of it: pc2grid convert {path} -o {path.with_suffix('.submaps')}"
            if path.suffix.lower() in _CONVERTED
            else CONVERT,
        )
    if len(header) < 100:
        raise DatabaseCorrupt(f"{path}: truncated to {size} bytes, not even the header is whole")
    application_id = int.from_bytes(header[68:72], "big")
    if application_id != APPLICATION_ID:
        raise NotADatabase(
            f"{path}: not a pc2grid database, but another program's SQLite file (application id"
            f" {application_id:#x})",
            hint=CONVERT,
        )
    version = int.from_bytes(header[60:64], "big")
    if version > FORMAT:
        raise DatabaseVersion(
            f"{path}: database format {version}; this pc2grid reads up to {FORMAT}",
            hint="use a newer pc2grid",
        )
    if version < 1:
        raise DatabaseCorrupt(f"{path}: database format {version} never existed", hint=SALVAGE)
    page_size = int.from_bytes(header[16:18], "big")
    page_size = 65536 if page_size == 1 else page_size
    if size != page_size * int.from_bytes(header[28:32], "big"):
        raise DatabaseCorrupt(
            f"{path}: {size} bytes where its header promises"
            f" {page_size * int.from_bytes(header[28:32], 'big')}: truncated or damaged",
            hint=SALVAGE,
        )


def inspect_tables(connection: sqlite3.Connection, path: Path) -> None:
    """Compare the tables with those of the file's format: no views or triggers of others, no damage.

    Raises DatabaseCorrupt.
    """
    found = {
        str(name): str(sql)
        for name, sql in connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL")
    }
    version = version_of(connection)
    wanted = statements(version)
    if found != wanted:
        odd = sorted(name for name in found.keys() | wanted if found.get(name) != wanted.get(name))
        raise DatabaseCorrupt(
            f"{path}: its tables are not those of format {version} ({', '.join(map(repr, odd))})",
            hint=SALVAGE,
        )
