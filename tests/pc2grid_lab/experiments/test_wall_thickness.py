"""Walls of a known thickness, straight and turned."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.model import OccupancyGrid
from pc2grid_lab.experiments.wall_thickness import wall_thickness


def wall(thickness_m: float, turned_rad: float) -> OccupancyGrid:
    """The map of a wall of 8 m."""
    y, x = np.mgrid[-5.0:5.0:0.05, -5.0:5.0:0.05]
    along = np.cos(turned_rad) * x + np.sin(turned_rad) * y
    across = np.cos(turned_rad) * y - np.sin(turned_rad) * x
    inside = (np.abs(along) < 4.0) & (np.abs(across) < 0.5 * thickness_m)
    return OccupancyGrid(cells=inside * np.int8(100), resolution_m=0.05, origin_m=(-5.0, -5.0))


@pytest.mark.parametrize("turned_rad", [0.0, 0.4, np.pi / 4, 1.3])
@pytest.mark.parametrize("thickness_m", [0.1, 0.2, 0.4])
def test_a_wall_is_as_thick_as_it_is_drawn(thickness_m: float, turned_rad: float) -> None:
    found = wall_thickness(wall(thickness_m, turned_rad))
    assert len(found) > 30  # a point each 0.2 m
    assert np.median(found) == pytest.approx(thickness_m, abs=0.051)  # a cell, as its edges are rounded to


def test_what_is_short_is_no_wall() -> None:
    cells = np.zeros((50, 50), np.int8)
    cells[20:30, 20:30] = 100
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    assert not len(wall_thickness(grid))
    assert not len(wall_thickness(OccupancyGrid(cells=0 * cells, resolution_m=0.05, origin_m=(0.0, 0.0))))
