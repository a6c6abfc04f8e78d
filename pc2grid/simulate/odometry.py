"""Wheel odometry of a simulated drive."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, freeze
from pc2grid.geometry import SE2
from pc2grid.simulate.config import OdometryConfig
from pc2grid.simulate.drive import Drive


@dataclass(frozen=True, slots=True)
class SimulatedOdometry:
    """Odometry as the robot publishes it, starting at the identity.

    times_s : (N,) since the session's start. poses : (N, 3) x, y, yaw of the base in the odom frame, metres
    and radians, yaw without jumps.
    """

    times_s: F64
    poses: F64

    def __post_init__(self) -> None:
        freeze(self, "times_s", np.float64, (None,))
        freeze(self, "poses", np.float64, (len(self.times_s), 3))

    def at(self, time_s: float) -> SE2:
        """T_odom_base between two messages."""
        x, y, yaw = (float(np.interp(time_s, self.times_s, self.poses[:, k])) for k in range(3))
        return SE2(x, y, math.remainder(yaw, 2 * math.pi))


def _slip(steps: int, error: float, step_s: float, memory_s: float, rng: np.random.Generator) -> F64:
    """(steps,) relative errors of standard deviation `error`, correlated over `memory_s`."""
    keep = math.exp(-step_s / memory_s)
    white = rng.standard_normal(steps) * error * math.sqrt(1 - keep * keep)
    first = error * rng.standard_normal()
    slip = itertools.accumulate(white.tolist(), lambda before, new: keep * before + new, initial=first)
    return np.array([*slip][1:])


def odometry_of(drive: Drive, config: OdometryConfig, rng: np.random.Generator) -> SimulatedOdometry:
    """Integrate the steps of the drive with the errors of wheel odometry.

    Three relative errors are added to the distance and rotation of each step: slip, which is correlated over
    `slip_s` (an Ornstein-Uhlenbeck process), a bias that is constant in the session, and a rotation per metre
    driven. The error grows with the distance, and not while the robot stands.
    """
    step_s = 1.0 / config.rate_hz
    times_s = (np.arange(math.floor(drive.duration_s * config.rate_hz) + 2) * step_s).astype(np.float64)
    x, y, yaw = drive.at(times_s).T
    middle = (yaw[1:] + yaw[:-1]) / 2
    forward = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    turn = np.diff(yaw)
    steps = len(turn)
    bias_forward, bias_turn, veer = rng.standard_normal(3) * (
        config.distance_bias,
        config.rotation_bias,
        config.veer_rpm,
    )
    slip_forward = _slip(steps, config.distance_error, step_s, config.slip_s, rng)
    slip_turn = _slip(steps, config.rotation_error, step_s, config.slip_s, rng)
    turn = turn * (1 + bias_turn + slip_turn) + veer * np.abs(forward)
    forward = forward * (1 + bias_forward + slip_forward)
    poses = np.zeros((steps + 1, 3))
    poses[1:, 2] = np.cumsum(turn)
    middle = poses[:-1, 2] + turn / 2
    poses[1:, 0] = np.cumsum(forward * np.cos(middle))
    poses[1:, 1] = np.cumsum(forward * np.sin(middle))
    return SimulatedOdometry(times_s, poses)
