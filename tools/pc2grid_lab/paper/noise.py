"""Noise of the paper's experiments: mapping errors at walls, and objects in the free space (paper IV-B).

The paper gives the counts and Figure 8, not the sizes. These were chosen before any result was known, and are
not tuned: a person or a chair is half a metre wide, a speckle spreads over two cells of 0.05 m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from pc2grid.model import OCCUPIED, UNKNOWN, OccupancyGrid, Submap


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """How much noise of both kinds, and of which size.

    boundary : N_b, occupied cells around which speckles are put.
    freespace : N_f, unoccupied cells on which obstacles are put: the paper calls them so, and half or more of
        them are unknown. Its sentence is read as printed.
    speckles : number of occupied cells put around each of the N_b, with normally distributed offsets.
    speckle_sigma_m : standard deviation of these offsets, per axis.
    obstacle_m : r_n, radius of the circles and half the width of the squares; both are filled, and equally
        likely.
    """

    boundary: int
    freespace: int
    speckles: int = 10
    speckle_sigma_m: float = 0.1
    obstacle_m: float = 0.25


NOISE_LEVELS = (
    Noise(boundary=0, freespace=0),
    Noise(boundary=50, freespace=10),
    Noise(boundary=100, freespace=20),
)
"""No noise, level 1 and level 2 of Figure 8."""


def add_noise(submap: Submap, noise: Noise, rng: np.random.Generator) -> Submap:
    """The submap with noise inside its radius. Boundary noise needs occupied cells, free-space noise
    unoccupied ones.
    """
    grid = submap.grid
    image = np.ascontiguousarray(grid.cells).astype(np.int16)
    center = (np.array(image.shape) - 1) / 2
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    beyond = (rows - center[0]) ** 2 + (columns - center[1]) ** 2 > (submap.radius_m / grid.resolution_m) ** 2
    occupied, unoccupied = np.argwhere(grid.occupied), np.argwhere(~(grid.occupied | beyond))
    if noise.freespace and len(unoccupied):
        half = round(noise.obstacle_m / grid.resolution_m)
        for (row, column), circle in zip(
            unoccupied[rng.integers(len(unoccupied), size=noise.freespace)].tolist(),
            (rng.random(noise.freespace) < 0.5).tolist(),
            strict=True,
        ):
            if circle:
                cv2.circle(image, (column, row), half, OCCUPIED, cv2.FILLED)
            else:
                cv2.rectangle(
                    image, (column - half, row - half), (column + half, row + half), OCCUPIED, cv2.FILLED
                )
    if noise.boundary and len(occupied):
        at = occupied[rng.integers(len(occupied), size=noise.boundary)]
        spread = rng.normal(
            0.0, noise.speckle_sigma_m / grid.resolution_m, (noise.boundary, noise.speckles, 2)
        )
        cells = (at[:, None] + np.rint(spread).astype(np.int64)).reshape(-1, 2)
        cells = cells[((cells >= 0) & (cells < image.shape)).all(axis=1)]
        image[cells[:, 0], cells[:, 1]] = OCCUPIED
    image[beyond] = UNKNOWN
    noisy = OccupancyGrid(cells=image.astype(np.int8), resolution_m=grid.resolution_m, origin_m=grid.origin_m)
    return replace(submap, grid=noisy)
