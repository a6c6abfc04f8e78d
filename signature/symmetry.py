"""Reflection symmetry: how well the walls coincide with their own mirror image (paper III-D).

Of a submap, mirrored at its two main directions, and of what is seen from a viewpoint, whose ranges are
mirrored at every axis through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, I64, BoolGrid, cells_of
from pc2grid.submaps.junction_graph import ROUNDING
from pc2grid.submaps.submaps import HIDDEN
from signature.config import SignatureConfig

_DIRECTIONS = 180
"""Bins of the vote on directions, one a degree."""

MIRROR_M = 0.5
"""Two ranges that differ by this do not agree at all."""
FEW = 0.15
"""Added to the number of mirrored pairs, as a share of all rays, so that the agreement of few
pairs counts for less."""
BESIDE = ((0,), (0.5,), (0.25, 0.75), (0.125, -0.125), (0.375, -0.375))
"""Directions of mirror axes relative to the best one, as shares of half a circle; the mean of each group."""
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)


class Axes(NamedTuple):
    """Directions of the two symmetry axes, radians in [0, pi) from the x axis towards y."""

    alpha_rad: float
    beta_rad: float


def line_segments(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F64:
    """Return the line segments L^S longer than lambda_theta (III-D 1), (N, 4) as column, row of both ends,
    cells.

    By OpenCV's probabilistic Hough transform, which starts from the same random seed on every call.
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
    """Return the two directions with the most votes (III-D 2); None without segments.

    segments : (N, 4) as of `line_segments`. Beta is the best direction at least `config.axis_separation_deg`
    from alpha, or the perpendicular of alpha if no segment has such a direction.

    The paper does not say how the segments vote. By `config.axis_vote`, "length": a segment votes with its
    length, which is its number of pixels, the votes are blurred around the half circle, and an axis is the
    mean direction of the segments near its peak; "plain": a segment has one vote, and an axis is a whole
    degree.
    """
    from scipy.ndimage import gaussian_filter1d

    x, y = (segments[:, 2:] - segments[:, :2]).T
    angles_rad, lengths = np.arctan2(y, x) % math.pi, np.hypot(x, y)
    if lengths.sum() == 0.0:
        return None
    at = np.round(np.degrees(angles_rad)).astype(np.int64) % _DIRECTIONS
    plain = config.axis_vote == "plain"
    votes = np.bincount(at, weights=None if plain else lengths, minlength=_DIRECTIONS).astype(np.float64)
    if not plain:
        votes = gaussian_filter1d(votes, config.axis_smoothing_deg, mode="wrap", radius=_DIRECTIONS // 2 - 1)
    alpha = int(np.argmax(votes))
    apart = np.abs((np.arange(_DIRECTIONS) - alpha + 90) % _DIRECTIONS - 90)
    others = np.where(apart >= config.axis_separation_deg, votes, 0.0)
    beta = int(np.argmax(others))
    if others[beta] <= ROUNDING * votes[alpha]:  # which the blur leaves where no segment is
        beta = (alpha + 90) % _DIRECTIONS
    if plain:
        return Axes(math.radians(alpha), math.radians(beta))
    return Axes(*(_mean_direction(peak, angles_rad, lengths, config) for peak in (alpha, beta)))


def _mean_direction(peak_deg: int, angles_rad: F64, lengths: F64, config: SignatureConfig) -> float:
    """Return the mean direction, radians in [0, pi), of the segments near a peak of the vote.

    It is finer than the degrees of the vote. Near means within two standard deviations of the blur. The
    weights are the squared lengths, which are proportional to the inverse variances of the directions.
    """
    peak_rad = math.radians(peak_deg)
    away_rad = (angles_rad - peak_rad + math.pi / 2) % math.pi - math.pi / 2
    weights = np.where(np.abs(away_rad) <= math.radians(2 * config.axis_smoothing_deg), lengths**2, 0.0)
    total = float(weights.sum())
    return (peak_rad + (float(away_rad @ weights) / total if total > 0.0 else 0.0)) % math.pi


def blurred(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F32:
    """Return S^G (H, W): the edge map under a Gaussian, scaled so that a straight line peaks at
    `symmetry_peak`.

    With `config.symmetry_limited` values above the peak, where lines meet, are cut to it. The paper does not
    do so.
    """
    sigma = config.symmetry_blur_m / resolution_m
    size = 2 * math.ceil(3 * sigma) + 1
    crest = np.float32(config.symmetry_peak * sigma * math.sqrt(2 * math.pi))
    image = cv2.GaussianBlur(edges * crest, (size, size), sigma, borderType=cv2.BORDER_CONSTANT)
    most = np.float32(config.symmetry_peak if config.symmetry_limited else np.inf)
    return np.minimum(image, most, out=image)


def reflection_score(cells: I64, image: F32, axis_rad: float) -> float:
    """Return Eq. 5: the mean of the blurred image at the mirror images of the boundary pixels.

    cells : (N, 2) as (row, column); they are mirrored at the line with direction `axis_rad` through the
    centre of the image (H, W). The paper rotates the image until the axis is vertical and flips it. To mirror
    the pixels and interpolate the image is the same reflection, with one interpolation instead of two. The
    image is 0 outside its border.
    """
    from scipy.ndimage import map_coordinates

    if not len(cells):
        return 0.0
    c, s = math.cos(2 * axis_rad), math.sin(2 * axis_rad)
    middle = (np.array(image.shape) - 1.0) / 2.0
    mirrored = np.array([[-c, s], [s, c]]) @ (cells - middle).T + middle[:, None]
    return float(map_coordinates(image, mirrored, np.float64, order=1, mode="grid-constant").mean())


def symmetry_scores(edges: BoolGrid, resolution_m: float, config: SignatureConfig) -> F32:
    """Return both reflection symmetry scores (s^alpha, s^beta), (2,), 0 .. `symmetry_peak` if limited (III-D
    3).

    Without any line segment there is no axis, and both are 0.
    """
    axes = symmetry_axes(line_segments(edges, resolution_m, config), config)
    if axes is None:
        return np.zeros(2, np.float32)
    image = blurred(edges, resolution_m, config)
    cells = cells_of(edges)
    return np.array([reflection_score(cells, image, axis) for axis in axes], np.float32)


def symmetry_seen(ranges_m: F32, ends: NDArray[np.int8]) -> F64:
    """Return the symmetry of what is seen from N viewpoints: agreement, 0..1, with its mirror image and with
    half a turn.

    ranges_m, ends : (N, B) of isovists, B a multiple of 8. Returns (N, Ks). The mirror axes pass through the
    viewpoint, one every half ray. The columns: at the best axis, at those of `BESIDE` beside it (of the two
    diagonal ones the worse and the better), the mean of all, their quantiles, and the agreement after half a
    turn.
    """
    count, bearings = ranges_m.shape
    agreement = mirror_agreement(ranges_m, ends)
    best = agreement.argmax(axis=1)
    beside = [
        agreement[
            np.arange(count)[:, None],
            (best[:, None] + np.array([round(s * bearings) for s in axes])) % bearings,
        ]
        for axes in BESIDE
    ]
    diagonal = np.sort(beside[2], axis=1)
    columns = [beside[0], beside[1], diagonal, *(b.mean(axis=1, keepdims=True) for b in beside[3:])]
    columns += [agreement.mean(axis=1, keepdims=True), np.quantile(agreement, QUANTILES, axis=1).T]
    opposite = (np.arange(bearings) + bearings // 2) % bearings
    half_turn = _agreement(ranges_m, ends != HIDDEN, opposite)
    return np.concatenate([*columns, half_turn[:, None]], axis=1)


def mirror_agreement(ranges_m: F32, ends: NDArray[np.int8]) -> F64:
    """Return the agreement, 0..1, of the ranges with their mirror image at each axis through the viewpoint,
    (N, B); axis k lies pi k / B from the first ray."""
    rays, seen = np.arange(ranges_m.shape[1]), ends != HIDDEN
    at_each = [_agreement(ranges_m, seen, (axis - rays) % len(rays)) for axis in rays]
    return np.stack(at_each, axis=1)


def _agreement(ranges_m: F32, seen: NDArray[np.bool_], partner: NDArray[np.intp]) -> F64:
    """Return the mean agreement (N,) of each range with that of its partner (B,), where both are known."""
    both = seen & seen[:, partner]
    apart = np.abs(ranges_m - ranges_m[:, partner]) / MIRROR_M
    total = (np.maximum(0.0, 1.0 - apart) * both).sum(axis=1)
    return np.asarray(total / (both.sum(axis=1) + FEW * ranges_m.shape[1]))
