"""The maps of joined sessions as one: what stands there now."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, BoolGrid, hand_over
from pc2grid.model import FREE, FREE_BELOW, OCCUPIED_FROM, THING, UNKNOWN, OccupancyGrid
from signature.bend import largest_m
from signature.database.protocol import BuildingFrame

if TYPE_CHECKING:
    from signature.database import SubmapDatabase

Cells = NDArray[np.int8]
_SQUARE_M = 1.0
"""Side of the squares for which a bend is computed."""


def building_map(maps: Sequence[tuple[OccupancyGrid, BuildingFrame]]) -> OccupancyGrid:
    """The maps of sessions, oldest first, each with where it lies, as one in the building's frame.

    Cells are as large as those of the first map; each is what the newest map says that is sure of its centre
    (free, occupied, or a thing); where none is sure, the oldest that knows it.
    Raises ValueError without a map.

    >>> import pc2grid
    >>> from pc2grid import SE2
    >>> plan = pc2grid.load_map("map.yaml")
    >>> exact = ((0.0, 0.0, 0.0),) * 3
    >>> frame = BuildingFrame(name="x", T_building_session=SE2(10.0, 0.0, 0.0), covariance=exact)
    >>> moved = building_map([(plan, frame)])
    >>> round(moved.free_m2 / plan.free_m2, 2), round(moved.origin_m[0] - plan.origin_m[0], 2)
    (1.0, 10.0)
    """
    whole = _around(maps)
    cells = whole.cells.copy()
    for window, told in _drawn(maps, whole):
        here = cells[window]
        chosen = _sure(told) | ((told != UNKNOWN) & (here == UNKNOWN))
        here[chosen] = told[chosen]
    return replace(whole, cells=hand_over(cells))


def _sure(cells: Cells) -> BoolGrid:
    """Where a map says what is there: an obstacle, a thing, or nothing."""
    return np.asarray((cells >= OCCUPIED_FROM) | (cells == THING) | ((cells >= FREE) & (cells < FREE_BELOW)))


def _around(maps: Sequence[tuple[OccupancyGrid, BuildingFrame]]) -> OccupancyGrid:
    """A grid of unknown cells that holds all maps."""
    if not maps:
        raise ValueError("a building without a map")
    cell_m = maps[0][0].resolution_m
    corners_m = np.concatenate([_corners(grid, frame) for grid, frame in maps])
    low = np.floor(corners_m.min(axis=0) / cell_m + 1e-6)
    width, height = (np.ceil(corners_m.max(axis=0) / cell_m - 1e-6) - low).astype(int).tolist()
    x, y = (low * cell_m).tolist()
    heights_m = {grid.height_m for grid, _ in maps}
    return OccupancyGrid(
        cells=np.full((height, width), UNKNOWN, np.int8),
        resolution_m=cell_m,
        origin_m=(float(x), float(y)),
        height_m=None if None in heights_m else float(np.mean([grid.height_m for grid, _ in maps])),
    )


def _drawn(
    maps: Sequence[tuple[OccupancyGrid, BuildingFrame]], whole: OccupancyGrid
) -> Iterator[tuple[tuple[slice, slice], Cells]]:
    """For each map the window of the grid that it lies in, and what it says of the cells there."""
    for grid, frame in maps:
        rows, columns = _covered(whole, _corners(grid, frame))
        told = _cells_at(grid, _as_drawn(frame, whole, rows, columns).reshape(-1, 2))
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        yield window, told.reshape(len(rows), len(columns))


def _corners(grid: OccupancyGrid, frame: BuildingFrame) -> F64:
    """(4, 2) of a map, wherever it is bent to, in the building."""
    height, width = grid.cells.shape
    around_m = largest_m(frame.bend)
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64) * grid.resolution_m
    outwards = np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)]) * around_m
    return frame.T_building_session.apply(corners + grid.origin_m + outwards)


def _as_drawn(
    frame: BuildingFrame, whole: OccupancyGrid, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> F64:
    """Where the centres of cells of a building (R, C, 2) lie in the map of a session.

    A bend changes little from cell to cell: it is inverted for the middles of large squares, and in between
    it is interpolated.
    """
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    T_session_building = frame.T_building_session.inverse()
    straight_m = T_session_building.apply(whole.to_point(at.reshape(-1, 2))).reshape(at.shape)
    if not frame.bend:
        return straight_m
    n = max(1, round(_SQUARE_M / whole.resolution_m))
    middle = (n - 1) / 2
    squares = np.stack(np.meshgrid(rows[::n] + middle, columns[::n] + middle, indexing="ij"), axis=-1)
    points_m = whole.to_point(squares.reshape(-1, 2))
    bent_m = (frame.as_drawn(points_m) - T_session_building.apply(points_m)).reshape(squares.shape)
    height, width = squares.shape[:2]
    return straight_m + cv2.resize(bent_m, (n * width, n * height))[: len(rows), : len(columns)]


def _covered(
    whole: OccupancyGrid, corners_m: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of a grid that a box with these corners may lie in."""
    at = whole.to_cell(corners_m)
    low, high = at.min(axis=0).clip(min=0), at.max(axis=0).clip(max=np.array(whole.cells.shape) - 1)
    return np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)


def _cells_at(grid: OccupancyGrid, points_m: NDArray[np.float64]) -> NDArray[np.int8]:
    """The cells (N,) of a grid at points (N, 2); unknown outside."""
    at = grid.to_cell(points_m)
    inside = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    found = np.full(len(at), UNKNOWN, np.int8)
    found[inside] = grid.cells[tuple(at[inside].T)]
    return found


def floors_of(database: SubmapDatabase, frames: Mapping[str, BuildingFrame]) -> tuple[tuple[str, ...], ...]:
    """The joined sessions of each floor, the oldest first. frames : of sessions, by name."""
    floors: dict[str, list[str]] = {}
    for name in (info.name for info in database.sessions() if info.name in frames):
        floors.setdefault(frames[name].name, []).append(name)
    return tuple(tuple(names) for names in floors.values())


def map_of(database: SubmapDatabase, session: str, frames: Mapping[str, BuildingFrame]) -> OccupancyGrid:
    """The map in whose frame answers in a session are: of its floor, or of the session alone.

    frames : of the sessions whose answers are in the frames of their buildings. A floor is drawn from all its
    sessions, see `building_map`.
    """
    if session not in frames:
        return database.grid(session)
    floor = frames[session].name
    names = next(names for names in floors_of(database, frames) if frames[names[0]].name == floor)
    return building_map([(database.grid(name), frames[name]) for name in names])
