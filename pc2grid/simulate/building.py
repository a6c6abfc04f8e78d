"""A building to drive through: a floor plan, or a real one as a point cloud or a mesh.

A plan is extruded to walls of one height. Of a cloud the faces of its occupied voxels are what rays hit;
of a mesh, its triangles. For both the floor is found and levelled, and the robot drives where it was seen
and nothing stands on it (`pc2grid.mapping.cloud_map`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.errors import MapFileError
from pc2grid.geometry import transform_points
from pc2grid.io.nav2_map import is_map_file, load_map
from pc2grid.mapping.cloud_map import level_cloud, map_cloud
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.scene import Mesh, quads

CLOUD_SUFFIXES = (".pcd", ".ply", ".xyz", ".pts")
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")

_VOXEL_M = 0.05  # smallest voxel of a cloud that rays hit
# A voxel is at least this many median distances between neighbours wide, so that walls have few holes: if n
# random points lie on a square metre, this distance is 0.47 / sqrt(n) and 3 % of such voxels stay empty.
_SPACINGS = 4.0
_LATTICE = 1.01  # the points of a lattice are equally far from their neighbours, within 1 %
_SPACING_SAMPLE = 2000  # points of which the spacing is measured
_SAMPLES_PER_M2, _MAX_SAMPLES = 1600.0, 4_000_000  # of the surface of a mesh, for its plan: one every 2.5 cm


@dataclass(frozen=True, slots=True)
class Building:
    """A real building.

    plan : where the robot may drive, in the map frame. shell : what rays hit, in the same frame, with the
    floor at z = 0.
    """

    plan: OccupancyGrid
    shell: Mesh

    @staticmethod
    def of_cloud(points_m: NDArray[np.floating]) -> Building:
        """Of a cloud (N, 3) whose z axis points up. Raises MapFileError if it shows no floor."""
        points = np.asarray(points_m, np.float64)
        T_map_cloud = level_cloud(points)
        # The voxels follow the axes of the cloud, in which they may have been a lattice before.
        shell = _moved(voxel_faces(points, voxel_m(points)), T_map_cloud)
        return Building(map_cloud(transform_points(T_map_cloud, points)), shell)

    @staticmethod
    def of_mesh(mesh: Mesh) -> Building:
        """Of a mesh whose z axis points up. Raises MapFileError if it shows no floor."""
        points = _sampled(mesh)
        T_map_mesh = level_cloud(points)
        return Building(map_cloud(transform_points(T_map_mesh, points)), _moved(mesh, T_map_mesh))


def load_building(path: str | Path) -> OccupancyGrid | Building:
    """Read a nav2 map, a cloud or a mesh. A .ply with triangles is a mesh.

    Raises MapFileError if the file cannot be read, or shows no floor.
    """
    path = Path(path)
    if is_map_file(path):
        return load_map(path)
    suffix = path.suffix.lower()
    if suffix not in (*CLOUD_SUFFIXES, *MESH_SUFFIXES):
        known = ", ".join(sorted({".yaml", *CLOUD_SUFFIXES, *MESH_SUFFIXES}))
        raise MapFileError(f"{path}: not a building that pc2grid reads", hint=f"known are {known}")
    if not path.is_file():
        raise MapFileError(f"{path}: no such file")
    try:
        mesh = _read_mesh(path) if suffix in MESH_SUFFIXES else None
        if mesh is not None:
            return Building.of_mesh(mesh)
        points = _read_points(path) if suffix in CLOUD_SUFFIXES else np.empty((0, 3))
        if not len(points):
            raise MapFileError("it holds neither points nor triangles")
        return Building.of_cloud(points)
    except MapFileError as error:
        raise MapFileError(f"{path}: {error.message}", hint=error.hint) from error


def _read_mesh(path: Path) -> Mesh | None:
    """The triangles of a file, None if it has none."""
    import open3d as o3d

    with _quietly():
        found = o3d.io.read_triangle_mesh(path)
    if not len(found.triangles):
        return None
    vertices_m = np.asarray(found.vertices)
    if not np.isfinite(vertices_m).all():
        raise MapFileError("a vertex is not a finite number")
    return Mesh(vertices_m.astype(np.float32), np.asarray(found.triangles).astype(np.uint32))


def _read_points(path: Path) -> F64:
    import open3d as o3d

    with _quietly():
        cloud = o3d.io.read_point_cloud(path, remove_nan_points=True, remove_infinite_points=True)
    return np.array(cloud.points)


def _quietly() -> Any:
    """Open3D prints a warning of its own for each file without triangles."""
    import open3d as o3d

    return o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)


def voxel_m(points_m: F64) -> float:
    """Edge of the voxels in which a cloud (N, 3) is dense: 5 cm or more.

    The points of a lattice, such as the centres of the voxels of an octree, keep its spacing.
    """
    from scipy.spatial import cKDTree

    sample = points_m[:: max(len(points_m) // _SPACING_SAMPLE, 1)]
    spacing = cKDTree(points_m).query(sample, k=2)[0][:, 1]
    low, median, high = np.quantile(spacing, (0.1, 0.5, 0.9))
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


def _sampled(mesh: Mesh) -> F64:
    """Points (N, 3) spread evenly over the triangles, the same in every run."""
    corners = mesh.vertices_m.astype(np.float64)[mesh.triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_m2 = np.linalg.norm(np.cross(a, b), axis=1) / 2
    total_m2 = float(area_m2.sum())
    count = int(min(total_m2 * _SAMPLES_PER_M2, _MAX_SAMPLES))
    if count == 0:
        raise MapFileError("its triangles have no area")
    rng = np.random.default_rng(0)
    chosen: I64 = rng.choice(len(area_m2), count, p=area_m2 / total_m2)
    u, v = rng.random((2, count, 1))
    flipped = u + v > 1
    u, v = np.where(flipped, 1 - u, u), np.where(flipped, 1 - v, v)
    points: F64 = corners[chosen, 0] + u * a[chosen] + v * b[chosen]
    return points
