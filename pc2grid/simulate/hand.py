"""A sensor in the hand of somebody who walks: the height and the tilt of the base, besides its drive.

The hand looks ahead and down, and sways slowly: each of height, pitch and roll is a sum of sines whose
periods and phases come from the seed. A phone or a headset that is carried so publishes its pose in space, by
visual-inertial odometry, which drifts little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, freeze
from pc2grid.simulate.config import DepthConfig, HandConfig, OdometryConfig, SimulationConfig


@dataclass(frozen=True, slots=True)
class Hand:
    """The motion of a hand over the place where somebody walks.

    phases : (3, P) of height, pitch and roll, one for each of the periods.
    """

    config: HandConfig
    phases: F64

    def __post_init__(self) -> None:
        freeze(self, "phases", np.float64, (3, len(self.config.periods_s)))

    @staticmethod
    def of(config: HandConfig, rng: np.random.Generator) -> Hand:
        """A hand that sways in its own way."""
        return Hand(config, rng.uniform(0.0, 2.0 * math.pi, (3, len(config.periods_s))))

    def at(self, time_s: float) -> F64:
        """T_walker_base (4, 4): the base over the walker's place on the floor, tilted about x and y."""
        c = self.config
        turns = 2.0 * math.pi * time_s / np.array(c.periods_s)
        rise, nod, lean = np.sin(turns + self.phases).mean(axis=1)
        pitch = math.radians(c.pitch_deg + c.pitch_sway_deg * nod)
        roll = math.radians(c.roll_sway_deg * lean)
        (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (pitch, roll))
        pose = np.eye(4)
        pose[:3, :3] = np.array([(cp, 0, sp), (0, 1, 0), (-sp, 0, cp)]) @ [
            (1, 0, 0),
            (0, cr, -sr),
            (0, sr, cr),
        ]
        pose[2, 3] = c.height_m + c.height_sway_m * rise
        return pose


def carried_camera(config: SimulationConfig | None = None, *, rate_hz: float = 10.0) -> SimulationConfig:
    """A session with a phone's depth camera in the hand, with its visual-inertial odometry.

    As real recordings of rooms are: a field of 60 by 45 degrees, pitched down by 0 to 40 degrees, noise that
    grows with the square of the range, a third of the pixels lost, and points in the air at edges.
    """
    return (config or SimulationConfig()).model_copy(
        update={
            "hand": HandConfig(carried=True),
            "depth": DepthConfig(
                width=96,
                height=72,
                horizontal_deg=60.0,
                vertical_deg=45.0,
                rate_hz=rate_hz,
                noise_per_m=0.003,
                max_range_m=5.0,
                dropout=0.1,
                holes=0.25,
                flying=0.5,
                mount_m=(0.0, 0.0, 0.0),
            ),
            "odometry": OdometryConfig(
                distance_error=0.005,
                rotation_error=0.005,
                distance_bias=0.002,
                rotation_bias=0.001,
                veer_rpm=0.0005,
            ),
        }
    )
