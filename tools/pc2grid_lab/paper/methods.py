"""The methods of the comparison by name: the paper's own, its six rivals (paper IV-A), and what beats it.

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

`learned` is not in the paper, whose Eq. 6 weighs all bins alike: the boundary at several radii, compared by a
metric that was learned on other maps. A submap is a vector of square roots of shares, and the distance of two
of them is Mahalanobis's, with the covariance of how a query differs from the submap of its own place: bins
that change when one stands a metre beside it, or turned, count less. The covariance is that of queries
without noise on the other maps, so that nothing is learned from the map that is asked, nor from noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.geometry import F32, F64, I64, BoolGrid, cells_of
from pc2grid.libraries import compiled
from pc2grid.model import OccupancyGrid, Submap
from pc2grid.submaps.junction_graph import thin
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, Matcher, Method, draw_queries
from signature.boundary import boundary_edges, boundary_points, weighed_pairs
from signature.config import SignatureConfig
from signature.paper import Signature, SignatureTable, describe as signature_of, distances, similarity
from signature.weights import shrunk


def proposed(
    config: SignatureConfig, describe: Callable[[Submap], Signature], submaps: Sequence[Submap]
) -> Matcher:
    """Compare three signatures by Eq. 6. describe : with these settings."""
    signatures = [describe(submap) for submap in submaps]
    table = SignatureTable.of(signatures, [submap.center_m for submap in submaps])
    return lambda query: similarity(distances(describe(query), table, config))


CONFIG = SignatureConfig.paper().model_copy(update={"thinning": "zhang_suen"})
"""The letter, but with the thinning of III-A for the boundary, too: on aces at noise level 2, the learned
boundary is right for .93 of 200 queries with it, and for .91 with Guo and Hall's."""

LEARNED_FROM = 400
"""Queries of each other map: the first of its own stream in the experiment."""
_RIDGE = 1e-6
"""Of the mean variance, added to each, since some bins are always empty."""

_SOFT_M, _NEAR_M = (2.0, 8.0), (2.5, 4.5)
"""A point weighs 1 up to the first distance from the centre, 0 from the second one on; chosen by hand."""
_NEAR_BINS = 48
"""Of pairs near the centre, which are at most 9 m apart."""
_RING_M, _RINGS = 0.8, 10
"""Width and number of the bins of distances from the centre."""

BOUNDARY_PARTS = ("boundary", "soft", "near", "radial")
"""The paper's histogram; the same with a soft rim; pairs near the centre; distances from the centre: 218."""
_SIZES = MappingProxyType(
    {"boundary": 80, "soft": 80, "near": _NEAR_BINS, "radial": _RINGS, "freespace": 80, "symmetry": 2}
)
_ENDS = np.cumsum(list(_SIZES.values()))
SIZE = int(_ENDS[-1])
COLUMNS: Mapping[str, slice] = MappingProxyType(
    {part: slice(int(end) - size, int(end)) for (part, size), end in zip(_SIZES.items(), _ENDS, strict=True)}
)
"""Where each part lies in a vector."""


def weight(distance_m: F64, full_m: float, none_m: float) -> F64:
    """Return 1 up to `full_m` from the centre, 0 from `none_m` on, half a cosine between."""
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip((distance_m - full_m) / (none_m - full_m), 0, 1)))


def submap_vector(submap: Submap) -> F64:
    """Return all parts of a submap of 8 m (SIZE,): square roots of shares, and the symmetry as a share of
    white.

    Free space and symmetry are the paper's.
    """
    signature = signature_of(submap, CONFIG)
    return np.concatenate((boundary_vector(submap), _roots(signature.freespace), signature.symmetry / 255))


