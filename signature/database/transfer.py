"""Sessions into, and between, databases of whatever engine a path or URL names."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from pc2grid.model import SessionMap
from signature.database import open_database, upkeep
from signature.database.postgres_schema import is_url
from signature.database.protocol import Entry, Problem, SessionInfo, SubmapDatabase
from signature.describe import Signature

Place = str | Path


def store(target: Place, entries: Iterable[Entry], *, keep: bool, force: bool = False) -> None:
    """Write sessions in one transaction, all or none; the database is made if there is none.

    keep : add them to what is there; otherwise they become its whole content.
    force : a session of the same name is replaced instead of refused.

    Raises as `SubmapDatabase.add`.
    """
    if is_url(target):
        from signature.database import postgres

        postgres.store(str(target), entries, keep=keep, force=force)
    else:
        from signature.database import sqlite

        sqlite.store(Path(target), entries, keep=keep, force=force)


def exists(target: Place) -> bool:
    """Whether there is something that storing without `keep` would replace."""
    if is_url(target):
        from signature.database.postgres import is_filled

        return is_filled(str(target))
    path = Path(target)
    return path.exists() and not (path.is_file() and path.stat().st_size == 0)


def check(source: Place) -> tuple[Problem, ...]:
    """Read everything and list what is wrong; empty if it is sound."""
    if not is_url(source):
        return upkeep.check(Path(source))
    with open_database(source) as database:
        return database.check()


def copy(source: Place, target: Place, *, recover: bool = False, force: bool = False) -> tuple[Problem, ...]:
    """Write a copy, on the same or another engine; see `signature.database.upkeep.copy`."""
    if not is_url(source) and not is_url(target):
        return upkeep.copy(Path(source), Path(target), recover=recover, force=force)
    _refuse_existing(target, force)
    problems = check(source)
    if problems and not recover:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise DatabaseCorrupt(
            f"{shown(source)}: damaged: {problems[0].where}: {problems[0].what}{more}",
            hint="--recover copies what is whole",
        )
    store(target, Sessions([source], recover=bool(problems)), keep=False)
    return problems


def merge(sources: Sequence[Place], target: Place, *, force: bool = False) -> int:
    """Put the sessions of several databases into a new one; see `signature.database.upkeep.merge`."""
    if not any(map(is_url, (*sources, target))):
        return upkeep.merge([Path(source) for source in sources], Path(target), force=force)
    _refuse_existing(target, force)
    store(target, Sessions(sources), keep=False)
    with open_database(target) as database:
        return len(database.sessions())


class Sessions:
    """The sessions of databases, one after the other, as often as they are asked for."""

    def __init__(self, sources: Sequence[Place], *, recover: bool = False) -> None:
        """recover : leave damaged submaps and sessions out instead of raising DatabaseCorrupt."""
        self._sources = sources
        self._recover = recover

    def __iter__(self) -> Iterator[Entry]:
        for source in self._sources:
            with open_database(source) as database:
                if self._recover:
                    database.leave_out_damaged()
                for info in database.sessions():
                    with contextlib.suppress(*([DatabaseCorrupt] if self._recover else [])):
                        yield _entry(database, info, self._recover)


def _entry(database: SubmapDatabase, info: SessionInfo, recover: bool) -> Entry:
    """A session as it was stored."""
    table = database.signatures(info.name)
    submaps, signatures = [], []
    for row, submap_id in enumerate(table.submap_id):
        try:
            submaps.append(database.submap(info.name, int(submap_id)))
        except DatabaseError:
            if not recover:
                raise
            continue
        signatures.append(
            Signature(
                boundary=table.boundary[row], freespace=table.freespace[row], symmetry=table.symmetry[row]
            )
        )
    session_map = SessionMap(
        session=info.name,
        sensor=info.sensor,
        grid=database.grid(info.name),
        submaps=tuple(submaps),
        trajectory=database.trajectory(info.name),
        loops=database.loops(info.name),
        report=info.report,
    )
    return session_map, signatures, info.provenance


def shown(place: Place) -> str:
    """A path or URL for messages: never with a password."""
    if not is_url(place):
        return str(place)
    from signature.database.postgres_schema import location

    return location(str(place))


def _refuse_existing(target: Place, force: bool) -> None:
    if not force and exists(target):
        raise OutputError(f"{shown(target)}: exists already", hint="--force replaces it")
