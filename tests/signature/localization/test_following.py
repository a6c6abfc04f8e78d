"""A robot that is located, carried away, and located again."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, Health, OccupancyGrid, RegisteredScan
from signature.config import Config, RelocalizeConfig
from signature.localization import localizer as follower_module
from signature.localization.answer import Answer, Place, fits_changed
from signature.localization.localizer import Follower, Localizer
from signature.localization.posterior import Belief, decide, weighed
from signature.places.map_index import Prior
from signature.places.query import query_of
from tests.helpers.simulated_drives import building, drive, office, plan

OFFICE = building({"office": office()})
OTHER = plan(16, 12, [(4, 0, 4, 7), (9, 5, 9, 12), (9, 5, 13, 5), (6, 9, 6, 12), (13, 2, 16, 2)])
FIRST = [(1.5, 7.0), (7.5, 7.0)]
HERE = SE2()
SECOND = [(6.5, 12.5), (2.0, 12.5), (1.0, 9.5)]
Step = tuple[RegisteredScan, PlanarScan, SE2]


def stretch(
    corners: list[tuple[float, float]],
    start: SE2 = HERE,
    health: Health = Health.FINE,
    grid: OccupancyGrid | None = None,
    field_deg: float = 270.0,
) -> Iterator[Step]:
    """A drive whose registered poses begin at `start`, with the same odometry, wrong by a metre and a half
    turn."""
    T_odom_session = SE2(1.0, 0.0, 3.0)
    for registered, planar_scan, truth in drive(
        office() if grid is None else grid, corners, field_rad=math.radians(field_deg)
    ):
        T_session_base = start @ SE2.from_matrix(registered.T_session_base)
        scan = replace(registered.scan, T_odom_base=(T_odom_session @ T_session_base).lift())
        moved = RegisteredScan(scan=scan, T_session_base=T_session_base.lift(), health=health)
        yield moved, planar_scan, truth


def estimates_of(localizer: Localizer, steps: list[Step]) -> list[tuple[Answer, SE2]]:
    found = []
    for registered, planar_scan, truth in steps:
        estimate = localizer.add(registered, planar_scan)
        if estimate is not None:
            found.append((estimate, truth))
    return found


@pytest.mark.parametrize(
    ("aside_m", "sigma_m", "counts"), [(0.1, 0.1, True), (1.0, 0.1, False), (0.0, 0.001, False)]
)
def test_what_odometry_says_counts_for_the_place_where_walls_say_it_more_exactly(
    aside_m: float, sigma_m: float, counts: bool
) -> None:
    query = query_of(office(), np.array([(2.0, 7.0), (7.0, 7.0)]), Config(), Config().relocalize)
    verdict, _ = decide(OFFICE, query)
    first = verdict.hypotheses[0]
    moved = replace(
        first,
        T_map_query=SE2(aside_m, 0.0, 0.0) @ first.T_map_query,
        covariance=np.eye(3) * sigma_m**2,
    )
    away = Place(
        fits=(moved,),
        mass=1e3 * verdict.confidence / (1.0 - verdict.mass),
        seen_m=0.0,
        T_odom_seen=query.T_odom_base,
        seen=(moved.covariance,),
    )
    assert verdict.status == "located"
    told, _ = weighed(verdict, [away], 0.0, 0.75)
    assert (told.status == "located") == counts == (told.confidence > 0.75)


def test_a_place_is_the_less_certain_the_likelier_tracking_slipped() -> None:
    query = query_of(office(), np.array([(2.0, 7.0), (7.0, 7.0)]), Config(), Config().relocalize)
    verdict, _ = decide(OFFICE, query)
    told, _ = weighed(verdict, [], 2.0, 0.75)
    assert verdict.status == "located" and told.status == "ambiguous"
    assert (
        told.confidence
        == told.places[0].mass
        == pytest.approx(verdict.confidence / (1.0 + 2.0 * verdict.confidence))
    )


def check_poses(estimates: list[tuple[Answer, SE2]]) -> None:
    for estimate, truth in estimates:
        pose = estimate.T_map_base
        assert pose is not None or not estimate.is_told
        assert pose is None or math.dist((pose.x, pose.y), (truth.x, truth.y)) < 0.15


def test_a_robot_that_drives_on_stays_located() -> None:
    estimates = estimates_of(Localizer(OFFICE), list(stretch(FIRST)))
    states = [estimate.state for estimate, _ in estimates]
    at = states.index("located")
    assert set(states[:at]) <= {"searching"}
    assert set(states[at:]) == {"located"}
    assert len(estimates) >= 5
    check_poses(estimates)


def test_the_odometry_frame_in_the_map_does_not_change_while_the_robot_drives() -> None:
    estimates = estimates_of(Localizer(OFFICE), list(stretch(FIRST)))
    frames = [estimate.T_map_odometry for estimate, _ in estimates if estimate.state == "located"]
    poses = np.array([(f.x, f.y) for f in frames if f is not None])
    assert len(poses) > 2
    assert np.ptp(poses, axis=0).max() < 0.2
    registered, truth = list(stretch(FIRST))[-1][0], list(stretch(FIRST))[-1][2]
    assert registered.scan.T_odom_base is not None
    assert frames[-1] is not None
    now = frames[-1] @ SE2.from_matrix(registered.scan.T_odom_base)
    assert math.dist((now.x, now.y), (truth.x, truth.y)) < 0.2


def test_a_robot_that_is_seen_being_carried_away_is_lost_and_then_recovered() -> None:
    """It is carried through a house that is not in the map."""
    steps = list(stretch(FIRST))
    end = SE2.from_matrix(steps[-1][0].T_session_base)
    steps += list(stretch([(2.0, 2.0), (2.0, 9.0)], end, Health.LOST, grid=OTHER))[:25]
    estimates = estimates_of(Localizer(OFFICE), [*steps, *stretch(SECOND, end)])
    states = [estimate.state for estimate, _ in estimates]
    at = states.index("lost")
    assert set(states[:at]) <= {"searching", "located"}
    assert states[at + 1 : at + 3] == ["recovered", "located"]
    assert set(states[at + 3 :]) == {"located"}
    check_poses(estimates)


@pytest.mark.parametrize("corners", [[FIRST[0], (4.6, 7.0)], FIRST])
def test_a_robot_that_is_carried_away_unseen_is_recovered_all_the_same(
    corners: list[tuple[float, float]],
) -> None:
    """It was put down before a scan showed anything, so odometry says that it is where it was. However much
    it has seen before, it is found by what it has seen since."""
    steps = list(stretch(corners))
    end = SE2.from_matrix(steps[-1][0].T_session_base)
    localizer = Localizer(OFFICE)
    before = estimates_of(localizer, steps)
    estimates = estimates_of(localizer, list(stretch(SECOND, end)))
    states = [estimate.state for estimate, _ in estimates]
    at = states.index("recovered")
    assert before[-1][0].state == "located" and at <= 2
    assert set(states[at + 1 :]) == {"located"}
    assert localizer.query.map().slipped_m >= before[-1][0].path_m  # none of the scans before counts
    check_poses([*before, *estimates[at:]])


def test_a_place_is_given_up_when_it_is_as_certain_that_the_robot_is_not_there() -> None:
    localizer = Localizer(OFFICE)
    estimates_of(localizer, list(stretch(FIRST)))
    query, found = localizer.query.map(), localizer.answer()
    belief = Belief(accept=0.75)
    states = [
        belief.update(query, said(found, mass, located=sure))
        for mass, sure in ((0.995, True), (0.5, False), (0.3, False), (0.8, True), (0.2, False), (0.5, False))
    ]
    assert states == ["located", "doubtful", "doubtful", "located", "lost", "lost"]


def said(answer: Answer, mass: float, *, located: bool = True) -> Answer:
    """An answer whose first place has a mass; whether that is where it is located."""
    places = tuple(replace(place, mass=0.0 if n else mass) for n, place in enumerate(answer.places))
    return replace(answer, places=places, status="located" if located else "not_found")


def test_a_place_is_told_when_a_second_search_agrees() -> None:
    """One alone may be chance; what two leave of doubt is at most .01."""
    localizer = Localizer(OFFICE)
    estimates_of(localizer, list(stretch(FIRST)))
    query, here = localizer.query.map(), localizer.answer()
    moved = SE2(3.0, 0.0, 0.0)
    there = replace(
        here,
        places=fits_changed(here.places, lambda fit: replace(fit, T_map_query=moved @ fit.T_map_query)),
    )
    for looks, expected in (
        ([(here, 0.9), (here, 0.85), (here, 0.8)], ["searching", "searching", "located"]),
        ([(here, 0.9), (there, 0.95), (there, 0.95)], ["searching", "searching", "located"]),
        ([(here, 0.995), (there, 0.8), (here, 0.8)], ["located", "lost", "lost"]),
        ([(here, 0.995), (there, 0.8), (there, 0.96)], ["located", "lost", "recovered"]),
    ):
        belief = Belief(accept=0.75)
        states = [belief.update(query, said(at, mass)) for at, mass in looks]
        assert states == expected


def test_a_robot_that_leaves_the_map_is_told_so_and_is_located_when_it_comes_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The map ends in the middle of the corridor. Without what was known before, it is lost there."""
    cells = office().cells.copy()
    cells[:, cells.shape[1] * 2 // 5 :] = UNKNOWN
    index = building({"west": replace(office(), cells=cells)})
    steps = list(stretch([(1.5, 7.0), (19.0, 7.0), (1.5, 7.0)]))
    estimates = estimates_of(Localizer(index), steps)
    states = [estimate.state for estimate, _ in estimates]
    assert "off_map" in states and "lost" not in states and states[-1] == "located"
    check_poses([(estimate, truth) for estimate, truth in estimates if estimate.is_told])
    sigmas_m = []
    for estimate, truth in estimates:
        said = estimate.to_json()["off_map"]
        assert (said is not None) == (estimate.state == "off_map")
        if said is not None:
            assert math.dist((said["x"], said["y"]), (truth.x, truth.y)) < 0.15
            assert said["session"] == "west" and said["probability"] >= 0.5
            sigmas_m.append(math.sqrt(said["covariance"][0][0]))
    assert sigmas_m[-1] > sigmas_m[0]
    before = Belief.before
    monkeypatch.setattr(Belief, "before", lambda *of: (before(*of)[0], ()))
    assert "lost" in {estimate.state for estimate, _ in estimates_of(Localizer(index), steps)}


def test_a_robot_elsewhere_is_never_located() -> None:
    estimates = estimates_of(Localizer(OFFICE), list(stretch([(2, 2), (2, 4.5)], grid=OTHER)))
    assert {estimate.state for estimate, _ in estimates} == {"searching"}
    assert all(estimate.T_map_base is None and estimate.T_map_odometry is None for estimate, _ in estimates)


def test_a_robot_that_stands_is_looked_for_once() -> None:
    first = next(stretch([(9.5, 4.0), (9.5, 3.0)], field_deg=360.0))
    steps = []
    for number in range(60):
        scan = replace(first[0].scan, stamp_ns=number * 10**8)
        steps.append((replace(first[0], scan=scan), first[1], first[2]))
    estimates = estimates_of(Localizer(OFFICE), steps)
    assert len(estimates) == 1
    assert estimates[0][0].path_m == 0.0
    check_poses(estimates)


def test_a_robot_that_stands_after_registration_was_lost_is_looked_for_at_once() -> None:
    steps = list(stretch(FIRST))
    end = SE2.from_matrix(steps[-1][0].T_session_base)
    (lost, planar_scan, truth), *_ = stretch(SECOND, end, Health.LOST, field_deg=360.0)
    since = []
    for number in range(30):
        scan = replace(lost.scan, stamp_ns=steps[-1][0].scan.stamp_ns + (number + 1) * 10**8)
        health = Health.FINE if number else Health.LOST
        since.append((replace(lost, scan=scan, health=health), planar_scan, truth))
    localizer = Localizer(OFFICE)
    assert estimates_of(localizer, steps)[-1][0].state == "located"
    ((estimate, _),) = estimates_of(localizer, since)
    assert estimate.state in ("lost", "recovered") and estimate.path_m == 0.0


def test_after_a_restart_a_located_robot_is_recovered() -> None:
    localizer = Localizer(OFFICE)
    assert estimates_of(localizer, list(stretch(FIRST)))[-1][0].state == "located"
    localizer.restart()
    estimates = estimates_of(localizer, list(stretch(FIRST, SE2(40.0, 2.0, 1.0))))
    states = [estimate.state for estimate, _ in estimates if estimate.is_told]
    assert states[0] == "recovered" and set(states[1:]) == {"located"}
    check_poses(estimates)


def test_one_place_in_two_sessions_is_one_if_they_are_joined() -> None:
    """A database of two maps of one floor: the pose stays in the map in which it was found first."""
    both = building({"monday": office(), "tuesday": office()})
    estimates = estimates_of(Localizer(both), list(stretch(FIRST)))
    assert {estimate.state for estimate, _ in estimates} == {"searching"}
    last = estimates[-1][0]
    assert last.status == "ambiguous" and last.places[0].mass == last.places[1].mass
    both = building({"monday": office(), "tuesday": office()}, joined={"monday": HERE, "tuesday": HERE})
    estimates = estimates_of(Localizer(both), list(stretch(FIRST)))
    assert len({estimate.session for estimate, _ in estimates if estimate.state == "located"}) == 1
    assert "doubtful" not in {estimate.state for estimate, _ in estimates}


def test_a_prior_is_about_the_beginning_and_is_forgotten_when_the_search_begins_again() -> None:
    """Two equal rooms: known to be in the left one at first, later carried to the right one."""
    bent = [(0, 3, 3, 3), (4, 3, 6, 3), (2, 3, 2, 5)]
    twins = plan(12, 6, [(6, 0, 6, 6), *bent, *[(x0 + 6, y0, x1 + 6, y1) for x0, y0, x1, y1 in bent]])
    # The rooms are not quite equal: their outer walls are cut off at the edge of the plan.
    index = building({"twins": twins}, Config(relocalize=RelocalizeConfig(accept=0.95)))
    steps = list(stretch([(1.0, 1.0), (5.0, 1.0)], grid=twins))
    for where, index_of in (
        ("unknown", index),
        ("left", index.within(replace(Prior.around(1.0, 1.0, 1.0), stamp_ns=0))),
    ):
        localizer = Localizer(index_of)
        estimates = estimates_of(localizer, steps)
        found = {estimate.status for estimate, _ in estimates}
        if where == "unknown":
            assert "located" not in found
            continue
        assert "located" in found  # although it has left the disc in which it began
        check_poses(estimates)
        localizer.restart()
        again = {estimate.status for estimate, _ in estimates_of(localizer, steps)}
        assert "located" not in again


def test_a_prior_says_nothing_of_a_robot_that_was_carried_away_unseen() -> None:
    index = OFFICE.within(replace(Prior.around(*FIRST[0], 1.0), stamp_ns=0))
    localizer, steps = Localizer(index), list(stretch([FIRST[0], (4.6, 7.0)]))
    assert estimates_of(localizer, steps)[-1][0].state == "located"
    end = SE2.from_matrix(steps[-1][0].T_session_base)
    estimates = estimates_of(localizer, list(stretch(SECOND, end)))
    at = [estimate.state for estimate, _ in estimates].index("recovered")
    assert {estimate.state for estimate, _ in estimates[at + 1 :]} == {"located"}
    check_poses(estimates[at:])


# --- Looks beside the tracking are those that are made in its place, and do not hold it up ---


STEPS = [
    (registered, planar_scan)
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (5.5, 7.0)], field_rad=math.radians(270))
]


