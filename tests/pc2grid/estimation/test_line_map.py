"""Scan matching in the plane: edge cases, and the compiled functions against their plain twins."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.estimation.line_map import (
    CAMERA_MATCHING,
    MATCHING_PARAMETERS,
    PointGrid,
    aligned,
    best_placements,
    placement_scores,
    sector_of,
)
from pc2grid.geometry import F32, F64, SE2, wrap_angle


def normal_equations_plain(
    index: NDArray[np.int32],
    moments: F64,
    points: F64,
    normal_rad: F64,
    pose: F64,
    cell_m: float,
    radius: int,
    scale_m: float,
) -> tuple[F64, F64, int]:
    """Linearise the point-to-line distances at a pose, in numpy.

    index : (H, W) row of `moments` (K, sectors, 6) for each cell, or -1. points : (N, 2) and normal_rad :
    (N,) in their frame. pose : (3,) x, y, yaw of that frame from the corner of cell (0, 0).
    radius : half width in cells of the neighbourhood. scale_m : scale of the Cauchy weight.

    Returns H (3, 3) and g (3,) of the Gauss-Newton step H d = -g for points of unit variance, and the
    number of points that found a line.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rotated = points @ np.array([[c, s], [-s, c]])
    at = rotated + pose[:2]
    sectors = moments.shape[1]
    sector = sector_of(normal_rad + pose[2], sectors)
    H, g, found = np.zeros((3, 3)), np.zeros(3), 0
    for k, (column, row) in enumerate(np.floor(at / cell_m).astype(int)):
        if not (radius <= row < index.shape[0] - radius and radius <= column < index.shape[1] - radius):
            continue
        cells = index[row - radius : row + radius + 1, column - radius : column + radius + 1]
        beside = (sector[k] + np.array([-1, 0, 1])) % sectors
        n, sx, sy, sxx, sxy, syy = moments[cells[cells >= 0]][:, beside].sum(axis=(0, 1))
        if n < 3:
            continue
        mean = np.array([sx, sy]) / n
        (small, large), axes = np.linalg.eigh(np.array([[sxx, sxy], [sxy, syy]]) / n - np.outer(mean, mean))
        if large < 1e-4:
            continue
        normal = axes[:, 0]
        r = float(normal @ (at[k] - mean))
        weight = (1.0 - max(small, 0.0) / large) ** 2 / (1.0 + (r / scale_m) ** 2)
        J = np.array([normal[0], normal[1], normal[1] * rotated[k, 0] - normal[0] * rotated[k, 1]])
        H += weight * np.outer(J, J)
        g += weight * r * J
        found += 1
    return H, g, found


def aligned_plain(
    index: NDArray[np.int32],
    moments: F64,
    points: F64,
    normal_rad: F64,
    guess: F64,
    prior: F64,
    prior_information: F64,
    cell_m: float,
    radii: NDArray[np.int64],
    residual_scale_m: float,
    prior_scale: float,
    converged: float,
) -> tuple[F64, F64, F64, int]:
    """Gauss-Newton of the point-to-line distances, held to a prior, one radius an iteration, in numpy.

    Parameters and results are those of `pc2grid.estimation.line_map.aligned`.
    """
    unit, damping, pose = cell_m**-2, 1e-6 * np.eye(3), guess
    for radius in radii:
        H, g, found = normal_equations_plain(
            index, moments, points, normal_rad, pose, cell_m, radius, residual_scale_m * radius
        )
        information, gradient, linearised = unit * H, unit * g, pose
        away = pose - prior
        away[2] = wrap_angle(float(away[2]))
        weight = prior_information / (1.0 + (away @ prior_information @ away) / prior_scale**2)
        step = np.linalg.solve(information + weight + damping, -(gradient + weight @ away))
        pose = pose + step
        if radius == radii[-1] and np.abs(step).sum() < converged:
            break
    alone = linearised - np.linalg.solve(information + unit * damping, gradient)
    return pose, alone, information, found


def placement_scores_plain(
    field: F32, points: F64, origin: F64, yaws: F64, first: int, step: int, count: int
) -> F32:
    """Score all placements of a window, in numpy. All in cells.

    points : (N, 2) x, y. origin : (2,) middle of the window. yaws : (A,) radians. Shifts are
    `first` + `step` * k for k below `count`, in x and in y. Returns the means (A, count (y), count (x)) of
    the field at the points, 0 outside.
    """
    scores = np.zeros((len(yaws), count, count), dtype=np.float32)
    shifts = first + step * np.arange(count)
    for a, yaw in enumerate(yaws):
        c, s = math.cos(yaw), math.sin(yaw)
        column, row = np.floor(points @ np.array([[c, s], [-s, c]]) + origin).astype(int).T
        for r, down in enumerate(shifts):
            for k, right in enumerate(shifts):
                y, x = row + down, column + right
                inside = (y >= 0) & (y < field.shape[0]) & (x >= 0) & (x < field.shape[1])
                scores[a, r, k] = field[y[inside], x[inside]].sum()
    mean: F32 = scores / np.float32(max(len(points), 1))
    return mean


