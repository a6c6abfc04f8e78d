"""The IMU of a simulated session."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, freeze
from pc2grid.geometry import invert_pose, rotation_vector
from pc2grid.io.messages.types import Header, Imu
from pc2grid.simulate.config import ImuConfig

_HOLDING_MPS2 = np.array([0.0, 0.0, 9.81])
"""An accelerometer measures what holds it against gravity."""
_STEP_S = 0.02
"""Rates and accelerations are differences over this time: less than the period of any motion here."""


@dataclass(frozen=True, slots=True)
class SimulatedImu:
    """What an IMU at the origin of the base measures, in its axes.

    times_s : (N,) since the session's start. turn_rates_rps, accelerations_mps2 : (N, 3); the latter with
        what holds against gravity, as an accelerometer measures it.
    """

    times_s: F64
    turn_rates_rps: F64
    accelerations_mps2: F64

    def __post_init__(self) -> None:
        freeze(self, "times_s", np.float64, (None,))
        freeze(self, "turn_rates_rps", np.float64, (len(self.times_s), 3))
        freeze(self, "accelerations_mps2", np.float64, (len(self.times_s), 3))

    def messages(self, begin_ns: int, frame: str) -> Iterator[Imu]:
        """What its driver publishes from a time on. It does not tell the orientation."""
        for k, time_s in enumerate(self.times_s.tolist()):
            rate, acceleration = (a[k].tolist() for a in (self.turn_rates_rps, self.accelerations_mps2))
            header = Header(begin_ns + round(time_s * 1e9), frame)
            yield Imu(header, None, tuple(rate), tuple(acceleration))


def imu_of(
    pose_at: Callable[[float], F64], duration_s: float, config: ImuConfig, rng: np.random.Generator
) -> SimulatedImu:
    """Differentiate a motion in space, with noise and a constant bias.

    pose_at : the true T_map_base (4, 4) at a time, z up.
    """
    times_s = np.arange(int(duration_s * config.rate_hz) + 1) / config.rate_hz
    rates, accelerations = np.empty((len(times_s), 3)), np.empty((len(times_s), 3))
    for k, time_s in enumerate(times_s.tolist()):
        before, now, after = (pose_at(max(time_s + step_s, 0.0)) for step_s in (-_STEP_S, 0.0, _STEP_S))
        rates[k] = rotation_vector(invert_pose(before) @ after) / (2.0 * _STEP_S)
        shaken = (after[:3, 3] - 2.0 * now[:3, 3] + before[:3, 3]) / _STEP_S**2
        accelerations[k] = now[:3, :3].T @ (shaken + _HOLDING_MPS2)
    for values, bias, noise in (
        (rates, config.turn_bias_rps, config.turn_noise_rps),
        (accelerations, config.acceleration_bias_mps2, config.acceleration_noise_mps2),
    ):
        values += bias * rng.standard_normal(3) + noise * rng.standard_normal(values.shape)
    return SimulatedImu(times_s, rates, accelerations)
