"""Following a robot: pose, health, and what it costs to be wrong."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest

from pc2grid.clouds.cloud import deskew, random_subset
from pc2grid.estimation.planar import MatchingMaps
from pc2grid.estimation.registration import KissRegistration
from pc2grid.estimation.spatial import begin
from pc2grid.estimation.tracker import Disagreement, Standstill, Tracker, check_odometry
from pc2grid.geometry import SE2, invert_pose, motion_size, transform_points, wrap_angle
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Health, OdometryCheck, OdometryOutlier, Scan
from pc2grid.settings import ProjectionConfig, RegistrationConfig
from pc2grid.simulate import SimulationConfig, prepare_session
from pc2grid.simulate.config import LidarConfig, OdometryConfig
from tests.helpers.field import DATA

HALL = DATA / "lidar/hall.mcap"


@functools.cache
def session(sensor, *, length_m=6.0, seed=4, **more):
    """The scans of a drive, each with its true pose."""
    config = SimulationConfig(length_m=length_m, seed=seed, **more)
    return list(prepare_session(sensor=sensor, config=config).scans())


@pytest.fixture(scope="module")
def laser():
    return session("laser", length_m=8.0)


def follow(scans):
    rest = iter(scans)
    beginning = begin(rest)
    tracker = Tracker(RegistrationConfig(), ProjectionConfig(), in_hand=beginning.in_hand)
    scans = itertools.chain(beginning.scans, rest)
    return [tracker.track(scan).registered for scan in scans]


def tracked(scans):
    """What a tracker on wheels says of each scan."""
    tracker = Tracker(RegistrationConfig(), ProjectionConfig(), in_hand=False)
    return [tracker.track(scan) for scan in scans]


def errors(pairs, poses):
    """Distance of each pose from the truth, both seen from the first scan."""
    first = pairs[0][1].inverse()
    truth = np.array([((first @ p).x, (first @ p).y) for _, p in pairs[: len(poses)]])
    return np.linalg.norm(np.array([T[:2, 3] for T in poses]) - truth, axis=1)


def relative_errors(poses, truth):
    """Error (m, rad) of each motion from one pose (4, 4) to the next."""
    wrong = [
        invert_pose(invert_pose(a) @ b) @ invert_pose(s) @ t
        for (a, b), (s, t) in zip(itertools.pairwise(poses), itertools.pairwise(truth), strict=True)
    ]
    return np.array([motion_size(T) for T in wrong]).T


def carried_at_2_hz(turn_rad):
    """A lidar in the hand, two scans a second, each with its true pose (4, 4).

    It turns left, right or not at all by so much from scan to scan.
    """
    config = SimulationConfig(length_m=6.0, seed=4, lidar=LidarConfig(beams=64, elevation_deg=35.0))
    rng, yaw_rad, chosen, last = np.random.default_rng(2), 0.0, [], None
    for scan, pose in prepare_session(sensor="lidar", config=config).scans():
        if last is not None and np.hypot(pose.x - last.x, pose.y - last.y) < 0.7:
            continue
        points = deskew(scan.points_m, scan.offsets_s, scan.T_first_last, float(np.ptp(scan.offsets_s)))
        T_base_held = scan.T_base_sensor @ SE2(0.0, 0.0, yaw_rad).lift()
        points = transform_points(invert_pose(T_base_held), points).astype(np.float32)
        stamp_ns = len(chosen) * 500_000_000
        held = Scan(stamp_ns=stamp_ns, points_m=points, T_base_sensor=np.eye(4), sensor="lidar")
        chosen.append((held, pose.lift() @ T_base_held))
        yaw_rad += turn_rad * rng.integers(-1, 2)
        last = pose
    return chosen


def test_a_lidar_in_the_hand_is_followed_through_turns_of_40_degrees_between_scans():
    pairs = carried_at_2_hz(np.radians(40.0))
    registered = follow(scan for scan, _ in pairs)
    assert not any(r.health is Health.LOST for r in registered)
    distance_m, turn_rad = relative_errors([r.T_session_base for r in registered], [T for _, T in pairs])
    assert distance_m.max() < 0.25 and np.degrees(turn_rad.max()) < 6.0  # 0.13 m, 4.0 degrees


@pytest.mark.skipif(not HALL.is_file(), reason="no real lidar: set PC2GRID_DATA")
@pytest.mark.parametrize(
    ("every", "first", "least"),
    [
        (2, 1, 0.7),
        (3, 0, 1.0),
        (4, 0, 0.7),
        pytest.param(2, 0, 0.7, marks=pytest.mark.nightly),
        pytest.param(3, 2, 0.7, marks=pytest.mark.nightly),
    ],
)
def test_a_hall_of_which_scans_are_dropped_is_followed_or_lost(every, first, least):
    """At one scan in two seconds and less the sensor turns by up to 110 degrees from one to the next.

    least : share of the scans that is not lost.
    """
    true = read_tum(HALL.with_suffix(".tum")).T_session_base
    with open_log(HALL) as log:
        scans = list(log.scans())[first::every]
    pairs = list(zip(follow(scans), true[first::every], strict=True))
    found = [(r.T_session_base, T) for r, T in pairs if r.health is not Health.LOST]
    assert len(found) >= least * len(scans)
    distance_m, _ = relative_errors([pose for pose, _ in found], [T for _, T in found])
    assert distance_m.max() < 0.1


def blind(scan):
    return dataclasses.replace(scan, T_odom_base=None)


@pytest.mark.parametrize(("sensor", "limit_m"), [("laser", 0.06), ("lidar", 0.06), ("depth", 0.10)])
def test_each_sensor_is_followed(sensor, limit_m):
    pairs = session(sensor, length_m=8.0) if sensor == "laser" else session(sensor)
    registered = follow(scan for scan, _ in pairs)
    assert len(registered) == len(pairs)
    assert errors(pairs, [r.T_session_base for r in registered]).max() < limit_m
    assert sum(r.health is Health.LOST for r in registered) == 0
    first = registered[0].T_session_base  # the session begins here; the others level it by the floor they see
    assert first[:2, 3] == pytest.approx((0.0, 0.0), abs=1e-9)
    # Levelling turns it about a horizontal axis: of the tilt, 1e-3, the heading changes in second order.
    assert SE2.from_matrix(first).yaw == pytest.approx(0.0, abs=1e-5)
    assert np.array_equal(first, np.eye(4)) == (sensor == "laser")


def test_a_camera_keeps_its_heading_where_wheels_turn_a_tenth_too_far():
    config = SimulationConfig(length_m=6.0, seed=5, odometry=OdometryConfig(rotation_bias=0.1))
    pairs = list(prepare_session(sensor="depth", config=config).scans())
    start = pairs[0][1].yaw
    true = np.array([pose.yaw - start for _, pose in pairs])

    def worst_deg(poses):
        yaws = np.array([SE2.from_matrix(T).yaw for T in poses])
        return np.degrees(np.abs(wrap_angle(yaws - yaws[0] - true)).max())

    assert worst_deg([scan.T_odom_base for scan, _ in pairs]) > 2.0
    assert worst_deg([r.T_session_base for r in follow(scan for scan, _ in pairs)]) < 0.2


def facing_a_wall(scans, apart_ns=100_000_000):
    """What a camera sees that stands 3 m in front of a long wall: it, and the floor before it."""
    rng = np.random.default_rng(3)
    for k in range(scans):
        floor = np.column_stack((rng.uniform(1.0, 2.9, 1500), rng.uniform(-1.5, 1.5, 1500), np.zeros(1500)))
        along, up = rng.uniform(-1.7, 1.7, 3000), rng.uniform(0.0, 2.0, 3000)
        wall = np.column_stack((np.full(3000, 3.0), along, up))
        points = np.concatenate((floor, wall)) + rng.normal(0.0, 0.003, (4500, 3))
        T_base_camera = np.eye(4)
        T_base_camera[2, 3] = 0.6
        yield Scan(stamp_ns=k * apart_ns, points_m=points, T_base_sensor=T_base_camera, sensor="depth")


def turning_before_a_wall(wall_m, turn_deg):
    """What a camera sees that turns by 180 degrees in a room of 6.5 x 5 m, first `wall_m` from a wall: floor
    and walls, with the true heading."""
    rng, mount = np.random.default_rng(2), np.eye(4)
    mount[2, 3] = 0.6
    bearing, up = np.meshgrid(np.radians(np.linspace(-43, 43, 120)), np.linspace(-0.5, 0.6, 40))
    for k in range(60):
        yaw = np.radians(turn_deg * np.clip(k - 6, 0, 180.0 / turn_deg))
        ahead = np.stack((np.cos(bearing + yaw), np.sin(bearing + yaw)))
        low, high = np.array((-6.0, -2.1)), np.array((wall_m, 2.9))
        to_walls = np.where(ahead > 0.0, high[:, None, None], low[:, None, None]) / ahead
        rays = np.stack((np.cos(bearing), np.sin(bearing), up * np.cos(bearing)))
        to_floor = np.where(up < 0.0, mount[2, 3] / np.maximum(-rays[2], 1e-9), np.inf)
        range_m = np.minimum(to_walls.min(axis=0), to_floor) * (1.0 + rng.normal(0.0, 0.002, up.shape))
        x, y, z = rays * range_m
        in_view = (x > 0.3) & (range_m < 5.0)
        points = np.column_stack((x[in_view], y[in_view], mount[2, 3] + z[in_view]))
        yield Scan(stamp_ns=k * 100_000_000, points_m=points, T_base_sensor=mount, sensor="depth"), yaw


@pytest.mark.parametrize(("wall_m", "turn_deg"), [(0.35, 4.5), (0.45, 6.0), (0.6, 4.5)])
def test_a_camera_without_odometry_turns_in_front_of_a_wall(wall_m, turn_deg):
    """It sees 16 to 30 hits that the map does not know, which fit the scans before: 0.2 to 0.5 degrees off.

    With the motion before alone it would turn on, by 4.5 or 6 degrees a scan, when it has stopped.
    """
    pairs = list(turning_before_a_wall(wall_m, turn_deg))
    found = follow(scan for scan, _ in pairs)
    off_rad = wrap_angle(SE2.from_matrix(found[-1].T_session_base).yaw - pairs[-1][1])
    assert abs(np.degrees(off_rad)) < 2.0


def test_a_camera_without_odometry_does_not_follow_kiss_icp_along_a_wall(monkeypatch):
    """KISS-ICP, which knows a quarter of the surroundings, slides by up to half a metre a scan."""

    def sliding(self, points, guess):
        return SE2(0.0, 0.3, 0.0).lift() @ guess

    monkeypatch.setattr(KissRegistration, "register", sliding)
    registered = follow(facing_a_wall(12))
    assert np.abs([r.T_session_base[:2, 3] for r in registered]).max() < 0.05


def along_a_corridor(step_m, reach_m):
    """What a laser of a short range sees in a corridor of 2 m with niches of unlike lengths in both walls.

    Its odometry is exact; each scan has its true pose.
    """
    bearing, ranges_m = np.linspace(-2.3, 2.3, 180), np.arange(0.1, reach_m, 0.01)
    rays = np.stack((np.cos(bearing), np.sin(bearing)))[:, :, None] * ranges_m
    for k in range(12):
        x_m = step_m * k
        x = rays[0] + x_m
        niche = np.sin(2.0 * x) + np.sin(3.4 * x) > 0.5
        outside = np.abs(rays[1]) > np.where(niche, 1.3, 1.0)
        returned = outside.any(axis=1)
        hits = rays[:, np.flatnonzero(returned), outside[returned].argmax(axis=1)]
        points = np.column_stack((*hits, np.zeros(returned.sum()))).astype(np.float32)
        pose = SE2(x_m, 0.0, 0.0)
        scan = Scan(
            stamp_ns=k * 5_000_000_000, points_m=points, T_base_sensor=np.eye(4), sensor="laser",
            T_odom_base=pose.lift(),
        )  # fmt: skip
        yield scan, pose


def test_a_scan_that_shows_much_new_ground_does_not_overrule_odometry():
    """Of 4 m that it sees ahead, less than three are known: it would fit whole near where the scan before was
    taken. After steps of 1.75 m it is 0.15 m off, after 2 m a niche."""
    pairs = list(along_a_corridor(step_m=1.5, reach_m=4.0))
    registered = follow(scan for scan, _ in pairs)
    assert not any(r.health in (Health.OVERRULED, Health.LOST) for r in registered)
    assert errors(pairs, [r.T_session_base for r in registered]).max() < 0.1  # a fifth of a niche


def test_odometry_with_the_wrong_sign_is_overruled(laser):
    wrong = []
    for k, (scan, pose) in enumerate(laser):
        odometry = scan.T_odom_base
        if k:  # every step negated, as a log does whose encoder counts without a sign
            true_step = invert_pose(laser[k - 1][0].T_odom_base) @ odometry
            step = true_step.copy()
            step[:2, 3] *= -1.0
            odometry = wrong[-1][0].T_odom_base @ step
        within = scan.T_first_last.copy()
        within[:2, 3] *= -1.0
        wrong.append((dataclasses.replace(scan, T_odom_base=odometry, T_first_last=within), pose))
    registered = follow(scan for scan, _ in wrong)
    assert errors(laser, [r.T_session_base for r in registered]).max() < 0.15
    assert sum(r.health is Health.OVERRULED for r in registered) > 0.5 * len(registered)
    assert not any(r.health is Health.OVERRULED for r in follow(scan for scan, _ in laser))


def test_laser_without_odometry_is_followed_or_reported_lost(laser):
    registered = follow(blind(scan) for scan, _ in laser)
    lost = [r.health is Health.LOST for r in registered]
    followed = [*lost, True].index(True)
    # Until it is said to be lost, a pose is off by less than a cell of the map.
    assert followed > 0.5 * len(lost)  # all of them today
    assert errors(laser, [r.T_session_base for r in registered[:followed]]).max() < 0.05


def restarted(pairs, stamp_shift_ns=0):
    """The same scans from a robot whose odometry starts again with the first of them."""
    first = invert_pose(pairs[0][0].T_odom_base)
    return [
        (
            dataclasses.replace(
                scan, T_odom_base=first @ scan.T_odom_base, stamp_ns=scan.stamp_ns + stamp_shift_ns
            ),
            pose,
        )
        for scan, pose in pairs
    ]


def late(pairs, first, last):
    """The same scans, but odometry stands still from scan `first` on and catches up with scan `last`."""
    return [
        (dataclasses.replace(scan, T_odom_base=pairs[first][0].T_odom_base), pose)
        if first < k < last
        else (scan, pose)
        for k, (scan, pose) in enumerate(pairs)
    ]


def sparse(pairs, every, change=lambda scan: scan):
    """One scan of so many, a second and a half apart."""
    return [
        (dataclasses.replace(change(scan), stamp_ns=k * 1_500_000_000), pose)
        for k, (scan, pose) in enumerate(pairs[::every])
    ]


def absurd_within(scan):
    """A counter that restarts during a scan would spread its points widely."""
    assert scan.T_first_last is not None
    return dataclasses.replace(scan, T_first_last=SE2(3.0, -2.0, 2.0).lift())


FAULTS = {
    "missing before a gap": lambda laser: [*laser[:31], (blind(laser[31][0]), laser[31][1]), *laser[61:]],
    "restarts at the same place": lambda laser: [*laser[:40], *restarted(laser[40:])],
    "restarts after 20 s": lambda laser: [*laser[:40], *restarted(laser[40:], 20 * 10**9)],
    "late at 20": lambda laser: late(laser, 20, 28),
    "late at 40": lambda laser: late(laser, 40, 48),
    "late at 55": lambda laser: late(laser, 55, 63),
    "absurd within scans": lambda laser: [(absurd_within(scan), pose) for scan, pose in laser],
    "one scan of fifteen": lambda laser: sparse(laser, 15),
    "one scan of four, none": lambda laser: sparse(laser, 4, blind),
}


LEAST_STEP_M = {"missing before a gap": 1.0, "one scan of fifteen": 0.6, "one scan of four, none": 0.2}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_odometry_lose_no_place(laser, fault):
    pairs = FAULTS[fault](laser)
    steps = [a.inverse() @ b for (_, a), (_, b) in itertools.pairwise(pairs)]
    assert max(np.hypot(step.x, step.y) for step in steps) > LEAST_STEP_M.get(fault, 0.0)
    if "late" in fault or "restarts" in fault:  # by odometry alone, it is elsewhere
        T_first_odom = invert_pose(pairs[0][0].T_odom_base)
        assert errors(pairs, [T_first_odom @ scan.T_odom_base for scan, _ in pairs]).max() > 0.25
    registered = follow(scan for scan, _ in pairs)
    assert not any(r.health is Health.LOST for r in registered)
    limit_m = 0.08 if "one scan" in fault else 0.06
    assert errors(pairs, [r.T_session_base for r in registered]).max() < limit_m


def test_a_gap_over_which_odometry_turned_wrong_loses_no_place(laser):
    """A pause of three seconds in which wheels turned 9 degrees too far: the scans behind it decide."""
    wrong = SE2(0.0, 0.0, 0.15).lift()
    behind = [
        (dataclasses.replace(scan, T_odom_base=wrong @ scan.T_odom_base), pose) for scan, pose in laser[70:]
    ]
    pairs = [*laser[:40], *behind]
    found = tracked(scan for scan, _ in pairs)
    assert not any(t.restart for t in found)
    assert sum(t.registered.health is Health.LOST for t in found) <= 1
    assert errors(pairs, [t.registered.T_session_base for t in found])[41:].max() < 0.06


def test_odometry_that_restarts_in_a_gap_is_not_used(laser):
    gap_ns = laser[39][0].stamp_ns - laser[0][0].stamp_ns + 5_000_000_000
    elsewhere = restarted(session("laser", length_m=3.0, seed=11), gap_ns)
    found = tracked(scan for scan, _ in [*laser[:40], *elsewhere])
    # The robot may be near, so ten scans are searched for before tracking starts again.
    assert [k for k, t in enumerate(found) if t.registered.health is Health.LOST] == list(range(40, 51))
    assert [k for k, t in enumerate(found) if t.restart] == [51]


def test_carried_off_without_odometry_is_noticed_and_restarts(laser):
    end_ns = laser[39][0].stamp_ns
    elsewhere = [
        dataclasses.replace(scan, stamp_ns=end_ns + (k + 1) * 100_000_000)
        for k, (scan, _) in enumerate(session("laser", length_m=3.0, seed=11))
    ]
    found = tracked(map(blind, [*(scan for scan, _ in laser[:40]), *elsewhere]))
    health = [t.registered.health for t in found]
    assert Health.LOST not in health[:40]
    assert Health.LOST in health[40:45] or any(t.restart for t in found)
    assert health[-1] is not Health.LOST


def test_a_single_wall_is_degenerate_along_itself():
    """It is 6 m long, 2 m ahead of a robot that drives along it by odometry."""
    y = np.linspace(-3, 3, 150)
    wall = np.column_stack((np.full(150, 2.0), y, np.zeros(150)))
    rng = np.random.default_rng(0)
    scans = [
        Scan(
            stamp_ns=k * 100_000_000, points_m=wall + rng.normal(0, 0.005, (150, 1)) * (1, 0, 0),
            T_base_sensor=np.eye(4), sensor="laser", T_odom_base=SE2(0.0, 0.02 * k, 0.0).lift(),
        )
        for k in range(8)
    ]  # fmt: skip
    found = [t.registered for t in tracked(scans)]
    assert {registered.health for registered in found[2:]} == {Health.DEGENERATE}
    assert found[-1].T_session_base[1, 3] == pytest.approx(0.14, abs=0.03)


def test_empty_scans_only_advance_the_time(laser):
    def emptied(k, scan):
        return dataclasses.replace(scan, points_m=np.zeros((0, 3), np.float32), offsets_s=None) if k else scan

    found = tracked(emptied(k % 3 == 1, scan) for k, (scan, _) in enumerate(laser[:30]))
    assert errors(laser, [t.registered.T_session_base for t in found]).max() < 0.05
    assert not any(t.keyframe for t in found[1::3])
    assert all(len(t.planar_scan.hits_m) == 0 for t in found[1::3])


def test_standing_still_adds_no_keyframes(laser):
    scan = laser[0][0]
    still = (dataclasses.replace(scan, stamp_ns=scan.stamp_ns + k) for k in range(0, 10**9, 10**8))
    assert sum(t.keyframe for t in tracked(still)) == 1


def test_deskew_puts_points_back_where_they_were():
    rng = np.random.default_rng(5)
    world = rng.uniform(-5, 5, (500, 3))
    offsets = rng.uniform(-0.05, 0.1, 500).astype(np.float32)
    motion = SE2(0.08, 0.01, 0.09).lift()  # in 0.1 s, from standing at the origin at the stamp
    seen = np.empty_like(world)
    for k, t in enumerate(offsets):
        pose = np.eye(4)
        yaw = 0.09 * t / 0.1
        pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        pose[:2, 3] = 0.08 * t / 0.1, 0.01 * t / 0.1
        seen[k] = transform_points(invert_pose(pose), world[k : k + 1])[0]
    assert np.abs(deskew(seen.astype(np.float32), offsets, motion, 0.1) - world).max() < 0.005
    assert np.abs(seen - world).max() > 0.3


def test_a_turn_that_begins_within_a_scan_is_undone_by_odometry():
    config = SimulationConfig(length_m=6.0, seed=4, lidar=LidarConfig(rate_hz=5.0, columns=450))
    pairs = list(prepare_session(sensor="lidar", config=config).scans())
    first = pairs[0][1].inverse()

    def worst_heading(scans):
        found = [SE2.from_matrix(registered.T_session_base) for registered in follow(scans)]
        return max(
            abs(((first @ truth).inverse() @ pose).yaw) for pose, (_, truth) in zip(found, pairs, strict=True)
        )

    aware = worst_heading(scan for scan, _ in pairs)
    unaware = worst_heading(dataclasses.replace(scan, T_first_last=None) for scan, _ in pairs)
    assert aware < np.radians(1.0) and aware < 0.6 * unaware


def test_a_random_subset_keeps_order_and_repeats():
    kept = random_subset(1000, 100)
    assert len(kept) == 100 and (np.diff(kept) > 0).all() and np.array_equal(kept, random_subset(1000, 100))
    assert len(random_subset(1000, 5000)) == 1000


def test_kiss_icp_without_points_returns_the_guess():
    kiss = KissRegistration(RegistrationConfig())
    guess = SE2(0.1, 0.0, 0.05).lift()
    assert np.array_equal(kiss.register(np.zeros((0, 3)), guess), guess)


def test_a_camera_without_odometry_does_not_leap_along_a_wall(monkeypatch):
    """A single leap would go on for many scans, as the motion before continues."""
    depth = [blind(scan) for scan, _ in session("depth", length_m=2.0, seed=3)[:30]]
    tracker = Tracker(RegistrationConfig(), ProjectionConfig(), in_hand=False)
    for scan in depth[:-1]:
        before = SE2.from_matrix(tracker.track(scan).registered.T_session_base)
    matched = MatchingMaps.match

    def leaping(self, planar_scan, guess, prior, information, **how):
        match = matched(self, planar_scan, guess, prior, information, **how)
        # The points know everything but x, and say that it is elsewhere.
        away = SE2(prior.x + 0.41, prior.y, prior.yaw)
        known = np.diag([2000.0, 40000.0, 40000.0])
        return dataclasses.replace(match, pose=away, by_points=away, information=known, overlap=1.0)

    monkeypatch.setattr(MatchingMaps, "match", leaping)
    pose = SE2.from_matrix(tracker.track(depth[-1]).registered.T_session_base)
    # Of the leap of 0.41 m a quarter is believed, which the next scans correct; a step is 0.04 m.
    assert abs(pose.x - before.x) < 0.41 / 3.0


def standing(scan, seconds, see=lambda points, k: points):
    """Scans of a robot that stands where `scan` was taken. see : the points (N, 3) of the k-th of them."""
    rng = np.random.default_rng(0)
    for k in range(int(10 * seconds)):
        noisy = (scan.points_m + rng.normal(0.0, 0.005, scan.points_m.shape)).astype(np.float32)
        points = see(noisy, k).astype(np.float32)
        yield dataclasses.replace(scan, stamp_ns=scan.stamp_ns + k * 10**8, points_m=points, offsets_s=None)


def chained(*parts):
    """Scans that follow each other after a tenth of a second; odometry stands still in between."""
    scans, end_ns, T_odom_base = [], 0, np.eye(4)
    for part in map(list, parts):
        T = T_odom_base @ invert_pose(part[0].T_odom_base)
        for scan in part:
            stamp_ns = end_ns + scan.stamp_ns - part[0].stamp_ns
            scans.append(dataclasses.replace(scan, stamp_ns=stamp_ns, T_odom_base=T @ scan.T_odom_base))
        end_ns, T_odom_base = scans[-1].stamp_ns + 10**8, scans[-1].T_odom_base
    return scans


def within(points, nearest_m, first_rad, last_rad):
    """Points (N, 3) of which those in a sector are as near as somebody who stands there."""
    bearing = np.arctan2(points[:, 1], points[:, 0])
    hidden = (bearing > first_rad) & (bearing < last_rad)
    return np.where(hidden[:, None], points * nearest_m / np.linalg.norm(points, axis=1)[:, None], points)


def walls_changed(scans):
    return [k for k, t in enumerate(tracked(scans)) if t.walls_changed]


@pytest.mark.parametrize("cabin_s", [0.0, 8.0])
def test_all_walls_that_change_in_a_standstill_begin_a_new_part(laser, cabin_s):
    """A robot rides in a lift, of which the cabin hides all else, and looks at another floor for 4 s."""
    down = [scan for scan, _ in laser[:40]]
    up = [scan for scan, _ in session("laser", seed=2, building_seed=2)]
    ride = standing(down[-1], cabin_s, lambda points, k: within(points, 0.8, -4.0, 4.0))
    parts = [list(part) for part in (down, ride, standing(up[0], 4.0), up)]
    (changed,) = walls_changed(chained(*filter(None, parts)))
    begin = len(down) + int(10 * (cabin_s + 4.0))
    assert begin <= changed < begin + 10  # it starts slowly


@pytest.mark.parametrize(
    "see",
    [
        lambda points, k: within(points, 1.0, 0.1 * k - 2.0, 0.1 * k - 1.2),  # somebody walks by
        lambda points, k: within(points, 0.8, -0.6, 0.6),  # and stands in front
        lambda points, k: within(points, 8.0, 0.3, 0.9),  # a door opens
        lambda points, k: within(points, 0.2, -4.0, 4.0) if k < 50 else points,  # something covers the laser
        lambda points, k: points[:0] if k < 50 else points,  # it is blinded
    ],
)
def test_what_passes_a_standing_robot_begins_no_new_part(laser, see):
    scans = [scan for scan, _ in laser]
    assert walls_changed(chained(scans[:40], standing(scans[40], 6.0, see), scans[41:])) == []


# --- Health says where the scans overruled odometry ---


SLIGHT, LARGE, LARGER = (
    Disagreement(0.02, 0.01, False),
    Disagreement(0.3, 0.1, True),
    Disagreement(0.2, 0.7, True),
)


def test_scans_that_follow_closely_are_one_stretch():
    stamps_ns = [k * 5 * 10**8 for k in range(8)]
    found = check_odometry(stamps_ns, [None, SLIGHT, LARGE, SLIGHT, LARGER, None, None, LARGE])
    assert found == OdometryCheck(
        compared=5,
        overruled=3,
        stretches=(
            OdometryOutlier(from_ns=10**9, to_ns=2 * 10**9, distance_m=0.3, turn_rad=0.7),
            OdometryOutlier(from_ns=35 * 10**8, to_ns=35 * 10**8, distance_m=0.3, turn_rad=0.1),
        ),
    )
    assert check_odometry([], []) == OdometryCheck()


def checked(scans):
    found = tracked(scans)
    check = check_odometry([t.registered.scan.stamp_ns for t in found], [t.disagreement for t in found])
    return check, [t.registered.health for t in found]


def test_odometry_that_is_merely_inexact_or_missing_is_not_overruled(laser):
    scans = [scan for scan, _ in laser]
    check, _ = checked(scans)
    assert check.compared == len(scans) - 1 and check.overruled == 0
    check, _ = checked(map(blind, scans[:30]))
    assert check == OdometryCheck()


def test_odometry_that_stalls_and_catches_up_in_one_step_is_overruled_there(laser):
    """As that of a real robot did: four scans without a motion, then half a turn at once."""
    scans = [scan for scan, _ in laser]
    odometry = [SE2.from_matrix(scan.T_odom_base) for scan in scans]
    steps = [a.inverse() @ b for a, b in zip(odometry, odometry[4:], strict=False)]
    first = int(np.argmax([np.hypot(step.x, step.y) + abs(step.yaw) for step in steps])) + 1
    stalled = [scan for scan, _ in late(laser, first - 1, first + 3)]
    check, health = checked(stalled)
    assert 1 <= check.overruled <= 5 and len(check.stretches) == 1
    (stretch,) = check.stretches
    assert scans[first].stamp_ns <= stretch.from_ns <= stretch.to_ns <= scans[first + 3].stamp_ns
    assert Health.LOST not in health


# --- Walls that change for good while the base stands, and those that only seem to ---


def at(second, x_m):
    return Scan(
        stamp_ns=int(second * 1e9), points_m=np.zeros((1, 3), np.float32), T_base_sensor=np.eye(4),
        sensor="laser", T_odom_base=SE2(x_m, 0.0, 0.0).lift(),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("fits_before", "left"),
    [
        (True, True),
        (False, False),  # a robot that stands from the start, and of which no scan ever fitted well
    ],
)
def test_walls_have_changed_only_where_they_were_known(fits_before, left):
    standstill = Standstill()
    assert not standstill.left(at(0.0, 0.0), sure=fits_before)
    assert not any(standstill.left(at(0.1 * k, 0.0), sure=False) for k in range(1, 60))
    assert standstill.left(at(6.0, 0.3), sure=False) == left