def boundary_vector(submap: Submap) -> F64:
    """Return the first parts of the vector, `BOUNDARY_PARTS`."""
    resolution_m = submap.grid.resolution_m
    edges = boundary_edges(submap, CONFIG)
    cells = boundary_points(edges, resolution_m, CONFIG)
    away_m = np.hypot(*((cells - (np.array(edges.shape) - 1) / 2) * resolution_m).T)
    weights = np.stack((np.ones(len(cells)), weight(away_m, *_SOFT_M), weight(away_m, *_NEAR_M)))
    bins = _SIZES["boundary"]
    pairs = np.zeros((1, len(weights), bins + 2))
    points = np.asarray(cells * (resolution_m / CONFIG.boundary_bin_m), np.float64)
    weighed_pairs(points[None], weights[None], np.zeros_like(weights)[None], pairs)
    whole, soft, near = pairs[0, :, :bins]
    rings = np.bincount(np.minimum((away_m / _RING_M).astype(np.int64), _RINGS - 1), minlength=_RINGS)
    return np.concatenate([_roots(counts) for counts in (whole, soft, near[:_NEAR_BINS], rings)])


def _roots(counts: NDArray[np.number]) -> F64:
    return np.asarray(np.sqrt(counts / max(counts.sum(), 1e-9)))


LEARNED = {
    "learned": BOUNDARY_PARTS,
    "learned_without_soft": ("boundary", "near", "radial"),
    "learned_without_near": ("boundary", "soft", "radial"),
    "learned_without_radial": ("boundary", "soft", "near"),
    "learned_boundary": ("boundary",),
    "learned_with_freespace": (*BOUNDARY_PARTS, "freespace"),
    "learned_with_symmetry": (*BOUNDARY_PARTS, "symmetry"),
}
"""The parts of each method that learns."""
UNLEARNED = {"boundary": 0.5, "near": 0.4, "radial": 0.1}
"""Weights of the method that does not learn, chosen by hand."""


Describe = Callable[[Submap], F64]
"""`submap_vector`, which methods share."""


def differences(grid: OccupancyGrid, submaps: Sequence[Submap], seed: int) -> F64:
    """Return the vectors (Q, SIZE) of queries of a map, without noise, less those of the submaps of their
    places."""
    centers_m = np.array([submap.center_m for submap in submaps])
    table = np.array([submap_vector(submap) for submap in submaps])
    experiment = Experiment(queries=LEARNED_FROM, seed=seed)
    queries = list(draw_queries(grid, centers_m, submaps[0].radius_m, experiment, NOISE_LEVELS[0]))
    own = cKDTree(centers_m).query([query.center_m for query in queries])[1]
    return np.asarray(np.array([submap_vector(query) for query in queries]) - table[own])


def metric(within: F64) -> F64:
    """Return the metric (K, K): Mahalanobis's distance is the Euclidean one of vectors times it. within :
    `differences`."""
    covariance = shrunk(within.T @ within / len(within), _RIDGE)
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)))


def learned(describe: Describe, parts: Sequence[str], within: F64, submaps: Sequence[Submap]) -> Matcher:
    """Compare parts of the vectors by Mahalanobis's distance. within (Q, SIZE) : `differences` of other
    maps."""
    columns = np.concatenate([np.arange(SIZE)[COLUMNS[part]] for part in parts])
    whitening = np.zeros((SIZE, len(columns)))
    whitening[columns] = metric(within[:, columns])
    table = np.array([describe(submap) for submap in submaps]) @ whitening
    return lambda query: np.asarray(-np.linalg.norm(table - describe(query) @ whitening, axis=1))


def unlearned(describe: Describe, weights: Mapping[str, float], submaps: Sequence[Submap]) -> Matcher:
    """Compare parts of the vectors by the sum of their distances sqrt(1 - BC) with weights."""
    table = np.array([describe(submap) for submap in submaps])

    def similarities(query: Submap) -> F64:
        apart = table - describe(query)
        # Of roots of shares, |a - b|^2 is 2 (1 - BC).
        terms = [
            share * np.linalg.norm(apart[:, COLUMNS[part]], axis=1) / np.sqrt(2.0)
            for part, share in weights.items()
        ]
        return np.asarray(-np.sum(terms, axis=0))

    return similarities


# --- the rivals ---------------------------------------------------------------------------------------

