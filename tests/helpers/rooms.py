"""Small maps with known shapes, for the tests of partition and signatures."""

import cv2
import numpy as np

from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, Submap
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import view_at

RESOLUTION_M = 0.05
"""Edge of a cell, as in the default settings. Bounds on positions are whole cells: a map shows no less, and
two sensors, or a map and the truth, may differ by the cell that each rounds to and one of noise."""


def canvas(size_m: float = 16.05) -> np.ndarray:
    n = round(size_m / RESOLUTION_M)
    return np.full((n, n), UNKNOWN, np.int8)


def grid_of(cells: np.ndarray) -> OccupancyGrid:
    """Cells as a grid whose centre is the map's (0, 0)."""
    half = np.array(cells.shape) / 2 * RESOLUTION_M
    return OccupancyGrid(cells=cells, resolution_m=RESOLUTION_M, origin_m=(-half[1], -half[0]))


def submap_of(cells: np.ndarray, radius_m: float = 8.0) -> Submap:
    return view_at(grid_of(cells), (0.0, 0.0), PartitionConfig.paper(radius_m))


def polygon(points_m: list[tuple[float, float]], cells: np.ndarray | None = None) -> np.ndarray:
    """A room inside walls one cell wide along a polygon around the centre."""
    cells = canvas() if cells is None else cells
    image = cells.astype(np.int16)
    corners = np.array(points_m) / RESOLUTION_M + (np.array(cells.shape[::-1]) - 1) / 2
    outline = np.rint(corners).astype(np.int32).reshape(-1, 1, 2)
    cv2.fillPoly(image, [outline], FREE)
    cv2.polylines(image, [outline], isClosed=True, color=OCCUPIED)
    return image.astype(np.int8)


def rectangle(width_m: float, height_m: float) -> np.ndarray:
    w, h = width_m / 2, height_m / 2
    return polygon([(-w, -h), (w, -h), (w, h), (-w, h)])


def disc(radius_m: float) -> np.ndarray:
    turns = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    return polygon([(radius_m * np.cos(t), radius_m * np.sin(t)) for t in turns])


def cross(arm_m: float, width_m: float) -> np.ndarray:
    a, w = arm_m, width_m / 2
    right, down, left = [(w, w), (a, w), (a, -w), (w, -w)], [(w, -a), (-w, -a)], [(-w, -w), (-a, -w), (-a, w)]
    return polygon([*right, *down, *left, (-w, w), (-w, a), (w, a)])


def l_shape() -> np.ndarray:
    return polygon([(-5, -5), (5, -5), (5, -1.5), (-1, -1.5), (-1, 4), (-5, 4)])


def random_rooms(seed: int, walls: int = 6) -> np.ndarray:
    """A room with walls and boxes at random places."""
    rng = np.random.default_rng(seed)
    cells = rectangle(rng.uniform(6, 14), rng.uniform(6, 14)).astype(np.int16)
    n = cells.shape[0]
    for _ in range(walls):
        r, c = rng.integers(40, n - 40, 2)
        length = int(rng.integers(10, 100))
        if rng.random() < 0.5:
            cells[r, c : c + length] = OCCUPIED
        else:
            cells[r : r + length, c] = OCCUPIED
    for _ in range(3):
        r, c = rng.integers(40, n - 40, 2)
        cells[r : r + 10, c : c + 10] = OCCUPIED
    return cells.astype(np.int8)


def degenerate() -> dict[str, Submap]:
    one_occupied, one_free, two = canvas(), canvas(), canvas()
    one_occupied[160, 160] = OCCUPIED
    one_free[160, 160] = FREE
    two[160, 160] = two[160, 180] = OCCUPIED
    n = canvas().shape
    tiny = OccupancyGrid(
        cells=np.full((1, 1), OCCUPIED, np.int8), resolution_m=RESOLUTION_M, origin_m=(0.0, 0.0)
    )
    return {
        "free": submap_of(np.full(n, FREE, np.int8)),
        "occupied": submap_of(np.full(n, OCCUPIED, np.int8)),
        "unknown": submap_of(canvas()),
        "one occupied cell": submap_of(one_occupied),
        "one free cell": submap_of(one_free),
        "two occupied cells": submap_of(two),
        "a grid of one cell": Submap(submap_id=0, center_m=(0.0, 0.0), radius_m=8.0, grid=tiny),
    }


def small_house() -> OccupancyGrid:
    """8 m x 6 m, three rooms."""
    cells = np.zeros((120, 160), np.int8)
    cells[:3], cells[-3:], cells[:, :3], cells[:, -3:] = 100, 100, 100, 100
    cells[58:61, :70], cells[58:61, 85:], cells[:40, 100:103] = 100, 100, 100
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-2.0, -3.0))
