"""A robot drives up a ramp: the rising floor in front of it is not a wall."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np
import pytest

from pc2grid.arrays import F64
from pc2grid.clouds.ground import Ground
from pc2grid.config import RegistrationConfig
from pc2grid.estimation.floor_ahead import FloorAhead
from pc2grid.estimation.tracker import Tracker
from pc2grid.geometry import SE2
from pc2grid.model import Scan
from pc2grid.pipeline import map_scans
from pc2grid.simulate.scene import Mesh, Scene, prism, quads
from signature.config import Config

LENGTH_M, HALF_WIDTH_M, CEILING_M, RISE_M = 20.0, 1.5, 2.6, 0.5
PROFILE_M = np.array([(0.0, 0.0), (6.0, 0.0), (12.0, RISE_M), (LENGTH_M, RISE_M)])
"""Of the floor, x and z: 1 in 12, the steepest that building codes allow wheelchairs."""


def tunnel(profile_m: F64, half_width_m: float, height_m: float) -> Mesh:
    """Floor, ceiling and walls along a profile (N, 2) of the floor, x and z."""
    y, h, faces = half_width_m, height_m, []
    for (x0, z0), (x1, z1) in itertools.pairwise(profile_m):
        faces += [[(x0, -y, z0 + up), (x1, -y, z1 + up), (x1, y, z1 + up), (x0, y, z0 + up)] for up in (0, h)]
        faces += [[(x0, s, z0), (x1, s, z1), (x1, s, z1 + h), (x0, s, z0 + h)] for s in (-y, y)]
    faces += [
        [(x, -y, z), (x, y, z), (x, y, z + h), (x, -y, z + h)] for x, z in (profile_m[0], profile_m[-1])
    ]
    return quads(np.array(faces))


def standing_at(x: float, profile_m: F64) -> F64:
    """T_world_base (4, 4) of a robot that stands on its wheels, 0.25 m before and behind its middle."""
    low, high = (float(np.interp(at, *profile_m.T)) for at in (x - 0.25, x + 0.25))
    pitch = math.atan2(high - low, 0.5)
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([(c, 0, -s, x), (0, 1, 0, 0), (s, 0, c, (low + high) / 2), (0, 0, 0, 1)])


def seen(scene: Scene, T_world_sensor: F64, rays: F64) -> F64:
    """Lengths (N,) of rays (N, 3) of the sensor frame up to the scene, as multiples of theirs."""
    lines = np.concatenate(
        (np.tile(T_world_sensor[:3, 3], (len(rays), 1)), rays @ T_world_sensor[:3, :3].T), axis=1
    )
    return scene.cast(lines.astype(np.float32)).astype(np.float64)


def corridor() -> Scene:
    pillars = [
        prism(np.array([(x, s * 1.1), (x + 0.4, s * 1.1), (x + 0.4, s * 1.5), (x, s * 1.5)]), -0.5, 3.5)
        for x, s in ((3, -1), (5, 1), (8, -1), (10.5, 1), (13, -1), (16, 1))
    ]
    return Scene(Mesh.join([tunnel(PROFILE_M, HALF_WIDTH_M, CEILING_M), *pillars]))


def drive() -> Iterator[Scan]:
    """Scans of a lidar 0.5 m above the wheels."""
    scene, rng = corridor(), np.random.default_rng(0)
    bearing, up = np.meshgrid(np.radians(np.arange(-180, 180, 2.0)), np.radians(np.linspace(-15, 15, 16)))
    beams = np.stack((np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)), axis=-1)
    beams = beams.reshape(-1, 3)
    mount = np.eye(4)
    mount[2, 3] = 0.5
    for k, x in enumerate(np.arange(1.0, 17.0, 0.25)):
        ranges = seen(scene, standing_at(float(x), PROFILE_M) @ mount, beams)
        points = beams * (ranges + rng.normal(0, 0.01, len(beams)))[:, None]
        yield Scan(
            stamp_ns=int(k * 2e8),
            points_m=points[np.isfinite(ranges)].astype(np.float32),
            T_base_sensor=mount,
            sensor="lidar",
        )


def test_a_ramp_that_was_driven_up_is_free() -> None:
    grid, trajectory, _ = map_scans(drive(), Config())
    assert np.abs(trajectory.planar()[-1] - (15.75, 0.0, 0.0)).max() < 0.1
    cells = np.argwhere(grid.cells >= 0)
    x, y = grid.to_point(cells).T
    x = x + 1.0  # the map begins where the robot stood first
    inside = (np.abs(y) < 1.0) & (x > 0.2) & (x < LENGTH_M - 0.2)
    assert inside.sum() > 0.95 * (2.0 * (LENGTH_M - 0.4)) / grid.resolution_m**2
    assert grid.free[tuple(cells[inside].T)].mean() > 0.995
    assert not grid.occupied[tuple(cells[inside].T)].any()


SHAFT_M = np.array([(0.0, 0.0), (6.0, 0.0), (16.0, 10.0 * math.tan(math.radians(7.6))), (20.0, 1.334)])
"""Of the floor of a shaft 1.35 m wide, x and z, in which a camera sees nothing but two smooth walls."""


SLOPE_END_M = 6.0 + 3.0 / math.tan(math.radians(7.6))
TO_ANOTHER_FLOOR_M = np.array([(0.0, 0.0), (6.0, 0.0), (SLOPE_END_M, 3.0), (SLOPE_END_M + 9.0, 3.0)])
"""The same shaft, as long as a ramp to the next floor, and 9 m behind it."""


def camera_drive(
    profile_m: F64 = SHAFT_M, end_m: float = 15.0, step_m: float = 0.06
) -> Iterator[tuple[float, Scan]]:
    """Scans of a camera 0.6 m above the wheels, each with the distance that these have travelled."""
    scene, rng = Scene(tunnel(profile_m, 0.675, 2.6)), np.random.default_rng(0)
    across, up = np.meshgrid(np.tan(np.radians(np.linspace(-44, 44, 60))), np.linspace(-0.57, 0.57, 120))
    rays = np.stack((np.ones_like(across), across, up), axis=-1).reshape(-1, 3)
    mount = np.eye(4)
    mount[:3, 3] = 0.2, 0.0, 0.6
    travel_m, before = 0.0, standing_at(1.0, profile_m)
    for k, x in enumerate(np.arange(1.0, end_m, step_m)):
        here = standing_at(float(x), profile_m)
        travel_m += float(np.linalg.norm((here - before)[:3, 3]))
        before = here
        depth = seen(scene, here @ mount, rays)
        depth += 0.0015 * depth**2 * rng.standard_normal(len(depth))
        points = mount[:3, 3] + rays * depth[:, None]
        yield (
            travel_m,
            Scan(
                stamp_ns=int(k * 1e8),
                points_m=points[depth < 6.0].astype(np.float32),
                T_base_sensor=mount,
                sensor="depth",
                T_odom_base=SE2(travel_m, 0.0, 0.0).lift(),
            ),
        )


def test_a_camera_does_not_stand_still_on_a_ramp_between_smooth_walls() -> None:
    tracker = Tracker(RegistrationConfig())
    for travel_m, scan in camera_drive():
        at_m = tracker.track(scan).registered.T_session_base[0, 3]
        assert abs(at_m - travel_m) < 0.01 * travel_m + 0.05


def test_a_ramp_between_smooth_walls_leads_a_camera_to_another_floor() -> None:
    """Its walls do not show the vertical: the pitch is that of the floor that was seen ahead before.

    Where a slope begins and ends is known to 1 m of travel, which is 0.13 m of height at both ends: the
    storey is 0.25 m too low.
    """
    tracker, arrived_m = Tracker(RegistrationConfig()), []
    for travel_m, scan in camera_drive(TO_ANOTHER_FLOOR_M, SLOPE_END_M + 7.0, step_m=0.12):
        tracked = tracker.track(scan)
        arrived_m += [travel_m] if tracked.arrived else []
    assert len(arrived_m) == 1
    first, second = tracker.storeys
    assert first.group == second.group
    assert second.height_m - first.height_m == pytest.approx(3.0, abs=0.4)


def test_the_pitch_follows_the_floor_that_was_seen_ahead() -> None:
    ground = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
    ahead, before_m, errors_rad = FloorAhead(), 0.0, []
    for travel_m, scan in camera_drive():
        ahead.move(travel_m - before_m, 0.0)
        before_m = travel_m
        pitch_rad = ahead.pitch_rad
        if pitch_rad is not None and 4.0 < travel_m < 13.0:
            true_rad = math.radians(7.6) if travel_m > 5.3 else 0.0
            if abs(travel_m - 5.0) > 0.8:  # the bend, over which a measurement takes the mean
                errors_rad.append(pitch_rad - true_rad)
        ahead.look(scan.points_m, ground, pitch_rad or 0.0)
    assert len(errors_rad) > 100
    assert np.abs(errors_rad).max() < math.radians(1.5)


def test_a_floor_that_the_robot_turned_away_from_says_nothing() -> None:
    ground = Ground(np.array([0.0, 0.0, 1.0]), 0.0)
    ahead = FloorAhead()
    x, y = (at.ravel() for at in np.meshgrid(np.arange(1.0, 3.0, 0.05), np.arange(-0.4, 0.4, 0.05)))
    points_m = np.column_stack((x, y, np.zeros_like(x))).astype(np.float32)
    for _ in range(30):
        ahead.move(0.1, 0.0)
        ahead.look(points_m, ground, 0.0)
    assert ahead.pitch_rad == pytest.approx(0.0, abs=1e-6)
    ahead.move(0.0, math.radians(30.0))
    assert ahead.pitch_rad is None
