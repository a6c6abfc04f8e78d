"""Which wall points the coarse search takes, and how exactly a place is known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import F32, SE2, wrap_angle
from pc2grid.matching.score import score_fit
from pc2grid.matching.search import SearchMap
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from signature.config import Config, RelocalizeConfig, ShortlistBy
from signature.localization.answer import ambiguous_line
from signature.localization.posterior import by_place, decide
from signature.places import map_index
from signature.places.hypotheses import (
    HYPOTHESES,
    best_around,
    coarse_points,
    distinct,
    fitted,
)
from signature.places.map_index import Prior
from signature.places.query import query_of
from signature.session.loops import RecognitionParameters, SessionRecognizer
from tests.helpers.simulated_drives import building, office, office_part, with_tables

CENTER_M = (3.0, -2.0)


def ring(radius_m: float, count: int) -> F32:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    around = radius_m * np.column_stack((np.cos(angles), np.sin(angles))) + CENTER_M
    return np.asarray(around, np.float32)


def test_near_and_far_walls_have_the_same_share() -> None:
    """Boxes around the robot give many points; the walls of the hall behind them must count as well."""
    boxes = np.concatenate([ring(r, 200) for r in (1.0, 2.0, 3.0, 4.0)])
    chosen = coarse_points(np.concatenate((boxes, ring(15.0, 500), ring(30.0, 500))), CENTER_M)
    away_m = np.hypot(*chosen.T)
    assert np.count_nonzero(away_m < 8.0) == HYPOTHESES.few_points
    assert np.count_nonzero(np.abs(away_m - 15.0) < 0.1) == HYPOTHESES.few_points
    assert away_m.max() < HYPOTHESES.far_m


def test_a_room_has_near_walls_only() -> None:
    chosen = coarse_points(ring(4.0, 400), CENTER_M)
    assert 0 < len(chosen) <= HYPOTHESES.few_points
    assert coarse_points(np.empty((0, 2), np.float32), CENTER_M).shape == (0, 2)


def test_a_pose_is_not_stated_more_exactly_than_the_map_is_drawn() -> None:
    """The map on itself: the alignment alone states 2 to 4 cm along rooms and some millimetres across."""
    query = query_of(office(), np.empty((0, 2)), Config(), Config().relocalize)
    fit = fitted(query, 0, -1, SearchMap.of(office()), SE2(0.04, -0.03, 0.01))
    stated = np.sqrt(np.diag(fit.covariance))
    assert np.all(stated >= (HYPOTHESES.map_m, HYPOTHESES.map_m, HYPOTHESES.map_rad))
    assert np.all(stated < (0.1, 0.1, 0.01))  # a tenth of a robot's width: what is aligned is known


def test_tables_that_a_lidar_has_seen_over_and_under_hide_no_place_from_a_laser() -> None:
    of_laser, of_lidar = office(), with_tables(office())
    at_map = SE2(0.04, -0.03, 0.01)

    def agreement(query: OccupancyGrid, target: OccupancyGrid) -> float:
        config = Config()
        asked = query_of(query, np.empty((0, 2)), config, config.relocalize)
        searched = building({"map": target}, config).maps_for(asked)(0)
        return fitted(asked, 0, -1, searched, at_map).known_agreement_both_ways

    plain = replace(of_lidar, heights=None)
    assert agreement(of_laser, of_lidar) > 0.9 > agreement(of_laser, plain)
    assert agreement(of_lidar, of_laser) > 0.9 > agreement(plain, of_laser)


def test_a_shoulder_is_led_to_its_peak_and_is_no_place_of_its_own() -> None:
    query = query_of(office(), np.empty((0, 2)), Config(), Config().relocalize)
    target = SearchMap.of(office())
    peak = fitted(query, 0, -1, target, SE2())
    aside = SE2(0.6, -0.5, 0.06)
    shoulder = replace(score_fit(target.walls, query.walls, aside, peak.covariance), submap_id=3)
    assert distinct(query, (shoulder, peak)) == (replace(peak, submap_id=3),)
    led = best_around(query, shoulder, target)
    pose = led.T_map_query
    assert abs(pose.x) + abs(pose.y) < 0.05 and led.score > shoulder.score
    (one,) = distinct(query, (led, peak))
    assert one.submap_id == 3  # of the place that proposed it
    elsewhere = replace(led, session_index=1)
    farther = replace(shoulder, T_map_query=SE2(0.9, 0.0, 0.0))
    for other in (elsewhere, farther):
        assert len(distinct(query, (other, peak))) == 2


@pytest.mark.parametrize(
    ("off", "one"),
    [((0.6, -0.5, 0.06), True), ((0.9, 0.0, 0.0), False), ((0.0, 0.0, math.radians(7.0)), False)],
)
def test_what_is_one_place_is_so_in_a_map_in_two_and_for_a_prior(
    off: tuple[float, float, float], one: bool
) -> None:
    """What a search around one of two poses has seen."""
    joined = building({"a": office(), "b": office()}, joined={"a": SE2(), "b": SE2()})
    query = query_of(office(), np.empty((0, 2)), Config(), Config().relocalize)
    here = fitted(query, 0, -1, SearchMap.of(office()), SE2())
    there = replace(here, T_map_query=SE2(*off))
    assert (len(distinct(query, (here, there))) == 1) is one
    assert (len(by_place(joined, query, (here, replace(there, session_index=1)))) == 1) is one
    assert Prior.of_pose(SE2(), 1e-6 * np.eye(3)).allows(SE2(*off)) is one


@pytest.mark.parametrize("by", ["signatures", "random"])
def test_a_search_goes_on_until_it_is_sure(by: ShortlistBy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the order is, no length of a list decides what is found."""
    monkeypatch.setattr(map_index, "FIRST_PLACES", 2)
    config = Config(relocalize=RelocalizeConfig(shortlist_by=by))
    index = building({"office": office()}, config)
    query = query_of(office_part((15.0, 5.0), 4.5), np.empty((0, 2)), config, config.relocalize)
    steps = [left for _, left in index.search(query)]
    assert len(steps) > 1 and steps == sorted(steps, reverse=True) and abs(steps[-1]) < 1e-9
    verdict, _ = decide(index, query)
    assert verdict.status == "located"
    pose = verdict.hypotheses[0].T_map_query
    assert abs(pose.x - 15.0) + abs(pose.y - 5.0) < 0.1


