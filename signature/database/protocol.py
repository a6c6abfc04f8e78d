"""What every engine of the submap database promises."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from pc2grid.errors import DatabaseError
from pc2grid.model import Loop, OccupancyGrid, ReadReport, SessionMap, Submap, Trajectory

if TYPE_CHECKING:
    from signature.config import Config
    from signature.describe import Signature
    from signature.similarity import SignatureTable


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """Where a session was recorded, in the user's words; None: not said."""

    building: str | None = None
    floor: str | None = None

    def __str__(self) -> str:
        return ", ".join(word for word in (self.building, self.floor) if word) or "no label"

    def fits(self, building: str | None, floor: str | None) -> bool:
        """Whether it is this building and floor; None: any, "": not said."""
        return building in (None, self.building or "") and floor in (None, self.floor or "")

    def contradicts(self, other: Label) -> bool:
        """Whether the two name different buildings, or different floors; what was not said rules nothing
        out."""
        pairs = ((self.building, other.building), (self.floor, other.floor))
        return any(a is not None and b is not None and a != b for a, b in pairs)


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """What made a session: enough to make it again. Holds no clock, so equal inputs give equal bytes.

    source : file name of the recording or map (no folder: databases travel).
    digest : sha256 of the recording, hex.
    config : the whole effective configuration.
    start_s, duration_s : which part of the recording, seconds from its start; duration None: to the end.
    versions : program and library -> version.
    label : building and floor.
    """

    source: str
    digest: str
    config: Config
    start_s: float = 0.0
    duration_s: float | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    label: Label = Label()


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionInfo:
    """A session as `db info` shows it.

    name : unique within the database.
    sensor : kind that made it, or "map".
    submaps : how many.
    area_m2 : free space in its grid.
    path_m : distance driven; 0 for an imported map.
    duration_s : time between first and last pose.
    scans : poses in its trajectory.
    report : what was read, and lost on the way.
    """

    name: str
    sensor: str
    digest: str
    submaps: int
    resolution_m: float
    area_m2: float
    path_m: float
    duration_s: float
    scans: int
    report: ReadReport
    provenance: Provenance

    @property
    def warnings(self) -> tuple[str, ...]:
        """What reading and mapping had to say."""
        return self.report.warnings

    @property
    def lossy(self) -> bool:
        """Whether data was lost on the way."""
        return self.report.lossy


def none_there(where: str, building: str | None, floor: str | None, labels: Sequence[Label]) -> DatabaseError:
    """The error for a building or floor that no session of a database has."""
    wanted = Label(building=building, floor=floor)
    there = "; ".join(sorted({str(label) for label in labels})[:20]) or "no session"
    return DatabaseError(f"{where}: no session of {wanted}", hint=f"there are: {there}")


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that `check` found: where (table and session) and what."""

    where: str
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbour:
    """A submap that looks like a query.

    center_m : (x, y) in the map frame of its session. score : Eq. 6, smaller is more alike.
    """

    session: str
    submap_id: int
    center_m: tuple[float, float]
    score: float


Entry = tuple[SessionMap, "Sequence[Signature]", Provenance]
"""All there is to store of one session."""


class SubmapDatabase(Protocol):
    """Sessions and their submaps. Reading never changes it; `add` changes all or nothing.

    Every read raises DatabaseCorrupt where a row does not match its checksum.
    """

    @property
    def location(self) -> str:
        """Path or URL, for messages."""
        ...

    def sessions(self, names: Collection[str] | None = None) -> tuple[SessionInfo, ...]:
        """All sessions, or those of `names`, in the order they were added."""
        ...

    def config(self) -> Config:
        """The configuration that its sessions share (of the first); the default if there is none."""
        ...

    def signatures(self, session: str | None = None) -> SignatureTable:
        """All signatures, or those of one session; `session_index` counts in the order of `sessions()`."""
        ...

    def nearest(
        self,
        query: Signature,
        count: int,
        *,
        building: str | None = None,
        floor: str | None = None,
        session: str | None = None,
    ) -> tuple[Neighbour, ...]:
        """The `count` submaps most alike by Eq. 6, best first, of those that the filters let through."""
        ...

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        ...

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame; empty for an imported map."""
        ...

    def loops(self, session: str) -> tuple[Loop, ...]:
        """Where the session came back to a place; `older` and `newer` count poses of its trajectory."""
        ...

    def submap(self, session: str, submap_id: int) -> Submap:
        """One submap."""
        ...

    def submaps(self, session: str) -> Iterable[Submap]:
        """All submaps of a session, by id."""
        ...

    def add(
        self,
        session_map: SessionMap,
        signatures: Sequence[Signature],
        provenance: Provenance,
        *,
        force: bool = False,
    ) -> None:
        """Store a session in one transaction. The same session again changes nothing; another one of the
        same name is refused with DatabaseError, or replaced with `force`."""
        ...

    def check(self) -> tuple[Problem, ...]:
        """Everything that is wrong with it; empty if sound."""
        ...

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only the sessions of this building and floor; None: any.

        Raises DatabaseError if there are none.
        """
        ...

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, do without the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left.
        """
        ...

    def close(self) -> None:
        """Let go of the file or connection."""
        ...

    def __enter__(self) -> SubmapDatabase: ...

    def __exit__(self, *_: Any) -> None: ...
