"""Changes of a database of any engine, checks of it, and copying, merging and splitting databases."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from pc2grid.io.source import is_submap_file
from signature.database import SubmapDatabase, engine_of, open_database
from signature.database.document import DatabaseDamage, StoredSession, clean, stored_session
from signature.database.postgres import is_url, location
from signature.database.protocol import BuildingFrame, Entry, Location, Problem, SessionInfo
from signature.database.rows import Rows, refuse_other_settings


def store(target: Location, entries: Iterable[Entry], *, keep: bool, overwrite: bool = False) -> None:
    """Write sessions in one transaction, all or none; the database is made if there is none.

    entries : may be iterated over more than once.
    keep : add them to the sessions of the database; otherwise they become its whole content.
    overwrite : replace a session of the same name instead of refusing the new one, and with it the other
        parts of the recording that it was made from.

    The same session again changes nothing; another one of the same name is refused with DatabaseError, or
    replaced with `overwrite`. Of the submaps their centres are stored: they are cut from the map again, with
    the settings of its provenance. Raises ValueError for submaps and signatures of other sizes than these
    settings make, OutputError, DatabaseBusy, and as `open_database`.
    """
    names = [clean(session_map.session) for session_map, _, _ in entries] if overwrite else []

    def write(rows: Rows) -> None:
        rows.remove([part for name in names for part in rows.other_parts(name)])
        rows.store(map(stored_session, entries), overwrite=overwrite)

    engine_of(target).change(target, write, keep=keep, create=True)


def remove(target: Location, names: Sequence[str]) -> None:
    """Remove sessions from a database in one transaction, all or none.

    Raises DatabaseError for a name that no session has, OutputError, DatabaseBusy, and as `open_database`.
    """
    engine_of(target).change(target, lambda rows: rows.remove(names))


def rename(target: Location, old: str, new: str) -> None:
    """Give a session another name; all else stays as it is.

    Raises DatabaseError if there is no session `old`, or if there is another session `new`; OutputError,
    DatabaseBusy, and as `open_database`.
    """
    engine_of(target).change(target, lambda rows: rows.rename(old, new))


def store_frames(target: Location, frames: Mapping[str, BuildingFrame | None]) -> None:
    """Store where sessions lie in their building, by name, all or none; None: nowhere.

    All else stays as it is. Raises DatabaseError for a name that no session has, OutputError, DatabaseBusy,
    and as `open_database`.
    """
    engine_of(target).change(target, lambda rows: rows.store_frames(frames))


def exists(target: Location) -> bool:
    """Return True if there is anything that storing without `keep` would replace."""
    return engine_of(target).exists(target)


def is_database(name: str) -> bool:
    """Return True if this is the URL or the file of a submap database."""
    return is_url(name) or is_submap_file(Path(name))


def shown(place: Location) -> str:
    """Return a path or URL for messages: never with a password."""
    return location(str(place)) if is_url(place) else str(place)


def check(source: Location) -> tuple[Problem, ...]:
    """Read everything and return all problems; empty if it is sound.

    Raises NotADatabase or DatabaseVersion if `source` is no database of the format that this version reads.
    """
    with contextlib.closing(engine_of(source).open(source, damaged=True)) as rows:
        return rows.all_problems()


def copy(
    source: Location, target: Location, *, recover: bool = False, overwrite: bool = False
) -> tuple[Problem, ...]:
    """Write a compact copy, on the same or another engine.

    With `recover`, parts that follow from the map of a session (submaps and their signatures, visible
    surroundings) are computed again where they are damaged; damaged points, and sessions of which
    another part is damaged, are left out. Returns all damage. Raises DatabaseCorrupt for damage without
    `recover`, OutputError if `target` exists without `overwrite`.
    """
    _refuse_existing(target, overwrite)
    problems = check(source)
    if problems and not recover:
        more = f" and {len(problems) - 1} more" if len(problems) > 1 else ""
        raise DatabaseDamage(shown(source), problems[0].where, problems[0].what + more)
    _write(target, [(source, None)], recover=bool(problems))
    return problems


def merge(sources: Sequence[Location], target: Location, *, overwrite: bool = False) -> int:
    """Put the sessions of several databases into a new one; returns their number.

    A session that is in several of them is taken once. Raises DatabaseError if a database is named twice, if
    two different sessions share a name, or were made with settings whose submaps cannot be compared.
    """
    _refuse_existing(target, overwrite)
    _refuse_repeated(sources)
    chosen: dict[str, tuple[SessionInfo, Location]] = {}
    for source in sources:
        with open_database(source) as database:
            for info in database.sessions():
                first, _ = next(iter(chosen.values()), (info, source))
                refuse_other_settings(first, info, shown(source))
                known, origin = chosen.setdefault(info.name, (info, source))
                if known != info:
                    raise DatabaseError(
                        f"{shown(source)}: its session {info.name!r} is not the {info.name!r} of"
                        f" {shown(origin)}",
                        hint=f"`pc2grid db rename {shown(source)} {info.name} NAME` gives it another one",
                    )
    _write(target, [(s, [n for n, (_, origin) in chosen.items() if origin == s]) for s in sources])
    return len(chosen)


def split(source: Location, names: Sequence[str], target: Location, *, overwrite: bool = False) -> int:
    """Copy sessions of a database into a new one; returns their number. `source` stays as it is.

    Raises DatabaseError for a name that no session has, or for a `target` that is `source`; OutputError if
    `target` exists without `overwrite`.
    """
    _refuse_existing(target, overwrite)
    _refuse_repeated([source, target])
    with open_database(source) as database:
        known = [database.session(name).name for name in dict.fromkeys(names)]
    _write(target, [(source, known)])
    return len(known)


def _write(
    target: Location, sources: Sequence[tuple[Location, Collection[str] | None]], *, recover: bool = False
) -> None:
    """Write sessions of databases, all or none, as the whole content of one.

    sources : each with the names of the sessions to take from it; None: all. recover : leave damaged sessions
    out, as far as they cannot be made whole again, instead of raising DatabaseCorrupt.
    """

    def sessions() -> Iterator[StoredSession]:
        for source, names in sources:
            with SubmapDatabase(engine_of(source).open(source, damaged=recover), damaged=recover) as database:
                for info in database.sessions(names):
                    with contextlib.suppress(*([DatabaseCorrupt] if recover else [])):
                        yield database.stored(info.name, recover=recover)

    engine_of(target).change(
        target, lambda rows: rows.store(sessions(), overwrite=False), keep=False, create=True
    )


def _refuse_existing(target: Location, overwrite: bool) -> None:
    """Raise OutputError if there is something already, and `overwrite` is not set."""
    if not overwrite and exists(target):
        raise OutputError(f"{shown(target)}: exists already", hint="--force replaces it")


def _refuse_repeated(sources: Sequence[Location]) -> None:
    known = set()
    for source in sources:
        place = shown(source) if is_url(source) else Path(source).resolve()
        if place in known:
            raise DatabaseError(f"{shown(source)}: named twice", hint="name each database once")
        known.add(place)
