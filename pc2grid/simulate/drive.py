"""The motion along a route: speeds, turns in place and short stops."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pc2grid.arrays import F64, freeze
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.simulate.config import DriveConfig
from pc2grid.simulate.route import Route

RATE_HZ = 100.0
"""Samples of a drive in a second."""

_PAUSE_S = (0.5, 2.5)  # shortest and longest stop
_SMOOTHING_S = 0.08  # standard deviation in time that inertia gives to every change of speed
_LEAST_MPS = 0.02  # mean speed of a step; keeps the time of a step finite


@dataclass(frozen=True, slots=True)
class Drive:
    """The true motion of the base, sampled evenly from time 0.

    poses : (N, 3) x, y, yaw in the map frame, RATE_HZ apart; metres and radians, yaw without jumps.
    """

    poses: F64

    def __post_init__(self) -> None:
        freeze(self, "poses", np.float64, (None, 3))

    @property
    def duration_s(self) -> float:
        """Time of the last pose."""
        return (len(self.poses) - 1) / RATE_HZ

    @property
    def length_m(self) -> float:
        """Distance driven."""
        return float(np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=1).sum())

    def at(self, times_s: F64) -> F64:
        """Poses (..., 3) at times (...) in seconds; before the start and after the end the robot stands."""
        position = np.clip(np.asarray(times_s) * RATE_HZ, 0, len(self.poses) - 1)
        low = np.minimum(position.astype(np.int64), max(len(self.poses) - 2, 0))
        high = np.minimum(low + 1, len(self.poses) - 1)
        part = (position - low)[..., None]
        poses: F64 = (1 - part) * self.poses[low] + part * self.poses[high]
        return poses

    def pose(self, time_s: float) -> SE2:
        """T_map_base."""
        x, y, yaw = (float(v) for v in self.at(np.array(time_s)))
        return SE2(x, y, wrap_angle(yaw))


def _headings(points_m: F64) -> F64:
    """Direction of the line at each of its points, radians, without jumps of 2 pi."""
    reach = min(2, len(points_m) - 1)
    index = np.arange(len(points_m))
    ahead = points_m[np.minimum(index + reach, len(points_m) - 1)]
    direction = ahead - points_m[np.maximum(index - reach, 0)]
    return np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))


def _follow(points_m: F64, yaws: F64, config: DriveConfig) -> F64:
    """Times (N,) along a line, starting and ending at rest, within speed, yaw rate and acceleration."""
    steps = np.maximum(np.linalg.norm(np.diff(points_m, axis=0), axis=1), 1e-6)
    bend = np.abs(np.gradient(yaws)) / np.gradient(np.concatenate(([0.0], np.cumsum(steps))))
    bend = maximum_filter1d(bend, 5)
    speed = np.minimum(config.speed_mps, config.yaw_rate_rps / np.maximum(bend, 1e-3))
    speed[0] = speed[-1] = 0.0
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 2 * config.acceleration_mps2 * steps[i - 1]))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2 * config.acceleration_mps2 * steps[i]))
    seconds = 2 * steps / np.maximum(speed[1:] + speed[:-1], _LEAST_MPS)
    seconds = np.maximum(seconds, np.abs(np.diff(yaws)) / config.yaw_rate_rps)
    return np.concatenate(([0.0], np.cumsum(seconds)))


def _turn(angle_rad: float, config: DriveConfig) -> tuple[F64, F64]:
    """Times and angles of a turn in place with a trapezoidal profile of the yaw rate."""
    size = abs(angle_rad)
    top = min(config.yaw_rate_rps, np.sqrt(size * config.yaw_acceleration_rps2))
    ramp_s = top / config.yaw_acceleration_rps2
    total_s = ramp_s + size / top
    times = np.linspace(0, total_s, max(int(total_s * RATE_HZ), 2))
    up = np.minimum(times, ramp_s)
    down = np.maximum(times - (total_s - ramp_s), 0)
    angles = top * (times - up) + config.yaw_acceleration_rps2 * (up**2 - down**2) / 2
    return times, np.sign(angle_rad) * angles


def drive_along(route: Route, config: DriveConfig, rng: np.random.Generator) -> Drive:
    """Drive a route from rest to rest, with random short stops and a stop at each turn in place."""
    points = route.points_m
    last = len(points) - 1
    gap = config.pause_every_m
    pauses = np.cumsum(rng.exponential(gap, size=int(3 * route.length_m / gap) + 10))
    driven = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    stops = {int(np.searchsorted(driven, s)): float(rng.uniform(*_PAUSE_S)) for s in pauses if s < driven[-1]}
    turns = [int(v) for v in route.turns if 0 < v < last]
    times, poses = [np.array([0.0, 0.5])], [np.tile([*points[0], 0.0], (2, 1))]
    yaw: float | None = None
    for a, b in zip([0, *turns], [*turns, last], strict=True):
        line = points[a : b + 1]
        yaws = _headings(line)
        if yaw is None:
            poses[0][:, 2] = yaws[0]
        else:
            spin = wrap_angle(float(yaws[0]) - yaw)
            if abs(spin) > 1e-3:
                when, angles = _turn(spin, config)
                times.append(times[-1][-1] + when)
                poses.append(np.column_stack((np.tile(line[0], (len(when), 1)), yaw + angles)))
            yaws += yaw + spin - yaws[0]
        cuts = sorted({a, b, *(s for s in stops if a + 10 < s < b - 10)})
        for c, d in pairwise(cuts):
            part, headings = points[c : d + 1], yaws[c - a : d - a + 1]
            times.append(times[-1][-1] + _follow(part, headings, config))
            poses.append(np.column_stack((part, headings)))
            if d in stops:
                times.append(times[-1][-1:] + stops[d])
                poses.append(poses[-1][-1:])
        yaw = float(yaws[-1])
    when, where = np.concatenate(times), np.concatenate(poses)
    even = np.arange(int(when[-1] * RATE_HZ) + 1) / RATE_HZ
    sampled = np.column_stack([np.interp(even, when, where[:, k]) for k in range(3)])
    return Drive(gaussian_filter1d(sampled, _SMOOTHING_S * RATE_HZ, axis=0, mode="nearest"))