Described = TypeVar("Described")
Given = TypeVar("Given")


def of_last(describe: Callable[[Given], Described]) -> Callable[[Given], Described]:
    """Return the same function, with its last result cached: methods that share it describe a query once."""
    last: list[Any] = [None, None]

    def described(given: Given) -> Described:
        if last[0] is not given:
            last[:] = given, describe(given)
        found: Described = last[1]
        return found

    return described


ANGULAR_BINS, RADIAL_BINS = 24, 12
"""Of the Shape Context, as in the paper."""
_INNER_M = 0.5
"""Its rings grow from here by a constant factor to the radius of the submap; chosen by hand."""


def shape_context(submaps: Sequence[Submap]) -> Matcher:
    """Compare the Shape Contexts of submaps."""
    table = np.array([context(submap) for submap in submaps])

    def similarities(query: Submap) -> F64:
        shape, best = context(query), np.ones(len(table))
        for turn in range(ANGULAR_BINS):
            turned = np.roll(shape, turn, axis=1)
            total = table + turned
            terms = np.divide((table - turned) ** 2, total, out=np.zeros_like(total), where=total > 0)
            # An empty submap shares no bin with any other: its cost is the largest, 1.
            cost = 0.5 * terms.sum(axis=(1, 2)) if shape.any() else np.ones(len(table))
            best = np.minimum(best, np.where(table.any(axis=(1, 2)), cost, 1.0))
        return -best

    return similarities


def context(submap: Submap) -> F32:
    """Return the shares of the boundary pixels, (radial, angular); sum 1, or all 0 without any."""
    edges = thin(submap.grid.occupied)
    y, x = ((cells_of(edges) - (np.array(edges.shape) - 1) / 2) * submap.grid.resolution_m).T
    rings = np.geomspace(_INNER_M, submap.radius_m, RADIAL_BINS)
    ring = np.minimum(np.searchsorted(rings, np.hypot(x, y)), RADIAL_BINS - 1)
    sector = (np.arctan2(y, x) / (2 * np.pi) % 1.0 * ANGULAR_BINS).astype(np.int64) % ANGULAR_BINS
    counts = np.bincount(ring * ANGULAR_BINS + sector, minlength=RADIAL_BINS * ANGULAR_BINS)
    return np.asarray(counts.reshape(RADIAL_BINS, ANGULAR_BINS) / max(len(x), 1), np.float32)


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

    def __call__(self, submaps: Sequence[Submap]) -> Matcher:
        """Find and describe the keypoints of every submap."""
        features = [self.features(submap) for submap in submaps]
        places_m, descriptors = (np.concatenate(rows) for rows in zip(*features, strict=True))
        # |a - b|^2 without |a|^2, which is the same for every b and does not change which is the nearest.
        minus_twice, squares = -2 * descriptors, (descriptors**2).sum(axis=1)
        starts = np.cumsum([0, *(len(f.places_m) for f in features)])

        def similarities(query: Submap) -> F64:
            wanted = self.features(query)
            if len(wanted.places_m) == 0 or len(places_m) == 0:
                return np.zeros(len(features))
            nearest = _nearest(wanted.descriptors @ minus_twice.T + squares, starts)
            inliers = _consensus(wanted.places_m, places_m, nearest, self.apart_m, self.iterations)
            # The larger number of keypoints, so that a submap with few is not similar to all that contain it.
            return np.asarray(inliers / np.maximum(len(wanted.places_m), np.diff(starts)))

        return similarities

    def features(self, submap: Submap) -> Features:
        """Return the keypoints of a submap and their descriptors; none where nothing is occupied or
        curved."""
        resolution = submap.grid.resolution_m
        if not submap.grid.occupied.any() or min(submap.grid.cells.shape) < 3:
            return Features(np.empty((0, 2), np.float32), np.empty((0, 129), np.float32))
        distance = distance_function(submap, self.smooth_m)
        keypoints = self._keypoints(distance, submap)
        gradient_y, gradient_x = (np.asarray(g, np.float32) for g in np.gradient(distance, resolution))
        strength = np.hypot(gradient_x, gradient_y)
        turns = np.arctan2(gradient_y.astype(np.float64), gradient_x) / (2 * math.pi) % 1.0
        directions = _directions(keypoints, strength, turns, self.orient_m / resolution)
        step = self.smooth_m / resolution
        half = int(self.window_m / resolution / step)
        samples = _samples(keypoints, directions, distance.shape, half, step)
        shares = _orientation_shares(samples, directions, strength, turns, half)
        rows, columns, inside = samples
        sums = (distance.astype(np.float64)[rows, columns] * inside).sum(axis=1)
        mean_m = sums / np.maximum(inside.sum(axis=1), 1)
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


