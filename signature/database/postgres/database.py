"""The submap database in PostgreSQL with pgvector: one for a whole fleet, with many writers at once."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import DatabaseError, NotADatabase, OutputError
from pc2grid.model import SessionMap, Submap
from signature.database import migrations, serialize, validation
from signature.database.nearest_rows import embedding, rank
from signature.database.postgres import schema
from signature.database.postgres.schema import served
from signature.database.protocol import (
    Entry,
    Label,
    Neighbour,
    Problem,
    Provenance,
    SessionInfo,
    none_there,
)
from signature.database.reader import RowReader, damage_of
from signature.database.serialize import Row

if TYPE_CHECKING:
    from psycopg import Connection

    from signature.config import Config
    from signature.describe import Signature
    from signature.similarity import SignatureTable

Key = tuple[str, int]
"""Building and number of a session."""
_ATTEMPTS = 5
"""How often a transaction is tried that conflicts with one of another writer; chosen by hand."""

_KNOWN = """
    s.id <> ALL(%(left_out)s)
    AND (%(building)s::text IS NULL OR s.building = %(building)s)
    AND (%(floor)s::text IS NULL OR s.floor = %(floor)s)
"""
"""The sessions that a handle knows: not left out as damaged, and of the building and floor it keeps to."""

_SESSIONS = """
    SELECT {columns}, s.crc32, g.resolution_m, t.count
    FROM pc2grid.session s
    LEFT JOIN pc2grid.grid g ON (g.building, g.session_id) = (s.building, s.id)
    LEFT JOIN pc2grid.trajectory t ON (t.building, t.session_id) = (s.building, s.id)
    WHERE {condition}
"""

_SIZES = """
    SELECT t.count, g.height, g.width, g.resolution_m, g.origin_x_m, g.origin_y_m
    FROM pc2grid.grid g JOIN pc2grid.trajectory t USING (building, session_id)
    WHERE g.building = %s AND g.session_id = %s
"""

_NEAREST = """
    SELECT s.name, {columns}, c.crc32
    FROM (
        SELECT * FROM pc2grid.signature
        WHERE {filters}
        ORDER BY embedding::halfvec({bins}) <#> %(vector)s::halfvec({bins})
        LIMIT %(count)s
    ) c
    JOIN pc2grid.session s ON (s.building, s.id) = (c.building, c.session_id)
    ORDER BY c.session_id, c.submap_id
