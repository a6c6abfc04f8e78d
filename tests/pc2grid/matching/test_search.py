"""The coarse search against brute force, its compiled functions against the plain ones."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from pc2grid.geometry import F64, I64, SE2, U8
from pc2grid.matching.score import refine, score_fit
from pc2grid.matching.search import (
    BLOCK,
    MOST_POINTS,
    SQUARE,
    TILE,
    SearchMap,
    SearchParameters,
    Tiles,
    best_in_tiles,
    headings,
    search_windows,
    tile_bounds,
)
from pc2grid.matching.walls import Walls
from pc2grid.model import FREE, OCCUPIED, OccupancyGrid
from tests.helpers.simulated_drives import office, office_part

MAP = SearchMap.of(office())
FIELD, WALLS_M = MAP.field, MAP.walls.points_m
STEP = math.radians(2.0)
ALL = {"floor": 0.0, "keep": 0.0}


def plain_sums(images: U8, level: I64, points: F64, poses: F64) -> I64:
    """(B,) the sum over the points, each in its image `level` (N,), at poses (B, 3) in cells; a point whose
    level is -1 counts as on a wall."""
    height, width = images.shape[-2:]
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    j = np.floor(c * points[:, 0] - s * points[:, 1] + poses[:, :1]).astype(np.int64)
    i = np.floor(s * points[:, 0] + c * points[:, 1] + poses[:, 1:2]).astype(np.int64)
    row, column = (i // SQUARE + TILE[0]).clip(0, height - 1), (j // SQUARE + TILE[1]).clip(0, width - 1)
    values = images[level, i % SQUARE, j % SQUARE, row, column]
    return np.asarray(np.where(level < 0, 255, values).sum(axis=1), np.int64)


def plain_tile_bounds(images: U8, level: I64, points: F64, tiles: Tiles, turns: F64) -> I64:
    """(T, K) the highest sum over the points at the centres of the squares of each tile, at each heading."""
    found = np.zeros((len(tiles.corner), len(turns)), np.int64)
    for t, k in np.ndindex(found.shape):
        y, x = ((tiles.corner[t] + np.argwhere(tiles.inside[t]) + 0.5) * SQUARE).T
        poses = np.column_stack((x, y, np.full(len(x), tiles.yaw_rad[t] + turns[k])))
        found[t, k] = plain_sums(images, level, points, poses).max()
    return found


def plain_best_in_tiles(
    images: U8, level: I64, points: F64, tiles: Tiles, turns: F64, half_a_rad: float
) -> F64:
    """(N, 4) the best pose of each block of squares at each heading, and its score; in cells. All cells are
    scored, at half a step of heading to both sides. level : (N,) the image that each point is scored by."""
    cells = np.indices((2, SQUARE, SQUARE)).reshape(3, -1).T
    best = []
    for t, k in np.ndindex(len(tiles.corner), len(turns)):
        squares = np.argwhere(tiles.inside[t])
        for block in np.unique(squares // BLOCK, axis=0):
            of_block = squares[(squares // BLOCK == block).all(axis=1)] + tiles.corner[t]
            y, x = (SQUARE * of_block[:, None] + cells[:, 1:] + 0.5).reshape(-1, 2).T
            yaw = tiles.yaw_rad[t] + turns[k] + (np.tile(cells[:, 0], len(of_block)) - 0.5) * half_a_rad
            poses = np.column_stack((x, y, yaw))
            scores = plain_sums(images, level, points, poses) / (255.0 * len(points))
            best.append([*poses[scores.argmax()], scores.max()])
    return np.array(best)


def score(points: np.ndarray, pose: np.ndarray, level: np.ndarray) -> float:
    """Mean of sliding maxima `level` (N,) at points (N, 2) m moved by x, y, yaw."""
    cells = np.array([*(pose[:2] - FIELD.origin_m) / FIELD.resolution_m, pose[2]])
    total = plain_sums(MAP.images, level, points.astype(float) / FIELD.resolution_m, cells[None])[0]
    return float(total / (255.0 * len(points)))


def seen_from(truth: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Wall points of the map in the frame of a pose."""
    c, s = math.cos(truth[2]), math.sin(truth[2])
    return ((walls - truth[:2]) @ np.array([[c, -s], [s, c]])).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