def _directions(keypoints: I64, strength: F32, turns: F64, radius: float) -> F64:
    """Return the main direction (K,), radians, of the gradient (H, W) in the `radius` (cells) of keypoints
    (K, 2). turns : directions of the gradient as shares of a turn, 0 .. 1."""
    reach = int(radius)
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    squared = (offsets**2).sum(axis=1)
    near = squared <= radius * radius
    falloff = np.exp(-2.0 * squared[near] / (radius * radius))
    rows, columns = (keypoints[:, None] + offsets[near]).transpose(2, 0, 1)
    rows, columns, inside = _inside(rows, columns, strength.shape)
    weights, turn = strength[rows, columns] * falloff * inside, turns[rows, columns] * _DIRECTIONS
    low = np.floor(turn).astype(np.int64)
    owner, votes = np.arange(len(keypoints))[:, None] * _DIRECTIONS, np.zeros(len(keypoints) * _DIRECTIONS)
    for at, share in ((low, 1 - (turn - low)), (low + 1, turn - low)):
        votes += np.bincount((owner + at % _DIRECTIONS).ravel(), (weights * share).ravel(), len(votes))
    rings = votes.reshape(-1, _DIRECTIONS)
    smooth = np.roll(rings, 1, axis=1) + 2 * rings + np.roll(rings, -1, axis=1)
    peak = smooth.argmax(axis=1)
    before, at_peak, after = (smooth[np.arange(len(smooth)), (peak + k) % _DIRECTIONS] for k in (-1, 0, 1))
    # The vertex of the parabola through the highest vote and its neighbours.
    bend = before - 2 * at_peak + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend < 0)
    return np.asarray((peak + shift) * (2 * math.pi / _DIRECTIONS))


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
    return _inside(rows, columns, shape)