def test_points_beside_a_map_are_no_part_of_it_and_a_heap_is_no_line() -> None:
    wall = np.column_stack((np.linspace(0.5, 3.5, 200), np.full(200, 2.0)))
    south = np.full(200, -math.pi / 2)
    grid = PointGrid((0.0, 0.0), (4.0, 4.0))
    beside = np.array([[-1.0, 2.0], [5.0, 2.0], [2.0, -1.0], [2.0, 5.0]] * 50)
    grid.add(beside, south)
    nothing = grid.match(wall, south, SE2(), SE2(), np.eye(3))
    assert nothing.overlap == 0.0 and nothing.pose == SE2()
    grid.add(np.full((200, 2), 2.0), south)
    assert grid.match(wall, south, SE2(), SE2(), np.eye(3)).overlap == 0.0
    grid.add(wall, south)
    found = grid.match(wall, south, SE2(0.0, 0.08), SE2(0.0, 0.08), np.eye(3))
    assert found.overlap > 0.9 and abs(found.pose.y) < 0.01


def test_one_wall_leaves_a_direction_unmeasured_however_much_a_point_counts() -> None:
    line, side = np.linspace(0.5, 3.5, 200), np.full(200, 0.5)
    walls = np.column_stack((line, side)), np.column_stack((side, line))
    normals = np.full(200, math.pi / 2), np.zeros(200)
    for parameters in (MATCHING_PARAMETERS, CAMERA_MATCHING):
        grid = PointGrid((0.0, 0.0), (4.0, 4.0), parameters=parameters)
        for wall, normal in zip(walls, normals, strict=True):
            grid.add(wall, normal)
        one = grid.match(walls[0][50:], normals[0][50:], SE2(), SE2(), np.eye(3))
        both = grid.match(np.concatenate(walls), np.concatenate(normals), SE2(), SE2(), np.eye(3))
        assert one.overlap > 0.9 and not one.measured
        assert both.measured


def test_free_ground_contradicts_what_is_placed_there_and_unknown_ground_does_not() -> None:
    """A room of 4 x 4 m whose middle the map has seen to be free; a wall of 3 m is placed in three ways."""
    line = np.linspace(1.0, 4.0, 200)
    wall, north = np.column_stack((line, np.full(200, 4.5))), np.full(200, -math.pi / 2)
    grid = PointGrid((0.0, 0.0), (8.0, 8.0))
    grid.add(wall, north)
    grid.clear(np.array([(0.5, 0.5), (4.5, 0.5), (4.5, 4.5), (0.5, 4.5)]))

    def placed(y_m: float) -> tuple[float, float]:
        held = SE2(0.0, y_m, 0.0)
        match = grid.match(wall, north, held, held, 1e9 * np.eye(3), radii=(1,))
        return match.overlap, match.contradicted

    assert placed(0.0) == (1.0, 0.0)  # the wall itself bounds the free ground, and is no part of it
    assert placed(-2.0) == (0.0, 1.0)  # in the middle of the room
    assert placed(2.0) == (0.0, 0.0)  # behind the wall
    grid.clear(np.array([(1.5, 4.6), (7.5, 4.6), (7.5, 9.5), (1.5, 9.5)]))  # also beyond the map
    overlap, contradicted = placed(2.0)
    assert overlap == 0.0 and contradicted == pytest.approx(0.77, abs=0.05)  # but for the border of it
    grid.clear(np.array([(-9.0, -9.0), (-8.0, -9.0), (-8.0, -8.0)]))  # nothing of it is on the map


def test_moments_of_points_added_in_parts_are_those_of_all_at_once() -> None:
    rng = np.random.default_rng(1)
    points, normals = rng.uniform(-1, 11, (4000, 2)), rng.uniform(-9, 9, 4000)
    whole, parts = (PointGrid((0.0, 0.0), (10.0, 10.0)) for _ in range(2))
    whole.add(points, normals)
    for k in range(0, 4000, 500):
        parts.add(points[k : k + 500], normals[k : k + 500])
    inside = ((points >= 0) & (points < 10)).all(axis=1)
    for grid in (whole, parts):
        assert grid._moments[..., 0].sum() == inside.sum()
        assert grid._moments[..., 1:3].sum(axis=(0, 1)) == pytest.approx(points[inside].sum(axis=0))
    filled = whole._index >= 0
    assert np.array_equal(filled, parts._index >= 0)
    assert whole._moments[whole._index[filled]] == pytest.approx(parts._moments[parts._index[filled]])