def test_the_looks_of_a_robot_search_one_part_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """So none takes long, and together they search the whole map, however bad the order is."""
    monkeypatch.setattr(map_index, "FIRST_PLACES", 1)
    config = Config(relocalize=RelocalizeConfig(shortlist_by="random"))
    index = building({"office": office()}, config)
    query = query_of(office_part((15.0, 5.0), 4.5), np.empty((0, 2)), config, config.relocalize)
    parts = math.ceil((len(index.places.table) - 1) / 10)
    looks = [list(index.at_look(number).search(query)) for number in range(3, 3 + parts)]
    assert parts > 2 and all(len(look) == 2 for look in looks)
    (_, left), *_ = looks[0]
    assert sum(first - second for (_, first), (_, second) in looks) == pytest.approx(left)
    best = [found[0] for _, (found, _) in looks if found]
    assert sum(abs(fit.T_map_query.x - 15.0) + abs(fit.T_map_query.y - 5.0) < 0.1 for fit in best) == 1


# --- Likely places that lie on one line ---


ALONG = math.radians(30.0)


def along(travel_m: float, *, beside_m: float = 0.0, turned_rad: float = 0.0) -> SE2:
    """A place so far along a corridor."""
    return SE2(1.0, 2.0, ALONG) @ SE2(travel_m, beside_m, turned_rad)


def test_places_along_a_corridor_are_one_line() -> None:
    bases = [along(4.0), along(9.0), along(-2.0), along(5.0, beside_m=0.2)]
    line = ambiguous_line(bases, (0.3, 0.2, 0.1, 0.1))
    assert line is not None
    assert line.length_m == pytest.approx(11.0, abs=0.1)
    assert {line.begin.x < line.end.x, line.begin.y < line.end.y} in ({True}, {False})
    assert line.yaw_rad == pytest.approx(ALONG)
    assert line.probability == pytest.approx(0.7)


def test_what_looks_the_other_way_is_not_on_it() -> None:
    """A corridor with both ends alike: the robot may drive either way."""
    bases = [along(4.0), along(9.0, turned_rad=math.pi), along(6.0)]
    line = ambiguous_line(bases, (0.4, 0.3, 0.2))
    assert line is not None
    assert line.length_m == pytest.approx(2.0) and line.probability == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("bases", "masses"),
    [
        ([along(4.0)], (0.9,)),
        ([along(4.0), along(9.0, turned_rad=1.0)], (0.5, 0.4)),
        ([along(4.0), along(9.0)], (0.3, 0.1)),
        ([], ()),
    ],
    ids=["one place", "another heading", "unlikely", "nothing"],
)
def test_else_there_is_no_line(bases: list[SE2], masses: tuple[float, ...]) -> None:
    assert ambiguous_line(bases, masses) is None


