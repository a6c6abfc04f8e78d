"""Which of several matches is taken, and how far it is believed."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np
import pytest

from pc2grid.estimation.planar import GroundModel, PlanarMatcher
from pc2grid.estimation.registration import KissRegistration
from pc2grid.estimation.smoother import PLANAR, PoseWithCovariance, ScanMatch
from pc2grid.estimation.spatial import Beginning, begin, is_rolling
from pc2grid.estimation.tracker import MatchedScan, follow, place
from pc2grid.geometry import F64, SE2, pose_from_rotation_vector
from pc2grid.io.recording import open_log
from pc2grid.model import Health, Scan
from pc2grid.settings import Config, ProjectionConfig, RegistrationConfig
from pc2grid.simulate import SimulationConfig, prepare_session
from pc2grid.simulate.config import LidarConfig
from tests.helpers.field import DATA

SCAN = Scan(stamp_ns=0, points_m=np.zeros((0, 3), np.float32), T_base_sensor=np.eye(4), sensor="laser")
EXACT = np.diag([1e4, 1e4, 1e4])  # a centimetre


def fit_at(x: float, *, evidence: float, fits: bool = True) -> ScanMatch:
    """A match at a place on the x axis; one that does not fit has half of its points on the map."""
    pose = SE2(x, 0.0, 0.0).lift()
    overlap = 0.9 if fits else 0.45
    return ScanMatch(
        pose=pose, alone=(pose, EXACT), overlap=overlap, measured=True,
        evidence=evidence, credible=fits,
    )  # fmt: skip


def expected(x: float, sigma: float) -> PoseWithCovariance:
    """A base at a place on the x axis, known to so many m and rad."""
    return PoseWithCovariance(SE2(x, 0.0, 0.0).lift(), sigma**2 * np.eye(3), np.array(PLANAR))


@dataclass
class Sensor:
    """Its matches are given: near where it is expected, and by search."""

    near: ScanMatch
    elsewhere: Sequence[ScanMatch] = ()
    searched: int = 0
    free = PLANAR
    ground = None

    def __bool__(self) -> bool:
        return True

    def start(self, *of_scan: object) -> F64:
        return np.eye(4)

    def take(self, *of_scan: object) -> None: ...

    def match(self, belief: PoseWithCovariance) -> list[ScanMatch]:
        return [self.near]

    def search(self, belief: PoseWithCovariance) -> Iterator[ScanMatch]:
        self.searched += 1
        yield from self.elsewhere

    def observable(self, fit: ScanMatch) -> ScanMatch:
        return fit

    def follow(self, belief: PoseWithCovariance) -> None: ...

    def levelled(self, pose: F64) -> F64:
        return pose

    def cut(self, *of_scan: object, lost: bool) -> None: ...

    def extend(self, *of_scan: object) -> None: ...

    def restart(self) -> None: ...


def placed(sensor: Sensor, belief: PoseWithCovariance) -> MatchedScan:
    return place(sensor, SCAN, SCAN.points_m, belief)  # type: ignore[arg-type]


def test_what_fits_where_it_is_expected_is_not_searched_for() -> None:
    sensor = Sensor(fit_at(0.01, evidence=100.0), [fit_at(2.0, evidence=200.0)])
    found = placed(sensor, expected(0.0, 0.02))
    assert found.alone is not None and found.alone[0][0, 3] == 0.01
    assert found.alone[1] == pytest.approx(EXACT) and not sensor.searched


def test_a_less_credible_prediction_is_made_only_for_a_scan_that_does_not_fit_the_first() -> None:
    made = []

    def another() -> Iterator[PoseWithCovariance]:
        made.append(True)
        yield expected(0.01, 0.02)

    for at, needed in ((0.01, False), (0.5, True)):
        sensor = Sensor(fit_at(at, evidence=100.0))
        place(sensor, SCAN, SCAN.points_m, expected(0.0, 0.02), another())  # type: ignore[arg-type]
        assert bool(made) is needed


def test_what_may_be_far_off_and_does_not_fit_is_searched_for() -> None:
    sensor = Sensor(fit_at(0.0, evidence=10.0, fits=False), [fit_at(1.0, evidence=100.0)])
    found = placed(sensor, expected(0.0, 0.5))
    assert sensor.searched and found.pose[0, 3] == 1.0


def test_of_two_places_that_fit_alike_neither_is_known() -> None:
    """The map may have it at either; the scans that follow decide."""
    here, there = fit_at(-0.5, evidence=100.0, fits=False), fit_at(0.5, evidence=100.5)
    found = placed(Sensor(here, [there]), expected(0.0, 0.5))
    assert found.alone is not None
    sigma_m = np.sqrt(np.linalg.inv(found.alone[1]).diagonal())
    assert sigma_m[0] > 0.5  # of masses that are equal; a third of it is 0.58 m
    assert sigma_m[1] == pytest.approx(0.01, rel=0.01)


@pytest.mark.parametrize(("new_ground", "believed"), [(90.0, True), (110.0, False)])
def test_new_ground_may_explain_a_scan_better_than_what_was_searched_for(
    new_ground: float, believed: bool
) -> None:
    """A sensor that may see what its map does not know offers that as a match without overlap."""
    nothing = replace(fit_at(0.0, evidence=new_ground, fits=False), overlap=0.0)
    sensor = Sensor(fit_at(0.0, evidence=0.0, fits=False), [fit_at(0.4, evidence=100.0), nothing])
    assert (placed(sensor, expected(0.0, 0.5)).alone is not None) is believed


def test_what_fits_neither_here_nor_elsewhere_is_not_placed() -> None:
    belief = expected(0.0, 0.02)
    found = placed(Sensor(fit_at(0.5, evidence=10.0, fits=False)), belief)
    assert found.alone is None and np.array_equal(found.pose, belief.pose)


# --- What KISS-ICP is given ---


ICP = Literal["kiss-icp", "none"]
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="PC2GRID_DATA is not there")


def test_a_matrix_that_is_nearly_a_rotation_does_not_end_the_process() -> None:
    """Rounded to 9 digits, its product with its transpose differs from 1 by 1e-10: too much for KISS-ICP."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-6, -4, -1), (6, 4, 2), (4000, 3))
    points[np.arange(4000), np.abs(points / (6, 4, 2)).argmax(axis=1)] *= 1.2
    rounded = np.round(pose_from_rotation_vector((0.3, 0.2, 0.1), (0.01, 0.0, 0.0)), 9)
    registration = KissRegistration(RegistrationConfig())
    registration.add(points, rounded)
    for _ in range(2):
        pose = registration.register(points, rounded)
        registration.add(points, pose)
    assert np.abs(pose - rounded).max() < 0.05


