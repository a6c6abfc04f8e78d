"""The space in which a robot can pass, and objects that may be placed in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from pc2grid.arrays import F32, F64, BoolGrid

_WINDOW_M = 1.2  # around an object, beyond the radius of the robot


def clearance_m(free: BoolGrid, resolution_m: float) -> F32:
    """Distance (H, W) from each cell's centre to the edge of the nearest cell that is not free, metres.

    Cells outside of the grid are not free.
    """
    return _distance_m(np.pad(free, 1), resolution_m)[1:-1, 1:-1]


def _distance_m(free: BoolGrid, resolution_m: float) -> F32:
    """The same without assuming anything outside of the grid."""
    cells = cv2.distanceTransform(free.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distance: F32 = np.maximum(cells - np.float32(0.5), 0).astype(np.float32) * np.float32(resolution_m)
    return distance


def outline_mask(outline_cells: F64, shape: tuple[int, int]) -> BoolGrid:
    """Cells of a grid that a convex outline (N, 2), as x and y in cells from the corner, touches."""
    shift = 6
    corners = np.round((outline_cells - 0.5) * (1 << shift)).astype(np.int32)
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, corners, 1, lineType=cv2.LINE_8, shift=shift)
    return mask.astype(bool)


class Passages:
    """Free space in which objects are placed so that it stays connected for a robot.

    free : (H, W) cells that are empty; changes with each object.
    reserved : (H, W) cells on which no object may be placed.
    """

    def __init__(self, free: BoolGrid, resolution_m: float, robot_m: float) -> None:
        self.free = free.copy()
        self.reserved: BoolGrid = np.zeros_like(self.free)
        self.resolution_m = resolution_m
        self.robot_m = robot_m
        self._passable = clearance_m(free, resolution_m) >= robot_m

    def reserve(self, cells: BoolGrid) -> None:
        """No object may be placed on these cells (H, W) from now on; they stay passable."""
        self.reserved |= cells

    def put(self, outline_cells: F64, *, overlap: bool = False) -> bool:
        """Place an object if it stands on free cells only and leaves every passage beside it open.

        outline_cells : (N, 2) convex outline, x and y in cells from the grid's corner.
        overlap : the object may reach into walls and other objects.

        The passable space in a window around the object must stay connected. This is stricter than
        connectivity of the whole building: a corridor is not blocked even if there is another way.
        """
        margin = int(np.ceil((self.robot_m + _WINDOW_M) / self.resolution_m))
        low = np.floor(outline_cells.min(axis=0)).astype(int) - margin
        high = np.ceil(outline_cells.max(axis=0)).astype(int) + margin
        height, width = self.free.shape
        c0, r0 = (int(v) for v in np.maximum(low, 0))
        c1, r1 = min(int(high[0]), width), min(int(high[1]), height)
        if r0 >= r1 or c0 >= c1 or (outline_cells < 0).any() or (outline_cells > (width, height)).any():
            return False
        window = np.s_[r0:r1, c0:c1]
        mask = outline_mask(outline_cells - (c0, r0), (r1 - r0, c1 - c0))
        distance = _distance_m(~mask, self.resolution_m)
        if (mask & self.reserved[window]).any() or not (overlap or self.free[window][mask].all()):
            return False
        before = self._passable[window]
        after = before & (distance >= self.robot_m)
        eight = np.ones((3, 3), bool)
        parts, count_before = ndimage.label(before, eight)
        _, count_after = ndimage.label(after, eight)
        kept: NDArray[np.int64] = np.unique(parts[after])
        if count_after != count_before or len(kept) != count_before:
            return False
        self.free[window] &= ~mask
        self._passable[window] = after
        return True
