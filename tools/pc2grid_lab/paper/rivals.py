"""The rivals of the paper (IV-A), and the free-space features of Millane et al.

Shape Context of a whole submap ("describes global shapes"): one log-polar histogram of the boundary around
the submap's centre, 24 angular and 12 radial bins (the descriptor of Belongie et al. 2002), compared by the
chi-square statistic in every of the 24 turns. The paper does not describe how it treats rotation.

Bags of visual words: SIFT or SURF features, at most 300 a submap, counted (BoW) or weighted by rarity
(TF-IDF). The 1024 words are learned from the submaps of the map itself. OpenCV's wheels do not contain SURF
(Bay et al. 2008). The detector of mahotas finds 96 % of its points again after half a turn of the image, but
its descriptors do not turn with the points: only 27 % of the points match themselves. So orientations and
descriptors are computed here, from Haar wavelets on the integral image as published.

Free-space features: global localization in distance function maps (Millane et al., IROS 2019). The distance
function D of a submap is the distance of every place to the nearest wall. Keypoints are the places where D is
strongly curved in two directions: peaks in the middle of rooms, saddles in doors, creases in corners. A
keypoint is described by the directions of D's gradient around it (SIFT's orientation histograms) and by the
mean of D, so that wide places do not match narrow ones. The similarity of two submaps is the share of
keypoints that one rigid motion, found by RANSAC, brings together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, I64, BoolGrid, cells_of
from pc2grid.libraries import compiled
from pc2grid.model import Submap
from pc2grid.submaps.junction_graph import thin


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeContext:
    """Bins as in the paper; rings grow by a constant factor from `inner_m`, chosen by hand, to the radius."""

    angular_bins: int = 24
    radial_bins: int = 12
    inner_m: float = 0.5

    def fit(self, submaps: Sequence[Submap]) -> _Shapes:
        """Describe every submap."""
        bins = (self.radial_bins, self.angular_bins)
        shapes = [self.context(submap) for submap in submaps]
        return _Shapes(self, np.stack(shapes) if shapes else np.empty((0, *bins), np.float32))

    def context(self, submap: Submap) -> F32:
        """Return the shares of the boundary pixels, (radial, angular); sum 1, or all 0 without any."""
        edges = thin(submap.grid.occupied)
        y, x = ((cells_of(edges) - (np.array(edges.shape) - 1) / 2) * submap.grid.resolution_m).T
        rings = np.geomspace(self.inner_m, submap.radius_m, self.radial_bins)
        ring = np.minimum(np.searchsorted(rings, np.hypot(x, y)), self.radial_bins - 1)
        turn = np.arctan2(y, x) / (2 * np.pi) % 1.0
        sector = (turn * self.angular_bins).astype(np.int64) % self.angular_bins
        counts = np.bincount(
            ring * self.angular_bins + sector, minlength=self.radial_bins * self.angular_bins
        )
        shares = counts.reshape(self.radial_bins, self.angular_bins) / max(len(x), 1)
        return np.asarray(shares, np.float32)


@dataclass(frozen=True, slots=True)
class _Shapes:
    method: ShapeContext
    table: F32

    def similarities(self, query: Submap) -> F64:
        shape = self.method.context(query)
        best = np.ones(len(self.table))
        for turn in range(shape.shape[1]):
            turned = np.roll(shape, turn, axis=1)
            total = self.table + turned
            terms = np.divide((self.table - turned) ** 2, total, out=np.zeros_like(total), where=total > 0)
            # An empty submap shares no bin with any other: its cost is the largest, 1.
            cost = 0.5 * terms.sum(axis=(1, 2)) if shape.any() else np.ones(len(self.table))
            best = np.minimum(best, np.where(self.table.any(axis=(1, 2)), cost, 1.0))
        return -best


_GRID, _ORIENTATIONS = 4, 8
"""SIFT's layout (Lowe 2004): 4 x 4 fields with 8 directions each."""

_DIRECTIONS = 36
"""Bins of the histogram in which a keypoint's own direction is found (Lowe 2004), and directions in which the
sector of 60 degrees of SURF is tried (by hand)."""

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
        """Return the keypoints of a submap and their descriptors; none where nothing is occupied or
        curved."""
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
        """Return the cells (K, 2) where |det Hessian of D| is a local maximum in known free space."""
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
    """Return D (H, W) in metres: the distance to the nearest occupied cell, smoothed; unknown cells are no
    walls."""
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
    """Return the directions (H, W) of a gradient as shares of a turn, 0 .. 1."""
    return np.asarray(np.arctan2(gy.astype(np.float64), gx) / (2 * math.pi) % 1.0)