def _inside(rows: I64, columns: I64, shape: tuple[int, ...]) -> tuple[I64, I64, BoolGrid]:
    """Return cells, and whether they lie inside an image of a shape; those outside are moved to (0, 0)."""
    inside = (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
    return np.where(inside, rows, 0), np.where(inside, columns, 0), inside


def _orientation_shares(
    samples: tuple[I64, I64, BoolGrid], directions: F64, strength: F32, turns: F64, half: int
) -> F64:
    """Return orientation histograms (K, 128) of length 1 on 4 x 4 fields that are turned with the keypoint.

    A sample counts in the nearest fields and directions by linear interpolation. All 0 where D does not
    change.
    """
    steps = np.arange(-half, half + 1)
    centers = (steps / (2 * half + 1) + 0.5) * _GRID - 0.5
    near = np.maximum(0.0, 1.0 - np.abs(centers[:, None] - np.arange(_GRID)))
    fields = np.kron(near, near)  # (S, 16): how much each sample counts in each field
    falloff = np.exp(-0.5 * (steps[:, None] ** 2 + steps**2).ravel() / (half * half))
    rows, columns, inside = samples
    weights = strength[rows, columns] * falloff * inside
    turn = (turns[rows, columns] - directions[:, None] / (2 * math.pi)) % 1.0 * _ORIENTATIONS
    low, shares = turn.astype(np.int64), np.zeros((_ORIENTATIONS, *rows.shape))
    for at, share in ((low, 1 - (turn - low)), (low + 1, turn - low)):
        np.put_along_axis(shares, (at % _ORIENTATIONS)[None], (weights * share)[None], axis=0)
    found = np.stack([part @ fields for part in shares], axis=-1)
    return _unit(found.reshape(len(directions), _GRID * _GRID * _ORIENTATIONS))


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
    image = np.select([submap.grid.free, submap.grid.occupied], [255, 0], 127).astype(np.uint8)
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


class Vocabulary:
    """1024 words for one kind of feature, learned by k-means from the features of N submaps.

    counts : of each word in each submap (N, words). read : returns the counts of each word in a submap.
    """

    def __init__(self, feature: Feature, submaps: Sequence[Submap]) -> None:
        from sklearn.cluster import KMeans

        features = [feature(submap_image(submap)) for submap in submaps]
        everything = np.concatenate(features)
        self._words = np.empty((0, everything.shape[1]), np.float32)
        if size := min(WORDS, len(np.unique(everything, axis=0))):
            # Ten iterations: the words need to be spread over the features, not to have converged.
            means = KMeans(size, init="random", n_init=1, max_iter=10, random_state=0)
            self._words = means.fit(everything).cluster_centers_.astype(np.float32)
        self.counts = np.array([self._word_counts(descriptors) for descriptors in features])
        self.read: Callable[[Submap], F64] = of_last(
            lambda submap: self._word_counts(feature(submap_image(submap)))
        )

    def _word_counts(self, descriptors: F32) -> F64:
        if len(self._words) == 0 or len(descriptors) == 0:
            return np.zeros(len(self._words))
        # |a - b|^2 without |a|^2, which is the same for all words b.
        nearest = np.argmin((self._words**2).sum(axis=1) - 2 * descriptors @ self._words.T, axis=1)
        return np.bincount(nearest, minlength=len(self._words)).astype(np.float64)


def words(
    learn: Callable[[Sequence[Submap]], Vocabulary], submaps: Sequence[Submap], *, tfidf: bool
) -> Matcher:
    """Compare submaps by the cosine between their word counts.

    learn : makes the vocabulary of a map. tfidf : weight a word by its inverse document frequency, which is
    larger the fewer submaps contain it.
    """
    from sklearn.feature_extraction.text import TfidfTransformer

    vocabulary = learn(submaps)
    counts = vocabulary.counts
    weights = np.ones(counts.shape[1])
    if tfidf and counts.size:
        weights = TfidfTransformer(norm=None).fit(counts).idf_
    table = _unit(counts * weights)
    return lambda query: np.asarray(table @ _unit(vocabulary.read(query) * weights))


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
    integral = cv2.integral(image).astype(np.float64)
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
    return np.asarray(_unit(fields.reshape(len(points), 64)), np.float32)


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
    sums = sector_sums(np.arctan2(dy, dx), dx, dy)
    best = (sums**2).sum(axis=1).argmax(axis=0)
    sum_x, sum_y = sums[best, :, np.arange(len(points))].T
    return np.asarray(np.arctan2(sum_y, sum_x))


# --- all by name --------------------------------------------------------------------------------------

METHOD_NAMES = (
    "proposed",
    "proposed_ln_bc",
    "shape_context",
    "sift_bow",
    "surf_bow",
    "sift_tfidf",
    "surf_tfidf",
    "sdf",
)
"""The paper's method to the letter, with both readings of the distance d of Eq. 6, OpenCV's sqrt(1 - BC) and
-ln BC; its rivals in the order of Table III."""

OURS = (*METHOD_NAMES[:2], "as_used_here")
"""What stands beside the published row in both tables; the last one with the default settings."""

EXTRA_METHOD_NAMES = ("as_used_here", *LEARNED, "unlearned")
"""Beyond the paper: the default settings; the boundary at several radii with a learned metric, with more and
fewer parts, and nothing learned."""

_NO_SYMMETRY = {"symmetry_sigma": 1e6}
"""A spread that makes Omega of Eq. 6 equal to 1."""
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "without_symmetry": _NO_SYMMETRY,
    "boundary_alone": {"weight_boundary": 1.0, **_NO_SYMMETRY},
    "freespace_alone": {"weight_boundary": 0.0, **_NO_SYMMETRY},
    "symmetry_counts": {"symmetry_sigma": 4.0},
    "proposed_ln_bc": {"histogram_distance": "bhattacharyya"},
}
"""Fields of the method to the letter with other values: without some of its signatures, with a symmetry that
counts (its sigma is 120), and with the other reading of the distance."""
ABLATION = tuple(VARIANTS)[:-1]
"""What each signature adds."""


