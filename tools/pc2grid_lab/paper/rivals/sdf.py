"""Free-space features: global localization in distance function maps (Millane et al., IROS 2019).

The distance function D of a submap is the distance of every place to the nearest wall. Keypoints are the
places where D is strongly curved in two directions: peaks in the middle of rooms, saddles in doors, creases
in corners. A keypoint is described by the directions of D's gradient around it (SIFT's orientation
histograms) and by the mean of D, so that wide places do not match narrow ones. The similarity of two
submaps is the share of keypoints that one rigid motion, found by RANSAC, brings together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, I64, BoolGrid, cells_of
from pc2grid.model import Submap
from pc2grid_lab.paper.rivals import _kernels

_GRID, _ORIENTATIONS = 4, 8
"""SIFT's layout (Lowe 2004): 4 x 4 fields with 8 directions each."""

_DIRECTION_BINS = 36
"""Of the histogram in which a keypoint's own direction is found (Lowe 2004)."""

_LEAST_PAIR_M = 1.0
"""Two matches nearer to each other than this do not determine a rotation well enough; chosen by hand."""


class Features(NamedTuple):
    """Keypoints of a submap.

    places_m : (K, 2) x, y in the submap's own frame.
    descriptors : (K, 129): 128 orientation shares of length 1, then the weighted mean distance.
    """

    places_m: F32
    descriptors: F32


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceFeatures:
    """Parameters of the method; all but the first are chosen by hand.

    max_keypoints : the most curved ones are kept (200: paper IV-A).
    smooth_m : standard deviation of the Gaussian on D before it is differentiated, as creases have no
        finite curvature; and the step of the samples in a window.
    apart_m : a keypoint is the most curved place within this distance. Matched keypoints this near to each
        other after a motion agree with it.
    orient_m : radius in which the keypoint's own direction is found.
    window_m : half the width of the square that is described.
    distance_weight : of the mean distance in metres against the orientation part of length 1.
    iterations : pairs of matches that RANSAC tries for each submap.
    """

    max_keypoints: int = 200
    smooth_m: float = 0.1
    apart_m: float = 0.25
    orient_m: float = 1.0
    window_m: float = 1.2
    distance_weight: float = 0.5
    iterations: int = 400

    def fit(self, submaps: Sequence[Submap]) -> _FeatureTable:
        """Find and describe the keypoints of every submap."""
        features = [self.features(submap) for submap in submaps]
        descriptors = np.concatenate([f.descriptors for f in features])
        return _FeatureTable(
            self,
            np.concatenate([f.places_m for f in features]),
            -2 * descriptors,
            (descriptors**2).sum(axis=1),
            np.cumsum([0, *(len(f.places_m) for f in features)]),
        )

    def features(self, submap: Submap) -> Features:
        """Keypoints of a submap and their descriptors; none where nothing is occupied or curved."""
        resolution = submap.grid.resolution_m
        if not submap.grid.occupied.any() or min(submap.grid.cells.shape) < 3:
            return Features(np.empty((0, 2), np.float32), np.empty((0, 129), np.float32))
        distance = distance_function(submap, self.smooth_m)
        keypoints = self._keypoints(distance, submap)
        gradient_y, gradient_x = (np.asarray(g, np.float32) for g in np.gradient(distance, resolution))
        strength, turns = np.hypot(gradient_x, gradient_y), _turns(gradient_x, gradient_y)
        directions = _directions(keypoints, strength, turns, self.orient_m / resolution)
        step = self.smooth_m / resolution
        half = int(self.window_m / resolution / step)
        samples = _samples(keypoints, directions, distance.shape, half, step)
        shares = _orientation_shares(samples, directions, strength, turns, half)
        mean_m = _mean_distances(samples, distance)
        descriptors = np.column_stack((shares, self.distance_weight * mean_m)).astype(np.float32)
        return Features((keypoints[:, ::-1] * resolution).astype(np.float32), descriptors)

    def _keypoints(self, distance: F32, submap: Submap) -> I64:
        """Cells (K, 2) where |det Hessian of D| is a local maximum in known free space."""
        resolution = submap.grid.resolution_m
        dy, dx = np.gradient(distance, resolution)
        (dyy, dyx), (dxy, dxx) = np.gradient(dy, resolution), np.gradient(dx, resolution)
        curvature = np.abs(dxx * dyy - dxy * dyx).astype(np.float32)
        # Next to a wall the curvature is that of D's kink at the wall.
        curvature[~submap.grid.free | (distance < 2 * self.smooth_m)] = 0.0
        width = 2 * round(self.apart_m / resolution) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        peaks = (curvature > 0) & (curvature >= cv2.dilate(curvature, disc))
        cells = cells_of(peaks)
        best = np.argsort(-curvature[cells[:, 0], cells[:, 1]], kind="stable")[: self.max_keypoints]
        return cells[best]


