"""The two steps of this folder where compiling pays. The tests compare them with plain forms in numpy."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64
from pc2grid.model import OCCUPIED_FROM


@numba.njit(cache=True)
def thin_in_place(flat: NDArray[np.uint8], width: int, border: I64, deletable: NDArray[np.bool_]) -> None:
    """Thin a 0/1 image in place.

    In each half of an iteration all pixels are tested on the same image, and those that may go are deleted
    together. A pixel is tested again only if a neighbour of it has gone.

    flat : the image row by row, `width` pixels a row, with a border of zeros. border : indices of the set
    pixels that have a zero neighbour. deletable : (2, 256), by half of an iteration and neighbour code.

    Measured: 20 times as fast as the numpy form on a whole map (killian, 20 million cells: 0.12 against 2.6
    s) and 20 to 30 times on one submap (0.2 against 4 ms for its boundary, 0.16 against 5 ms for its free
    space), both of which every description needs.
    """
    steps = np.array([-width, 1 - width, 1, width + 1, width, width - 1, -1, -width - 1])
    # In how many halves of an iteration a pixel still has to be tested: two after a neighbour has gone.
    pending = np.zeros(len(flat), np.uint8)
    # One entry more than there are pixels: what is written behind the last one is not read.
    set_pixels = 0
    for i in range(len(flat)):
        set_pixels += flat[i]
    waiting, gone = np.empty(set_pixels + 1, np.int64), np.empty(set_pixels, np.int64)
    count = len(border)
    for k in range(count):
        waiting[k] = border[k]
        pending[border[k]] = 2
    half = 0
    while count > 0:
        left, losses = 0, 0
        for k in range(count):
            i = waiting[k]
            code = 0
            for n in range(8):
                code |= int(flat[i + steps[n]]) << n
            if deletable[half, code]:
                pending[i] = 0
                gone[losses] = i
                losses += 1
            else:
                pending[i] -= 1
                waiting[left] = i
                left += pending[i]
        count = left
        for k in range(losses):
            flat[gone[k]] = 0
        for k in range(losses):
            for n in range(8):
                j = gone[k] + steps[n]
                waiting[count] = j
                count += int((flat[j] != 0) & (pending[j] == 0))
                pending[j] = 2 * flat[j]
        half = 1 - half


@numba.njit(cache=True, nogil=True)
def cast_rays(
    cells: NDArray[np.int8], rows: F64, columns: F64, limit: float, bearings: int, patience: int
) -> tuple[F32, NDArray[np.int8]]:
    """Follow the rays of each place (N,) in steps of half a cell; all lengths in cells. Returns (N, B) each.

    cells : (H, W). rows, columns : (N,) where the rays start, in cells from the grid's corner. limit : length
    of a ray. patience : steps through unknown cells after which a ray is HIDDEN.

    Returns how far each ray is known to be free (or its wall), and how it ends.

    Measured: 20 times as fast as the numpy form at 78 places of fr079 (4 against 87 ms); every described view
    and every query casts rays.
    """
    height, width = cells.shape
    flat = np.ascontiguousarray(cells).reshape(-1)
    ranges = np.empty((len(rows), bearings), dtype=np.float32)
    ends = np.empty((len(rows), bearings), dtype=np.int8)
    step = 0.5
    for b in range(bearings):
        angle = 2.0 * np.pi * b / bearings
        dc, dr = np.cos(angle) * step, np.sin(angle) * step
        for n in range(len(rows)):
            r, c, length = rows[n], columns[n], 0.0
            end = 0
            known = 0.0
            unknown_run = 0
            while length < limit:
                r += dr
                c += dc
                length += step
                if not (0.0 <= r < height and 0.0 <= c < width):
                    end = -1
                    break
                value = flat[np.uint64(r) * np.uint64(width) + np.uint64(c)]
                if value >= OCCUPIED_FROM:
                    end = 1
                    known = length
                    break
                if value < 0:
                    unknown_run += 1
                    if unknown_run > patience:
                        end = -1
                        break
                else:
                    unknown_run = 0
                    known = length
            ranges[n, b] = known
            ends[n, b] = end
    return ranges, ends
