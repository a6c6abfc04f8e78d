"""What the points of a map and a query change in an answer."""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import BEARINGS
from pc2grid.geometry import SE2, invert_pose
from pc2grid.matching.icp_in_space import MapSurface, SpatialFit, register_in_space
from pc2grid.matching.score import Fit
from pc2grid.model import Health, PointMap
from signature.config import Config
from signature.database import Label
from signature.localization.answer import Answer, Place
from signature.localization.localizer import Follower, Localizer
from signature.localization.posterior import SPACE, log_odds_in_space, masses_of, settle_in_space, weighed
from signature.places.hypotheses import HYPOTHESES
from signature.places.map_index import MapIndex
from signature.places.query import Query, QueryInSpace
from tests.helpers.building_clouds import box_surface
from tests.helpers.simulated_drives import building, flat_scan, office
from tests.helpers.tall_offices import lidar_drive, points as points_of
from tests.helpers.twin_rooms import APART_M, HEIGHTS_M, drive, furnished_map, twin_map


@pytest.fixture(scope="module")
def points() -> MapSurface:
    return MapSurface(twin_map())


def ask(height_m: float, *rooms_x_m: float, cupboard: bool = False) -> tuple[QueryInSpace, Answer]:
    """A query, and the planar verdict that it lies in the rooms that begin at these x."""
    query, scans = QueryInSpace(Config()), drive(height_m, cupboard=cupboard)
    for registered, _ in scans:
        query.add(registered)
    last, T_room_base = scans[-1]
    T_room_odom = SE2.from_matrix(T_room_base @ invert_pose(last.T_session_base))
    fits = (
        Fit(
            T_map_query=SE2(x_m, 0.0, 0.0) @ T_room_odom,
            forward=0.9,
            backward=0.9,
            overlap=0.9,
            compared=90.0,
            score=0.9,
            looked_at=100.0,
            covariance=np.eye(3) * 1e-4,
        )
        for x_m in rooms_x_m
    )
    alone = len(rooms_x_m) == 1
    mass = 0.95 if alone else 0.49
    verdict = Answer(
        status="located" if alone else "ambiguous",
        places=tuple(Place(fits=(fit,), mass=mass) for fit in fits),
        stamp_ns=0,
        path_m=0.0,
        T_odom_base=SE2(),
        local_map=office(),
        sessions=("twins",),
        labels=(Label(),),
    )
    return query, verdict


def other_walls() -> MapSurface:
    """A map with the same floor, and walls that stand elsewhere."""
    floor = box_surface((-5, -5, 0), (10, 10, 0)), box_surface((-5, -5, 4.0), (10, 10, 4.0))
    walls = box_surface((4.0, -5, 0), (4.0, 10, 4.0)), box_surface((-5, 1.0, 0), (10, 1.0, 4.0))
    return MapSurface(PointMap.of(np.concatenate((*floor, *walls)), 0.05))


def base_of(verdict: Answer, query: QueryInSpace) -> SE2:
    """The base at the first hypothesis, in the plane."""
    assert query.T_odom_base is not None
    return verdict.hypotheses[0].T_map_query @ SE2.from_matrix(query.T_odom_base)


