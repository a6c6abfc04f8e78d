"""The methods that every engine of the submap database has, and the types they use."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from pc2grid.display import short
from pc2grid.errors import DatabaseError
from pc2grid.io.containers.detect import SUBMAPS_ID
from pc2grid.model import (
    Consistency,
    Loop,
    OccupancyGrid,
    OdometryCheck,
    PointMap,
    Precision,
    ReadReport,
    SessionMap,
    Submap,
    Trajectory,
)

if TYPE_CHECKING:
    import networkx as nx

    from signature.config import Config
    from signature.describe import Signature
    from signature.seen_places import SeenPlaces
    from signature.similarity import SignatureTable


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """Where a session was recorded; None: not known.

    building, floor : in the user's words.
    told_apart : the floor is not in the user's words: its recording reaches several floors, which got names
        of their own. It tells the sessions of that recording apart, and says nothing of other recordings.
    floor_height_m : of the floor above the lowest one of its recording, where stairs or ramps join them.
    """

    building: str | None = None
    floor: str | None = None
    told_apart: bool = False
    floor_height_m: float | None = None

    def __str__(self) -> str:
        floor = f"floor {self.floor}" if self.told_apart and self.floor else self.floor
        if floor and self.floor_height_m is not None:
            floor += f" at {self.floor_height_m:.1f} m"
        return ", ".join(word for word in (self.building, floor) if word) or "no label"

    def fits(self, building: str | None, floor: str | None) -> bool:
        """Whether it is this building and floor; None: any, "": those that were not given."""
        return building in (None, self.building or "") and floor in (None, self.floor or "")

    def comparable(self, other: Label, *, one_recording: bool) -> bool:
        """Whether the names of the two floors mean the same."""
        return one_recording or not (self.told_apart or other.told_apart)

    def contradicts(self, other: Label, *, one_recording: bool = False) -> bool:
        """Whether the two name different buildings, or different floors; None differs from nothing.

        one_recording : both sessions are parts of one recording.
        """
        pairs = [(self.building, other.building)]
        if self.comparable(other, one_recording=one_recording):
            pairs.append((self.floor, other.floor))
        return any(a is not None and b is not None and a != b for a, b in pairs)

    def agrees(self, other: Label, *, one_recording: bool = False) -> bool:
        """Whether the two name the same building, and the same floor or none."""
        known = self.building is not None and self.building == other.building and self.floor == other.floor
        return known and self.comparable(other, one_recording=one_recording)


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """What made a session: enough to make it again. It has no time of day, so equal inputs give equal bytes.

    source : file name of the recording or map, without its folder, which differs between machines.
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

    def __repr__(self) -> str:
        return f"Provenance({short(self.source)}, sha256 {self.digest[:12]}, {short(self.label)})"


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionInfo:
    """A session as `db info` shows it.

    name : unique within the database.
    sensor : kind that made it, or "map".
    submaps : how many.
    area_m2 : free space in its grid.
    path_m : distance driven, metres; 0 for an imported map.
    duration_s : time between first and last pose.
    scans : poses in its trajectory.
    report : what was read, and what was lost while reading.
    consistency : how well its map agrees with its own scans; None for an imported map, and for a session that
        was stored before this was measured.
    odometry : how well odometry agrees with its scans; None likewise.
    precision : how exactly its places lie to each other; None likewise.
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
    consistency: Consistency | None = None
    odometry: OdometryCheck | None = None
    precision: Precision | None = None

    def __repr__(self) -> str:
        driven = f"{self.path_m:.1f} m in {self.duration_s:.0f} s, " if self.scans else ""
        return (
            f"SessionInfo({short(self.name)}, {self.sensor}, {driven}{self.area_m2:.0f} m2,"
            f" {self.submaps} submaps)"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of reading and mapping."""
        return self.report.warnings

    @property
    def lossy(self) -> bool:
        """Whether data was lost while reading."""
        return self.report.lossy


def none_there(where: str, building: str | None, floor: str | None, labels: Sequence[Label]) -> DatabaseError:
    """The error for a building or floor that no session of a database has."""
    wanted = Label(building=building, floor=floor)
    there = "; ".join(sorted({str(label) for label in labels})[:20]) or "no session"
    return DatabaseError(f"{where}: no session of {wanted}", hint=f"there are: {there}")


@dataclass(frozen=True, slots=True)
class Problem:
    """One finding of `check`: where (table and session) and what."""

    where: str
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Neighbour:
    """A submap that is similar to a query.

    center_m : (x, y) in the map frame of its session. score : Eq. 6, smaller is more similar.
    """

    session: str
    submap_id: int
    center_m: tuple[float, float]
    score: float

    def __repr__(self) -> str:
        x, y = self.center_m
        where = f"{self.submap_id} of {short(self.session)} at ({x:.2f}, {y:.2f}) m"
        return f"Neighbour({where}, score {self.score:.4f})"


APPLICATION_ID = int.from_bytes(SUBMAPS_ID, "big")
"""Marks a file, and the lock of a server, as pc2grid's."""
BUSY_TIMEOUT_S = 30.0
"""How long a writer waits for another one; chosen by hand."""
Entry = tuple[SessionMap, "Sequence[Signature]", Provenance]
"""Everything that is stored of one session: the map, the signature of each submap, the provenance."""


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
        """The configuration of the first session, whose signature and partition settings all sessions share.

        The default configuration if there is no session.
        """
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
        """The `count` most similar submaps by Eq. 6, best first, of this building, floor and session."""
        ...

    def grid(self, session: str) -> OccupancyGrid:
        """Whole occupancy grid of a session."""
        ...

    def trajectory(self, session: str) -> Trajectory:
        """Poses of the base in the session's map frame; empty for an imported map."""
        ...

    def loops(self, session: str) -> tuple[Loop, ...]:
        """The loops of a session; their `older` and `newer` are indices of poses of its trajectory."""
        ...

    def graph(self, session: str) -> nx.Graph:
        """The junction graph of a session's free space (`pc2grid.submaps.junction_graph`).

        Made again from the grid if none was stored, as in databases of formats 1 and 2.
        """
        ...

    def points(self, session: str) -> PointMap | None:
        """The points of a session in space; None if none were stored."""
        ...

    def seen_places(self, session: str) -> SeenPlaces | None:
        """What is seen from the centre of each submap of a session, by id; None if it was not stored, as in
        databases of formats 1 to 4."""
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
        """All damage; empty if there is none."""
        ...

    def keep_only(self, *, building: str | None = None, floor: str | None = None) -> None:
        """From now on, know only the sessions of this building and floor; None: any.

        Raises DatabaseError if there are none.
        """
        ...

    def leave_out_damaged(self) -> tuple[Problem, ...]:
        """From now on, leave out the sessions that cannot be searched because they are damaged.

        Returns what is wrong with each of them. Raises DatabaseCorrupt if none is left.
        """
        ...

    def close(self) -> None:
        """Close the file or connection."""
        ...

    def __enter__(self) -> SubmapDatabase: ...

    def __exit__(self, *_: Any) -> None: ...