"""
"""The candidates for Eq. 6: the nearest by the index, which is used only with the condition it was made with,
`vector_dims(embedding) = bins`."""

_NEAREST_FILTERS = {
    "bins": "vector_dims(embedding) = {bins}",
    "left_out": "session_id <> ALL(%(left_out)s)",
    "building": "building = %(building)s",
    "floor": "floor = %(floor)s",
    "session": "session_id = %(session)s",
}
"""Conditions of _NEAREST: value -> SQL."""


def store(
    url: str, entries: Iterable[Entry], *, keep: bool, force: bool = False, drop: Collection[str] = ()
) -> None:
    """Write sessions in one transaction, all or none; see `signature.database.maintenance.store`.

    Any number of processes may write at once; they wait for each other only if they store sessions of one
    name, or while the database is empty.
    """
    psycopg = schema.driver()
    where = schema.location(url)
    again = (psycopg.errors.UniqueViolation, psycopg.errors.DeadlockDetected)
    with schema.connect(url, where) as connection:
        schema.initialise(connection, where)
        if schema.inspect(connection, where) < migrations.FORMAT:
            with served(where), connection.transaction():
                _migrate(connection)
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                with served(where), connection.transaction():
                    if drop:
                        connection.execute("DELETE FROM pc2grid.session WHERE name = ANY(%s)", [list(drop)])
                    _store(connection, where, entries, keep=keep, force=force)
                return
            except DatabaseError as error:
                # Another writer has just stored a session of that name: compare with it.
                if attempt == _ATTEMPTS or not isinstance(error.__cause__, again):
                    raise


def _store(
    connection: Connection[Any], where: str, entries: Iterable[Entry], *, keep: bool, force: bool
) -> None:
    if not keep:
        connection.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
        connection.execute("DELETE FROM pc2grid.session")
    for session_map, signatures, provenance in map(serialize.storable, entries):
        name = session_map.session
        content = serialize.rows_of(session_map, provenance)
        other = _other_session(connection, where, name)
        if other is not None:
            resolution_m = session_map.grid.resolution_m
            serialize.refuse_other_settings(other, provenance.config, resolution_m, where)
        elif signatures:
            bins = len(signatures[0].boundary) + len(signatures[0].freespace)
            schema.index_embeddings(connection, bins)
        found = connection.execute(
            "SELECT building, id, document FROM pc2grid.session WHERE name = %s FOR UPDATE", [name]
        ).fetchone()
        if found is None:
            (number,) = connection.execute("SELECT nextval('pc2grid.session_id')").fetchone() or (0,)
        else:
            old_building, number, document = found
            if not force and document == content["session"][0]["document"]:
                continue
            if not force:
                raise serialize.refuse_same_name(name, where)
            connection.execute(
                "DELETE FROM pc2grid.session WHERE building = %s AND id = %s", [old_building, number]
            )
        _insert(connection, int(number), content, signatures, provenance)


def remove(url: str, names: Sequence[str]) -> None:
    """Remove sessions in one transaction, all or none. Raises DatabaseError for a name that is unknown."""
    with _changed(url) as (connection, where):
        known = _names(connection)
        for name in dict.fromkeys(names):
            if connection.execute("DELETE FROM pc2grid.session WHERE name = %s", [name]).rowcount != 1:
                raise serialize.no_session(name, known, where)


def rename(url: str, old: str, new: str) -> None:
    """Give a session another name.

    Raises DatabaseError if there is no session `old`, or if there is another session `new`.
    """
    new = serialize.stored_name(new)
    with _changed(url) as (connection, where):
        found = connection.execute(
            "SELECT building, id FROM pc2grid.session WHERE name = %s FOR UPDATE", [old]
        ).fetchone()
        if found is None:
            raise serialize.no_session(old, _names(connection), where)
        taken = connection.execute("SELECT 1 FROM pc2grid.session WHERE name = %s", [new]).fetchone()
        if new != old and taken is not None:
            raise serialize.name_is_taken(new, where)
        building, number = found
        ((row, sound),) = _select(connection, "session", (building, number))
        if not sound:
            raise serialize.corrupt(where, f"session {number}", "wrong checksum")
        values = [{**row, "name": new}[column] for column in schema.TYPES["session"]]
        connection.execute(
            "UPDATE pc2grid.session SET name = %s, crc32 = %s WHERE building = %s AND id = %s",
            [new, serialize.row_crc(values), building, number],
        )


@contextlib.contextmanager
def _changed(url: str) -> Iterator[tuple[Connection[Any], str]]:
    """A transaction on an existing database, and the location for messages."""
    where = schema.location(url)
    with schema.connect(url, where) as connection:
        if schema.inspect(connection, where) < migrations.FORMAT:
            with served(where), connection.transaction():
                _migrate(connection)
        with served(where), connection.transaction():
            yield connection, where


def _names(connection: Connection[Any]) -> list[str]:
    """Names of sessions for a message: a fleet has many."""
    return [name for (name,) in connection.execute("SELECT name FROM pc2grid.session ORDER BY id LIMIT 20")]


def _migrate(connection: Connection[Any]) -> None:
    """Within a transaction: add what a database of an older format lacks."""
    missing = schema.add_missing_tables(connection)
    known = connection.execute("SELECT building, id FROM pc2grid.session ORDER BY id").fetchall()
    for table in missing:
        row = serialize.row_of_older_format(table)
        _copy_in(connection, table, [{"building": b, "session_id": n, **row} for b, n in known])


def _other_session(connection: Connection[Any], where: str, name: str) -> SessionInfo | None:
    """Any session but `name`, locked against removal until this transaction ends.

    None: there is no other, and no writer can add one until then.
    """
    psycopg = schema.driver()
    query = "s.name <> %s LIMIT 1"
    with connection.transaction() as attempt:
        # A shared lock: writers do not wait for each other once there is a session to compare with.
        connection.execute("SELECT 1 FROM pc2grid.about FOR SHARE")
        found = [info for _, info in _read_sessions(connection, where, query, [name])]
        if not found:
            raise psycopg.Rollback(attempt)  # releases the lock: two holders could not both make it exclusive
    if found:
        return found[0]
    connection.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
    return next((info for _, info in _read_sessions(connection, where, query, [name])), None)


def _insert(
    connection: Connection[Any],
    number: int,
    content: dict[str, list[Row]],
    signatures: Sequence[Signature],
    provenance: Provenance,
) -> None:
    """Store the rows of one session: table -> rows, and its signatures."""
    building, floor = provenance.label.building or "", provenance.label.floor or ""
    session = {"building": building, "id": number, "floor": floor, **content["session"][0]}
    _copy_in(connection, "session", [session])
    of_session = {"building": building, "session_id": number}
    for table, found in content.items():
        if table != "session":
            _copy_in(connection, table, [{**of_session, **row} for row in found])
    described = [
        {
            **of_session,
            **{column: submap[column] for column in ("submap_id", "center_x_m", "center_y_m")},
            "floor": floor,
            "boundary": serialize.pack_array(signature.boundary, "<f4"),
            "freespace": serialize.pack_array(signature.freespace, "<f4"),
            "symmetry": serialize.pack_array(signature.symmetry, "<f4"),
        }
        for submap, signature in zip(content["submap"], signatures, strict=True)
    ]
    copy_signatures(connection, described, provenance.config)


def copy_signatures(connection: Connection[Any], described: Sequence[Row], config: Config) -> None:
    """Append rows to the table `signature`, with checksum and embedding."""
    from pgvector import HalfVector

    if not described:
        return
    vectors = _embeddings(described, config)
    _copy_in(connection, "signature", described, embedding=[HalfVector(vector) for vector in vectors])


def _copy_in(connection: Connection[Any], table: str, content: Sequence[Row], **more: Sequence[Any]) -> None:
    """Append rows with their checksums, and the further columns of `more`."""
    types = schema.TYPES[table]
    columns = [*types, "crc32", *more]
    query = f"COPY pc2grid.{table} ({', '.join(columns)}) FROM STDIN (FORMAT BINARY)"
    with connection.cursor() as cursor, cursor.copy(query) as copy:
        copy.set_types([*types.values(), "bigint", *("halfvec" for _ in more)])
        for i, row in enumerate(content):
            values = [row[column] for column in types]
            copy.write_row([*values, serialize.row_crc(values), *(column[i] for column in more.values())])


def _embeddings(described: Sequence[Row], config: Config) -> Any:
    """(N, D) float16: the vectors by which the index finds these rows."""
    boundary, freespace = (
        np.frombuffer(b"".join(row[name] for row in described), "<f4").reshape(len(described), -1)
        for name in ("boundary", "freespace")
    )
    return embedding(boundary, freespace, config.signature).astype(np.float16)


def _select(
    connection: Connection[Any], table: str, key: Key, submap_id: int | None = None
) -> list[tuple[Row, bool]]:
    """The rows of a session, each with whether it matches its checksum."""
    columns = tuple(schema.TYPES[table])
    order = " ORDER BY submap_id" if "submap_id" in columns else ""
    number = "id" if table == "session" else "session_id"
    only = "" if submap_id is None else " AND submap_id = %s"
    query = (
        f"SELECT {', '.join(columns)}, crc32 FROM pc2grid.{table}"
        f" WHERE building = %s AND {number} = %s{only}{order}"
    )
    values = key if submap_id is None else (*key, submap_id)
    with connection.cursor(binary=True) as cursor:
        return [
            (dict(zip(columns, row, strict=True)), serialize.row_crc(row) == crc)
            for *row, crc in cursor.execute(query, values)
        ]


def _read_sessions(
    connection: Connection[Any], where: str, condition: str, values: Any
) -> list[tuple[Key, SessionInfo]]:
    columns = tuple(schema.TYPES["session"])
    query = _SESSIONS.format(columns=", ".join(f"s.{column}" for column in columns), condition=condition)
    found = []
    # The resolution and the number of scans are used before the checksums of their own rows are compared.
    for *row, crc, resolution_m, scans in connection.execute(query, values):
        name = f"session {row[columns.index('id')]}"
        if serialize.row_crc(row) != crc:
            raise serialize.corrupt(where, name, "wrong checksum")
        if resolution_m is None or scans is None:
            what = f"has no {'grid' if resolution_m is None else 'trajectory'}"
            raise serialize.corrupt(where, name, what)
        session = dict(zip(columns, row, strict=True))
        with serialize.explained(where, name):
            info = serialize.read_info(session, resolution_m, scans, where)
            label = info.provenance.label
            if (session["building"], session["floor"]) != (label.building or "", label.floor or ""):
                raise ValueError(
                    f"filed under {session['building']!r}, {session['floor']!r}, but is of {label}"
                )
            found.append(((session["building"], session["id"]), info))
    return found


class PostgresDatabase(RowReader):
    """A schema `pc2grid` on a PostgreSQL server. See `SubmapDatabase` for what the methods promise.

    A handle sees the database as it was when it was opened: one snapshot, for which the server keeps deleted
    rows, so services should open a new handle now and then. `add` lets its own handle see the new state.
    """

    def __init__(self, url: str, *, writable: bool = False) -> None:
        self._url = url
        self._where = schema.location(url)
        self._writable = writable
        self._left_out: Collection[Key] = ()
        self._building: str | None = None
        self._floor: str | None = None
        self._config: Config | None = None
        self._connection = schema.connect(url, self._where)
        try:
            schema.inspect(self._connection, self._where)
            psycopg = schema.driver()
            self._connection.set_autocommit(False)
            self._connection.set_isolation_level(psycopg.IsolationLevel.REPEATABLE_READ)
            self._connection.set_read_only(True)
            self._look()
        except BaseException:
            self._connection.close()
            raise

    @classmethod
    def create(cls, url: str, *, force: bool = False) -> PostgresDatabase:
        """See `create_database`."""
        if not force and is_filled(url):
            where = schema.location(url)
            raise OutputError(f"{where}: exists already", hint="--force replaces it")
        store(url, (), keep=False)
        return cls(url, writable=True)

    def _look(self) -> None:
        """Take a new snapshot."""
        self._config = None
        with served(self._where):
            self._connection.rollback()
            found = self._connection.execute("SELECT format FROM pc2grid.about").fetchone()
        self._format = int(found[0]) if found else migrations.FORMAT

    @property
    def location(self) -> str:
        """The URL without its password."""
        return self._where

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """All sessions, or those of `names`, in the order they were added."""
        values = self._known()
        condition = _KNOWN
        if names is not None:
            condition, values["names"] = f"{_KNOWN} AND s.name = ANY(%(names)s)", list(names)
        with served(self._where):
            found = _read_sessions(self._connection, self._where, f"{condition} ORDER BY s.id", values)
        return tuple(info for _, info in found)

    def config(self) -> Config:
        """The configuration of the first session; the default if there is none."""
        from signature.config import Config

        if self._config is None:
            with served(self._where):
                condition = f"{_KNOWN} ORDER BY s.id LIMIT 1"
                found = _read_sessions(self._connection, self._where, condition, self._known())
            self._config = found[0][1].provenance.config if found else Config()
        return self._config

    def signatures(self, session: str | None = None) -> SignatureTable:
        """All signatures, or those of one session; `session_index` counts in the order of `sessions()`."""
        keys = self._keys()
        index = {key: i for i, key in enumerate(keys.values())}
        wanted = keys.values() if session is None else [self._key(session)]
        kept = [row for key in wanted for row in self._believed(self._rows("signature", key))]
        return self._table(kept, index)

    def nearest(
        self,
        query: Signature,
        count: int,
        *,
        building: str | None = None,
        floor: str | None = None,
        session: str | None = None,
    ) -> tuple[Neighbour, ...]:
        """The `count` most similar submaps by Eq. 6, of the candidates that the index finds."""
        from pgvector import HalfVector

        config = self.config().signature
        vector = embedding(query.boundary[None], query.freespace[None], config)[0]
        values: dict[str, Any] = {
            "bins": len(vector),
            "left_out": [number for _, number in self._left_out] or None,
        }
        for column, asked, kept in (("building", building, self._building), ("floor", floor, self._floor)):
            if asked is not None and kept not in (None, asked):
                return ()
            values[column] = kept if asked is None else asked
        if session is not None:
            own, values["session"] = self._key(session)
            if values["building"] not in (None, own):
                return ()
            values["building"] = own
        columns = tuple(schema.TYPES["signature"])
        filters = [sql for name, sql in _NEAREST_FILTERS.items() if values.get(name) is not None]
        statement = _NEAREST.format(
            columns=", ".join(f"c.{column}" for column in columns),
            filters=" AND ".join(filters).format(bins=len(vector)),
            bins=len(vector),
        )
        values |= {"vector": HalfVector(vector), "count": max(count, schema.SHORTLIST)}
        found: list[tuple[Row, bool]] = []
        names: list[str] = []
        index: dict[Key, int] = {}
        with served(self._where), self._connection.cursor(binary=True) as cursor:
            for name, *row, crc in cursor.execute(statement, values):
                found.append((dict(zip(columns, row, strict=True)), serialize.row_crc(row) == crc))
                key = (found[-1][0]["building"], found[-1][0]["session_id"])
                if key not in index:
                    index[key] = len(names)
                    names.append(name)
        table = self._table(self._believed(found), index)
        with serialize.explained(self._where, "signatures"):
            return rank(query, table, names, count, config)

    def submaps(self, session: str) -> Iterator[Submap]:
        """All submaps of a session, by id."""
        key = self._key(session)
        described, found = (self._rows(table, key) for table in ("signature", "submap"))
        # A row whose damaged key names another session is missed only by counting.
        missing = len(described) - len(found)
        if missing:
            what = "submaps" if missing > 0 else "signatures"
            raise serialize.corrupt(self._where, f"{what} of session {session!r}", f"{abs(missing)} missing")
        sizes = self._sizes_of(key)
        for row, sound in found:
            where = f"submap {row['submap_id']} of session {session!r}"
            yield self._decoded(row, sound, where, sizes, serialize.read_submap)

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
            raise DatabaseError(f"{self._where}: opened for reading only")
        # Making the index waits for all readers; this handle must not be one of them.
        with served(self._where):
            self._connection.rollback()
        try:
            store(self._url, [(session_map, signatures, provenance)], keep=True, force=force)
        finally:
            self._look()

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only some sessions; see `SubmapDatabase.keep_only`."""
        before = self._building, self._floor
        self._building, self._floor, self._config = building, floor, None
        if not self._keys():
            self._building, self._floor = before
            query = "SELECT DISTINCT building, floor FROM pc2grid.session ORDER BY 1, 2 LIMIT 20"
            labels = [Label(building=b or None, floor=f or None) for b, f in self._ask(query)]
            raise none_there(self._where, building, floor, labels)

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, leave out the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left.
        """
        damaged = {
            key: problem
            for key in self._keys().values()
            for problem in [next(self._damage(key, ("session", "grid", "signature")), None)]
            if problem is not None
        }
        self._left_out, self._config = {*self._left_out, *damaged}, None
        problems = tuple(damaged.values())
        if problems and not self._keys():
            raise serialize.corrupt(self._where, problems[0].where, problems[0].what)
        return problems

    def check(self) -> tuple[Problem, ...]:
        """Everything that is wrong with the database: each row against its checksum, none may be missing."""
        problems: list[Problem] = []
        for key in self._keys().values():
            found = list(self._damage(key, schema.tables(self._format)))
            problems += found or [*self._wrong_embeddings(key), *self._incomplete(key)]
        return tuple(dict.fromkeys(problems))

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def __enter__(self) -> PostgresDatabase:
        return self

    def _known(self) -> dict[str, Any]:
        """The values of _KNOWN."""
        left_out = [number for _, number in self._left_out]
        return {"left_out": left_out, "building": self._building, "floor": self._floor}

    def _ask(self, query: str, values: Any = None) -> list[tuple[Any, ...]]:
        """All rows of a query."""
        with served(self._where):
            return self._connection.execute(query, values).fetchall()

    def _rows(self, table: str, key: Key, submap_id: int | None = None) -> list[tuple[Row, bool]]:
        """The rows of a session in a table, each with whether it matches its checksum."""
        with served(self._where):
            return _select(self._connection, table, key, submap_id)

    def _keys(self) -> dict[str, Key]:
        """Name -> key of the sessions that are known, in their order."""
        query = f"SELECT s.name, s.building, s.id FROM pc2grid.session s WHERE {_KNOWN} ORDER BY s.id"
        return {name: (building, number) for name, building, number in self._ask(query, self._known())}

    def _key(self, session: str) -> Key:
        query = f"SELECT s.building, s.id FROM pc2grid.session s WHERE s.name = %(name)s AND {_KNOWN}"
        found = self._ask(query, {**self._known(), "name": session})
        if not found:
            there = ", ".join(map(repr, list(self._keys())[:20])) or "none"
            raise DatabaseError(f"{self._where}: no session {session!r}", hint=f"there are: {there}")
        return str(found[0][0]), int(found[0][1])

    def _found(self, table: str, session: str, submap_id: int | None) -> tuple[Row, bool] | None:
        key = self._key(session)
        if table not in schema.tables(self._format):
            return serialize.row_of_older_format(table), True
        return next(iter(self._rows(table, key, submap_id)), None)

    def _sizes(self, session: str) -> validation.Sizes | None:
        return self._sizes_of(self._key(session))

    def _sizes_of(self, key: Key) -> validation.Sizes | None:
        found = self._ask(_SIZES, key)
        return validation.Sizes(*found[0]) if found else None

    def _believed(self, found: Iterable[tuple[Row, bool]]) -> list[Row]:
        """Rows of the table `signature`. Raises DatabaseCorrupt for one that does not match its checksum."""
        for row, sound in found:
            if not sound:
                where = f"signature {row['submap_id']} of session {row['session_id']}"
                raise serialize.corrupt(self._where, where, "wrong checksum")
        return [row for row, _ in found]

    def _damage(self, key: Key, tables: Sequence[str]) -> Iterator[Problem]:
        """What is wrong with the rows of a session in these tables, and which single ones are missing."""
        sizes = self._sizes_of(key)
        for table in tables:
            for row, sound in self._rows(table, key):
                problem = damage_of(table, row, sound, sizes, lambda row: _table([row], {key: 0}))
                if problem is not None:
                    yield problem
        # A session without a grid or a trajectory cannot be listed, so these two are always looked for.
        for table in ("grid", "trajectory", *(table for table in migrations.SINCE if table in tables)):
            if not self._rows(table, key):
                yield Problem(f"session {key[1]}", f"has no {table}")

    def _wrong_embeddings(self, key: Key) -> Iterator[Problem]:
        """Embeddings that do not follow from their histograms: the index would not find the submap."""
        found = [row for row, _ in self._rows("signature", key)]
        if not found:
            return
        ((session, _),) = self._rows("session", key)
        config = serialize.read_info(session, 1.0, 0, self._where).provenance.config
        query = (
            "SELECT embedding FROM pc2grid.signature WHERE building = %s AND session_id = %s"
            " ORDER BY submap_id"
        )
        stored = self._ask(query, key)
        for row, wanted, (vector,) in zip(found, _embeddings(found, config), stored, strict=True):
            if not np.array_equal(vector.to_numpy(), wanted):
                yield Problem(f"signature {row['submap_id']} of session {key[1]}", "wrong embedding")

    def _incomplete(self, key: Key) -> Iterator[Problem]:
        """A difference between the submaps of a session and its signatures."""
        ((session, _),) = self._rows("session", key)
        submaps, signatures = (
            [(row["submap_id"], row["center_x_m"], row["center_y_m"]) for row, _ in self._rows(table, key)]
            for table in ("submap", "signature")
        )
        count = serialize.read_info(session, 1.0, 0, self._where).submaps
        isovists = 0
        if "isovist" in schema.tables(self._format):
            ((isovist, _),) = self._rows("isovist", key)
            isovists = isovist["count"]
        what = serialize.mismatch(submaps, signatures, isovists, count)
        if what:
            yield Problem(f"session {session['name']!r}", what)

    def _table(self, described: Sequence[Row], index: Mapping[Key, int]) -> SignatureTable:
        """Rows of the table `signature` as arrays. Raises DatabaseCorrupt naming the first damaged one."""
        with serialize.explained(self._where, "signatures"):
            try:
                return self._comparable(_table(described, index))
            except Exception:
                for row in described:
                    name = f"signature {row['submap_id']} of session {row['session_id']}"
                    with serialize.explained(self._where, name):
                        self._comparable(_table([row], {(row["building"], row["session_id"]): 0}))
                raise

    def _comparable(self, table: SignatureTable) -> SignatureTable:
        """The table, if its histograms have as many bins as the configuration makes."""
        if len(table):
            validation.check_bins(table.boundary.shape[1], table.freespace.shape[1], self.config())
        return table


def is_filled(url: str) -> bool:
    """Whether the database holds sessions. Raises DatabaseUnreachable if the server does not answer."""
    where = schema.location(url)
    with schema.connect(url, where) as connection:
        try:
            schema.inspect(connection, where)
        except NotADatabase:
            return False
        with served(where):
            return connection.execute("SELECT 1 FROM pc2grid.session LIMIT 1").fetchone() is not None


def _table(described: Sequence[Row], index: Mapping[Key, int]) -> SignatureTable:
    """Rows of the table `signature` as arrays. Raises ValueError if they do not fit together."""
    from signature.similarity import SignatureTable

    if not described:
        return SignatureTable.of((), np.empty((0, 2)))

    def joined(name: str) -> Any:
        values = [row[name] for row in described]
        width = len(values[0]) // 4
        # Together, shorter and longer values can have the right length.
        for value in values:
            if len(value) != 4 * width:
                raise ValueError(f"{name} of {len(value)} bytes among others of {4 * width}")
        return serialize.unpack_raw(b"".join(values), "<f4", (len(described), width))

    def numbers(kind: type, *names: str) -> Any:
        return np.array([[row[name] for name in names] for row in described], kind)

    boundary, freespace, symmetry = joined("boundary"), joined("freespace"), joined("symmetry")
    submap_id, center_m = (
        numbers(np.int32, "submap_id")[:, 0],
        numbers(np.float64, "center_x_m", "center_y_m"),
    )
    validation.check_histograms(boundary, "boundary")
    validation.check_histograms(freespace, "freespace")
    validation.check_described(submap_id, center_m, symmetry)
    return SignatureTable(
        boundary=boundary,
        freespace=freespace,
        symmetry=symmetry,
        session_index=np.array([index[row["building"], row["session_id"]] for row in described], np.int32),
        submap_id=submap_id,
        center_m=center_m,
    )