FACTS = ("stamp_ns", "path_m", "session", "T_map_base")


def facts(found: list[Answer]) -> list[tuple[object, ...]]:
    return [(k.state, *(getattr(k, name) for name in FACTS)) for k in found]


def test_a_thread_makes_the_same_looks() -> None:
    found = []
    for beside in (False, True):
        with Follower(Localizer(OFFICE), beside=beside) as follower:
            estimates: list[Answer] = []
            for registered, planar_scan in STEPS:
                follower.add(registered, planar_scan)
                follower.finish()  # no travel waits, so no estimate is left out
                estimates += follower.take()
        found.append(facts(estimates))
    assert found[0] == found[1]
    assert len(found[0]) >= 3


class Slow:
    """A localizer whose estimates last until they are let go."""

    uses_points = False

    def __init__(self) -> None:
        self.go = threading.Event()
        self.scans = self.searches = self.restarts = self.points = 0

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True) -> None:
        self.scans += 1
        self.points += len(registered.scan.points_m)
        if may_search:
            self.searches += 1
            self.go.wait(60.0)

    def restart(self) -> None:
        self.restarts += 1


def test_a_slow_look_holds_up_no_scan_and_looks_that_are_out_of_date_are_left_out() -> None:
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:  # returns at once, although the first estimate lasts
            follower.add(registered, planar_scan)
        follower.restart()
        slow.go.set()
        follower.finish()
    assert slow.scans == len(STEPS)
    assert slow.restarts == 1
    # The estimates at the last metre, and at what was there before the rest came.
    assert slow.searches < len(STEPS) / 2


def test_what_waits_is_bounded_and_holds_no_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(follower_module, "MOST_KEPT", 5)
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:
            follower.add(registered, planar_scan)
        slow.go.set()
        follower.finish()
    assert 5 <= slow.scans <= 6 and slow.points == 0


def test_an_error_of_the_thread_is_raised_where_looks_are_taken() -> None:
    class Broken(Slow):
        def add(
            self, registered: RegisteredScan, planar_scan: PlanarScan, *, may_search: bool = True
        ) -> None:
            raise MemoryError("too large")

    with Follower[None](Broken(), beside=True) as follower:
        follower.add(*STEPS[0])
        follower.finish()
        with pytest.raises(MemoryError, match="too large"):
            follower.take()


def test_leaving_ends_the_thread_without_using_what_waits() -> None:
    slow = Slow()
    with Follower[None](slow, beside=True) as follower:
        for registered, planar_scan in STEPS:
            follower.add(registered, planar_scan)
        while not slow.scans:
            time.sleep(0.001)
        threading.Timer(0.05, slow.go.set).start()
    assert slow.scans < len(STEPS)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("searches")]
