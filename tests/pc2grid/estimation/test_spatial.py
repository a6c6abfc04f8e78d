"""A camera in the hand: followed in space, with a map in which the floor is free and a table is no wall."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest

from pc2grid.clouds.ground import FloorBelow, level_floor
from pc2grid.estimation import spatial
from pc2grid.estimation.smoother import ScanMatch
from pc2grid.estimation.spatial import (
    SPATIAL_MATCHING,
    SpaceMap,
    SpatialMatcher,
    begin,
    first_pose,
    is_rolling,
)
from pc2grid.estimation.surface_map import LEAST_INFORMATION
from pc2grid.estimation.tracker import Tracked, Tracker, follow
from pc2grid.geometry import F64, SE2, invert_pose, motion_size, pose_from_rotation_vector
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Health, OccupancyGrid, Scan
from pc2grid.observer import Observer
from pc2grid.settings import ProjectionConfig, RegistrationConfig
from pc2grid.simulate import SimulationConfig, prepare_session
from pc2grid.simulate.scene import Scene
from signature.config import Config
from signature.session.build import map_scans
from tests.helpers.field import DATA
from tests.helpers.flat_by_hand import (
    CORRIDOR,
    box,
    camera_images,
    carried,
    images as drifting_images,
    rising,
)

ROOMS = DATA / "depth/room"
TABLE = ((2.0, 1.2), (3.2, 2.8))  # its lowest and highest corner, m


def room() -> Scene:
    """5 x 4 m, 2.5 m high, with a table of 0.7 m, a cupboard of 2 m, and a pillar."""
    parts = [
        box((0.0, 0.0), (5.0, 4.0), 0.0, 2.5),
        box(*TABLE, 0.68, 0.70),
        box((4.4, 0.0), (5.0, 1.0), 0.0, 2.0),
        box((0.0, 3.2), (0.5, 4.0), 0.0, 2.2),
    ]
    return Scene(np.concatenate(parts))


def hand(count: int) -> list[F64]:
    """T_room_base of a camera carried around the table, 1.4 m high, 10 to 35 degrees down."""
    poses = []
    for k in range(count):
        share = k / (count - 1)
        angle = math.pi * (1.0 + 1.2 * share)
        place = (2.6 + 1.7 * math.cos(angle), 2.0 + 1.3 * math.sin(angle), 1.4 + 0.05 * math.sin(0.9 * k))
        yaw, pitch = angle + math.pi, math.radians(22.0 + 12.0 * math.sin(0.35 * k))
        turn = pose_from_rotation_vector((0.0, 0.0, yaw)) @ pose_from_rotation_vector((0.0, pitch, 0.0))
        turn[:3, 3] = place
        poses.append(turn)
    return poses


def images(scene: Scene, poses: Sequence[F64], interval_ns: int = 100_000_000) -> Iterator[tuple[Scan, F64]]:
    """What it sees, 64 x 50 degrees, with noise, holes and flying pixels, and its pose."""
    view: Any = {"half": (0.63, 0.47), "noise_per_m": 0.0015, "holes": 0.2, "flying": 0.3}
    return zip(camera_images(scene, poses, poses, interval_ns=interval_ns, **view), poses, strict=True)


class Heard(Observer):
    """Keeps all warnings."""

    def __init__(self) -> None:
        self.warnings: list[str] = []

    def on_warning(self, text: str) -> None:
        """See `Observer.on_warning`."""
        self.warnings.append(text)


@pytest.fixture(scope="module")
def recorded() -> list[tuple[Scan, F64]]:
    return list(images(room(), hand(80)))


def tracked(scans: list[Scan]) -> list[Tracked]:
    tracker = Tracker(RegistrationConfig(), in_hand=True)
    return [tracker.track(scan) for scan in scans]


def error_m(found: list[Tracked], truth: list[F64]) -> float:
    """The largest distance from the truth, the first poses laid on each other."""
    T = truth[0] @ invert_pose(found[0].registered.T_session_base)
    return max(
        float(np.linalg.norm((T @ one.registered.T_session_base - true)[:3, 3]))
        for one, true in zip(found, truth, strict=True)
    )


def grid_in_the_room(scans: list[Scan], first: F64) -> tuple[OccupancyGrid, F64]:
    """The map, and T_session_room (4, 4)."""
    grid, trajectory, _ = map_scans(scans, Config())
    return grid, trajectory.T_session_base[0] @ invert_pose(first)


def test_a_camera_in_the_hand_is_followed_with_its_odometry(recorded: list[tuple[Scan, F64]]) -> None:
    """6 m of travel with exact odometry: what is left is the noise of coarse images, half a percent."""
    scans, truth = zip(*recorded, strict=True)
    found = tracked(list(scans))
    assert begin(iter(scans)).in_hand
    assert not any(one.registered.health is Health.LOST for one in found)
    assert error_m(found, list(truth)) < 0.05


def test_a_sensor_that_is_level_at_first_is_in_the_hand_from_its_first_scan_on() -> None:
    """For half a second it is held level, then as by any hand."""
    held = hand(20)
    yaw_rad = math.atan2(held[0][1, 0], held[0][0, 0])
    upright = pose_from_rotation_vector((0.0, 0.0, yaw_rad), held[0][:3, 3])
    poses = [upright] * 5 + held
    scans = [dataclasses.replace(scan, sensor="lidar") for scan, _ in images(room(), poses)]
    assert is_rolling(scans[0])
    _, trajectory, _ = map_scans(scans, Config())
    in_session = trajectory.T_session_base
    for k in range(
        len(scans) - 1
    ):  # in space from its first scan on: on wheels it has neither tilt nor height
        found, true = (invert_pose(T[k]) @ T[k + 1] for T in (in_session, poses))
        distance_m, turn_rad = motion_size(invert_pose(found) @ true)
        assert distance_m < 0.05 and turn_rad < math.radians(2.0)


def test_odometry_that_drifts_is_corrected(recorded: list[tuple[Scan, F64]]) -> None:
    """It reports 2 % too much of every step, and turns half a degree a metre."""
    scans, truth = zip(*recorded, strict=True)
    drift = [truth[0]]
    for before, now in itertools.pairwise(truth):
        step = invert_pose(before) @ now
        step[:3, 3] *= 1.02
        turn = pose_from_rotation_vector((0.0, 0.0, math.radians(0.5) * motion_size(step)[0]))
        drift.append(drift[-1] @ turn @ step)
    found = tracked([dataclasses.replace(s, T_odom_base=T) for s, T in zip(scans, drift, strict=True)])
    alone = max(float(np.linalg.norm((a - b)[:3, 3])) for a, b in zip(drift, truth, strict=True))
    assert alone > 0.08
    assert error_m(found, list(truth)) < 0.9 * alone


def test_the_floor_is_free_the_table_is_no_wall_and_walls_are(recorded: list[tuple[Scan, F64]]) -> None:
    scans = [scan for scan, _ in recorded]
    grid, T_session_room = grid_in_the_room(scans, recorded[0][1])

    def values(x0: float, y0: float, x1: float, y1: float) -> F64:
        """The cells of a rectangle of the room: -1 unknown, 0..100."""
        x, y = np.meshgrid(np.arange(x0, x1, 0.05), np.arange(y0, y1, 0.05))
        points = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size), np.ones(x.size))) @ T_session_room.T
        rows, columns = grid.to_cell(points[:, :2]).clip(0, np.array(grid.cells.shape) - 1).T
        found: F64 = grid.cells[rows, columns].astype(np.float64)
        return found

    (x0, y0), (x1, y1) = TABLE
    table = values(x0 + 0.1, y0 + 0.1, x1 - 0.1, y1 - 0.1)
    assert ((table == -1) | (table >= 20)).mean() > 0.8 and (table >= 65).mean() < 0.05
    floor = values(x1 + 0.2, 1.2, 4.8, 3.8)
    assert ((floor >= 0) & (floor < 20)).mean() > 0.9
    wall = np.array([values(5.0 - 0.1, y, 5.0 + 0.1, y + 0.05).max() for y in np.arange(1.2, 3.8, 0.05)])
    assert (wall >= 65).mean() > 0.9


def test_the_same_scans_give_the_same_bytes(recorded: list[tuple[Scan, F64]]) -> None:
    scans = [scan for scan, _ in recorded][:20]
    first, second = (tracked(scans) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert a.registered.T_session_base.tobytes() == b.registered.T_session_base.tobytes()
        assert a.planar_scan.hits_m.tobytes() == b.planar_scan.hits_m.tobytes()


def along_a_bare_wall(count: int) -> tuple[list[Scan], list[F64]]:
    """Three times a second, a fifth of a metre a step, the camera passes a long wall without a feature."""
    scene = Scene(box((0.0, 0.0), (60.0, 8.0), 0.0, 6.0))
    passing = []
    for k in range(count):
        T = pose_from_rotation_vector((0.0, 0.0, 0.5 * math.pi)) @ pose_from_rotation_vector((0.0, 0.4, 0.0))
        T[:3, 3] = 15.0 + 0.2 * k, 6.0, 1.4
        passing.append(T)
    return [scan for scan, _ in images(scene, passing, 333_000_000)], passing


def test_along_a_bare_wall_nothing_is_known_without_odometry() -> None:
    """Each image fits the last ones wherever it is put along the wall. Odometry knows how fast it goes."""
    scans, passing = along_a_bare_wall(30)
    with_it = tracked(scans)
    assert not any(one.registered.health is Health.LOST for one in with_it)
    assert error_m(with_it, passing) < 0.05
    without = tracked([dataclasses.replace(scan, T_odom_base=None) for scan in scans])
    lost = [one.registered.health is Health.LOST for one in without]
    assert sum(lost) > 3


def test_along_a_bare_wall_no_part_is_longer_than_its_pose_is_known() -> None:
    """Where the standard deviation along the wall exceeds 0.3 m, the scan is lost and a new part begins."""
    scans, passing = along_a_bare_wall(40)
    unaided = (dataclasses.replace(scan, T_odom_base=None) for scan in scans)
    followed = [registered for registered, _ in follow(unaided)]
    lost = [k for k, registered in enumerate(followed) if registered.health is Health.LOST]
    assert len(lost) > 5
    for before, after in itertools.pairwise((0, *lost, len(scans))):
        first, last = before + 1, after - 1
        if last > first:
            moved = invert_pose(followed[first].T_session_base) @ followed[last].T_session_base
            true = invert_pose(passing[first]) @ passing[last]
            assert np.linalg.norm((moved - true)[:3, 3]) < 1.0  # three standard deviations
    aided = list(follow(scans[:10]))
    assert all(registered.health is not Health.LOST for registered, _ in aided)


def test_in_a_furnished_room_the_pose_is_known_without_odometry(recorded: list[tuple[Scan, F64]]) -> None:
    found = tracked([dataclasses.replace(scan, T_odom_base=None) for scan, _ in recorded])
    health = [one.registered.health for one in found]
    assert health.count(Health.FINE) > 0.5 * len(found) and health.count(Health.LOST) < 0.1 * len(found)


def looking_up(count: int) -> list[F64]:
    """T_room_base of a camera that first looks 25 degrees up at a corner without a floor, then down."""
    poses = []
    for k in range(count):
        pitch = math.radians(-25.0 + 50.0 * min(max(k - 8, 0) / 20.0, 1.0))
        yaw = 0.6 + 0.02 * k
        T = pose_from_rotation_vector((0.0, 0.0, yaw)) @ pose_from_rotation_vector((0.0, pitch, 0.0))
        T[:3, 3] = 1.0 + 0.02 * k, 1.0, 1.4
        poses.append(T)
    return poses


def tilt_deg(found: F64, true: F64) -> float:
    """How far two attitudes disagree about what is up."""
    return math.degrees(math.acos(min(1.0, float(found[2, :3] @ true[2, :3]))))


def test_a_start_that_shows_no_floor_is_levelled_by_the_imu() -> None:
    """The IMU errs by 2 degrees, and its heading means nothing."""
    poses = looking_up(3)
    wrong = pose_from_rotation_vector((0.0, math.radians(2.0), 0.0)) @ pose_from_rotation_vector((0, 0, 2.5))
    scans = [dataclasses.replace(s, T_odom_base=None) for s, _ in images(room(), poses)]
    felt = [dataclasses.replace(s, T_level_base=level(wrong @ T)) for s, T in zip(scans, poses, strict=True)]
    by_imu = tracked(felt)
    for one, true in zip(by_imu, poses, strict=True):
        assert tilt_deg(one.registered.T_session_base, true) < 3.0  # its error, and some of tracking
    without = tracked(scans)
    assert tilt_deg(without[0].registered.T_session_base, poses[0]) > 20.0  # taken to be held level


def test_a_session_begins_with_the_floor_in_view() -> None:
    """The camera looks down to the floor within two seconds; nothing else says which way is up."""
    poses, heard = looking_up(40), Heard()
    unaided = [dataclasses.replace(scan, T_odom_base=None) for scan, _ in images(room(), poses)]
    followed = [registered for registered, _ in follow(iter(unaided), observer=heard)]
    left_out = len(unaided) - len(followed)
    assert 0 < left_out < 30
    for registered, true in zip(followed, poses[left_out:], strict=True):
        assert tilt_deg(registered.T_session_base, true) < 3.0
    (warning,) = heard.warnings
    assert f"{left_out} scans show no floor" in warning and "begin with the floor in view" in warning


def test_where_no_floor_comes_in_view_the_user_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    unaided = [dataclasses.replace(scan, T_odom_base=None) for scan, _ in images(room(), looking_up(5))]
    beginning = begin(iter(unaided))
    assert list(beginning.scans) == unaided and not beginning.left_out
    assert beginning.warning is not None and "taken to be held level" in beginning.warning
    few = dataclasses.replace(SPATIAL_MATCHING, most_waiting=3)
    monkeypatch.setattr(spatial, "SPATIAL_MATCHING", few)
    assert begin(iter(unaided)).scans == unaided[:3]
    assert begin(iter(())).warning is None


def test_a_slanting_plane_is_no_floor_where_walls_show_the_vertical(recorded: list[tuple[Scan, F64]]) -> None:
    """Points of a plane that is tilted by 25 degrees, larger than the floor in view, before the walls."""
    scan, true = recorded[0]
    heights = scan.points_m @ true[2, :3] + true[2, 3]
    walls = scan.points_m[heights > heights.min() + 0.1]
    tilted = pose_from_rotation_vector((0.0, math.radians(25.0), 0.0)) @ level(np.linalg.inv(true))
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 60), np.linspace(-1.0, 1.0, 60))
    plane = np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))) @ tilted[:3, :3].T
    plane += (1.5, 0.0, -1.2)
    for points, found in ((plane, True), (np.vstack((plane, walls)), False)):
        seen = points.astype(np.float32)
        assert (level_floor(dataclasses.replace(scan, points_m=seen), seen) is not None) is found


def test_a_floor_in_view_is_more_exact_than_the_imu(recorded: list[tuple[Scan, F64]]) -> None:
    scan, true = recorded[0]
    for error_deg, least_deg, most_deg in ((3.0, 0.0, 1.5), (40.0, 39.0, 41.0)):
        wrong = pose_from_rotation_vector((math.radians(error_deg), 0.0, 0.0))
        felt = dataclasses.replace(scan, T_odom_base=None, T_level_base=level(wrong @ true))
        found = first_pose(felt, felt.points_m)
        assert least_deg <= tilt_deg(found, true) < most_deg


@pytest.mark.parametrize("with_odometry", [False, True])
@pytest.mark.parametrize("measured", [False, True])
def test_what_a_scan_shows_of_the_vertical_holds_its_tilt(
    recorded: list[tuple[Scan, F64]], with_odometry: bool, measured: bool
) -> None:
    """A match that leans by 3 degrees as the map does: floor and walls in view turn it back, whether the map
    holds its position or not."""
    scan, true = recorded[0]
    scan = dataclasses.replace(scan, sensor="lidar", T_odom_base=scan.T_odom_base if with_odometry else None)
    matcher = SpatialMatcher(RegistrationConfig(), ProjectionConfig())
    leaning = pose_from_rotation_vector((math.radians(3.0), 0.0, 0.0)) @ matcher.start(scan, scan.points_m)
    matcher.cut(scan, scan.points_m, leaning, lost=False)
    matcher.take(scan, scan.points_m)
    fit = ScanMatch(
        pose=leaning,
        alone=(leaning, 1e4 * np.eye(6)),
        overlap=1.0,
        measured=measured,
        evidence=0.0,
        credible=True,
    )
    found, information = matcher.observable(fit).alone
    assert (tilt_deg(found, true) < 1.0) is not with_odometry
    assert (np.linalg.eigvalsh(information)[-1] > 1.5e4) is not with_odometry


@pytest.mark.parametrize(("turn_rad_per_m", "least_m", "most_m"), [(0.0, 10.0, 100.0), (0.02, 0.1, 1.0)])
def test_a_slide_is_known_only_as_far_as_it_would_tilt_the_scan(
    recorded: list[tuple[Scan, F64]], turn_rad_per_m: float, least_m: float, most_m: float
) -> None:
    """The map holds all but a slide along x, which may pitch the scan by a degree a metre."""
    scan, _ = recorded[0]
    scan = dataclasses.replace(scan, sensor="lidar", T_odom_base=None)
    matcher = SpatialMatcher(RegistrationConfig(), ProjectionConfig())
    pose = matcher.start(scan, scan.points_m)
    matcher.cut(scan, scan.points_m, pose, lost=False)
    matcher.take(scan, scan.points_m)
    slide = np.array([1.0, 0.0, 0.0, 0.0, turn_rad_per_m, 0.0])
    held = 1e4 * (np.eye(6) - np.outer(slide, slide) / (slide @ slide))
    fit = ScanMatch(pose=pose, alone=(pose, held), overlap=1.0, measured=False, evidence=0.0, credible=True)
    covariance = np.linalg.inv(matcher.observable(fit).alone[1] + LEAST_INFORMATION)
    along_m, pitch_rad = np.sqrt(covariance[0, 0]), np.sqrt(covariance[4, 4])
    assert least_m < along_m < most_m
    assert pitch_rad < math.radians(1.0)


def level(T: F64) -> F64:
    """The attitude of a pose (4, 4)."""
    turn = T.copy()
    turn[:3, 3] = 0.0
    return turn


def steps(time_s: float) -> F64:
    """T_floor_base of a hand 1.2 m above the floor, which steps and strides turn by up to 15 degrees."""
    pitch, roll = (
        math.radians(5.0)
        * sum(math.sin(2.0 * math.pi * (time_s / period_s + phase)) for period_s in (0.5, 1.0, 11.0))
        for phase in (0.0, 0.3)
    )
    turn = pose_from_rotation_vector((0.0, pitch, 0.0)) @ pose_from_rotation_vector((roll, 0.0, 0.0))
    turn[2, 3] = 1.2
    return turn


def sweeps(columns: int = 300) -> Iterator[tuple[Scan, F64]]:
    """Scans of a lidar of 16 beams that is carried through an office, with its IMU, and the true poses.

    The vertical of the IMU errs by a degree and a half, its turns by 0.3 degrees a second.
    """
    walk = prepare_session(sensor="lidar", config=SimulationConfig(length_m=2.0, seed=1))
    scene, rng = Scene(walk.mesh()), np.random.default_rng(2)
    times_s = np.arange(columns) * 0.1 / columns
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    up = np.radians(np.linspace(-15.0, 15.0, 16))
    rays = np.dstack(
        (
            np.outer(np.cos(azimuth), np.cos(up)),
            np.outer(np.sin(azimuth), np.cos(up)),
            np.tile(np.sin(up), (columns, 1)),
        )
    )

    def pose(time_s: float) -> F64:
        return walk.drive.pose(time_s).lift() @ steps(time_s)

    for k in range(int(10.0 * walk.drive.duration_s)):
        poses = np.array([pose(0.1 * k + time_s) for time_s in times_s])
        ahead = np.einsum("nij,nbj->nbi", poses[:, :3, :3], rays)
        starts = np.broadcast_to(poses[:, None, :3, 3], ahead.shape)
        ranges = scene.cast(np.concatenate((starts, ahead), axis=2).reshape(-1, 6).astype(np.float32))
        points = (ranges + 0.02 * rng.standard_normal(len(ranges)))[:, None] * rays.reshape(-1, 3)
        drift = pose_from_rotation_vector((0.0, 0.0, math.radians(0.03)))
        scan = Scan(
            stamp_ns=100_000_000 * k,
            points_m=points.astype(np.float32),
            offsets_s=np.repeat(times_s, 16).astype(np.float32),
            T_base_sensor=np.eye(4),
            sensor="lidar",
            T_first_last=level(invert_pose(poses[0]) @ poses[-1]) @ drift,
            T_level_base=level(pose_from_rotation_vector((0.0, math.radians(1.5), 0.0)) @ poses[0]),
        )
        yield scan, poses[0]


def test_sixteen_rings_in_the_hand_of_somebody_who_walks_need_the_gyroscope() -> None:
    """Steps turn the lidar by several degrees more from scan to scan than the motion before says.

    Rings are too sparse to find that by themselves.
    """
    scans, truth = zip(*sweeps(), strict=True)
    worst_deg = []
    for with_imu in (True, False):
        silent = {} if with_imu else {"T_level_base": None, "T_first_last": None}
        found = tracked([dataclasses.replace(scan, **silent) for scan in scans])
        poses = [one.registered.T_session_base for one in found]
        worst_deg.append(max(tilt_deg(a, b) for a, b in zip(poses, truth, strict=True)))
    assert worst_deg[0] < 3.0
    assert worst_deg[1] > 6.0


@pytest.mark.nightly
@pytest.mark.skipif(not ROOMS.is_dir(), reason="no recording of a phone: set PC2GRID_DATA")
@pytest.mark.parametrize(
    ("name", "with_odometry", "limit_m"),
    [("room_a", True, 0.05), ("room_a", False, 0.10), ("room_b", True, 0.05), ("room_b", False, 0.10)],
)
def test_the_rooms_of_a_phone(name: str, with_odometry: bool, limit_m: float) -> None:
    """Measured: 0.02, 0.07, 0.04, 0.06 m. Its depths are scaled by a few percent, hence the second limit."""
    with open_log(ROOMS / f"{name}.mcap") as log:
        scans = list(log.scans())
    truth = read_tum(ROOMS / f"{name}.tum")
    seen = [s if with_odometry else dataclasses.replace(s, T_odom_base=None) for s in scans]
    found = tracked(seen)
    at = np.searchsorted(truth.stamps_ns, [s.stamp_ns for s in scans]).clip(max=len(truth) - 1)
    ours = np.array([one.registered.T_session_base[:3, 3] for one in found])
    true = truth.T_session_base[at, :3, 3]
    a, b = ours - ours.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    rotation = U @ np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt)))) @ Vt
    assert math.sqrt(float(((a @ rotation.T - b) ** 2).sum(axis=1).mean())) < limit_m


# --- The map in space of a carried sensor whose height drifts: its columns stand on their own floor ---


RISE = 0.02
"""Of the way: 0.38 m when the corridor has been passed twice."""


def mapped(rise: float) -> tuple[OccupancyGrid, F64, list[float | None]]:
    """The map of the corridor by rising poses, the way (N, 2), and the heights above the floor as seen."""
    projection = ProjectionConfig()
    poses = carried(CORRIDOR)
    space, builder, above_m = None, GridBuilder(projection), []
    for scan in drifting_images(poses, rising(poses, rise)):
        points, pose = scan.points_m, scan.T_odom_base
        assert pose is not None
        if space is None:
            space = SpaceMap(scan, points, RegistrationConfig(), projection)
        space.extend(scan, points, space.thin(scan, points, np.eye(3)), pose)
        planar_scan = space.cut(scan, pose)
        builder.add(planar_scan, SE2.from_matrix(pose))
        above_m.append(planar_scan.above_floor_m)
    return builder.grid(), np.array([pose[:2, 3] for pose in poses]), above_m


def on_things(grid: OccupancyGrid, way_m: F64) -> float:
    """The share of the way within 10 cm of what the map calls things."""
    rows, columns = np.nonzero(grid.things)
    things_m = grid.to_point(np.column_stack((rows, columns)))
    return float(np.mean([(np.abs(things_m - at_m) < 0.1).all(axis=1).any() for at_m in way_m]))


@pytest.mark.parametrize("rise", [0.0, RISE, -RISE])
def test_two_passes_at_other_heights_leave_the_way_free(rise: float) -> None:
    grid, way_m, above_m = mapped(rise)
    assert on_things(grid, way_m) == 0.0
    seen = np.array([np.nan if above is None else above for above in above_m])
    true_m = np.array([pose[2, 3] for pose in carried(CORRIDOR)])
    assert np.isfinite(seen).mean() > 0.8
    assert np.nanmax(np.abs(seen - true_m)) < 0.05


def test_without_their_own_floor_the_second_pass_stands_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """The control: the floor stays where it was seen first."""
    follow = FloorBelow.follow
    monkeypatch.setattr(FloorBelow, "follow", lambda self, *of: follow(self, *of) if not self.z_m else None)
    grid, way_m, _ = mapped(RISE)
    assert on_things(grid, way_m) > 0.05
