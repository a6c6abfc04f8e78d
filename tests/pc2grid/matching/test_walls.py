"""Wall points, their weights, and thinning, against plain counterparts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from pc2grid.matching.walls import WALLS, Walls, at_all_heights, steadiness, thin_evenly
from pc2grid.model import OCCUPIED, UNKNOWN, OccupancyGrid


def test_a_wall_point_counts_by_the_size_of_its_object() -> None:
    cells = np.zeros((100, 200), np.int8)
    cells[10, 10:110] = 100  # 5 m of wall,
    cells[10, 60] = 0  # with a gap of one cell
    cells[50:60, 20:30] = 100  # a box of 0.5 m
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    walls = Walls.of(grid)
    box = walls.points_m[:, 1] > 1.5
    assert (walls.weights[~box] == 1.0).all() and box.sum() >= 25
    assert walls.weights[box] == pytest.approx(0.6 / 2.0, abs=0.03)  # a cell wider on each side
    assert walls.weight == pytest.approx((~box).sum() + 0.3 * box.sum(), rel=0.05)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 1.0])
def test_an_object_is_as_long_as_its_connected_component(share: float) -> None:
    occupied = np.random.default_rng(0).random((60, 90)) < share
    cells = np.argwhere(occupied)[::2]
    joined = ndimage.binary_dilation(occupied, np.ones((3, 3)))
    labels, _ = ndimage.label(joined, np.ones((3, 3)))
    boxes = ndimage.find_objects(labels)
    longer = np.array([max(s.stop - s.start for s in boxes[labels[i, j] - 1]) for i, j in cells])
    expected = np.minimum(longer * 0.05 / WALLS.fixed_m, 1.0)
    assert np.allclose(steadiness(occupied, cells, 0.05), expected)


def test_thinning_keeps_one_point_a_square_and_the_order() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (500, 2))
    kept = thin_evenly(points, 0.5)
    squares = np.floor(points / 0.5).astype(int)
    assert (np.diff(kept) > 0).all()
    assert len(kept) == len(np.unique(squares, axis=0)) == len(np.unique(squares[kept], axis=0))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 300), far_m=st.sampled_from([0.0, 1e6]))
def test_thinning_keeps_the_first_point_of_each_square(seed: int, count: int, far_m: float) -> None:
    points = np.random.default_rng(seed).normal(far_m, 2.0, (count, 2))
    squares = np.floor(points / 0.4).astype(np.int64)
    first = np.unique(squares, axis=0, return_index=True)[1]
    assert np.array_equal(thin_evenly(points, 0.4), np.sort(first))


def test_a_laser_sees_what_stands_at_all_heights() -> None:
    """A table top, under and over which rays have passed, and a cupboard, of which the upper half was seen:
    nothing has passed below. A laser may see the table or not, and sees the cupboard at any height."""
    cells, heights = np.zeros((2, 40, 40), np.int8)
    cells[10, 5:35], heights[10, 5:35] = OCCUPIED, 0b101_010
    cells[30, 5:35], heights[30, 5:35] = OCCUPIED, 0b000_110
    grid = OccupancyGrid(cells=cells, heights=heights, resolution_m=0.05, origin_m=(0.0, 0.0))
    seen = at_all_heights(grid)
    assert set(seen.cells[10, 5:35].tolist()) == {UNKNOWN}
    assert set(seen.cells[30, 5:35].tolist()) == {OCCUPIED}
    assert seen.free[20].all()
    assert seen.heights is None


def test_a_laser_sees_the_rim_of_a_thing_and_not_its_inside() -> None:
    cells = np.zeros((40, 40), np.int8)
    cells[10:30, 10:30] = OCCUPIED
    grid = OccupancyGrid(cells=cells, heights=np.zeros_like(cells), resolution_m=0.05, origin_m=(0.0, 0.0))
    seen = at_all_heights(grid)
    assert (seen.cells[11:29, 11:29] == UNKNOWN).all()
    assert np.count_nonzero(seen.occupied) == 4 * 19  # whose heights are not known stands at all of them
