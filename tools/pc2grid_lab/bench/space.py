"""How exact poses with six degrees of freedom are, and how exact the truth is that they are compared with."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, islice, product
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.clouds.voxel_cloud import VoxelCloud
from pc2grid.geometry import SE2, invert_pose, rotation_vector, transform_points
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.matching.icp_in_space import SpatialView, register_in_space
from pc2grid.model import PointMap, Scan, SensorKind
from pc2grid.pipeline import follow
from pc2grid.simulate import SimulationConfig, iter_session, office_floorplan, simulate_session
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Row
from pc2grid_lab.experiments.plan_drives import MAP_SEED
from pc2grid_lab.experiments.sensor_matrix import query_start
from signature.config import Config
from signature.database import open_database
from signature.localization.in_space import masses_in_space
from signature.localization.localizer import locate
from signature.localization.query import QueryInSpace
from signature.sessions import add_sessions, build_session

VOXEL_M = 0.05
_NEAR_M = 4.0
"""The frame of the map at a place is that of its path so far around it."""
_HALL_MAP = 22  # the scans of the hall, of 36, that its map is made of
_HALL_RANGE_M = 20.0


@dataclass(frozen=True, slots=True)
class _Error:
    """Metres and degrees between two poses."""

    metres: float
    degrees: float

    @staticmethod
    def of(T_true: F64, T_found: F64) -> _Error:
        """The error of a pose (4, 4)."""
        error = invert_pose(T_true) @ T_found
        turn_rad = float(np.linalg.norm(rotation_vector(error)))
        return _Error(float(np.linalg.norm(error[:3, 3])), math.degrees(turn_rad))


def poses(folder: Path, quick: bool) -> Iterator[Row]:
    """A simulated lidar and a depth camera, located in a lidar's map with points."""
    config = _with_points()
    plan = office_floorplan(0)
    mapping = _simulation(20.0 if quick else 80.0, MAP_SEED)
    simulate_session(folder / "map.mcap", sensor="lidar", grid=plan, config=mapping)
    made = build_session(folder / "map.mcap", "office", config)
    add_sessions(folder / "office.submaps", [made], config, keep=False)
    path = made[0].trajectory.planar()
    true = _true_at(folder / "map.tum", made[0].trajectory.stamps_ns)
    kinds: tuple[SensorKind, ...] = ("lidar", "depth")
    for sensor in kinds:
        at_place, in_plan, asked = [], [], 0
        for seed in range(1, 3 if quick else 9):
            asked += 1
            drive = folder / f"{sensor}{seed}.mcap"
            start = query_start(plan, mapping, seed)
            simulate_session(drive, sensor=sensor, grid=plan, config=_simulation(5.0, seed, start))
            with open_database(folder / "office.submaps") as database, open_log(drive, config.read) as log:
                answer = locate(follow(log.scans(), config), database, config)
            drive.unlink()
            if answer.status != "located" or answer.in_space is None:
                continue
            (x, y, yaw) = _true_at(drive.with_suffix(".tum"), np.array([answer.stamp_ns]))[0]
            near = np.hypot(true[:, 0] - x, true[:, 1] - y) < _NEAR_M
            for errors, chosen in ((in_plan, np.ones(len(true), bool)), (at_place, near)):
                T_plan_map = SE2.fit(path[chosen, :2], true[chosen, :2])
                T_map_base = (T_plan_map.inverse() @ SE2(x, y, yaw)).lift()
                errors.append(_Error.of(T_map_base, answer.in_space.T_map_base))
        note = f"{len(at_place)} of {asked} located in the map of a lidar"
        yield from _rows(f"pose in space, {sensor}, in the map's frame at the place", at_place, note)
        yield from _rows(f"pose in space, {sensor}, in the plan: with the map's own error", in_plan, note)
    yield from _hall()


def _hall() -> Iterator[Row]:
    """How far the true poses of hall.mcap are from where its scans fit onto each other.

    Map and scan both lie at the true poses, and the registration starts there, so it would stay if truth and
    scans agreed.
    """
    what = "hall: true poses, from where the scans fit"
    log_file, truth = fixtures.data_file("lidar/hall.mcap"), fixtures.data_file("lidar/hall.tum")
    if log_file is None or truth is None:
        yield Row(what=what, measured=None, unit="cm", note="needs PC2GRID_DATA")
        return
    tum = read_tum(truth)
    with open_log(log_file, Config().read) as log:
        scans = list(log.scans())
    posed = [(scan, tum.T_session_base[_nearest(tum.stamps_ns, scan.stamp_ns)]) for scan in scans]
    cloud = VoxelCloud(VOXEL_M)
    for scan, T in posed[:_HALL_MAP]:
        cloud.add(transform_points(T, _near_points(scan)))
    points = PointMap.of(cloud.points_m(), VOXEL_M, cloud.corner_m)
    errors = []
    for scan, T in posed[_HALL_MAP:]:
        # In its own true frame, so that the planar pose to start from is the unit.
        view = SpatialView(sensor_m=T[:3, 3], points_m=transform_points(T, _near_points(scan)))
        fit = register_in_space((view,), points, SE2())
        if fit is not None:
            errors.append(_Error.of(T, fit.T_map_query @ T))
    note = f"{len(errors)} scans on a map of the {_HALL_MAP} before, all at their true poses"
    yield from _rows(what, errors, note, goal=False)


