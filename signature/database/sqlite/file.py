"""A `*.submaps` file opened for reading: its sessions, and its damage."""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pc2grid.errors import DatabaseCorrupt
from signature.database import migrations, serialize, validation
from signature.database.protocol import Problem, SessionInfo
from signature.database.reader import damage_of
from signature.database.serialize import Row
from signature.database.sqlite import rows, schema
from signature.database.sqlite.connection import BoundedConnection

_MAPPED_BYTES = 1 << 30
"""How much of a file SQLite maps into memory at most; chosen by hand."""


def connect(path: Path) -> sqlite3.Connection:
    """A connection that cannot change the file.

    Raises NotADatabase, DatabaseVersion, DatabaseCorrupt.
    """
    schema.inspect_header(path)
    real = os.path.realpath(path)
    # Finished files are never written again, so readers need no locks. Only a journal that another
    # program left beside the file calls for them.
    journals = [Path(real + suffix) for suffix in ("-wal", "-journal")]
    immutable = "" if any(journal.exists() for journal in journals) else "&immutable=1"
    with rows.explained(path, "header"):
        connection = _open(real, immutable)
        try:
            connection.execute("PRAGMA trusted_schema = OFF")
            connection.execute(f"PRAGMA mmap_size = {_MAPPED_BYTES}")
            schema.inspect_tables(connection, path)
            migrate(connection, in_memory=True)
        except BaseException:
            connection.close()
            raise
    return connection


def connect_damaged(path: Path) -> sqlite3.Connection:
    """A connection to a file that may be damaged in any way: neither header nor tables are checked."""
    connection = _open(str(path.resolve()), "&immutable=1")
    with contextlib.suppress(*schema.DAMAGE):  # every later use of the connection finds the damage again
        migrate(connection, in_memory=True)
    return connection


def _open(path: str, options: str) -> sqlite3.Connection:
    return sqlite3.connect(
        f"file:{quote(path)}?mode=ro{options}",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
        factory=BoundedConnection,
    )


def migrate(connection: sqlite3.Connection, *, in_memory: bool = False) -> None:
    """Add the tables that a file of an older format lacks; nothing is done to one of the present format.

    in_memory : add them to this connection as temporary tables, and leave the file as it is.
    """
    version = schema.version_of(connection)
    if version >= migrations.FORMAT:
        return
    if in_memory:
        connection.execute("PRAGMA temp_store = MEMORY")
    present = schema.statements(version)
    missing = {table: text for table, text in schema.statements().items() if table not in present}
    for statement in missing.values():
        connection.execute(statement.replace("TABLE", "TEMP TABLE", 1) if in_memory else statement)
    # A reader of damaged sessions finds the damage later; a writer must not copy them.
    with contextlib.suppress(*schema.DAMAGE if in_memory else ()):
        for (session_id,) in connection.execute("SELECT id FROM session"):
            for table in missing:
                row = serialize.row_of_older_format(table)
                rows.insert(connection, table, {"session_id": session_id, **row})
    if not in_memory:
        connection.execute(f"PRAGMA user_version = {migrations.FORMAT}")


def iter_sessions(
    connection: sqlite3.Connection, path: Path, without: Collection[int] = (), *, sound_only: bool = False
) -> Iterator[tuple[int, SessionInfo]]:
    """The sessions with their numbers, in the order they were added.

    without : numbers of sessions to skip. sound_only : skip those whose own row is damaged, and end at the
        first that cannot be read, instead of raising DatabaseCorrupt.
    """
    tolerated = (DatabaseCorrupt,) if sound_only else ()
    with contextlib.suppress(*tolerated):
        for row, sound in rows.select(connection, path, "session"):
            if row["id"] in without:
                continue
            try:
                info = _session_info(connection, path, row, sound)
            except tolerated:
                continue
            yield row["id"], info


def _session_info(connection: sqlite3.Connection, path: Path, row: Row, sound: bool) -> SessionInfo:
    where = f"session {row['id']}"
    if not sound:
        raise serialize.corrupt(path, where, "wrong checksum")

    def number(table: str, column: str) -> Any:
        """A number of another row of the session, used before the checksum of that row is compared."""
        statement = f"SELECT {column} FROM {table} WHERE session_id = ?"
        found = next(rows.query(connection, path, statement, row["id"]), None)
        if found is None:
            raise serialize.corrupt(path, where, f"has no {table}")
        return found[0]

    resolution_m, scans = number("grid", "resolution_m"), number("trajectory", "count")
    with rows.explained(path, where):
        return serialize.read_info(row, resolution_m, scans, path)


def read_sizes(connection: sqlite3.Connection, path: Path, session_id: int) -> validation.Sizes | None:
    """What the submaps and loops of a session must fit; None if its grid or trajectory is lost.

    They are used before the checksums of the rows that they come from are compared.
    """
    statement = (
        "SELECT t.count, g.height, g.width, g.resolution_m, g.origin_x_m, g.origin_y_m"
        " FROM grid g JOIN trajectory t ON t.session_id = g.session_id WHERE g.session_id = ?"
    )
    found = next(rows.query(connection, path, statement, session_id), None)
    return None if found is None else validation.Sizes(*found)