@pytest.mark.parametrize(("height_m", "x_m"), [(HEIGHTS_M[0], 0.0), (HEIGHTS_M[1], APART_M)])
def test_twins_in_the_plane_are_told_apart_by_their_height(
    height_m: float, x_m: float, points: MapSurface
) -> None:
    query, verdict = ask(height_m, 0.0, APART_M)
    settled = settle_in_space(verdict, query, lambda _: points, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "located" and settled.confidence > 0.9
    assert in_space is not None and in_space.status == "agrees"
    base = base_of(settled, query)
    assert abs(base.x - x_m - 3.3) < 1.5
    assert len(settled.places) == 2
    # The planar pose is that of space; the floor is at z = 0, and the base on it.
    assert base.x == pytest.approx(in_space.T_map_base[0, 3])
    assert in_space.T_map_base[2, 3] == pytest.approx(0.0, abs=0.02)


def with_masses(verdict: Answer, *masses: float) -> Answer:
    """The verdict, located at the first place, with other masses."""
    places = [replace(place, mass=mass) for place, mass in zip(verdict.places, masses, strict=True)]
    return replace(verdict, status="located", places=tuple(places))


def test_equal_twins_stay_ambiguous(points: MapSurface) -> None:
    """Both hypotheses in the same room, which is taken for two places."""
    query, verdict = ask(HEIGHTS_M[0], 0.0, 0.0)
    settled = settle_in_space(verdict, query, lambda _: points, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "ambiguous" and in_space is None
    assert [place.mass for place in settled.places] == pytest.approx([0.5, 0.5], abs=0.01)


def test_furniture_does_not_tell_twins_apart() -> None:
    """The query is in the second room, or in the first one, into which a cupboard was brought since."""
    query, verdict = ask(HEIGHTS_M[0], 0.0, APART_M, cupboard=True)
    points = MapSurface(furnished_map())
    fits = [register_in_space(query.views, points, h.T_map_query) for h in verdict.hypotheses]
    assert isinstance(fits[0], SpatialFit) and isinstance(fits[1], SpatialFit)
    assert fits[1].on - fits[0].on > 0.05
    assert fits[1].compared.patches_over(fits[0].compared) == 0
    settled = settle_in_space(verdict, query, lambda _: points, accept=0.9)
    assert settled.status == "ambiguous"
    assert [place.mass for place in settled.places] == pytest.approx([0.5, 0.5], abs=0.01)


def test_a_located_pose_is_refined_and_becomes_surer(points: MapSurface) -> None:
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    first = verdict.hypotheses[0]
    moved = replace(first, T_map_query=first.T_map_query @ SE2(0.1, -0.05, 0.03))
    believed = replace(verdict, places=(replace(verdict.places[0], fits=(moved,)),))
    settled = settle_in_space(believed, query, lambda _: points, accept=0.9)
    at = settled.in_space
    assert settled.status == "located" and settled.confidence > 0.99
    # Not surer than the map.
    assert at is not None
    for covariance in (at.covariance, settled.hypotheses[0].covariance):
        assert np.sqrt(np.diag(covariance)[:2]).min() > HYPOTHESES.map_m
    error = base_of(verdict, query).inverse() @ base_of(settled, query)
    assert np.hypot(error.x, error.y) < 0.02


def test_a_place_that_the_points_contradict_is_turned_down() -> None:
    """The map has the floor there, and walls that stand elsewhere."""
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    wrong = other_walls()
    settled = settle_in_space(verdict, query, lambda _: wrong, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "not_found" and settled.confidence < 0.9
    assert in_space is not None and in_space.status == "contradicts"


def test_a_place_that_the_plane_leaves_open_is_located_by_its_points(points: MapSurface) -> None:
    """Its mass in the plane is small, as if its things had been moved; a wrong place has more."""
    query, verdict = ask(HEIGHTS_M[0], 0.0, APART_M + 3.0)
    right, wrong = verdict.places
    places = (replace(wrong, mass=0.2), replace(right, mass=0.02))
    unsure = replace(verdict, status="not_found", places=places)
    settled = settle_in_space(unsure, query, lambda _: points, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "located" and settled.places[0].mass > settled.places[1].mass
    assert in_space is not None and in_space.status == "agrees"
    assert base_of(settled, query).x < 4.9


def test_a_place_that_is_not_compared_keeps_its_odds(points: MapSurface) -> None:
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    fit = register_in_space(query.views, points, verdict.hypotheses[0].T_map_query)
    assert isinstance(fit, SpatialFit)
    masses, best = masses_of((0.3, 0.3), {1: fit})
    factor = math.exp(log_odds_in_space(fit))
    assert best == 1 and masses[1] / masses[0] == pytest.approx(factor)
    assert masses[0] / (1.0 - masses.sum()) == pytest.approx(0.3 / 0.4)


def test_points_count_for_the_place_as_odometry_and_walls_know_it_together(points: MapSurface) -> None:
    """At the edge of the map, where walls alone hardly tell. Another place beside the map becomes less likely
    with "nowhere"."""
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    (first,) = verdict.hypotheses
    fit = register_in_space(query.views, points, first.T_map_query)
    drifted = replace(first, covariance=0.01 * np.eye(3))
    elsewhere = replace(drifted, T_map_query=SE2(9.0, 9.0, 0.0) @ first.T_map_query)
    beside = [Place(fits=(one,), mass=mass) for one, mass in ((drifted, 2.0), (elsewhere, 1.0))]
    told, _ = weighed(with_masses(verdict, 0.2), beside, 0.0, accept=0.9)
    settled = settle_in_space(told, query, lambda _: points, accept=0.9)
    # Odds beside "nowhere", by the walls, by odometry, and by the points.
    odds = (0.2 / 0.8 + 2.0) * math.exp(log_odds_in_space(fit))
    assert told.status == "ambiguous" and told.confidence == pytest.approx(2.25 / (1.0 + 2.25 + 1.0))
    assert settled.status == "located" and settled.confidence / settled.off_map[0].mass == pytest.approx(odds)


def test_a_place_that_icp_leaves_is_turned_down(points: MapSurface) -> None:
    """0.65 m beside the right one; what it tells is the same wherever the place is."""
    query, verdict = ask(HEIGHTS_M[0], 0.65)
    settled = settle_in_space(verdict, query, lambda _: points, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "not_found" and in_space is None
    odds = 0.95 / 0.05 * math.exp(SPACE.left)
    assert settled.confidence == pytest.approx(odds / (1.0 + odds))


def test_what_stands_in_the_way_contradicts_more_than_what_is_gone(points: MapSurface) -> None:
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    fit = register_in_space(query.views, points, verdict.hypotheses[0].T_map_query)
    assert isinstance(fit, SpatialFit)
    gone = replace(fit, on=fit.on - 0.1, through=fit.through + 0.1)
    stands = replace(fit, on=fit.on - 0.1, before=fit.before + 0.1)
    assert log_odds_in_space(fit) > log_odds_in_space(gone) > log_odds_in_space(stands)


def test_a_place_that_is_turned_down_is_not_kept_for_one_that_is_not_compared() -> None:
    """The map ends before the second place, so that is not compared and stays as unlikely as it was."""
    query, verdict = ask(HEIGHTS_M[0], 0.0, 60.0)
    believed = with_masses(verdict, 0.95, 0.01)
    wrong = other_walls()
    settled = settle_in_space(believed, query, lambda _: wrong, accept=0.9)
    in_space = settled.in_space
    assert settled.status == "not_found" and settled.confidence < 0.5
    assert in_space is not None and in_space.status == "contradicts"


def test_only_what_can_matter_is_compared(points: MapSurface) -> None:
    """A place that is certain whatever the others are; not one of two twins."""
    asked: list[int] = []

    def points_of(session_index: int) -> MapSurface:
        asked.append(session_index)
        return points

    query, alone = ask(HEIGHTS_M[0], 0.0, APART_M)
    likely = with_masses(alone, 0.95, 0.01)
    assert settle_in_space(likely, query, points_of, accept=0.9).status == "located"
    assert len(asked) == 1
    settle_in_space(alone, query, points_of, accept=0.9)
    assert len(asked) == 3


def test_without_points_on_a_side_nothing_changes(points: MapSurface) -> None:
    query, verdict = ask(HEIGHTS_M[0], 0.0)
    assert settle_in_space(verdict, query, lambda _: None, accept=0.9) is verdict
    assert settle_in_space(verdict, QueryInSpace(Config()), lambda _: points, accept=0.9) is verdict


def test_what_was_seen_before_tracking_was_lost_is_forgotten() -> None:
    query, scans = Query(Config(), Config().relocalize, in_space=True), drive(HEIGHTS_M[0])
    planar_scan = flat_scan(np.ones((1, 2)), np.ones(BEARINGS))
    for registered, _ in scans[:3]:
        query.add(registered, planar_scan)
    assert query.in_space is not None and len(query.in_space.views) == 3
    query.add(replace(scans[3][0], health=Health.LOST), planar_scan)
    assert query.in_space.views == () and query.in_space.T_odom_base is None
    query.add(replace(scans[4][0], scan=replace(scans[4][0].scan, sensor="laser")), planar_scan)
    assert query.in_space.views == ()


# --- A running robot's points, where the database has points, too ---


LOW_M, HIGH_M = 2.5, 3.5
TWINS = building(
    {"low": office(), "high": office()}, labels={"low": Label(floor="low"), "high": Label(floor="high")}
)
ALONE = building({"high": office()})


def with_points(index: MapIndex, maps: Mapping[str, MapSurface]) -> MapIndex:
    index = copy.copy(index)
    index.surface_of = lambda number: maps.get(index.sessions[number])
    return index


@pytest.fixture(scope="module")
def maps() -> dict[str, MapSurface]:
    return {"low": MapSurface(points_of(LOW_M)), "high": MapSurface(points_of(HIGH_M))}


@pytest.mark.parametrize(("height_m", "name"), [(LOW_M, "low"), (HIGH_M, "high")])
def test_twins_that_differ_in_height_only(height_m: float, name: str, maps: dict[str, MapSurface]) -> None:
    plain, spatial = Localizer(TWINS), Localizer(with_points(TWINS, maps))
    answers: list[Answer] = []
    for registered, planar_scan, _ in lidar_drive(height_m):
        in_plane = plain.add(registered, planar_scan)
        assert in_plane is None or in_plane.status != "located"
        estimate = spatial.add(registered, planar_scan)
        answers += [] if estimate is None else [estimate]
    located = [estimate for estimate in answers if estimate.state == "located"]
    assert located
    assert {estimate.session for estimate in located} == {name}
    assert all(estimate.in_space is not None for estimate in located)


def test_a_thread_refines_a_located_robot(maps: dict[str, MapSurface]) -> None:
    """The thread gets the points of a scan every 0.2 m; the pose is that of space."""
    localizer = Localizer(with_points(ALONE, maps))
    truth, errors_m = {}, []
    with Follower(localizer, beside=True) as follower:
        for registered, planar_scan, T_map_base in lidar_drive(HIGH_M):
            truth[registered.scan.stamp_ns] = T_map_base
            follower.add(registered, planar_scan)
        follower.finish()
        estimates = follower.take()
    for estimate in estimates:
        if estimate.T_map_base is None:
            continue
        assert estimate.in_space is not None and estimate.in_space.status == "agrees"
        true = truth[estimate.stamp_ns]
        errors_m.append(math.hypot(estimate.T_map_base.x - true.x, estimate.T_map_base.y - true.y))
    assert errors_m and max(errors_m) < 0.04


def test_without_points_nothing_is_done_in_space() -> None:
    assert not Localizer(ALONE).uses_points
    localizer = Localizer(with_points(ALONE, {}))
    estimates = [localizer.add(registered, planar_scan) for registered, planar_scan, _ in lidar_drive(LOW_M)]
    located = [estimate for estimate in estimates if estimate is not None and estimate.state == "located"]
    assert located and all(estimate.in_space is None for estimate in located)