def make_methods(names: Iterable[str], within: F64 | None = None) -> dict[str, Method]:
    """Make methods by name, with the paper's parameters.

    Methods with the same features share them when they are made together, so that the features of a submap
    are extracted once. within : `learned.differences` of other maps, without which no method can be made that
    learns. Raises KeyError for a name that is not known.
    """
    letter, default = SignatureConfig.paper(), SignatureConfig()
    # All variants of the letter differ in comparing alone.
    of_letter = of_last(partial(signature_of, config=letter))
    vectors = of_last(submap_vector)
    sift_words, surf_words = (of_last(partial(Vocabulary, feature)) for feature in (sift, surf))
    known: dict[str, Method] = {
        "proposed": partial(proposed, letter, of_letter),
        "as_used_here": partial(proposed, default, partial(signature_of, config=default)),
        "shape_context": shape_context,
        "sift_bow": partial(words, sift_words, tfidf=False),
        "surf_bow": partial(words, surf_words, tfidf=False),
        "sift_tfidf": partial(words, sift_words, tfidf=True),
        "surf_tfidf": partial(words, surf_words, tfidf=True),
        "sdf": DistanceFeatures(),
        "unlearned": partial(unlearned, vectors, UNLEARNED),
    }
    for name, changed in VARIANTS.items():
        known[name] = partial(proposed, letter.model_copy(update=dict(changed)), of_letter)
    if within is not None:
        known |= {name: partial(learned, vectors, parts, within) for name, parts in LEARNED.items()}
    return {name: known[name] for name in names}


C64 = NDArray[np.complex64]


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


def haar(integral: F64, y: F64, x: F64, half: I64) -> tuple[F64, F64]:
    """Return Haar wavelets in x and y at places y, x (M, K), 2 * half (M or 1, K or 1) pixels wide: (M, K)
    each.

    They are 0 where the wavelet would leave the image.
    """
    height, width = integral.shape
    rows, columns = np.floor(y + 0.5).astype(np.int64), np.floor(x + 0.5).astype(np.int64)
    inside = (rows >= half) & (columns >= half) & (rows + half < height) & (columns + half < width)
    # The integral image at the corners of the four quarters of the wavelet.
    row, column = ([np.where(inside, at + k * half, 0) for k in (-1, 0, 1)] for at in (rows, columns))
    top, middle, bottom = ([integral[row[i], column[j]] for j in range(3)] for i in range(3))
    left = bottom[1] - top[1] - bottom[0] + top[0]
    right = bottom[2] - top[2] - bottom[1] + top[1]
    upper = middle[2] - top[2] - middle[0] + top[0]
    lower = bottom[2] - middle[2] - bottom[0] + middle[0]
    return right - left, lower - upper


def sector_sums(angles: F64, dx: F64, dy: F64) -> F64:
    """Return the sums (sectors, 2, K) of wavelets (M, K) whose angles lie in each sector of 60 degrees."""
    sums = np.empty((_DIRECTIONS, 2, angles.shape[1]))
    for k in range(_DIRECTIONS):
        ahead = angles - (k * math.pi / (_DIRECTIONS / 2) - math.pi)
        inside = ((ahead >= 0) & (ahead < math.pi / 3)) | (ahead + 2 * math.pi < math.pi / 3)
        sums[k] = (dx * inside).sum(axis=0), (dy * inside).sum(axis=0)
    return sums
