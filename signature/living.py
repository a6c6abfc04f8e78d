"""The living map of a floor: one map of all its joined sessions, which is searched in their place.

Sessions of one floor repeat each other, and the older ones show what has moved since. The living map adds up
what all of them say of each cell (`evidence_map`): what has stood in every session is certain, what moves is
not; places and signatures are made from it anew. Its sessions retire: they keep their maps, from which the
next living map is made and they themselves are made whole again, and lose what only a search needs. So what
is searched grows with the floor, not with the years. The map that is exported shows what stands there now
(`building_map`), and is made from the same maps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import BoolGrid
from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.matching.walls import WALLS
from pc2grid.model import UNKNOWN, PointMap, SessionMap, Trajectory
from pc2grid.submaps.partition import divide
from signature.database import maintenance, open_database
from signature.database.protocol import BuildingFrame, Label, Place, Provenance, SessionRole
from signature.database.stored import StoredSession, completed, stored_session, thinned
from signature.localization.joining.building_map import evidence_map
from signature.sessions import describe_all, provenance

if TYPE_CHECKING:
    from signature.config import Config
    from signature.database import SubmapDatabase

_EXACT = ((0.0, 0.0, 0.0),) * 3
"""Covariance of what defines a frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LivingMap:
    """A living map that was made. name : of its session. frame : of its building. members : the sessions that
    it was made from, oldest first. free_m2 : free ground. submaps : how many."""

    name: str
    frame: str
    members: tuple[str, ...]
    free_m2: float
    submaps: int


def update(target: Place, frames: Collection[str] | None = None) -> tuple[LivingMap, ...]:
    """Make the living maps of a database anew, and retire the sessions that they are made from, in one
    transaction. A session that alone observes its heights (`living_name`) is searched as before.

    frames : of the buildings that are updated; None: all.

    Raises DatabaseError if no two sessions observe the same heights of one floor, or if a session has the
    name of a living map and is none, and as `maintenance.replace_sessions`.
    """
    with open_database(target) as database:
        known = database.frames()
        floors = _floors(database, known, frames)
        _refuse_taken(database, known, floors)
        lived = [_living(database, name, members, known) for name, members in floors.items()]
        retiring = [
            thinned(database.stored(name), replace(known[name], role=SessionRole.RETIRED))
            for name in (member for members in floors.values() for member in members)
            if known[name].role is not SessionRole.RETIRED
        ]
    if not floors:
        where = maintenance.shown(target)
        raise DatabaseError(
            f"{where}: no two joined sessions of one floor observe the same heights",
            hint=f"`pc2grid db join {where}` finds out which sessions show one building",
        )
    # Living maps that were renamed, or whose sessions are gone.
    living = {n for n, at in known.items() if at.role is SessionRole.LIVING}
    stale = [n for n in living - floors.keys() if frames is None or known[n].name in frames]
    maintenance.replace_sessions(target, [*lived, *retiring], remove=stale)
    return tuple(
        LivingMap(
            name=made.info.name,
            frame=known[members[0]].name,
            members=tuple(members),
            free_m2=made.info.area_m2,
            submaps=made.info.submaps,
        )
        for made, members in zip(lived, floors.values(), strict=True)
    )


def _refuse_taken(
    database: SubmapDatabase, known: Mapping[str, BuildingFrame], names: Collection[str]
) -> None:
    """Raises DatabaseError if a session has one of the names of living maps and is none."""
    for info in database.sessions(names):
        if info.name not in known or known[info.name].role is not SessionRole.LIVING:
            raise DatabaseError(
                f"{database.location}: holds a session {info.name!r} that is no living map",
                hint=f"`pc2grid db rename {database.location} {info.name} NAME` gives it another name",
            )


def undo(target: Place) -> tuple[str, ...]:
    """Make the sessions that retired whole again, and remove the living maps, in one transaction; returns
    the names of these sessions.

    What follows from a map is computed again: submaps, signatures, junction graph, what is seen. The poses of
    every scan, the loops and the points in space are only in the recording.

    Raises as `maintenance.replace_sessions`.
    """
    with open_database(target) as database:
        known = database.frames()
        living = [name for name, at in known.items() if at.role is SessionRole.LIVING]
        back = tuple(name for name, at in known.items() if at.role is SessionRole.RETIRED)
        whole = [_whole(database.stored(name)) for name in back]
    if living or whole:
        maintenance.replace_sessions(target, whole, remove=living)
    return back


