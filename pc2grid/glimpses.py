"""What the scans between two keyframes saw, and no keyframe did.

A robot that turns by a door sees the wall behind it in a few scans, beam by beam at other places. Keyframes
alone leave holes in such walls; keeping every scan would cost memory without end. So of the scans in
between only those returns are kept that fall into cells where nothing has been seen since the keyframe.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pc2grid.geometry import SE2
from pc2grid.model import F32
from pc2grid.sweep import Sweep


class Glimpses:
    """Collects them, from one keyframe to the next.

    reach_m : returns farther from the keyframe are left out. cell_m : edge of a cell.
    """

    def __init__(self, reach_m: float, cell_m: float) -> None:
        self._cell_m = cell_m
        self._side = 2 * math.ceil(reach_m / cell_m)
        self._seen = np.zeros((self._side, self._side), np.bool_)
        self._found: list[F32] = []
        self._T_keyframe_map = SE2()

    def take(self) -> F32:
        """What was found since the last keyframe, (N, 2) in its frame, each point once."""
        found = np.concatenate(self._found) if self._found else np.empty((0, 2), np.float32)
        self._found = []
        return found

    def restart(self, sweep: Sweep, T_map_base: SE2) -> None:
        """A new keyframe."""
        self._seen = np.zeros((self._side, self._side), np.bool_)
        self._T_keyframe_map = T_map_base.inverse()
        _unseen(self._seen, sweep.hits_m.astype(np.float64), self._cell_m)

    def add(self, sweep: Sweep, T_map_base: SE2) -> None:
        """A scan that is no keyframe."""
        hits = (self._T_keyframe_map @ T_map_base).apply(sweep.hits_m)
        found = _unseen(self._seen, hits, self._cell_m)
        if len(found):
            self._found.append(found)


@njit(cache=True)
def _unseen(seen: NDArray[np.bool_], hits: NDArray[np.float64], cell_m: float) -> F32:
    """Marks the cells of hits (M, 2), and returns the hits in those that were not marked."""
    half = seen.shape[0] // 2
    found = np.empty((hits.shape[0], 2), dtype=np.float32)
    count = 0
    for k in range(hits.shape[0]):
        row, column = half + math.floor(hits[k, 1] / cell_m), half + math.floor(hits[k, 0] / cell_m)
        if 0 <= row < 2 * half and 0 <= column < 2 * half and not seen[row, column]:
            seen[row, column] = True
            found[count] = hits[k]
            count += 1
    return found[:count].copy()
