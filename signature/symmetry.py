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
from pc2grid.model import F32, BoolGrid
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
    width = 2 * math.ceil(3 * sigma) + 1
    crest = config.symmetry_peak * sigma * math.sqrt(2 * math.pi)
    image = cv2.GaussianBlur(
        edges.astype(np.float32) * np.float32(crest), (width, width), sigma, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(np.minimum(image, config.symmetry_peak), np.float32)


def reflection_score(cells: NDArray[np.integer], image: F32, axis_rad: float) -> float:
    """Eq. 5: mean of the blurred image at the mirror images of the boundary pixels.

    cells : (N, 2) as (row, column), mirrored at the line of direction `axis_rad` through the image's centre.
    The paper rotates the image until the axis is upright and flips it; mirroring the pixels and reading the
    blurred image between its cells is the same without resampling twice. Mirror images outside count 0.
    """
    if len(cells) == 0:
        return 0.0
    center = (np.array(image.shape) - 1) / 2
    rows, columns = (cells - center).T
    c, s = math.cos(2 * axis_rad), math.sin(2 * axis_rad)
    x = (c * columns + s * rows + center[1]).astype(np.float32)
    y = (s * columns - c * rows + center[0]).astype(np.float32)
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return float(values.mean())


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
