"""The steps of SDF and SURF where compiling pays. The tests compare them with plain forms in numpy: no bit of
a result differs."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64, I64, BoolGrid

C64 = NDArray[np.complex64]


@numba.njit(cache=True)
def ring_votes(keypoints: I64, offsets: I64, falloff: F64, strength: F32, turns: F64, bins: int) -> F64:
    """Votes (K, bins) of the gradient around keypoints (K, 2) on its direction, shared by two bins.

    offsets (S, 2), falloff (S,) : the cells around a keypoint, and their weights. strength, turns (H, W).
    """
    height, width = strength.shape
    lower, upper = np.zeros((len(keypoints), bins)), np.zeros((len(keypoints), bins))
    for k in range(len(keypoints)):
        for s in range(len(offsets)):
            row, column = keypoints[k, 0] + offsets[s, 0], keypoints[k, 1] + offsets[s, 1]
            if 0 <= row < height and 0 <= column < width:
                weight = strength[row, column] * falloff[s]
                turn = turns[row, column] * bins
                low = math.floor(turn)
                lower[k, low % bins] += weight * (1 - (turn - low))
                upper[k, (low + 1) % bins] += weight * (turn - low)
    return lower + upper


@numba.njit(cache=True)
def _remainder(value: float, size: float) -> float:
    """value % size as numpy has it, for a size that is a power of two."""
    while value >= size:
        value -= size
    while value <= -size:
        value += size
    return value + size if value < 0 else value


@numba.njit(cache=True)
def direction_shares(
    rows: I64,
    columns: I64,
    inside: BoolGrid,
    own: F64,
    falloff: F64,
    strength: F32,
    turns: F64,
    bins: int,
) -> F64:
    """What the samples (K, S) of K keypoints add to each of the directions, a power of two: (bins, K, S).

    own (K,) : directions of the keypoints, as shares of a turn, from which those of the samples are counted.
    """
    out = np.zeros((bins, *rows.shape))
    for k in range(rows.shape[0]):
        for s in range(rows.shape[1]):
            if inside[k, s]:
                row, column = rows[k, s], columns[k, s]
                weight = strength[row, column] * falloff[s]
                turn = _remainder(turns[row, column] - own[k], 1.0) * bins
                for at in (int(turn) % bins, (int(turn) + 1) % bins):
                    apart = abs(_remainder(turn - at + bins / 2, bins) - bins / 2)
                    out[at, k, s] = weight * max(0.0, 1.0 - apart)
    return out


@numba.njit(cache=True)
def most_agreeing(
    a: C64, b: C64, submap: I64, rotation: C64, shift: C64, inlier_m: float, counts: I64
) -> None:
    """The most of the matches a[m] ~ b[s, m] of each submap s that one of its motions explains.

    a (M,), b (N, M) : points as complex numbers. submap, rotation, shift (H,) : motions. counts (N,), in
    place. The product is rounded as numpy rounds it, whose processor adds to it before it rounds.
    """
    near = np.float32(inlier_m**2)
    for h in range(len(submap)):
        s = submap[h]
        r, t, count = rotation[h], shift[h], 0
        for m in range(len(a)):
            real = np.float32(np.float64(r.real) * a[m].real - np.float32(r.imag * a[m].imag))
            imag = np.float32(np.float64(r.real) * a[m].imag + np.float32(r.imag * a[m].real))
            x, y = real + t.real - b[s, m].real, imag + t.imag - b[s, m].imag
            count += x * x + y * y <= near
            if count + len(a) - 1 - m <= counts[s]:  # no more than another motion explains
                break
        counts[s] = max(counts[s], count)


@numba.njit(cache=True)
def haar(integral: F64, y: F64, x: F64, half: I64) -> tuple[F64, F64]:
    """Haar wavelets in x and y at places y, x (M, K), 2 * half (M or 1, K or 1) pixels wide: (M, K) each.

    They are 0 where the wavelet would leave the image.
    """
    height, width = integral.shape
    across, down = np.zeros(y.shape), np.zeros(y.shape)
    for m in range(y.shape[0]):
        for k in range(y.shape[1]):
            h = half[m if half.shape[0] > 1 else 0, k if half.shape[1] > 1 else 0]
            row, column = math.floor(y[m, k] + 0.5), math.floor(x[m, k] + 0.5)
            if row >= h and column >= h and row + h < height and column + h < width:
                # Integral image at the corners of the four quarters of the wavelet.
                top, middle, bottom = integral[row - h], integral[row], integral[row + h]
                west, east = column - h, column + h
                left = bottom[column] - top[column] - bottom[west] + top[west]
                right = bottom[east] - top[east] - bottom[column] + top[column]
                upper = middle[east] - top[east] - middle[west] + top[west]
                lower = bottom[east] - middle[east] - bottom[west] + middle[west]
                across[m, k], down[m, k] = right - left, lower - upper
    return across, down


@numba.njit(cache=True)
def sector_sums(angles: F64, dx: F64, dy: F64, sectors: int) -> F64:
    """Sums (sectors, 2, K) of wavelets (M, K) whose angles lie in each sector of 60 degrees."""
    sums = np.zeros((sectors, 2, angles.shape[1]))
    step = math.pi / (sectors / 2)
    for m in range(angles.shape[0]):
        for k in range(angles.shape[1]):
            # The sectors that begin less than 60 degrees before; with one more on either side, for rounding.
            last = math.floor((angles[m, k] + math.pi) / step)
            for back in range(-1, sectors // 6 + 2):
                sector = (last - back) % sectors
                ahead = angles[m, k] - (sector * math.pi / (sectors / 2) - math.pi)
                if 0 <= ahead < math.pi / 3 or ahead + 2 * math.pi < math.pi / 3:
                    sums[sector, 0, k] += dx[m, k]
                    sums[sector, 1, k] += dy[m, k]
    return sums
