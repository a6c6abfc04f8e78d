"""One point cloud of a building, for example a terrestrial scan, becomes an occupancy grid.

The floor is found and levelled. A cell is free where the floor was seen and nothing stands on it at the
heights that a robot passes through, and occupied where something does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.clouds.ground import Ground, find_ground
from pc2grid.errors import MapFileError
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudMapParameters:
    """How a cloud becomes a grid. Chosen by hand; tried on a 3D scan of an office floor with 5 cm voxels.

    resolution_m : edge of a cell, and of the voxels in which points are counted, so that a dense cloud
        gives the same grid as a thin one.
    floor_m : points this near to the floor plane are floor. A floor is uneven by some centimetres over a
        whole storey.
    refine_m : RANSAC tolerance when the plane is fitted to all points near the floor.
    passage_m : lowest and highest height above the floor at which an obstacle blocks a robot.
    obstacle_voxels : a cell is occupied if at least this many voxels above it are; one alone may be noise.
    gap_m : gaps of the seen floor up to this wide are closed.
    margin_m : width of the unknown border around the cloud.
    max_cells : larger grids are refused, since a few stray points would make them.
    """

    resolution_m: float = 0.05
    floor_m: float = 0.15
    refine_m: float = 0.05
    passage_m: tuple[float, float] = (0.2, 1.6)
    obstacle_voxels: int = 2
    gap_m: float = 0.2
    margin_m: float = 0.5
    max_cells: int = 100_000_000


CLOUD_MAP = CloudMapParameters()


def level_cloud(points_m: NDArray[np.floating], parameters: CloudMapParameters = CLOUD_MAP) -> F64:
    """Return T_level_cloud (4, 4): it makes the floor of a cloud (N, 3) level and puts it at z = 0.

    x and y stay as they are but for the small tilt. The z axis of the cloud must point up within 35
    degrees. Of several storeys the lowest is taken.

    Raises MapFileError if the cloud shows no floor.
    """
    points = np.asarray(points_m, np.float64)
    middle = np.append(points[:, :2].mean(axis=0), np.median(points[:, 2])) if len(points) else np.zeros(3)
    ground = find_ground(points, middle)
    if ground is None:
        raise MapFileError(
            "the cloud shows no floor: no large level plane lies below its other points",
            hint="its z axis must point up; cut off what lies below the floor",
        )
    ground = _refined(points, ground, parameters)
    T_level_cloud = ground.leveling()
    T_level_cloud[2, 3] += ground.offset_m
    return T_level_cloud


def _refined(points: F64, ground: Ground, p: CloudMapParameters) -> Ground:
    """The ground fitted to all points near it; `find_ground` uses a small sample."""
    import open3d as o3d

    near = points[np.abs(ground.heights(points)) < p.floor_m]
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(near))
    model, _ = cloud.segment_plane(p.refine_m, 3, 1000, probability=1.0)
    plane: F64 = np.asarray(model) / np.linalg.norm(model[:3])
    if plane[:3] @ ground.normal < 0.0:
        plane = -plane
    return Ground(plane[:3], float(plane[3]), ground.ceiling_m)


def map_cloud(
    level_points_m: NDArray[np.floating], parameters: CloudMapParameters = CLOUD_MAP
) -> OccupancyGrid:
    """Draw the occupancy grid of a levelled cloud (N, 3), whose floor is at z = 0.

    The grid has the x and y axes of the cloud. Raises MapFileError if the cloud is too large for a grid.

    >>> import numpy as np
    >>> floor = np.mgrid[0:4:0.05, 0:3:0.05, 0:1].reshape(3, -1).T
    >>> wall = np.mgrid[0:4:0.05, 3:3.05:0.05, 0:2:0.05].reshape(3, -1).T
    >>> grid = map_cloud(np.concatenate((floor, wall)))
    >>> bool(grid.free.any()), bool(grid.occupied.any())
    (True, True)
    """
    import cv2

    p = parameters
    voxels = _voxels(np.asarray(level_points_m, np.float64), p)
    if not len(voxels):
        raise MapFileError("the cloud has no points near its floor")
    low = voxels[:, :2].min(axis=0)
    columns, rows = (int(v) for v in voxels[:, :2].max(axis=0) - low + 1)
    margin = round(p.margin_m / p.resolution_m)
    shape = (rows + 2 * margin, columns + 2 * margin)
    if shape[0] * shape[1] > p.max_cells:
        raise MapFileError(
            f"the cloud is {columns * p.resolution_m:.0f} x {rows * p.resolution_m:.0f} m large",
            hint="remove stray points from it",
        )
    cell = (voxels[:, 1] - low[1] + margin) * shape[1] + voxels[:, 0] - low[0] + margin
    height_m = (voxels[:, 2] + 0.5) * p.resolution_m

    def counts(chosen: NDArray[np.bool_]) -> I64:
        return np.bincount(cell[chosen], minlength=shape[0] * shape[1]).reshape(shape)

    floor = (counts(np.abs(height_m) < p.floor_m) > 0).astype(np.uint8)
    side = 2 * round(p.gap_m / p.resolution_m / 2) + 1
    floor = cv2.morphologyEx(floor, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)).astype(np.uint8)
    obstacles = counts((height_m > p.passage_m[0]) & (height_m < p.passage_m[1]))
    cells = np.full(shape, UNKNOWN, np.int8)
    cells[floor > 0] = FREE
    cells[obstacles >= p.obstacle_voxels] = OCCUPIED
    corner = (low - margin) * p.resolution_m
    return OccupancyGrid(
        cells=cells, resolution_m=p.resolution_m, origin_m=(float(corner[0]), float(corner[1]))
    )


def _voxels(points: F64, p: CloudMapParameters) -> I64:
    """Indices (V, 3) of the voxels that hold points and matter to a robot, each once."""
    chosen = points[(points[:, 2] > -p.floor_m) & (points[:, 2] < p.passage_m[1])]
    voxels: I64 = np.unique(np.floor(chosen / p.resolution_m).astype(np.int64), axis=0)
    return voxels
