"""A simulated session, in memory or as a recording: a building with clutter, a drive, and a sensor's
readings.

A recording is a standard ROS 2 MCAP, with the ground truth in a TUM file beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pc2grid.geometry import F32, F64, SE2, invert_pose, wrap_angle
from pc2grid.io.atomic import refuse_existing
from pc2grid.io.export import LogWriter
from pc2grid.io.trajectory import write_tum
from pc2grid.model import OccupancyGrid, Scan, SensorKind, Trajectory
from pc2grid.simulate.config import DepthConfig, LaserConfig, SimulationConfig
from pc2grid.simulate.drive import Drive, SimulatedOdometry, drive_along, odometry_of, plan_route
from pc2grid.simulate.plan import office_floorplan
from pc2grid.simulate.scene import (
    SENSORS,
    Building,
    Furniture,
    Scene,
    SimulatedSensor,
    covered,
    depth_intrinsics,
    extrude,
    laser_angle_min,
    laser_time_increment,
    place_clutter,
)

EPOCH_NS = 1_700_000_000_000_000_000
"""Stamp of the start of every session; constant, so that the same seed gives the same bytes."""
RAYS_PER_CAST = 300_000  # bounds the memory of one call of the ray caster


# Each purpose has its own stream of random numbers, so that more clutter does not change the noise.
_CLUTTER, _ROUTE, _DRIVE, _ODOMETRY, _NOISE = range(5)


@dataclass(frozen=True, slots=True)
class Measurements:
    """The measurements of one scan.

    time_s : of its stamp, since the session's start. values_m : (R,) float32, one per ray, NaN for a ray
    without a return.
    """

    time_s: float
    values_m: F32

    @property
    def stamp_ns(self) -> int:
        """Return the header stamp."""
        return EPOCH_NS + round(self.time_s * 1e9)


@dataclass(frozen=True, slots=True)
class Session:
    """Everything that the seed of a session determines, before the first ray is cast.

    grid : the true floor plan. clutter : movable objects in it.
    drive : true motion in the plan's map frame.
    odometry : None when switched off. scan_count : scans of the sensor during the drive.
    shell : (T, 3, 3) triangles of a real building; None where the plan is extruded.
    """

    sensor: SimulatedSensor
    grid: OccupancyGrid
    clutter: tuple[Furniture, ...]
    drive: Drive
    odometry: SimulatedOdometry | None
    config: SimulationConfig
    shell: F32 | None = None

    @property
    def scan_count(self) -> int:
        """Return the number of whole scans from start to end of the drive."""
        return max(int(self.drive.duration_s * self.sensor.rate_hz), 1)

    def mesh(self) -> F32:
        """Return building and objects as triangles (T, 3, 3) in the map frame."""
        shell = extrude(self.grid, self.config.wall_height_m) if self.shell is None else self.shell
        return np.concatenate([shell, *(furniture.mesh() for furniture in self.clutter)])

    def readings(self) -> Iterator[Measurements]:
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
                yield Measurements(float(index) / sensor.rate_hz, sensor.measure(ranges, rng))

    def scan(self, reading: Measurements) -> Scan:
        """Return a reading as the scan that `pc2grid.io` decodes from the recording."""
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
        """Return T_odom_base (4, 4) by the odometry; None if there is none."""
        return None if self.odometry is None else self.odometry.at(time_s).lift()

    def scans(self) -> Iterator[tuple[Scan, SE2]]:
        """Yield scans in the base frame, not deskewed, with the true T_map_base at their stamps."""
        for reading in self.readings():
            yield self.scan(reading), self.drive.pose(reading.time_s)


def _rays(poses: F64, mount_m: F64, directions: F64) -> F32:
    """Return rays (S, R, 6) in the map frame.

    They are made from base poses (S, R, 3), the mounting point (3,) and directions (R, 3) in base axes.
    """
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
) -> Session:
    """Place the clutter, plan the drive and compute its odometry.

    grid : the floor plan, or a real building; None for the procedural office of `config.building_seed`.
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
    blocked, clearance_m = covered(plan, clutter), config.drive.clearance_m
    points, turns = plan_route(
        plan, blocked, config.length_m, start_m=config.start_m, least_m=clearance_m, rng=stream(_ROUTE)
    )
    drive = drive_along(points, turns, config.drive, stream(_DRIVE))
    odometry = odometry_of(drive, config.odometry, stream(_ODOMETRY)) if config.odometry.enabled else None
    made = SENSORS[sensor](getattr(config, sensor))
    return Session(made, plan, clutter, drive, odometry, config, shell)


# --- recordings ---------------------------------------------------------------------------------------

