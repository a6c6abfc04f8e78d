"""The methods of the comparison by name: the paper's own, its six rivals (paper IV-A), and what beats it.

`learned` is not in the paper, whose Eq. 6 weighs all bins alike: the boundary at several radii, compared by a
metric that was learned on other maps. A submap is a vector of square roots of shares, and the distance of two
of them is Mahalanobis's, with the covariance of how a query differs from the submap of its own place: bins
that change when one stands a metre beside it, or turned, count less. The covariance is that of queries
without noise on the other maps, so that nothing is learned from the map that is asked, nor from noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.geometry import F64
from pc2grid.model import OccupancyGrid, Submap
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, Matcher, Method, draw_queries
from pc2grid_lab.paper.rivals import (
    DistanceFeatures,
    Vocabulary,
    of_last,
    shape_context,
    sift,
    surf,
    words,
)
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
