"""The two tables of a database, and what SQLite and PostgreSQL share of reading and writing their rows.

`session` has one row a session: its name, its label, its document. `array` has one row for each array of a
session. Every row ends with the crc32 of its other columns: no engine notices a flipped bit in a blob.
"""

from __future__ import annotations

import functools
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic import ValidationError

from pc2grid.errors import DatabaseError, DatabaseVersion
from signature.database import codec, stored, validation
from signature.database.protocol import BuildingFrame, Problem, SessionInfo
from signature.database.stored import PARTS, StoredSession

SESSION_COLUMNS = ("building", "id", "floor", "name", "document")
ARRAY_COLUMNS = ("building", "session_id", "name", "dtype", "shape", "data")
_SESSIONS = f"SELECT {', '.join(SESSION_COLUMNS)}, crc32 FROM session"
_ARRAYS = (
    f'SELECT {", ".join(ARRAY_COLUMNS)}, crc32 FROM "array" WHERE building = ? AND session_id = ?'
    " AND substr(name, 1, ?) = ?"
)
_NAMES = 'SELECT name FROM "array" WHERE building = ? AND session_id = ? ORDER BY name'
_ORPHANS = (
    'SELECT DISTINCT a.session_id FROM "array" a WHERE NOT EXISTS'
    " (SELECT 1 FROM session s WHERE s.building = a.building AND s.id = a.session_id) ORDER BY a.session_id"
)