def _whole(session: StoredSession) -> StoredSession:
    """A session that had retired, with what follows from its map."""
    kept = ("info", "grid", "trajectory", "loops")
    again = completed({name: getattr(session, name) for name in kept})
    frame = session.frame
    return replace(again, frame=None if frame is None else replace(frame, role=None))


def _floors(
    database: SubmapDatabase, known: Mapping[str, BuildingFrame], frames: Collection[str] | None
) -> dict[str, list[str]]:
    """The sessions of each living map, oldest first, by the name that the map gets."""
    found: dict[str, list[str]] = {}
    for info in database.sessions():
        at = known.get(info.name)
        if at is None or at.role is SessionRole.LIVING or (frames is not None and at.name not in frames):
            continue
        found.setdefault(living_name(at.name, database.grid(info.name).height_m), []).append(info.name)
    return {name: members for name, members in found.items() if len(members) > 1}


def living_name(frame: str, height_m: float | None) -> str:
    """The name of the living map of a floor.

    height_m : of the one plane that its sessions observe. What is free in one plane may be occupied in
    another one, so each plane has a map of its own (`WallParameters.plane_m`).

    >>> living_name("monday", None), living_name("monday", 0.2)
    ('monday.living', 'monday.living-0.0m')
    """
    if height_m is None:
        return f"{frame}.living"
    return f"{frame}.living-{WALLS.plane_m * np.floor(height_m / WALLS.plane_m):.1f}m"


def _living(
    database: SubmapDatabase, name: str, members: Sequence[str], known: Mapping[str, BuildingFrame]
) -> StoredSession:
    """The living map of some sessions, as it is stored."""
    placed = [(member, known[member]) for member in members]
    points = _points(database, [*((old, at) for old, at in known.items() if old == name), *placed])
    (newest,) = database.sessions(members[-1:])
    config = newest.provenance.config
    voxel_m = {"points_voxel_m": None if points is None else points.voxel_m}
    config = config.model_copy(update={"projection": config.projection.model_copy(update=voxel_m)})
    grid = evidence_map([(database.grid(member), frame) for member, frame in placed])
    graph, submaps = divide(grid, config.partition)
    whole = SessionMap(
        session=name,
        sensor="map",
        grid=grid,
        submaps=submaps,
        trajectory=Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4))),
        graph=graph,
        points=points,
    )
    made = stored_session((whole, describe_all(whole, config), _origin(database, members, config)))
    frame = BuildingFrame(
        name=known[members[0]].name, T_building_session=SE2(), covariance=_EXACT, role=SessionRole.LIVING
    )
    return replace(made, frame=frame)


def _origin(database: SubmapDatabase, members: Sequence[str], config: Config) -> Provenance:
    """What a living map was made from: the digests of its sessions, in their order."""
    origins = [info.provenance for info in database.sessions(list(members))]
    digest = hashlib.sha256("".join(origin.digest for origin in origins).encode()).hexdigest()
    labels = [origin.label for origin in origins]
    buildings = {label.building for label in labels} - {None}
    floors = {label.floor for label in labels if not label.told_apart} - {None}
    label = Label(
        building=buildings.pop() if len(buildings) == 1 else None,
        floor=floors.pop() if len(floors) == 1 else None,
    )
    return provenance(f"{len(origins)} sessions", digest, config, label=label)


def _points(database: SubmapDatabase, placed: Sequence[tuple[str, BuildingFrame]]) -> PointMap | None:
    """The points in space of all maps that have any, oldest first: over ground that a newer one of them
    knows, those of the newest."""
    newer: list[tuple[str, BuildingFrame]] = []
    clouds, voxel_m = [], 0.0
    for member, frame in reversed(placed):
        points = database.points(member)
        if points is None or not len(points):
            continue
        cloud_m, voxel_m = frame.apply(points.points_m()), max(voxel_m, points.voxel_m)
        for other, of_other in newer:
            grid = database.grid(other)
            at = grid.to_cell(of_other.as_drawn(cloud_m[:, :2]))
            inside: BoolGrid = np.asarray(((at >= 0) & (at < grid.cells.shape)).all(axis=1))
            inside[inside] = grid.cells[tuple(at[inside].T)] != UNKNOWN
            cloud_m = cloud_m[~inside]
        newer.append((member, frame))
        clouds.append(cloud_m)
    return PointMap.of(np.concatenate(clouds), voxel_m) if clouds else None
