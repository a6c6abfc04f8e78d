"""Which way is up, by the walls that one scan shows.

A plane that slants, such as the back of a chair, may be taken for a floor. Walls are upright: the vertical is
the direction to which their normals are perpendicular.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.clouds.ground import Ground, find_ground
from pc2grid.clouds.level import LEVEL
from pc2grid.clouds.sampling import random_subset
from pc2grid.model import Scan
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class UprightParameters:
    """How the vertical is measured. Chosen by hand, on simulated scans of a 16-beam lidar.

    points, voxel_m, normals : so many of a scan are used, of these one a voxel, so that near walls count no
        more, and for so many of them a normal is estimated.
    neighbours : points of which a normal is estimated. squeeze : their heights count this many times when
        neighbours are looked for, so that they lie on several rings of a lidar.
    flatness : largest ratio of the variances across a surface and along its shorter side.
    breadth_m : least standard deviation along that side: points of a single ring have no normal.
    steepest_rad : normals nearer to the vertical than 90 degrees minus this are not of walls.
    scale : of the robust weight of a normal, sine of its angle with the horizontal.
    rounds : of reweighting.
    least_normals, least_share : with fewer normals, or with less weight on the second direction of walls,
        the vertical is not determined.
    side_share : weight, as a share of that of all normals, of the vertical being perpendicular to the y axis
        of the base, about which a hand turns a camera most. So one wall ahead, which shows the pitch, is
        enough.
    """

    points: int = 12_000
    voxel_m: float = 0.07
    normals: int = 700
    neighbours: int = 40
    squeeze: float = 0.4
    flatness: float = 0.05
    breadth_m: float = 0.12
    steepest_rad: float = math.radians(37.0)
    scale: float = 0.05
    rounds: int = 8
    least_normals: int = 30
    least_share: float = 0.05
    side_share: float = 0.0


UPRIGHT = UprightParameters()
CAMERA_UPRIGHT = UprightParameters(voxel_m=0.1, squeeze=0.7, side_share=0.1)
"""Of a depth camera. It sees small patches densely: with the voxels of a lidar, the neighbours of a point
span less than `breadth_m`. Chosen by hand; in a room by a phone (`depth/room`) 3 planes of 25, tilted by 14
to 27 degrees, are told from the floor by it."""


def level_floor(scan: Scan, points_m: NDArray[np.floating]) -> Ground | None:
    """The floor in the points (N, 3) of a scan, base frame; None if it shows none.

    What the walls of the scan do not stand on is no floor, but a slanting plane such as the back of a chair.
    """
    ground = find_ground(points_m, scan.T_base_sensor[:3, 3])
    if ground is None:
        return None
    parameters = CAMERA_UPRIGHT if SENSOR_MODELS[scan.sensor].narrow else UPRIGHT
    vertical = vertical_of(points_m, ground.normal, parameters)
    return ground if vertical is None or float(vertical @ ground.normal) > LEVEL.level else None


def vertical_of(
    points_m: NDArray[np.floating], guess: F64, parameters: UprightParameters = UPRIGHT
) -> F64 | None:
    """The vertical (3,), a unit vector that points up, by the walls in a scan; None if they do not show it.

    points_m : (N, 3) in the base frame, without the sensor's motion. guess : (3,) direction around which the
    vertical is looked for: the one that is perpendicular to most normals.
    """
    p, normals = parameters, _normals(points_m, parameters)
    walls = normals[np.abs(normals @ guess) < math.sin(p.steepest_rad)]
    if len(walls) < p.least_normals:
        return None
    vertical, spread, weight = guess, np.zeros(3), np.zeros(1)
    for _ in range(p.rounds):
        weight = (1.0 + ((walls @ vertical) / p.scale) ** 2) ** -2
        scatter = (walls * weight[:, None]).T @ walls
        scatter[1, 1] += p.side_share * weight.sum()
        spread, axes = np.linalg.eigh(scatter)
        vertical = axes[:, 0] if axes[:, 0] @ guess > 0.0 else -axes[:, 0]
    return vertical if spread[1] > p.least_share * float(weight.sum()) else None


def _normals(points_m: NDArray[np.floating], p: UprightParameters) -> F64:
    """Normals (K, 3) of flat surfaces."""
    from scipy.spatial import cKDTree

    points = points_m[random_subset(len(points_m), p.points)].astype(np.float64)
    _, first = np.unique(np.floor(points / p.voxel_m).astype(np.int64), axis=0, return_index=True)
    points = points[np.sort(first)]
    if len(points) < p.neighbours:
        return np.empty((0, 3))
    squeezed = points * (1.0, 1.0, p.squeeze)
    _, near = cKDTree(squeezed).query(squeezed[random_subset(len(points), p.normals)], k=p.neighbours)
    around = points[near]
    around -= around.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / p.neighbours)
    flat = (variances[:, 0] < p.flatness * variances[:, 1]) & (variances[:, 1] > p.breadth_m**2)
    normals: F64 = axes[flat, :, 0]
    return normals
