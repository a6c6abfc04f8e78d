"""Two-way scores: what supports a pose, what contradicts it, and what does not count."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import F64, SE2, U8
from pc2grid.matching.score import (
    LEAST_LIKELIHOOD,
    REFINEMENT,
    Fit,
    RefinementParameters,
    Support,
    _sums,
    agreement,
    gauss_newton,
    normal_equations,
    refine,
    score_fit,
    self_similarity,
)
from pc2grid.matching.search import SearchMap, search_windows
from pc2grid.matching.walls import LIKELIHOOD, LikelihoodField, Walls
from pc2grid.model import FREE, OCCUPIED, THING, UNKNOWN, OccupancyGrid
from tests.helpers.simulated_drives import office, office_part, plan

OFFICE = office()
TARGET = SearchMap.of(OFFICE)


def test_the_map_objects_where_it_has_walls_and_the_query_saw_none() -> None:
    query_grid = office_part((15.0, 4.0))
    emptied = query_grid.cells.copy()
    here = query_grid.to_cell(np.array([[0.0, -1.0], [3.0, -1.0]]))
    emptied[here[0, 0] - 3 : here[0, 0] + 4, here[0, 1] : here[1, 1]] = 0
    seen_through = OccupancyGrid(cells=emptied, resolution_m=0.05, origin_m=query_grid.origin_m)
    pose = SE2(15.0, 4.0, 0.0)
    whole, gone = (score_fit(TARGET.walls, Walls.of(g), pose, np.eye(3)) for g in (query_grid, seen_through))
    assert gone.forward > 0.95
    assert gone.backward < whole.backward - 0.1


def test_unknown_ground_is_neutral() -> None:
    half = OFFICE.cells.copy()
    half[:, 200:] = UNKNOWN
    walls = Walls.of(OccupancyGrid(cells=half, resolution_m=0.05, origin_m=(0.0, 0.0)))
    fit = score_fit(walls, Walls.of(office_part((10.0, 7.0))), SE2(10.0, 7.0, 0.0), np.eye(3))
    assert 0.3 < fit.overlap < 0.7
    assert fit.forward == pytest.approx(fit.overlap + LIKELIHOOD.neutral * (1 - fit.overlap), abs=0.03)


def plain_known_sums(walls: Walls, field: LikelihoodField, T_field_walls: SE2) -> F64:
    """(3,) of the wall points on known ground: their weight, the weighted sum of their likelihoods, 0..1, and
    the weight of those that were seen from unknown ground."""
    likelihood, known = field.at(T_field_walls.apply(walls.points_m), above=walls.only_explain)
    _, before = field.at(T_field_walls.apply(walls.before_m))
    weights = walls.weights[known].astype("f8")
    return np.array([weights.sum(), weights @ likelihood[known], weights[~before[known]].sum()])


@pytest.mark.parametrize("pose", [SE2(), SE2(9.3, 6.1, 0.7), SE2(1.0, 13.0, -2.0), SE2(60.0, 0.0, 0.1)])
@pytest.mark.parametrize("only_explain", [False, True])
def test_the_compiled_sums_are_the_plain_ones(pose: SE2, only_explain: bool) -> None:
    """Within the map, over its edge, and beside it."""
    grid = office_part((10.0, 7.0))
    walls = replace(Walls.of(grid).seen_from(grid.free.astype(np.float32)), only_explain=only_explain)
    fast, plain = (sums(walls, TARGET.field, pose) for sums in (_sums, plain_known_sums))
    assert fast == pytest.approx(plain, rel=1e-5, abs=1e-9)  # one adds in single precision


def seen_beside_a_wall(inside: bool) -> Walls:
    """A wall of 5 m along x, and the ground on one side of it, 2 m deep."""
    cells = np.full((81, 100), UNKNOWN, np.int8)
    cells[40] = 100
    cells[slice(41, None) if inside else slice(40)] = 0
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, -2.0))
    return Walls.of(grid).seen_from(grid.free.astype(np.float32))


def test_a_wall_that_the_map_has_seen_from_its_other_side_is_no_evidence() -> None:
    room, street = seen_beside_a_wall(True), seen_beside_a_wall(False)
    same, other = (score_fit(room, query, SE2(), np.eye(3)) for query in (room, street))
    assert same.compared == room.weight
    assert other.compared < 0.05 * room.weight  # at the ends of the wall, the side that is seen is not exact
    assert other.score == pytest.approx(same.score)  # a thin wall may well be the same


def test_a_wall_that_the_map_knows_from_both_sides_is_compared_from_each() -> None:
    """Drawn 0.1 m too far out, as much as the field is wide."""
    cells = np.zeros((81, 100), np.int8)
    cells[40] = 100
    known = Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, -2.0)))
    for inside, out_m in ((True, -0.1), (False, 0.1)):
        query = seen_beside_a_wall(inside)
        assert score_fit(known, query, SE2(0.0, out_m, 0.0), np.eye(3)).compared == query.weight


def test_what_was_moved_costs_less_than_a_missing_wall() -> None:
    """The same number of cells: two boxes that are gone from the map, or a stretch of its wall."""
    here = office_part((10.5, 7.0))
    fits = []
    for things in ([(0, 0), (0, 14)], [(0, 0), (0, 8)]):
        cells = here.cells.copy()
        row, column = here.to_cell(np.array([[0.0, 0.0]]))[0]
        for up, right in things:
            cells[row + up : row + up + 8, column + right : column + right + 8] = 100
        walls = Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=here.origin_m))
        fits.append(score_fit(TARGET.walls, walls, SE2(10.5, 7.0, 0.0), np.eye(3)).forward)
    apart, joined = fits
    assert joined < apart < 1.0


def kitchen(seen: str, *, tells_heights: bool = True) -> Walls:
    """A counter 2.4 m long in front of a wall, 0.6 m away: its front is seen, or it is looked over."""
    cells = np.full((60, 80), UNKNOWN, np.int8)
    heights = np.zeros((60, 80), np.uint8)
    cells[4:30, 10:60] = 0
    cells[30, 10:58], heights[30, 10:58] = (100, 0b000_011) if seen == "front" else (THING, 0b100_011)
    if seen != "front":
        cells[31:42, 10:58], heights[31:42, 10:58] = THING, 0b100_010
        cells[42, 10:58], heights[42, 10:58] = 100, 0b000_100
    told = heights if tells_heights else None
    return Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0), heights=told))


def test_a_counter_is_the_same_by_its_front_and_looked_over() -> None:
    """The front is a wall in one map and a thing in the other, and explains it. Without heights the thing is
    unknown, and the wall behind the counter, which is as long, is taken for the front."""
    onto_front = SE2(0.0, -0.6, 0.0)
    front, over = kitchen("front"), kitchen("over")
    right, wrong = (score_fit(front, over, pose, np.eye(3)) for pose in (SE2(), onto_front))
    assert right.known_agreement_both_ways > 0.99 and wrong.known_agreement_both_ways < 0.7
    front, over = (kitchen(seen, tells_heights=False) for seen in ("front", "over"))
    right, wrong = (score_fit(front, over, pose, np.eye(3)) for pose in (SE2(), onto_front))
    assert right.overlap == 0.0 and wrong.known_agreement_both_ways > 0.99


@pytest.mark.parametrize("value", [UNKNOWN, 0, 100])
def test_empty_and_full_grids_give_an_answer(value: int) -> None:
    grid = OccupancyGrid(cells=np.full((40, 40), value, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    walls = Walls.of(grid)
    pose, covariance = refine(TARGET.field, walls.points_m, SE2(5, 5, 0), (0.0, 0.0))
    fit = score_fit(TARGET.walls, walls, pose, covariance)
    assert np.isfinite(covariance).all() and 0.0 <= fit.score <= 1.0
    found = search_windows(
        SearchMap.of(grid), walls.points_m[:0], np.zeros((1, 3)), half_t_m=0.4, half_a_rad=0.1
    )
    assert len(found) == 0


def seen_from_the_middle(height_m: float | None, *boxes: tuple[slice, slice]) -> Walls:
    """A room of 6 x 4 m and the ground around its middle: its walls, and boxes that stand in it."""
    cells = np.full((82, 122), 0, np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    for box in boxes:
        cells[box] = 100
    return Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-3.05, -2.05), height_m=height_m))


def test_what_stands_in_a_lower_plane_does_not_contradict_the_free_space_of_a_higher_one() -> None:
    """A bench of 4 m that only the lower laser sees: neutral across heights, against the place otherwise."""
    bench = np.s_[30:32, 20:100]
    high, low = seen_from_the_middle(2.0), seen_from_the_middle(0.1, bench)
    same = seen_from_the_middle(2.0, bench)
    across, back = (score_fit(*pair, SE2(), np.eye(3)) for pair in ((high, low), (low, high)))
    alike = score_fit(high, same, SE2(), np.eye(3))
    # 20 m of walls and 8 m along the bench: 0.7 of the points lie on walls.
    assert across.known_agreement > 0.99 and 0.6 < across.overlap < 0.8
    assert alike.known_agreement < 0.8 and alike.overlap == 1.0
    assert back.backward > 0.99 and back.looked_at < 0.8 * alike.compared + 1.0
    assert across.score == pytest.approx(back.score, abs=0.01)
    assert across.score > alike.score + 0.02


def test_a_wall_of_the_higher_plane_is_missed_in_the_lower_one() -> None:
    """The higher laser sees a wall across the room, the lower one passes through: not the same place."""
    wall = np.s_[:, 60:62]
    high, low = seen_from_the_middle(2.0, wall), seen_from_the_middle(0.1)
    assert score_fit(high, low, SE2(), np.eye(3)).backward < 0.85
    assert score_fit(low, high, SE2(), np.eye(3)).known_agreement < 0.85


def test_planes_near_to_each_other_and_unknown_heights_are_compared_in_full() -> None:
    bench = np.s_[30:32, 20:100]
    with_bench = seen_from_the_middle(0.1, bench)
    for height_m in (0.4, None):
        fit = score_fit(seen_from_the_middle(height_m), with_bench, SE2(), np.eye(3))
        assert fit.overlap == 1.0 and fit.known_agreement < 0.8


ROOM_WEIGHT = seen_from_the_middle(None).weight
TABLE = np.s_[31:51, 11:51]


def with_table(heights_of_it: int) -> Walls:
    """The same room with something of 2 x 1 m at one end, seen at all heights: its heights, see `SLICES`."""
    cells = np.full((82, 122), 0, np.int8)
    cells[[0, -1], :] = cells[:, [0, -1]] = 100
    heights = np.where(cells == 100, np.uint8(0b000_111), np.uint8(0))
    cells[TABLE], heights[TABLE] = THING, heights_of_it
    return Walls.of(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-3.05, -2.05), heights=heights))


AT_ONE_HEIGHT, AT_ALL_HEIGHTS = 0b101_010, 0b000_111


@pytest.mark.parametrize("laser_asks", [True, False])
def test_what_stands_at_one_height_explains_a_laser_and_does_not_contradict_it(laser_asks: bool) -> None:
    """One laser sees a table, as it is at the height of its top. Another one passes under it."""
    table = with_table(AT_ONE_HEIGHT)

    def fit(laser: Walls) -> Fit:
        return score_fit(*((table, laser) if laser_asks else (laser, table)), SE2(), np.eye(3))

    passes, meets = fit(seen_from_the_middle(None)), fit(seen_from_the_middle(None, TABLE))
    for one in (passes, meets):
        assert one.known_agreement_both_ways > 0.99 and one.overlap > 0.99  # corners of the table are rounded
    walls_of_laser = (meets.compared, meets.looked_at)[0 if laser_asks else 1]
    assert walls_of_laser > ROOM_WEIGHT + 50.0  # the table is explained, and not left out as unknown ground
    assert passes.compared == passes.looked_at == ROOM_WEIGHT


@pytest.mark.parametrize("laser_asks", [True, False])
def test_what_stands_at_all_heights_contradicts_a_laser_that_did_not_see_it(laser_asks: bool) -> None:
    cupboard, laser = with_table(AT_ALL_HEIGHTS), seen_from_the_middle(None)
    fit = score_fit(*((cupboard, laser) if laser_asks else (laser, cupboard)), SE2(), np.eye(3))
    assert fit.known_agreement_both_ways < 0.9


def test_a_table_tells_where_the_walls_do_not() -> None:
    """In a room that looks the same turned by 180 degrees, the table at one end decides, if both have looked
    at all heights. A laser's map may have missed it."""
    room, turned = with_table(AT_ONE_HEIGHT), SE2(0.0, 0.0, np.pi)
    right, wrong = (score_fit(room, room, pose, np.eye(3)) for pose in (SE2(), turned))
    assert right.score > 0.99 > wrong.score + 0.05
    no_table = seen_from_the_middle(None)
    unaware = [score_fit(no_table, room, pose, np.eye(3)).score for pose in (SE2(), turned)]
    assert unaware[0] == pytest.approx(unaware[1], abs=0.02) and unaware[1] > 0.95


