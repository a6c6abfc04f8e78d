"""The submap database as one SQLite file."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import DatabaseError
from pc2grid.io.atomic import refuse_existing
from pc2grid.model import SessionMap, Submap
from signature.database import serialize, validation
from signature.database.protocol import (
    BUSY_TIMEOUT_S,
    Entry,
    Neighbour,
    Problem,
    Provenance,
    SessionInfo,
    none_there,
)
from signature.database.reader import RowReader
from signature.database.serialize import Row
from signature.database.sqlite import rows, schema
from signature.database.sqlite.atomic_update import rewrite
from signature.database.sqlite.file import (
    check,
    connect,
    connect_damaged,
    damaged_sessions,
    iter_sessions,
    read_sizes,
)

if TYPE_CHECKING:
    from signature.config import Config
    from signature.describe import Signature
    from signature.similarity import SignatureTable


def store(
    path: Path,
    entries: Iterable[Entry],
    *,
    keep: bool,
    force: bool = False,
    drop: Collection[str] = (),
    timeout_s: float = BUSY_TIMEOUT_S,
) -> None:
    """Write sessions to a file, all or none.

    keep : add them to the sessions of the file; otherwise they become its whole content.
    force : replace a session of the same name instead of refusing the new one.
    drop : names of sessions that are removed before.

    Raises DatabaseError for a session of that name with other content, or with signatures that cannot be
    compared with those of the other sessions; DatabaseBusy; OutputError.
    """
    with rewrite(path, keep=keep, timeout_s=timeout_s) as connection:
        present = {info.name: (number, info) for number, info in iter_sessions(connection, path)}
        for name in drop:
            _remove(connection, present.pop(name)[0])
        for session_map, signatures, provenance in map(serialize.storable, entries):
            name, resolution_m = session_map.session, session_map.grid.resolution_m
            other = next((info for _, info in present.values() if info.name != name), None)
            if other is not None:
                serialize.refuse_other_settings(other, provenance.config, resolution_m, path)
            content = serialize.rows_of(session_map, provenance)
            (session,) = content["session"]
            number = max((number for number, _ in present.values()), default=0) + 1
            if name in present:
                number = present[name][0]
                if not force and _document(connection, number) == session["document"]:
                    continue
                if not force:
                    raise serialize.refuse_same_name(name, path)
                _remove(connection, number)
            content["signature"] = [rows.signature_row(session_map.submaps, signatures)]
            _insert(connection, number, content)
            scans = len(session_map.trajectory)
            present[name] = number, serialize.read_info(session, resolution_m, scans, path)


def remove(path: Path, names: Sequence[str], *, timeout_s: float = BUSY_TIMEOUT_S) -> None:
    """Remove sessions from a file, all or none; the file becomes smaller.

    Raises DatabaseError for a name that no session has, and as `store`.
    """
    with _changed(path, timeout_s) as (connection, known):
        for name in dict.fromkeys(names):
            if name not in known:
                raise serialize.no_session(name, known, path)
            _remove(connection, known[name])
        # The copy that is worked on is nobody else's: the change may end before the file is made compact.
        connection.execute("COMMIT")
        connection.execute("VACUUM")
        connection.execute("BEGIN")


def rename(path: Path, old: str, new: str, *, timeout_s: float = BUSY_TIMEOUT_S) -> None:
    """Give a session of a file another name; all else stays as it is.

    Raises DatabaseError if there is no session `old`, or if there is another session `new`; and as `store`.
    """
    new = serialize.stored_name(new)
    with _changed(path, timeout_s) as (connection, known):
        if old not in known:
            raise serialize.no_session(old, known, path)
        if new != old and new in known:
            raise serialize.name_is_taken(new, path)
        ((row, _),) = rows.select(connection, path, "session", "id = ?", known[old])
        connection.execute("DELETE FROM session WHERE id = ?", (known[old],))
        rows.insert(connection, "session", {**row, "name": new})


@contextlib.contextmanager
def _changed(path: Path, timeout_s: float) -> Iterator[tuple[sqlite3.Connection, dict[str, int]]]:
    """A connection to change an existing file by, and the numbers of its sessions by name."""
    schema.inspect_header(path)
    with rewrite(path, keep=True, timeout_s=timeout_s) as connection:
        yield connection, {info.name: number for number, info in iter_sessions(connection, path)}


def _document(connection: sqlite3.Connection, session_id: int) -> str:
    """All that is known of a stored session besides its data: equal if it was made in the same way."""
    (stored,) = connection.execute("SELECT document FROM session WHERE id = ?", (session_id,)).fetchone()
    return str(stored)


def _insert(connection: sqlite3.Connection, session_id: int, content: dict[str, list[Row]]) -> None:
    """Store the rows of one session: table -> rows."""
    for table in schema.TABLES:
        key = "id" if table == "session" else "session_id"
        for row in content[table]:
            rows.insert(connection, table, {key: session_id, **row})


def _remove(connection: sqlite3.Connection, session_id: int) -> None:
    """Delete all rows of a session."""
    for table in schema.TABLES:
        key = "id" if table == "session" else "session_id"
        connection.execute(f"DELETE FROM {table} WHERE {key} = ?", (session_id,))


class SqliteDatabase(RowReader):
    """A `*.submaps` file. See `SubmapDatabase` for what the methods promise.

    An open handle sees the file as it was when it was opened; `add` lets its own handle see the new file.
    """

    def __init__(self, path: Path, *, writable: bool = False, damaged: bool = False) -> None:
        """damaged : open a file in whatever state it is, and know only the sessions that can be read."""
        self._path = path
        self._writable = writable
        self._damaged = damaged
        self._left_out: Collection[int] = ()
        self._connection = connect_damaged(path) if damaged else connect(path)

    @classmethod
    def create(cls, path: Path, *, force: bool = False) -> SqliteDatabase:
        """See `create_database`."""
        if not (path.exists() and path.stat().st_size == 0):
            refuse_existing(path, force)
        store(path, (), keep=False)
        return cls(path, writable=True)

    @property
    def location(self) -> str:
        """Path of the file."""
        return str(self._path)

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """All sessions, or those of `names`, in the order they were added."""
        return tuple(info for _, info in self._sessions() if names is None or info.name in names)

    def config(self) -> Config:
        """The configuration of the first session; the default if there is none."""
        from signature.config import Config

        first = next(self._sessions(), None)
        return first[1].provenance.config if first else Config()

    def signatures(self, session: str | None = None) -> SignatureTable:
        """All signatures, or those of one session; `session_index` counts in the order of `sessions()`."""
        from signature.similarity import SignatureTable

        index = {session_id: i for i, session_id in enumerate(self._ids().values())}
        only = ("1",) if session is None else ("session_id = ?", self._id(session))
        table: dict[str, Any] = {}
        filled, config = 0, self.config()
        # Not from the column `count`, in which a damaged row may state any number.
        statement = f"SELECT coalesce(sum(length(submap_id)), 0) FROM signature WHERE {only[0]}"
        ((bytes_of_ids,),) = rows.query(self._connection, self._path, statement, *only[1:])
        capacity = int(bytes_of_ids) // 4
        found = False
        for row, sound in rows.select(self._connection, self._path, "signature", *only):
            found = True
            if row["session_id"] in self._left_out:
                continue
            where = f"signatures of session {row['session_id']}"
            if not sound:
                raise serialize.corrupt(self._path, where, "wrong checksum")
            if not row["count"]:
                continue
            with rows.explained(self._path, where):
                arrays = rows.read_signature_arrays(row)
                validation.check_bins(row["boundary_bins"], row["freespace_bins"], config)
                arrays["session_index"] = np.full(row["count"], index[row["session_id"]], np.int32)
            # Copied into the table row by row, so that only one session is in memory twice.
            for name, values in arrays.items():
                if name not in table:
                    table[name] = np.empty((capacity, *values.shape[1:]), values.dtype)
                table[name][filled : filled + len(values)] = values
            filled += row["count"]
        if session is not None and not found:
            raise serialize.corrupt(self._path, f"signatures of session {session!r}", "missing")
        if not table:
            return SignatureTable.of((), np.empty((0, 2)))
        return SignatureTable(**{name: values[:filled] for name, values in table.items()})

    def nearest(
        self,
        query: Signature,
        count: int,
        *,
        building: str | None = None,
        floor: str | None = None,
        session: str | None = None,
    ) -> tuple[Neighbour, ...]:
        """The `count` most similar submaps by Eq. 6; see `SubmapDatabase.nearest`."""
        from signature.database.nearest_rows import rank

        table, sessions = self.signatures(session), self.sessions()
        wanted = [info.provenance.label.fits(building, floor) for info in sessions]
        among = np.asarray(wanted, np.bool_)[table.session_index]
        names = [info.name for info in sessions]
        return rank(query, table, names, count, self.config().signature, among)

    def submaps(self, session: str) -> Iterator[Submap]:
        """All submaps of a session, by id."""
        session_id = self._id(session)
        statement = "SELECT count FROM signature WHERE session_id = ?"
        stored = next(rows.query(self._connection, self._path, statement, session_id), None)
        if stored is None:
            raise serialize.corrupt(self._path, f"signature of session {session!r}", "missing")
        with rows.explained(self._path, f"signature of session {session!r}"):
            missing = validation.count(stored[0], "count")
        sizes = read_sizes(self._connection, self._path, session_id)
        for row, sound in rows.select(self._connection, self._path, "submap", "session_id = ?", session_id):
            where = f"submap {row['submap_id']} of session {session!r}"
            yield self._decoded(row, sound, where, sizes, serialize.read_submap)
            missing -= 1
        # A row whose damaged session_id names another session is missed only by counting.
        if missing:
            raise serialize.corrupt(self._path, f"submaps of session {session!r}", f"{missing} missing")

    def add(
        self,
        session_map: SessionMap,
        signatures: Sequence[Signature],
        provenance: Provenance,
        *,
        force: bool = False,
    ) -> None:
        """Store a session in one transaction; see `SubmapDatabase.add`."""
        if not self._writable:
            raise DatabaseError(f"{self._path}: opened for reading only")
        store(self._path, [(session_map, signatures, provenance)], keep=True, force=force)
        self.close()
        self._connection = connect(self._path)

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only some sessions; see `SubmapDatabase.keep_only`."""
        # The labels of damaged sessions are unknown: they stay, so that leave_out_damaged() reports them.
        damaged = damaged_sessions(self._connection, self._path)
        known = iter_sessions(self._connection, self._path, {*self._left_out, *damaged})
        labels = {number: info.provenance.label for number, info in known}
        others = {number for number, label in labels.items() if not label.fits(building, floor)}
        if len(others) == len(labels):
            raise none_there(self.location, building, floor, list(labels.values()))
        self._left_out = {*self._left_out, *others}

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, leave out the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left, or if the file
        itself cannot be read.
        """
        found = damaged_sessions(self._connection, self._path)
        damaged = {number: problem for number, problem in found.items() if number not in self._left_out}
        problems = tuple(damaged.values())
        self._left_out = {*self._left_out, *damaged}
        if problems and not self._ids():
            raise serialize.corrupt(self._path, problems[0].where, problems[0].what)
        return problems

    def check(self) -> tuple[Problem, ...]:
        """Everything that is wrong with the file."""
        return check(self._path)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def __enter__(self) -> SqliteDatabase:
        return self

    def _sessions(self) -> Iterator[tuple[int, SessionInfo]]:
        return iter_sessions(self._connection, self._path, self._left_out, sound_only=self._damaged)

    def _ids(self) -> dict[str, int]:
        """Name -> number of the sessions that are known, in their order."""
        if self._damaged:
            return {info.name: number for number, info in self._sessions()}
        found = rows.query(self._connection, self._path, "SELECT name, id FROM session ORDER BY id")
        return {name: number for name, number in found if number not in self._left_out}

    def _id(self, session: str) -> int:
        ids = self._ids()
        if session not in ids:
            there = ", ".join(map(repr, ids)) or "none"
            raise DatabaseError(f"{self._path}: no session {session!r}", hint=f"there are: {there}")
        return ids[session]

    def _found(self, table: str, session: str, submap_id: int | None) -> tuple[Row, bool] | None:
        condition, values = "session_id = ?", [self._id(session)]
        if submap_id is not None:
            condition, values = f"{condition} AND submap_id = ?", [*values, submap_id]
        return next(rows.select(self._connection, self._path, table, condition, *values), None)

    def _sizes(self, session: str) -> validation.Sizes | None:
        return read_sizes(self._connection, self._path, self._id(session))
