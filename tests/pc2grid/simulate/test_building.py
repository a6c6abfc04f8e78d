"""Floor plans, their walls in space, and what is put into them."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.simulate.plan import clearance_m, office_floorplan
from pc2grid.simulate.scene import covered, place_clutter


def largest_share(grid: OccupancyGrid, free: np.ndarray, robot_m: float = 0.35) -> float:
    """Share of the passable cells that a robot can reach from one another."""
    from scipy import ndimage

    labels, _ = ndimage.label(clearance_m(free, grid.resolution_m) >= robot_m, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    return float(sizes.max() / sizes.sum())


@pytest.mark.parametrize("seed", [0, 1, 2])  # a comb, a ladder and a ring of corridors
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
    first = office_floorplan(3)
    assert np.array_equal(office_floorplan(3).cells, first.cells)
    assert (office_floorplan(4).cells != first.cells).mean() > 0.02


def test_clutter_leaves_every_way_open() -> None:
    grid = office_floorplan(0)
    clutter = place_clutter(grid, 80, np.random.default_rng(0), robot_m=0.35)
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