# --- Refinement below the cell size, the compiled step against the plain one, and the covariance ---


MAP = SearchMap.of(office())
FIELD = MAP.field
ONE_STEP = RefinementParameters(steps=1)


def plain_normal_equations(
    values: U8, x: F64, y: F64, tx: float, ty: float, yaw: float
) -> tuple[F64, F64, float, float]:
    """Hessian (3, 3), gradient (3,), sum of squared misfits and number of the points that count.

    A point counts if the interpolation has its four cells within the field and gives at least
    `LEAST_LIKELIHOOD`.
    """
    height, width = values.shape
    c, s = math.cos(yaw), math.sin(yaw)
    rx, ry = c * x - s * y, s * x + c * y
    u, v = rx + tx - 0.5, ry + ty - 0.5  # the value of a cell is that of its centre
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    rx, ry, u, v = (along[inside] for along in (rx, ry, u, v))
    j, i = u.astype(np.int64), v.astype(np.int64)
    a, b = u - j, v - i
    f00, f01 = values[i, j] / 255.0, values[i, j + 1] / 255.0
    f10, f11 = values[i + 1, j] / 255.0, values[i + 1, j + 1] / 255.0
    f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
    du = (1 - b) * (f01 - f00) + b * (f11 - f10)
    dv = (1 - a) * (f10 - f00) + a * (f11 - f01)
    jacobian = np.column_stack((du, dv, dv * rx - du * ry))[f >= LEAST_LIKELIHOOD]
    residual = 1.0 - f[f >= LEAST_LIKELIHOOD]
    return jacobian.T @ jacobian, jacobian.T @ residual, float(residual @ residual), float(len(residual))