def _directions(keypoints: I64, strength: F32, turns: F64, radius: float) -> F64:
    """Return the main direction (K,), radians, of the gradient (H, W) in the `radius` (cells) of keypoints
    (K, 2)."""
    bins, reach = _DIRECTIONS, int(radius)
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squared = (offsets**2).sum(axis=1)
    near = squared <= radius * radius
    falloff = np.exp(-2.0 * squared[near] / (radius * radius))
    rings = ring_votes(keypoints, offsets[near], falloff, strength, turns, bins)
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
    """Return the cells (K, S) of the samples in a square around each keypoint, turned with it, as rows and
    columns, and whether they lie inside an image of a shape; those outside are moved to (0, 0).

    half : samples on either side of the keypoint. step : from one to the next, cells.
    """
    v, u = (axis.ravel() for axis in np.mgrid[-half : half + 1, -half : half + 1])
    c, s = np.cos(directions)[:, None], np.sin(directions)[:, None]
    rows = np.floor(keypoints[:, :1] + (s * u + c * v) * step + 0.5).astype(np.int64)
    columns = np.floor(keypoints[:, 1:] + (c * u - s * v) * step + 0.5).astype(np.int64)
    inside = (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
    return np.where(inside, rows, 0), np.where(inside, columns, 0), inside


def _mean_distances(samples: tuple[I64, I64, BoolGrid], distance: F32) -> F64:
    """Return the mean (K,) of D over the samples of each keypoint that lie inside the map."""
    rows, columns, inside = samples
    sums = (distance.astype(np.float64)[rows, columns] * inside).sum(axis=1)
    return np.asarray(sums / np.maximum(inside.sum(axis=1), 1))


def _orientation_shares(
    samples: tuple[I64, I64, BoolGrid], directions: F64, strength: F32, turns: F64, half: int
) -> F64:
    """Return orientation histograms (K, 128) of length 1 on 4 x 4 fields that are turned with the keypoint.

    A sample counts in the nearest fields and directions by linear interpolation. All 0 where D does not
    change.
    """
    steps = np.arange(-half, half + 1)
    centers = (steps / (2 * half + 1) + 0.5) * _GRID - 0.5
    shares = np.maximum(0.0, 1.0 - np.abs(centers[:, None] - np.arange(_GRID)))
    fields = np.kron(shares, shares)  # (S, 16): how much each sample counts in each field
    falloff = np.exp(-0.5 * (steps[:, None] ** 2 + steps**2).ravel() / (half * half))
    own = directions / (2 * math.pi)
    parts = direction_shares(*samples, own, falloff, strength, turns, _ORIENTATIONS)
    found = np.stack([part @ fields for part in parts], axis=-1)
    histograms = found.reshape(len(directions), _GRID * _GRID * _ORIENTATIONS)
    lengths = np.linalg.norm(histograms, axis=1, keepdims=True)
    return np.asarray(histograms / np.where(lengths > 0, lengths, 1.0))


def _nearest(costs: F32, starts: I64) -> I64:
    """Return for each submap the cheapest for each wanted keypoint (row), (N, K); -1 if the submap has
    none."""
    out = np.full((len(starts) - 1, len(costs)), -1, np.int64)
    for s, (start, stop) in enumerate(itertools.pairwise(starts.tolist())):
        if stop > start:
            out[s] = start + costs[:, start:stop].argmin(axis=1)
    return out


def _consensus(a: F32, b: F32, nearest: I64, inlier_m: float, iterations: int) -> I64:
    """Find by RANSAC, for each submap, the most matches a[m] ~ b[nearest[s, m]] that one rigid motion
    explains: (N,).

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
    most_agreeing(za, matched, submap, rotation, shift, inlier_m, counts)
    return counts


Feature = Callable[[NDArray[np.uint8]], F32]

MAX_FEATURES = 300
WORDS = 1024


def submap_image(submap: Submap) -> NDArray[np.uint8]:
    """Return the submap as an image (H, W) like the published maps: walls black, free cells white, unknown
    cells grey.

    The image is blurred by one cell. Without the blur both features respond to the steps in slanted lines
    of one cell, and recognise a third less.
    """
    image = np.full(submap.grid.cells.shape, 127, np.uint8)
    image[submap.grid.free] = 255
    image[submap.grid.occupied] = 0
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0))


def sift(image: NDArray[np.uint8]) -> F32:
    """Return up to 300 SIFT descriptors (K, 128) of OpenCV, those of the strongest contrast."""
    detector: Any = cv2.SIFT.create(nfeatures=MAX_FEATURES)
    _, descriptors = detector.detectAndCompute(image, None)
    # OpenCV returns more than asked for if several have the contrast of the last.
    return (
        np.empty((0, 128), np.float32)
        if descriptors is None
        else descriptors[:MAX_FEATURES].astype(np.float32)
    )


def surf(image: NDArray[np.uint8]) -> F32:
    """Return up to 300 SURF descriptors (K, 64) of length 1, of the points with the strongest response."""
    return describe_points(image, interest_points(image, MAX_FEATURES))


@dataclass(slots=True)
class Vocabulary:
    """1024 words for one kind of feature, learned by k-means.

    The last map and the last submap are cached, so that methods which share a vocabulary extract features
    once.
    """

    feature: Feature
    seed: int = 0
    words: F32 = field(default_factory=lambda: np.empty((0, 0), np.float32))
    counts: F64 = field(default_factory=lambda: np.empty((0, 0)))
    _learned: Sequence[Submap] | None = None
    _read: Submap | None = None
    _count: F64 = field(default_factory=lambda: np.empty(0))

    def learn(self, submaps: Sequence[Submap]) -> F64:
        """Learn the words from the features of N submaps; counts of each word in each submap (N, words)."""
        from sklearn.cluster import KMeans

        if self._learned is submaps:
            return self.counts
        features = [self.feature(submap_image(submap)) for submap in submaps]
        everything = np.concatenate(features)
        size = min(WORDS, len(np.unique(everything, axis=0)))
        if size:
            # Ten iterations: the words need to be spread over the features, not to have converged.
            means = KMeans(size, init="random", n_init=1, max_iter=10, random_state=self.seed)
            self.words = means.fit(everything).cluster_centers_.astype(np.float32)
        else:
            self.words = np.empty((0, everything.shape[1]), np.float32)
        self.counts = np.array([self._word_counts(descriptors) for descriptors in features])
        self._learned, self._read = submaps, None
        return self.counts

    def read(self, submap: Submap) -> F64:
        """Return the counts of each word in a submap, (words,)."""
        if self._read is not submap:
            self._count = self._word_counts(self.feature(submap_image(submap)))
            self._read = submap
        return self._count

    def _word_counts(self, descriptors: F32) -> F64:
        if len(self.words) == 0 or len(descriptors) == 0:
            return np.zeros(len(self.words))
        # |a - b|^2 without |a|^2, which is the same for all words b.
        nearest = np.argmin((self.words**2).sum(axis=1) - 2 * descriptors @ self.words.T, axis=1)
        return np.bincount(nearest, minlength=len(self.words)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Words:
    """Submaps compared by the cosine between their word counts.

    tfidf : weight a word by its inverse document frequency, which is larger the fewer submaps contain it.
    """

    vocabulary: Vocabulary
    tfidf: bool

    def fit(self, submaps: Sequence[Submap]) -> _Counts:
        """Learn the words and their weights from the submaps of a map."""
        from sklearn.feature_extraction.text import TfidfTransformer

        counts = self.vocabulary.learn(submaps)
        weights = np.ones(counts.shape[1])
        if self.tfidf and counts.size:
            weights = TfidfTransformer(norm=None).fit(counts).idf_
        return _Counts(self.vocabulary, weights, _unit(counts * weights))


@dataclass(frozen=True, slots=True)
class _Counts:
    vocabulary: Vocabulary
    weights: F64
    table: F64

    def similarities(self, query: Submap) -> F64:
        return np.asarray(self.table @ _unit(self.vocabulary.read(query) * self.weights))


def _unit(rows: F64) -> F64:
    """Return the rows scaled to length 1; a row of zeros stays zero, and its similarity to all others is
    0."""
    lengths = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.where(lengths > 0, lengths, 1.0))


def interest_points(image: NDArray[np.uint8], max_points: int) -> F64:
    """Return the points (K, 3) as y, x, scale in pixels; the strongest of mahotas's Fast-Hessian detector."""
    from mahotas.features import surf

    if min(image.shape) < 16:  # smaller than the smallest filter
        return np.empty((0, 3))
    points = np.asarray(surf.interest_points(image, max_points=max_points), np.float64)
    if points.size == 0:
        return np.empty((0, 3))
    return np.ascontiguousarray(points.reshape(len(points), -1)[:, :3])


def describe_points(image: NDArray[np.uint8], points: F64) -> F32:
    """Return SURF descriptors (K, 64) of points (K, 3) as y, x, scale.

    For each of 4 x 4 fields of a square of 20 scales, turned with the point: the sums of dx, dy, |dx|, |dy|
    of 5 x 5 wavelets. A descriptor has length 1, or 0 where the image does not change.
    """
    integral = np.zeros((image.shape[0] + 1, image.shape[1] + 1))
    integral[1:, 1:] = image.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    y, x, scale = points.T[:, :, None]
    turn = orientations(integral, points)[:, None]
    c, s = np.cos(turn), np.sin(turn)
    v, u = (axis.ravel() + 0.5 for axis in np.mgrid[-10:10, -10:10])
    half = np.maximum(1, np.floor(scale + 0.5)).astype(np.int64)
    dx, dy = haar(integral, y + scale * (s * u + c * v), x + scale * (c * u - s * v), half)
    weights = np.exp(-(u**2 + v**2) / (2 * 3.3**2))
    along, across = weights * (c * dx + s * dy), weights * (c * dy - s * dx)
    responses = np.stack((along, across, np.abs(along), np.abs(across)), axis=-1)
    fields = responses.reshape(len(points), 4, 5, 4, 5, 4).sum(axis=(2, 4))
    descriptors = fields.reshape(len(points), 64)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.where(lengths > 0, lengths, 1.0), np.float32)