@example(seed=435)
def test_the_search_misses_nothing_that_brute_force_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (40, 2)).astype(np.float32)
    start = np.array([[rng.uniform(4, 16), rng.uniform(3, 11), rng.uniform(-3, 3)]])
    one = SearchParameters(most=1, **ALL)
    found = search_windows(MAP, points, start, half_t_m=0.4, half_a_rad=0.1, parameters=one)
    steps = np.linspace(-1, 1, 12)
    exact = np.zeros(len(points), int)
    offsets = itertools.product(0.4 * steps, 0.4 * steps, 0.1 * steps)
    best = max(score(points, start[0] + np.array(offset), exact) for offset in offsets)
    # Bounds neglect half a cell, which a few of the points may need; no empty promise either.
    assert best - 0.02 <= found[0, 3] <= best + 0.35


@pytest.mark.parametrize("center", [(2.0, 7.0), (10.5, 7.0), (15.0, 4.0), (6.0, 10.0)])
def test_a_cut_out_of_the_map_is_found_where_it_was_cut(center: tuple[float, float]) -> None:
    walls = Walls.of(office_part(center))
    x, y, yaw = np.meshgrid(np.arange(1, 20, 1.0), np.arange(1, 14, 1.0), np.arange(-180, 180, 15.0))
    everywhere = np.column_stack((x.ravel(), y.ravel(), np.radians(yaw.ravel())))
    points = walls.points_m[:: -(-len(walls.points_m) // MOST_POINTS)]
    poses = search_windows(
        MAP,
        points,
        everywhere,
        half_t_m=0.5,
        half_a_rad=math.radians(7.5),
        parameters=SearchParameters(keep=0.9),
    )
    pose, _ = refine(FIELD, walls.points_m, SE2(*poses[0, :3]), (0.0, 0.0))
    assert math.dist((pose.x, pose.y), center) < 0.03
    assert abs(pose.yaw) < math.radians(0.5)
    fit = score_fit(MAP.walls, walls, pose, np.eye(3))
    assert fit.forward > 0.95 and fit.backward > 0.9 and fit.overlap > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_the_best_pose_is_found_by_what_is_far_away(seed: int) -> None:
    """Half a box turns points 20 m away farther than the sliding maxima look; that must not exclude it."""
    rng = np.random.default_rng(seed)
    cells = np.full((900, 900), FREE, np.int8)
    far, angle = rng.uniform(240, 400, 100), rng.uniform(-math.pi, math.pi, 100)
    cells[(450 + far * np.sin(angle)).astype(int), (450 + far * np.cos(angle)).astype(int)] = OCCUPIED
    posts = SearchMap.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)))
    truth = np.array([22.5, 22.5, 0.3])
    elsewhere = np.column_stack((rng.uniform(-5, 5, (150, 2)), rng.uniform(1, 5, 150)))
    found = search_windows(
        posts,
        seen_from(truth, posts.walls.points_m),
        truth + np.concatenate(([(0.3, 0.3, 0.12)], elsewhere)),
        half_t_m=0.4,
        half_a_rad=math.radians(7.8),
        parameters=SearchParameters(most=1),
    )
    assert len(found) == 1 and math.dist(found[0, :2], truth[:2]) < 0.2 and found[0, 3] > 0.9


def test_reported_poses_lie_apart_and_best_first() -> None:
    points = np.random.default_rng(0).uniform(-2, 2, (40, 2)).astype(np.float32)
    starts = np.array([(x, 7.0, yaw) for x in range(4, 16) for yaw in (0.0, 0.1, 2.0)])
    some = SearchParameters(floor=0.0, keep=0.5, most=12)
    found = search_windows(MAP, points, starts, half_t_m=0.6, half_a_rad=0.1, parameters=some)
    assert len(found) > 3 and (np.diff(found[:, 3]) <= 0).all() and found[-1, 3] >= 0.5 * found[0, 3]
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            turned = abs(math.remainder(a[2] - b[2], 2 * math.pi))
            assert np.abs(a[:2] - b[:2]).max() >= 0.5 or turned >= math.radians(10)