def definitions(blob: str, number: str, *, session_key: str = "", array_key: str = "") -> dict[str, str]:
    """The statement that creates each table: table -> SQL.

    blob : the engine's type of bytes. number : its column of a session's number. session_key, array_key :
    what it adds to the two tables.
    """
    return {
        "session": f"CREATE TABLE session (building text NOT NULL, {number}, floor text NOT NULL,"
        f" name text NOT NULL UNIQUE, document text NOT NULL, crc32 bigint NOT NULL{session_key})",
        "array": 'CREATE TABLE "array" (building text NOT NULL, session_id bigint NOT NULL,'
        f" name text NOT NULL, dtype text NOT NULL, shape text NOT NULL, data {blob} NOT NULL,"
        f" crc32 bigint NOT NULL, PRIMARY KEY (building, session_id, name){array_key})",
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
    """The rows of a database through one connection."""

    for_update = ""
    """Ends a query whose rows nobody else may change until the transaction ends."""

    def __init__(self, location: str) -> None:
        """location : path or URL, for messages; never with a password."""
        self.location = location

    @abstractmethod
    def select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """The rows of a query with `?` for each value. Raises DatabaseCorrupt, DatabaseUnreachable."""

    @abstractmethod
    def execute(self, statement: str, *values: Any) -> None:
        """Change rows."""

    @abstractmethod
    def new_id(self) -> int:
        """A number for a further session, larger than all others."""

    # --- reading --------------------------------------------------------------------------------------

    def sessions(self, condition: str = "true", *values: Any, tail: str = "") -> Iterator[SessionRow]:
        """Rows of sessions in the order they were added. tail : what follows that in the statement."""
        for *row, crc in self.select(f"{_SESSIONS} WHERE {condition} ORDER BY id{tail}", *values):
            yield SessionRow._make((*row, codec.row_crc(row) == crc))

    def info(self, row: SessionRow) -> SessionInfo:
        """What the row of a session says.

        Raises DatabaseCorrupt, and DatabaseVersion for settings that this version does not know.
        """
        where = f"session {row.id}"
        if not row.sound:
            raise codec.DatabaseDamage(self.location, where, "wrong checksum")
        with codec.explained(self.location, where):
            filed = tuple(validation.text(getattr(row, name), name) for name in ("name", "building", "floor"))
            document = validation.text(row.document, "document")
            try:
                info = _info(document)
            except ValidationError as error:
                raise self._unknown_setting(row, json.loads(document)["info"], error) from None
            label = info.provenance.label
            if filed != (info.name, label.building or "", label.floor or ""):
                raise ValueError(f"filed as {', '.join(map(repr, filed))}, but is {info.name!r} of {label}")
            return info

    def part(self, row: SessionRow, part: str, others: Mapping[str, Any]) -> Any:
        """A part of a session (`signature.database.stored`). others : parts that it is compared with.

        Raises DatabaseCorrupt that names the array, or the part, and the session.
        """
        arrays = {}
        for name, array in self._arrays(row, part):
            if isinstance(array, codec.DatabaseDamage):
                raise array
            arrays[name] = array
        with codec.explained(self.location, f"{part} of session {row.name!r}"):
            return stored.decode(part, _content(row.document), arrays, others)

    def problems(self, row: SessionRow, parts: Sequence[str] = PARTS) -> Iterator[Problem]:
        """What is wrong with these parts of a session: each array, and each part that its arrays make."""
        known: dict[str, Any] = {}
        try:
            known["info"] = self.info(row)
        except codec.DatabaseDamage as error:
            yield error.problem
        except DatabaseVersion as error:
            yield Problem(f"session {row.id}", error.message)
        for part in parts[1:]:
            try:
                damaged = [
                    a.problem for _, a in self._arrays(row, part) if isinstance(a, codec.DatabaseDamage)
                ]
                yield from damaged
                if not damaged and "info" in known:
                    known[part] = self.part(row, part, known)
            except codec.DatabaseDamage as error:
                yield error.problem

    def strays(self, row: SessionRow) -> Iterator[Problem]:
        """Arrays that no part of a session has."""
        for (name,) in self.select(_NAMES, row.building, row.id):
            if str(name).partition(".")[0] not in PARTS[1:]:
                yield Problem(f"{name} of session {row.name!r}", "no part of a session")

    def count_submaps(self) -> int:
        """How many submaps all sessions have at most, by the bytes that are there."""
        statement = 'SELECT coalesce(sum(length(data)), 0) FROM "array" WHERE name = ?'
        ((size,),) = self.select(statement, "submaps.symmetry")
        return int(size) // 8

    def orphans(self) -> Iterator[Problem]:
        """Arrays without a session."""
        for (number,) in self.select(_ORPHANS):
            yield Problem(f"arrays of session {number}", "belong to no session")

    def _arrays(self, row: SessionRow, part: str) -> Iterator[tuple[str, codec.Array | codec.DatabaseDamage]]:
        """The arrays of a part by their names, or what is wrong with them."""
        for *values, crc in self.select(_ARRAYS, row.building, row.id, len(part) + 1, f"{part}."):
            _, _, name, *packed = values
            found: codec.Array | codec.DatabaseDamage
            try:
                with codec.explained(self.location, f"{name} of session {row.name!r}"):
                    if codec.row_crc(values) != crc:
                        raise ValueError("wrong checksum")
                    found = codec.unpack(codec.Packed(*packed))
            except codec.DatabaseDamage as error:
                found = error
            yield name, found

    def _unknown_setting(
        self, row: SessionRow, content: Mapping[str, Any], error: ValidationError
    ) -> DatabaseVersion:
        what = ".".join(map(str, error.errors()[0]["loc"]))
        made_by = content["provenance"]["versions"].get("pc2grid", "an unknown version")
        return DatabaseVersion(
            f"{self.location}: session {row.name!r} was made by pc2grid {made_by} with the setting {what},"
            " which this version does not understand",
            hint="convert the recording again, or use that version",
        )

    # --- writing: within a transaction ----------------------------------------------------------------

    def store(self, sessions: Iterable[StoredSession], *, force: bool) -> None:
        """Add sessions. One that is stored already is passed over.

        force : replace a session of the same name.

        Raises DatabaseError for a session of that name with other content, or with signatures that cannot be
        compared with those of the other sessions.
        """
        for session in sessions:
            document, arrays = stored.encode(session)
            info = _info(document)
            other = self.other(info)
            if other is not None:
                refuse_other_settings(other, info, self.location)
            known = self.find(info.name)
            if known is not None:
                # Where it lies in the building is no part of what was recorded.
                if not force and stored.with_frame(known.document, None) == stored.with_frame(document, None):
                    continue
                if not force:
                    raise DatabaseError(
                        f"{self.location}: holds another session named {info.name!r} already",
                        hint="--force replaces it; --name gives this one another name",
                    )
                self.delete(known)
            label, number = info.provenance.label, self.new_id() if known is None else known.id
            building, floor = label.building or "", label.floor or ""
            self._insert("session", SESSION_COLUMNS, (building, number, floor, info.name, document))
            for name, packed in arrays.items():
                self._insert('"array"', ARRAY_COLUMNS, (building, number, name, *packed))

    def remove(self, names: Sequence[str]) -> None:
        """Remove sessions. Raises DatabaseError for a name that no session has."""
        known = self._some_names()
        for name in dict.fromkeys(names):
            row = self.find(name)
            if row is None:
                raise no_session(name, known, self.location)
            self.delete(row)

    def rename(self, old: str, new: str) -> None:
        """Give a session another name. Raises DatabaseError if there is no session `old`, or one `new`."""
        new, row = stored.stored_name(new), self.find(old)
        if row is None:
            raise no_session(old, self._some_names(), self.location)
        if new != old and self.find(new) is not None:
            raise DatabaseError(
                f"{self.location}: holds a session {new!r} already", hint="choose another name"
            )
        self.info(row)
        content = json.loads(row.document)
        content["info"]["name"] = new
        self._update(row, new, codec.to_json(content))

    def place(self, frames: Mapping[str, BuildingFrame | None]) -> None:
        """Store where sessions lie in their building, by name; None: nowhere. Raises DatabaseError for a name
        that no session has."""
        for name, frame in frames.items():
            row = self.find(name)
            if row is None:
                raise no_session(name, self._some_names(), self.location)
            self._update(row, row.name, stored.with_frame(row.document, frame))

    def _update(self, row: SessionRow, name: str, document: str) -> None:
        """Give a session another name and document."""
        values = (row.building, row.id, row.floor, name, document)
        self.execute(
            "UPDATE session SET name = ?, document = ?, crc32 = ? WHERE building = ? AND id = ?",
            name, document, codec.row_crc(values), row.building, row.id,
        )  # fmt: skip

    def find(self, name: str) -> SessionRow | None:
        """The session of a name."""
        return next(self.sessions("name = ?", name, tail=self.for_update), None)

    def other(self, info: SessionInfo) -> SessionInfo | None:
        """Any session of another name; None if there is none."""
        row = next(self.sessions("name <> ?", info.name, tail=" LIMIT 1"), None)
        return None if row is None else self.info(row)

    def delete(self, row: SessionRow) -> None:
        """Delete all rows of a session."""
        self.execute('DELETE FROM "array" WHERE building = ? AND session_id = ?', row.building, row.id)
        self.execute("DELETE FROM session WHERE building = ? AND id = ?", row.building, row.id)

    def _some_names(self) -> list[str]:
        """Names of sessions for a message: a fleet has many."""
        return [name for (name,) in self.select("SELECT name FROM session ORDER BY id LIMIT 20")]

    def _insert(self, table: str, columns: Sequence[str], values: Sequence[Any]) -> None:
        """Add a row with its checksum."""
        marks = ", ".join("?" * (len(columns) + 1))
        statement = f"INSERT INTO {table} ({', '.join(columns)}, crc32) VALUES ({marks})"
        self.execute(statement, *values, codec.row_crc(values))


@functools.lru_cache(maxsize=256)
def _info(document: str) -> SessionInfo:
    """The description of a session in its document. Cached: every part that is read is compared with it."""
    info: SessionInfo = stored.decode("info", _content(document), {}, {})
    return info


@functools.lru_cache(maxsize=256)
def _content(document: str) -> Any:
    """A document, which must not be changed."""
    return json.loads(document)


def no_session(name: str, known: Iterable[str], location: str) -> DatabaseError:
    """The error for a session that a database does not hold."""
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
