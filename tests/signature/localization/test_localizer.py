"""The decision: located, ambiguous or not found."""

import math
from dataclasses import replace
from typing import Any

import pytest

from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import FREE, Health, OccupancyGrid, RegisteredScan
from pc2grid_cli.relocalize import as_text
from signature.config import Config
from signature.database import Label
from signature.localization.answer import Answer
from signature.localization.localizer import Localizer
from signature.places import map_index
from signature.places.map_index import MapIndex
from signature.places.query import Query, QueryMap
from tests.helpers.simulated_drives import OTHER, TWINS, building, drive, office, plan

OFFICE = building({"office": office()})
ROUTE = [(1.5, 7.0), (9.5, 7.0), (9.5, 4.0)]


def ask(
    where: MapIndex, grid: OccupancyGrid, corners: list[tuple[float, float]], **kind: float
) -> tuple[Answer, SE2]:
    localizer = Localizer(where)
    for registered, planar_scan, truth in drive(grid, corners, **kind):
        localizer.add(registered, planar_scan)
        end = truth
    return localizer.answer(), end


@pytest.mark.parametrize("field_deg", [360.0, 270.0, 90.0])
def test_a_drive_through_a_known_building_is_located(field_deg: float) -> None:
    answer, truth = ask(OFFICE, office(), ROUTE, field_rad=math.radians(field_deg))
    assert answer.status == "located" and answer.session == "office"
    pose = answer.T_map_base
    assert pose is not None and math.dist((pose.x, pose.y), (truth.x, truth.y)) < 0.1
    assert abs(math.remainder(pose.yaw - truth.yaw, 2 * math.pi)) < math.radians(1.5)
    assert answer.confidence >= 0.9
    whole = answer.T_map_odom @ answer.T_odom_base if answer.T_map_odom else None
    assert whole is not None and math.dist((whole.x, whole.y), (pose.x, pose.y)) < 1e-9
    # Certainty grows with the travel, and history tells it.
    travelled = [m.path_m for m in answer.history]
    assert travelled == sorted(travelled) and len(travelled) >= 8
    assert answer.history[-1].confidence >= answer.history[0].confidence
    # There may be thousands, so none holds a map, or those before it.
    assert not any(
        m.local_map.cells.size or m.map or m.history or len(m.hypotheses) > 1 for m in answer.history
    )


