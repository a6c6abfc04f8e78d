"""What is decided of a query, and what moves it: slips and the prior."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.model import Health, RegisteredScan
from signature.config import Config, RelocalizeConfig
from signature.localization.answer import Answer
from signature.localization.localizer import Localizer
from signature.localization.posterior import POSTERIOR, decide, slip_of
from signature.places.map_index import MapIndex, Prior
from signature.places.query import Query, QueryMap
from tests.helpers.simulated_drives import TWINS, building, drive, office


@functools.cache
def driven_through_the_office() -> tuple[MapIndex, QueryMap, Answer]:
    """Return the index of the office, what a drive has seen there, and where that is."""
    index = building({"office": office()})
    query = Query(index.made_with, index.config)
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        query.add(registered, planar_scan)
    seen = query.map()
    return index, seen, decide(index, seen)[0]


@pytest.mark.parametrize(("turned", "likely"), [(0, False), (1, False), (10, True)])
def test_scans_that_contradict_a_place_say_since_when_tracking_slipped(turned: int, likely: bool) -> None:
    """A single one that is seen from the same place may be a person who stands in the way."""
    index, seen, answer = driven_through_the_office()
    last = len(seen.keyframes) - turned
    keyframes = tuple(
        k if n < last else replace(k, T_odom_base=k.T_odom_base @ SE2(0.0, 0.0, 0.7))
        for n, k in enumerate(seen.keyframes)
    )
    odds, since = slip_of(index, replace(seen, keyframes=keyframes), answer)
    assert since == turned and (odds > 0.5) is likely
    weak = tuple(replace(k, weak=True) for k in keyframes)
    more, _ = slip_of(index, replace(seen, keyframes=weak), answer)
    assert more == pytest.approx(odds * POSTERIOR.slip_weak / POSTERIOR.slip) and more > odds


@pytest.mark.parametrize(("poor", "likely"), [(10, True), (1000, False)])
def test_scans_that_all_fit_poorly_do_not_tell_of_a_slip(poor: int, likely: bool) -> None:
    """So fit those of a camera in the map of a laser. If only the last ones do, that tells."""
    index, seen, answer = driven_through_the_office()
    keyframes = [
        k if n < len(seen.keyframes) - poor else replace(k, planar_scan=_blurred(k.planar_scan))
        for n, k in enumerate(seen.keyframes)
    ]
    odds, _ = slip_of(index, replace(seen, keyframes=tuple(keyframes)), answer)
    assert (odds > 0.1) is likely


def _blurred(planar_scan: PlanarScan) -> PlanarScan:
    """Return the scan with two of three hits beside the walls."""
    beside_m = np.resize([0.0, 0.4, 0.4], len(planar_scan.hits_m))[:, None]
    return replace(planar_scan, hits_m=(planar_scan.hits_m + beside_m).astype(np.float32))


# --- What is known of the pose beforehand excludes places, and nothing else ---


IN_ROOM = [(1.0, 1.0), (5.0, 1.0), (5.0, 2.4)]
AT_ONCE = Config(relocalize=RelocalizeConfig(step_m=100.0))
"""The database is asked once, at the end: what is tested here does not depend on the looks before."""
ALIKE = building({"twins": TWINS}, AT_ONCE)
OFFICE = building({"office": office()}, AT_ONCE)
ROUTE = [(1.5, 7.0), (9.5, 7.0), (9.5, 4.0)]


@functools.cache
def driven(in_office: bool) -> list[tuple[RegisteredScan, PlanarScan, SE2]]:
    return list(drive(office(), ROUTE) if in_office else drive(TWINS, IN_ROOM))


def ask(index: MapIndex, *, in_office: bool = True) -> tuple[Answer, SE2]:
    localizer = Localizer(index)
    for registered, planar_scan, truth in driven(in_office):
        localizer.add(registered, planar_scan)
        end = truth
    return localizer.answer(), end


def distance(a: SE2 | None, b: SE2) -> float:
    assert a is not None
    return math.dist((a.x, a.y), (b.x, b.y))


@pytest.mark.parametrize("room", [0.0, 6.0])
def test_of_two_rooms_that_are_alike_the_prior_names_one(room: float) -> None:
    """The robot is in the left one; whoever says it is in the right one is believed."""
    assert ask(ALIKE, in_office=False)[0].status == "ambiguous"
    answer, truth = ask(ALIKE.within(Prior.around(3.0 + room, 2.0, radius_m=3.0)), in_office=False)
    assert answer.status == "located" and answer.confidence >= 0.9 and answer.prior == "used"
    assert distance(answer.T_map_base, SE2(truth.x + room, truth.y, truth.yaw)) < 0.1
    assert answer.excluded is None
    inside = [h.T_map_query @ answer.T_odom_base for h in answer.hypotheses]
    assert all(math.dist((p.x, p.y), (3.0 + room, 2.0)) <= 3.0 for p in inside)


def test_where_the_robot_is_not_it_is_not_found_and_the_place_is_named() -> None:
    answer, truth = ask(OFFICE.within(Prior.around(17.0, 2.0, radius_m=2.0)))
    assert answer.status == "not_found" and answer.T_map_base is None
    assert answer.excluded is not None and answer.excluded.status == "located"
    assert distance(answer.excluded.pose, truth) < 0.1
    for h in answer.hypotheses:
        pose = h.T_map_query @ answer.T_odom_base
        assert distance(pose, SE2(17.0, 2.0)) <= 2.0


def test_a_prior_that_holds_changes_no_right_answer() -> None:
    free, truth = ask(OFFICE)
    for prior in (Prior.around(9.0, 5.0, radius_m=3.0), Prior.around(9.0, 5.0, radius_m=100.0)):
        answer, _ = ask(OFFICE.within(prior))
        assert answer.status == "located" and distance(answer.T_map_base, truth) < 0.1
        assert answer.confidence >= free.confidence - 1e-9


def test_a_pose_of_the_first_scan_is_carried_along_by_the_travel() -> None:
    """1 m and 20 degrees off at the start, 11 m before the answer."""
    covariance = np.diag([0.5, 0.5, 0.1])
    start = SE2(2.3, 6.5, math.radians(20.0))
    answer, truth = ask(OFFICE.within(Prior.of_pose(start, covariance, stamp_ns=0)))
    assert answer.status == "located" and distance(answer.T_map_base, truth) < 0.1
    # The end of the travel is far outside the region: without its time it would be excluded.
    answer, _ = ask(OFFICE.within(Prior.of_pose(start, covariance)))
    assert answer.status == "not_found"
    turned = Prior.of_pose(SE2(1.5, 7.0, math.pi), covariance, stamp_ns=0)
    assert ask(OFFICE.within(turned))[0].status == "not_found"


def estimates(index: MapIndex) -> tuple[list[tuple[int, str, float]], Answer]:
    """Stamp, status and confidence of each estimate in the left room, and the answer at the end."""
    localizer, found = Localizer(index), []
    for registered, planar_scan, _ in driven(in_office=False):
        estimate = localizer.add(registered, planar_scan)
        if estimate is not None:
            found.append((registered.scan.stamp_ns, estimate.status, estimate.confidence))
    return found, localizer.answer()


@functools.cache
def alike_step_by_step() -> MapIndex:
    """The two rooms, asked after each metre."""
    return building({"twins": TWINS}, Config(relocalize=RelocalizeConfig(accept=0.95)))


@functools.cache
def undecided() -> tuple[list[tuple[int, str, float]], Answer]:
    """The estimates without a prior."""
    return estimates(alike_step_by_step())


def test_a_prior_acts_at_its_time_and_never_before() -> None:
    """The robot is 3 m from the region at first."""
    free, without = undecided()
    registered, _, then = driven(in_office=False)[20]
    prior = replace(Prior.around(then.x, then.y, 1.0), stamp_ns=registered.scan.stamp_ns)
    found, answer = estimates(alike_step_by_step().within(prior))
    assert without.status == "ambiguous" and answer.status == "located" and answer.prior == "used"
    assert distance(answer.T_map_base, driven(in_office=False)[-1][2]) < 0.1
    before = [k for k, (stamp_ns, _, _) in enumerate(found) if stamp_ns < registered.scan.stamp_ns]
    assert len(before) >= 3 and found[: len(before)] == free[: len(before)]
    assert all(status == "located" for _, status, _ in found[len(before) :])


@pytest.mark.parametrize(("later_ns", "told"), [(1, ("ambiguous", "ahead")), (None, ("located", "used"))])
def test_a_prior_at_the_end_changes_no_estimate_before(later_ns: int | None, told: tuple[str, str]) -> None:
    """One of a time after the last scan says nothing yet; one without a time is about the last scan."""
    registered, _, end = driven(in_office=False)[-1]
    stamp_ns = None if later_ns is None else registered.scan.stamp_ns + later_ns
    prior = replace(Prior.around(end.x, end.y, 1.0), stamp_ns=stamp_ns)
    found, answer = estimates(alike_step_by_step().within(prior))
    assert found == undecided()[0]
    assert (answer.status, answer.prior) == told
    assert told[0] == "ambiguous" or distance(answer.T_map_base, end) < 0.1


@pytest.mark.parametrize(
    ("told_at", "lost", "again_at", "became"),
    [
        # Registration that is lost before the time of a prior takes nothing from it. But while it is lost,
        # nothing connects the time with what comes after.
        (17, range(8, 12), None, "used"),
        (17, range(12, 19), None, "lapsed"),
        (17, range(17, 18), None, "lapsed"),
        (0, range(10, 11), None, "lapsed"),
        (None, range(10, 11), None, "used"),  # without a time it is about now
        # The same of a robot that is followed anew.
        (5, (), 10, "lapsed"),
        (20, (), 10, "used"),
    ],
)
def test_a_prior_lapses_if_tracking_breaks_after_its_time(
    told_at: int | None, lost: range, again_at: int | None, became: str
) -> None:
    """It says that the robot is where it is not."""
    scans = driven(in_office=True)
    stamp_ns = None if told_at is None else scans[told_at][0].scan.stamp_ns
    localizer = Localizer(OFFICE.within(replace(Prior.around(17.0, 2.0, 1.0), stamp_ns=stamp_ns)))
    for k, (registered, planar_scan, _) in enumerate(scans):
        if k == again_at:
            localizer.restart()
        localizer.add(replace(registered, health=Health.LOST if k in lost else Health.FINE), planar_scan)
    answer = localizer.answer()
    assert (answer.prior, answer.status) == (became, "not_found" if became == "used" else "located")


def test_a_prior_that_contradicts_where_the_robot_was_located_is_not_taken_for_lapsed() -> None:
    scans, index = driven(in_office=True), building({"office": office()})
    prior = replace(Prior.around(17.0, 2.0, 1.0), stamp_ns=scans[-8][0].scan.stamp_ns)
    localizer, located = Localizer(index.within(prior)), 0
    for registered, planar_scan, _ in scans:
        estimate = localizer.add(registered, planar_scan)
        located += estimate is not None and estimate.state == "located"
    answer = localizer.answer()
    assert located and (answer.status, answer.prior) == ("not_found", "used")
    assert answer.excluded is not None and distance(answer.excluded.pose, scans[-1][2]) < 0.1


def test_the_frame_of_the_prior_is_that_of_one_session() -> None:
    both = building({"twins": TWINS, "office": office()}, AT_ONCE)
    with pytest.raises(ConfigError, match="2 sessions") as caught:
        both.within(Prior.around(1.0, 1.0, 1.0))
    assert "--session" in (caught.value.hint or "") and "office" in (caught.value.hint or "")
    with pytest.raises(ConfigError, match="'attic'"):
        both.within(Prior.around(1.0, 1.0, 1.0, session="attic"))
    answer, truth = ask(both.within(Prior.around(9.0, 5.0, 3.0, session="office")))
    assert answer.session == "office" and distance(answer.T_map_base, truth) < 0.1
    answer, _ = ask(both.within(Prior.around(9.0, 5.0, 3.0, session="twins")))
    assert answer.status == "not_found"
    assert answer.excluded is not None and answer.excluded.session == "office"


def test_regions() -> None:
    disc = Prior.around(1.0, 2.0, 3.0)
    assert disc.allows(SE2(3.9, 2.0, 2.0)) and not disc.allows(SE2(4.1, 2.0, 2.0))
    assert disc.allows(SE2(4.1, 2.0, 0.0), since_m=40.0)
    pose = Prior.of_pose(SE2(0, 0, 3.1), np.diag([4.0, 0.01, 0.01]))
    assert pose.allows(SE2(6.0, 0.0, -3.1)) and not pose.allows(SE2(0.0, 1.0, 3.1))
    assert not pose.allows(SE2(0.0, 0.0, 2.0)) and pose.radius_m > 6.0
    assert Prior.of_pose(SE2(), np.diag([1.0, 1.0, 0.0])).allows(SE2(0, 0, 3.0))
    rng = np.random.default_rng(0)
    turn = SE2(0, 0, 0.7).matrix()[:2, :2]
    spread = turn @ np.diag([1.0, 0.2]) @ turn.T
    draws = rng.multivariate_normal((0, 0), spread, 2000)
    tilted = Prior.of_pose(SE2(), np.block([[spread, np.zeros((2, 1))], [np.zeros((1, 2)), 0.01]]))
    inside = np.mean([tilted.allows(SE2(x, y, 0.0)) for x, y in draws])
    assert 0.985 < inside <= 1.0
    squares = draws * 3.0
    _, seen, _ = driven_through_the_office()
    kept = tilted.squares(seen, squares, 0.8).tolist()
    assert all([x, y] in kept for x, y in squares.tolist() if tilted.allows(SE2(x, y, 0.0)))
    assert len(kept) < len(squares)


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (np.zeros((3, 3)), "zero"),
        (np.diag([1.0, -1.0, 1.0]), "not a covariance"),
        (np.diag([1.0, math.nan, 1.0]), "finite"),
    ],
)
def test_a_covariance_that_names_no_region_is_refused(covariance: np.ndarray, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Prior.of_pose(SE2(), covariance)


@pytest.mark.parametrize("radius_m", [0.0, -1.0, math.nan, math.inf])
def test_a_radius_that_is_none_is_refused(radius_m: float) -> None:
    with pytest.raises(ConfigError, match="radius"):
        Prior.around(0.0, 0.0, radius_m)
