"""The axes of a building as a compass: most walls meet at right angles.

Loops tie a heading to the places that are seen twice. Along a corridor that is driven once nothing does, and
an error of one degree moves its far end by 1.7 m in 100 m. The walls themselves show the direction, as far as
the building is right-angled (the Manhattan world of Coughlan and Yuille, 1999; in a pose graph: Peasley et
al., "Accurate on-line 3D occupancy grids using Manhattan world constraints", 2012).

Each local map contributes the direction of its walls modulo 90 degrees, weakly and robustly: what a building
with other angles shows is either not concentrated (curved walls) or farther from the axes than the robust
scale (a wing at another angle), and loses its weight. The loops and the tracked steps, which are ten times
as exact, decide wherever they say anything.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.geometry import wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class AxesParameters:
    """Numbers of the constraint. They follow from what walls look like, and were not fitted.

    robust_rad : deviation from the axes at which a local map has a quarter of its weight: two to seven times
        that of real walls (`docs/method.md`).
    sigma_rad : standard deviation of the direction of one local map whose walls are all parallel to the axes.
        Local maps 4 m apart show the same walls up to 12 m ahead and behind: six of them are about one
        observation with 3 degrees, so that each alone counts as one with sqrt(6) times as much.
    rounds : in which the axes are found; outliers lose their weight in the first of them.
    """

    robust_rad: float = math.radians(3.0)
    sigma_rad: float = math.radians(7.0)
    rounds: int = 5


AXES = AxesParameters()


@dataclass(frozen=True, slots=True)
class WallDirection:
    """In which direction the walls of a local map run, modulo 90 degrees.

    direction_rad : in the frame of the local map, within 45 degrees of its x axis. concentration : 0 where
    all directions are as frequent, 1 where all walls are parallel or at right angles.
    """

    direction_rad: float
    concentration: float


def wall_direction(normal_rad: NDArray[np.floating]) -> WallDirection:
    """The direction of the walls with normals (N,); without a wall, of concentration 0."""
    if not len(normal_rad):
        return WallDirection(0.0, 0.0)
    # Four times an angle is the same for directions that differ by right angles.
    mean = np.exp(4j * np.asarray(normal_rad, np.float64)).mean()
    return WallDirection(float(np.angle(mean)) / 4.0, float(np.abs(mean)))


def pull_to_axes(
    yaw_rad: F64, walls: Sequence[WallDirection], parameters: AxesParameters = AXES
) -> tuple[F64, F64]:
    """How far the walls of local maps with headings (N,) deviate from the axes, and what that counts.

    Returns deviations (N,) in radians, within 45 degrees, by which the headings are too large, and their
    robust information (N,) in 1 / rad^2 (weights of Geman and McClure). The axes are those of the local maps
    themselves.
    """
    direction = np.array([wall.direction_rad for wall in walls]) + yaw_rad
    weight = np.array([wall.concentration for wall in walls]) ** 2
    axis_rad = float(np.angle((weight * np.exp(4j * direction)).sum())) / 4.0
    for _ in range(parameters.rounds):
        deviation = _from_axis(direction, axis_rad)
        robust = weight / (1.0 + (deviation / parameters.robust_rad) ** 2) ** 2
        axis_rad += float((robust * deviation).sum() / max(robust.sum(), np.finfo(float).tiny))
    return _from_axis(direction, axis_rad), robust / parameters.sigma_rad**2


def _from_axis(direction_rad: F64, axis_rad: float) -> F64:
    """Directions (N,) relative to the nearest axis, from -45 to 45 degrees."""
    return wrap_angle(4.0 * (direction_rad - axis_rad)) / 4.0
