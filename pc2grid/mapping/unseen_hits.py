"""Hits of the scans between two keyframes in cells that the keyframe did not hit.

A robot that turns beside a door sees the wall behind it in a few scans only, and each beam meets another
spot. Keyframes alone leave holes in such walls, and keeping every scan would need memory in proportion to
the length of the recording. So of the scans in between only those hits are kept that fall into cells without
a hit since the keyframe.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2


class UnseenHits:
    """Collects these hits from one keyframe to the next.

    reach_m : hits farther from the keyframe, along x or y, are left out. cell_m : edge of a cell.
    """

    def __init__(self, reach_m: float, cell_m: float) -> None:
        self._cell_m = cell_m
        self._side = 2 * math.ceil(reach_m / cell_m)
        self._hit = np.zeros(self._side * self._side, np.bool_)  # cells with a hit since the keyframe
        self._found: list[F32] = []
        self._T_keyframe_session = SE2()

    def take(self) -> F32:
        """The hits found since the last keyframe, (N, 2) in its frame; each is returned once."""
        found = np.concatenate(self._found) if self._found else np.empty((0, 2), np.float32)
        self._found = []
        return found

    def restart(self, planar_scan: PlanarScan, T_session_base: SE2) -> None:
        """Begin with a new keyframe."""
        self._hit[:] = False
        self._T_keyframe_session = T_session_base.inverse()
        self._mark(planar_scan.hits_m.astype(np.float64))

    def add(self, planar_scan: PlanarScan, T_session_base: SE2) -> None:
        """Add a scan that is no keyframe."""
        hits_m = (self._T_keyframe_session @ T_session_base).apply(planar_scan.hits_m)
        new = self._mark(hits_m)
        if len(new):
            self._found.append(hits_m[new].astype(np.float32))

    def _mark(self, hits_m: F64) -> NDArray[np.intp]:
        """Mark the cells of hits (M, 2); returns the first hit of each cell that was not marked, in order."""
        cells = np.floor(hits_m / self._cell_m).astype(np.int64) + self._side // 2
        inside = np.flatnonzero(((cells >= 0) & (cells < self._side)).all(axis=1))
        flat = cells[inside, 1] * self._side + cells[inside, 0]
        unmarked = ~self._hit[flat]
        inside, flat = inside[unmarked], flat[unmarked]
        self._hit[flat] = True
        _, first = np.unique(flat, return_index=True)
        first_hits: NDArray[np.intp] = inside[np.sort(first)]
        return first_hits
