"""Which wall points fit, which are contradicted, and which the map cannot judge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.matching.score import Support, agreement
from pc2grid.matching.walls import Walls
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.helpers.simulated_drives import office, office_part

OFFICE = office()
HERE = SE2(10.0, 7.0, 0.0)


def with_block(grid: OccupancyGrid, x_m: float, y_m: float, value: int) -> OccupancyGrid:
    """The grid with a square of half a metre around a point set to one value."""
    cells = grid.cells.copy()
    row, column = grid.to_cell(np.array([[x_m, y_m]]))[0]
    cells[row - 5 : row + 6, column - 5 : column + 6] = value
    return replace(grid, cells=cells)


def test_a_query_at_its_own_place_fits_and_misses_nothing() -> None:
    found = agreement(Walls.of(OFFICE), Walls.of(office_part((10.0, 7.0))), HERE)
    assert (found.support == Support.FITS).all()
    assert len(found.missed_m) == 0
    assert found.share(Support.FITS) == 1.0


def test_a_thing_that_only_the_query_has_is_contradicted_where_it_stands() -> None:
    query = Walls.of(with_block(office_part((10.0, 7.0)), 0.0, 0.0, OCCUPIED))
    found = agreement(Walls.of(OFFICE), query, HERE)
    against = HERE.apply(found.points_m[found.support == Support.CONTRADICTED])
    assert len(against) > 10
    assert np.abs(against - (10.0, 7.0)).max() < 0.35
    assert len(found.missed_m) == 0


def test_a_thing_that_only_the_map_has_is_missed_where_it_stands() -> None:
    target = Walls.of(with_block(OFFICE, 10.0, 7.0, OCCUPIED))
    found = agreement(target, Walls.of(office_part((10.0, 7.0))), HERE)
    assert (found.support == Support.FITS).all()
    assert len(found.missed_m) > 10
    assert np.abs(found.missed_m - (10.0, 7.0)).max() < 0.35


def test_where_the_map_knows_nothing_it_says_nothing() -> None:
    half = OFFICE.cells.copy()
    half[:, 200:] = UNKNOWN
    query = Walls.of(office_part((10.0, 7.0)))
    found = agreement(Walls.of(replace(OFFICE, cells=half)), query, HERE)
    east = HERE.apply(found.points_m)[:, 0] > 10.1
    assert (found.support[east] == Support.UNKNOWN).all()
    assert (found.support[~east] != Support.UNKNOWN).mean() > 0.95


@pytest.mark.parametrize("value", [UNKNOWN, FREE])
def test_a_query_without_walls_has_no_shares(value: int) -> None:
    nothing = OccupancyGrid(cells=np.full((40, 40), value, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    found = agreement(Walls.of(OFFICE), Walls.of(nothing), HERE)
    assert found.points_m.shape == (0, 2)
    assert [found.share(kind) for kind in Support] == [0.0, 0.0, 0.0]
