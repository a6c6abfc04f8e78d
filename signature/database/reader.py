"""What both engines do with a row that they have found: compare its checksum, decode it, name its damage."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any, TypeVar

from pc2grid.display import html_table, short
from pc2grid.errors import DatabaseError
from pc2grid.model import Loop, OccupancyGrid, PointMap, Submap, Trajectory
from signature.database import serialize, validation
from signature.database.protocol import Problem, SessionInfo
from signature.database.serialize import Row

if TYPE_CHECKING:
    import networkx as nx

    from signature.config import Config
    from signature.seen_places import SeenPlaces

T = TypeVar("T")


class RowReader(ABC):
    """The methods of `SubmapDatabase` that read single rows of a session."""

    @property
    @abstractmethod
    def location(self) -> str:
        """Path or URL, for messages."""

    @abstractmethod
    def config(self) -> Config:
        """The configuration that the sessions share."""

    @abstractmethod
    def _found(self, table: str, session: str, submap_id: int | None) -> tuple[Row, bool] | None:
        """The row of a session in a table, and whether it matches its checksum; None if there is none."""

    @abstractmethod
    def _sizes(self, session: str) -> validation.Sizes | None:
        """What the submaps, loops and graph of a session must fit; None if its grid or trajectory is lost.

        They are used before the checksums of the rows that they come from are compared.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the file or connection."""

    @abstractmethod
    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """All sessions, or those of `names`; see `SubmapDatabase.sessions`."""

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

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        return self._read("grid", session, lambda row, _: serialize.read_grid(row))

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame."""
        return self._read("trajectory", session, lambda row, _: serialize.read_trajectory(row))

    def loops(self, session: str) -> tuple[Loop, ...]:
        """The loops of a session; see `SubmapDatabase.loops`."""
        return self._read("loop", session, serialize.read_loops)

    def graph(self, session: str) -> nx.Graph:
        """The junction graph of a session; see `SubmapDatabase.graph`."""
        from pc2grid.submaps.junction_graph import junction_graph

        stored = self._read("graph", session, serialize.read_graph)
        return stored if len(stored) else junction_graph(self.grid(session), self.config().partition)

    def points(self, session: str) -> PointMap | None:
        """The points of a session in space; see `SubmapDatabase.points`."""
        return self._read("points", session, lambda row, _: serialize.read_points(row))

    def seen_places(self, session: str) -> SeenPlaces | None:
        """What is seen from the places of a session; see `SubmapDatabase.seen_places`."""
        return self._read("isovist", session, lambda row, _: serialize.read_isovists(row))

    def submap(self, session: str, submap_id: int) -> Submap:
        """One submap. Raises DatabaseError if the session has none of that number."""
        return self._read("submap", session, serialize.read_submap, int(submap_id))

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _read(
        self,
        table: str,
        session: str,
        decode: Callable[[Row, validation.Sizes | None], T],
        submap_id: int | None = None,
    ) -> T:
        """The decoded row of a session in a table; of the table `submap`, the row of one submap."""
        found = self._found(table, session, submap_id)
        if found is None and submap_id is not None:
            raise DatabaseError(f"{self.location}: session {session!r} has no submap {submap_id}")
        where = f"{table if submap_id is None else f'submap {submap_id}'} of session {session!r}"
        if found is None:
            raise serialize.corrupt(self.location, where, "missing")
        return self._decoded(*found, where, self._sizes(session), decode)

    def _decoded(
        self,
        row: Row,
        sound: bool,
        where: str,
        sizes: validation.Sizes | None,
        decode: Callable[[Row, validation.Sizes | None], T],
    ) -> T:
        if not sound:
            raise serialize.corrupt(self.location, where, "wrong checksum")
        with serialize.explained(self.location, where):
            return decode(row, sizes)


def damage_of(
    table: str,
    row: Row,
    sound: bool,
    sizes: validation.Sizes | None,
    read_signatures: Callable[[Row], object],
) -> Problem | None:
    """What is wrong with a row: it must match its checksum, and be decoded.

    read_signatures : decodes a row of the table `signature`, which each engine arranges in its own way.
    """
    session_id = row["id"] if table == "session" else row["session_id"]
    number = f"{row['submap_id']} of session {session_id}" if "center_x_m" in row else str(session_id)
    try:
        if not sound:
            raise ValueError("wrong checksum")
        if table == "signature":
            read_signatures(row)
        else:
            serialize.decode(table, row, sizes)
    except Exception as error:
        # Decoding damaged content may raise anything, and whatever it raises is the finding.
        return Problem(f"{table} {number}", str(error))
    return None
