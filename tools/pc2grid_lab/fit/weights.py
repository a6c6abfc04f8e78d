"""The weights of the signatures and the evidence of their distance, learned from pairs of which it is known
whether they show one place. What is learned and why is told in `signature.weights`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pc2grid.geometry import F32, F64
from pc2grid.io.atomic import replace_file
from signature.visible import WITHOUT_SHARE
from signature.weights import COMBINATIONS, SeenStatistics, SeenWeights, Spread

_LEAST_SEEN = 0.7
"""The weights are learned from pairs of which both sides have seen at least this share of the rays. With 0.5
and 0.3, 0.01 and 0.03 fewer of real views that were left out found their place among the first 20."""
_FOLDS = 8
"""How much a distance says is learned from each of so many parts of the pairs, by weights of the others:
the pairs that weights are learned from are nearer to each other than those of another building."""
_TOO_LITTLE = 0.15
"""Share of the rays; a view that has seen less is not used to learn how much a distance says."""


class Pairs(NamedTuple):
    """Signatures of what was seen, (N, K) each: views of `queries`, places of maps at the `same` points, and
    places of `other` buildings."""

    queries: F32
    same: F32
    other: F32


def learned_from(pairs: Pairs, *, seed: int = 0) -> SeenStatistics:
    """Measure the weights from pairs of which enough was seen, and the evidence of a distance from all;
    pairs of one recording are side by side."""
    return replace(without_spreads(pairs), spreads=fitted_spreads(pairs, seed=seed))


def without_spreads(pairs: Pairs) -> SeenStatistics:
    """Return the moments that the weights are made of, alone."""
    enough = (pairs.queries[:, -1] >= _LEAST_SEEN) & (pairs.same[:, -1] >= _LEAST_SEEN)
    queries, same = (rows[enough][:, WITHOUT_SHARE].astype(np.float64) for rows in pairs[:2])
    apart = (queries - queries.mean(axis=0)) - (same - same.mean(axis=0))
    places = np.concatenate((pairs.other[:, WITHOUT_SHARE], same)).astype(np.float64)
    every = places - places.mean(axis=0)
    return SeenStatistics(
        query_mean=queries.mean(axis=0),
        place_mean=places.mean(axis=0),
        within=apart.T @ apart / len(apart),
        between=every.T @ every / len(every),
        spreads=np.zeros((len(COMBINATIONS), 7)),
    )


def save(statistics: SeenStatistics, path: Path) -> None:
    """Write what was learned to an .npz file, which `SeenStatistics.load` reads."""
    content = {field.name: getattr(statistics, field.name).astype(np.float32) for field in fields(statistics)}
    with replace_file(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **content)


def fitted_spreads(pairs: Pairs, *, seed: int = 0) -> F64:
    """Return the numbers of a `Spread` for each of `COMBINATIONS`, (7, 7), by pairs in `_FOLDS` parts, see
    there."""
    rng, every = np.random.default_rng(seed), np.arange(len(pairs.queries))
    folds = []
    for held in np.array_split(every, _FOLDS):
        queries, same = (np.delete(rows, held, axis=0) for rows in pairs[:2])
        by = without_spreads(Pairs(queries, same, pairs.other))
        folds.append((Pairs(pairs.queries[held], pairs.same[held], pairs.other), by))

    def numbers(names: Sequence[str]) -> tuple[float, ...]:
        found = [squared_distances(held, SeenWeights.of(by, names), rng) for held, by in folds]
        spread = spread_of(*(np.concatenate(each) for each in zip(*found, strict=True)))
        return *spread.one_place, *spread.two_places, spread.one_shape, spread.two_shape

    return np.array([numbers(names) for names in COMBINATIONS])


def squared_distances(
    pairs: Pairs, weights: SeenWeights, rng: np.random.Generator
) -> tuple[F64, F64, F64, F64]:
    """Return the arguments of `spread_of`: of pairs at one place, and of as many at two, with a place of
    another building, and of another pair.

    Pairs of which one side has seen less than `_TOO_LITTLE` are left out.
    """
    kept = (pairs.queries[:, -1] > _TOO_LITTLE) & (pairs.same[:, -1] > _TOO_LITTLE)
    queries, same = pairs.queries[kept], pairs.same[kept]
    other = pairs.other[rng.integers(0, len(pairs.other), len(queries))]
    shuffled = same[rng.permutation(len(same))]
    at = weights.of_queries(queries)
    squared, hidden = zip(
        *(
            (((at - weights.of_places(rows)) ** 2).sum(axis=1), 2.0 - queries[:, -1] - rows[:, -1])
            for rows in (same, other, shuffled)
        ),
        strict=True,
    )
    return squared[0], hidden[0], np.concatenate(squared[1:]), np.concatenate(hidden[1:])


def spread_of(one_place: F64, one_hidden: F64, two_places: F64, two_hidden: F64) -> Spread:
    """Return the spread of squared distances (N,) and (M,) with the hidden shares u of each.

    The variance of the logarithm of a gamma variable of shape k is about 1 / (k - 1/2).
    """
    one = np.polynomial.polynomial.polyfit(one_hidden, np.log(one_place), 2)
    two = np.polynomial.polynomial.polyfit(two_hidden, np.log(two_places), 1)
    rest = [
        np.log(squares) - np.polynomial.polynomial.polyval(hidden, fit)
        for squares, hidden, fit in ((one_place, one_hidden, one), (two_places, two_hidden, two))
    ]
    a, b, c = one.tolist()
    first, second = two.tolist()
    return Spread(
        one_place=(a, b, c),
        two_places=(first, second),
        one_shape=float(1.0 / rest[0].var() + 0.5),
        two_shape=float(1.0 / rest[1].var() + 0.5),
    )
