"""Glass and mirrors: rays that pass, return partly, or are reflected.

A lidar sees glass only where it looks at it nearly at a right angle; elsewhere nearly all of its light
passes (Foster, Sun, Park, Kuipers: VisAGGE, ICRA 2013). A mirror shows the room a second time, behind it.
"""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F32, U8
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.scene import Scene
from pc2grid_lab.worlds.change import GLASS, MIRROR

_SEEN_COS = math.cos(math.radians(5.0))  # glass is seen within this of its normal
_HEIGHT_M = (0.05, 2.1)  # of a pane above the floor
_THICK_M, _STEP_M = 0.6, 0.05  # walls up to so thick are passed; step of the search for their far side
_INTO_M = 0.02  # a hit is looked up so far behind the surface, in the cell of the wall
_OFF_M = 1e-3  # a reflected ray starts so far in front of the mirror, so that it does not hit it again


class Panes:
    """Casts rays into a scene, in which some of the walls are glass or mirrors."""

    def __init__(self, scene: Scene, plan: OccupancyGrid, kind: U8, glass_return: float) -> None:
        """kind : (H, W) GLASS, MIRROR or 0 for each cell of the plan. glass_return : share of the rays that
        glass returns where it is not met at a right angle."""
        self._scene, self._plan, self._kind, self._glass_return = scene, plan, kind, glass_return

    def cast(self, rays: F32, rng: np.random.Generator) -> F32:
        """As `Scene.cast`; a ray passes one pane or is reflected once."""
        hits, normals = self._scene.cast_with_normals(rays)
        distances: F32 = hits.copy()
        kind = self._kind_at(rays, hits)
        direction = rays[:, 3:]
        cosine = np.abs((direction * normals).sum(axis=1)) / np.linalg.norm(direction, axis=1)
        passes = (kind == GLASS) & (cosine < _SEEN_COS) & (rng.random(len(rays)) >= self._glass_return)
        for chosen, onward in ((passes, self._passed), (kind == MIRROR, self._reflected)):
            k = np.flatnonzero(chosen)
            if len(k):
                distances[k] = onward(rays[k], hits[k], normals[k])
        return distances

    def _kind_at(self, rays: F32, hits: F32) -> U8:
        """What each ray hits (N,)."""
        found = np.zeros(len(rays), np.uint8)
        k = np.flatnonzero(np.isfinite(hits))
        across = np.maximum(np.linalg.norm(rays[k, 3:5], axis=1), 1e-6)
        height = rays[k, 2] + hits[k] * rays[k, 5]
        found[k] = self._look_up(rays[k], hits[k] + _INTO_M / across)
        found[k[(height < _HEIGHT_M[0]) | (height > _HEIGHT_M[1])]] = 0
        return found

    def _look_up(self, rays: F32, t: F32) -> U8:
        """The kind of the cell (N,) at a multiple (N,) of each ray's direction; 0 outside of the plan."""
        cells = self._plan.to_cell((rays[:, :2] + t[:, None] * rays[:, 3:5]).astype(np.float64))
        inside = np.all((cells >= 0) & (cells < self._kind.shape), axis=1)
        found = np.zeros(len(rays), np.uint8)
        found[inside] = self._kind[cells[inside, 0], cells[inside, 1]]
        return found

    def _passed(self, rays: F32, hits: F32, normals: F32) -> F32:
        """Distances of rays that go on behind the pane; inf where the wall does not end."""
        step = _STEP_M / np.maximum(np.linalg.norm(rays[:, 3:5], axis=1), 1e-6)
        far = hits + step
        inside = np.ones(len(rays), bool)
        for _ in range(round(_THICK_M / _STEP_M)):
            inside &= self._look_up(rays, far) == GLASS
            far = np.where(inside, far + step, far).astype(np.float32)
        onward = rays.copy()
        onward[:, :3] += far[:, None] * rays[:, 3:]
        distances = far + self._scene.cast(onward)
        return np.where(inside, np.float32(np.inf), distances).astype(np.float32)

    def _reflected(self, rays: F32, hits: F32, normals: F32) -> F32:
        """Distances along the reflected rays, which the sensor takes for straight ones."""
        direction = rays[:, 3:]
        along = (direction * normals).sum(axis=1)[:, None]
        reflected = rays.copy()
        reflected[:, 3:] = direction - 2 * along * normals
        reflected[:, :3] += hits[:, None] * direction - _OFF_M * np.sign(along) * normals
        distances: F32 = (hits + self._scene.cast(reflected)).astype(np.float32)
        return distances
