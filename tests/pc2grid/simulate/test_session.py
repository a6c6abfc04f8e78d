"""What the sensors see, and the recording that is made of it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pc2grid.errors import ConfigError, OutputError
from pc2grid.geometry import F64, transform_points
from pc2grid.io.trajectory import read_tum
from pc2grid.model import FREE, OCCUPIED, OccupancyGrid, Scan, SensorKind
from pc2grid.simulate import (
    Session,
    SimulationConfig,
    office_floorplan,
    prepare_session,
    simulate_session,
)
from pc2grid.simulate.config import DepthConfig, DriveConfig, LaserConfig, LidarConfig, OdometryConfig
from pc2grid.simulate.drive import RATE_HZ, Drive, odometry_of
from pc2grid.simulate.plan import clearance_m
from pc2grid.simulate.scene import covered, depth, laser, lidar
from pc2grid.simulate.session import EPOCH_NS
from tests.helpers.field import DATA
from tests.helpers.rooms import small_house

SENSORS: tuple[SensorKind, ...] = ("lidar", "laser", "depth")


def brief(**changes: Any) -> SimulationConfig:
    return SimulationConfig(**{"length_m": 3.0, "clutter": 0, "seed": 5, **changes})


def away_from_walls(session: Session, points_m: F64) -> F64:
    """Distance (N,) of each point in the obstacle band to the nearest occupied cell, metres."""
    import cv2

    grid = session.grid
    distance = cv2.distanceTransform((~grid.occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    walls = points_m[(points_m[:, 2] > 0.2) & (points_m[:, 2] < 1.8), :2]
    cell = grid.to_cell(walls)
    away: F64 = np.maximum(distance[cell[:, 0], cell[:, 1]] - 0.5, 0) * grid.resolution_m
    return away


def unmoved(session: Session, scan: Scan) -> F64:
    """Points (N, 3) in the map, each from where the robot truly was when it was taken."""
    assert scan.offsets_s is not None
    poses = session.drive.at((scan.stamp_ns - EPOCH_NS) / 1e9 + scan.offsets_s)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y, z = scan.points_m.T
    return np.column_stack((poses[:, 0] + c * x - s * y, poses[:, 1] + s * x + c * y, z))


def test_what_a_camera_sees_lies_on_the_walls_of_the_plan() -> None:
    session = prepare_session(sensor="depth", config=brief())
    away = [
        away_from_walls(session, transform_points(T_map_base.lift(), scan.points_m))
        for scan, T_map_base in session.scans()
    ]
    distances = np.concatenate(away)
    assert len(distances) > 5000
    # A cell's half diagonal and two standard deviations of the noise, which is 5.5 cm at 6 m.
    assert np.percentile(distances, 99) < 0.12


@pytest.mark.parametrize("sensor", ["lidar", "laser"])
def test_motion_distorts_a_scan_and_point_times_undo_it(sensor: SensorKind) -> None:
    quick = DriveConfig(speed_mps=0.8, yaw_rate_rps=1.0)
    exact = {"lidar": LidarConfig(noise_m=0), "laser": LaserConfig(noise_m=0)}
    session = prepare_session(sensor=sensor, config=brief(length_m=8.0, drive=quick, **exact))
    blurred, sharp = [], []
    for scan, T_map_base in session.scans():
        time_s = (scan.stamp_ns - EPOCH_NS) / 1e9
        turn = np.diff(session.drive.at(np.array([time_s, time_s + 0.1]))[:, 2])[0]
        if abs(turn) > 0.05:
            blurred.append(away_from_walls(session, transform_points(T_map_base.lift(), scan.points_m)))
            sharp.append(away_from_walls(session, unmoved(session, scan)))
    # Without noise every point is on a wall: within its cell, or on the edge of the next one.
    assert np.percentile(np.concatenate(sharp), 99.9) < 0.03
    assert np.mean(np.concatenate(blurred) > 0.05) > 0.03


@pytest.mark.parametrize("sensor", SENSORS)
def test_scan_is_as_documented(sensor: SensorKind) -> None:
    scans = list(prepare_session(sensor=sensor, config=brief(length_m=1.0)).scans())
    stamps = [scan.stamp_ns for scan, _ in scans]
    assert np.diff(stamps).tolist() == [100_000_000] * (len(scans) - 1)
    assert stamps[0] == EPOCH_NS
    scan = scans[-1][0]
    assert scan.sensor == sensor
    assert scan.T_odom_base is not None
    rays = {"lidar": 900 * 16, "laser": 541, "depth": 160 * 120}[sensor]
    assert len(scan.points_m) + scan.dropped == rays
    from_sensor = np.linalg.norm(scan.points_m - scan.T_base_sensor[:3, 3], axis=1)
    low, high, height = {"lidar": (0.4, 60, 0.7), "laser": (0.1, 25, 0.28), "depth": (0.3, 11, 0.6)}[sensor]
    assert from_sensor.min() > low - 0.01
    assert from_sensor.max() < high + 0.01
    assert scan.T_base_sensor[2, 3] == height
    if sensor == "depth":
        assert scan.offsets_s is None
        bearing = np.degrees(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0] - 0.2))
        assert np.abs(bearing).max() == pytest.approx(45, abs=1)
        assert scan.points_m[:, 0].max() < 6.3
    else:
        assert scan.offsets_s is not None
        assert 0 <= scan.offsets_s.min() < scan.offsets_s.max() < 0.1
    if sensor == "laser":
        np.testing.assert_allclose(scan.points_m[:, 2], 0.28, atol=1e-6)
    else:
        # The floor is seen at its height, nothing below it, and nothing above the ceiling.
        z = scan.points_m[:, 2]
        assert np.sum(np.abs(z) < 0.05) > 100
        assert -0.2 < z.min() < z.max() < 2.7


def test_depth_noise_grows_with_the_square_of_depth() -> None:
    config = DepthConfig(dropout=0.0, edge_dropout=0.0, max_range_m=10)
    camera = depth(config)
    rng = np.random.default_rng(0)
    for true_m in (0.5, 2.0, 5.0):
        reading = camera.measure(np.full(160 * 120, true_m, np.float32), rng)
        assert np.std(reading) == pytest.approx(0.001 + 0.0015 * true_m**2, rel=0.05)
        assert np.mean(reading) == pytest.approx(true_m, abs=0.002)
        np.testing.assert_allclose(reading * 1000, np.round(reading * 1000), atol=1e-3)


@pytest.mark.parametrize("make", [lidar, laser])
def test_range_noise_dropouts_and_limits(make: Any) -> None:
    config = LidarConfig(dropout=0.1) if make is lidar else brief().laser.model_copy(update={"dropout": 0.1})
    sensor = make(config)
    rng = np.random.default_rng(0)
    rays = len(sensor.directions)
    readings = np.concatenate([sensor.measure(np.full(rays, 5.0, np.float32), rng) for _ in range(20)])
    assert np.nanstd(readings) == pytest.approx(0.02, rel=0.05)
    assert np.nanmean(readings) == pytest.approx(5.0, abs=0.002)
    assert np.isnan(readings).mean() == pytest.approx(0.1, abs=0.02)
    for outside in (np.inf, config.max_range_m + 1, 0.0):
        assert np.isnan(sensor.measure(np.full(rays, outside, np.float32), rng)).all()


def test_sessions_differ_in_clutter_and_route_but_not_in_walls() -> None:
    one, two = (prepare_session(sensor="laser", config=brief(clutter=20, seed=seed)) for seed in (1, 2))
    assert np.array_equal(one.grid.cells, two.grid.cells)
    assert {it.pose for it in one.clutter}.isdisjoint({it.pose for it in two.clutter})
    assert not np.allclose(one.drive.poses[0], two.drive.poses[0])


def test_clutter_is_seen() -> None:
    session = prepare_session(sensor="lidar", config=brief(clutter=120))
    away = [away_from_walls(session, unmoved(session, scan)) for scan, _ in session.scans()]
    assert np.mean(np.concatenate(away) > 0.2) > 0.005


# --- recordings ---------------------------------------------------------------------------------------


def messages(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, log time and message, read by the reference decoder."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [(channel.topic, m.log_time, ros) for _, channel, m, ros in reader.iter_decoded_messages()]


@pytest.mark.parametrize("sensor", SENSORS)
def test_recording_holds_what_the_sensor_measured(tmp_path: Path, sensor: SensorKind) -> None:
    config = brief(length_m=1.0)
    shares: list[float] = []
    made = simulate_session(tmp_path / "out.mcap", sensor=sensor, config=config, progress=shares.append)
    session = prepare_session(sensor=sensor, config=config)
    readings = list(session.readings())
    assert made.scans == len(readings) == len(shares)
    assert shares[-1] == 1.0
    log = messages(made.path)
    topic = {"lidar": "/points", "laser": "/scan", "depth": "/camera/depth/image_rect_raw"}[sensor]
    recorded = [message for name, _, message in log if name == topic]
    assert len(recorded) == len(readings)
    for message, reading in zip(recorded, readings, strict=True):
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == reading.stamp_ns
        values = reading.values_m
        if sensor == "laser":
            np.testing.assert_array_equal(message.ranges, np.where(np.isnan(values), np.inf, values))
            assert message.angle_max - message.angle_min == pytest.approx(np.radians(270))
            assert message.time_increment * 720 == pytest.approx(0.1)
        elif sensor == "depth":
            image = np.frombuffer(bytes(message.data), "<u2")
            np.testing.assert_allclose(image / 1000, np.nan_to_num(values), atol=1e-6)
        else:
            cloud = np.frombuffer(bytes(message.data), "<f4").reshape(-1, 4)
            kept = np.isfinite(values)
            np.testing.assert_allclose(
                cloud[:, :3], values[kept, None] * session.sensor.directions[kept], atol=1e-5
            )
            np.testing.assert_allclose(cloud[:, 3], session.sensor.offsets_s[kept], atol=1e-7)
    static = [message for name, _, message in log if name == "/tf_static"]
    assert static[0].transforms[0].child_frame_id == recorded[0].header.frame_id
    odometry = [time for name, time, _ in log if name == "/odom"]
    assert np.allclose(np.diff(odometry), 20_000_000)
    assert odometry[0] <= readings[0].stamp_ns
    assert odometry[-1] >= readings[-1].stamp_ns
    truth = read_tum(made.truth_path)
    assert truth.stamps_ns.tolist() == [reading.stamp_ns for reading in readings]
    true = session.drive.at(np.array([reading.time_s for reading in readings]))
    np.testing.assert_allclose(truth.planar()[:, :2], true[:, :2], atol=1e-8)
    np.testing.assert_allclose(np.cos(truth.planar()[:, 2] - true[:, 2]), 1, atol=1e-8)


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    config = brief(length_m=1.0)
    (tmp_path / "out.tum").write_text("mine")
    with pytest.raises(OutputError, match="exists"):
        simulate_session(tmp_path / "out.mcap", sensor="laser", config=config)
    assert [path.name for path in tmp_path.iterdir()] == ["out.tum"]
    made = simulate_session(tmp_path / "out.mcap", sensor="laser", config=config, overwrite=True)
    assert len(read_tum(made.truth_path)) == made.scans


def test_command_line(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from pc2grid.io.maps import save_map
    from pc2grid_cli.main import app

    yaml, _ = save_map(small_house(), tmp_path / "house")
    out = tmp_path / "out.mcap"
    options = ["--sensor", "laser", "--length", "2", "--clutter", "2", "--start", "1.5", "0.5", "--seed", "4"]
    ran = CliRunner().invoke(app, ["simulate", str(yaml), str(out), *options, "--no-odometry"])
    assert ran.exit_code == 0, ran.output
    assert "laser scans, 2.0 m" in ran.output
    x, y, _ = read_tum(tmp_path / "out.tum").planar()[0]
    assert np.hypot(x - 1.5, y - 0.5) < 0.1
    assert {name for name, _, _ in messages(out)} == {"/scan", "/tf_static"}
    ran = CliRunner().invoke(app, ["simulate", str(yaml), str(out), *options])
    assert isinstance(ran.exception, OutputError)
    assert CliRunner().invoke(app, ["simulate", "out.txt", *options]).exit_code == 2
    assert CliRunner().invoke(app, ["simulate", "a.yaml", "b.yaml", "c.mcap", *options]).exit_code == 2
    assert CliRunner().invoke(app, ["simulate", str(out)]).exit_code == 2


@pytest.mark.skipif(not (DATA / "maps").is_dir(), reason="no real maps: set PC2GRID_DATA")
@pytest.mark.parametrize("name", ["fr079", "aces"])
def test_real_floor_plans_can_be_driven_through(name: str) -> None:
    from pc2grid.io.maps import load_map

    grid = load_map(DATA / "maps" / f"{name}.yaml")
    session = prepare_session(sensor="laser", grid=grid, config=brief(length_m=40.0, clutter=30))
    assert session.drive.length_m == pytest.approx(40, rel=0.02)
    cell = grid.to_cell(session.drive.poses[:, :2])
    assert grid.free[cell[:, 0], cell[:, 1]].all()
    assert len(session.clutter) == 30
    scan, _ = next(session.scans())
    assert len(scan.points_m) > 100
    assert away_from_walls(session, unmoved(session, scan)).mean() < 0.3


# --- Routes, drives and odometry ---


def room(*free: tuple[float, float, float, float], size_m: float = 12.0) -> OccupancyGrid:
    """Solid, with rectangles x0, y0, x1, y1 in metres taken out."""
    cells = np.full((round(size_m / 0.05), round(size_m / 0.05)), OCCUPIED, np.int8)
    for x0, y0, x1, y1 in free:
        cells[round(y0 / 0.05) : round(y1 / 0.05), round(x0 / 0.05) : round(x1 / 0.05)] = FREE
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))


@pytest.mark.parametrize("seed", range(2))
def test_drive_keeps_its_distance_speed_and_length(seed: int) -> None:
    session = prepare_session(
        sensor="laser", config=SimulationConfig(length_m=60, seed=seed, building_seed=seed, clutter=60)
    )
    drive, limits = session.drive, session.config.drive
    free = session.grid.free & ~covered(session.grid, session.clutter)
    cell = session.grid.to_cell(drive.poses[:, :2])
    room_m = clearance_m(free, session.grid.resolution_m)[cell[:, 0], cell[:, 1]]
    assert room_m.min() > limits.clearance_m - 0.05
    assert drive.length_m == pytest.approx(60, rel=0.01)
    velocity = np.diff(drive.poses, axis=0) * RATE_HZ
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    assert speed.max() < limits.speed_mps + 0.01
    assert np.abs(velocity[:, 2]).max() < limits.yaw_rate_rps + 0.01
    assert np.abs(np.diff(speed)).max() * RATE_HZ < 1.5
    # It looks where it goes.
    fast = speed > 0.3
    sideways = -np.sin(drive.poses[:-1, 2]) * velocity[:, 0] + np.cos(drive.poses[:-1, 2]) * velocity[:, 1]
    assert np.abs(sideways[fast]).max() < 0.15


def test_drive_closes_the_loop_of_a_ring() -> None:
    ring = room((1, 1, 11, 11))
    cells = ring.cells.copy()
    cells[60:180, 60:180] = OCCUPIED
    ring = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    config = SimulationConfig(length_m=45, clutter=0, start_m=(2.0, 2.0))
    drive = prepare_session(sensor="laser", grid=ring, config=config).drive
    away = np.linalg.norm(drive.poses[:, :2] - drive.poses[0, :2], axis=1)
    left = int(np.argmax(away > 5))
    assert away[left:].min() < 2.0


def test_start_is_where_it_was_asked_for() -> None:
    grid = office_floorplan(0)
    free = np.argwhere(clearance_m(grid.free, 0.05) > 0.6)
    x, y = grid.to_point(free[[len(free) // 2]])[0]
    for seed in (0, 1):
        config = SimulationConfig(length_m=5, seed=seed, start_m=(float(x), float(y)))
        session = prepare_session(sensor="laser", grid=grid, config=config)
        assert np.linalg.norm(session.drive.poses[0, :2] - (x, y)) < 0.1


def test_impossible_drives_say_why() -> None:
    small = room((5, 5, 5.5, 5.5))
    with pytest.raises(ConfigError, match=r"wide"):
        prepare_session(sensor="laser", grid=small, config=SimulationConfig(clutter=0))
    large = room((1, 1, 11, 5))
    with pytest.raises(ConfigError, match=r"m from where a robot fits .*nearest"):
        prepare_session(sensor="laser", grid=large, config=SimulationConfig(start_m=(6.0, 9.0)))
    solid = OccupancyGrid(cells=np.full((50, 50), 100, np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    with pytest.raises(ConfigError):
        prepare_session(sensor="lidar", grid=solid)


def test_pauses_and_drive_settings_are_followed() -> None:
    slow = SimulationConfig(length_m=10, clutter=0, drive=DriveConfig(speed_mps=0.2))
    fast = SimulationConfig(length_m=10, clutter=0, drive=DriveConfig(speed_mps=0.8, pause_every_m=1000))
    slow_s = prepare_session(sensor="laser", config=slow).drive.duration_s
    assert slow_s > 2 * prepare_session(sensor="laser", config=fast).drive.duration_s


# --- odometry -----------------------------------------------------------------------------------------


def laps(count: int) -> Drive:
    """Standing for 5 s, then a square of 5 m with round corners, again and again."""
    side = np.column_stack((np.full(1000, 0.005), np.zeros(1000)))
    corner = np.column_stack((np.full(200, 0.002), np.full(200, math.pi / 2 / 200)))
    steps = np.concatenate([np.zeros((500, 2)), *([side, corner] * (4 * count))])
    yaw = np.cumsum(steps[:, 1])
    x, y = np.cumsum(steps[:, 0] * np.cos(yaw)), np.cumsum(steps[:, 0] * np.sin(yaw))
    return Drive(np.column_stack((x, y, yaw)))


def test_odometry_drifts_as_configured() -> None:
    drive = laps(2)
    turned = drive.poses[-1, 2]
    length = drive.length_m
    quarter, full, distance = [], [], []
    for seed in range(60):
        odometry = odometry_of(drive, OdometryConfig(), np.random.default_rng(seed))
        error = odometry.poses[:, 2] - drive.at(odometry.times_s)[:, 2]
        full.append(error[-1])
        quarter.append(error[len(error) // 4])
        distance.append(np.linalg.norm(np.diff(odometry.poses[:, :2], axis=0), axis=1).sum() / length - 1)
        standing = odometry.poses[odometry.times_s < 4.5]
        np.testing.assert_allclose(standing, 0, atol=1e-12)
    # Errors of 3 % that last half a second, in turns of 2 s: well below 3 % of the sum, well above none.
    assert 0.005 < np.std(full) / turned < 0.03
    assert np.std(full) > 1.3 * np.std(quarter)
    assert 0.002 < np.std(distance) < 0.02
    assert abs(np.mean(full)) / turned < 0.01
