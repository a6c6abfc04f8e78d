"""What changed in a building between sessions that are joined."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64
from pc2grid.errors import DatabaseError
from pc2grid.geometry import SE2
from pc2grid.mapping.changes import MapChanges, map_changes
from pc2grid.model import OccupancyGrid
from signature.database.protocol import BuildingFrame
from signature.database.rows import no_session
from signature.localization.joining.building_map import building_map

if TYPE_CHECKING:
    from signature.database import SubmapDatabase


def sessions_of(database: SubmapDatabase, named: str) -> tuple[str, ...]:
    """The sessions that a name or a date stands for: the session of that name, or the joined sessions that
    were recorded on a day (YYYY-MM-DD, UTC), in the order in which they were stored.

    Raises DatabaseError if there is none.
    """
    names = [info.name for info in database.sessions()]
    if named in names:
        return (named,)
    try:
        day = datetime.date.fromisoformat(named)
    except ValueError:
        raise no_session(named, names, database.location) from None
    days = {name: _day(database, name) for name in database.frames()}
    found = tuple(name for name in names if days.get(name) == day)
    if not found:
        known = ", ".join(sorted({str(day) for day in days.values() if day is not None})) or "none"
        raise DatabaseError(
            f"{database.location}: no joined session was recorded on {day}", hint=f"there are: {known}"
        )
    return found


def _day(database: SubmapDatabase, session: str) -> datetime.date | None:
    """When a session began, UTC; None for an imported map."""
    stamps_ns = database.trajectory(session).stamps_ns
    if not len(stamps_ns):
        return None
    return datetime.datetime.fromtimestamp(int(stamps_ns[0]) // 10**9, datetime.timezone.utc).date()


def building_changes(
    database: SubmapDatabase, before: Sequence[str], after: Sequence[str]
) -> tuple[OccupancyGrid, MapChanges]:
    """The map of a building from its sessions `before`, in the building's frame, and what differs in those
    `after`. Of several sessions the newest that knows a cell counts.

    Raises DatabaseError for a session that does not exist, that is in both, or that is not joined with the
    others.
    """
    frames = _common_frame(database, (*before, *after))
    earlier = _map_of(database, before, frames)
    if len(after) == 1 and not frames[after[0]].bend:
        later, T_building_later = database.grid(after[0]), frames[after[0]].T_building_session
    else:
        later, T_building_later = _map_of(database, after, frames), SE2()
    covariance = sum(
        (_at(frames[_least_exact(names, frames)], T_building_later) for names in (before, after)),
        np.zeros((3, 3)),
    )
    return earlier, map_changes(earlier, later, T_building_later, covariance)


def _map_of(
    database: SubmapDatabase, names: Sequence[str], frames: Mapping[str, BuildingFrame]
) -> OccupancyGrid:
    first = frames[names[0]]
    if len(names) == 1 and first.T_building_session == SE2() and not first.bend:
        return database.grid(names[0])
    return building_map([(database.grid(name), frames[name]) for name in names])


def _common_frame(database: SubmapDatabase, names: Sequence[str]) -> dict[str, BuildingFrame]:
    """Where sessions lie in their one building."""
    where = database.location
    known = [info.name for info in database.sessions(list(names))]
    for number, name in enumerate(names):
        if name not in known:
            raise no_session(name, (info.name for info in database.sessions()), where)
        if name in names[:number]:
            raise DatabaseError(f"{where}: {name!r} is compared with itself", hint="name two sessions")
    frames = database.frames()
    for name in names:
        if name not in frames or frames[name].name != frames.get(names[0], frames[name]).name:
            others = ", ".join(repr(other) for other in names if other != name)
            raise DatabaseError(
                f"{where}: {name!r} is not joined with {others}",
                hint=f"`pc2grid db join {where}` finds out how its sessions lie to each other",
            )
    return {name: frames[name] for name in names}


def _least_exact(names: Sequence[str], frames: Mapping[str, BuildingFrame]) -> str:
    return max(names, key=lambda name: frames[name].covariance[0][0] + frames[name].covariance[1][1])


def _at(frame: BuildingFrame, T_building_there: SE2) -> F64:
    """The covariance (3, 3) of where a session lies in its building, at the origin of another frame."""
    T = frame.T_building_session
    J = np.eye(3)
    J[:2, 2] = T.y - T_building_there.y, T_building_there.x - T.x
    return np.asarray(J @ np.array(frame.covariance) @ J.T)
