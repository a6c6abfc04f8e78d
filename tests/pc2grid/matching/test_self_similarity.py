"""A bare corridor fits onto itself, slid along; a corridor with rooms does not."""

import numpy as np
import pytest

from pc2grid.matching.score import self_similarity
from pc2grid.matching.walls import Walls
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

RESOLUTION_M = 0.05


def corridor(*rooms_m: tuple[float, float], length_m: float = 16.0, turned: bool = False) -> OccupancyGrid:
    """A corridor along x (turned: along y), 2 m wide, with a room of 3 m depth beside it from each first to
    each second of `rooms_m`."""
    cells = np.full((120, round(length_m / RESOLUTION_M)), UNKNOWN, np.int8)
    cells[10:50] = FREE
    cells[[10, 49]] = OCCUPIED
    for from_m, to_m in rooms_m:
        first, last = round(from_m / RESOLUTION_M), round(to_m / RESOLUTION_M)
        cells[49:110, first:last] = OCCUPIED
        cells[49:109, first + 1 : last - 1] = FREE
    if turned:
        cells = np.ascontiguousarray(cells.T)
    return OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=(-3.0, 5.0))


@pytest.mark.parametrize("turned", [False, True])
def test_a_bare_corridor_is_like_itself_in_any_direction(turned: bool) -> None:
    like = self_similarity(Walls.of(corridor(turned=turned)))
    assert like > 0.9  # not 1: squares of 0.1 m average a wall of 0.05 m with what is beside it


def test_rooms_of_different_sizes_make_it_unlike() -> None:
    alike = [
        self_similarity(Walls.of(corridor(*rooms)))
        for rooms in ((), ((2.0, 5.0),), ((2.0, 5.0), (6.0, 10.5), (11.0, 12.5)))
    ]
    assert alike[0] > alike[1] + 0.05 and alike[1] > alike[2]


def test_equal_rooms_side_by_side_are_like_each_other() -> None:
    equal = corridor((0.0, 4.0), (4.0, 8.0), (8.0, 12.0), (12.0, 16.0))
    different = corridor((0.0, 2.5), (2.5, 8.0), (8.0, 11.5), (11.5, 16.0))
    assert self_similarity(Walls.of(equal)) > self_similarity(Walls.of(different)) + 0.2


def test_what_hardly_overlaps_with_itself_is_not_compared() -> None:
    cells = np.full((40, 40), UNKNOWN, np.int8)
    cells[5, 5:35] = OCCUPIED
    line = OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0))
    assert self_similarity(Walls.of(line)) == 0.0
    empty = OccupancyGrid(cells=np.full((40, 40), FREE, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    assert self_similarity(Walls.of(empty)) == 0.0
