"""Changing a database of any engine, checking it, and copying, merging and splitting databases.

The engine follows from the path or URL; `check`, `copy`, `merge` and `split` use only
`SubmapDatabase` and `store`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from pc2grid.model import PointMap, SessionMap, is_part_of, part_name
from signature.database import open_database, serialize
from signature.database.postgres.schema import is_url
from signature.database.protocol import Entry, Problem, SessionInfo, SubmapDatabase
from signature.describe import Signature

if TYPE_CHECKING:
    import networkx as nx

Place = str | Path
"""Path of a `*.submaps` file, or URL of a PostgreSQL database."""
_MOST_PARTS = 100
"""Parts of one recording that are looked for; a recording of 1.9 km without loops falls into 9."""


def store(target: Place, entries: Iterable[Entry], *, keep: bool, force: bool = False) -> None:
    """Write sessions in one transaction, all or none; the database is made if there is none.

    entries : may be iterated over more than once.
    keep : add them to the sessions of the database; otherwise they become its whole content.
    force : replace a session of the same name instead of refusing the new one, and with it the other parts of
        the recording that it was made from.

    Raises as `SubmapDatabase.add`.
    """
    names = [session_map.session for session_map, _, _ in entries] if keep and force else []
    drop = _other_parts(target, names) if names and exists(target) else []
    if is_url(target):
        from signature.database.postgres.database import store as store_rows

        store_rows(str(target), entries, keep=keep, force=force, drop=drop)
    else:
        from signature.database.sqlite.database import store as store_file

        store_file(Path(target), entries, keep=keep, force=force, drop=drop)


def _other_parts(target: Place, names: Collection[str]) -> list[str]:
    """The stored sessions that are other parts of the recordings which these sessions were made from."""
    with open_database(target) as database:
        asked = [part_name(name, k) for name in names for k in range(_MOST_PARTS)]
        known = {info.name: info.provenance.digest for info in database.sessions(asked)}
    return [
        part
        for part, digest in known.items()
        if any(is_part_of(part, name) and digest == known.get(name) for name in names)
    ]


def remove(target: Place, names: Sequence[str]) -> None:
    """Remove sessions from a database in one transaction, all or none.

    Raises DatabaseError for a name that no session has, OutputError, DatabaseBusy, and as `open_database`.
    """
    if is_url(target):
        from signature.database.postgres.database import remove as remove_rows

        remove_rows(str(target), names)
    else:
        from signature.database.sqlite.database import remove as remove_from_file

        remove_from_file(Path(target), names)


def rename(target: Place, old: str, new: str) -> None:
    """Give a session another name; all else stays as it is.

    Raises DatabaseError if there is no session `old`, or if there is another session `new`; OutputError,
    DatabaseBusy, and as `open_database`.
    """
    if is_url(target):
        from signature.database.postgres.database import rename as rename_row

        rename_row(str(target), old, new)
    else:
        from signature.database.sqlite.database import rename as rename_in_file

        rename_in_file(Path(target), old, new)


def exists(target: Place) -> bool:
    """Whether there is anything that storing without `keep` would replace."""
    if is_url(target):
        from signature.database.postgres.database import is_filled

        return is_filled(str(target))
    path = Path(target)
    return path.exists() and not (path.is_file() and path.stat().st_size == 0)


def shown(place: Place) -> str:
    """A path or URL for messages: never with a password."""
    if not is_url(place):
        return str(place)
    from signature.database.postgres.schema import location

    return location(str(place))


def check(source: Place) -> tuple[Problem, ...]:
    """Read everything and list what is wrong; empty if it is sound.

    Raises NotADatabase or DatabaseVersion if `source` is no database of a format that this version reads.
    """
    if not is_url(source):
        from signature.database.sqlite.file import check as check_file

        return check_file(Path(source))
    with open_database(source) as database:
        return database.check()


def copy(source: Place, target: Place, *, recover: bool = False, force: bool = False) -> tuple[Problem, ...]:
    """Write a compact copy, on the same or another engine.

    With `recover`, damaged submaps, damaged points, and sessions of which another part is damaged, are left
    out; a damaged junction graph is made again. Returns all damage. Raises DatabaseCorrupt for damage without
    `recover`, OutputError if `target` exists without `force`.
    """
    _refuse_existing(target, force)
    problems = check(source)
    if problems and not recover:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise serialize.corrupt(shown(source), problems[0].where, problems[0].what + more)
    store(target, _Sessions([(source, None)], recover=bool(problems)), keep=False)
    return problems


def merge(sources: Sequence[Place], target: Place, *, force: bool = False) -> int:
    """Put the sessions of several databases into a new one; returns how many.

    A session that several of them hold is taken once. Raises DatabaseError if a database is named twice, if
    two different sessions share a name, or were made with settings whose submaps cannot be compared.
    """
    _refuse_existing(target, force)
    _refuse_repeated(sources)
    chosen: dict[str, tuple[SessionInfo, Place]] = {}
    for source in sources:
        with open_database(source) as database:
            for info in database.sessions():
                first, _ = next(iter(chosen.values()), (info, source))
                serialize.refuse_other_settings(
                    first, info.provenance.config, info.resolution_m, shown(source)
                )
                known, origin = chosen.setdefault(info.name, (info, source))
                if known != info:
                    raise DatabaseError(
                        f"{shown(source)}: its session {info.name!r} is not the {info.name!r} of"
                        f" {shown(origin)}",
                        hint=f"`pc2grid db rename {shown(source)} {info.name} NAME` gives it another one",
                    )
    wanted = [(source, [n for n, (_, origin) in chosen.items() if origin == source]) for source in sources]
    store(target, _Sessions(wanted), keep=False)
    return len(chosen)


def split(source: Place, names: Sequence[str], target: Place, *, force: bool = False) -> int:
    """Copy sessions of a database into a new one; returns how many. `source` stays as it is.

    Raises DatabaseError for a name that no session has, or for a `target` that is `source`; OutputError if
    `target` exists without `force`.
    """
    _refuse_existing(target, force)
    _refuse_repeated([source, target])
    with open_database(source) as database:
        known = [info.name for info in database.sessions(names)]
        for name in names:
            if name not in known:
                raise serialize.no_session(name, (i.name for i in database.sessions()), shown(source))
    store(target, _Sessions([(source, known)]), keep=False)
    return len(known)


class _Sessions:
    """The sessions of databases, one after the other, as often as they are iterated over."""

    def __init__(
        self, sources: Sequence[tuple[Place, Sequence[str] | None]], *, recover: bool = False
    ) -> None:
        """sources : databases, each with the names of the sessions to take from it; None: all.

        recover : leave damaged submaps and sessions out instead of raising DatabaseCorrupt.
        """
        self._sources = sources
        self._recover = recover

    def __iter__(self) -> Iterator[Entry]:
        for source, names in self._sources:
            with _open_damaged(source) if self._recover else open_database(source) as database:
                for info in database.sessions(names):
                    with contextlib.suppress(*([DatabaseCorrupt] if self._recover else [])):
                        yield _entry(database, info, self._recover)


def _open_damaged(source: Place) -> SubmapDatabase:
    """A database that knows only those of its sessions that can be read."""
    if not is_url(source):
        from signature.database.sqlite.database import SqliteDatabase

        return SqliteDatabase(Path(source), damaged=True)
    database = open_database(source)
    database.leave_out_damaged()
    return database


def _entry(database: SubmapDatabase, info: SessionInfo, recover: bool) -> Entry:
    """A session as it was stored; with `recover`, without the submaps that are damaged or missing."""
    table = database.signatures(info.name)
    submaps = {}
    if recover:
        for submap_id in table.submap_id.tolist():
            with contextlib.suppress(DatabaseError):
                submaps[submap_id] = database.submap(info.name, submap_id)
    else:
        submaps = {submap.submap_id: submap for submap in database.submaps(info.name)}
    session_map = SessionMap(
        session=info.name,
        sensor=info.sensor,
        grid=database.grid(info.name),
        submaps=tuple(submaps.values()),
        trajectory=database.trajectory(info.name),
        loops=database.loops(info.name),
        graph=_graph(database, info.name, recover),
        consistency=info.consistency,
        odometry=info.odometry,
        precision=info.precision,
        points=_points(database, info.name, recover),
        report=info.report,
    )
    signatures = [
        Signature(boundary=table.boundary[row], freespace=table.freespace[row], symmetry=table.symmetry[row])
        for row, submap_id in enumerate(table.submap_id.tolist())
        if submap_id in submaps
    ]
    return session_map, signatures, info.provenance


def _graph(database: SubmapDatabase, session: str, recover: bool) -> nx.Graph:
    from pc2grid.submaps.junction_graph import junction_graph

    try:
        return database.graph(session)
    except DatabaseCorrupt:
        if not recover:
            raise
        return junction_graph(database.grid(session), database.config().partition)


def _points(database: SubmapDatabase, session: str, recover: bool) -> PointMap | None:
    with contextlib.suppress(*([DatabaseCorrupt] if recover else [])):
        return database.points(session)
    return None


def _refuse_existing(target: Place, force: bool) -> None:
    if not force and exists(target):
        raise OutputError(f"{shown(target)}: exists already", hint="--force replaces it")


def _refuse_repeated(sources: Sequence[Place]) -> None:
    known = set()
    for source in sources:
        place = shown(source) if is_url(source) else Path(source).resolve()
        if place in known:
            raise DatabaseError(f"{shown(source)}: named twice", hint="name each database once")
        known.add(place)
