"""Branch and bound against brute force, refinement, two-way scores and their covariance."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pc2grid.alignment import NEUTRAL, assess, likelihood, prepare, prepare_query, refine, search, thin_evenly
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, OccupancyGrid
from tests.drives import office, plan

MAP = office()
FIELD = prepare(MAP)


def cut(center: tuple[float, float], half_m: float = 3.0) -> OccupancyGrid:
    """Part of the office in a frame of its own, whose origin is at `center`."""
    crop = MAP.crop(center, half_m)
    return OccupancyGrid(
        cells=crop.cells,
        resolution_m=crop.resolution_m,
        origin_m=(crop.origin_m[0] - center[0], crop.origin_m[1] - center[1]),
    )


@pytest.mark.parametrize(("resolution_m", "sigma_m"), [(0.05, 0.1), (0.1, 0.1), (0.03, 0.07)])
def test_the_field_is_what_opencv_s_exact_distance_gives(resolution_m: float, sigma_m: float) -> None:
    cells = np.random.default_rng(0).choice([-1, 0, 50, 100], (90, 140), p=[0.2, 0.75, 0.03, 0.02])
    cells[:, 100:] = np.where(cells[:, 100:] == 100, 0, cells[:, 100:])
    grid = OccupancyGrid(cells=cells.astype(np.int8), resolution_m=resolution_m, origin_m=(0.0, 0.0))
    free_of_walls = (~grid.occupied).astype(np.uint8)
    distance = cv2.distanceTransform(free_of_walls, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    expected = np.exp(-0.5 * (distance * (resolution_m / sigma_m)) ** 2) * 255.0
    expected[cells < 0] = np.maximum(expected[cells < 0], NEUTRAL * 255.0)
    expected[(cells == 50)] = np.maximum(expected[cells == 50], NEUTRAL * 255.0)  # neither free nor occupied
    field, known = likelihood(grid, sigma_m)
    assert np.array_equal(field, expected.astype(np.uint8))
    assert np.array_equal(known, (cells == 0) | (cells == 100))


def all_poses() -> np.ndarray:
    x, y, yaw = np.meshgrid(np.arange(1, 20, 1.0), np.arange(1, 14, 1.0), np.arange(-180, 180, 15.0))
    return np.column_stack((x.ravel(), y.ravel(), np.radians(yaw.ravel())))


@pytest.mark.parametrize("center", [(2.0, 7.0), (10.5, 7.0), (15.0, 4.0), (6.0, 10.0)])
def test_a_cut_out_of_the_map_is_found_where_it_was_cut(center: tuple[float, float]) -> None:
    query = prepare_query(cut(center), center_m=(0.0, 0.0))
    poses = search(
        FIELD, query.walls_m[::2], all_poses(), half_t_m=0.5, half_a_rad=math.radians(7.5), keep=0.9
    )
    pose, _ = refine(FIELD, query, SE2(*poses[0, :3]))
    assert math.dist((pose.x, pose.y), center) < 0.03
    assert abs(pose.yaw) < math.radians(0.5)
    fit = assess(FIELD, query, pose, np.eye(3))
    assert fit.forward > 0.95 and fit.backward > 0.9 and fit.overlap > 0.99


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
@example(seed=435)
def test_the_search_misses_nothing_that_brute_force_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (40, 2)).astype(np.float32)
    start = np.array([[rng.uniform(4, 16), rng.uniform(3, 11), rng.uniform(-3, 3)]])
    found = search(
        FIELD, points, start, half_t_m=0.4, half_a_rad=0.1, finest_m=0.05, floor=0.0, keep=0.0, most=1
    )
    steps = np.linspace(-1, 1, 12)
    best = -1.0
    for dx in 0.4 * steps:
        for dy in 0.4 * steps:
            for da in 0.1 * steps:
                x, y, yaw = start[0] + (dx, dy, da)
                cells = np.floor((SE2(x, y, yaw).apply(points) - FIELD.origin_m) / 0.05).astype(int)
                best = max(best, FIELD.levels[0][cells[:, 1], cells[:, 0]].mean() / 255)
    # Bounds neglect half a cell, which a few of the points may need; no empty promise either.
    assert best - 0.02 <= found[0, 3] <= best + 0.35


def test_the_pose_found_turns_with_the_query() -> None:
    query = prepare_query(cut((10.5, 7.0)))
    turned = SE2(1.0, -2.0, 2.1)
    moved = prepare_query(cut((10.5, 7.0)))
    moved = type(moved)(
        walls_m=turned.apply(query.walls_m).astype(np.float32),
        weights=query.weights,
        field=query.field,
        known=query.known,
        resolution_m=query.resolution_m,
        origin_m=query.origin_m,
        center_m=(1.0, -2.0),
    )
    guess = SE2(10.6, 7.1, 0.03) @ turned.inverse()
    pose, _ = refine(FIELD, moved, guess)
    there = pose @ turned
    assert math.dist((there.x, there.y), (10.5, 7.0)) < 0.03 and abs(there.yaw) < 0.01


def test_a_corridor_is_certain_across_and_uncertain_along() -> None:
    corridor = plan(30, 2, [])
    query = prepare_query(
        OccupancyGrid(cells=corridor.cells[:, 200:300], resolution_m=0.05, origin_m=(-2.5, -1.0))
    )
    _, covariance = refine(prepare(corridor), query, SE2(12.5, 1.0, 0.0))
    along, across = math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])
    assert across < 0.05 < 0.3 < along


def test_the_other_side_objects_where_the_map_has_walls_and_the_query_saw_none() -> None:
    query_grid = cut((15.0, 4.0))
    emptied = query_grid.cells.copy()
    here = query_grid.to_cell(np.array([[0.0, -1.0], [3.0, -1.0]]))
    emptied[here[0, 0] - 3 : here[0, 0] + 4, here[0, 1] : here[1, 1]] = 0
    seen_through = OccupancyGrid(cells=emptied, resolution_m=0.05, origin_m=query_grid.origin_m)
    pose = SE2(15.0, 4.0, 0.0)
    whole, gone = (assess(FIELD, prepare_query(g), pose, np.eye(3)) for g in (query_grid, seen_through))
    assert gone.forward > 0.95
    assert gone.backward < whole.backward - 0.1


def test_unknown_ground_speaks_neither_for_nor_against() -> None:
    half = MAP.cells.copy()
    half[:, 200:] = UNKNOWN
    field = prepare(OccupancyGrid(cells=half, resolution_m=0.05, origin_m=(0.0, 0.0)))
    fit = assess(field, prepare_query(cut((10.0, 7.0))), SE2(10.0, 7.0, 0.0), np.eye(3))
    assert 0.3 < fit.overlap < 0.7
    assert fit.forward == pytest.approx(fit.overlap + NEUTRAL * (1 - fit.overlap), abs=0.03)


def test_a_wall_speaks_by_the_size_of_what_it_belongs_to() -> None:
    cells = np.zeros((100, 200), np.int8)
    cells[10, 10:110] = 100  # 5 m of wall,
    cells[10, 60] = 0  # with a gap of one cell
    cells[50:60, 20:30] = 100  # a box of 0.5 m
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    query = prepare_query(grid)
    box = query.walls_m[:, 1] > 1.5
    assert (query.weights[~box] == 1.0).all() and box.sum() >= 25
    assert query.weights[box] == pytest.approx(0.6 / 2.0, abs=0.03)  # a cell wider on each side
    assert query.walls == pytest.approx((~box).sum() + 0.3 * box.sum(), rel=0.05)


def test_what_was_moved_costs_less_than_a_missing_wall() -> None:
    """The same number of cells: two boxes that are gone from the map, or a stretch of its wall."""
    here = cut((10.5, 7.0))
    fits = []
    for things in ([(0, 0), (0, 14)], [(0, 0), (0, 8)]):
        cells = here.cells.copy()
        row, column = here.to_cell(np.array([[0.0, 0.0]]))[0]
        for up, right in things:
            cells[row + up : row + up + 8, column + right : column + right + 8] = 100
        grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=here.origin_m)
        fits.append(assess(FIELD, prepare_query(grid), SE2(10.5, 7.0, 0.0), np.eye(3)).forward)
    apart, joined = fits
    assert joined < apart < 1.0


@pytest.mark.parametrize("value", [UNKNOWN, 0, 100])
def test_empty_and_full_grids_give_an_answer(value: int) -> None:
    grid = OccupancyGrid(cells=np.full((40, 40), value, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    query = prepare_query(grid)
    pose, covariance = refine(FIELD, query, SE2(5, 5, 0))
    fit = assess(FIELD, query, pose, covariance)
    assert np.isfinite(covariance).all() and 0.0 <= fit.score <= 1.0
    assert len(search(prepare(grid), query.walls_m[:0], np.zeros((1, 3)))) == 0


def test_thinning_keeps_one_point_a_square_and_the_order() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (500, 2))
    kept = thin_evenly(points, 0.5)
    squares = np.floor(points / 0.5).astype(int)
    assert (np.diff(kept) > 0).all()
    assert len(kept) == len(np.unique(squares, axis=0)) == len(np.unique(squares[kept], axis=0))