@pytest.mark.parametrize("near", [(220.0, 160.0), (65.0, 65.0)])  # the other: walls hang over the map's edge
def test_the_compiled_normal_equations_are_the_plain_ones(near: tuple[float, float]) -> None:
    x, y = np.random.default_rng(0).uniform(-120, 120, (2, 400))
    fast = normal_equations(FIELD.values, x, y, *near, 0.3)
    plain = plain_normal_equations(FIELD.values, x, y, *near, 0.3)
    assert fast[3] == plain[3] >= REFINEMENT.least_points
    for a, b in zip(fast, plain, strict=True):
        assert np.allclose(a, b, rtol=1e-9, atol=1e-9)
    pose, _, _ = gauss_newton(FIELD.values, x, y, np.array([*near, 0.3]), ONE_STEP)
    H, g = plain[:2]
    step = np.linalg.solve(H + np.diag(0.05 * np.diag(H) + 1e-3), g)
    size = math.hypot(step[0], step[1])
    assert size > 0.01
    assert pose == pytest.approx(np.array([*near, 0.3]) + (step * 2.0 / size if size > 2.0 else step))


def test_the_pose_found_turns_with_the_query() -> None:
    walls = Walls.of(office_part((10.5, 7.0)))
    turned = SE2(1.0, -2.0, 2.1)
    guess = SE2(10.6, 7.1, 0.03) @ turned.inverse()
    pose, _ = refine(FIELD, turned.apply(walls.points_m).astype(np.float32), guess, (1.0, -2.0))
    there = pose @ turned
    assert math.dist((there.x, there.y), (10.5, 7.0)) < 0.03 and abs(there.yaw) < 0.01


