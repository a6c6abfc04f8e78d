"""Isovists against hand-made rooms and a slow oracle."""

from __future__ import annotations

import math

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64
from pc2grid.model import OCCUPIED_FROM, UNKNOWN, OccupancyGrid
from pc2grid.submaps.submaps import (
    _STEP_CELLS,
    HIDDEN,
    OPEN,
    WALL,
    cast_rays,
    isovist,
    polygon_mask,
    visible_submap,
)
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import plan


def cast_rays_plain(
    cells: NDArray[np.int8], rows: F64, columns: F64, limit: float, bearings: int, patience: int
) -> tuple[F32, NDArray[np.int8]]:
    """Follow the rays of each place (N,) in steps of half a cell.

    cells : (H, W). rows, columns : (N,) where the rays start, in cells from the grid's corner. limit : length
    of a ray, in cells. patience : steps through unknown cells after which a ray is HIDDEN.

    Returns how far each ray is known to be free (or its wall), in cells, and how it ends; (N, B) each.
    """
    shape = (len(rows), bearings)
    angles = 2.0 * np.pi * np.arange(bearings) / bearings
    r, c = np.broadcast_to(rows[:, None], shape).copy(), np.broadcast_to(columns[:, None], shape).copy()
    ranges, ends = np.zeros(shape), np.full(shape, OPEN, np.int8)
    unknown_run, running = np.zeros(shape, np.int64), np.ones(shape, np.bool_)
    length = 0.0
    while length < limit and running.any():
        r += np.sin(angles) * _STEP_CELLS
        c += np.cos(angles) * _STEP_CELLS
        length += _STEP_CELLS
        inside = (r >= 0) & (r < cells.shape[0]) & (c >= 0) & (c < cells.shape[1])
        value = np.full(shape, UNKNOWN, np.int8)
        value[inside] = cells[r[inside].astype(np.int64), c[inside].astype(np.int64)]
        unknown_run = np.where(value < 0, unknown_run + 1, 0)
        ranges[running & (value >= 0)] = length
        ends[running & (value >= OCCUPIED_FROM)] = WALL
        ends[running & (~inside | (unknown_run > patience))] = HIDDEN
        running &= ends == OPEN
    return ranges.astype(np.float32), ends


def test_rays_in_a_square_room_end_on_its_walls() -> None:
    room = plan(6, 6, [])
    view = isovist(room, (3.0, 3.0), 10.0)
    assert (view.ends == WALL).all()
    assert view.ranges_m[0] == view.ranges_m.min() or abs(view.ranges_m[0] - 3.0) < 3 * RESOLUTION_M
    assert abs(view.ranges_m[45] - 3.0 * math.sqrt(2)) < 0.2
    assert abs(np.mean(view.ranges_m.astype(float) ** 2) * math.pi - 36.0) < 2.5


def test_rays_beyond_the_sight_are_open_and_into_the_unknown_hidden() -> None:
    cells = np.zeros((200, 200), np.int8)
    cells[:, 150:] = UNKNOWN
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    view = isovist(grid, (5.0, 5.0), 3.0)
    assert view.ends[180] == OPEN and abs(view.ranges_m[180] - 3.0) < RESOLUTION_M
    assert view.ends[0] == HIDDEN and abs(view.ranges_m[0] - 2.5) < 2 * RESOLUTION_M
    assert abs(view.observed - (1 - 2 * math.acos(2.5 / 3) / (2 * math.pi))) < 0.03


def test_a_few_unobserved_cells_do_not_hide_the_wall_behind_them() -> None:
    room = plan(6, 6, [])
    cells = room.cells.copy()
    cells[:, 80] = UNKNOWN
    view = isovist(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), (3.0, 3.0), 10.0)
    assert view.ends[0] == WALL and abs(view.ranges_m[0] - 3.0) < 3 * RESOLUTION_M


def test_a_visible_submap_hides_the_next_room_and_keeps_the_wall() -> None:
    rooms = plan(12, 6, [(6, 0, 6, 6)])
    submap = visible_submap(rooms, isovist(rooms, (3.0, 3.0), 8.0), 7)
    assert submap.submap_id == 7
    next_room = submap.grid.to_cell(np.array([[8.0, 3.0], [9.0, 1.0]]))
    assert (submap.grid.cells[next_room[:, 0], next_room[:, 1]] == UNKNOWN).all()
    wall = submap.grid.to_cell(np.array([[6.0, 3.0]]))[0]
    assert submap.grid.occupied[wall[0], wall[1] - 2 : wall[1] + 3].any()
    assert submap.grid.free.sum() * 0.05**2 > 0.9 * 36 * 0.9


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_what_is_inside_the_polygon_is_seen(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walls = [(*rng.uniform(0.5, 7.5, 2), *rng.uniform(0.5, 7.5, 2)) for _ in range(4)]
    room = plan(8, 8, walls)
    free = room.to_point(np.argwhere(cv2.distanceTransform(room.free.astype(np.uint8), 2, 5) > 6))
    center = free[rng.integers(len(free))]
    view = isovist(room, (float(center[0]), float(center[1])), 5.0)
    inside = np.argwhere(polygon_mask(view, room) & room.free)
    if not len(inside):
        return
    seen = 0
    sample = inside[rng.integers(len(inside), size=40)]
    for point in room.to_point(sample):
        steps = np.linspace(0, 1, 200)[:, None]
        cells = room.to_cell(center + steps * (point - center))
        seen += not room.occupied[cells[:, 0], cells[:, 1]].any()
    assert seen >= 0.9 * len(sample)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), patience=st.integers(0, 4))
def test_compiled_rays_are_the_plain_ones(seed: int, patience: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice([UNKNOWN, 0, 100], (80, 120), p=[0.05, 0.94, 0.01]).astype(np.int8)
    rows, columns = rng.uniform(-2, 82, 30), rng.uniform(-2, 122, 30)
    compiled = cast_rays(cells, rows, columns, 60.0, 90, patience)
    plain = cast_rays_plain(cells, rows, columns, 60.0, 90, patience)
    assert np.array_equal(compiled[0], plain[0]) and np.array_equal(compiled[1], plain[1])
