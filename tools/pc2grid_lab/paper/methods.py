"""The methods of the comparison by name: the paper's own, its six rivals (paper IV-A), and what beats it.

`Learned` is not in the paper, whose Eq. 6 weighs all bins alike: the boundary at several radii, compared by a
metric that was learned on other maps. A submap is a vector of square roots of shares, and the distance of two
of them is Mahalanobis's, with the covariance of how a query differs from the submap of its own place: bins
that change when one stands a metre beside it, or turned, count less. The covariance is that of queries
without noise on the other maps, so that nothing is learned from the map that is asked, nor from noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.geometry import F64
from pc2grid.model import OccupancyGrid, Submap
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, Method, draw_queries
from pc2grid_lab.paper.rivals import DistanceFeatures, ShapeContext, Vocabulary, Words, sift, surf
from signature.boundary import boundary_edges, boundary_points, weighed_pairs
from signature.config import SignatureConfig
from signature.freespace import freespace_paths
from signature.paper import Signature, SignatureTable, described, distances, similarity
from signature.weights import shrunk

_OF_COMPARING = {"weight_boundary", "symmetry_scale", "symmetry_sigma", "histogram_distance"}
"""Fields of a configuration that do not change a signature."""


@dataclass(slots=True)
class Signatures:
    """Signatures, with those of the last submap cached: methods that share them describe a query once."""

    _read: Submap | None = None
    _found: dict[str, Signature] = field(default_factory=dict)

    def of(self, submap: Submap, config: SignatureConfig) -> Signature:
        """Return the signature that `signature.paper` gives, without a graph that would only be unpacked."""
        if self._read is not submap:
            self._read, self._found = submap, {}
        key = config.model_dump_json(exclude=_OF_COMPARING)
        if key not in self._found:
            self._found[key] = described(submap, freespace_paths(submap, config), config)
        return self._found[key]


@dataclass(frozen=True, slots=True)
class Proposed:
    """Three signatures, compared by Eq. 6."""

    config: SignatureConfig = field(default_factory=SignatureConfig)
    signatures: Signatures = field(default_factory=Signatures)

    def fit(self, submaps: Sequence[Submap]) -> _Signed:
        """Describe every submap."""
        signatures = [self.signatures.of(submap, self.config) for submap in submaps]
        return _Signed(self, SignatureTable.of(signatures, [submap.center_m for submap in submaps]))


@dataclass(frozen=True, slots=True)
class _Signed:
    method: Proposed
    table: SignatureTable

    def similarities(self, query: Submap) -> F64:
        config = self.method.config
        return similarity(distances(self.method.signatures.of(query, config), self.table, config))


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
    signature = Signatures().of(submap, CONFIG)
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


@dataclass(slots=True)
class Vectors:
    """`submap_vector`, with the last submap cached: methods that share it describe a query once."""

    _read: Submap | None = None
    _vector: F64 = field(default_factory=lambda: np.empty(0))

    def of(self, submap: Submap) -> F64:
        """Return the vector of a submap."""
        if self._read is not submap:
            self._read, self._vector = submap, submap_vector(submap)
        return self._vector


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


@dataclass(frozen=True, slots=True)
class Learned:
    """Parts of the vectors, compared by Mahalanobis's distance.

    within (Q, SIZE) : `differences` of other maps.
    """

    vectors: Vectors
    parts: tuple[str, ...]
    within: F64

    def fit(self, submaps: Sequence[Submap]) -> _Vectors:
        """Describe every submap."""
        columns = np.concatenate([np.arange(SIZE)[COLUMNS[part]] for part in self.parts])
        whitening = np.zeros((SIZE, len(columns)))
        whitening[columns] = metric(self.within[:, columns])
        return _Vectors(self.vectors, whitening, np.array([self.vectors.of(s) for s in submaps]) @ whitening)


@dataclass(frozen=True, slots=True)
class _Vectors:
    vectors: Vectors
    whitening: F64
    table: F64

    def similarities(self, query: Submap) -> F64:
        return np.asarray(-np.linalg.norm(self.table - self.vectors.of(query) @ self.whitening, axis=1))


@dataclass(frozen=True, slots=True)
class Unlearned:
    """Parts of the vectors, compared by the sum of their distances sqrt(1 - BC) with weights."""

    vectors: Vectors
    weights: Mapping[str, float]

    def fit(self, submaps: Sequence[Submap]) -> _Parts:
        """Describe every submap."""
        return _Parts(self, np.array([self.vectors.of(submap) for submap in submaps]))


@dataclass(frozen=True, slots=True)
class _Parts:
    method: Unlearned
    table: F64

    def similarities(self, query: Submap) -> F64:
        apart = self.table - self.method.vectors.of(query)
        # Of roots of shares, |a - b|^2 is 2 (1 - BC).
        terms = [
            share * np.linalg.norm(apart[:, COLUMNS[part]], axis=1) / np.sqrt(2.0)
            for part, share in self.method.weights.items()
        ]
        return np.asarray(-np.sum(terms, axis=0))


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
    signatures, vectors = Signatures(), Vectors()
    sift_words, surf_words = Vocabulary(sift), Vocabulary(surf)
    letter = SignatureConfig.paper()
    known: dict[str, Method] = {
        "proposed": Proposed(letter, signatures),
        "as_used_here": Proposed(),
        "shape_context": ShapeContext(),
        "sift_bow": Words(sift_words, tfidf=False),
        "surf_bow": Words(surf_words, tfidf=False),
        "sift_tfidf": Words(sift_words, tfidf=True),
        "surf_tfidf": Words(surf_words, tfidf=True),
        "sdf": DistanceFeatures(),
        "unlearned": Unlearned(vectors, UNLEARNED),
    }
    for name, changed in VARIANTS.items():
        known[name] = Proposed(letter.model_copy(update=dict(changed)), signatures)
    if within is not None:
        known |= {name: Learned(vectors, parts, within) for name, parts in LEARNED.items()}
    return {name: known[name] for name in names}
