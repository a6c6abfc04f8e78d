"""One map of several: what the newest session that is sure of a cell says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from signature.database.protocol import BuildingFrame, Deformation
from signature.localization.joining.building import building_map

_ = UNKNOWN


def grid(rows: list[list[int]]) -> OccupancyGrid:
    """Rows from the top down, cells of 1 m, the lower left corner at (0, 0)."""
    return OccupancyGrid(cells=np.array(rows[::-1], np.int8), resolution_m=1.0, origin_m=(0.0, 0.0))


def at(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, bend: Deformation = ()) -> BuildingFrame:
    exact = ((0.0, 0.0, 0.0),) * 3
    return BuildingFrame(name="old", T_building_session=SE2(x, y, yaw), covariance=exact, bend=bend)


OLD = grid([[OCCUPIED, OCCUPIED, OCCUPIED], [FREE, FREE, OCCUPIED]])
NEW = grid([[_, FREE, _], [_, OCCUPIED, _]])


def test_the_newest_that_knows_a_cell_decides() -> None:
    whole = building_map([(OLD, at()), (NEW, at())])
    assert whole.cells[::-1].tolist() == [[OCCUPIED, FREE, OCCUPIED], [FREE, OCCUPIED, OCCUPIED]]


def test_maps_are_moved_and_turned_into_one_frame() -> None:
    """The new one, a quarter turn counterclockwise, stands left of the old one."""
    whole = building_map([(OLD, at()), (NEW, at(0.0, 0.0, math.pi / 2))])
    assert whole.origin_m == (-2.0, 0.0)
    assert whole.cells[::-1].tolist() == [
        [_, _, _, _, _],
        [FREE, OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED],
        [_, _, FREE, FREE, OCCUPIED],
    ]


def test_a_bent_map_is_straight_in_the_building() -> None:
    """A wall of 30 m, drawn with a step for every 10 m: it leaves its line by 2 cells."""
    cells = np.zeros((9, 300), np.int8)
    for begin, row in ((0, 4), (100, 5), (200, 6)):
        cells[row, begin : begin + 100] = OCCUPIED
    drawn = OccupancyGrid(cells=cells, resolution_m=0.1, origin_m=(0.0, 0.0))
    places = tuple((x, 0.45, 0.0, -0.1 * int(x / 10.0), 0.0) for x in np.arange(0.5, 30.0).tolist())
    whole = building_map([(drawn, at(5.0, bend=places))])
    rows, columns = np.nonzero(whole.occupied)
    x, y = whole.to_point(np.column_stack((rows, columns))).T
    # Where the bend changes, cells round to one beside the line.
    assert np.abs(y - 0.45).max() < 0.1 + 1e-6 and (np.histogram(x, np.arange(5.0, 35.1))[0] >= 10).all()
    # Nothing of the map was cut off that the bend moves beyond its edges.
    assert whole.free_m2 == pytest.approx(drawn.free_m2, rel=0.02)
