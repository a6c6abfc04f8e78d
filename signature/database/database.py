"""The submap database as its users see it, over the rows of either engine (`signature.database.rows`)."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.display import html_table, short
from pc2grid.errors import DatabaseCorrupt, DatabaseError
from pc2grid.model import Loop, OccupancyGrid, PointMap, SessionMap, Submap, Trajectory
from pc2grid.submaps.junction_graph import graph_from_arrays
from pc2grid.submaps.partition import view_at
from signature.config import Config
from signature.database import document, validation
from signature.database.arrays import DatabaseDamage, explained
from signature.database.document import PARTS, StoredSession, SubmapArrays, stored_session
from signature.database.protocol import (
    BuildingFrame,
    Place,
    Problem,
    Provenance,
    SessionInfo,
    none_there,
)
from signature.database.rows import Rows, SessionRow, no_session
from signature.similarity import SignatureTable

if TYPE_CHECKING:
    import networkx as nx
    from typing_extensions import Self

    from signature.describe import Signature
    from signature.seen_places import SeenPlaces


class SubmapDatabase(ABC):
    """Sessions and their submaps. Reading never changes it; `add` changes all or nothing.

    Every read raises DatabaseCorrupt where a row does not match its checksum, or says what cannot be.
    """

    def __init__(self, place: Place, rows: Rows, *, writable: bool, damaged: bool) -> None:
        self._place, self._rows, self._writable, self._damaged = place, rows, writable, damaged
        self._left_out: set[int] = set()

    # --- what an engine does in its own way -----------------------------------------------------------

    @classmethod
    @abstractmethod
    def open(cls, place: Place, *, writable: bool = False, damaged: bool = False) -> Self:
        """Open what is there; see `signature.database.open_database`.

        damaged : open it in whatever state it is, and know only the sessions whose own row can be read.
        """

    @classmethod
    @abstractmethod
    def change(
        cls, place: Place, action: Callable[[Rows], None], *, keep: bool = True, create: bool = False
    ) -> None:
        """Change a database in one transaction, all or nothing.

        action : may be called again if another writer comes in between. keep : start from what is there;
        otherwise from nothing. create : make the database if there is none.

        Raises what `action` raises, as `open`, OutputError if it cannot be written, and DatabaseBusy.
        """

    @classmethod
    @abstractmethod
    def exists(cls, place: Place) -> bool:
        """Whether there is anything that a change without `keep` would replace."""

    @classmethod
    @abstractmethod
    def problems_of(cls, place: Place) -> tuple[Problem, ...]:
        """All damage of what is there. Raises NotADatabase or DatabaseVersion if it is no database."""

    @abstractmethod
    def _renew(self) -> None:
        """See the database as it is now."""

    @abstractmethod
    def close(self) -> None:
        """Close the file or connection."""

    # --- what is in it --------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

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
        """Path or URL, for messages; never with a password."""
        return self._rows.location

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """All sessions, or those of `names`, in the order they were added."""
        if names is None:
            return tuple(map(self._rows.info, self._known()))
        marks = ", ".join("?" * len(names)) or "NULL"
        return tuple(map(self._rows.info, self._known(f"name IN ({marks})", *names)))

    def config(self) -> Config:
        """The configuration of the first session, whose signature and partition settings all sessions share.

        The default configuration if there is no session.
        """
        first = next(self._known(), None)
        return Config() if first is None else self._rows.info(first).provenance.config

    def signatures(self, session: str | None = None) -> SignatureTable:
        """All signatures, or those of one session; `session_index` counts in the order of `sessions()`."""
        config, tables = self.config(), list[SignatureTable]()
        for index, row in enumerate(self._known()):
            if session not in (None, row.name):
                continue
            part = self._rows.part(row, "submaps", {"info": self._rows.info(row)})
            if not len(part):
                continue
            with explained(self.location, f"submaps of session {row.name!r}"):
                validation.check_bins(part.boundary.shape[1], part.freespace.shape[1], config)
            columns = {field.name: getattr(part, field.name) for field in fields(SubmapArrays)}
            tables.append(SignatureTable(session_index=np.full(len(part), index, np.int32), **columns))
        if session is not None and not tables:
            self._row(session)
        return SignatureTable.concatenated(tables or [SignatureTable.of((), np.empty((0, 2)))])

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        grid: OccupancyGrid = self._parts(session, "grid")["grid"]
        return grid

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame; empty for an imported map."""
        trajectory: Trajectory = self._parts(session, "trajectory")["trajectory"]
        return trajectory

    def loops(self, session: str) -> tuple[Loop, ...]:
        """The loops of a session; their `older` and `newer` are indices of poses of its trajectory."""
        loops: tuple[Loop, ...] = self._parts(session, "loops")["loops"]
        return loops

    def graph(self, session: str) -> nx.Graph:
        """The junction graph of a session's free space (`pc2grid.submaps.junction_graph`)."""
        return graph_from_arrays(self._parts(session, "grid", "graph")["graph"])

    def points(self, session: str) -> PointMap | None:
        """The points of a session in space; None if none were stored."""
        points: PointMap | None = self._parts(session, "points")["points"]
        return points

    def seen_places(self, session: str) -> SeenPlaces:
        """What is seen from the centre of each submap of a session, by id."""
        seen: SeenPlaces = self._parts(session, "seen")["seen"]
        return seen

    def frame(self, session: str) -> BuildingFrame | None:
        """Where a session lies in the frame of its building; None if it was not joined with another one."""
        frame: BuildingFrame | None = self._parts(session, "frame")["frame"]
        return frame

    def frames(self) -> dict[str, BuildingFrame]:
        """The same of all sessions that were joined, by name."""
        found = (
            (row.name, self._rows.part(row, "frame", {"info": self._rows.info(row)})) for row in self._known()
        )
        return {name: frame for name, frame in found if frame is not None}

    def submap(self, session: str, submap_id: int) -> Submap:
        """One submap. Raises DatabaseError if the session has none of that number."""
        found = next(self._cut(session, submap_id), None)
        if found is None:
            raise DatabaseError(f"{self.location}: session {session!r} has no submap {submap_id}")
        return found

    def submaps(self, session: str) -> Iterable[Submap]:
        """All submaps of a session, by id."""
        return self._cut(session)

    def stored(self, session: str, *, recover: bool = False) -> StoredSession:
        """Everything that is stored of a session.

        recover : without what is damaged and can be lost (`signature.database.document.completed`).
        """
        row = self._row(session)
        parts: dict[str, Any] = {"info": self._rows.info(row)}
        for part in PARTS:
            with contextlib.suppress(*[DatabaseCorrupt] if recover and part in document.RECOVERED else []):
                parts[part] = self._rows.part(row, part, parts)
        return document.completed(parts)

    def add(
        self,
        session_map: SessionMap,
        signatures: Sequence[Signature],
        provenance: Provenance,
        *,
        overwrite: bool = False,
    ) -> None:
        """Store a session in one transaction. The same session again changes nothing; another one of the
        same name is refused with DatabaseError, or replaced with `overwrite`.

        Of the submaps their centres are stored: they are cut from the map again, with the settings of
        `provenance`. Raises ValueError for submaps and signatures of other sizes than these settings make.
        """
        if not self._writable:
            raise DatabaseError(f"{self.location}: opened for reading only")
        session = stored_session((session_map, signatures, provenance))
        try:
            self.change(self._place, lambda rows: rows.store([session], overwrite=overwrite))
        finally:
            self._renew()

    def check(self) -> tuple[Problem, ...]:
        """All damage; empty if there is none."""
        return self.problems_of(self._place)

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only the sessions of this building and floor; None: any.

        Raises DatabaseError if there are none.
        """
        labels, others = [], set()
        for row in self._known():
            with contextlib.suppress(DatabaseCorrupt):  # it stays, so that leave_out_damaged() reports it
                label = self._rows.info(row).provenance.label
                labels.append(label)
                others |= set() if label.fits(building, floor) else {row.id}
        if len(others) == len(labels):
            raise none_there(self.location, building, floor, labels)
        self._left_out |= others

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, leave out the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them; damage to what a search can do without is not looked for.
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

    def _damaged_rows(self) -> Iterator[Problem]:
        """What is wrong with the rows of all sessions."""
        for row in self._all():
            yield from self._rows.problems(row)
        yield from self._rows.orphans()

    def _all(self, condition: str = "true", *values: Any) -> Iterator[SessionRow]:
        """The rows of all sessions."""
        return self._rows.sessions(condition, *values)

    def _known(self, condition: str = "true", *values: Any) -> Iterator[SessionRow]:
        """The rows of the sessions that are known."""
        with contextlib.suppress(*[DatabaseCorrupt] if self._damaged else []):
            for row in self._all(condition, *values):
                unreadable = self._damaged and next(self._rows.problems(row, ()), None) is not None
                if row.id not in self._left_out and not unreadable:
                    yield row

    def _row(self, session: str) -> SessionRow:
        row = next(self._known("name = ?", session), None)
        if row is None:
            raise no_session(session, [known.name for known in self._known()][:20], self.location)
        return row

    def _parts(self, session: str, *parts: str) -> dict[str, Any]:
        """The info and these parts of a session, each compared with those before it."""
        row = self._row(session)
        found: dict[str, Any] = {"info": self._rows.info(row)}
        for part in parts:
            found[part] = self._rows.part(row, part, found)
        return found

    def _cut(self, session: str, submap_id: int | None = None) -> Iterator[Submap]:
        """The submaps of a session, or that of a number, cut from its grid."""
        parts = self._parts(session, "grid", "submaps")
        submaps, config = parts["submaps"], parts["info"].provenance.config
        for number, (x, y) in zip(submaps.submap_id.tolist(), submaps.center_m.tolist(), strict=True):
            if submap_id in (None, number):
                yield view_at(parts["grid"], (x, y), config.partition, submap_id=number)