def twins(folder: Path, quick: bool) -> Iterator[Row]:
    """Rooms that differ in height only, and rooms that differ in nothing but what stands in them.

    A small office is mapped four times by a lidar, each time with other things in it, twice with a ceiling of
    2.5 m and twice of 3.5 m. Queries are registered at their true place in all four maps. Of two maps of
    different height the one of the right height should win, of two maps of one height none.
    """
    from tests.helpers.simulated_drives import office

    config, plan = _with_points(), office()
    maps: list[tuple[float, PointMap, SE2]] = []
    for number, height_m in enumerate((2.5, 2.5, 3.5, 3.5)):
        log = folder / f"twin{number}.mcap"
        drive = _twin(40.0, 100 + number, height_m)
        simulate_session(log, sensor="lidar", grid=plan, config=drive)
        made, _ = build_session(log, "office", config)
        assert made.points is not None
        true = _true_at(log.with_suffix(".tum"), made.trajectory.stamps_ns)
        maps.append((height_m, made.points, SE2.fit(made.trajectory.planar()[:, :2], true[:, :2])))
    won: Counter[str] = Counter()
    for seed, height_m in product(range(1, 3 if quick else 9), (2.5, 3.5)):
        query, T_plan_odom = QueryInSpace(), SE2()
        simulated = list(
            islice(iter_session(sensor="lidar", grid=plan, config=_twin(8.0, seed, height_m)), 30)
        )
        for (registered, _), (_, T_plan_base) in zip(
            follow((scan for scan, _ in simulated), config), simulated, strict=True
        ):
            query.add(registered)
            T_plan_odom = T_plan_base @ SE2.from_matrix(registered.T_session_base).inverse()
        fits = [
            (of_m, register_in_space(query.views, points, T_plan_map.inverse() @ T_plan_odom))
            for of_m, points, T_plan_map in maps
        ]
        won.update(_outcome(height_m, a, b) for a, b in combinations(fits, 2))
    different = won["right"] + won["wrong"] + won["none"]
    alike = won["alike"] + won["alike, chosen"]
    what = "rooms whose heights differ by 1 m"
    yield Row(what=f"{what}: the right one is chosen", measured=won["right"], unit=f"of {different}")
    yield Row(what=f"{what}: the wrong one", measured=won["wrong"], unit=f"of {different}", goal=0.0)
    yield Row(
        what="rooms of one height: one is chosen", measured=won["alike, chosen"], unit=f"of {alike}", goal=0.0
    )


def _outcome(height_m: float, *rooms: tuple[float, Any]) -> str:
    """Which of two rooms is chosen. height_m : the true one; rooms : height, and fit or None."""
    heights, fits = zip(*rooms, strict=True)
    if None in fits:
        return "no fit"
    masses, first = masses_in_space([0.49] * len(fits), dict(enumerate(fits)))
    chosen = masses[first] >= 0.9
    if heights[0] == heights[1]:
        return "alike, chosen" if chosen else "alike"
    if not chosen:
        return "none"
    return "right" if heights[first] == height_m else "wrong"


def _twin(length_m: float, seed: int, height_m: float) -> SimulationConfig:
    return SimulationConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "clutter": 8,
            "wall_height_m": height_m,
            "lidar": {"rate_hz": 4.0, "columns": 360},
        }
    )


def _rows(what: str, errors: list[_Error], note: str, *, goal: bool = True) -> Iterator[Row]:
    for unit, values, limit in (
        ("cm", [100.0 * error.metres for error in errors], 2.0),
        ("degrees", [error.degrees for error in errors], 0.3),
    ):
        measured = float(np.median(values)) if values else None
        yield Row(what=what, measured=measured, unit=unit, goal=limit if goal else None, note=note)


def _with_points() -> Config:
    config = Config()
    projection = config.projection.model_copy(update={"points_voxel_m": VOXEL_M})
    return config.model_copy(update={"projection": projection})


def _simulation(length_m: float, seed: int, start_m: tuple[float, float] | None = None) -> SimulationConfig:
    return SimulationConfig.model_validate(
        {
            "length_m": length_m,
            "seed": seed,
            "start_m": start_m,
            "clutter": 10,
            "lidar": {"rate_hz": 5.0, "columns": 720},
            "depth": {"rate_hz": 5.0},
        }
    )


def _true_at(tum: Path, stamps_ns: I64) -> F64:
    """True x, y, yaw (N, 3) at the scans of these stamps."""
    truth = read_tum(tum)
    nearest = [_nearest(truth.stamps_ns, int(stamp_ns)) for stamp_ns in stamps_ns]
    return truth.planar()[nearest]


def _nearest(stamps_ns: I64, stamp_ns: int) -> int:
    return int(np.abs(stamps_ns - stamp_ns).argmin())


def _near_points(scan: Scan) -> F64:
    cloud = VoxelCloud(VOXEL_M)
    cloud.add(scan.points_m[np.linalg.norm(scan.points_m, axis=1) < _HALL_RANGE_M])
    return cloud.points_m()
