"""A `*.submaps` file opened for reading: its rows, and what is wrong with them."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from signature.database import plausible, rows, schema
from signature.database.connection import BoundedConnection
from signature.database.older import bring_along
from signature.database.protocol import Problem, SessionInfo


def connect(path: Path) -> sqlite3.Connection:
    """A connection that cannot change the file.

    Raises NotADatabase, DatabaseVersion, DatabaseCorrupt.
    """
    schema.inspect_header(path)
    real = os.path.realpath(path)
    # Finished files are never written again, so no locks are needed and none are taken; unless
    # another program left its journal beside the file.
    journals = [Path(real + suffix) for suffix in ("-wal", "-journal")]
    immutable = "" if any(journal.exists() for journal in journals) else "&immutable=1"
    uri = f"file:{quote(real)}?mode=ro{immutable}"
    with rows.explained(path, "header"):
        connection = sqlite3.connect(
            uri, uri=True, isolation_level=None, check_same_thread=False, factory=BoundedConnection
        )
        try:
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute("PRAGMA mmap_size = 1073741824")
            schema.inspect_tables(connection, path)
            bring_along(connection, beside=True)
        except BaseException:
            connection.close()
            raise
    return connection


@contextlib.contextmanager
def whatever_it_holds(path: Path) -> Iterator[sqlite3.Connection]:
    """A connection to a file that may be damaged in any way; nothing is believed yet."""
    uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
    opened = sqlite3.connect(uri, uri=True, isolation_level=None, factory=BoundedConnection)
    with contextlib.closing(opened) as connection:
        with contextlib.suppress(*schema.COMPLAINTS):  # each use of the connection meets the damage again
            bring_along(connection, beside=True)
        yield connection


def read_sessions(
    connection: sqlite3.Connection, path: Path, without: Collection[int] = ()
) -> list[tuple[int, SessionInfo]]:
    """All sessions but those of the numbers `without`, with their numbers. Raises DatabaseCorrupt."""
    return list(iter_sessions(connection, path, without))


def iter_sessions(
    connection: sqlite3.Connection, path: Path, without: Collection[int] = ()
) -> Iterator[tuple[int, SessionInfo]]:
    """The same, one after the other."""
    with rows.explained(path, "session"):
        # The sizes come from rows whose own checksum is looked at when they are used.
        resolution_m = dict(connection.execute("SELECT session_id, resolution_m FROM grid"))
        scans = dict(connection.execute("SELECT session_id, count FROM trajectory"))
        for row, sound in rows.select(connection, "session"):
            if row["id"] in without:
                continue
            where = f"session {row['id']}"
            if not sound:
                raise rows.corrupt(path, where, "wrong checksum")
            for table, known in (("grid", resolution_m), ("trajectory", scans)):
                if row["id"] not in known:
                    raise rows.corrupt(path, where, f"has no {table}")
            with rows.explained(path, where):
                info = rows.read_info(row, resolution_m[row["id"]], scans[row["id"]], path)
            yield row["id"], info


def read_sizes(connection: sqlite3.Connection, session_id: int) -> plausible.Sizes | None:
    """What the submaps and loops of a session must fit; None if its grid or trajectory is lost.

    Like all that is read of other rows, believed only until their own checksum is looked at.
    """
    query = (
        "SELECT t.count, g.height, g.width, g.resolution_m, g.origin_x_m, g.origin_y_m"
        " FROM grid g JOIN trajectory t ON t.session_id = g.session_id WHERE g.session_id = ?"
    )
    found = connection.execute(query, (session_id,)).fetchone()
    return None if found is None else plausible.Sizes(*found)


def read_table(
    connection: sqlite3.Connection, path: Path, table: str, where: str = "1", *values: int
) -> Iterator[tuple[rows.Row | None, Problem | None]]:
    """Each row, and what is wrong with it: it must match its checksum and decode."""
    session_id, sizes = None, None
    try:
        for row, sound in rows.select(connection, table, where, *values):
            number = row["submap_id"] if table == "submap" else row.get("id", row.get("session_id"))
            name = f"{table} {number}" + (f" of session {row['session_id']}" if table == "submap" else "")
            try:
                if not sound:
                    raise ValueError("wrong checksum")
                if table in ("submap", "loop") and row["session_id"] != session_id:
                    session_id, sizes = row["session_id"], read_sizes(connection, row["session_id"])
                rows.decode(table, row, path, rows.read_signature_arrays, sizes)
            except Exception as error:
                # Whatever the decoding of damaged content stumbles over is the finding.
                yield row, Problem(name, str(error))
            else:
                yield row, None
    except schema.COMPLAINTS as error:
        yield None, Problem(table, str(error))


def damaged_sessions(connection: sqlite3.Connection, path: Path) -> dict[int, Problem]:
    """Numbers of the sessions whose own row, grid or signatures are damaged or missing, and what it is.

    These are what a search reads; damaged submaps, trajectories and loops are not looked for. Raises
    DatabaseCorrupt if a table cannot be read to its end.
    """
    damaged: dict[int, Problem] = {}
    present: dict[str, set[int]] = {}
    for table, key in (("session", "id"), ("grid", "session_id"), ("signature", "session_id")):
        present[table] = set()
        for row, problem in read_table(connection, path, table):
            if row is None:
                assert problem is not None
                raise rows.corrupt(path, problem.where, problem.what)
            present[table].add(row[key])
            if problem is not None:
                damaged.setdefault(row[key], problem)
    with rows.explained(path, "trajectory"):
        present["trajectory"] = {
            number for (number,) in connection.execute("SELECT session_id FROM trajectory")
        }
    for number in sorted(set().union(*present.values())):
        lost = [table for table, numbers in present.items() if number not in numbers]
        if lost:
            damaged.setdefault(number, Problem(f"session {number}", f"has no {' and no '.join(lost)}"))
    return damaged