def test_nothing_to_search_and_too_much() -> None:
    start = np.array([[5.0, 5.0, 0.0]])
    for points, starts in ((np.zeros((0, 2)), start), (np.zeros((3, 2)), start[:0])):
        found = search_windows(MAP, points.astype(np.float32), starts, half_t_m=0.5, half_a_rad=0.1)
        assert found.shape == (0, 4)
    with pytest.raises(ValueError, match="at most"):
        points = np.zeros((MOST_POINTS + 1, 2), np.float32)
        search_windows(MAP, points, start, half_t_m=0.5, half_a_rad=0.1)
    black = np.zeros((MOST_POINTS, 2), np.float32)
    on_wall = WALLS_M[:1].astype(np.float64)
    found = search_windows(MAP, black, np.array([[*on_wall[0], 0.0]]), half_t_m=0.05, half_a_rad=0.01)
    assert found[0, 3] == pytest.approx(1.0)  # 256 times 255 still fits


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), half_m=st.floats(0.05, 1.5))
def test_leaving_out_what_would_not_be_reported_changes_nothing(seed: int, half_m: float) -> None:
    rng = np.random.default_rng(seed)
    truth = np.array([*rng.uniform((1, 1), (19, 13)), rng.uniform(-3, 3)])
    points = seen_from(truth, WALLS_M[np.hypot(*(WALLS_M - truth[:2]).T) < 5.0][:200])
    starts = np.concatenate((truth[None] + 0.02, truth + rng.uniform(-1, 1, (4, 3)) * (3, 3, 3)))
    shape = {"half_t_m": half_m, "half_a_rad": 2 * STEP}
    every = SearchParameters(step_rad=STEP, most=100, **ALL)
    good = SearchParameters(step_rad=STEP, most=100, floor=0.3, keep=0.8)
    whole = search_windows(MAP, points, starts, parameters=every, **shape)
    found = search_windows(MAP, points, starts, parameters=good, **shape)
    assert np.array_equal(found, whole[whole[:, 3] >= max(0.3, 0.8 * whole[0, 3])])


def boxes_around(rng: np.random.Generator, inside: bool) -> np.ndarray:
    """Boxes (6, 3) in cells: within the map, or over its edge and beyond; two of them have one heading."""
    height, width = FIELD.values.shape
    low, high = ((60, 60), (width - 60, height - 60)) if inside else ((-40, -40), (width + 40, 60))
    yaws = rng.uniform(-3, 3, 5)
    return np.column_stack((rng.uniform(low, high, (6, 2)), [*yaws, yaws[0]]))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), inside=st.booleans())
def test_the_compiled_functions_are_the_plain_ones(seed: int, inside: bool) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-60, 60, (25, 2))
    tiles, turns, half_a_rad = Tiles.of(boxes_around(rng, inside), 5.0), headings(0.05, 0.06), 0.025
    levels = np.vstack([rng.integers(3 - k, 6 - k, 25) for k in range(4)])
    levels[:, 0] = -1
    flat = MAP.images.reshape(-1), MAP.images.shape[-2:]
    bounds = tile_bounds(*flat, levels[0], points, tiles.corner, tiles.yaw_rad, tiles.inside, turns)
    assert np.array_equal(bounds, plain_tile_bounds(MAP.images, levels[0], points, tiles, turns))
    # What has no bound is scored everywhere, as in the plain form.
    tile, turn = (index.ravel() for index in np.indices(bounds.shape))
    unbounded = np.vstack([np.full((3, 25), -1), levels[3:]])
    every = np.full(bounds.size, 255 * 25)
    at = tiles.corner[tile], tiles.yaw_rad[tile] + turns[turn], tiles.inside, tile, every
    fast = best_in_tiles(*flat, unbounded, points, *at, half_a_rad, 0.0, 0.0)
    slow = plain_best_in_tiles(MAP.images, levels[3], points, tiles, turns, half_a_rad)
    assert np.sort(fast[:, 3]) == pytest.approx(np.sort(slow[:, 3]), abs=1e-12)
    again = plain_sums(MAP.images, levels[3], points, fast[:, :3])
    assert again / (255.0 * 25) == pytest.approx(fast[:, 3], abs=1e-12)