def test_a_corridor_is_certain_across_and_uncertain_along() -> None:
    corridor = plan(30, 2, [])
    part = OccupancyGrid(cells=corridor.cells[:, 200:300], resolution_m=0.05, origin_m=(-2.5, -1.0))
    field, points_m = SearchMap.of(corridor).field, Walls.of(part).points_m
    _, covariance = refine(field, points_m, SE2(12.5, 1.0, 0.0), (0.0, 0.0))
    along, across = math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])
    assert across < 0.05 < 0.3 < along


# --- Which wall points fit, which are contradicted, and which the map cannot judge ---


HERE = SE2(10.0, 7.0, 0.0)


def with_block(grid: OccupancyGrid, x_m: float, y_m: float, value: int) -> OccupancyGrid:
    """The grid with a square of half a metre around a point set to one value."""
    cells = grid.cells.copy()
    row, column = grid.to_cell(np.array([[x_m, y_m]]))[0]
    cells[row - 5 : row + 6, column - 5 : column + 6] = value
    return replace(grid, cells=cells)


def test_a_query_at_its_own_place_fits_and_misses_nothing() -> None:
    found = agreement(Walls.of(OFFICE), Walls.of(office_part((10.0, 7.0))), HERE)
    assert (found.support == Support.FITS).all()
    assert len(found.missed_m) == 0
    assert found.share(Support.FITS) == 1.0