def corner(rng: np.random.Generator) -> tuple[PointGrid, F64, F64]:
    """A map of two walls and some clutter, and points (N, 2) near the walls with their normals (N,)."""
    along, side = np.linspace(0.5, 7.5, 300), np.full(300, 2.0)
    wall = np.concatenate((np.column_stack((along, side)), np.column_stack((side, along))))
    normals = np.repeat((-math.pi / 2, math.pi), 300)
    grid = PointGrid((0.0, 0.0), (8.0, 8.0))
    grid.add(wall + rng.normal(0, 0.01, wall.shape), normals)
    grid.add(rng.uniform(0, 8, (50, 2)), rng.uniform(-3, 3, 50))
    return grid, wall[::5] + rng.normal(0, 0.02, wall[::5].shape), normals[::5]


@pytest.mark.parametrize("sigma", [0.01, 0.3, np.inf])
@pytest.mark.parametrize("turns", [-1, 0])
@pytest.mark.parametrize("radii", [(1,), (2,), (3,), (3, 2, 1, 1, 1, 1)])
def test_a_match_is_that_of_its_definition(sigma: float, turns: int, radii: tuple[int, ...]) -> None:
    """Whether the prior is held, or outweighed, or there is none; its turn may be a whole one off."""
    grid, points, normals = corner(np.random.default_rng(7))
    guess, prior = np.array([0.05, -0.03, 0.02]), np.array([0.02, 0.1, 0.05 + 2.0 * math.pi * turns])
    information = np.diag([sigma**-2, sigma**-2, 4.0 * sigma**-2])
    arguments = (
        *(grid._index, grid._moments, points, normals, guess, prior, information, grid.cell_m),
        *(np.array(radii), 0.05, 2.0, 1e-4),
    )
    upper = np.triu_indices(3)
    *poses, found_information, found, contradicted = aligned(
        *arguments[:2], np.ones(grid.shape, np.uint8), *arguments[2:4],
        *(tuple(guess), tuple(prior), tuple(information[upper])), *arguments[7:9],
        *(np.full((len(points) + 1, 6), -1.0), *arguments[9:]),
    )  # fmt: skip
    assert found + contradicted == len(points)  # all of them lie on the map
    *plain, plain_information, plain_found = aligned_plain(*arguments)
    assert found == plain_found
    assert found_information == pytest.approx(plain_information[upper], rel=1e-9, abs=1e-9)
    assert np.array(poses) == pytest.approx(np.array(plain), rel=1e-9, abs=1e-9)


def test_likelihood_falls_with_the_distance_from_the_points() -> None:
    grid = PointGrid((0.0, 0.0), (4.0, 4.0))
    grid.add(np.array([[2.05, 1.05]]), np.zeros(1))
    field = grid.likelihood()
    assert field.shape == grid.shape and field[10, 20] == 1.0
    assert (
        field[10, 22] == pytest.approx(math.exp(-0.5 * (0.2 / 0.15) ** 2), abs=0.05) and field[35, 20] < 1e-6
    )


def test_placements_are_scored_as_by_their_definition() -> None:
    rng = np.random.default_rng(4)
    field, points = rng.random((40, 50), np.float32), rng.uniform(-15, 15, (60, 2))
    arguments = (field, points, np.array([25.3, 20.1]), np.array([-0.4, 0.0, 0.7]), -6, 2, 7)
    assert placement_scores(*arguments) == pytest.approx(placement_scores_plain(*arguments), abs=1e-5)


def test_the_best_placement_is_where_the_points_lie() -> None:
    cells = np.argwhere(np.random.default_rng(5).random((60, 60)) < 0.05)
    field = np.zeros((60, 60), np.float32)
    field[tuple(cells.T)] = 1.0
    truth = SE2(0.4, -0.2, math.radians(4.0))
    points = truth.inverse().apply(0.1 * (cells[:, ::-1] + 0.5))
    (score, pose), *others = best_placements(field, np.zeros(2), 0.1, points, SE2(), 0.6, math.radians(6.0))
    assert score > 0.95 and all(other < 0.5 for other, _ in others)
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((truth.x, truth.y, truth.yaw))


def test_what_walls_do_not_hold_is_not_taken_from_kiss_icp() -> None:
    """Along a bare wall it slides; before a corner it knows."""
    rng = np.random.default_rng(3)
    wall = np.column_stack((rng.uniform(1.0, 7.0, 400), 2.0 + 0.005 * rng.standard_normal(400)))
    side = np.column_stack((1.0 + 0.005 * rng.standard_normal(200), rng.uniform(2.0, 5.0, 200)))
    north, east = np.full(400, 0.5 * np.pi), np.zeros(200)
    prior, slid = SE2(), SE2(0.5, 0.0, 0.0)
    information = np.diag([100.0, 100.0, 1000.0])
    for points, normals, left_m in (
        (wall, north, 0.0),
        (np.concatenate((wall, side)), np.concatenate((north, east)), 0.4),
    ):
        grid = PointGrid((-2.0, -2.0), (10.0, 8.0))
        grid.add(points + np.array((0.5, 0.0)), normals)
        weighed = grid.weighed(points, normals, slid, prior, information)
        assert weighed.x == pytest.approx(left_m, abs=0.1)
