"""People who walk while the robot drives; a map should not contain them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.config import DriveConfig
from pc2grid.simulate.drive import Drive, drive_along
from pc2grid.simulate.route import plan_route

_PACE = DriveConfig(speed_mps=0.8, pause_every_m=10.0)
_CLEARANCE_M = 0.35  # of a person's route to anything solid
_RADIUS_M = (0.18, 0.25)
_HEIGHT_M = (1.55, 1.9)

ASIDE_M = 0.6
"""A person nearer to the robot than this is not seen, instead of being driven through."""


@dataclass(frozen=True, slots=True)
class Walker:
    """A person as an upright cylinder. walk : true motion of its axis in the map frame."""

    walk: Drive
    radius_m: float
    height_m: float

    def hits(self, rays: F32, times_s: F64, robot_m: F64) -> F32:
        """Intersections of rays with the side of the cylinder.

        rays : (S, R, 6) origin and direction in the map frame. times_s : (S, R) when each is cast.
        robot_m : (S, 2) position of the robot in each scan. Returns (S, R): multiples of the direction, inf
        without an intersection.
        """
        distance = np.full(times_s.shape, np.inf, np.float32)
        middle = self.walk.at(times_s[:, 0])[:, :2]
        for k in np.flatnonzero(np.linalg.norm(middle - robot_m, axis=1) > ASIDE_M):
            from_axis = rays[k, :, :2] - self.walk.at(times_s[k])[:, :2]
            direction = rays[k, :, 3:5]
            # |from_axis + s direction| = radius, the nearer solution.
            a = (direction**2).sum(axis=1)
            b = (from_axis * direction).sum(axis=1)
            c = (from_axis**2).sum(axis=1) - self.radius_m**2
            inside = b * b - a * c
            s = (-b - np.sqrt(np.maximum(inside, 0))) / np.maximum(a, 1e-12)
            z = rays[k, :, 2] + s * rays[k, :, 5]
            met = (inside > 0) & (s > 0) & (c > 0) & (z > 0) & (z < self.height_m)
            distance[k, met] = s[met]
        return distance


def send_walkers(
    grid: OccupancyGrid, blocked: BoolGrid, count: int, duration_s: float, rng: np.random.Generator
) -> tuple[Walker, ...]:
    """`count` people, each on its own route for at least `duration_s`."""
    walkers = []
    for _ in range(count):
        length_m = duration_s * _PACE.speed_mps
        route = plan_route(grid, blocked, length_m, start_m=None, least_m=_CLEARANCE_M, rng=rng)
        walk = drive_along(route, _PACE, rng)
        walkers.append(Walker(walk, float(rng.uniform(*_RADIUS_M)), float(rng.uniform(*_HEIGHT_M))))
    return tuple(walkers)