def test_a_thing_that_only_the_query_has_is_contradicted_where_it_stands() -> None:
    query = Walls.of(with_block(office_part((10.0, 7.0)), 0.0, 0.0, OCCUPIED))
    found = agreement(Walls.of(OFFICE), query, HERE)
    against = HERE.apply(found.points_m[found.support == Support.CONTRADICTED])
    assert len(against) > 10
    assert np.abs(against - (10.0, 7.0)).max() < 0.35
    assert len(found.missed_m) == 0


def test_a_thing_that_only_the_map_has_is_missed_where_it_stands() -> None:
    target = Walls.of(with_block(OFFICE, 10.0, 7.0, OCCUPIED))
    found = agreement(target, Walls.of(office_part((10.0, 7.0))), HERE)
    assert (found.support == Support.FITS).all()
    assert len(found.missed_m) > 10
    assert np.abs(found.missed_m - (10.0, 7.0)).max() < 0.35


def test_where_the_map_knows_nothing_it_says_nothing() -> None:
    half = OFFICE.cells.copy()
    half[:, 200:] = UNKNOWN
    query = Walls.of(office_part((10.0, 7.0)))
    found = agreement(Walls.of(replace(OFFICE, cells=half)), query, HERE)
    east = HERE.apply(found.points_m)[:, 0] > 10.1
    assert (found.support[east] == Support.UNKNOWN).all()
    assert (found.support[~east] != Support.UNKNOWN).mean() > 0.95


@pytest.mark.parametrize("value", [UNKNOWN, FREE])
def test_a_query_without_walls_has_no_shares(value: int) -> None:
    nothing = OccupancyGrid(cells=np.full((40, 40), value, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    found = agreement(Walls.of(OFFICE), Walls.of(nothing), HERE)
    assert found.points_m.shape == (0, 2)
    assert [found.share(kind) for kind in Support] == [0.0, 0.0, 0.0]


# --- A bare corridor fits onto itself, slid along; a corridor with rooms does not ---


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
