"""A simulated session as a recording: standard ROS 2 MCAP, with the ground truth in a TUM file beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.io.atomic import refuse_existing
from pc2grid.io.export.mcap import LogWriter
from pc2grid.io.trajectory import write_tum
from pc2grid.model import OccupancyGrid, SensorKind, Trajectory
from pc2grid.simulate.building import Building
from pc2grid.simulate.config import DepthConfig, LaserConfig, SimulationConfig
from pc2grid.simulate.sensors import depth_intrinsics, laser_angle_min, laser_time_increment
from pc2grid.simulate.session import EPOCH_NS, Reading, Session, prepare_session

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
    """What was written.

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
    progress : called with the share that is done, 0..1.

    Topics: the sensor's (TOPICS; a camera has INFO_TOPIC too), /tf_static base_link -> sensor and, unless
    switched off, nav_msgs/Odometry with /tf odom -> base_link. The same arguments give the same bytes.
    Raises ConfigError if there is no room for the robot, OutputError if a file cannot be written.

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
    with LogWriter(out, overwrite=overwrite) as log:
        about = {"sensor": session.sensor.kind, "config": session.config.model_dump_json()}
        log.metadata("pc2grid.simulation", about)
        log.tf_static(EPOCH_NS, BASE_FRAME, session.sensor.frame, session.sensor.T_base_sensor)
        odometry_sent = 0
        for reading in session.readings():
            odometry_sent = _write_odometry(log, session, odometry_sent, reading.time_s)
            _write_reading(log, session, reading)
            stamps.append(reading.stamp_ns)
            poses.append(session.drive.pose(reading.time_s).lift())
            if progress is not None:
                progress((reading.index + 1) / count)
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
    """Write the odometry up to a time, from message `sent` on; returns how many messages are written then."""
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


def _write_reading(log: LogWriter, session: Session, reading: Reading) -> None:
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
