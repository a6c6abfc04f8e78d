"""One map of several: the newest session that knows a cell decides."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from signature.localization.joining.building_map import building_map

_ = UNKNOWN


def grid(rows: list[list[int]]) -> OccupancyGrid:
    """Rows from the top down, cells of 1 m, the lower left corner at (0, 0)."""
    return OccupancyGrid(cells=np.array(rows[::-1], np.int8), resolution_m=1.0, origin_m=(0.0, 0.0))


OLD = grid([[OCCUPIED, OCCUPIED, OCCUPIED], [FREE, FREE, OCCUPIED]])
NEW = grid([[_, FREE, _], [_, OCCUPIED, _]])


def test_the_newest_that_knows_a_cell_decides() -> None:
    whole = building_map([(OLD, SE2()), (NEW, SE2())])
    assert whole.cells[::-1].tolist() == [[OCCUPIED, FREE, OCCUPIED], [FREE, OCCUPIED, OCCUPIED]]


def test_maps_are_moved_and_turned_into_one_frame() -> None:
    """The new one, a quarter turn counterclockwise, stands left of the old one."""
    whole = building_map([(OLD, SE2()), (NEW, SE2(0.0, 0.0, math.pi / 2))])
    assert whole.origin_m == (-2.0, 0.0)
    assert whole.cells[::-1].tolist() == [
        [_, _, _, _, _],
        [FREE, OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED],
        [_, _, FREE, FREE, OCCUPIED],
    ]


def test_no_map_is_no_building() -> None:
    with pytest.raises(ValueError, match="without a map"):
        building_map([])
