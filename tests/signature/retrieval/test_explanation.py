"""What explains a place: the signatures of the query on top of those of the map."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid
from signature.localization.shown.page import compare_views
from tests.helpers.simulated_drives import office

SIGHT_M = 5.0
VIEWS_M = ((3.0, 7.0), (9.0, 7.0))
"""In the corridor of the office."""


def quarter_turned(grid: OccupancyGrid) -> tuple[OccupancyGrid, SE2]:
    """The same map in a frame that is turned by 90 degrees, and the pose of that frame in the map's."""
    cells = np.ascontiguousarray(np.rot90(grid.cells, axes=(1, 0)))
    turned = OccupancyGrid(cells=cells, resolution_m=grid.resolution_m, origin_m=(0.0, 0.0))
    # Row r, column c of the map is row c, column H - 1 - r of the turned one: x' = H - y, y' = x.
    return turned, SE2(0.0, grid.cells.shape[0] * grid.resolution_m, -math.pi / 2)


def test_where_the_query_is_the_map_all_signatures_coincide_and_speak_for_one_place() -> None:
    for view in compare_views(office(), VIEWS_M, office(), SE2(), SIGHT_M):
        for name in ("boundary", "freespace", "symmetry"):
            np.testing.assert_array_equal(getattr(view.query, name), getattr(view.map, name))
        assert view.log_ratio is not None and view.log_ratio > 0.0
        # Histograms are shares of all pairs.
        assert math.isclose(view.map.boundary.sum(), 1.0, abs_tol=1e-6)
        assert math.isclose(view.map.freespace.sum(), 1.0, abs_tol=1e-6)


def test_a_turned_query_is_shown_in_the_frame_of_the_map() -> None:
    grid, T_map_query = quarter_turned(office())
    views_m = [tuple(xy) for xy in T_map_query.inverse().apply(np.array(VIEWS_M)).tolist()]
    for view in compare_views(grid, views_m, office(), T_map_query, SIGHT_M):
        # Rays start at cells, so that a turned one may end 5 cm earlier, of the 0.5 m of a mirrored pair.
        assert np.abs(view.query.symmetry - view.map.symmetry).mean() < 0.05
        assert np.abs(view.query.boundary - view.map.boundary).sum() < 0.3
        assert view.log_ratio is not None and view.log_ratio > 0.0


def test_a_wrong_place_and_one_without_floor_can_be_told() -> None:
    (right, _), (wrong, _) = (
        compare_views(office(), VIEWS_M, office(), SE2(*at), SIGHT_M) for at in ((0.0, 0.0), (6.5, -4.0))
    )
    assert right.log_ratio is not None and wrong.log_ratio is not None
    assert wrong.log_ratio < right.log_ratio
    outside = compare_views(office(), VIEWS_M, office(), SE2(-100.0, 0.0), SIGHT_M)
    assert [view.log_ratio for view in outside] == [None, None]
    assert compare_views(office(), (), office(), SE2(), SIGHT_M) == ()
