"""Free-space features: global localization in distance function maps (Millane et al., IROS 2019).

The distance function D of a submap tells, of every place, how far the nearest wall is. Where it is strongly
curved in two directions (peaks in the middle of rooms, saddles in doors, creases in corners) are keypoints;
each is described by which way D falls around it (SIFT's orientation histograms over D's gradient) and by
how large D is on average, so that wide places do not match narrow ones. Two submaps are as alike as the
share of keypoints that one rigid motion, found by RANSAC, brings together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64
from pc2grid.model import F32, Submap
from pc2grid.skeleton import cells_of

I32 = NDArray[np.int32]

_GRID, _ORIENTATIONS = 4, 8  # SIFT's layout: 4 x 4 fields of 8 directions


class Features(NamedTuple):
    """Keypoints of a submap.

    places_m : (K, 2) x, y in the submap's own frame.
    descriptors : (K, 129): 128 orientation shares of length 1, then the weighted mean distance.
    """

    places_m: F32
    descriptors: F32


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceFeatures:
    """Parameters of the method.

    max_keypoints : the most curved ones are kept (200 in the letter's comparison).
    smooth_m : Gaussian on D before it is differentiated; D has creases, whose curvature is not finite.
    apart_m : a keypoint is the most curved place within this distance.
    orient_m : radius in which the keypoint's own direction is found.
    window_m : half the width of the square that is described.
    sample_m : step of the samples in it.
    distance_weight : of the mean distance in metres against the orientation part of length 1.
    inlier_m : matched keypoints this near after the motion agree with it.
    iterations : pairs of matches that RANSAC tries a submap.
    """

    max_keypoints: int = 200
    smooth_m: float = 0.1
    apart_m: float = 0.25
    orient_m: float = 1.0
    window_m: float = 1.2
    sample_m: float = 0.1
    distance_weight: float = 0.5
    inlier_m: float = 0.25
    iterations: int = 400

    def fit(self, submaps: Sequence[Submap]) -> _FeatureTable:
        """Find and describe the keypoints of every submap."""
        features = [self.features(submap) for submap in submaps]
        return _FeatureTable(
            self,
            np.concatenate([f.places_m for f in features]),
            np.concatenate([f.descriptors for f in features]),
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
        directions = _directions(keypoints, gradient_x, gradient_y, self.orient_m / resolution)
        descriptors = _descriptors(
            keypoints,
            directions,
            distance,
            gradient_x,
            gradient_y,
            self.window_m / resolution,
            self.sample_m / resolution,
            self.distance_weight,
        )
        return Features((keypoints[:, ::-1] * resolution).astype(np.float32), descriptors)

    def _keypoints(self, distance: F32, submap: Submap) -> NDArray[np.int64]:
        """Cells (K, 2) where |det Hessian of D| is a local maximum in known free space."""
        resolution = submap.grid.resolution_m
        dy, dx = np.gradient(distance, resolution)
        (dyy, dyx), (dxy, dxx) = np.gradient(dy, resolution), np.gradient(dx, resolution)
        curvature = np.abs(dxx * dyy - dxy * dyx).astype(np.float32)
        # Next to a wall D's own kink is all there is to see.
        curvature[~submap.grid.free | (distance < 2 * self.smooth_m)] = 0.0
        width = 2 * round(self.apart_m / resolution) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        peaks = (curvature > 0) & (curvature >= cv2.dilate(curvature, disc))
        cells = cells_of(peaks)
        best = np.argsort(-curvature[cells[:, 0], cells[:, 1]], kind="stable")[: self.max_keypoints]
        return cells[best]


def distance_function(submap: Submap, smooth_m: float) -> F32:
    """D (H, W) in metres: distance to the nearest occupied cell, smoothed; unknown counts as passable."""
    resolution = submap.grid.resolution_m
    cells = cv2.distanceTransform((~submap.grid.occupied).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(cv2.GaussianBlur(cells, (0, 0), smooth_m / resolution) * resolution, np.float32)


@dataclass(frozen=True, slots=True)
class _FeatureTable:
    method: DistanceFeatures
    places_m: F32
    descriptors: F32
    starts: NDArray[np.int64]

    def similarities(self, query: Submap) -> F64:
        wanted = self.method.features(query)
        n = len(self.starts) - 1
        if len(wanted.places_m) == 0 or len(self.places_m) == 0:
            return np.zeros(n)
        # |a - b|^2 without |a|^2, which does not change which b is nearest; added where it does matter.
        costs = (self.descriptors**2).sum(axis=1) - 2 * (wanted.descriptors @ self.descriptors.T)
        nearest = _nearest(costs, self.starts)
        inliers = np.array(
            [
                _consensus(
                    wanted.places_m[nearest[:, s] >= 0],
                    self.places_m[nearest[nearest[:, s] >= 0, s]],
                    self.method.inlier_m,
                    self.method.iterations,
                )
                for s in range(n)
            ]
        )
        # The larger of both counts: a bare submap must not look like everything it is a part of.
        return np.asarray(inliers / np.maximum(len(wanted.places_m), np.diff(self.starts)))


@numba.njit(cache=True)
def _directions(
    keypoints: NDArray[np.int64], gx: NDArray[np.float32], gy: NDArray[np.float32], radius: float
) -> NDArray[np.float64]:
    """Dominant direction of the gradient around each keypoint, radians (K,)."""
    bins = 36
    out = np.empty(len(keypoints))
    reach = int(radius)
    for i in range(len(keypoints)):
        votes = np.zeros(bins)
        r0, c0 = keypoints[i]
        for r in range(max(r0 - reach, 0), min(r0 + reach + 1, gx.shape[0])):
            for c in range(max(c0 - reach, 0), min(c0 + reach + 1, gx.shape[1])):
                d2 = (r - r0) ** 2 + (c - c0) ** 2
                if d2 <= radius * radius:
                    x, y = gx[r, c], gy[r, c]
                    weight = math.sqrt(x * x + y * y) * math.exp(-2.0 * d2 / (radius * radius))
                    turn = (math.atan2(y, x) / (2 * math.pi)) % 1.0 * bins
                    low = int(turn)
                    votes[low % bins] += weight * (1 - (turn - low))
                    votes[(low + 1) % bins] += weight * (turn - low)
        smooth = np.empty(bins)
        for k in range(bins):
            smooth[k] = votes[k - 1] + 2 * votes[k] + votes[(k + 1) % bins]
        k = int(np.argmax(smooth))
        before, at, after = smooth[k - 1], smooth[k], smooth[(k + 1) % bins]
        bend = before - 2 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
        out[i] = (k + shift) * 2 * math.pi / bins
    return out


@numba.njit(cache=True)
def _descriptors(
    keypoints: NDArray[np.int64],
    directions: NDArray[np.float64],
    distance: NDArray[np.float32],
    gx: NDArray[np.float32],
    gy: NDArray[np.float32],
    window: float,
    step: float,
    distance_weight: float,
) -> NDArray[np.float32]:
    """Orientation histograms on a 4 x 4 grid turned with the keypoint, and the mean distance: (K, 129)."""
    out = np.zeros((len(keypoints), _GRID * _GRID * _ORIENTATIONS + 1), np.float32)
    half = int(window / step)
    for i in range(len(keypoints)):
        c, s = math.cos(directions[i]), math.sin(directions[i])
        total, count = 0.0, 0
        for v in range(-half, half + 1):
            for u in range(-half, half + 1):
                row = math.floor(keypoints[i, 0] + (s * u + c * v) * step + 0.5)
                column = math.floor(keypoints[i, 1] + (c * u - s * v) * step + 0.5)
                if row < 0 or column < 0 or row >= distance.shape[0] or column >= distance.shape[1]:
                    continue
                total += distance[row, column]
                count += 1
                x, y = gx[row, column], gy[row, column]
                weight = math.sqrt(x * x + y * y) * math.exp(-0.5 * (u * u + v * v) / (half * half))
                field_u = (u / (2 * half + 1) + 0.5) * _GRID - 0.5
                field_v = (v / (2 * half + 1) + 0.5) * _GRID - 0.5
                turn = ((math.atan2(y, x) - directions[i]) / (2 * math.pi)) % 1.0 * _ORIENTATIONS
                iu, iv, io = math.floor(field_u), math.floor(field_v), int(turn)
                for a in range(2):
                    for b in range(2):
                        if 0 <= iu + a < _GRID and 0 <= iv + b < _GRID:
                            share = weight * (1 - abs(field_u - iu - a)) * (1 - abs(field_v - iv - b))
                            base = ((iv + b) * _GRID + iu + a) * _ORIENTATIONS
                            out[i, base + io % _ORIENTATIONS] += share * (1 - (turn - io))
                            out[i, base + (io + 1) % _ORIENTATIONS] += share * (turn - io)
        length = math.sqrt(np.sum(out[i] ** 2))
        if length > 0:
            out[i] /= length
        out[i, -1] = distance_weight * total / max(count, 1)
    return out


@numba.njit(cache=True)
def _nearest(costs: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each wanted keypoint (row) the cheapest of each submap, (K, N); -1 if the submap has none."""
    n = len(starts) - 1
    out = np.full((len(costs), n), -1, np.int64)
    for i in range(len(costs)):
        for s in range(n):
            best = np.float32(np.inf)
            for j in range(starts[s], starts[s + 1]):
                if costs[i, j] < best:
                    best = costs[i, j]
                    out[i, s] = j
    return out


@numba.njit(cache=True)
def _consensus(a: NDArray[np.float32], b: NDArray[np.float32], inlier_m: float, iterations: int) -> int:
    """RANSAC: the most matches a[i] ~ b[i] that one rigid motion of the plane explains."""
    n = len(a)
    if n < 2:
        return 0
    best = 0
    state = np.uint64(88172645463325252)  # xorshift: the same draws on every call
    for _ in range(iterations):
        state ^= state << np.uint64(13)
        state ^= state >> np.uint64(7)
        state ^= state << np.uint64(17)
        i = int((state >> np.uint64(8)) % np.uint64(n))
        j = int((state >> np.uint64(36)) % np.uint64(n))
        ax, ay = a[j, 0] - a[i, 0], a[j, 1] - a[i, 1]
        bx, by = b[j, 0] - b[i, 0], b[j, 1] - b[i, 1]
        length_a, length_b = math.sqrt(ax * ax + ay * ay), math.sqrt(bx * bx + by * by)
        # A pair close together says little of the turn; pairs of other length are no rigid motion.
        if length_a < 1.0 or length_b < 1.0 or abs(length_a - length_b) > 2 * inlier_m:
            continue
        scale = 1.0 / (length_a * length_b)
        c, s = (ax * bx + ay * by) * scale, (ax * by - ay * bx) * scale
        middle_ax, middle_ay = (a[i, 0] + a[j, 0]) / 2, (a[i, 1] + a[j, 1]) / 2
        middle_bx, middle_by = (b[i, 0] + b[j, 0]) / 2, (b[i, 1] + b[j, 1]) / 2
        count = 0
        for k in range(n):
            x, y = a[k, 0] - middle_ax, a[k, 1] - middle_ay
            ex = c * x - s * y + middle_bx - b[k, 0]
            ey = s * x + c * y + middle_by - b[k, 1]
            if ex * ex + ey * ey <= inlier_m * inlier_m:
                count += 1
        best = max(best, count)
    return best