def test_the_line_with_most_of_the_mass_is_told() -> None:
    """The crossing of two corridors."""
    bases = [along(0.0), along(0.0, beside_m=6.0), along(5.0), along(8.0)]
    line = ambiguous_line(bases, (0.3, 0.25, 0.2, 0.15))
    assert line is not None and line.length_m == pytest.approx(8.0)
    assert line.probability == pytest.approx(0.65)


# --- A session that recognises its own earlier places ---


def rooms(seed: int) -> OccupancyGrid:
    """A furnished hall between walls, 0.8 m wider than that of the seed before; the origin lies in its
    middle. (Halls of one outline are one place, as far as their walls go.)"""
    rng = np.random.default_rng(seed)
    n = round((9.0 + 0.8 * seed) / 0.05)
    cells = np.full((n + 40, n + 40), UNKNOWN, np.int8)
    cells[20:-20, 20:-20] = FREE
    cells[[20, 21, -22, -21], 20:-20] = OCCUPIED
    cells[20:-20, [20, 21, -22, -21]] = OCCUPIED
    for _ in range(9):
        row, column = rng.integers(24, n - 20, 2)
        long, wide = rng.integers(4, 10), rng.integers(16, 36)
        if rng.random() < 0.5:
            long, wide = wide, long
        cells[row : row + long, column : column + wide] = OCCUPIED
    middle = (n + 40) // 2
    cells[middle - 12 : middle + 12, middle - 30 : middle + 30] = FREE
    half_m = 0.05 * middle
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-half_m, -half_m))


def seen_from(grid: OccupancyGrid, pose: SE2) -> OccupancyGrid:
    """The same map in another frame, which lies at `pose` in it."""
    n = grid.cells.shape[0] + 120
    origin_m = (-0.025 * n, -0.025 * n)
    empty = OccupancyGrid(cells=np.full((n, n), UNKNOWN, np.int8), resolution_m=0.05, origin_m=origin_m)
    rows, columns = np.indices((n, n)).reshape(2, -1)
    at = grid.to_cell(pose.apply(empty.to_point(np.column_stack((rows, columns)))))
    inside = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    cells = empty.cells.copy()
    cells[rows[inside], columns[inside]] = grid.cells[at[inside, 0], at[inside, 1]]
    return replace(empty, cells=cells)


PATH_M = np.column_stack((np.linspace(-1.0, 1.0, 9), np.zeros(9)))
"""Of the keyframes of a place map."""


def test_an_earlier_place_is_recognised_and_a_new_one_is_not() -> None:
    recognizer = SessionRecognizer(Config(), RecognitionParameters(maps=2))
    assert list(recognizer.recognize(rooms(0), PATH_M)) == []
    for index in (1, 2, 3):
        found = recognizer.recognize(rooms(index), PATH_M)
        assert all(recognition.evidence.log_odds() < 2.2 for recognition in found)
    again = SE2(0.7, -0.4, 2.0)
    found = recognizer.recognize(seen_from(rooms(1), again), PATH_M)
    best = max(found, key=lambda recognition: recognition.evidence.log_odds())
    assert best.older == 1 and best.evidence.log_odds() > 3.0
    assert math.hypot(best.T_older_newer.x - again.x, best.T_older_newer.y - again.y) < 0.1
    assert abs(wrap_angle(best.T_older_newer.yaw - again.yaw)) < 0.02
    assert all(recognition.older < 4 for recognition in found)


def test_tables_that_were_seen_over_and_under_do_not_hide_an_earlier_place() -> None:
    """They were carried away since. They tell against it if nothing says at which heights they stood."""
    tables, odds = with_tables(rooms(1)), []
    for earlier in (tables, replace(tables, heights=None)):
        recognizer = SessionRecognizer(Config())
        recognizer.recognize(earlier, PATH_M)
        found, *_ = recognizer.recognize(rooms(1), PATH_M)
        odds.append(found.evidence.log_odds())
    assert odds[0] > 4.6 and odds[0] > odds[1] + 2.0
