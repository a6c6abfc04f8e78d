"""The submap database as one SQLite file."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import DatabaseError
from pc2grid.io.atomic import refuse_existing
from pc2grid.model import Loop, OccupancyGrid, SessionMap, Submap, Trajectory
from signature.database import plausible, rows, schema, upkeep
from signature.database.protocol import (
    Entry,
    Neighbour,
    Problem,
    Provenance,
    SessionInfo,
    none_there,
)
from signature.database.rewrite import BUSY_TIMEOUT_S, rewrite
from signature.database.sqlite_file import (
    connect,
    damaged_sessions,
    iter_sessions,
    read_sessions,
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
    timeout_s: float = BUSY_TIMEOUT_S,
) -> None:
    """Write sessions to a file, all or none.

    keep : add them to what the file holds; otherwise they become its whole content.
    force : a session of the same name is replaced instead of refused.

    Raises DatabaseError for a session of that name with other content, or with signatures that cannot be
    compared with the others'; DatabaseBusy; OutputError.
    """
    with rewrite(path, keep=keep, timeout_s=timeout_s) as connection:
        for session_map, signatures, provenance in map(rows.storable, entries):
            present = read_sessions(connection, path)
            name = session_map.session
            old = next((session_id for session_id, info in present if info.name == name), None)
            others = [info for session_id, info in present if session_id != old]
            if others:
                resolution_m = session_map.grid.resolution_m
                rows.refuse_other_settings(others[0], provenance.config, resolution_m, path)
            if old is not None:
                if not force and _same(connection, old, session_map, provenance):
                    continue
                if not force:
                    raise DatabaseError(
                        f"{path}: holds another session named {name!r} already",
                        hint="--force replaces it; --name gives this one another name",
                    )
                remove(connection, old)
            taken = [session_id for session_id, _ in present]
            new = old if old is not None else max(taken, default=0) + 1
            rows.insert_session(connection, new, session_map, signatures, provenance)


def remove(connection: sqlite3.Connection, session_id: int) -> None:
    """Delete all rows of a session."""
    for table in schema.TABLES:
        column = "id" if table == "session" else "session_id"
        connection.execute(f"DELETE FROM {table} WHERE {column} = ?", (session_id,))


class SqliteDatabase:
    """A `*.submaps` file. See `SubmapDatabase` for what the methods promise.

    Open handles see the file as it was when they were opened; `add` moves its own handle on.
    """

    def __init__(self, path: Path, *, writable: bool = False) -> None:
        self._path = path
        self._writable = writable
        self._left_out: Collection[int] = ()
        self._connection = connect(self._path)

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
        found = read_sessions(self._connection, self._path, self._left_out)
        return tuple(info for _, info in found if names is None or info.name in names)

    def config(self) -> Config:
        """The configuration of the first session; the default if there is none."""
        from signature.config import Config

        first = next(iter_sessions(self._connection, self._path, self._left_out), None)
        return first[1].provenance.config if first else Config()

    def signatures(self, session: str | None = None) -> SignatureTable:
        """All signatures, or those of one session; `session_index` counts in the order of `sessions()`."""
        from signature.similarity import SignatureTable

        index = {session_id: i for i, session_id in enumerate(self._ids().values())}
        only = ("1",) if session is None else ("session_id = ?", self._id(session))
        table: dict[str, Any] = {}
        filled, config = 0, self.config()
        with rows.explained(self._path, "signatures"):
            # Lengths of blobs are as large as the file at most, whatever a damaged row says of itself.
            query = f"SELECT length(submap_id) FROM signature WHERE {only[0]}"
            capacity = sum(length for (length,) in self._connection.execute(query, only[1:])) // 4
            for row, sound in rows.select(self._connection, "signature", *only):
                if row["session_id"] in self._left_out:
                    continue
                where = f"signatures of session {row['session_id']}"
                if not sound:
                    raise rows.corrupt(self._path, where, "wrong checksum")
                if not row["count"]:
                    continue
                with rows.explained(self._path, where):
                    arrays = rows.read_signature_arrays(row)
                    plausible.check_bins(row["boundary_bins"], row["freespace_bins"], config)
                    arrays["session_index"] = np.full(row["count"], index[row["session_id"]], np.int32)
                # Row by row into place, so that no more than one session is in memory twice.
                for name, values in arrays.items():
                    if name not in table:
                        table[name] = np.empty((capacity, *values.shape[1:]), values.dtype)
                    table[name][filled : filled + len(values)] = values
                filled += row["count"]
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
        """The `count` submaps most alike by Eq. 6; see `SubmapDatabase.nearest`."""
        from signature.database.search import rank

        table, sessions = self.signatures(session), self.sessions()
        wanted = [info.provenance.label.fits(building, floor) for info in sessions]
        among = np.asarray(wanted, np.bool_)[table.session_index]
        names = [info.name for info in sessions]
        return rank(query, table, names, count, self.config().signature, among)

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        row = self._row("grid", session, "session_id = ?", self._id(session))
        with rows.explained(self._path, f"grid of session {session!r}"):
            return rows.read_grid(row)

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame."""
        row = self._row("trajectory", session, "session_id = ?", self._id(session))
        with rows.explained(self._path, f"trajectory of session {session!r}"):
            return rows.read_trajectory(row)

    def loops(self, session: str) -> tuple[Loop, ...]:
        """Where the session came back to a place; see `SubmapDatabase.loops`."""
        row = self._row("loop", session, "session_id = ?", self._id(session))
        with rows.explained(self._path, f"loops of session {session!r}"):
            return rows.read_loops(row, read_sizes(self._connection, row["session_id"]))

    def submap(self, session: str, submap_id: int) -> Submap:
        """One submap. Raises DatabaseError if the session has none of that number."""
        where = "session_id = ? AND submap_id = ?"
        row = self._row("submap", session, where, self._id(session), int(submap_id))
        with rows.explained(self._path, f"submap {submap_id} of session {session!r}"):
            return rows.read_submap(row, read_sizes(self._connection, row["session_id"]))

    def submaps(self, session: str) -> Iterator[Submap]:
        """All submaps of a session, by id."""
        session_id = self._id(session)
        with rows.explained(self._path, f"submaps of session {session!r}"):
            query = "SELECT count FROM signature WHERE session_id = ?"
            (missing,) = self._connection.execute(query, (session_id,)).fetchone() or (0,)
            sizes = read_sizes(self._connection, session_id)
            for row, sound in rows.select(self._connection, "submap", "session_id = ?", session_id):
                where = f"submap {row['submap_id']} of session {session!r}"
                if not sound:
                    raise rows.corrupt(self._path, where, "wrong checksum")
                with rows.explained(self._path, where):
                    submap = rows.read_submap(row, sizes)
                yield submap
                missing -= 1
            # A row that no longer says whose it is would not be found, and not be missed either.
            if missing:
                raise rows.corrupt(self._path, f"submaps of session {session!r}", f"{missing} missing")

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
        # What a damaged one was is not known: whoever asks for damage shall hear of it.
        unknown = {*self._left_out, *damaged_sessions(self._connection, self._path)}
        known = read_sessions(self._connection, self._path, unknown)
        labels = {number: info.provenance.label for number, info in known}
        others = {number for number, label in labels.items() if not label.fits(building, floor)}
        if len(others) == len(known):
            raise none_there(self.location, building, floor, list(labels.values()))
        self._left_out = {*self._left_out, *others}

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, do without the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left, or if the file
        itself cannot be read.
        """
        found = damaged_sessions(self._connection, self._path)
        damaged = {number: problem for number, problem in found.items() if number not in self._left_out}
        problems = tuple(damaged.values())
        self._left_out = {*self._left_out, *damaged}
        if problems and not self._ids():
            raise rows.corrupt(self._path, problems[0].where, problems[0].what)
        return problems

    def check(self) -> tuple[Problem, ...]:
        """Everything that is wrong with the file."""
        return upkeep.check(self._path)

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    def __enter__(self) -> SqliteDatabase:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _ids(self) -> dict[str, int]:
        with rows.explained(self._path, "session"):
            found = self._connection.execute("SELECT name, id FROM session ORDER BY id")
            return {name: number for name, number in found if number not in self._left_out}

    def _id(self, session: str) -> int:
        ids = self._ids()
        if session not in ids:
            there = ", ".join(map(repr, ids)) or "none"
            raise DatabaseError(f"{self._path}: no session {session!r}", hint=f"there are: {there}")
        return ids[session]

    def _row(self, table: str, session: str, where: str, *values: Any) -> rows.Row:
        with rows.explained(self._path, f"{table} of session {session!r}"):
            found = next(rows.select(self._connection, table, where, *values), None)
            if found is None and table == "submap":
                raise DatabaseError(f"{self._path}: session {session!r} has no submap {values[-1]}")
            if found is None:
                raise rows.corrupt(self._path, f"{table} of session {session!r}", "missing")
            row, sound = found
            if not sound:
                what = f"submap {values[-1]}" if table == "submap" else table
                raise rows.corrupt(self._path, f"{what} of session {session!r}", "wrong checksum")
            return row


def _same(
    connection: sqlite3.Connection, session_id: int, session_map: SessionMap, provenance: Provenance
) -> bool:
    """Whether a stored session came from the same recording, settings and versions as this one."""
    (stored,) = connection.execute("SELECT document FROM session WHERE id = ?", (session_id,)).fetchone()
    return bool(stored == rows.document(session_map, provenance))
