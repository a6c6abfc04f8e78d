"""Wall points, their weights, and thinning, against plain counterparts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.ndimage import distance_transform_edt

from pc2grid.matching import walls as matching_walls
from pc2grid.matching.walls import (
    LIKELIHOOD,
    WALLS,
    LikelihoodField,
    LikelihoodParameters,
    WallParameters,
    Walls,
    thin_evenly,
)
from pc2grid.model import FREE, OCCUPIED, THING, UNKNOWN, OccupancyGrid


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


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 300), far_m=st.sampled_from([0.0, 1e6]))
def test_thinning_keeps_the_first_point_of_each_square(seed: int, count: int, far_m: float) -> None:
    points = np.random.default_rng(seed).normal(far_m, 2.0, (count, 2))
    squares = np.floor(points / 0.4).astype(np.int64)
    first = np.unique(squares, axis=0, return_index=True)[1]
    assert np.array_equal(thin_evenly(points, 0.4), np.sort(first))


def drawn(thick_m: float, resolution_m: float) -> OccupancyGrid:
    """A corridor of 2 m between walls, x from 0 to 8 m, with unknown ground behind them."""
    cells = np.full((round(6.0 / resolution_m), round(8.0 / resolution_m)), UNKNOWN, np.int8)
    free, wall = round(2.0 / resolution_m), max(round(thick_m / resolution_m), 1)
    cells[free - wall : 2 * free + wall] = OCCUPIED
    cells[free : 2 * free] = FREE
    return OccupancyGrid(cells=cells, resolution_m=resolution_m, origin_m=(0.0, 0.0))


@pytest.mark.parametrize("resolution_m", [0.02, 0.05, 0.1])
def test_inside_a_thick_wall_no_ray_has_ended(resolution_m: float) -> None:
    """Points 0.4 m behind its face fit nowhere, and are no longer taken for points on the wall."""
    grid = drawn(0.6, resolution_m)
    inside_m, face_m = ([(x, y) for x in np.arange(1.0, 7.0, 0.1)] for y in (1.6, 2.0 - 0.5 * resolution_m))
    whole, seen = (Walls.of(grid, drawn=only) for only in (False, True))
    for walls, fits in ((whole, True), (seen, False)):
        likelihood, known = walls.field.at(np.array(inside_m))
        assert known.all() and ((likelihood > LIKELIHOOD.neutral).all() if fits else likelihood.max() < 0.05)
        assert (walls.field.at(np.array(face_m))[0] == 1.0).all()
    assert seen.points_m[:, 1].min() > 2.0 - 2.0 * LIKELIHOOD.sigma_m and len(seen.points_m) < len(
        whole.points_m
    )


@pytest.mark.parametrize(("thick_m", "resolution_m"), [(0.1, 0.05), (0.25, 0.25), (0.1, 0.02)])
def test_thin_walls_stay_as_they_are(thick_m: float, resolution_m: float) -> None:
    grid = drawn(thick_m, resolution_m)
    whole, seen = (Walls.of(grid, drawn=only) for only in (False, True))
    assert np.array_equal(whole.points_m, seen.points_m)
    assert np.array_equal(whole.field.values, seen.field.values)


def test_a_wall_before_which_no_free_ground_is_known_stays_as_it_is() -> None:
    """Far walls of a single scan: what is free between its rays is not known."""
    cells = drawn(0.1, 0.05).cells.copy()
    cells[100, ::7] = OCCUPIED
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    far = Walls.of(grid, drawn=True).points_m[:, 1] > 4.5
    assert far.sum() == len(cells[100, ::7])


OF_A_LASER = Walls.of(
    OccupancyGrid(cells=np.zeros((40, 40), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
)


def test_a_laser_must_have_seen_what_stands_at_all_heights() -> None:
    """A table top, under and over which rays have passed, and a cupboard, of which the upper half was seen:
    nothing has passed below. Both explain what a laser sees. It may miss the table, and not the cupboard. Who
    has looked at all heights must have seen both."""
    cells, heights = np.zeros((2, 40, 40), np.int8)
    cells[10, 5:35], heights[10, 5:35] = THING, 0b101_010
    cells[11:15, 5:35], heights[11:15, 5:35] = THING, 0b101_010
    cells[30, 5:35], heights[30, 5:35] = OCCUPIED, 0b000_110
    walls = Walls.of(OccupancyGrid(cells=cells, heights=heights, resolution_m=0.05, origin_m=(0.0, 0.0)))
    assert (walls.field.values[[12, 30], 10:30] == 255).all()
    missed, seen = walls.facing(OF_A_LASER), walls.facing(walls)
    assert np.allclose(missed.points_m[:, 1], 30.5 * 0.05)
    table = seen.points_m[:, 1] < 1.0
    assert table.any() and missed.weight == pytest.approx(float(seen.weights[~table].sum()))
    # A thing, 1.6 m long with a cell on each side.
    assert seen.weights[table] == pytest.approx(WALLS.movable * 1.6 / WALLS.fixed_m)


def test_of_a_thing_its_edges_must_have_been_seen_and_not_its_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    cells = np.zeros((40, 40), np.int8)
    cells[10:30, 10:30] = OCCUPIED
    grid = OccupancyGrid(cells=cells, heights=np.zeros_like(cells), resolution_m=0.05, origin_m=(0.0, 0.0))
    monkeypatch.setattr(matching_walls, "WALLS", WallParameters(spacing_m=0.05))
    walls = Walls.of(grid)
    # What stands at heights that are not known stands at all of them.
    assert len(walls.facing(OF_A_LASER).points_m) == len(walls.facing(walls).points_m) == 4 * 19


@pytest.mark.parametrize(
    ("mine_m", "other_m", "only_explain"),
    [(0.1, 2.0, True), (2.0, 0.1, False), (0.1, 0.4, False), (None, 2.0, False), (0.0, 2.0, False)],
)
def test_a_laser_clearly_above_need_not_have_seen_anything(
    mine_m: float | None, other_m: float, only_explain: bool
) -> None:
    """Of a laser that tf does not lift above its base, nobody has said how high it is."""
    mine, other = replace(OF_A_LASER, height_m=mine_m), replace(OF_A_LASER, height_m=other_m)
    assert mine.facing(other).only_explain is only_explain


# --- The likelihood field against its definition, with distances by scipy ---


def a_grid(resolution_m: float = 0.05) -> OccupancyGrid:
    cells = np.random.default_rng(0).choice([-1, 0, 50, 100], (90, 140), p=[0.2, 0.75, 0.03, 0.02])
    cells[:, 100:] = np.where(cells[:, 100:] == 100, 0, cells[:, 100:])
    return OccupancyGrid(cells=cells.astype(np.int8), resolution_m=resolution_m, origin_m=(-1.0, 2.0))


@pytest.mark.parametrize(("resolution_m", "sigma_m"), [(0.05, 0.1), (0.1, 0.1), (0.03, 0.07)])
def test_the_field_is_a_gaussian_of_the_exact_distance(
    resolution_m: float, sigma_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = a_grid(resolution_m)
    distance = distance_transform_edt(~grid.occupied)
    expected = np.exp(-0.5 * (distance * (resolution_m / sigma_m)) ** 2) * 255.0
    unknown = ~(grid.occupied | grid.free)  # never observed, or neither free nor occupied
    expected[unknown] = np.maximum(expected[unknown], LIKELIHOOD.neutral * 255.0)
    monkeypatch.setattr(matching_walls, "LIKELIHOOD", LikelihoodParameters(sigma_m=sigma_m))
    field = LikelihoodField.of(grid, grid.occupied)
    assert np.abs(field.values - np.floor(expected)).max() <= 1  # float32 against float64
    assert np.mean(field.values == np.floor(expected)) > 0.999
    assert np.array_equal(field.known, ~unknown)


def test_points_are_looked_up_in_their_cells_and_outside_nothing_is_known() -> None:
    grid = a_grid()
    field = LikelihoodField.of(grid, grid.occupied)
    cells = np.argwhere(grid.occupied)
    likelihood, known = field.at(grid.to_point(cells))
    assert (likelihood == 1.0).all() and known.all()
    likelihood, known = field.at(np.array([[-1.01, 3.0], [0.0, 1.99], [6.01, 3.0], [0.0, 6.51]]))
    assert not likelihood.any() and not known.any()
