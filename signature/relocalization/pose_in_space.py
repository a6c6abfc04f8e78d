"""A pose with six degrees of freedom, with its covariance and how well the points agree there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pc2grid.arrays import F64, freeze

SpaceStatus = Literal["agrees", "unsure", "contradicts"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseInSpace:
    """A pose of the base with six degrees of freedom, and how well it agrees with the map.

    status : agrees, contradicts, or unsure between the two.
    T_map_base : (4, 4) at the query's last scan. covariance : (6, 6) of x, y, z and of the rotation about the
        axes of the map, metres and radians. rmse_m : of the distances of points from surfaces.
    rays, on, through, before : see `SpatialFit`.
    """

    status: SpaceStatus
    T_map_base: F64
    covariance: F64
    rmse_m: float
    rays: int
    on: float
    through: float
    before: float

    def __post_init__(self) -> None:
        freeze(self, "T_map_base", np.float64, (4, 4))
        freeze(self, "covariance", np.float64, (6, 6))

    @property
    def rpy_rad(self) -> tuple[float, float, float]:
        """Roll, pitch and yaw, radians (REP-103: about the fixed axes x, y, z in this order)."""
        R = self.T_map_base[:3, :3]
        pitch = math.asin(float(np.clip(-R[2, 0], -1.0, 1.0)))
        return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])
