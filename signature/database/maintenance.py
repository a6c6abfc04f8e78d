"""Changes of a database of any engine, checks of it, and copying, merging and splitting databases."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pc2grid.errors import DatabaseCorrupt, DatabaseError, OutputError
from pc2grid.io.source import is_submap_file
from pc2grid.model import is_part_of
from signature.database import SubmapDatabase, document, engine_of, open_database
from signature.database.database import PART_COLUMNS, SESSION_COLUMNS, SessionRow
from signature.database.document import (
    PARTS,
    DatabaseDamage,
    StoredSession,
    clean,
    row_crc,
    stored_name,
    stored_session,
)
from signature.database.postgres import is_url, location
from signature.database.protocol import BuildingFrame, Entry, Location, Problem, SessionInfo


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

    def write(database: SubmapDatabase) -> None:
        for row in [part for name in names for part in _other_parts(database, name)]:
            _delete(database, row)
        _add(database, map(stored_session, entries), overwrite=overwrite)

    engine_of(target).change(target, write, keep=keep, create=True)


def remove(target: Location, names: Sequence[str]) -> None:
    """Remove sessions from a database in one transaction, all or none.

    Raises DatabaseError for a name that no session has, OutputError, DatabaseBusy, and as `open_database`.
    """

    def write(database: SubmapDatabase) -> None:
        for row in [database.row(name) for name in dict.fromkeys(names)]:
            _delete(database, row)

    engine_of(target).change(target, write)


def rename(target: Location, old: str, new: str) -> None:
    """Give a session another name; all else stays as it is.

    Raises DatabaseError if there is no session `old`, or if there is another session `new`; OutputError,
    DatabaseBusy, and as `open_database`.
    """

    def write(database: SubmapDatabase) -> None:
        name, row = stored_name(new), database.row(old)
        if name != old and database.find(name) is not None:
            raise DatabaseError(
                f"{database.location}: holds a session {name!r} already", hint="choose another name"
            )
        text = document.encode_info(replace(database.info(row), name=name))
        values = (row.building, row.id, row.floor, name, text)
        database.execute(
            "UPDATE session SET name = ?, document = ?, crc32 = ? WHERE building = ? AND id = ?",
            name, text, row_crc(values), row.building, row.id,
        )  # fmt: skip

    engine_of(target).change(target, write)


def store_frames(target: Location, frames: Mapping[str, BuildingFrame | None]) -> None:
    """Store where sessions lie in their building, by name, all or none; None: nowhere.

    All else stays as it is. Raises DatabaseError for a name that no session has, OutputError, DatabaseBusy,
    and as `open_database`.
    """

    def write(database: SubmapDatabase) -> None:
        for name, frame in frames.items():
            row = database.row(name)
            where = row.building, row.id, "frame"
            database.execute("DELETE FROM part WHERE building = ? AND session_id = ? AND name = ?", *where)
            _insert(database, "part", PART_COLUMNS, (*where, document.encode("frame", frame)))

    engine_of(target).change(target, write)


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
    with engine_of(source).open(source, damaged=True) as database:
        return database.all_problems()


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
                _refuse_other_settings(first, info, shown(source))
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
            with engine_of(source).open(source, damaged=recover) as database:
                for info in database.sessions(names):
                    with contextlib.suppress(*([DatabaseCorrupt] if recover else [])):
                        yield database.stored(info.name, recover=recover)

    engine_of(target).change(
        target, lambda database: _add(database, sessions(), overwrite=False), keep=False, create=True
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


# --- rows, within a transaction -----------------------------------------------------------------------


def _add(database: SubmapDatabase, sessions: Iterable[StoredSession], *, overwrite: bool) -> None:
    """Add sessions. One that is stored already is skipped.

    overwrite : replace a session of the same name.

    Raises DatabaseError for a session of that name with other content, or with signatures that cannot be
    compared with those of the other sessions.
    """
    for session in sessions:
        document.check("submaps", session.submaps, {"info": session.info, "grid": session.grid})
        text = document.encode_info(session.info)
        info = document.decode_info(text)
        other = database.other(info)
        if other is not None:
            _refuse_other_settings(other, info, database.location)
        known = database.find(info.name)
        if known is not None and not overwrite:
            if known.document == text:
                continue
            raise DatabaseError(
                f"{database.location}: holds another session named {info.name!r} already",
                hint="--force replaces it; --name gives this one another name",
            )
        if known is not None:
            _delete(database, known)
        label, number = info.provenance.label, database.new_id() if known is None else known.id
        building, floor = label.building or "", label.floor or ""
        _insert(database, "session", SESSION_COLUMNS, (building, number, floor, info.name, text))
        for part in PARTS:
            data = document.encode(part, getattr(session, part))
            _insert(database, "part", PART_COLUMNS, (building, number, part, data))


def _other_parts(database: SubmapDatabase, name: str) -> list[SessionRow]:
    """Return the other parts of the recording of a session, which are sessions of their own."""
    first = database.find(name)
    if first is None:
        return []
    digest = database.info(first).provenance.digest
    rows = database.rows("substr(name, 1, ?) = ?", len(name) + 1, f"{name}#")
    parts = [row for row in rows if is_part_of(row.name, name)]
    return [row for row in parts if database.info(row).provenance.digest == digest]


def _delete(database: SubmapDatabase, row: SessionRow) -> None:
    """Delete all rows of a session."""
    database.execute("DELETE FROM part WHERE building = ? AND session_id = ?", row.building, row.id)
    database.execute("DELETE FROM session WHERE building = ? AND id = ?", row.building, row.id)


def _insert(database: SubmapDatabase, table: str, columns: Sequence[str], values: Sequence[Any]) -> None:
    """Add a row with its checksum."""
    marks = ", ".join("?" * (len(columns) + 1))
    statement = f"INSERT INTO {table} ({', '.join(columns)}, crc32) VALUES ({marks})"
    database.execute(statement, *values, row_crc(values))


def _refuse_other_settings(known: SessionInfo, new: SessionInfo, location: str) -> None:
    """Refuse to store signatures that cannot be compared with those of the session `known`.

    All sessions of a database share the settings that shape signatures, and the resolution of the map.
    Raises DatabaseError naming the first setting that differs.
    """
    pairs = [
        (f"{section}.{key}", getattr(getattr(known.provenance.config, section), key), value)
        for section in ("signature", "partition")
        for key, value in getattr(new.provenance.config, section)
    ]
    pairs.append(("the map's resolution", known.resolution_m, new.resolution_m))
    for name, was, now in pairs:
        if was != now:
            raise DatabaseError(
                f"{location}: sessions made with {name} = {was!r} and with {now!r} cannot be compared",
                hint="use the same settings, or another database",
            )
