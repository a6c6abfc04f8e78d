"""One simulated session: a building with clutter, a drive through it, and the readings of a sensor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.geometry import SE2, invert_pose
from pc2grid.model import OccupancyGrid, Scan, SensorKind
from pc2grid.simulate.building import Building
from pc2grid.simulate.clutter import Furniture, covered, place_clutter
from pc2grid.simulate.config import SimulationConfig
from pc2grid.simulate.drive import Drive, drive_along
from pc2grid.simulate.floorplan import office_floorplan
from pc2grid.simulate.odometry import SimulatedOdometry, odometry_of
from pc2grid.simulate.route import plan_route
from pc2grid.simulate.scene import Mesh, Scene, extrude
from pc2grid.simulate.sensors import Sensor, make_sensor

EPOCH_NS = 1_700_000_000_000_000_000
"""Stamp of the start of every session; constant, so that the same seed gives the same bytes."""

RAYS_PER_CAST = 300_000  # bounds the memory of one call of the ray caster

# Each purpose has its own stream of random numbers, so that more clutter does not change the noise.
_CLUTTER, _ROUTE, _DRIVE, _ODOMETRY, _NOISE = range(5)


@dataclass(frozen=True, slots=True)
class Reading:
    """What the sensor measured in one scan.

    index : number of the scan. time_s : of its stamp, since the session's start. values_m : (R,) float32, one
    per ray, NaN for a ray without a return.
    """

    index: int
    time_s: float
    values_m: F32

    @property
    def stamp_ns(self) -> int:
        """Its header stamp."""
        return EPOCH_NS + round(self.time_s * 1e9)


@dataclass(frozen=True, slots=True)
class Session:
    """Everything that the seed of a session determines, before the first ray is cast.

    grid : the true floor plan. clutter : movable objects in it.
    drive : true motion in the plan's map frame.
    odometry : None when switched off. scan_count : scans of the sensor during the drive.
    shell : geometry of a real building; None where the plan is extruded.
    added : further objects that the plan does not show.
    """

    sensor: Sensor
    grid: OccupancyGrid
    clutter: tuple[Furniture, ...]
    drive: Drive
    odometry: SimulatedOdometry | None
    config: SimulationConfig
    shell: Mesh | None = None
    added: tuple[Furniture, ...] = ()

    @property
    def scan_count(self) -> int:
        """Whole scans from start to end of the drive."""
        return max(int(self.drive.duration_s * self.sensor.rate_hz), 1)

    def mesh(self) -> Mesh:
        """Building and objects as triangles in the map frame."""
        shell = extrude(self.grid, self.config.wall_height_m) if self.shell is None else self.shell
        return Mesh.join([shell, *(furniture.mesh() for furniture in (*self.clutter, *self.added))])

    def readings(self) -> Iterator[Reading]:
        """Cast all scans, several in a call; each ray starts at the robot's pose at the time of the ray."""
        sensor = self.sensor
        scene = Scene(self.mesh())
        T = sensor.T_base_sensor
        directions = sensor.directions @ T[:3, :3].T
        batch = max(RAYS_PER_CAST // len(directions), 1)
        for first in range(0, self.scan_count, batch):
            indices = np.arange(first, min(first + batch, self.scan_count))
            times_s = indices[:, None] / sensor.rate_hz + sensor.offsets_s
            rays = _rays(self.drive.at(times_s), T[:3, 3], directions)
            true_m = scene.cast(rays.reshape(-1, 6)).reshape(times_s.shape)
            for index, ranges in zip(indices, true_m, strict=True):
                rng = np.random.default_rng([self.config.seed, _NOISE, int(index)])
                yield Reading(int(index), float(index) / sensor.rate_hz, sensor.measure(ranges, rng))

    def scan(self, reading: Reading) -> Scan:
        """A reading as the scan that `pc2grid.io` decodes from the recording."""
        T = self.sensor.T_base_sensor
        kept = np.isfinite(reading.values_m)
        points = (reading.values_m[kept, None] * self.sensor.directions[kept]).astype(np.float32)
        moving = bool(self.sensor.offsets_s.any())
        offsets = self.sensor.offsets_s[kept].astype(np.float32) if moving else None
        motion = None
        if offsets is not None and len(offsets):
            ends_s = (reading.time_s + float(s) for s in (offsets.min(), offsets.max()))
            first, last = (self._odometry_at(time_s) for time_s in ends_s)
            motion = None if first is None or last is None else invert_pose(first) @ last
        return Scan(
            stamp_ns=reading.stamp_ns,
            points_m=(points @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
            T_base_sensor=T,
            sensor=self.sensor.kind,
            offsets_s=offsets,
            T_odom_base=self._odometry_at(reading.time_s),
            T_first_last=motion,
            dropped=int((~kept).sum()),
        )

    def _odometry_at(self, time_s: float) -> F64 | None:
        """T_odom_base (4, 4) by the odometry; None if there is none."""
        return None if self.odometry is None else self.odometry.at(time_s).lift()

    def scans(self) -> Iterator[tuple[Scan, SE2]]:
        """Scans in the base frame, not deskewed, with the true T_map_base at their stamps."""
        for reading in self.readings():
            yield self.scan(reading), self.drive.pose(reading.time_s)


def _rays(poses: F64, mount_m: F64, directions: F64) -> F32:
    """Rays (S, R, 6) in the map frame from base poses (S, R, 3), the mounting point (3,) and directions
    (R, 3) in base axes."""
    x, y, yaw = poses[..., 0], poses[..., 1], poses[..., 2]
    c, s = np.cos(yaw), np.sin(yaw)
    rays = np.empty((*yaw.shape, 6), np.float32)
    rays[..., 0] = x + c * mount_m[0] - s * mount_m[1]
    rays[..., 1] = y + s * mount_m[0] + c * mount_m[1]
    rays[..., 2] = mount_m[2]
    rays[..., 3] = c * directions[:, 0] - s * directions[:, 1]
    rays[..., 4] = s * directions[:, 0] + c * directions[:, 1]
    rays[..., 5] = directions[:, 2]
    return rays


def prepare_session(
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
    added: tuple[Furniture, ...] = (),
) -> Session:
    """Place the clutter, plan the drive and compute its odometry.

    grid : the floor plan, or a real building; None for the procedural office of `config.building_seed`.
    added : further objects that the plan does not show.
    Raises ConfigError if there is no room for the robot in the building, or at the given start.
    """
    config = config or SimulationConfig()
    building = office_floorplan(config.building_seed) if grid is None else grid
    plan, shell = (building, None) if isinstance(building, OccupancyGrid) else (building.plan, building.shell)

    def stream(number: int) -> np.random.Generator:
        return np.random.default_rng([config.seed, number])

    clutter = place_clutter(
        plan,
        config.clutter,
        stream(_CLUTTER),
        robot_m=config.drive.clearance_m,
        keep_free_m=() if config.start_m is None else (config.start_m,),
    )
    blocked, clearance_m = covered(plan, (*clutter, *added)), config.drive.clearance_m
    route = plan_route(
        plan, blocked, config.length_m, start_m=config.start_m, least_m=clearance_m, rng=stream(_ROUTE)
    )
    drive = drive_along(route, config.drive, stream(_DRIVE))
    odometry = odometry_of(drive, config.odometry, stream(_ODOMETRY)) if config.odometry.enabled else None
    return Session(make_sensor(sensor, config), plan, clutter, drive, odometry, config, shell, added)


def iter_session(
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
) -> Iterator[tuple[Scan, SE2]]:
    """A session in memory: each scan with the true T_map_base at its stamp.

    The same scans as in the log that `simulate_session` writes, without the log.
    """
    yield from prepare_session(sensor=sensor, grid=grid, config=config).scans()
