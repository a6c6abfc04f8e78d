"""Floor plans, their walls in space, and what is put into them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.errors import ConfigError
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.simulate.clutter import covered, place_clutter
from pc2grid.simulate.floorplan import office_floorplan
from pc2grid.simulate.passage import Passages, clearance_m
from pc2grid.simulate.scene import Scene, extrude


def largest_share(grid: OccupancyGrid, free: np.ndarray, robot_m: float = 0.35) -> float:
    """Share of the passable cells that a robot can reach from one another."""
    from scipy import ndimage

    labels, _ = ndimage.label(clearance_m(free, grid.resolution_m) >= robot_m, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    return float(sizes.max() / sizes.sum())


@pytest.mark.parametrize("seed", range(8))
def test_office_is_one_connected_building_with_corridors_and_rooms(seed: int) -> None:
    grid = office_floorplan(seed)
    assert largest_share(grid, grid.free) > 0.97
    assert 0.6 < grid.free.mean() < 0.9
    # Closed to the outside: unknown cells around it touch walls only.
    outside = np.pad(grid.free, 1)
    touching = np.pad(grid.cells == UNKNOWN, 1, constant_values=True)
    assert not (outside[1:] & touching[:-1]).any()
    assert not (outside[:, 1:] & touching[:, :-1]).any()


def test_office_depends_on_the_seed_alone() -> None:
    again = office_floorplan(3)
    assert np.array_equal(office_floorplan(3).cells, again.cells)
    assert (office_floorplan(4).cells != again.cells).mean() > 0.02


def test_office_of_another_size_and_resolution() -> None:
    grid = office_floorplan(1, 30.0, 24.0, resolution_m=0.1)
    assert grid.cells.shape == (250, 310)
    assert grid.origin_m == (-0.5, -0.5)
    with pytest.raises(ConfigError, match="too small"):
        office_floorplan(0, 12.0, 30.0)
    with pytest.raises(ConfigError, match="cells"):
        office_floorplan(0, resolution_m=0.5)


def test_corridor_walls_have_relief() -> None:
    # A smooth office has long walls only; relief makes short steps, so count the corners.
    solid = office_floorplan(2).occupied.astype(int)
    corners = solid[1:, 1:] + solid[:-1, :-1] - solid[1:, :-1] - solid[:-1, 1:]
    assert (corners != 0).sum() > 600


def walk(occupied: np.ndarray, row: int, column: int, dr: int, dc: int) -> float:
    """Cells from the centre of a cell to the first wall in a direction, inf if none."""
    r, c, steps = row, column, 0
    while 0 <= r < occupied.shape[0] and 0 <= c < occupied.shape[1]:
        if occupied[r, c]:
            return steps - 0.5
        r, c, steps = r + dr, c + dc, steps + 1
    return math.inf


@pytest.mark.parametrize("seed", range(3))
def test_extruded_walls_stand_exactly_where_the_grid_is_occupied(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.array([FREE, OCCUPIED, UNKNOWN], np.int8), size=(23, 31), p=[0.6, 0.25, 0.15])
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-3.0, 7.0))
    scene = Scene(extrude(grid, 2.5))
    open_cells = np.argwhere(~grid.occupied)
    for dr, dc in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        rays = np.zeros((len(open_cells), 6), np.float32)
        rays[:, :2] = grid.to_point(open_cells)
        rays[:, 2] = 1.2
        rays[:, 3], rays[:, 4] = dc, dr
        expected = [walk(grid.occupied, int(r), int(c), dr, dc) * 0.05 for r, c in open_cells]
        np.testing.assert_allclose(scene.cast(rays), expected, atol=1e-4)


def test_extrusion_merges_faces_and_has_floor_and_ceiling() -> None:
    cells = np.zeros((40, 60), np.int8)
    cells[10:20, 15:45] = OCCUPIED
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    mesh = extrude(grid, 2.5)
    assert len(mesh.triangles) == 2 * (4 + 2)
    down_and_up = np.array([[0.3, 0.3, 1.0, 0, 0, -1], [0.3, 0.3, 1.0, 0, 0, 1]], np.float32)
    np.testing.assert_allclose(Scene(mesh).cast(down_and_up), [1.0, 1.5], atol=1e-5)


def corridor(width_cells: int) -> np.ndarray:
    free = np.zeros((width_cells + 4, 200), bool)
    free[2:-2, 2:-2] = True
    return free


def test_nothing_may_block_a_corridor() -> None:
    square = np.array([(0, 0), (16, 0), (16, 16), (0, 16)], float)
    passages = Passages(corridor(40), 0.05, robot_m=0.35)  # 2 m wide
    assert not passages.put(square + np.array((90, 14)))  # in the middle: 0.6 m on both sides
    assert passages.put(square + np.array((90, 3)))  # at the wall: 1.1 m left
    assert not passages.put(square + np.array((92, 26)))  # opposite of it
    assert not passages.put(square + np.array((90, 5)))  # on top of it
    assert not passages.put(square + np.array((-4, 5)))  # outside


@pytest.mark.parametrize("seed", range(3))
def test_clutter_leaves_every_way_open(seed: int) -> None:
    grid = office_floorplan(seed)
    clutter = place_clutter(grid, 80, np.random.default_rng(seed), robot_m=0.35)
    assert len(clutter) > 60
    under = covered(grid, clutter)
    assert not (under & ~grid.free).any()
    assert largest_share(grid, grid.free & ~under) > 0.97


def test_clutter_keeps_away_from_the_start() -> None:
    cells = np.full((80, 80), OCCUPIED, np.int8)
    cells[2:-2, 2:-2] = FREE
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    for seed in range(5):
        clutter = place_clutter(grid, 20, np.random.default_rng(seed), robot_m=0.3, keep_free_m=((1.0, 2.0),))
        assert clutter
        for furniture in clutter:
            outline = furniture.pose.apply(furniture.outline_m)
            assert np.linalg.norm(outline - (1.0, 2.0), axis=1).min() > 1.0
