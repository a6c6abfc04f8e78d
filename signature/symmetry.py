"""Reflection symmetry scores: how well the walls fall onto their own mirror image (paper III-D)."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, I64, BoolGrid
from pc2grid.skeleton import cells_of
from signature.config import SignatureConfig


class Axes(NamedTuple):
    """Directions of the two symmetry axes, radians in [0, pi) from the x axis towards y."""

    alpha_rad: float
    beta_rad: float


def line_segments(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F64:
    """Line segments L^S longer than lambda_theta (III-D 1), (N, 4) as column, row of both ends, cells.

    OpenCV's probabilistic Hough transform; its random order is seeded alike on every call.
    """
    segments = cv2.HoughLinesP(
        edges.view(np.uint8),
        1.0,
        math.radians(config.segment_step_deg),
        config.segment_votes,
        minLineLength=config.segment_min_m / resolution_m,
        maxLineGap=config.segment_gap_m / resolution_m,
    )
    return np.empty((0, 4)) if segments is None else segments.reshape(-1, 4).astype(np.float64)


def symmetry_axes(segments: F64, config: SignatureConfig) -> Axes | None:
    """The two directions most voted for (III-D 2); None without segments.

    A segment votes for its direction with its length, as it stands for that many pixels. Votes are blurred
    around the half circle; beta is the best at least `config.axis_separation_deg` from alpha, or alpha's
    perpendicular when no segment lies there.
    """
    if not len(segments):
        return None
    alpha, beta, found = _axes(
        segments,
        _blur(config.axis_smoothing_deg),
        config.axis_separation_deg,
        math.radians(2 * config.axis_smoothing_deg),
    )
    return Axes(alpha, beta) if found else None


@functools.cache
def _blur(sigma_deg: float) -> F64:
    """What a vote adds to the directions around it, (180,), from its own on."""
    apart = np.minimum(np.arange(180), 180 - np.arange(180))
    return np.asarray(np.exp(-0.5 * (apart / sigma_deg) ** 2), np.float64)


@numba.njit(cache=True)
def _axes(segments: F64, blur: F64, separation_deg: float, window_rad: float) -> tuple[float, float, bool]:
    """`symmetry_axes` as two angles, and whether there are any."""
    count = len(segments)
    angles, lengths, votes = np.empty(count), np.empty(count), np.zeros(180)
    for k in range(count):
        x, y = segments[k, 2] - segments[k, 0], segments[k, 3] - segments[k, 1]
        angles[k], lengths[k] = math.atan2(y, x) % math.pi, math.hypot(x, y)
        votes[round(math.degrees(angles[k])) % 180] += lengths[k]
    if lengths.sum() == 0.0:
        return 0.0, 0.0, False
    smooth = np.zeros(180)
    for d in range(180):
        if votes[d] > 0.0:
            smooth[d:] += votes[d] * blur[: 180 - d]
            smooth[:d] += votes[d] * blur[180 - d :]
    alpha = int(np.argmax(smooth))
    highest, beta = 1e-6 * smooth[alpha], (alpha + 90) % 180
    for d in range(180):
        apart = abs((d - alpha + 90) % 180 - 90)
        if apart >= separation_deg and smooth[d] > highest:
            highest, beta = smooth[d], d
    return (
        _refined(alpha, angles, lengths, window_rad),
        _refined(beta, angles, lengths, window_rad),
        True,
    )


@numba.njit(cache=True)
def _refined(peak_deg: int, angles: F64, lengths: F64, window_rad: float) -> float:
    """Mean direction of the segments within a window around a whole degree, finer than the vote.

    A segment's direction is the surer the longer it is: weights are squared lengths, inverse variances.
    """
    peak, shift, weight = math.radians(peak_deg), 0.0, 0.0
    for k in range(len(angles)):
        away = (angles[k] - peak + math.pi / 2) % math.pi - math.pi / 2
        if abs(away) <= window_rad:
            shift += away * lengths[k] ** 2
            weight += lengths[k] ** 2
    return (peak + (shift / weight if weight > 0.0 else 0.0)) % math.pi


def blurred(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F32:
    """S^G (H, W): the edge map under a Gaussian, scaled so that a straight line peaks at `symmetry_peak`."""
    sigma = config.symmetry_blur_m / resolution_m
    kernel = cv2.getGaussianKernel(2 * math.ceil(3 * sigma) + 1, sigma)[:, 0].astype(np.float32)
    crest = config.symmetry_peak * sigma * math.sqrt(2 * math.pi)
    return _blurred(cells_of(edges), edges.shape, kernel, np.float32(crest), np.float32(config.symmetry_peak))


@numba.njit(cache=True)
def _blurred(
    cells: I64, shape: tuple[int, int], kernel: F32, crest: np.float32, most: np.float32
) -> NDArray[np.float32]:
    """Cells (N, 2) of value `crest` under a separable, symmetric kernel (K,), at most `most`.

    Few cells are set: along the rows only they are worked on. What falls beyond the image is lost.
    """
    height, width = shape
    half, end = len(kernel) // 2, len(kernel) // 2 + width
    rows = np.zeros((height + 2 * half, width + 2 * half), np.float32)
    for p in range(len(cells)):
        r, c = cells[p, 0] + half, cells[p, 1]
        for k in range(len(kernel)):
            rows[r, c + k] += crest * kernel[k]
    image = np.empty((height, width), np.float32)
    for r in range(height):
        total, middle, last = image[r], rows[r + half, half:end], r + 2 * half
        for c in range(width):
            total[c] = kernel[half] * middle[c]
        k = 0
        while k + 3 <= half:  # three at a time: the sums stay in registers meanwhile
            w0, a0, b0 = kernel[k], rows[r + k, half:end], rows[last - k, half:end]
            w1, a1, b1 = kernel[k + 1], rows[r + k + 1, half:end], rows[last - k - 1, half:end]
            w2, a2, b2 = kernel[k + 2], rows[r + k + 2, half:end], rows[last - k - 2, half:end]
            for c in range(width):
                total[c] += w0 * (a0[c] + b0[c]) + w1 * (a1[c] + b1[c]) + w2 * (a2[c] + b2[c])
            k += 3
        for q in range(k, half):
            weight, above, below = kernel[q], rows[r + q, half:end], rows[last - q, half:end]
            for c in range(width):
                total[c] += weight * (above[c] + below[c])
        for c in range(width):
            total[c] = min(total[c], most)
    return image


def reflection_score(cells: I64, image: F32, axis_rad: float) -> float:
    """Eq. 5: mean of the blurred image at the mirror images of the boundary pixels.

    cells : (N, 2) as (row, column), mirrored at the line of direction `axis_rad` through the image's centre.
    The paper rotates the image until the axis is upright and flips it; mirroring the pixels and reading the
    blurred image between its cells is the same without resampling twice. Mirror images outside count 0.
    """
    return float(_reflected(cells, image, math.cos(2 * axis_rad), math.sin(2 * axis_rad)))


@numba.njit(cache=True)
def _reflected(cells: I64, image: F32, c: float, s: float) -> float:
    """`reflection_score` by cosine and sine of twice the axis' direction."""
    height, width = image.shape
    middle_r, middle_c, total = 0.5 * (height - 1), 0.5 * (width - 1), 0.0
    for p in range(len(cells)):
        row, column = cells[p, 0] - middle_r, cells[p, 1] - middle_c
        x, y = c * column + s * row + middle_c, s * column - c * row + middle_r
        i, j = math.floor(y), math.floor(x)
        a, b = x - j, y - i
        if 0 <= i < height - 1 and 0 <= j < width - 1:
            upper = (1.0 - a) * image[i, j] + a * image[i, j + 1]
            lower = (1.0 - a) * image[i + 1, j] + a * image[i + 1, j + 1]
            total += (1.0 - b) * upper + b * lower
        elif -1 <= i < height and -1 <= j < width:  # beside the image there is nothing
            for di, weight in ((0, 1.0 - b), (1, b)):
                for dj, share in ((0, 1.0 - a), (1, a)):
                    if 0 <= i + di < height and 0 <= j + dj < width:
                        total += weight * share * image[i + di, j + dj]
    return total / max(len(cells), 1)


def symmetry_scores(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F32:
    """Both reflection symmetry scores (s^alpha, s^beta), (2,), 0 .. `symmetry_peak` (III-D 3).

    Without any line segment there is no axis, and both are 0.
    """
    axes = symmetry_axes(line_segments(edges, resolution_m, config), config)
    if axes is None:
        return np.zeros(2, np.float32)
    image = blurred(edges, resolution_m, config)
    cells = cells_of(edges)
    return np.array([reflection_score(cells, image, axis) for axis in axes], np.float32)
