"""Two-way scores: what supports a pose, what contradicts it, and what does not count."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.matching.likelihood_field import LIKELIHOOD
from pc2grid.matching.refinement import refine
from pc2grid.matching.two_way_score import score_fit
from pc2grid.matching.walls import Walls
from pc2grid.matching.window_search import SearchMap, search_windows
from pc2grid.model import UNKNOWN, OccupancyGrid
from tests.helpers.simulated_drives import office, office_part

OFFICE = office()
TARGET = SearchMap.of(OFFICE)


def test_the_map_objects_where_it_has_walls_and_the_query_saw_none() -> None:
    query_grid = office_part((15.0, 4.0))
    emptied = query_grid.cells.copy()
    here = query_grid.to_cell(np.array([[0.0, -1.0], [3.0, -1.0]]))
    emptied[here[0, 0] - 3 : here[0, 0] + 4, here[0, 1] : here[1, 1]] = 0
    seen_through = OccupancyGrid(cells=emptied, resolution_m=0.05, origin_m=query_grid.origin_m)
    pose = SE2(15.0, 4.0, 0.0)
    whole, gone = (score_fit(TARGET.walls, Walls.of(g), pose, np.eye(3)) for g in (query_grid, seen_through))
    assert gone.forward > 0.95
    assert gone.backward < whole.backward - 0.1


def test_unknown_ground_is_neutral() -> None:
    half = OFFICE.cells.copy()
    half[:, 200:] = UNKNOWN
    walls = Walls.of(OccupancyGrid(cells=half, resolution_m=0.05, origin_m=(0.0, 0.0)))
    fit = score_fit(walls, Walls.of(office_part((10.0, 7.0))), SE2(10.0, 7.0, 0.0), np.eye(3))
    assert 0.3 < fit.overlap < 0.7
    assert fit.forward == pytest.approx(fit.overlap + LIKELIHOOD.neutral * (1 - fit.overlap), abs=0.03)


def test_what_was_moved_costs_less_than_a_missing_wall() -> None:
    """The same number of cells: two boxes that are gone from the map, or a stretch of its wall."""
    here = office_part((10.5, 7.0))
    fits = []
    for things in ([(0, 0), (0, 14)], [(0, 0), (0, 8)]):
        cells = here.cells.copy()
        row, column = here.to_cell(np.array([[0.0, 0.0]]))[0]
        for up, right in things:
            cells[row + up : row + up + 8, column + right : column + right + 8] = 100
        walls = Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=here.origin_m))
        fits.append(score_fit(TARGET.walls, walls, SE2(10.5, 7.0, 0.0), np.eye(3)).forward)
    apart, joined = fits
    assert joined < apart < 1.0


@pytest.mark.parametrize("value", [UNKNOWN, 0, 100])
def test_empty_and_full_grids_give_an_answer(value: int) -> None:
    grid = OccupancyGrid(cells=np.full((40, 40), value, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    walls = Walls.of(grid)
    pose, covariance = refine(TARGET.field, walls.points_m, SE2(5, 5, 0), (0.0, 0.0))
    fit = score_fit(TARGET.walls, walls, pose, covariance)
    assert np.isfinite(covariance).all() and 0.0 <= fit.score <= 1.0
    found = search_windows(
        SearchMap.of(grid), walls.points_m[:0], np.zeros((1, 3)), half_t_m=0.4, half_a_rad=0.1
    )
    assert len(found) == 0