def check(path: Path) -> tuple[Problem, ...]:
    """Read everything and list what is wrong; empty if the file is sound.

    Raises NotADatabase or DatabaseVersion if it is not a file of this format at all.
    """
    problems: list[Problem] = []
    try:
        schema.inspect_header(path)
    except DatabaseCorrupt as error:
        problems.append(Problem("file", error.message))
    with contextlib.closing(connect_damaged(path)) as connection:
        problems += _damaged_structure(connection, path)
        for table in schema.TABLES:
            problems += [problem for _, problem in _examine(connection, path, table) if problem]
        if not problems:
            problems += _incomplete(connection, path)
    return tuple(dict.fromkeys(problems))


def damaged_sessions(connection: sqlite3.Connection, path: Path) -> dict[int, Problem]:
    """Numbers of the sessions whose own row, grid or signatures are damaged or missing, and what it is.

    A search reads nothing else; damaged submaps, trajectories and loops are not looked for. Raises
    DatabaseCorrupt if a table cannot be read to its end.
    """
    damaged: dict[int, Problem] = {}
    present: dict[str, set[int]] = {}
    for table, key in (("session", "id"), ("grid", "session_id"), ("signature", "session_id")):
        present[table] = set()
        for row, problem in _examine(connection, path, table):
            if row is None:
                assert problem is not None
                raise serialize.corrupt(path, problem.where, problem.what)
            present[table].add(row[key])
            if problem is not None:
                damaged.setdefault(row[key], problem)
    found = rows.query(connection, path, "SELECT session_id FROM trajectory")
    present["trajectory"] = {number for (number,) in found}
    for number in sorted(set().union(*present.values())):
        lost = [table for table, numbers in present.items() if number not in numbers]
        if lost:
            damaged.setdefault(number, Problem(f"session {number}", f"has no {' and no '.join(lost)}"))
    return damaged


def _damaged_structure(connection: sqlite3.Connection, path: Path) -> Iterator[Problem]:
    """What SQLite itself finds wrong, and tables that are not those of the format."""
    try:
        schema.inspect_tables(connection, path)
        for (message,) in connection.execute("PRAGMA integrity_check"):
            yield from (Problem("file", line) for line in str(message).splitlines() if line != "ok")
        for table, rowid, *_ in connection.execute("PRAGMA main.foreign_key_check"):
            yield Problem(f"{table} row {rowid}", "belongs to no session")
    except DatabaseCorrupt as error:
        yield Problem("file", error.message)
    except schema.DAMAGE as error:
        yield Problem("file", str(error))


def _examine(
    connection: sqlite3.Connection, path: Path, table: str
) -> Iterator[tuple[Row | None, Problem | None]]:
    """Each row of a table, and what is wrong with it: it must match its checksum, and be decoded.

    The row is None where the table cannot be read any further.
    """
    session_id, sizes = None, None
    try:
        for row, sound in rows.select(connection, path, table):
            try:
                if sound and table in ("loop", "graph", "submap") and row["session_id"] != session_id:
                    session_id = row["session_id"]
                    sizes = read_sizes(connection, path, session_id)
            except DatabaseCorrupt:
                sizes = None
            yield row, damage_of(table, row, sound, sizes, rows.read_signature_arrays)
    except DatabaseCorrupt as error:
        yield None, Problem(table, str(error.__cause__ or error))


def _incomplete(connection: sqlite3.Connection, path: Path) -> Iterator[Problem]:
    """Sessions that lack a whole row, or whose submaps are not those of their signatures."""
    for session, _ in rows.select(connection, path, "session"):
        where, session_id = f"session {session['name']!r}", session["id"]
        statement = "SELECT count(*) FROM {} WHERE session_id = ?"
        lost = [
            table
            for table in schema.ONE_EACH
            if connection.execute(statement.format(table), (session_id,)).fetchone() != (1,)
        ]
        if lost:
            yield Problem(where, f"has no {' and no '.join(lost)}")
            continue
        statement = "SELECT submap_id, center_x_m, center_y_m FROM submap WHERE session_id = ? ORDER BY id"
        submaps: list[Any] = connection.execute(statement, (session_id,)).fetchall()
        ((row, _),) = rows.select(connection, path, "signature", "session_id = ?", session_id)
        arrays = rows.read_signature_arrays(row)
        signatures = list(zip(arrays["submap_id"].tolist(), *arrays["center_m"].T.tolist(), strict=True))
        ((isovists,),) = connection.execute("SELECT count FROM isovist WHERE session_id = ?", (session_id,))
        count = serialize.read_info(session, 1.0, 0, path).submaps
        what = serialize.mismatch(submaps, signatures, isovists, count)
        if what:
            yield Problem(where, what)
