"""Floors of a house that are reached by stairs, ramps or a lift are told apart."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.clouds.upright import CAMERA_UPRIGHT, vertical_of
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.estimation.rides import RIDES, RideWatch
from pc2grid.estimation.tracker import Tracker
from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.mapping.floors import floor_heights, floor_names
from pc2grid.model import Scan, SensorKind, Storey
from pc2grid.simulate import SimulationConfig
from pc2grid.simulate.config import DepthConfig, LidarConfig
from pc2grid_lab.worlds import HouseConfig, HouseSession, prepare_house_session

UP = np.array([0.0, 0.0, 1.0])
DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[3] / ".." / "shared" / "data"))


def room(tilt_rad: float, *, rng: np.random.Generator) -> np.ndarray:
    """What a lidar sees in a room of 6 x 4 m, in the frame of a base that is pitched up."""
    bearing, up = np.meshgrid(np.radians(np.arange(-180, 180, 1.0)), np.radians(np.linspace(-15, 15, 16)))
    beams = np.stack((np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)), axis=-1)
    beams = beams.reshape(-1, 3)
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    level = beams @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)]).T
    with np.errstate(divide="ignore"):
        away_m = np.minimum(3.0 / np.abs(level[:, 0]), 2.0 / np.abs(level[:, 1]))
    return beams * (away_m + rng.normal(0.0, 0.02, len(beams)))[:, None]


@pytest.mark.parametrize("tilt_deg", [-20.0, -4.8, 0.0, 4.8, 30.0])
def test_walls_show_the_tilt_of_the_base(tilt_deg: float) -> None:
    points = room(math.radians(tilt_deg), rng=np.random.default_rng(1))
    vertical = vertical_of(points, (UP,))
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(tilt_deg, abs=0.7)
    assert abs(math.degrees(math.asin(vertical[1]))) < 0.7


def test_a_single_wall_does_not_show_it() -> None:
    y, z = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(0, 2, 20))
    assert vertical_of(np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel())), (UP,)) is None


def test_a_camera_sees_the_pitch_by_a_single_wall_ahead() -> None:
    rng = np.random.default_rng(1)
    pitch = math.radians(20.0)
    y, z = np.meshgrid(np.linspace(-1.5, 1.5, 80), np.linspace(-0.5, 1.5, 60))
    wall = np.column_stack((np.full(y.size, 2.0), y.ravel(), z.ravel())) + rng.normal(0, 0.005, (y.size, 3))
    c, s = math.cos(pitch), math.sin(pitch)
    points = wall @ np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)])
    assert vertical_of(points, (UP,)) is None
    vertical = vertical_of(points, (UP,), CAMERA_UPRIGHT)
    assert vertical is not None
    assert math.degrees(math.asin(vertical[0])) == pytest.approx(20.0, abs=0.5)
    beside = points[:, [1, 0, 2]] * (1.0, -1.0, 1.0)  # a wall along the way shows no pitch
    assert vertical_of(beside, (UP,), CAMERA_UPRIGHT) is None


def house(sensor: SensorKind = "lidar", **settings: object) -> HouseSession:
    config = SimulationConfig(
        length_m=4.0,
        seed=3,
        building_seed=2,
        clutter=10,
        lidar=LidarConfig(columns=450, rate_hz=5.0),
        depth=DepthConfig(rate_hz=3.0),
    )
    return prepare_house_session(sensor=sensor, house=HouseConfig.model_validate(settings), config=config)


@pytest.mark.parametrize(
    ("sensor", "settings"),
    [("lidar", {"ride": "stairs"}), ("depth", {"ride": "stairs"}), ("lidar", {"ride": "lift"})],
    ids=["stairs", "stairs by camera", "lift"],
)
def test_a_ride_leads_to_another_floor(sensor: SensorKind, settings: dict[str, object]) -> None:
    session = house(sensor, visits=(0, 1), **settings)
    tracker = Tracker(RegistrationConfig(), ProjectionConfig())
    arrived, told, true = [], [], []
    for reading in session.readings():
        tracked = tracker.track(session.scan(reading))
        if tracked.arrived:
            arrived.append(reading.index)
            assert tracked.restart
        if tracked.riding:
            assert not tracked.keyframe
        else:
            told.append(tracked.storey)
            true.append(session.floor_at(reading.time_s))
    assert len(arrived) == 1
    # A door that opens is noticed when it has opened, so a shut cabin still counts to the floor below.
    wrong = [k for k, (a, b) in enumerate(zip(told, true, strict=True)) if a != b]
    assert len(wrong) <= 20
    first, second = tracker.storeys
    if settings["ride"] == "lift":
        assert (first.group, second.group) == (0, 1)
    else:
        assert not wrong
        assert second.height_m == pytest.approx(3.0, abs=0.25)


def test_a_house_is_as_it_is_asked_for() -> None:
    session = house(visits=(0, 1, 0), slope=0.6)
    heights = np.array([session.pose(k / 5.0)[2, 3] for k in range(session.scan_count)])
    assert heights.max() == pytest.approx(3.0)
    assert heights[0] == heights[-1] == pytest.approx(0.0)
    floors = [session.floor_at(k / 5.0) for k in range(session.scan_count)]
    assert [a for a, b in zip(floors, [None, *floors], strict=False) if a != b] == [0, 1, 0]


def cabin_scan(seconds: float, *, shut: bool) -> PlanarScan:
    """A square of 2 m around the sensor; with its door open, 8 m can be seen through it."""
    bearing = np.arange(1440) * (2.0 * math.pi / 1440)
    away_m = 1.0 / np.maximum(np.abs(np.cos(bearing)), np.abs(np.sin(bearing)))
    if not shut:
        away_m[np.abs(np.angle(np.exp(1j * bearing))) < math.radians(30.0)] = 8.0
    hits = (away_m[:, None] * np.column_stack((np.cos(bearing), np.sin(bearing)))).astype(np.float32)
    return PlanarScan.of_hits(
        stamp_ns=int(seconds * 1e9), hits_m=hits, origin_m=np.zeros(2), free_m=away_m.astype(np.float32)
    )


def rides(plan: list[tuple[float, bool]], *, drift_m: float = 0.0, since_s: float = 0.0) -> list[float]:
    """The times at which a robot that stands still arrives somewhere else. plan : until when the door is
    shut or open. drift_m : metres that it moves a second, after `since_s`."""
    watch = RideWatch()
    scan = Scan(stamp_ns=0, points_m=np.zeros((0, 3), np.float32), T_base_sensor=np.eye(4), sensor="laser")
    arrived, seconds, x = [], 0.0, 0.0
    for until_s, shut in plan:
        while seconds < until_s:
            forward_m = drift_m * max(seconds - since_s, 0.0) - x
            x += forward_m
            # The pose jumps to and fro, as the shut door is taken for a wall that was seen before.
            pose = SE2(x + 0.3 * shut, 0.0, 0.0).lift()
            seen = cabin_scan(seconds, shut=shut)
            if watch.observe(scan, scan.points_m, seen, pose, forward_m, None).arrived:
                arrived.append(seconds)
            seconds += 0.2
    return arrived


def test_a_lift_is_a_cabin_whose_door_shuts_and_opens() -> None:
    assert rides([(3.0, False), (9.0, True), (12.0, False)]) == pytest.approx([9.0], abs=0.3)
    assert not rides([(3.0, False), (3.0 + RIDES.shut_s / 2, True), (12.0, False)])  # a person in the door
    assert not rides([(12.0, False)])
    assert not rides([(3.0, False), (12.0, True)])  # it has not opened yet
    assert not rides([(3.0, False), (9.0, True), (12.0, False)], drift_m=0.2)
    # A robot that has turned in a dead end sees out of it again when it drives.
    assert not rides([(3.0, False), (9.0, True), (12.0, False)], drift_m=0.8, since_s=8.8)


@pytest.mark.skipif(not DATA.is_dir(), reason="PC2GRID_DATA is not there")
def test_the_end_of_a_real_hall_is_no_lift() -> None:
    """A robot stands there for 7 s, with all walls near, until somebody opens the door ahead."""
    tracker = Tracker(RegistrationConfig(), ProjectionConfig())
    with open_log(DATA / "laser" / "killian.mcap") as log:
        scans = [tracker.track(scan) for scan in log.scans(1465.0, 20.0)]
    assert len(scans) > 150
    assert len(tracker.storeys) == 1


def test_level_ground_with_a_tilted_sensor_is_no_slope() -> None:
    """A mounting that is wrong by 5 degrees tilts the floor, too."""
    rng = np.random.default_rng(0)
    watch = RideWatch()
    tilt = math.radians(5.0)
    ground = Ground(np.array([math.sin(tilt), 0.0, math.cos(tilt)]), 0.5)
    scan = Scan(stamp_ns=0, points_m=np.zeros((0, 3), np.float32), T_base_sensor=np.eye(4), sensor="lidar")
    for k in range(30):
        ride = watch.observe(
            replace(scan, stamp_ns=k),
            room(tilt, rng=rng).astype(np.float32),
            cabin_scan(float(k), shut=False),
            SE2(0.2 * k, 0.0, 0.0).lift(),
            0.2,
            ground,
        )
        assert not ride.riding and not ride.arrived


def test_floors_are_named_by_height() -> None:
    storeys = [Storey(group=0, height_m=h) for h in (0.0, 3.1, -2.9)]
    assert floor_names(storeys, [0, 1, 2, 0]) == ["1", "2", "0", "1"]
    assert floor_names(storeys[:1], [0]) == [None]
    lift = [*storeys[:2], Storey(group=1, height_m=0.0), Storey(group=1, height_m=-3.0)]
    assert floor_names(lift, [0, 1, 2, 3]) == ["0", "1", "lift 1, floor 1", "lift 1, floor 0"]
    assert floor_heights(storeys, [0, 2]) == pytest.approx([2.9, 0.0])
    assert floor_heights(lift, [0, 1, 2, 3]) == [0.0, 3.1, None, None]
    assert floor_heights(storeys[:1], [0]) == [None]
