"""The submap database as its users see it, and what SQLite and PostgreSQL share of reading it.

A database has two tables. `session` has one row a session: its name, its label, its document. `part` has one
row for each part of a session. Every row ends with the crc32 of its other columns: no engine detects a
flipped bit in a blob. An engine is a subclass; `signature.database.maintenance` writes.
"""

from __future__ import annotations

import contextlib
import json
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from pydantic import ValidationError
from typing_extensions import Self

from pc2grid.display import html_table, short
from pc2grid.errors import DatabaseCorrupt, DatabaseError, DatabaseVersion
from pc2grid.model import Loop, OccupancyGrid, PointMap, Submap, Trajectory
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid.submaps.submaps import view_at
from signature.config import Config
from signature.database import document
from signature.database.document import (
    PARTS,
    DatabaseDamage,
    StoredSession,
    explained,
    row_crc,
)
from signature.database.protocol import BuildingFrame, Label, Location, Problem, SessionInfo
from signature.paper import SignatureTable
from signature.visible import SeenPlaces

if TYPE_CHECKING:
    import networkx as nx

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


class SubmapDatabase(contextlib.AbstractContextManager["SubmapDatabase"]):
    """Sessions and their submaps, to be read.

    A handle shows the database as it was when it was opened.
    (A server keeps deleted rows for it, so services should open a new handle now and then.)

    Every read raises DatabaseCorrupt if a row does not match its checksum, or has impossible content.

    location : the path or URL, for messages; never with a password.
    """

    for_update = ""
    """Ends a query for the row of a session, which nobody else may change until the transaction ends."""

    def __init__(self, location: str, connection: Any, *, damaged: bool = False) -> None:
        """Read through one connection. damaged : know only the sessions whose own row can be read."""
        self.location, self.connection, self._damaged = location, connection, damaged
        self._left_out: set[int] = set()
        self._labelled: dict[str, str] = {}

    # --- what an engine does in its own way -----------------------------------------------------------

    @classmethod
    @abstractmethod
    def open(cls, place: Location, *, damaged: bool = False) -> Self:
        """Open a database for reading. damaged : in whatever state it is.

        Raises NotADatabase, DatabaseVersion, DatabaseCorrupt, DatabaseUnreachable.
        """

    @classmethod
    @abstractmethod
    def change(
        cls,
        place: Location,
        action: Callable[[SubmapDatabase], None],
        *,
        keep: bool = True,
        create: bool = False,
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
    def _select(self, statement: str, *values: Any) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query with `?` for each value. Raises DatabaseCorrupt, DatabaseUnreachable."""

    @abstractmethod
    def execute(self, statement: str, *values: Any) -> None:
        """Change rows."""

    @abstractmethod
    def new_id(self) -> int:
        """Return a number for a further session, larger than all others."""

    def _damaged_structure(self) -> Iterator[Problem]:
        """Yield the problems of the database itself."""
        return iter(())

    # --- what is in it --------------------------------------------------------------------------------

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close the file or connection."""
        self.connection.close()

    def __repr__(self) -> str:
        # Without its sessions: the database may be closed, damaged, or on a server that is away.
        return f"SubmapDatabase({short(self.location, 120)})"

    def _repr_html_(self) -> str:
        rows = [
            (
                info.name,
                info.provenance.label,
                info.sensor,
                f"{info.path_m:.1f}",
                f"{info.area_m2:.0f}",
                info.submaps,
            )
            for info in self.sessions()
        ]
        head = ("session", "label", "sensor", "driven, m", "free, m2", "submaps")
        return html_table(self.location, rows, head)

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """Return all sessions, or those of `names`, in the order they were added."""
        if names is None:
            return tuple(map(self.info, self._known()))
        marks = ", ".join("?" * len(names)) or "NULL"
        return tuple(map(self.info, self._known(f"name IN ({marks})", *names)))

    def session(self, name: str) -> SessionInfo:
        """Return the session of a name. Raises DatabaseError if there is none."""
        return self.info(self.row(name))

    def config(self) -> Config:
        """Return the configuration of the first session; all sessions share its signature and partition
        settings.

        It is the default configuration if there is no session.
        """
        first = next(self._known(), None)
        return Config() if first is None else self.info(first).provenance.config

    def signatures(self, session: str | None = None) -> SignatureTable:
        """Return all signatures, or those of one session; `session_index` counts in the order of
        `sessions()`."""
        config, tables = self.config(), list[SignatureTable]()
        for index, row in enumerate(self._known()):
            if session not in (None, row.name):
                continue
            part = self._part(row, "submaps", {"info": self.info(row)})
            if not len(part):
                continue
            with explained(self.location, f"submaps of session {row.name!r}"):
                document.check_bins(part, config)
            tables.append(replace(part, session_index=np.full(len(part), index, np.int32)))
        if session is not None and not tables:
            self.row(session)
        return SignatureTable.concatenated(tables or [SignatureTable.of((), np.empty((0, 2)))])

    def grid(self, session: str) -> OccupancyGrid:
        """Return the whole occupancy grid of a session."""
        return cast("OccupancyGrid", self._parts(session, "grid")["grid"])

    def trajectory(self, session: str) -> Trajectory:
        """Return the poses of the base in the session's map frame; empty for an imported map."""
        return cast("Trajectory", self._parts(session, "trajectory")["trajectory"])

    def loops(self, session: str) -> tuple[Loop, ...]:
        """Return the loops of a session; their `older` and `newer` are indices of poses of its trajectory."""
        return cast("tuple[Loop, ...]", self._parts(session, "loops")["loops"])

    def graph(self, session: str) -> nx.Graph:
        """Return the junction graph of a session's free space (`pc2grid.submaps.junction_graph`)."""
        found = self._parts(session, "grid")
        return junction_graph(found["grid"], found["info"].provenance.config.partition)

    def points(self, session: str) -> PointMap | None:
        """Return the points of a session in space; None if none were stored."""
        return cast("PointMap | None", self._parts(session, "points")["points"])

    def seen_places(self, session: str) -> SeenPlaces:
        """Return the visible surroundings of the centre of each submap of a session, by id."""
        return cast("SeenPlaces", self._parts(session, "seen")["seen"])

    def frame(self, session: str) -> BuildingFrame | None:
        """Return the place of a session in its building; None if it was not joined with another one."""
        return cast("BuildingFrame | None", self._parts(session, "frame")["frame"])

    def frames(self) -> dict[str, BuildingFrame]:
        """Return the places of all sessions that were joined, by name."""
        found = ((row.name, self._part(row, "frame", {"info": self.info(row)})) for row in self._known())
        return {name: frame for name, frame in found if frame is not None}

    def submaps(self, session: str) -> Iterator[Submap]:
        """Yield all submaps of a session, by id, cut from its grid."""
        parts = self._parts(session, "grid", "submaps")
        submaps, config = parts["submaps"], parts["info"].provenance.config
        for number, (x, y) in zip(submaps.submap_id.tolist(), submaps.center_m.tolist(), strict=True):
            yield view_at(parts["grid"], (x, y), config.partition, submap_id=number)

    def stored(self, session: str, *, recover: bool = False) -> StoredSession:
        """Return everything that is stored of a session.

        recover : without damaged parts that can be lost (`signature.database.document.completed`).
        """
        row = self.row(session)
        parts: dict[str, Any] = {"info": self.info(row)}
        for part in PARTS:
            with contextlib.suppress(*[DatabaseCorrupt] if recover and part in document.RECOVERED else []):
                parts[part] = self._part(row, part, parts)
        return document.completed(parts)

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """Restrict this handle to the sessions of a building and floor; None: any, "": not labelled.

        Raises DatabaseError if there are none.
        """
        wanted = {"building": building, "floor": floor}
        self._labelled = {column: word for column, word in wanted.items() if word is not None}
        if next(self._known(), None) is None:
            self._labelled = {}
            found = self._select("SELECT DISTINCT building, floor FROM session ORDER BY 1, 2 LIMIT 20")
            labels = "; ".join(str(Label(building=b or None, floor=f or None)) for b, f in found)
            raise DatabaseError(
                f"{self.location}: no session of {Label(building=building, floor=floor)}",
                hint=f"there are: {labels or 'no session'}",
            )

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """Leave out, from now on, the sessions that cannot be searched because they are damaged.

        Returns the problem of each of them; damage to parts that a search does not need is not searched for.
        Raises DatabaseCorrupt if none is left, or if the database itself cannot be read.
        """
        damaged = {
            row.id: problem
            for row in self._known()
            for problem in [next(self._problems(row, document.SEARCHED), None)]
            if problem is not None
        }
        self._left_out |= damaged.keys()
        problems = (*damaged.values(), *self._orphans())
        if problems and next(self._known(), None) is None:
            raise DatabaseDamage(self.location, problems[0].where, problems[0].what)
        return problems

    # --- rows and parts -------------------------------------------------------------------------------

    def _known(self, condition: str = "true", *values: Any, tail: str = "") -> Iterator[SessionRow]:
        """Yield the rows of the known sessions, in SQL restricted to their building: a fleet has too many of
        all."""
        for column, word in self._labelled.items():
            condition, values = f"{condition} AND {column} = ?", (*values, word)
        with contextlib.suppress(*[DatabaseCorrupt] if self._damaged else []):
            for row in self.rows(condition, *values, tail=tail):
                unreadable = self._damaged and next(self._problems(row, ()), None) is not None
                if row.id not in self._left_out and not unreadable:
                    yield row

    def find(self, session: str) -> SessionRow | None:
        """Return the row of the session of a name; None if there is none."""
        return next(self._known("name = ?", session, tail=self.for_update), None)

    def row(self, session: str) -> SessionRow:
        """Return the row of the session of a name. Raises DatabaseError that names some of the others."""
        row = self.find(session)
        if row is None:
            raise no_session(session, [known.name for known in self._known()][:20], self.location)
        return row

    def _parts(self, session: str, *parts: str) -> dict[str, Any]:
        """Return the info and these parts of a session, each compared with those before it."""
        row = self.row(session)
        found: dict[str, Any] = {"info": self.info(row)}
        for part in parts:
            found[part] = self._part(row, part, found)
        return found

    def rows(self, condition: str = "true", *values: Any, tail: str = "") -> Iterator[SessionRow]:
        """Yield rows of sessions in the order they were added. tail : end of the statement.

        Raises DatabaseCorrupt where the order ends: a page of a file that refers back to earlier pages gives
        the same rows again and again, more than memory holds.
        """
        last = None
        for *values_, crc in self._select(f"{_SESSIONS} WHERE {condition} ORDER BY id{tail}", *values):
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
                setting = ".".join(map(str, first[2:]))
                versions = json.loads(row.document)["provenance"]["versions"]
                raise DatabaseVersion(
                    f"{self.location}: session {row.name!r} was made by pc2grid"
                    f" {versions.get('pc2grid', 'an unknown version')} with the setting {setting},"
                    " which this version does not understand",
                    hint="convert the recording again, or use that version",
                ) from None
            label, filed = info.provenance.label, (row.name, row.building, row.floor)
            if filed != (info.name, label.building or "", label.floor or ""):
                raise ValueError(f"filed as {', '.join(map(repr, filed))}, but is {info.name!r} of {label}")
            return info

    def _part(self, row: SessionRow, part: str, others: Mapping[str, Any]) -> Any:
        """Return a part of a session (`signature.database.document`). others : parts that it is compared
        with.

        Raises DatabaseCorrupt that names the part and the session.
        """
        found = next(self._select(_PART, row.building, row.id, part), None)
        with explained(self.location, f"{part} of session {row.name!r}"):
            if found is None:
                raise ValueError("is missing")
            *values, crc = found
            if row_crc(values) != crc:
                raise ValueError("wrong checksum")
            value = document.decode(part, values[-1])
            document.check(part, value, others)
            return value

    def _problems(self, row: SessionRow, parts: Sequence[str] = PARTS) -> Iterator[Problem]:
        """Yield the problems of a session and of these parts of it."""
        known: dict[str, Any] = {}
        try:
            known["info"] = self.info(row)
            for part in parts:
                try:
                    known[part] = self._part(row, part, known)
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
            problems += self._damaged_structure()
            for row in self.rows():
                problems += self._problems(row)
            problems += self._orphans()
        except DatabaseDamage as error:
            problems.append(error.problem)
        return tuple(dict.fromkeys(problems))

    def other(self, info: SessionInfo) -> SessionInfo | None:
        """Return any session of another name; None if there is none."""
        row = next(self.rows("name <> ?", info.name, tail=" LIMIT 1"), None)
        return None if row is None else self.info(row)

    def _orphans(self) -> Iterator[Problem]:
        """Yield parts without a session."""
        for (number,) in self._select(_ORPHANS):
            yield Problem(f"parts of session {number}", "belong to no session")


def no_session(name: str, known: Iterable[str], location: str) -> DatabaseError:
    """Return the error for a session that is not in a database."""
    there = ", ".join(map(repr, known)) or "none"
    return DatabaseError(f"{location}: no session {name!r}", hint=f"there are: {there}")
