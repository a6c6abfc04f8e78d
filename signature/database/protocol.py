"""The description of the sessions of a submap database: labels, provenance, place in a building, and the
format.

A session drifts where it closes no loop, and joining corrects it by other sessions
(`signature.join.building`). Its map stays as it was drawn; the correction is a `Deformation`,
a small rigid motion that varies over the map. It has a row for each of some places of the map: x and y of the
place, and the motion of the map about it, x, y and yaw, all in the axes of the map. In between, the motions
are blended by a Gaussian of the distance. A map without rows is rigid.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pc2grid.display import short
from pc2grid.errors import DatabaseError, DatabaseVersion
from pc2grid.geometry import F64, SE2
from pc2grid.io.source import SUBMAPS_ID
from pc2grid.model import Consistency, OdometryCheck, Precision, ReadReport, SessionMap
from signature.config import Config
from signature.paper import Signature

FORMAT = 1
"""The format that is written and read."""
APPLICATION_ID = int.from_bytes(SUBMAPS_ID, "big")
"""Marks a file, and the lock of a server, as pc2grid's."""
CONNECT_TIMEOUT_S = 10.0
"""How long a server, or a scheduler and its first worker, may take to answer; chosen by hand."""
BUSY_TIMEOUT_S = 30.0
"""How long a writer waits for another one; chosen by hand."""
Location = str | Path
"""Path of a `*.submaps` file, or URL of a PostgreSQL database."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """The place where a session was recorded; None: not known.

    building, floor : in the user's words.
    """

    building: str | None = None
    floor: str | None = None

    def __str__(self) -> str:
        return ", ".join(word for word in (self.building, self.floor) if word) or "no label"

    def contradicts(self, other: Label) -> bool:
        """Return True if the two name different buildings, or different floors; None contradicts nothing."""
        pairs = ((self.building, other.building), (self.floor, other.floor))
        return any(a is not None and b is not None and a != b for a, b in pairs)


@dataclass(frozen=True, slots=True, kw_only=True)
class Provenance:
    """The origin of a session: enough to make it again. It has no time of day, so equal inputs give equal
    bytes.

    source : file name of the recording or map, without its folder, which differs between machines.
    digest : sha256 of the recording, hex.
    config : the whole effective configuration.
    start_s, duration_s : part of the recording, seconds from its start; duration None: to the end.
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
    points : how many points in space are stored.
    report : counts of what was read, and of what was lost while reading.
    consistency : agreement of its map with its own scans; None for an imported map.
    odometry : agreement of odometry with its scans; None likewise.
    precision : standard deviations of its places relative to each other; None likewise.
    """

    name: str
    sensor: str
    submaps: int
    resolution_m: float
    area_m2: float
    path_m: float
    duration_s: float
    scans: int
    points: int
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


Entry = tuple[SessionMap, Sequence[Signature], Provenance]
"""Everything that is stored of one session: the map, the signature of each submap, the provenance."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One finding of `check`: where (part and session) and what."""

    where: str
    what: str


# --- the place in a building --------------------------------------------------------------------------

Covariance = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Of x, y and yaw, row by row; metres and radians."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildingFrame:
    """The place of a session in the frame of its building, in which joined sessions have their answers.

    name : of the frame: that of the session whose map frame it was when the first sessions were joined. It
        stays when that session is renamed or removed.
    T_building_session : the map frame of the session in that of the building. covariance : of it, in the axes
        of the building.
    bend : deformation of the map before T_building_session is applied; empty: it is rigid.
    """

    name: str
    T_building_session: SE2
    covariance: Covariance
    bend: Deformation = ()

    def at(self, x_m: float, y_m: float) -> SE2:
        """Return T_building_session around a place of the session's map."""
        return self.around(np.array([(x_m, y_m)]))[0]

    def around(self, points_m: F64) -> list[SE2]:
        """Return T_building_session around points (N, 2) of the session's map, each good near its point."""
        found = []
        for (x, y), (dx, dy, yaw) in zip(
            points_m.tolist(), motions(self.bend, points_m).tolist(), strict=True
        ):
            found.append(self.T_building_session @ (SE2(x + dx, y + dy, yaw) @ SE2(-x, -y, 0.0)))
        return found

    def placed(self, T_session_base: SE2) -> SE2:
        """Transform a pose in the session's map into the building."""
        return self.at(T_session_base.x, T_session_base.y) @ T_session_base

    def apply(self, points_m: F64) -> F64:
        """Transform points (N, 2) or (N, 3) of the session's map into the building."""
        bent_m = points_m[:, :2] + motions(self.bend, points_m[:, :2])[:, :2]
        return np.column_stack((self.T_building_session.apply(bent_m), points_m[:, 2:]))

    def to_session(self, points_m: F64) -> F64:
        """Transform points (N, 2) of the building into the session's map."""
        bent_m = drawn_m = self.T_building_session.inverse().apply(points_m)
        for _ in range(_ROUNDS if self.bend else 0):
            drawn_m = bent_m - motions(self.bend, drawn_m)[:, :2]
        return drawn_m


def by_building(frames: Mapping[str, BuildingFrame]) -> dict[str, dict[str, BuildingFrame]]:
    """Return the joined sessions by the frame of their building. frames : by session."""
    found: dict[str, dict[str, BuildingFrame]] = defaultdict(dict)
    for session, at in frames.items():
        found[at.name][session] = at
    return found


Deformation = tuple[tuple[float, float, float, float, float], ...]
"""Rows (x, y, motion in x, in y, in yaw); metres and radians."""
_BLENDED_M = 3.0
"""Standard deviation of the weights. From 2 to 4 m, sessions of csail and aces came to lie equally well."""
_NEAREST = 8
"""Places that are blended; those further away have no weight."""
_ROUNDS = 3
"""In which a motion is inverted: each leaves a few percent of the error, as steep as real bends are."""


def motions(deformation: Deformation, points_m: F64) -> F64:
    """Return the motion (M, 3) x, y, yaw of a map at points (M, 2)."""
    points_m = np.asarray(points_m, np.float64)
    if not deformation or not len(points_m):
        return np.zeros((len(points_m), 3))
    from scipy.spatial import cKDTree

    rows = np.array(deformation)
    distance_m, near = cKDTree(rows[:, :2]).query(points_m, k=range(1, min(_NEAREST, len(rows)) + 1))
    weight = np.exp((distance_m[:, :1] ** 2 - distance_m**2) / (2.0 * _BLENDED_M**2))
    weight /= weight.sum(axis=1, keepdims=True)
    moved = rows[near, 2:]
    away = points_m[:, None] - rows[near, :2]
    moved[..., 0] -= moved[..., 2] * away[..., 1]
    moved[..., 1] += moved[..., 2] * away[..., 0]
    return np.asarray((weight[..., None] * moved).sum(axis=1))


def largest_m(deformation: Deformation) -> float:
    """Return the largest shift of a place by a deformation."""
    return max((float(np.hypot(dx, dy)) for _, _, dx, dy, _ in deformation), default=0.0)


# --- errors -------------------------------------------------------------------------------------------


def refuse_other_format(location: object, version: int) -> None:
    """Raise DatabaseVersion for a database of another format."""
    if version != FORMAT:
        raise DatabaseVersion(
            f"{location}: database format {version}; this pc2grid reads format {FORMAT}",
            hint="use a newer pc2grid" if version > FORMAT else "convert the recordings again",
        )


def no_utf8(location: str) -> DatabaseError:
    """Return the error for a name that no database can hold."""
    return DatabaseError(
        f"{location}: holds UTF-8 only, and a name is none", hint="rename the recording, or use --name"
    )