def test_an_answer_is_one_search_and_asking_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An estimate is the answer at its scan; at others the database is searched when it is asked."""
    searched, search = [], MapIndex.search

    def counted(index: MapIndex, query: QueryMap, *arguments: Any) -> Any:
        searched.append(query.path_m)
        return search(index, query, *arguments)

    monkeypatch.setattr(MapIndex, "search", counted)
    quiet, asked = Localizer(OFFICE), Localizer(OFFICE)
    for number, (registered, planar_scan, _) in enumerate(drive(office(), ROUTE)):
        told = quiet.add(registered, planar_scan)
        estimate = asked.add(registered, planar_scan)
        searched.clear()
        answer = asked.answer() if estimate or number % 20 == 10 else None
        assert len(searched) == (answer is not None and estimate is None)
        if estimate and told and answer:
            assert (answer.confidence, answer.T_map_base) == (told.confidence, told.T_map_base)
            assert answer.history[-1].stamp_ns == registered.scan.stamp_ns


def test_a_look_on_the_way_is_one_part_of_the_search_and_the_answer_is_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks, search = [], MapIndex.search

    def noted(index: MapIndex, query: QueryMap, *arguments: Any) -> Any:
        looks.append(index.look)
        return search(index, query, *arguments)

    monkeypatch.setattr(map_index, "FIRST_PLACES", 1)
    monkeypatch.setattr(MapIndex, "search", noted)
    localizer, scans = Localizer(OFFICE), iter(drive(office(), ROUTE))
    while len(set(looks)) < 3:
        registered, planar_scan, _ = next(scans)
        localizer.add(registered, planar_scan)
    assert localizer.answer().status == "located"
    assert list(dict.fromkeys(looks)) == [1, 2, 3, None]


def test_another_building_is_not_found() -> None:
    answer, _ = ask(OFFICE, OTHER, [(2, 2), (2, 9), (7, 8)])
    assert answer.status == "not_found" and answer.T_map_base is None and answer.session is None


def test_two_identical_rooms_are_ambiguous_with_both_named() -> None:
    answer, truth = ask(building({"twins": TWINS}), TWINS, [(1.0, 1.0), (5.0, 1.0), (5.0, 2.4)])
    assert answer.status == "ambiguous" and answer.T_map_base is None
    places = [h.T_map_query @ answer.T_odom_base for h in answer.hypotheses]
    for expected in (truth, SE2(truth.x + 6, truth.y, truth.yaw)):
        assert any(math.dist((p.x, p.y), (expected.x, expected.y)) < 0.25 for p in places)
    line, document = answer.line, answer.to_json()["line"]
    assert line is not None and document is not None
    assert line.length_m == document["length_m"] == pytest.approx(6.0, abs=0.1)
    assert abs(math.remainder(line.yaw_rad - truth.yaw, 2 * math.pi)) < math.radians(3.0)
    assert line.probability > 0.9
    assert "on one line of 6.0 m with probability > 0.9" in as_text(answer)


def test_a_symmetric_room_reports_both_headings() -> None:
    room = plan(8, 5, [])
    answer, truth = ask(building({"room": room}), room, [(2.0, 2.0), (6.0, 2.0)])
    assert answer.status == "ambiguous"
    poses = [h.T_map_query @ answer.T_odom_base for h in answer.hypotheses]
    turned = SE2(8 - truth.x, 5 - truth.y, truth.yaw + math.pi)
    for expected in (truth, turned):
        assert any(
            math.dist((p.x, p.y), (expected.x, expected.y)) < 0.25
            and abs(math.remainder(p.yaw - expected.yaw, 2 * math.pi)) < 0.1
            for p in poses
        )


def test_an_empty_database_finds_nothing() -> None:
    answer, _ = ask(building({}), office(), ROUTE)
    assert answer.status == "not_found" and answer.hypotheses == () and answer.confidence == 0.0


def test_the_session_is_named_and_its_frame_kept() -> None:
    both = building({"other": OTHER, "office": office()})
    answer, truth = ask(both, office(), ROUTE)
    assert answer.session == "office"
    assert answer.T_map_base is not None
    assert math.dist((answer.T_map_base.x, answer.T_map_base.y), (truth.x, truth.y)) < 0.1


def elsewhere(grid: OccupancyGrid, origin_m: tuple[float, float]) -> OccupancyGrid:
    return OccupancyGrid(cells=grid.cells, resolution_m=grid.resolution_m, origin_m=origin_m)


def test_two_joined_sessions_do_not_make_each_other_ambiguous() -> None:
    tidied = office().cells.copy()
    tidied[20:90, 130:150] = FREE  # between the sessions a wall went
    second = elsewhere(OccupancyGrid(cells=tidied, resolution_m=0.05, origin_m=(0, 0)), (-30.0, 12.0))
    joined = {"monday": SE2(), "tuesday": SE2(30.0, -12.0, 0.0)}
    both = building({"monday": office(), "tuesday": second}, joined=joined)
    answer, truth = ask(both, office(), ROUTE)
    assert answer.status == "located" and answer.T_map_base is not None
    assert sorted(fit.session_index for fit in answer.places[0].fits) == [0, 1]
    moved = {"monday": SE2(), "tuesday": SE2(-30.0, 12.0, 0.0)}[answer.session or ""]
    expected = moved @ truth
    assert math.dist((answer.T_map_base.x, answer.T_map_base.y), (expected.x, expected.y)) < 0.1


def test_two_floors_that_look_alike_are_ambiguous_and_both_are_named() -> None:
    labels = {"a": Label(building="hall", floor="1"), "b": Label(building="hall", floor="2")}
    twice = building({"a": office(), "b": elsewhere(office(), (5.0, 0.0))}, labels=labels)
    answer, _ = ask(twice, office(), ROUTE)
    assert answer.status == "ambiguous" and answer.label.floor is None
    first, second = (place.mass for place in answer.places[:2])
    assert first == pytest.approx(second) and first + second > 0.9
    named = [(h["session"], h["floor"]) for h in answer.to_json()["hypotheses"]]
    assert {("a", "1"), ("b", "2")} <= set(named)


def test_the_answer_does_not_depend_on_where_the_query_starts() -> None:
    late = Localizer(OFFICE)
    early = Localizer(OFFICE)
    scans = list(drive(office(), [(18.0, 1.5), (18.0, 2.4), (18.5, 7.0), *ROUTE[1:]]))
    for k, (registered, planar_scan, truth) in enumerate(scans):
        early.add(registered, planar_scan)
        end = truth
        if k >= 20:
            late.add(registered, planar_scan)
    a, b = early.answer(), late.answer()
    assert a.status == b.status == "located"
    for answer in (a, b):
        assert answer.T_map_base is not None
        assert math.dist((answer.T_map_base.x, answer.T_map_base.y), (end.x, end.y)) < 0.1


def test_lost_scans_end_a_part_and_the_last_one_alone_is_a_query() -> None:
    localizer = Localizer(OFFICE)
    for registered, planar_scan, _ in drive(office(), ROUTE[:2]):
        lost = RegisteredScan(
            scan=registered.scan, T_session_base=registered.T_session_base, health=Health.LOST
        )
        localizer.add(lost, planar_scan)
    assert localizer.answer().path_m == 0.0
    with pytest.raises(NoScans):
        Localizer(OFFICE).answer()


def test_a_query_is_drawn_from_the_newest_scans_alone() -> None:
    config = Config().relocalize
    queries = [Query(Config(), config.model_copy(update={"window_m": m})) for m in (15.0, 2.0)]
    for registered, planar_scan, _ in drive(office(), ROUTE, reach_m=3.0):
        for query in queries:
            query.add(registered, planar_scan)
    whole, last = (query.map() for query in queries)
    assert last.T_odom_base == whole.T_odom_base and last.path_m == whole.path_m
    assert 0 < last.walls.weight < 0.7 * whole.walls.weight


@pytest.mark.parametrize("slip_deg", [0.0, 40.0])
def test_a_query_whose_last_scans_contradict_the_others_is_located_by_these_alone(slip_deg: float) -> None:
    """Tracking slips by a turn; all but the last two metres fit the map."""
    scans = list(drive(office(), ROUTE))
    slip = SE2(0.0, 0.0, math.radians(slip_deg))
    turn_at = SE2.from_matrix(scans[-10][0].T_session_base)
    localizer = Localizer(OFFICE)
    for k, (registered, planar_scan, _) in enumerate(scans):
        T = SE2.from_matrix(registered.T_session_base)
        if k >= len(scans) - 10:
            T = turn_at @ slip @ turn_at.inverse() @ T
        localizer.add(replace(registered, T_session_base=T.lift()), planar_scan)
    answer = localizer.answer()
    assert answer.status == "located" and answer.T_map_base is not None
    T_map_base = scans[-1][2]
    assert math.dist((answer.T_map_base.x, answer.T_map_base.y), (T_map_base.x, T_map_base.y)) < 0.1
    assert (localizer.query.map().slipped_m > 0.0) == (slip_deg != 0.0)
