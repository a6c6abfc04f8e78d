"""How likely two descriptions of what was seen show one place; weights of the bins, explained.

Two sensors at one place do not fill the bins equally, and some bins differ more than others. A bin tells
places apart if it varies more between places than between sensors. Both were measured: `within`, the
covariance of the difference between a query and a map at one place, over real drives in maps of another time,
and `between`, that of different places. By the whole of `within` the distance is Mahalanobis'. Fisher's
linear discriminant, the generalized eigenvalue problem `between v = q within v`, gives in closed form the
directions v with the largest quotients q, along which the differences at one place have unit variance. Along
these the distance is Euclidean: there is one short vector for each place and view, and an index can search
them.

A squared distance D^2 says less the less was seen. With u, the share of rays hidden from one side plus that
hidden from the other, ln D^2 has the mean a + b u + c u^2 at one place and a' + b' u at two; both were
measured, too. D^2 is taken as gamma distributed with these means, and the logarithm of the ratio of the two
densities is the evidence for one place. It goes to 0 where little was seen.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TypeVar

import numpy as np

from pc2grid.geometry import F32, F64, I64, frozen_arrays
from signature.visible import PARTS, WITHOUT_SHARE

DIMENSIONS = 24
"""Length of the vectors. On real windows of buildings that were left out, 48, 96 and all, which is
Mahalanobis' distance, find as many places: docs/method.md."""
_SHRINK = 0.6
"""So much of `within` is its diagonal alone, as there are few pairs for so many bins; 0.2 and 0.9 gave 0.01
and 0.02 less recall among the first 20 of real windows that were left out, which is little."""
_RIDGE = 1e-3
"""Added to the diagonal of `within`, as a share of its mean, so that bins that are always empty stay finite;
0.01 and 0.0001 gave the same."""
COMBINATIONS = tuple(c for n in (1, 2, 3) for c in itertools.combinations(PARTS, n))
"""The names of all combinations of the signatures; the last one is all three."""
_FILE = Path(__file__).with_name("statistics.npz")


FloatArray = TypeVar("FloatArray", F32, F64)


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(
    query_mean=(np.float64, "C"),
    place_mean=(np.float64, "C"),
    within=(np.float64, "C", "C"),
    between=(np.float64, "C", "C"),
    spreads=(np.float64, len(COMBINATIONS), 7),
)
class SeenStatistics:
    """What the weights are made of, for the C columns of the three signatures.

    query_mean, place_mean (C,) : means over queries and over places of maps. within, between (C, C) :
    covariances, see above. spreads (7, 7) : the numbers of a `Spread` for each of `COMBINATIONS`.
    """

    query_mean: F64
    place_mean: F64
    within: F64
    between: F64
    spreads: F64

    def columns(self, names: Sequence[str] = ()) -> I64:
        """Return the columns of the signatures `names`, by default of all."""
        return np.concatenate([np.r_[part] for name, part in PARTS.items() if not names or name in names])

    def spread(self, names: Sequence[str] = ()) -> Spread:
        """Return the evidence of the distance by some of the signatures."""
        chosen = tuple(name for name in PARTS if not names or name in names)
        a, b, c, d, e, one, two = self.spreads[COMBINATIONS.index(chosen)].tolist()
        return Spread(one_place=(a, b, c), two_places=(d, e), one_shape=one, two_shape=two)

    @staticmethod
    def load(path: Path = _FILE) -> SeenStatistics:
        """Read what the laboratory has learned; by default the statistics that come with the program, which
        `pc2grid_lab.fit.queries` has learned from real logs."""
        with np.load(path, allow_pickle=False) as file:
            return SeenStatistics(
                **{field.name: file[field.name].astype(np.float64) for field in fields(SeenStatistics)}
            )


def shrunk(covariance: F64, ridge: float) -> F64:
    """Return a covariance (D, D) shrunk to its diagonal by `_SHRINK`. ridge : added to the diagonal, as a
    share of its mean."""
    variances = np.diag(covariance)
    return np.asarray((1.0 - _SHRINK) * covariance + np.diag(_SHRINK * variances + ridge * variances.mean()))


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenWeights:
    """A linear map of signatures to vectors whose Euclidean distance tells places apart.

    query_mean, place_mean (C,), matrix (C, D).
    """

    query_mean: F64
    place_mean: F64
    matrix: F64

    @staticmethod
    def of(statistics: SeenStatistics, names: Sequence[str] = ()) -> SeenWeights:
        """Return the best weights of the signatures `names`, by default of all of
        `signature.visible.PARTS`."""
        from scipy.linalg import eigh

        columns = statistics.columns(names)
        chosen = np.ix_(columns, columns)
        quotients, directions = eigh(statistics.between[chosen], shrunk(statistics.within[chosen], _RIDGE))
        matrix = np.zeros((len(statistics.query_mean), min(DIMENSIONS, len(columns))))
        matrix[columns] = directions[:, np.argsort(-quotients)[: matrix.shape[1]]]
        return SeenWeights(query_mean=statistics.query_mean, place_mean=statistics.place_mean, matrix=matrix)

    def of_queries(self, signatures: F32) -> F32:
        """Return vectors (N, D) of views of queries, given as (N, K)."""
        return np.asarray((signatures[:, WITHOUT_SHARE] - self.query_mean) @ self.matrix, np.float32)

    def of_places(self, signatures: F32) -> F32:
        """Return vectors (N, D) of places of maps, given as (N, K)."""
        return np.asarray((signatures[:, WITHOUT_SHARE] - self.place_mean) @ self.matrix, np.float32)


learned = functools.cache(SeenStatistics.load)
"""The statistics that come with the program; read once."""


@functools.cache
def seen_weights(*names: str) -> SeenWeights:
    """Return the weights of all three signatures, or of those named, by the statistics that come with the
    program."""
    return SeenWeights.of(learned(), names)


@functools.cache
def seen_spread(*names: str) -> Spread:
    """Return the evidence of the distance by the signatures of `seen_weights`."""
    return learned().spread(names)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """How D^2 is distributed: coefficients of the mean of ln D^2, and shapes of the gamma distributions.

    one_place : a, b, c. two_places : a', b'. See the text above.
    """

    one_place: tuple[float, float, float]
    two_places: tuple[float, float]
    one_shape: float
    two_shape: float

    def log_ratio(self, squared: FloatArray, hidden: FloatArray) -> FloatArray:
        """Return natural logarithm of the ratio of the likelihoods of one place and of two, elementwise, as
        exact as the arguments: float32 takes a quarter of the time.

        squared : D^2. hidden : u, 0..2.
        """
        one, two, (a, b, c) = self.one_shape, self.two_shape, self.one_place
        # The mean of the logarithm of a gamma variable is about the logarithm of its mean less 1 / (2 k).
        mean_two = self.two_places[0] + self.two_places[1] * hidden + 0.5 / two
        mean_one = np.minimum(a + hidden * (b + hidden * c) + 0.5 / one, mean_two)
        # The ratio of the gamma densities falls again towards 0; a view that is nearer than most views of one
        # place are is no less likely than these.
        nearest = (one - two) / np.maximum(one * np.exp(-mean_one) - two * np.exp(-mean_two), 1e-9)
        x = np.log(np.maximum(squared, np.maximum(nearest, 1e-3)))
        same = one * (math.log(one) - mean_one + x - np.exp(x - mean_one)) - math.lgamma(one)
        different = two * (math.log(two) - mean_two + x - np.exp(x - mean_two)) - math.lgamma(two)
        ratio: FloatArray = same - different
        return ratio
