"""A floor plan as a mesh of walls, floor and ceiling, and casting rays into it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, BoolGrid, freeze
from pc2grid.model import OccupancyGrid


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in the map frame.

    vertices_m : (V, 3) float32. triangles : (T, 3) uint32, rows of `vertices_m`; seen from both sides.
    """

    vertices_m: F32
    triangles: NDArray[np.uint32]

    def __post_init__(self) -> None:
        freeze(self, "vertices_m", np.float32, (None, 3))
        freeze(self, "triangles", np.uint32, (None, 3))

    @staticmethod
    def join(meshes: Iterable[Mesh]) -> Mesh:
        """All of them as one."""
        parts = list(meshes)
        starts = np.cumsum([0] + [len(part.vertices_m) for part in parts])
        return Mesh(
            np.concatenate([np.empty((0, 3), np.float32), *(part.vertices_m for part in parts)]),
            np.concatenate(
                [
                    np.empty((0, 3), np.uint32),
                    *(part.triangles + np.uint32(s) for part, s in zip(parts, starts, strict=False)),
                ]
            ),
        )


def quads(corners_m: F64) -> Mesh:
    """Flat four-cornered faces (N, 4, 3), corners in order around each face."""
    first = 4 * np.arange(len(corners_m))[:, None]
    triangles = np.concatenate((first + np.array([0, 1, 2]), first + np.array([0, 2, 3])))
    return Mesh(corners_m.reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))


def prism(outline_m: F64, bottom_m: float, top_m: float) -> Mesh:
    """A convex outline (N, 2) between two heights, with lid and bottom."""
    n = len(outline_m)
    after = np.roll(outline_m, -1, axis=0)
    sides = np.empty((n, 4, 3))
    sides[:, 0, :2] = sides[:, 3, :2] = outline_m
    sides[:, 1, :2] = sides[:, 2, :2] = after
    sides[:, :2, 2], sides[:, 2:, 2] = bottom_m, top_m
    fan = np.column_stack((np.zeros(n - 2), np.arange(1, n - 1), np.arange(2, n))).astype(np.uint32)
    lids = [
        Mesh(np.column_stack((outline_m, np.full(n, z))).astype(np.float32), fan) for z in (bottom_m, top_m)
    ]
    return Mesh.join([quads(sides), *lids])


def _runs(mask: BoolGrid) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Maximal runs of True along the rows: row, first column, column after the last."""
    padded = np.pad(mask, ((0, 0), (1, 1)))
    rows, starts = np.nonzero(padded[:, 1:] & ~padded[:, :-1])
    _, ends = np.nonzero(~padded[:, 1:] & padded[:, :-1])
    return rows, starts, ends


def extrude(grid: OccupancyGrid, height_m: float) -> Mesh:
    """Walls where the grid is occupied, and a floor (z = 0) and ceiling over its whole extent.

    Faces are made only between an occupied and another cell, and faces in one line are joined: a building of
    a million cells has about ten thousand. Walls reach the ceiling, so they have no top. Unknown cells are
    empty.
    """
    solid = np.pad(grid.occupied, 1)
    along_x = _runs(solid[1:, 1:-1] != solid[:-1, 1:-1])
    along_y = _runs((solid[1:-1, 1:] != solid[1:-1, :-1]).T)
    lines = np.concatenate(
        (
            np.column_stack((along_x[1], along_x[0], along_x[2], along_x[0])),
            np.column_stack((along_y[0], along_y[1], along_y[0], along_y[2])),
        )
    )
    ends_m = lines.reshape(-1, 2, 2) * grid.resolution_m + np.array(grid.origin_m)
    walls = np.empty((len(lines), 4, 3))
    walls[:, :2, :2], walls[:, 2:, :2] = ends_m, ends_m[:, ::-1]
    walls[:, :2, 2], walls[:, 2:, 2] = 0.0, height_m
    (x0, y0), (h, w) = grid.origin_m, grid.cells.shape
    x1, y1 = x0 + w * grid.resolution_m, y0 + h * grid.resolution_m
    plates = np.array([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)] for z in (0.0, height_m)])
    return quads(np.concatenate((walls, plates)))


class Scene:
    """Casts rays into a mesh (Open3D RaycastingScene, Embree). The constructor loads Open3D."""

    def __init__(self, mesh: Mesh) -> None:
        from pc2grid.open3d_core import o3d

        tensor: Any = o3d.core.Tensor
        self._tensor = tensor
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        # Open3D's tensors need writable memory.
        self._scene.add_triangles(tensor(mesh.vertices_m.copy()), tensor(mesh.triangles.copy()))

    def cast(self, rays: F32) -> F32:
        """Rays (N, 6), origin in metres and direction, to (N,): multiples of the direction until the
        first hit, inf without one."""
        hits: F32 = self._scene.cast_rays(self._tensor.from_numpy(rays))["t_hit"].numpy()
        return hits