def distance_function(submap: Submap, smooth_m: float) -> F32:
    """D (H, W) in metres: distance to the nearest occupied cell, smoothed; unknown cells are no walls."""
    resolution = submap.grid.resolution_m
    cells = cv2.distanceTransform((~submap.grid.occupied).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(cv2.GaussianBlur(cells, (0, 0), smooth_m / resolution) * resolution, np.float32)


@dataclass(frozen=True, slots=True)
class _FeatureTable:
    """places_m (D, 2), minus_twice (D, 129) of the descriptors b of all submaps: -2 b and |b|^2 (D,)."""

    method: DistanceFeatures
    places_m: F32
    minus_twice: F32
    squares: F32
    starts: I64

    def similarities(self, query: Submap) -> F64:
        wanted = self.method.features(query)
        n = len(self.starts) - 1
        if len(wanted.places_m) == 0 or len(self.places_m) == 0:
            return np.zeros(n)
        # |a - b|^2 without |a|^2, which is the same for every b and does not change which is the nearest.
        costs = wanted.descriptors @ self.minus_twice.T
        costs += self.squares
        inliers = _consensus(
            wanted.places_m,
            self.places_m,
            _nearest(costs, self.starts),
            self.method.apart_m,
            self.method.iterations,
        )
        # The larger number of keypoints, so that a submap with few is not similar to all that contain it.
        return np.asarray(inliers / np.maximum(len(wanted.places_m), np.diff(self.starts)))


def _turns(gx: F32, gy: F32) -> F64:
    """Directions (H, W) of a gradient as shares of a turn, 0 .. 1."""
    return np.asarray(np.arctan2(gy.astype(np.float64), gx) / (2 * math.pi) % 1.0)


def _directions(keypoints: I64, strength: F32, turns: F64, radius: float) -> F64:
    """Main direction (K,), radians, of the gradient (H, W) in the `radius` (cells) of keypoints (K, 2)."""
    bins, reach = _DIRECTION_BINS, int(radius)
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squared = (offsets**2).sum(axis=1)
    near = squared <= radius * radius
    falloff = np.exp(-2.0 * squared[near] / (radius * radius))
    rings = _kernels.ring_votes(keypoints, offsets[near], falloff, strength, turns, bins)
    smooth = np.roll(rings, 1, axis=1) + 2 * rings + np.roll(rings, -1, axis=1)
    peak = smooth.argmax(axis=1)
    before, at_peak, after = (smooth[np.arange(len(smooth)), (peak + k) % bins] for k in (-1, 0, 1))
    # The vertex of the parabola through the highest vote and its neighbours.
    bend = before - 2 * at_peak + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.asarray((peak + shift) * (2 * math.pi / bins))


def _samples(
    keypoints: I64, directions: F64, shape: tuple[int, ...], half: int, step: float
) -> tuple[I64, I64, BoolGrid]:
    """Cells (K, S) of the samples in a square around each keypoint, turned with it, as rows and columns, and
    whether they lie inside an image of a shape; those outside are moved to (0, 0).

    half : samples on either side of the keypoint. step : from one to the next, cells.
    """
    v, u = (axis.ravel() for axis in np.mgrid[-half : half + 1, -half : half + 1])
    c, s = np.cos(directions)[:, None], np.sin(directions)[:, None]
    rows = np.floor(keypoints[:, :1] + (s * u + c * v) * step + 0.5).astype(np.int64)
    columns = np.floor(keypoints[:, 1:] + (c * u - s * v) * step + 0.5).astype(np.int64)
    inside = (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
    return np.where(inside, rows, 0), np.where(inside, columns, 0), inside


def _mean_distances(samples: tuple[I64, I64, BoolGrid], distance: F32) -> F64:
    """Mean (K,) of D over the samples of each keypoint that lie inside the map."""
    rows, columns, inside = samples
    sums = (distance.astype(np.float64)[rows, columns] * inside).sum(axis=1)
    return np.asarray(sums / np.maximum(inside.sum(axis=1), 1))


def _orientation_shares(
    samples: tuple[I64, I64, BoolGrid], directions: F64, strength: F32, turns: F64, half: int
) -> F64:
    """Orientation histograms (K, 128) of length 1 on 4 x 4 fields that are turned with the keypoint.

    A sample counts in the nearest fields and directions by linear interpolation. All 0 where D does not
    change.
    """
    steps = np.arange(-half, half + 1)
    centers = (steps / (2 * half + 1) + 0.5) * _GRID - 0.5
    shares = np.maximum(0.0, 1.0 - np.abs(centers[:, None] - np.arange(_GRID)))
    fields = np.kron(shares, shares)  # (S, 16): how much each sample counts in each field
    falloff = np.exp(-0.5 * (steps[:, None] ** 2 + steps**2).ravel() / (half * half))
    own = directions / (2 * math.pi)
    parts = _kernels.direction_shares(*samples, own, falloff, strength, turns, _ORIENTATIONS)
    found = np.stack([part @ fields for part in parts], axis=-1)
    histograms = found.reshape(len(directions), _GRID * _GRID * _ORIENTATIONS)
    lengths = np.linalg.norm(histograms, axis=1, keepdims=True)
    return np.asarray(histograms / np.where(lengths > 0, lengths, 1.0))


def _nearest(costs: F32, starts: I64) -> I64:
    """For each submap the cheapest for each wanted keypoint (row), (N, K); -1 if the submap has none."""
    out = np.full((len(starts) - 1, len(costs)), -1, np.int64)
    for s, (start, stop) in enumerate(itertools.pairwise(starts.tolist())):
        if stop > start:
            out[s] = start + costs[:, start:stop].argmin(axis=1)
    return out


def _consensus(a: F32, b: F32, nearest: I64, inlier_m: float, iterations: int) -> I64:
    """RANSAC: for each submap the most matches a[m] ~ b[nearest[s, m]] that one rigid motion explains: (N,).

    a (M, 2), b (D, 2), nearest (N, M) : -1 where a submap has no keypoints. The motion follows from two
    matches; the same pairs are drawn on every call.
    """
    counts = np.zeros(len(nearest), np.int64)
    if len(a) < 2:
        return counts
    i, j = np.random.default_rng(0).integers(0, len(a), (2, iterations))
    # Points as complex numbers: the rotation is the quotient of the directions of both pairs.
    za, zb = (points[:, 0] + 1j * points[:, 1] for points in (a, b))
    matched = zb[nearest]
    length_a = np.hypot(*(a[j] - a[i]).T)
    length_b = np.hypot(*(b[nearest[:, j]] - b[nearest[:, i]]).transpose(2, 0, 1))
    # Pairs of different lengths do not follow from a rigid motion.
    usable = np.minimum(length_a, length_b) >= _LEAST_PAIR_M
    usable &= np.abs(length_a - length_b) <= 2 * inlier_m
    usable &= (nearest[:, 0] >= 0)[:, None]
    submap, pair = np.nonzero(usable)
    i, j = i[pair], j[pair]
    rotation = (matched[submap, j] - matched[submap, i]) * np.conj(za[j] - za[i])
    rotation /= np.abs(rotation)
    shift = (matched[submap, i] + matched[submap, j]) / 2 - rotation * (za[i] + za[j]) / 2
    _kernels.most_agreeing(za, matched, submap, rotation, shift, inlier_m, counts)
    return counts
