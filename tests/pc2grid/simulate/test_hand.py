"""A camera in the hand: what it sees from where it is, and what its images lack."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pc2grid.geometry import invert_pose, motion_size, transform_points
from pc2grid.io import open_log
from pc2grid.model import OccupancyGrid
from pc2grid.simulate import SimulationConfig, carried_camera, prepare_session, simulate_session
from pc2grid.simulate.config import HandConfig, ImuConfig, OdometryConfig
from pc2grid.simulate.session import Session

WALL_M = 2.5


def room() -> OccupancyGrid:
    """6 x 5 m within walls of 0.2 m; the corner of the free floor is (0, 0)."""
    cells = np.zeros((54, 64), np.int8)
    cells[:2] = cells[-2:] = cells[:, :2] = cells[:, -2:] = 100
    return OccupancyGrid(
        cells=np.kron(cells, np.ones((2, 2), np.int8)), resolution_m=0.05, origin_m=(-0.2, -0.2)
    )


def session(**depth: float) -> Session:
    """Two metres in the room, at 3 Hz. depth : settings of the camera; no noise unless given."""
    config = carried_camera(SimulationConfig(length_m=2.0, clutter=0, seed=4), rate_hz=3.0)
    quiet = {
        "noise_m": 0.0,
        "noise_per_m": 0.0,
        "dropout": 0.0,
        "edge_dropout": 0.0,
        "holes": 0.0,
        "flying": 0.0,
    }
    camera = config.depth.model_copy(update={**quiet, **depth})
    return prepare_session(sensor="depth", grid=room(), config=config.model_copy(update={"depth": camera}))


def off_surface_m(points_m: np.ndarray) -> np.ndarray:
    """Distance of points (N, 3) from the nearest of walls, floor and ceiling of the room."""
    x, y, z = points_m.T
    return np.minimum.reduce(
        [np.abs(x), np.abs(x - 6.0), np.abs(y), np.abs(y - 5.0), np.abs(z), np.abs(z - WALL_M)]
    )


def test_what_it_sees_lies_on_the_surfaces_of_the_room_at_its_true_pose() -> None:
    drive = session()
    for reading in drive.readings():
        points_m = transform_points(drive.pose(reading.time_s), drive.scan(reading).points_m)
        assert len(points_m) > 1000
        assert off_surface_m(points_m).max() < 0.005  # depths are in whole millimetres


def test_its_odometry_is_of_six_degrees_of_freedom() -> None:
    drive = session()
    assert drive.odometry is not None
    reading = list(drive.readings())[-1]
    T_odom_base = drive.scan(reading).T_odom_base
    assert T_odom_base is not None
    true = drive.pose(reading.time_s)
    assert np.allclose(T_odom_base[2], true[2])  # height and tilt are those of the hand
    assert np.linalg.norm(np.linalg.inv(drive.pose(0.0))[:3] @ true[:, 3]) > 0.1


def test_a_lidar_in_the_hand_sweeps_while_the_hand_moves() -> None:
    """Each column is cast from where the hand is then: put back with the true motion, walls are straight."""
    config = carried_camera(SimulationConfig(length_m=2.0, clutter=0, seed=4))
    lidar = config.lidar.model_copy(update={"noise_m": 0.0, "columns": 90, "mount_m": (0.0, 0.0, 0.0)})
    made = prepare_session(sensor="lidar", grid=room(), config=config.model_copy(update={"lidar": lidar}))
    straight, skewed = [], []
    for reading in made.readings():
        scan, begin = made.scan(reading), made.pose(reading.time_s)
        assert scan.offsets_s is not None
        for points, of, put in ((scan.points_m, scan.offsets_s, straight), (scan.points_m, None, skewed)):
            if of is None:
                put.append(off_surface_m(transform_points(begin, points)))
                continue
            for time_s in np.unique(of):
                T = made.pose(reading.time_s + float(time_s))
                put.append(off_surface_m(transform_points(T, points[of == time_s])))
    assert np.concatenate(straight).max() < 0.01
    assert np.concatenate(skewed).max() > 0.05


def test_a_recording_of_an_imu_says_what_is_up(tmp_path: Path) -> None:
    """Somebody who begins to walk errs by some degrees."""
    config = carried_camera(SimulationConfig(length_m=2.0, clutter=0, seed=4), rate_hz=3.0)
    changed = {"imu": ImuConfig(enabled=True), "odometry": OdometryConfig(enabled=False)}
    config = config.model_copy(update=changed)
    made = prepare_session(sensor="depth", grid=room(), config=config)
    simulate_session(tmp_path / "a.mcap", sensor="depth", grid=room(), config=config)
    with open_log(tmp_path / "a.mcap") as log:
        assert log.choose().imu_topic == "/imu/data_raw"
        for k, scan in enumerate(log.scans()):
            assert scan.T_level_base is not None
            cosine = float(scan.T_level_base[2, :3] @ made.pose(k / 3.0)[2, :3])
            # 0.5 m/s2 for a second are 3 degrees, the bias of 0.1 m/s2 0.6 in one axis.
            assert np.degrees(np.arccos(min(cosine, 1.0))) < 4.0


def test_the_turn_while_a_lidar_sweeps_is_read_from_the_imu(tmp_path: Path) -> None:
    """Steps turn it by up to 6 degrees in a sweep; the IMU errs by its bias of 0.3 degrees a second."""
    hand = HandConfig(carried=True, pitch_deg=0.0, pitch_sway_deg=15.0, periods_s=(0.5, 1.0))
    config = SimulationConfig(length_m=2.0, clutter=0, seed=4, hand=hand)
    small = config.lidar.model_copy(update={"columns": 45, "mount_m": (0.0, 0.0, 0.0)})
    quiet = {"lidar": small, "imu": ImuConfig(enabled=True), "odometry": OdometryConfig(enabled=False)}
    config = config.model_copy(update=quiet)
    made = prepare_session(sensor="lidar", grid=room(), config=config)
    simulate_session(tmp_path / "a.mcap", sensor="lidar", grid=room(), config=config)
    turns = []
    with open_log(tmp_path / "a.mcap") as log:
        for k, scan in enumerate(log.scans()):
            assert scan.offsets_s is not None
            assert scan.T_first_last is not None
            times_s = 0.1 * k + float(scan.offsets_s.min()), 0.1 * k + float(scan.offsets_s.max())
            first, last = (made.pose(time_s) for time_s in times_s)
            true = invert_pose(first) @ last
            turns.append(motion_size(true)[1])
            assert motion_size(invert_pose(scan.T_first_last) @ true)[1] < np.radians(0.6)
    assert max(turns) > np.radians(4.0)
