"""Routes, drives and odometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pc2grid.errors import ConfigError
from pc2grid.model import FREE, OCCUPIED, OccupancyGrid
from pc2grid.simulate import SimulationConfig, office_floorplan, prepare_session
from pc2grid.simulate.config import DriveConfig, OdometryConfig
from pc2grid.simulate.drive import RATE_HZ, Drive, odometry_of
from pc2grid.simulate.plan import clearance_m
from pc2grid.simulate.scene import covered


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
