"""The submap database in PostgreSQL with pgvector: one for a whole fleet, written by many at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.errors import DatabaseError, NotADatabase, OutputError
from pc2grid.model import Loop, OccupancyGrid, SessionMap, Submap, Trajectory
from signature.database import codec, plausible, postgres_schema, rows
from signature.database.postgres_schema import served
from signature.database.protocol import Entry, Label, Neighbour, Problem, Provenance, SessionInfo, none_there
from signature.database.search import embedding, rank

if TYPE_CHECKING:
    from psycopg import Connection

    from signature.config import Config
    from signature.describe import Signature
    from signature.similarity import SignatureTable

Key = tuple[str, int]
"""Building and number of a session."""
_ATTEMPTS = 5
_KNOWN = (
    "s.id <> ALL(%(left_out)s) AND (%(building)s::text IS NULL OR s.building = %(building)s)"
    " AND (%(floor)s::text IS NULL OR s.floor = %(floor)s)"
)
_OF = "building = %s AND session_id = %s"


def store(url: str, entries: Iterable[Entry], *, keep: bool, force: bool = False) -> None:
    """Write sessions in one transaction, all or none; see `signature.database.sqlite.store`.

    Any number of writers may be at it at once; they wait for each other only for sessions of one name, or
    while the database is empty.
    """
    psycopg = postgres_schema.driver()
    where = postgres_schema.location(url)
    again = (psycopg.errors.UniqueViolation, psycopg.errors.DeadlockDetected)
    with postgres_schema.connect(url, where) as connection:
        postgres_schema.initialise(connection, where)
        if postgres_schema.inspect(connection, where) < postgres_schema.FORMAT:
            with served(where), connection.transaction():
                _bring_along(connection)
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                with served(where), connection.transaction():
                    _store(connection, where, entries, keep=keep, force=force)
                return
            except DatabaseError as error:
                # Somebody else stored a session of that name just now: look again what it is.
                if attempt == _ATTEMPTS or not isinstance(error.__cause__, again):
                    raise


def _store(
    connection: Connection[Any], where: str, entries: Iterable[Entry], *, keep: bool, force: bool
) -> None:
    if not keep:
        connection.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
        connection.execute("DELETE FROM pc2grid.session")
    for session_map, signatures, provenance in map(rows.storable, entries):
        name = session_map.session
        other = _other_session(connection, where, name)
        if other is not None:
            resolution_m = session_map.grid.resolution_m
            rows.refuse_other_settings(other, provenance.config, resolution_m, where)
        elif signatures:
            bins = len(signatures[0].boundary) + len(signatures[0].freespace)
            postgres_schema.index_embeddings(connection, bins)
        found = connection.execute(
            "SELECT building, id, document FROM pc2grid.session WHERE name = %s FOR UPDATE", [name]
        ).fetchone()
        number: int | None = None
        if found is not None:
            old_building, number, document = found
            if not force and document == rows.document(session_map, provenance):
                continue
            if not force:
                raise DatabaseError(
                    f"{where}: holds another session named {name!r} already",
                    hint="--force replaces it; --name gives this one another name",
                )
            connection.execute(
                "DELETE FROM pc2grid.session WHERE building = %s AND id = %s", [old_building, number]
            )
        if number is None:
            (number,) = connection.execute("SELECT nextval('pc2grid.session_id')").fetchone() or (0,)
        _insert_session(connection, int(number), session_map, signatures, provenance)


def _bring_along(connection: Connection[Any]) -> None:
    """Sessions of format 1 knew no loops: they have none."""
    if "loop" in postgres_schema.bring_along(connection):
        known = connection.execute("SELECT building, id FROM pc2grid.session ORDER BY id").fetchall()
        nothing = rows.loop_row(())
        _copy_in(connection, "loop", [{"building": b, "session_id": n, **nothing} for b, n in known])


def _other_session(connection: Connection[Any], where: str, name: str) -> SessionInfo | None:
    """Any session but `name`, kept from being removed until this transaction ends.

    None: there is no other, and nobody can add one until then.
    """
    psycopg = postgres_schema.driver()
    query = "s.name <> %s LIMIT 1"
    with connection.transaction() as attempt:
        # Shared, so that writers do not wait for each other once there is something to compare with.
        connection.execute("SELECT 1 FROM pc2grid.about FOR SHARE")
        found = [info for _, info in _read_sessions(connection, where, query, [name])]
        if not found:
            raise psycopg.Rollback(attempt)  # and let go of the lock: two that share it cannot both have it
    if found:
        return found[0]
    connection.execute("SELECT 1 FROM pc2grid.about FOR UPDATE")
    return next((info for _, info in _read_sessions(connection, where, query, [name])), None)


def _insert_session(
    connection: Connection[Any],
    number: int,
    session_map: SessionMap,
    signatures: Sequence[Signature],
    provenance: Provenance,
) -> None:
    submaps = session_map.submaps
    if len(signatures) != len(submaps):
        raise ValueError(f"{len(submaps)} submaps but {len(signatures)} signatures")
    building, floor = provenance.label.building or "", provenance.label.floor or ""
    session = {
        "building": building,
        "id": number,
        "floor": floor,
        "name": session_map.session,
        "sensor": session_map.sensor,
        "document": rows.document(session_map, provenance),
    }
    of_session = {"building": building, "session_id": number}
    _copy_in(connection, "session", [session])
    _copy_in(connection, "grid", [{**of_session, **rows.grid_row(session_map.grid)}])
    _copy_in(connection, "trajectory", [{**of_session, **rows.trajectory_row(session_map.trajectory)}])
    _copy_in(connection, "loop", [{**of_session, **rows.loop_row(session_map.loops)}])
    _copy_in(connection, "submap", [{**of_session, **rows.submap_row(submap)} for submap in submaps])
    described = [
        {
            **of_session,
            "submap_id": int(submap.submap_id),
            "floor": floor,
            "center_x_m": float(submap.center_m[0]),
            "center_y_m": float(submap.center_m[1]),
            "boundary": codec.pack_array(signature.boundary, "<f4"),
            "freespace": codec.pack_array(signature.freespace, "<f4"),
            "symmetry": codec.pack_array(signature.symmetry, "<f4"),
        }
        for submap, signature in zip(submaps, signatures, strict=True)
    ]
    copy_signatures(connection, described, provenance.config)


def copy_signatures(connection: Connection[Any], described: Sequence[rows.Row], config: Config) -> None:
    """Append rows to the table `signature`, with checksum and embedding."""
    from pgvector import HalfVector

    if not described:
        return
    vectors = _embeddings(described, config)
    _copy_in(connection, "signature", described, embedding=[HalfVector(vector) for vector in vectors])


def _copy_in(
    connection: Connection[Any], table: str, content: Sequence[rows.Row], **more: Sequence[Any]
) -> None:
    """Append rows with their checksums, and what is in `more` besides."""
    types = postgres_schema.TYPES[table]
    columns = [*types, "crc32", *more]
    query = f"COPY pc2grid.{table} ({', '.join(columns)}) FROM STDIN (FORMAT BINARY)"
    with connection.cursor() as cursor, cursor.copy(query) as copy:
        copy.set_types([*types.values(), "bigint", *("halfvec" for _ in more)])
        for i, row in enumerate(content):
            values = [row[column] for column in types]
            copy.write_row([*values, codec.row_crc(values), *(column[i] for column in more.values())])


def _embeddings(described: Sequence[rows.Row], config: Config) -> Any:
    """(N, D) float16: what the index holds for these rows."""
    boundary, freespace = (
        np.frombuffer(b"".join(row[name] for row in described), "<f4").reshape(len(described), -1)
        for name in ("boundary", "freespace")
    )
    return embedding(boundary, freespace, config.signature).astype(np.float16)


def _select(
    connection: Connection[Any], table: str, key: Key, submap_id: int | None = None
) -> list[tuple[rows.Row, bool]]:
    """The rows of a session with whether they match their checksum."""
    columns = tuple(postgres_schema.TYPES[table])
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
            (dict(zip(columns, row, strict=True)), codec.row_crc(row) == crc)
            for *row, crc in cursor.execute(query, values)
        ]


def _read_sizes(connection: Connection[Any], key: Key) -> plausible.Sizes | None:
    """What the submaps and loops of a session must fit; None if its grid or trajectory is lost."""
    query = (
        "SELECT t.count, g.height, g.width, g.resolution_m, g.origin_x_m, g.origin_y_m FROM pc2grid.grid g"
        " JOIN pc2grid.trajectory t USING (building, session_id) WHERE g.building = %s AND g.session_id = %s"
    )
    found = connection.execute(query, key).fetchone()
    return None if found is None else plausible.Sizes(*found)


def _read_sessions(
    connection: Connection[Any], where: str, condition: str, values: Any
) -> list[tuple[Key, SessionInfo]]:
    columns = tuple(postgres_schema.TYPES["session"])
    # The sizes come from rows whose own checksum is looked at when they are used.
    query = (
        f"SELECT {', '.join(f's.{c}' for c in columns)}, s.crc32, g.resolution_m, t.count"
        " FROM pc2grid.session s LEFT JOIN pc2grid.grid g ON (g.building, g.session_id) = (s.building, s.id)"
        " LEFT JOIN pc2grid.trajectory t ON (t.building, t.session_id) = (s.building, s.id)"
        f" WHERE {condition}"
    )
    found = []
    for *row, crc, resolution_m, scans in connection.execute(query, values):
        name = f"session {row[columns.index('id')]}"
        if codec.row_crc(row) != crc:
            raise rows.corrupt(where, name, "wrong checksum")
        if resolution_m is None or scans is None:
            raise rows.corrupt(where, name, f"has no {'grid' if resolution_m is None else 'trajectory'}")
        session = dict(zip(columns, row, strict=True))
        with rows.explained(where, name):
            info = rows.read_info(session, resolution_m, scans, where)
            label = info.provenance.label
            if (session["building"], session["floor"]) != (label.building or "", label.floor or ""):
                raise ValueError(
                    f"filed under {session['building']!r}, {session['floor']!r}, but is of {label}"
                )
            found.append(((session["building"], session["id"]), info))
    return found


class PostgresDatabase:
    """A schema `pc2grid` on a PostgreSQL server. See `SubmapDatabase` for what the methods promise.

    A handle sees the database as it was when it was opened (one snapshot, which costs the server a little
    as long as it is held: services should open a new one now and then); `add` moves its own handle on.
    """

    def __init__(self, url: str, *, writable: bool = False) -> None:
        self._url = url
        self._where = postgres_schema.location(url)
        self._writable = writable
        self._left_out: Collection[Key] = ()
        self._building: str | None = None
        self._floor: str | None = None
        self._config: Config | None = None
        self._connection = postgres_schema.connect(url, self._where)
        try:
            postgres_schema.inspect(self._connection, self._where)
            psycopg = postgres_schema.driver()
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
            where = postgres_schema.location(url)
            raise OutputError(f"{where}: exists already", hint="--force replaces it")
        store(url, (), keep=False)
        return cls(url, writable=True)

    def _look(self) -> None:
        """Take a new snapshot."""
        self._config = None
        with served(self._where):
            self._connection.rollback()
            found = self._connection.execute("SELECT format FROM pc2grid.about").fetchone()
        self._format = int(found[0]) if found else postgres_schema.FORMAT

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
        kept = []
        with served(self._where):
            for key in wanted:
                for row, sound in _select(self._connection, "signature", key):
                    self._believe(row, sound)
                    kept.append(row)
        return self._described(kept, index)

    def nearest(
        self,
        query: Signature,
        count: int,
        *,
        building: str | None = None,
        floor: str | None = None,
        session: str | None = None,
    ) -> tuple[Neighbour, ...]:
        """The `count` submaps most alike by Eq. 6; the index finds those that Eq. 6 is asked about."""
        from pgvector import HalfVector

        config = self.config().signature
        vector = embedding(query.boundary[None], query.freespace[None], config)[0]
        values: dict[str, Any] = {
            "vector": HalfVector(vector),
            "count": max(count, postgres_schema.SHORTLIST),
            "left_out": [number for _, number in self._left_out],
        }
        wanted = ["session_id <> ALL(%(left_out)s)"] if self._left_out else ["true"]
        for column, asked, kept in (("building", building, self._building), ("floor", floor, self._floor)):
            if asked is not None and kept not in (None, asked):
                return ()
            values[column] = asked if asked is not None else kept
            if values[column] is not None:
                wanted.append(f"{column} = %({column})s")
        if session is not None:
            values["own"], values["number"] = self._key(session)
            wanted.append("building = %(own)s AND session_id = %(number)s")
        wanted.append(f"vector_dims(embedding) = {len(vector)}")  # as in the index, or it is not used
        columns = tuple(postgres_schema.TYPES["signature"])
        inside = (
            f"SELECT {', '.join(columns)}, crc32 FROM pc2grid.signature WHERE {' AND '.join(wanted)}"
            f" ORDER BY embedding::halfvec({len(vector)}) <#> %(vector)s::halfvec({len(vector)})"
            " LIMIT %(count)s"
        )
        outside = (
            f"SELECT s.name, {', '.join(f'c.{column}' for column in columns)}, c.crc32 FROM ({inside}) c"
            " JOIN pc2grid.session s ON (s.building, s.id) = (c.building, c.session_id)"
            " ORDER BY c.session_id, c.submap_id"
        )
        candidates: list[rows.Row] = []
        names: list[str] = []
        index: dict[Key, int] = {}
        with served(self._where), self._connection.cursor(binary=True) as cursor:
            for name, *found, crc in cursor.execute(outside, values):
                row = dict(zip(columns, found, strict=True))
                self._believe(row, codec.row_crc(found) == crc)
                key = (row["building"], row["session_id"])
                if key not in index:
                    index[key] = len(names)
                    names.append(name)
                candidates.append(row)
        table = self._described(candidates, index)
        with rows.explained(self._where, "signatures"):
            return rank(query, table, names, count, config)

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        row = self._row("grid", session)
        with rows.explained(self._where, f"grid of session {session!r}"):
            return rows.read_grid(row)

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame."""
        row = self._row("trajectory", session)
        with rows.explained(self._where, f"trajectory of session {session!r}"):
            return rows.read_trajectory(row)

    def loops(self, session: str) -> tuple[Loop, ...]:
        """Where the session came back to a place; see `SubmapDatabase.loops`."""
        if "loop" not in postgres_schema.tables(self._format):
            return ()
        row = self._row("loop", session)
        sizes = self._sizes(self._key(session))
        with rows.explained(self._where, f"loops of session {session!r}"):
            return rows.read_loops(row, sizes)

    def submap(self, session: str, submap_id: int) -> Submap:
        """One submap. Raises DatabaseError if the session has none of that number."""
        row = self._row("submap", session, int(submap_id))
        sizes = self._sizes(self._key(session))
        with rows.explained(self._where, f"submap {submap_id} of session {session!r}"):
            return rows.read_submap(row, sizes)

    def submaps(self, session: str) -> Iterator[Submap]:
        """All submaps of a session, by id."""
        key = self._key(session)
        with served(self._where):
            described = len(_select(self._connection, "signature", key))
            found = _select(self._connection, "submap", key)
        sizes = self._sizes(key)
        # A row that no longer says whose it is would not be found, and not be missed either.
        if described > len(found):
            what = f"{described - len(found)} missing"
            raise rows.corrupt(self._where, f"submaps of session {session!r}", what)
        for row, sound in found:
            where = f"submap {row['submap_id']} of session {session!r}"
            if not sound:
                raise rows.corrupt(self._where, where, "wrong checksum")
            with rows.explained(self._where, where):
                submap = rows.read_submap(row, sizes)
            yield submap

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
        # Making the index waits for readers: not for ourselves.
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
            with served(self._where):
                found = self._connection.execute(query).fetchall()
            labels = [Label(building=b or None, floor=f or None) for b, f in found]
            raise none_there(self._where, building, floor, labels)

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, do without the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left.
        """
        with served(self._where):
            damaged = {
                key: problem
                for key in self._keys().values()
                for problem in [next(self._damage(key, ("session", "grid", "signature")), None)]
                if problem is not None
            }
        self._left_out, self._config = {*self._left_out, *damaged}, None
        problems = tuple(damaged.values())
        if problems and not self._keys():
            raise rows.corrupt(self._where, problems[0].where, problems[0].what)
        return problems

    def check(self) -> tuple[Problem, ...]:
        """Everything that is wrong with the database: each row against its checksum, none may be missing."""
        problems: list[Problem] = []
        with served(self._where):
            for key in self._keys().values():
                found = list(self._damage(key, postgres_schema.tables(self._format)))
                problems += found or [*self._misled(key), *self._incomplete(key)]
        return tuple(dict.fromkeys(problems))

    def close(self) -> None:
        """Let go of the connection."""
        self._connection.close()

    def __enter__(self) -> PostgresDatabase:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _known(self) -> dict[str, Any]:
        """Values for _KNOWN."""
        left_out = [number for _, number in self._left_out]
        return {"left_out": left_out, "building": self._building, "floor": self._floor}

    def _keys(self) -> dict[str, Key]:
        """Name -> key of the sessions that are known, in their order."""
        query = f"SELECT s.name, s.building, s.id FROM pc2grid.session s WHERE {_KNOWN} ORDER BY s.id"
        with served(self._where):
            found = self._connection.execute(query, self._known()).fetchall()
        return {name: (building, number) for name, building, number in found}

    def _key(self, session: str) -> Key:
        with served(self._where):
            found = self._connection.execute(
                f"SELECT s.building, s.id FROM pc2grid.session s WHERE s.name = %(name)s AND {_KNOWN}",
                {**self._known(), "name": session},
            ).fetchone()
        if found is None:
            there = ", ".join(map(repr, list(self._keys())[:20])) or "none"
            raise DatabaseError(f"{self._where}: no session {session!r}", hint=f"there are: {there}")
        return str(found[0]), int(found[1])

    def _row(self, table: str, session: str, submap_id: int | None = None) -> rows.Row:
        what = table if submap_id is None else f"submap {submap_id}"
        with served(self._where):
            found = _select(self._connection, table, self._key(session), submap_id)
        if not found and submap_id is not None:
            raise DatabaseError(f"{self._where}: session {session!r} has no submap {submap_id}")
        if not found:
            raise rows.corrupt(self._where, f"{what} of session {session!r}", "missing")
        row, sound = found[0]
        if not sound:
            raise rows.corrupt(self._where, f"{what} of session {session!r}", "wrong checksum")
        return row

    def _sizes(self, key: Key) -> plausible.Sizes | None:
        with served(self._where):
            return _read_sizes(self._connection, key)

    def _damage(self, key: Key, tables: Sequence[str]) -> Iterator[Problem]:
        """What is wrong with the rows of a session in these tables, and which single ones it lacks."""
        sizes = self._sizes(key)
        for table in tables:
            found = _select(self._connection, table, key)
            for row, sound in found:
                number = row["submap_id"] if "submap_id" in row else key[1]
                name = f"{table} {number}" + (f" of session {key[1]}" if "submap_id" in row else "")
                try:
                    if not sound:
                        raise ValueError("wrong checksum")
                    rows.decode(table, row, self._where, lambda r: _table([r], {key: 0}), sizes)
                except Exception as error:
                    # Whatever the decoding of damaged content stumbles over is the finding.
                    yield Problem(name, str(error))
        # Without the first two a session is not even listed.
        for table in ("grid", "trajectory", *({"loop"} & {*tables})):
            if not _select(self._connection, table, key):
                yield Problem(f"session {key[1]}", f"has no {table}")

    def _misled(self, key: Key) -> Iterator[Problem]:
        """Embeddings that are not what the histograms make them: the index would look in the wrong place."""
        found = [row for row, _ in _select(self._connection, "signature", key)]
        if not found:
            return
        (session, _), *_rest = _select(self._connection, "session", key)
        config = rows.read_info(session, 1.0, 0, self._where).provenance.config
        stored = self._connection.execute(
            f"SELECT embedding FROM pc2grid.signature WHERE {_OF} ORDER BY submap_id", key
        ).fetchall()
        for row, wanted, (vector,) in zip(found, _embeddings(found, config), stored, strict=True):
            if not np.array_equal(vector.to_numpy(), wanted):
                yield Problem(f"signature {row['submap_id']} of session {key[1]}", "wrong embedding")

    def _incomplete(self, key: Key) -> Iterator[Problem]:
        """Submaps that are missing, against what was stored."""
        (session, _), *_rest = _select(self._connection, "session", key)
        count = rows.read_info(session, 1.0, 0, self._where).submaps
        stored, described = (
            [(row["submap_id"], row["center_x_m"], row["center_y_m"]) for row, _ in found]
            for found in (_select(self._connection, table, key) for table in ("submap", "signature"))
        )
        what = rows.unlike(stored, described, count)
        if what:
            yield Problem(f"session {session['name']!r}", what)

    def _described(self, described: Sequence[rows.Row], index: Mapping[Key, int]) -> SignatureTable:
        """Rows of the table `signature` as arrays. Raises DatabaseCorrupt naming the first that cannot be."""
        with rows.explained(self._where, "signatures"):
            try:
                table = _table(described, index)
                if len(table):
                    plausible.check_bins(table.boundary.shape[1], table.freespace.shape[1], self.config())
                return table
            except Exception:
                # One by one, to say which.
                for row in described:
                    name = f"signature {row['submap_id']} of session {row['session_id']}"
                    with rows.explained(self._where, name):
                        alone = _table([row], {(row["building"], row["session_id"]): 0})
                        plausible.check_bins(alone.boundary.shape[1], alone.freespace.shape[1], self.config())
                raise

    def _believe(self, row: rows.Row, sound: bool) -> None:
        if not sound:
            where = f"signature {row['submap_id']} of session {row['session_id']}"
            raise rows.corrupt(self._where, where, "wrong checksum")


def is_filled(url: str) -> bool:
    """Whether the database holds sessions. Raises DatabaseUnreachable and its like if it cannot be asked."""
    where = postgres_schema.location(url)
    with postgres_schema.connect(url, where) as connection:
        try:
            postgres_schema.inspect(connection, where)
        except NotADatabase:
            return False
        with served(where):
            return connection.execute("SELECT 1 FROM pc2grid.session LIMIT 1").fetchone() is not None


def _table(described: Sequence[rows.Row], index: Mapping[Key, int]) -> SignatureTable:
    """Rows of the table `signature` as arrays. ValueError if they do not fit together."""
    from signature.similarity import SignatureTable

    if not described:
        return SignatureTable.of((), np.empty((0, 2)))

    def joined(name: str) -> Any:
        values = [row[name] for row in described]
        width = len(values[0]) // 4
        # Some shorter and some longer ones can have the right length together.
        for value in values:
            if len(value) != 4 * width:
                raise ValueError(f"{name} of {len(value)} bytes among others of {4 * width}")
        return codec.unpack_raw(b"".join(values), "<f4", (len(described), width))

    def numbers(kind: type, *names: str) -> Any:
        return np.array([[row[name] for name in names] for row in described], kind)

    boundary, freespace, symmetry = joined("boundary"), joined("freespace"), joined("symmetry")
    submap_id, center_m = (
        numbers(np.int32, "submap_id")[:, 0],
        numbers(np.float64, "center_x_m", "center_y_m"),
    )
    plausible.check_histograms(boundary, "boundary")
    plausible.check_histograms(freespace, "freespace")
    plausible.check_described(submap_id, center_m, symmetry)
    return SignatureTable(
        boundary=boundary,
        freespace=freespace,
        symmetry=symmetry,
        session_index=np.array([index[row["building"], row["session_id"]] for row in described], np.int32),
        submap_id=submap_id,
        center_m=center_m,
    )