def test_kiss_icp_brings_a_scan_near_and_the_control_leaves_it_where_it_was() -> None:
    walls = np.random.default_rng(1).uniform((-6, -4, -1), (6, 4, 2), (4000, 3))
    faces = np.abs(walls / (6, 4, 2)).argmax(axis=1)
    walls[np.arange(4000), faces] = np.sign(walls[np.arange(4000), faces]) * np.array((6, 4, 2))[faces]
    guess = pose_from_rotation_vector((0.0, 0.0, 0.15), (0.4, -0.3, 0.0))
    found = []
    icp: ICP
    for icp in ("kiss-icp", "none"):
        registration = KissRegistration(RegistrationConfig(icp=icp))
        registration.add(walls, np.eye(4))
        found.append(registration.register(walls, guess))
    assert np.abs(found[0] - np.eye(4)).max() < 0.05
    assert np.array_equal(found[1], guess)


@pytest.mark.parametrize(("by_m", "beginnings"), [(0.05, 1), (0.2, 2)])
def test_a_scan_is_matched_twice_where_kiss_icp_brings_it_elsewhere(
    by_m: float, beginnings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within a cell both matches end at one place."""
    _, walls = hall()
    scan = scan_of(walls, mounted_m=1.0)
    matcher = PlanarMatcher(RegistrationConfig(), ProjectionConfig())
    matcher.start(scan, scan.points_m)
    matcher.cut(scan, scan.points_m, np.eye(4), lost=False)
    matcher.extend(scan, scan.points_m, np.eye(4))
    matcher.take(scan, scan.points_m)
    monkeypatch.setattr(KissRegistration, "register", lambda *given: SE2(by_m, 0.0, 0.0).lift())
    assert len(matcher.match(expected(0.0, 0.02))) == beginnings


@needs_data
def test_a_laser_without_odometry_does_not_stand_still_in_a_corridor() -> None:
    """With KISS-ICP as the only beginning it stays behind by 1.3 m, from 24 s on."""
    with open_log(DATA / "laser/hallway/hallway.mcap") as log:
        poses = np.array([r.T_session_base[:2, 3] for r, _ in follow(log.scans(0.0, 29.0))])
    assert math.dist(poses[0], poses[-1]) == pytest.approx(11.6, abs=0.3)


@needs_data
def test_a_lidar_in_the_hand_with_scans_far_apart_is_lost_without_kiss_icp() -> None:
    """Every third scan of the hall, 12 in all; with KISS-ICP none is, see test_tracker.py."""
    config = Config(registration=RegistrationConfig(icp="none"))
    with open_log(DATA / "lidar/hall.mcap") as log:
        healths = [r.health for r, _ in follow(islice(log.scans(), 0, None, 3), config)]
    assert healths.count(Health.LOST) >= 6


# --- The floor under a robot on wheels, and which sensors are on wheels ---


def hall() -> tuple[F64, F64]:
    """Points (N, 3) of the floor of a hall, 1 m below the sensor, and of its walls."""
    x, y = np.meshgrid(np.linspace(-6, 6, 80), np.linspace(-4, 4, 60))
    floor = np.column_stack((x.ravel(), y.ravel(), np.full(x.size, -1.0)))
    along, up = np.meshgrid(np.linspace(-6, 6, 80), np.linspace(-1, 2, 20))
    wall = np.column_stack((along.ravel(), np.full(along.size, 4.0), up.ravel()))
    end = np.column_stack((np.full(along.size, 6.0), along.ravel() * 4 / 6, up.ravel()))
    return floor, np.concatenate((wall, end))


def scan_of(points_m: F64, *, mounted_m: float) -> Scan:
    T_base_sensor = pose_from_rotation_vector(np.zeros(3), (0.0, 0.0, mounted_m))
    return Scan(
        stamp_ns=0, sensor="lidar", points_m=np.asarray(points_m, np.float32), T_base_sensor=T_base_sensor
    )


def shaft(slope_deg: float) -> F64:
    """Points (N, 3) that a camera sees of the floor of a narrow shaft, which rises from x = 1.2 m on, and of
    its side walls."""
    x, across = np.meshgrid(np.linspace(0.7, 5.0, 80), np.linspace(-0.7, 0.7, 30))
    z = np.maximum(x - 1.2, 0.0) * math.tan(math.radians(slope_deg))
    floor = np.column_stack((x.ravel(), across.ravel(), z.ravel()))
    up = (across.ravel() + 0.7) * 1.2
    walls = [np.column_stack((x.ravel(), np.full(x.size, side), up)) for side in (-0.7, 0.7)]
    return np.concatenate((floor, *walls))


def test_the_floor_of_a_robot_on_wheels_does_not_follow_a_ramp_ahead() -> None:
    level, ramp = (scan_of(shaft(slope_deg), mounted_m=0.6) for slope_deg in (0.0, 4.8))
    ground = GroundModel(level.points_m, level)
    for scan, scans in ((level, 200), (ramp, 80)):  # before the ramp for eight seconds
        for _ in range(scans):
            ground.follow(scan.points_m, scan)
    assert ground.ground is not None
    assert math.acos(ground.ground.normal[2]) < math.radians(1.0)


@pytest.mark.parametrize(
    ("height_m", "pitch_deg", "rolling"),
    [
        (0.0, 0.0, True),
        (0.01, 0.0, True),  # base_link above base_footprint, TurtleBot3
        (0.0, 0.3, True),  # pitch of an EKF
        (0.01, 0.3, True),
        (0.02, 5.2, False),  # depth/room, room_a
        (0.33, 1.4, False),  # room_b
        (0.02, 0.84, False),
    ],
)
def test_a_base_that_is_a_little_off_its_footprint_is_on_wheels(
    height_m: float, pitch_deg: float, rolling: bool
) -> None:
    floor, walls = hall()
    points = np.concatenate((floor, walls)) + np.array((0.0, 0.0, 1.0 - height_m))
    T_odom_base = pose_from_rotation_vector((0.0, math.radians(pitch_deg), 0.0), (0.0, 0.0, height_m))
    scan = replace(scan_of(points, mounted_m=1.0 - height_m), T_odom_base=T_odom_base)
    assert is_rolling(scan) is rolling


@pytest.fixture(scope="module")
def driven() -> list[Scan]:
    small = LidarConfig(rate_hz=5.0, columns=300)
    config = SimulationConfig(length_m=4.0, seed=3, clutter=0, lidar=small)
    return [scan for scan, _ in prepare_session(sensor="lidar", config=config).scans()]


def moved(scan: Scan, height_m: float, pitch_deg: float) -> Scan:
    """A scan whose odometry reports the base at a height and a pitch, as an EKF in three dimensions does."""
    assert scan.T_odom_base is not None
    tilted = pose_from_rotation_vector((0.0, math.radians(pitch_deg), 0.0), (0.0, 0.0, height_m))
    return replace(scan, T_odom_base=scan.T_odom_base @ tilted)


@pytest.mark.parametrize(
    ("height_m", "pitch_deg", "carried"),
    [
        (lambda k: 0.25, lambda k: 0.0, False),  # base_link stands high above base_footprint
        (lambda k: 0.01, lambda k: 0.3 * math.sin(k), False),  # pitch of an EKF
        (lambda k: 0.01, lambda k: 0.0 if k < 5 else 4.0, True),  # a hand that begins level
        (lambda k: 0.02 * k, lambda k: 0.0, True),  # and one that lifts the sensor
        (lambda k: 0.0, lambda k: 0.0 if k < 30 else 7.0, False),  # a ramp after some seconds
    ],
)
@pytest.mark.parametrize("standing", [0, 40])
def test_the_scans_of_the_first_metres_decide_whether_a_robot_is_on_wheels(
    driven: list[Scan],
    standing: int,
    height_m: Callable[[int], float],
    pitch_deg: Callable[[int], float],
    carried: bool,
) -> None:
    scans = [moved(scan, height_m(k), pitch_deg(k)) for k, scan in enumerate(driven)]
    assert len(scans) > 35
    beginning = begin(iter([scans[0]] * standing + scans))
    assert beginning.in_hand == carried
    assert len(beginning.scans) < standing + 35


def test_a_robot_that_stands_is_not_waited_for_longer_than_some_seconds() -> None:
    floor, walls = hall()
    scan = replace(scan_of(np.concatenate((floor, walls)), mounted_m=1.0), T_odom_base=np.eye(4))
    standing = [replace(scan, stamp_ns=k * 500_000_000) for k in range(60)]
    beginning = begin(iter(standing))
    assert not beginning.in_hand and len(beginning.scans) == 8


def test_a_laser_and_a_tilted_sensor_are_known_from_their_first_scan() -> None:
    floor, walls = hall()
    scan = replace(scan_of(np.concatenate((floor, walls)), mounted_m=1.0), T_odom_base=np.eye(4))
    laser = replace(scan, sensor="laser")
    assert begin(iter([laser] * 9)) == Beginning([laser])
    tilted = moved(scan, 0.0, 5.0)
    assert begin(iter([tilted] * 9)) == Beginning([tilted], in_hand=True)
