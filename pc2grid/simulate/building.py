"""A building to drive through: a floor plan, or a real one as a point cloud or a mesh.

A plan is extruded to walls of one height. Of a cloud the faces of its occupied voxels are what rays hit;
of a mesh, its triangles. For both the floor is found and levelled, and the robot drives where it was seen
and nothing stands on it (`pc2grid.mapping.cloud_map`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import MapFileError
from pc2grid.geometry import transform_points
from pc2grid.io.building_file import (
    building_points,
    is_building_file,
    kind_of,
    load_mesh,
    neighbour_distances_m,
    sampled,
)
from pc2grid.io.nav2_map import is_map_file, load_map
from pc2grid.mapping.cloud_map import check_plausible, drivable_plan, level_cloud, voxel_cloud
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.scene import Mesh, quads

_VOXEL_M = 0.05  # smallest voxel of a cloud that rays hit
# A voxel is at least this many median distances between neighbours wide, so that walls have few holes: if n
# random points lie on a square metre, this distance is 0.47 / sqrt(n) and 3 % of such voxels stay empty.
_SPACINGS = 4.0
_LATTICE = 1.01  # the points of a lattice are equally far from their neighbours, within 1 %


@dataclass(frozen=True, slots=True)
class Building:
    """A real building.

    plan : where the robot may drive, in the map frame. shell : what rays hit, in the same frame, with the
    floor at z = 0. T_map_file : (4, 4), the frame of the file in the map frame.
    """

    plan: OccupancyGrid
    shell: Mesh
    T_map_file: F64

    @staticmethod
    def of_cloud(points_m: NDArray[np.floating]) -> Building:
        """Of a cloud (N, 3) whose z axis points up. Raises MapFileError if it shows no floor."""
        points = np.asarray(points_m, np.float64)
        T_map_cloud = level_cloud(points)
        # The voxels follow the axes of the cloud, in which they may have been a lattice before.
        shell = _moved(voxel_faces(points, voxel_m(points)), T_map_cloud)
        return Building(drivable_plan(transform_points(T_map_cloud, points)), shell, T_map_cloud)

    @staticmethod
    def of_mesh(mesh: Mesh) -> Building:
        """Of a mesh whose z axis points up. Raises MapFileError if it shows no floor."""
        points = voxel_cloud(sampled(mesh.vertices_m.astype(np.float64), mesh.triangles.astype(np.int64)))
        T_map_mesh = level_cloud(points)
        plan = drivable_plan(transform_points(T_map_mesh, points))
        return Building(plan, _moved(mesh, T_map_mesh), T_map_mesh)


def load_building(path: str | Path) -> OccupancyGrid | Building:
    """Read a nav2 map, a cloud or a mesh. A .ply with triangles is a mesh.

    Raises MapFileError if the file cannot be read, or shows no floor.
    """
    path = Path(path)
    if is_map_file(path):
        return load_map(path)
    try:
        if is_building_file(path) and kind_of(path) == "mesh":
            vertices, triangles = load_mesh(path)
            check_plausible(vertices)
            return Building.of_mesh(Mesh(vertices.astype(np.float32), triangles.astype(np.uint32)))
        return Building.of_cloud(np.concatenate([np.empty((0, 3)), *building_points(path, ReadConfig())]))
    except MapFileError as error:
        if str(path) in error.message:
            raise
        raise MapFileError(f"{path}: {error.message}", hint=error.hint) from error


def voxel_m(points_m: F64) -> float:
    """Edge of the voxels in which a cloud (N, 3) is dense: 5 cm or more.

    The points of a lattice, such as the centres of the voxels of an octree, keep its spacing.
    """
    low, median, high = np.quantile(neighbour_distances_m(points_m), (0.1, 0.5, 0.9))
    lattice = low > 0.0 and high < _LATTICE * low
    return max(float(median) * (1.0 if lattice else _SPACINGS), _VOXEL_M)


def voxel_faces(points_m: F64, edge_m: float) -> Mesh:
    """The faces between an occupied voxel and an empty one. The first point's corner is on the lattice."""
    first = points_m.min(axis=0)
    voxels = np.rint((points_m - first) / edge_m).astype(np.int64) + 1
    occupied = np.zeros(voxels.max(axis=0) + 2, bool)
    occupied[tuple(voxels.T)] = True
    corners = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for side in (1, -1):
            faces = np.argwhere(occupied & ~np.roll(occupied, -side, axis=axis))
            corner = np.repeat(faces[:, None].astype(np.float64), 4, axis=1)
            corner[..., axis] += 0.5 * side
            corner[..., u] += (-0.5, 0.5, 0.5, -0.5)
            corner[..., v] += (-0.5, -0.5, 0.5, 0.5)
            corners.append(corner)
    return quads((np.concatenate(corners) - 1) * edge_m + first)


def _moved(mesh: Mesh, T: F64) -> Mesh:
    return Mesh(transform_points(T, mesh.vertices_m).astype(np.float32), mesh.triangles)