BASE_FRAME, ODOM_FRAME = "base_link", "odom"
TOPICS: dict[SensorKind, str] = {
    "lidar": "/points",
    "laser": "/scan",
    "depth": "/camera/depth/image_rect_raw",
}
INFO_TOPIC = "/camera/depth/camera_info"
ODOMETRY_TOPIC = "/odom"


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedSession:
    """The files of a simulated session.

    path : the MCAP. truth_path : TUM file of true base poses in the floor plan's map frame, one per scan.
    scans : their number. duration_s, length_m : of the drive. clutter : how many objects could be placed.
    """

    path: Annotated[Path, Field(serialization_alias="recording")]
    truth_path: Annotated[Path, Field(serialization_alias="truth")]
    sensor: SensorKind
    scans: int
    duration_s: float
    length_m: float
    clutter: int


def simulate_session(
    out: str | Path,
    *,
    sensor: SensorKind,
    grid: OccupancyGrid | Building | None = None,
    config: SimulationConfig | None = None,
    progress: Callable[[float], None] | None = None,
    overwrite: bool = False,
) -> SimulatedSession:
    """Drive through a building and record it.

    out : MCAP to write; the ground truth is written beside it as `.tum`. Existing files are refused without
        `overwrite`.
    grid : the floor plan, or a real building; None for the procedural office of `config.building_seed`.
    progress : called with the finished share, 0..1.

    Topics: the sensor's (TOPICS; a camera has INFO_TOPIC too), /tf_static base_link -> sensor and, unless
    switched off, nav_msgs/Odometry with /tf odom -> base_link. The same arguments give the same bytes. Raises
    ConfigError if there is no room for the robot, OutputError if a file cannot be written.

    >>> made = simulate_session("drive.mcap", sensor="laser", config=SimulationConfig(length_m=1.0))
    >>> made.truth_path.name, made.scans > 10
    ('drive.tum', True)
    """
    out = Path(out)
    truth_path = out.with_suffix(".tum")
    for path in (out, truth_path):
        refuse_existing(path, overwrite)
    session = prepare_session(sensor=sensor, grid=grid, config=config)
    count = session.scan_count
    stamps, poses = [], []
    with LogWriter.to(out, overwrite=overwrite) as log:
        about = {"sensor": session.sensor.kind, "config": session.config.model_dump_json()}
        log.metadata("pc2grid.simulation", about)
        log.tf_static(EPOCH_NS, BASE_FRAME, session.sensor.frame, session.sensor.T_base_sensor)
        odometry_sent = 0
        for done, reading in enumerate(session.readings(), 1):
            odometry_sent = _write_odometry(log, session, odometry_sent, reading.time_s)
            _write_reading(log, session, reading)
            stamps.append(reading.stamp_ns)
            poses.append(session.drive.pose(reading.time_s).lift())
            if progress is not None:
                progress(done / count)
        _write_odometry(log, session, odometry_sent, np.inf)
    write_tum(truth_path, Trajectory(stamps_ns=np.array(stamps), T_session_base=np.array(poses)))
    return SimulatedSession(
        path=out,
        truth_path=truth_path,
        sensor=session.sensor.kind,
        scans=count,
        duration_s=session.drive.duration_s,
        length_m=session.drive.length_m,
        clutter=len(session.clutter),
    )


def _write_odometry(log: LogWriter, session: Session, sent: int, until_s: float) -> int:
    """Write the odometry up to a time, from message `sent` on; returns the number of messages written so
    far."""
    odometry = session.odometry
    if odometry is None:
        return 0
    end = int(np.searchsorted(odometry.times_s, until_s, side="right"))
    for time_s, (x, y, yaw) in zip(odometry.times_s[sent:end], odometry.poses[sent:end], strict=True):
        stamp_ns = EPOCH_NS + round(float(time_s) * 1e9)
        T_odom_base = SE2(float(x), float(y), wrap_angle(float(yaw))).lift()
        log.odometry(ODOMETRY_TOPIC, stamp_ns, T_odom_base, ODOM_FRAME, BASE_FRAME)
        log.tf(stamp_ns, ODOM_FRAME, BASE_FRAME, T_odom_base)
    return end


def _write_reading(log: LogWriter, session: Session, reading: Measurements) -> None:
    """Write one scan as the driver of its sensor publishes it."""
    sensor, values, stamp_ns = session.sensor, reading.values_m, reading.stamp_ns
    topic, config = TOPICS[sensor.kind], sensor.config
    if isinstance(config, LaserConfig):
        log.laser_scan(
            topic,
            stamp_ns,
            sensor.frame,
            np.where(np.isfinite(values), values, np.inf),
            laser_angle_min(config),
            np.radians(config.step_deg),
            config.min_range_m,
            config.max_range_m,
            laser_time_increment(config),
        )
    elif isinstance(config, DepthConfig):
        log.camera_info(
            INFO_TOPIC, stamp_ns, sensor.frame, depth_intrinsics(config), config.width, config.height
        )
        log.depth_image(topic, stamp_ns, sensor.frame, values.reshape(config.height, config.width))
    else:
        kept = np.isfinite(values)
        points = (values[kept, None] * sensor.directions[kept]).astype(np.float32)
        log.point_cloud(topic, stamp_ns, sensor.frame, points, sensor.offsets_s[kept])
