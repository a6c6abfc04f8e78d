"""The submap database as its users see it, over the rows of either engine (`signature.database.rows`)."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from dataclasses import fields
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from pc2grid.display import html_table, short
from pc2grid.errors import DatabaseCorrupt, DatabaseError
from pc2grid.model import Loop, OccupancyGrid, PointMap, Submap, Trajectory
from pc2grid.submaps.junction_graph import junction_graph
from pc2grid.submaps.submaps import view_at
from signature.config import Config
from signature.database import document
from signature.database.document import (
    PARTS,
    DatabaseDamage,
    StoredSession,
    SubmapArrays,
    explained,
)
from signature.database.protocol import BuildingFrame, Label, Problem, SessionInfo
from signature.database.rows import Rows, SessionRow, no_session
from signature.paper import SignatureTable
from signature.visible import SeenPlaces

if TYPE_CHECKING:
    import networkx as nx


class SubmapDatabase(contextlib.AbstractContextManager["SubmapDatabase"]):
    """Sessions and their submaps, to be read.

    A handle shows the database as it was when it was opened.
    (A server keeps deleted rows for it, so services should open a new handle now and then.)

    Every read raises DatabaseCorrupt if a row does not match its checksum, or has impossible content.
    """

    def __init__(self, rows: Rows, *, damaged: bool = False) -> None:
        """Wrap the rows of an engine. damaged : know only the sessions whose own row can be read."""
        self._rows, self._damaged = rows, damaged
        self._left_out: set[int] = set()
        self._labelled: dict[str, str] = {}

    # --- what is in it --------------------------------------------------------------------------------

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close the file or connection."""
        self._rows.close()

    def __repr__(self) -> str:
        # Without its sessions: the database may be closed, damaged, or on a server that is away.
        return f"{type(self).__name__}({short(self.location, 120)})"

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

    @property
    def location(self) -> str:
        """Return the path or URL, for messages; never with a password."""
        return self._rows.location

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """Return all sessions, or those of `names`, in the order they were added."""
        if names is None:
            return tuple(map(self._rows.info, self._known()))
        marks = ", ".join("?" * len(names)) or "NULL"
        return tuple(map(self._rows.info, self._known(f"name IN ({marks})", *names)))

    def session(self, name: str) -> SessionInfo:
        """Return the session of a name. Raises DatabaseError if there is none."""
        return self._rows.info(self._row(name))

    def config(self) -> Config:
        """Return the configuration of the first session; all sessions share its signature and partition
        settings.

        It is the default configuration if there is no session.
        """
        first = next(self._known(), None)
        return Config() if first is None else self._rows.info(first).provenance.config

    def signatures(self, session: str | None = None) -> SignatureTable:
        """Return all signatures, or those of one session; `session_index` counts in the order of
        `sessions()`."""
        config, tables = self.config(), list[SignatureTable]()
        for index, row in enumerate(self._known()):
            if session not in (None, row.name):
                continue
            part = self._rows.part(row, "submaps", {"info": self._rows.info(row)})
            if not len(part):
                continue
            with explained(self.location, f"submaps of session {row.name!r}"):
                document.check_bins(part, config)
            columns = {field.name: getattr(part, field.name) for field in fields(SubmapArrays)}
            tables.append(SignatureTable(session_index=np.full(len(part), index, np.int32), **columns))
        if session is not None and not tables:
            self._row(session)
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
        found = (
            (row.name, self._rows.part(row, "frame", {"info": self._rows.info(row)})) for row in self._known()
        )
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
        row = self._row(session)
        parts: dict[str, Any] = {"info": self._rows.info(row)}
        for part in PARTS:
            with contextlib.suppress(*[DatabaseCorrupt] if recover and part in document.RECOVERED else []):
                parts[part] = self._rows.part(row, part, parts)
        return document.completed(parts)

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """Restrict this handle to the sessions of a building and floor; None: any, "": not labelled.

        Raises DatabaseError if there are none.
        """
        wanted = {"building": building, "floor": floor}
        self._labelled = {column: word for column, word in wanted.items() if word is not None}
        if next(self._known(), None) is None:
            self._labelled = {}
            found = self._rows.select("SELECT DISTINCT building, floor FROM session ORDER BY 1, 2 LIMIT 20")
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
            for problem in [next(self._rows.problems(row, document.SEARCHED), None)]
            if problem is not None
        }
        self._left_out |= damaged.keys()
        problems = (*damaged.values(), *self._rows.orphans())
        if problems and next(self._known(), None) is None:
            raise DatabaseDamage(self.location, problems[0].where, problems[0].what)
        return problems

    # --- rows and parts -------------------------------------------------------------------------------

    def _known(self, condition: str = "true", *values: Any) -> Iterator[SessionRow]:
        """Yield the rows of the known sessions, in SQL restricted to their building: a fleet has too many of
        all."""
        for column, word in self._labelled.items():
            condition, values = f"{condition} AND {column} = ?", (*values, word)
        with contextlib.suppress(*[DatabaseCorrupt] if self._damaged else []):
            for row in self._rows.sessions(condition, *values):
                unreadable = self._damaged and next(self._rows.problems(row, ()), None) is not None
                if row.id not in self._left_out and not unreadable:
                    yield row

    def _row(self, session: str) -> SessionRow:
        row = next(self._known("name = ?", session), None)
        if row is None:
            raise no_session(session, [known.name for known in self._known()][:20], self.location)
        return row

    def _parts(self, session: str, *parts: str) -> dict[str, Any]:
        """Return the info and these parts of a session, each compared with those before it."""
        row = self._row(session)
        found: dict[str, Any] = {"info": self._rows.info(row)}
        for part in parts:
            found[part] = self._rows.part(row, part, found)
        return found
