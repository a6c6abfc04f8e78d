"""The three sensors: directions and times of their rays, and noise and losses of their readings."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pc2grid.arrays import F32, F64, freeze
from pc2grid.model import SensorKind
from pc2grid.simulate.config import DepthConfig, LaserConfig, LidarConfig, SimulationConfig

OPTICAL = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
"""R_body_optical (REP-103): z forward, x right, y down, in body axes."""


# A neighbour whose depth differs by more than this share of the depth and this distance is a depth jump.
_JUMP_SHARE, _JUMP_M = 0.1, 0.1


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor as the rays that it casts in each scan.

    kind : of the sensor. frame : name of its frame.
    T_base_sensor : (4, 4) mounting.
    rate_hz : scans per second.
    directions : (R, 3) in the sensor frame; a reading times its direction is the point. Unit vectors for
        ranges; z = 1 for depths.
    offsets_s : (R,) when each ray is cast, relative to the scan's stamp; all zero for a camera.
    """

    kind: SensorKind
    frame: str
    T_base_sensor: F64
    rate_hz: float
    directions: F64
    offsets_s: F64
    config: LidarConfig | LaserConfig | DepthConfig

    def __post_init__(self) -> None:
        freeze(self, "T_base_sensor", np.float64, (4, 4))
        freeze(self, "directions", np.float64, (None, 3))
        freeze(self, "offsets_s", np.float64, (len(self.directions),))

    def measure(self, true_m: F32, rng: np.random.Generator) -> F32:
        """True distances (R,), inf for none, to readings (R,) float32, NaN without a return."""
        if isinstance(self.config, DepthConfig):
            return _measure_depth(true_m, self.config, rng)
        noise = rng.standard_normal(len(true_m), dtype=np.float32) * np.float32(self.config.noise_m)
        kept = rng.random(len(true_m), dtype=np.float32) >= self.config.dropout
        reading = true_m + noise
        kept &= (reading >= self.config.min_range_m) & (reading <= self.config.max_range_m)
        return np.where(kept, reading, np.float32(np.nan))


def _measure_depth(true_m: F32, config: DepthConfig, rng: np.random.Generator) -> F32:
    """Noise that grows with the square of the depth, losses at depth jumps, rounding to millimetres."""
    depth = np.where(np.isfinite(true_m), true_m, 0).astype(np.float32)
    spread = config.noise_m + config.noise_per_m * depth**2
    lost = np.full(len(depth), config.dropout, np.float32)
    image = depth.reshape(config.height, config.width)
    near, far = ndimage.minimum_filter(image, 3), ndimage.maximum_filter(image, 3)
    lost[((far - near) > _JUMP_SHARE * image + _JUMP_M).ravel()] = config.edge_dropout
    noise = rng.standard_normal(len(depth), dtype=np.float32) * spread
    reading = np.round((depth + noise) * 1000) / np.float32(1000)
    kept = rng.random(len(depth), dtype=np.float32) >= lost
    kept &= (reading >= config.min_range_m) & (reading <= config.max_range_m) & (depth > 0)
    return np.where(kept, reading, np.float32(np.nan)).astype(np.float32)


def _mount(xyz_m: tuple[float, float, float]) -> F64:
    pose = np.eye(4)
    pose[:3, 3] = xyz_m
    return pose


def lidar(config: LidarConfig) -> Sensor:
    """Columns of beams, fired one after another during one turn; the stamp is that of the first column."""
    azimuth = np.arange(config.columns) * (2 * math.pi / config.columns) - math.pi
    top = math.radians(config.elevation_deg) if config.beams > 1 else 0.0
    elevation = np.linspace(-top, top, config.beams)
    a, e = (v.ravel() for v in np.meshgrid(azimuth, elevation, indexing="ij"))
    directions = np.column_stack((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    offsets = np.repeat(np.arange(config.columns) / (config.columns * config.rate_hz), config.beams)
    return Sensor("lidar", "lidar_link", _mount(config.mount_m), config.rate_hz, directions, offsets, config)


def laser(config: LaserConfig) -> Sensor:
    """One horizontal row of rays from right to left, one after another; the stamp is that of the first."""
    count = round(config.field_deg / config.step_deg) + 1
    angle = laser_angle_min(config) + np.arange(count) * math.radians(config.step_deg)
    directions = np.column_stack((np.cos(angle), np.sin(angle), np.zeros(count)))
    offsets = np.arange(count, dtype=np.float64) * laser_time_increment(config)
    return Sensor("laser", "laser_link", _mount(config.mount_m), config.rate_hz, directions, offsets, config)


def laser_angle_min(config: LaserConfig) -> float:
    """Bearing of the first ray, radians."""
    return -math.radians(round(config.field_deg / config.step_deg) * config.step_deg) / 2


def laser_time_increment(config: LaserConfig) -> float:
    """Seconds between two rays."""
    return config.step_deg / 360.0 / config.rate_hz


def depth(config: DepthConfig) -> Sensor:
    """A pinhole camera with a global shutter."""
    K = depth_intrinsics(config)
    u, v = (p.ravel() for p in np.meshgrid(np.arange(config.width), np.arange(config.height)))
    directions = np.column_stack(((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.size)))
    pose = _mount(config.mount_m)
    pose[:3, :3] = OPTICAL
    frame, at_once = "camera_depth_optical_frame", np.zeros(u.size)
    return Sensor("depth", frame, pose, config.rate_hz, directions, at_once, config)


def depth_intrinsics(config: DepthConfig) -> F64:
    """K (3, 3) in pixels, pixel centres at whole numbers."""
    fx = config.width / 2 / math.tan(math.radians(config.horizontal_deg) / 2)
    fy = config.height / 2 / math.tan(math.radians(config.vertical_deg) / 2)
    return np.array([(fx, 0, (config.width - 1) / 2), (0, fy, (config.height - 1) / 2), (0, 0, 1)])


def make_sensor(kind: SensorKind, config: SimulationConfig) -> Sensor:
    """The sensor of that kind as configured."""
    if kind == "lidar":
        return lidar(config.lidar)
    if kind == "laser":
        return laser(config.laser)
    return depth(config.depth)
