"""The two tables of a database, and the reading and writing of their rows that SQLite and PostgreSQL share.

`session` has one row a session: its name, its label, its document. `part` has one row for each part of a
session. Every row ends with the crc32 of its other columns: no engine detects a flipped bit in a blob.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from pydantic import ValidationError
from typing_extensions import Self

from pc2grid.errors import DatabaseError, DatabaseVersion
from pc2grid.model import is_part_of
from signature.database import document
from signature.database.document import PARTS, DatabaseDamage, StoredSession, explained, row_crc
from signature.database.protocol import BuildingFrame, Location, Problem, SessionInfo

SESSION_COLUMNS = ("building", "id", "floor", "name", "document")
PART_COLUMNS = ("building", "session_id", "name", "data")
_SESSIONS = f"SELECT {', '.join(SESSION_COLUMNS)}, crc32 FROM session"
_PART = (
    f"SELECT {', '.join(PART_COLUMNS)}, crc32 FROM part WHERE building = ? AND session_id = ? AND name = ?"
)
_ORPHANS = (
    "SELECT DISTINCT p.session_id FROM part p WHERE NOT EXISTS"
    " (SELECT 1 FROM session s WHERE s.building = p.building AND s.id = p.session_id) ORDER BY p.session_id"
)


def definitions(blob: str, number: str, *, session_key: str = "", part_key: str = "") -> dict[str, str]:
    """Return the statement that creates each table: table -> SQL.

    blob : the engine's type of bytes. number : its column of a session's number. session_key, part_key : its
    additions to the two tables.
    """
    return {
        "session": f"CREATE TABLE session (building text NOT NULL, {number}, floor text NOT NULL,"
        f" name text NOT NULL UNIQUE, document text NOT NULL, crc32 bigint NOT NULL{session_key})",
        "part": "CREATE TABLE part (building text NOT NULL, session_id bigint NOT NULL, name text NOT NULL,"
        f" data {blob} NOT NULL, crc32 bigint NOT NULL, PRIMARY KEY (building, session_id, name){part_key})",
    }


class SessionRow(NamedTuple):
    """A row of the table `session`; sound: it matches its checksum."""

    building: str
    id: int
    floor: str
    name: str
    document: str
    sound: bool


class Rows(ABC):
    """The rows of a database through one connection.

    source : its path or URL. location : the same for messages, never with a password.
    """

    for_update = ""
    """Ends a query whose rows nobody else may change until the transaction ends."""

    def __init__(self, source: Location, location: str, connection: Any) -> None:
        self.source, self.location, self.connection = source, location, connection

    # --- what an engine does in its own way -----------------------------------------------------------

    @classmethod
    @abstractmethod
    def open(cls, place: Location, *, damaged: bool = False) -> Self:
        """Open the rows of a database for reading. damaged : in whatever state it is.

        Raises NotADatabase, DatabaseVersion, DatabaseCorrupt, DatabaseUnreachable.
        """

    @classmethod
    @abstractmethod
    def change(
        cls, place: Location, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """Change a database in one transaction, all or nothing.

        action : may be called again if another writer comes in between. keep : start from the present
        content; otherwise from nothing. create : make the database if there is none.

        Raises what `action` raises, as `open`, OutputError if it cannot be written, and DatabaseBusy.
        """

    @classmethod
    @abstractmethod
    def exists(cls, place: Location) -> bool:
        """Return True if there is anything that a change without `keep` would replace."""

    @abstractmethod
    def select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query with `?` for each value. Raises DatabaseCorrupt, DatabaseUnreachable."""

    @abstractmethod
    def execute(self, statement: str, *values: Any) -> None:
        """Change rows."""

    @abstractmethod
    def new_id(self) -> int:
        """Return a number for a further session, larger than all others."""

    def close(self) -> None:
        """Close the file or connection."""
        self.connection.close()

    def damaged_structure(self) -> Iterator[Problem]:
        """Yield the problems of the database itself."""
        return iter(())

    # --- reading --------------------------------------------------------------------------------------

    def sessions(self, condition: str = "true", *values: Any, tail: str = "") -> Iterator[SessionRow]:
        """Yield rows of sessions in the order they were added. tail : end of the statement.

        Raises DatabaseCorrupt where the order ends: a page of a file that refers back to earlier pages gives
        the same rows again and again, more than memory holds.
        """
        last = None
        for *values_, crc in self.select(f"{_SESSIONS} WHERE {condition} ORDER BY id{tail}", *values):
            row = SessionRow._make((*values_, row_crc(values_) == crc))
            if last is not None and row.id <= last:
                raise DatabaseDamage(self.location, f"session {row.id}", "comes twice")
            last = row.id
            yield row

    def info(self, row: SessionRow) -> SessionInfo:
        """Return the description of a session from its row.

        Raises DatabaseCorrupt, and DatabaseVersion for settings that this version does not know.
        """
        where = f"session {row.id}"
        if not row.sound:
            raise DatabaseDamage(self.location, where, "wrong checksum")
        with explained(self.location, where):
            try:
                info = document.decode_info(row.document)
            except ValidationError as error:
                first = error.errors()[0]["loc"]
                if first[:2] != ("provenance", "config"):
                    raise
                raise self._unknown_setting(row, ".".join(map(str, first[2:]))) from None
            label, filed = info.provenance.label, (row.name, row.building, row.floor)
            if filed != (info.name, label.building or "", label.floor or ""):
                raise ValueError(f"filed as {', '.join(map(repr, filed))}, but is {info.name!r} of {label}")
            return info

    def part(self, row: SessionRow, part: str, others: Mapping[str, Any]) -> Any:
        """Return a part of a session (`signature.database.document`). others : parts that it is compared
        with.

        Raises DatabaseCorrupt that names the part and the session.
        """
        found = next(self.select(_PART, row.building, row.id, part), None)
        with explained(self.location, f"{part} of session {row.name!r}"):
            if found is None:
                raise ValueError("is missing")
            *values, crc = found
            if row_crc(values) != crc:
                raise ValueError("wrong checksum")
            value = document.decode(part, values[-1])
            document.check(part, value, others)
            return value

    def problems(self, row: SessionRow, parts: Sequence[str] = PARTS) -> Iterator[Problem]:
        """Yield the problems of a session and of these parts of it."""
        known: dict[str, Any] = {}
        try:
            known["info"] = self.info(row)
            for part in parts:
                try:
                    known[part] = self.part(row, part, known)
                except DatabaseDamage as error:
                    yield error.problem
        except DatabaseDamage as error:
            yield error.problem
        except DatabaseVersion as error:
            yield Problem(f"session {row.id}", error.message)

    def all_problems(self) -> tuple[Problem, ...]:
        """Return the problems of the database, its sessions and their parts; as far as it can be read."""
        problems: list[Problem] = []
        try:
            problems += self.damaged_structure()
            for row in self.sessions():
                problems += self.problems(row)
            problems += self.orphans()
        except DatabaseDamage as error:
            problems.append(error.problem)
        return tuple(dict.fromkeys(problems))

    def orphans(self) -> Iterator[Problem]:
        """Yield parts without a session."""
        for (number,) in self.select(_ORPHANS):
            yield Problem(f"parts of session {number}", "belong to no session")

    def _unknown_setting(self, row: SessionRow, setting: str) -> DatabaseVersion:
        versions = json.loads(row.document)["provenance"]["versions"]
        return DatabaseVersion(
            f"{self.location}: session {row.name!r} was made by pc2grid"
            f" {versions.get('pc2grid', 'an unknown version')} with the setting {setting},"
            " which this version does not understand",
            hint="convert the recording again, or use that version",
        )

    # --- writing: within a transaction ----------------------------------------------------------------

    def store(self, sessions: Iterable[StoredSession], *, overwrite: bool) -> None:
        """Add sessions. One that is stored already is skipped.

        overwrite : replace a session of the same name.

        Raises DatabaseError for a session of that name with other content, or with signatures that cannot be
        compared with those of the other sessions.
        """
        for session in sessions:
            document.check("submaps", session.submaps, {"info": session.info, "grid": session.grid})
            text = document.encode_info(session.info)
            info = document.decode_info(text)
            other = self.other(info)
            if other is not None:
                refuse_other_settings(other, info, self.location)
            known = self.find(info.name)
            if known is not None and not overwrite:
                if known.document == text:
                    continue
                raise DatabaseError(
                    f"{self.location}: holds another session named {info.name!r} already",
                    hint="--force replaces it; --name gives this one another name",
                )
            if known is not None:
                self.delete(known)
            label, number = info.provenance.label, self.new_id() if known is None else known.id
            building, floor = label.building or "", label.floor or ""
            self._insert("session", SESSION_COLUMNS, (building, number, floor, info.name, text))
            for part in PARTS:
                data = document.encode(part, getattr(session, part))
                self._insert("part", PART_COLUMNS, (building, number, part, data))

    def other_parts(self, name: str) -> list[str]:
        """Return the other parts of the recording of a session, which are sessions of their own."""
        first = self.find(name)
        if first is None:
            return []
        digest = self.info(first).digest
        rows = self.sessions("substr(name, 1, ?) = ?", len(name) + 1, f"{name}#")
        return [row.name for row in rows if is_part_of(row.name, name) and self.info(row).digest == digest]

    def remove(self, names: Iterable[str]) -> None:
        """Remove sessions. Raises DatabaseError for a name that no session has."""
        for row in [self._found(name) for name in dict.fromkeys(names)]:
            self.delete(row)

    def rename(self, old: str, new: str) -> None:
        """Give a session another name. Raises DatabaseError if there is no session `old`, or one `new`."""
        new, row = document.stored_name(new), self._found(old)
        if new != old and self.find(new) is not None:
            raise DatabaseError(
                f"{self.location}: holds a session {new!r} already", hint="choose another name"
            )
        text = document.encode_info(replace(self.info(row), name=new))
        values = (row.building, row.id, row.floor, new, text)
        self.execute(
            "UPDATE session SET name = ?, document = ?, crc32 = ? WHERE building = ? AND id = ?",
            new, text, row_crc(values), row.building, row.id,
        )  # fmt: skip

    def store_frames(self, frames: Mapping[str, BuildingFrame | None]) -> None:
        """Store where sessions lie in their building, by name; None: nowhere.

        Raises DatabaseError for a name that no session has.
        """
        for name, frame in frames.items():
            row = self._found(name)
            where = row.building, row.id, "frame"
            self.execute("DELETE FROM part WHERE building = ? AND session_id = ? AND name = ?", *where)
            self._insert("part", PART_COLUMNS, (*where, document.encode("frame", frame)))

    def find(self, name: str) -> SessionRow | None:
        """Return the session of a name."""
        return next(self.sessions("name = ?", name, tail=self.for_update), None)

    def other(self, info: SessionInfo) -> SessionInfo | None:
        """Return any session of another name; None if there is none."""
        row = next(self.sessions("name <> ?", info.name, tail=" LIMIT 1"), None)
        return None if row is None else self.info(row)

    def delete(self, row: SessionRow) -> None:
        """Delete all rows of a session."""
        self.execute("DELETE FROM part WHERE building = ? AND session_id = ?", row.building, row.id)
        self.execute("DELETE FROM session WHERE building = ? AND id = ?", row.building, row.id)

    def _found(self, name: str) -> SessionRow:
        """Return the session of a name. Raises DatabaseError that names some of the others."""
        row = self.find(name)
        if row is None:
            known = [name for (name,) in self.select("SELECT name FROM session ORDER BY id LIMIT 20")]
            raise no_session(name, known, self.location)
        return row

    def _insert(self, table: str, columns: Sequence[str], values: Sequence[Any]) -> None:
        """Add a row with its checksum."""
        marks = ", ".join("?" * (len(columns) + 1))
        statement = f"INSERT INTO {table} ({', '.join(columns)}, crc32) VALUES ({marks})"
        self.execute(statement, *values, row_crc(values))


def no_session(name: str, known: Iterable[str], location: str) -> DatabaseError:
    """Return the error for a session that is not in a database."""
    there = ", ".join(map(repr, known)) or "none"
    return DatabaseError(f"{location}: no session {name!r}", hint=f"there are: {there}")


def refuse_other_settings(known: SessionInfo, new: SessionInfo, location: str) -> None:
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
