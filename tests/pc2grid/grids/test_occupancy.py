"""Planar scans drawn into a growing grid."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan
from pc2grid.errors import LimitExceeded
from pc2grid.geometry import SE2
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.model import THING, OccupancyGrid
from pc2grid.settings import ProjectionConfig
from signature.session.keyframes import Keyframe
from signature.session.local_maps import CAMERA_LOCAL_MAPS, LOCAL_MAPS, LocalMap, LocalMapParameters
from tests.helpers.rooms import RESOLUTION_M
from tests.helpers.simulated_drives import flat_scan


def disc(radius_m: float, *, hits: bool = True) -> PlanarScan:
    """A planar scan that looks all around a round room."""
    bearings = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    rim = radius_m * np.column_stack((np.cos(bearings), np.sin(bearings)))
    return flat_scan(rim if hits else [], radius_m)


def state(grid: OccupancyGrid, x: float, y: float) -> int:
    row, column = grid.to_cell(np.array([[x, y]]))[0]
    return int(grid.cells[row, column])


def test_round_room_is_free_inside_occupied_at_its_wall_unknown_outside() -> None:
    builder = GridBuilder(ProjectionConfig())
    for _ in range(3):
        builder.add(disc(2.0), SE2(10.0, -3.0, 0.7))
    grid = builder.grid()
    y, x = np.mgrid[: grid.cells.shape[0], : grid.cells.shape[1]]
    centres = grid.to_point(np.column_stack((y.ravel(), x.ravel())))
    distance = np.linalg.norm(centres - (10.0, -3.0), axis=1).reshape(grid.cells.shape)
    assert grid.free[distance < 1.9].all()
    assert (grid.cells[distance > 2.1] == -1).all()
    wall = grid.occupied
    assert wall.sum() > 200 and np.abs(distance[wall] - 2.0).max() < RESOLUTION_M


def test_a_person_who_has_left_is_cleared() -> None:
    builder = GridBuilder(ProjectionConfig())
    builder.add(flat_scan([(1.02, 0.02)], np.where(np.arange(BEARINGS) < 4, 1.0, 0.0)), SE2())
    assert state(builder.grid(), 1.02, 0.02) >= 65
    for _ in range(5):
        builder.add(disc(2.0), SE2())
    assert 0 <= state(builder.grid(), 1.02, 0.02) < 20


def test_what_was_taken_for_a_wall_until_rays_passed_over_it_is_a_thing_until_it_has_gone() -> None:
    """A chair 1 m ahead: a hit as long as nothing behind it is seen, then low, then away."""
    builder = GridBuilder(ProjectionConfig())
    chair = np.array([[1.02, 0.02]], np.float32)
    for _ in range(3):
        builder.add(dataclasses.replace(disc(2.0), hits_m=chair, normal_rad=np.zeros(1, np.float32)), SE2())
    assert state(builder.grid(), 1.02, 0.02) >= 65
    for _ in range(3):
        builder.add(dataclasses.replace(disc(2.0), low_m=chair), SE2())
    assert state(builder.grid(), 1.02, 0.02) == THING
    assert np.count_nonzero(builder.grid().things) == 1
    for _ in range(6):
        builder.add(disc(2.0), SE2())
    assert 0 <= state(builder.grid(), 1.02, 0.02) < 20


def test_a_grid_tells_the_heights_of_what_stands_there() -> None:
    """A wall and a chair ahead; the chair is seen twice, from below and from above."""
    builder = GridBuilder(ProjectionConfig())
    wall, chair = np.array([[1.52, 0.02]], np.float32), np.array([[1.02, 0.02]], np.float32)
    for of_chair in (0b000_001, 0b100_010):
        heights = np.array([0b000_111, of_chair], np.uint8)
        seen = dataclasses.replace(disc(2.0), hits_m=wall, normal_rad=np.zeros(1, np.float32), low_m=chair)
        builder.add(dataclasses.replace(seen, heights=heights), SE2())
    grid = builder.grid()
    assert grid.heights is not None
    assert [int(grid.heights[tuple(grid.to_cell(at)[0])]) for at in (wall, chair)] == [0b000_111, 0b100_011]
    assert np.count_nonzero(grid.heights) == 2
    unknown = GridBuilder(ProjectionConfig())
    unknown.add(disc(2.0), SE2())
    assert unknown.grid().heights is None


def test_a_map_past_the_limit_is_refused() -> None:
    builder = GridBuilder(ProjectionConfig(max_cells=600_000))
    builder.add(disc(2.0), SE2())
    with pytest.raises(LimitExceeded, match="max_cells"):
        for k in range(1, 10):
            builder.add(disc(2.0), SE2(100.0 * k, 0.0, 0.0))
        builder.grid()


def test_memory_goes_with_what_was_visited_not_with_the_rectangle_around_it() -> None:
    builder = GridBuilder(ProjectionConfig(max_cells=15_000_000))
    for k in range(200):  # 800 m as the crow flies: a square of 128 million cells
        builder.add(disc(2.0), SE2(2.83 * k, 2.83 * k, 0.0))
    with pytest.raises(LimitExceeded, match="max_cells"):
        builder.grid()
    corridor = GridBuilder(ProjectionConfig(max_cells=15_000_000))
    for k in range(200):
        corridor.add(disc(2.0), SE2(4.0 * k, 0.0, 0.0))
    grid = corridor.grid()
    assert grid.cells.shape[1] * grid.resolution_m > 790 and 0 <= state(grid, 796.5, 0.5) < 50


def test_lone_hit_beside_a_wall_is_noise_until_it_is_repeated() -> None:
    strayed, away = (1.92, 0.02), (0.0, 2.5)
    once = disc(2.0)
    rays = np.hypot(*(once.hits_m - strayed).T) < 0.12  # their free space ends a cell before the wall
    bearings = np.arange(len(once.free_m)) * 2 * np.pi / len(once.free_m)
    free_m = np.where(np.cos(bearings) > 0.99, 1.9, once.free_m).astype(np.float32)
    hits_m = np.concatenate((once.hits_m[~rays], np.array([strayed, away], np.float32)))
    stray = dataclasses.replace(once, hits_m=hits_m, free_m=free_m)
    wall_alone = dataclasses.replace(once, free_m=free_m)
    for times in (1, 2):
        builder = GridBuilder(ProjectionConfig())
        for k in range(3):
            builder.add(stray if k < times else wall_alone, SE2())
        grid = builder.grid()
        assert state(grid, *away) >= 65  # met as seldom, but nothing stands beside it
        assert state(grid, *strayed) >= 65 if times == 2 else state(grid, *strayed) == -1
        assert occupied_at(grid, once.hits_m).all()


def occupied_at(grid: OccupancyGrid, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    cells = grid.to_cell(points)
    return np.asarray(grid.cells[cells[:, 0], cells[:, 1]] >= 65)


# --- Local maps that loops are closed on ---


def uneven_walls(seed: int) -> PlanarScan:
    """Two walls that meet in a corner, with ledges 5 cm deep and 15 cm apart; noise 3 mm."""
    rng = np.random.default_rng(seed)
    along = np.arange(-1.5, 1.5, 0.02)
    deep = 2.0 + 0.05 * (np.floor(along / 0.15) % 2)
    hits = np.concatenate((np.column_stack((along, deep)), np.column_stack((deep, along))))
    return flat_scan(hits + rng.normal(size=hits.shape) * 0.003, 1.5)


def rms_error_m(parameters: LocalMapParameters) -> float:
    """Of matches of a part of each wall, seen again, with the local map of both."""
    rng = np.random.default_rng(1)
    local_map = LocalMap([Keyframe(0, uneven_walls(0), SE2())], [SE2()], parameters)
    errors = []
    for seed in range(1, 21):
        again = uneven_walls(seed)
        x, y, yaw = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.05, math.radians(2.0))
        first, second = rng.integers(0, 100, 2)
        part = np.r_[first : first + 50, 150 + second : 200 + second]
        guess = SE2(x, y, yaw)
        match = local_map.match(again.hits_m[part].astype(np.float64), again.normal_rad[part], guess)
        errors.append(math.hypot(match.pose.x, match.pose.y))
    return float(np.sqrt(np.mean(np.square(errors))))


def test_smaller_cells_place_uneven_walls_more_exactly() -> None:
    coarse_m, fine_m = rms_error_m(LOCAL_MAPS), rms_error_m(CAMERA_LOCAL_MAPS)
    assert fine_m < 0.01
    assert fine_m < 0.75 * coarse_m


ROOM = np.array([(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (2.0, 4.0), (2.0, 3.0), (0.0, 3.0), (0.0, 0.0)])


def room_with(shelves: float) -> LocalMap:
    """A room with a niche, and shelves before such a share of each wall, as seen from the middle."""
    walls = [
        np.linspace(a, b, round(math.dist(a, b) / 0.05), endpoint=False) - (3.0, 2.0)
        for a, b in itertools.pairwise(ROOM)
    ]
    for wall in walls:
        wall[: round(shelves * len(wall))] *= 0.6
    hits = np.concatenate(walls)
    free_m = np.zeros(BEARINGS, np.float32)
    bearing = (np.arctan2(hits[:, 1], hits[:, 0]) / (2 * np.pi / BEARINGS)).astype(int) % BEARINGS
    free_m[bearing] = np.hypot(*hits.T)
    return LocalMap([Keyframe(0, flat_scan(hits, free_m), SE2())], [SE2()])


def test_an_overlap_counts_as_much_as_it_is_likely() -> None:
    """At a step, the last bit of a number would decide whether a loop is closed."""
    found = [
        room_with(0.0).overlap(room_with(share), SE2(0.05, 0.0, 0.0), 0.1, 0.05)
        for share in np.linspace(0.0, 1.0, 21)
    ]
    counts = [0.0 if overlap is None else overlap.counts for overlap in found]
    assert counts[0] > 0.99 and found[-1] is None
    assert sum(0.1 < c < 0.9 for c in counts) >= 3


def test_what_an_overlap_counts_is_in_its_information() -> None:
    overlap = room_with(0.0).overlap(room_with(0.6), SE2(), 0.1, 0.05)
    assert overlap is not None and 0.1 < overlap.counts < 0.9
    match = room_with(0.0).match(*room_with(0.6).sample(), overlap.pose)
    assert overlap.information == pytest.approx(overlap.counts * match.information, rel=1e-3)