def orientations(integral: F64, points: F64) -> F64:
    """Return the directions (K,), radians, in which the wavelets within 6 scales have the largest 60 degree
    sum."""
    y, x, scale = points.T
    i, j = (axis.reshape(-1, 1) for axis in np.mgrid[-6:7, -6:7])
    near = (i**2 + j**2 < 36)[:, 0]
    i, j = i[near], j[near]
    half = np.maximum(1, np.floor(2 * scale + 0.5)).astype(np.int64)[None]
    dx, dy = haar(integral, y + i * scale, x + j * scale, half)
    weights = np.exp(-(i**2 + j**2) / (2 * 2.5 * 2.5))
    dx, dy = weights * dx, weights * dy
    sums = sector_sums(np.arctan2(dy, dx), dx, dy, _DIRECTIONS)
    best = (sums**2).sum(axis=1).argmax(axis=0)
    sum_x, sum_y = sums[best, :, np.arange(len(points))].T
    return np.asarray(np.arctan2(sum_y, sum_x))


C64 = NDArray[np.complex64]


@compiled()
def ring_votes(keypoints: I64, offsets: I64, falloff: F64, strength: F32, turns: F64, bins: int) -> F64:
    """Return the votes (K, bins) of the gradient around keypoints (K, 2) on its direction, shared by two
    bins.

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


@compiled()
def _remainder(value: float, size: float) -> float:
    """Return value % size as numpy has it, for a size that is a power of two."""
    while value >= size:
        value -= size
    while value <= -size:
        value += size
    return value + size if value < 0 else value


@compiled()
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
    """Return what the samples (K, S) of K keypoints add to each of the directions, a power of two: (bins, K,
    S).

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


@compiled()
def most_agreeing(
    a: C64, b: C64, submap: I64, rotation: C64, shift: C64, inlier_m: float, counts: I64
) -> None:
    """Count the most of the matches a[m] ~ b[s, m] of each submap s that one of its motions explains.

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


@compiled()
def haar(integral: F64, y: F64, x: F64, half: I64) -> tuple[F64, F64]:
    """Return Haar wavelets in x and y at places y, x (M, K), 2 * half (M or 1, K or 1) pixels wide: (M, K)
    each.

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


@compiled()
def sector_sums(angles: F64, dx: F64, dy: F64, sectors: int) -> F64:
    """Return the sums (sectors, 2, K) of wavelets (M, K) whose angles lie in each sector of 60 degrees."""
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
