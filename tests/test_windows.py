"""Windowed matching against brute force, and against the tree that opens only what it must."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pc2grid.alignment import NEUTRAL, levels_for, prepare, search
from pc2grid.windows import MOST_POINTS, search_windows
from tests.drives import office

FIELD = prepare(office())
STEP = math.radians(2.0)


def score(points: np.ndarray, pose: np.ndarray, exact: bool) -> float:
    """Mean likelihood of points (N, 2) m at x, y, yaw; `exact`: or the most within half a cell and step."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    moved = points.astype(np.float64) @ [[c, s], [-s, c]] + pose[:2]
    cells = np.floor((moved - FIELD.origin_m) / FIELD.resolution_m).astype(int)
    reach = np.asarray(FIELD.reaches_m) / FIELD.resolution_m
    distance = (np.hypot(*points.T) / FIELD.resolution_m).astype(np.float32)
    level = np.zeros(len(points), int) if exact else levels_for(distance, 0.5, STEP / 2, reach)
    _, height, width = FIELD.levels.shape
    inside = ((cells >= 0) & (cells < (width, height))).all(axis=1)
    x, y = np.where(inside[:, None], cells, 0).T
    return float(np.where(inside, FIELD.levels[level, y, x], int(255 * NEUTRAL)).mean() / 255)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), corner=st.booleans())
def test_the_best_pose_is_the_best_of_all_in_the_box(seed: int, corner: bool) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5, 5, (30, 2)).astype(np.float32)
    # Near a corner of the map, most windows hang over its edge.
    start = np.array([[*((0.3, 0.3) if corner else rng.uniform(3, 11, 2)), rng.uniform(-3, 3)]])
    found = search_windows(
        FIELD, points, start, half_t_m=0.2, half_a_rad=3 * STEP / 2, step_rad=STEP, floor=0.0, keep=0.0
    )
    steps, turns = FIELD.resolution_m * np.arange(-4, 5), STEP * np.arange(-1, 2)
    poses = start[0] + np.array([(dx, dy, da) for dx in steps for dy in steps for da in turns])
    everywhere = [score(points, pose, exact=False) for pose in poses]
    # A coordinate on the border of two cells may be rounded either way.
    assert found[0, 3] == pytest.approx(max(everywhere), abs=0.02)
    assert score(points, found[0, :3], exact=False) == pytest.approx(found[0, 3], abs=0.02)
    within = start[0] + rng.uniform(-1, 1, (200, 3)) * (0.2, 0.2, 3 * STEP / 2)
    assert max(score(points, pose, exact=True) for pose in within) <= found[0, 3] + 0.02


@pytest.mark.parametrize("count", [1, 3, 4, 90])
def test_the_tree_finds_the_same_places(count: int) -> None:
    rng = np.random.default_rng(count)
    truth = np.array([10.3, 7.1, 0.4])
    walls = FIELD.walls_m[np.hypot(*(FIELD.walls_m - truth[:2]).T) < 4.0]
    walls = walls[rng.choice(len(walls), count, replace=False)]
    c, s = math.cos(truth[2]), math.sin(truth[2])
    points = ((walls - truth[:2]) @ np.array([[c, -s], [s, c]])).astype(np.float32)
    starts = truth + np.array([(0.3, -0.2, 0.05), (-3.0, 2.0, 1.0), (4.0, -3.0, -2.0)])
    shape = {"half_t_m": 0.5, "half_a_rad": math.radians(5.0), "floor": 0.3, "keep": 0.7}
    tree, windows = search(FIELD, points, starts, **shape), search_windows(FIELD, points, starts, **shape)
    assert windows[0, 3] == pytest.approx(tree[0, 3], abs=0.05)
    if count == 90:
        for found in (tree, windows):
            assert math.dist(found[0, :2], truth[:2]) < 0.15 and abs(found[0, 2] - truth[2]) < 0.03


def test_reported_poses_lie_apart_and_best_first() -> None:
    points = np.random.default_rng(0).uniform(-2, 2, (40, 2)).astype(np.float32)
    starts = np.array([(x, 7.0, yaw) for x in range(4, 16) for yaw in (0.0, 0.1, 2.0)])
    found = search_windows(FIELD, points, starts, half_t_m=0.6, half_a_rad=0.1, floor=0.0, keep=0.5, most=12)
    assert len(found) > 3 and (np.diff(found[:, 3]) <= 0).all() and found[-1, 3] >= 0.5 * found[0, 3]
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            turned = abs(math.remainder(a[2] - b[2], 2 * math.pi))
            assert np.abs(a[:2] - b[:2]).max() >= 0.5 or turned >= math.radians(10)


def test_nothing_to_search_and_too_much() -> None:
    start = np.array([[5.0, 5.0, 0.0]])
    for points, starts in ((np.zeros((0, 2)), start), (np.zeros((3, 2)), start[:0])):
        found = search_windows(FIELD, points.astype(np.float32), starts, half_t_m=0.5, half_a_rad=0.1)
        assert found.shape == (0, 4)
    with pytest.raises(ValueError, match="at most"):
        points = np.zeros((MOST_POINTS + 1, 2), np.float32)
        search_windows(FIELD, points, start, half_t_m=0.5, half_a_rad=0.1)
    black = np.zeros((MOST_POINTS, 2), np.float32)
    on_wall = FIELD.walls_m[:1].astype(np.float64)
    found = search_windows(FIELD, black, np.array([[*on_wall[0], 0.0]]), half_t_m=0.05, half_a_rad=0.01)
    assert found[0, 3] == pytest.approx(1.0)  # 256 times 255 still fits


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000), half_m=st.floats(0.05, 1.5))
def test_leaving_out_what_would_not_be_reported_changes_nothing(seed: int, half_m: float) -> None:
    rng = np.random.default_rng(seed)
    truth = np.array([*rng.uniform((1, 1), (19, 13)), rng.uniform(-3, 3)])
    walls = FIELD.walls_m[np.hypot(*(FIELD.walls_m - truth[:2]).T) < 5.0][:200]
    c, s = math.cos(truth[2]), math.sin(truth[2])
    points = ((walls - truth[:2]) @ np.array([[c, -s], [s, c]])).astype(np.float32)
    starts = np.concatenate((truth[None] + 0.02, truth + rng.uniform(-1, 1, (4, 3)) * (3, 3, 3)))
    shape = {"half_t_m": half_m, "half_a_rad": 2 * STEP, "step_rad": STEP, "most": 100}
    whole = search_windows(FIELD, points, starts, floor=0.0, keep=0.0, **shape)
    found = search_windows(FIELD, points, starts, floor=0.3, keep=0.8, **shape)
    assert np.array_equal(found, whole[whole[:, 3] >= max(0.3, 0.8 * whole[0, 3])])
