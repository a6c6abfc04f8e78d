"""The weights of the bins are learned from pairs, and how much a distance says."""

from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import F32
from pc2grid_lab.fit.weights import Pairs, learned_from, save, spread_of, squared_distances
from signature import weights as seen_likelihood
from signature.visible import PARTS
from signature.weights import SeenStatistics, SeenWeights

SPREAD = SeenStatistics.load().spread()
COLUMNS = PARTS["symmetry"].stop


def made_up_pairs(count: int = 3000) -> Pairs:
    """Places that differ in the first ten columns, and descriptions of one that differ in the others."""
    rng = np.random.default_rng(0)

    def described(places: F32) -> F32:
        noise = rng.normal(0, 1, (len(places), COLUMNS))
        noise[:, :10] *= 0.1
        noise[:, :10] += places
        return np.column_stack((noise, np.ones(len(places)))).astype(np.float32)

    places = rng.normal(0, 1, (count, 10)).astype(np.float32)
    others = rng.normal(0, 1, (count, 10)).astype(np.float32)
    return Pairs(described(places), described(places), described(others))


def test_bins_that_tell_places_apart_weigh_more_than_those_that_differ_by_the_sensor() -> None:
    pairs = made_up_pairs()
    weights = SeenWeights.of(learned_from(pairs))
    first = weights.matrix[:, :10]
    assert np.abs(first[:10]).max() > 10 * np.abs(first[10:]).max()
    queries, same = weights.of_queries(pairs.queries), weights.of_places(pairs.same)
    # The difference at one place and the ridge together have unit variance along each direction; the columns
    # of the pairs do not depend on each other, so that to shrink their covariance does nothing.
    within, others = 2.0 * 0.1**2, 2.0
    ridge = seen_likelihood._RIDGE * (10 * within + (COLUMNS - 10) * others) / COLUMNS
    expected = np.full(10, within / (within + ridge))
    assert np.var((queries - same)[:, :10], axis=0) == pytest.approx(expected, rel=0.15)
    # The right one of 3,000 is the nearest.
    nearest = ((queries[:100, None] - same[None]) ** 2).sum(axis=2).argmin(axis=1)
    assert np.mean(nearest == np.arange(100)) > 0.9


def test_statistics_come_back_from_their_file(tmp_path: Path) -> None:
    statistics = learned_from(made_up_pairs(200))
    save(statistics, tmp_path / "statistics.npz")
    again = SeenStatistics.load(path=tmp_path / "statistics.npz")
    np.testing.assert_allclose(again.within, statistics.within, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(again.spreads, statistics.spreads, rtol=1e-5)


def test_how_much_a_distance_says_is_learned_from_pairs_that_the_weights_were_not() -> None:
    """Of few pairs for many bins: these lie nearer by weights of their own than new ones do."""
    pairs, new = made_up_pairs(400), made_up_pairs(4000)
    statistics = learned_from(pairs)
    weights, rng = SeenWeights.of(statistics), np.random.default_rng(0)
    own, fresh = (
        float(np.log(squared_distances(each, weights, rng)[0]).mean())
        for each in (pairs, Pairs(*(rows[1000:] for rows in new)))
    )
    told = statistics.spread().one_place[0]
    assert own < fresh and abs(told - fresh) < 0.5 * (fresh - own)


def test_the_spread_is_found_again() -> None:
    rng = np.random.default_rng(0)
    hidden = rng.uniform(0, 1.5, 20_000)

    def drawn(coefficients: tuple[float, ...], shape: float) -> np.ndarray:
        mean = np.exp(np.polynomial.polynomial.polyval(hidden, coefficients) + 0.5 / shape)
        return rng.gamma(shape, mean / shape)

    found = spread_of(
        drawn(SPREAD.one_place, SPREAD.one_shape), hidden, drawn(SPREAD.two_places, SPREAD.two_shape), hidden
    )
    assert found.one_place == pytest.approx(SPREAD.one_place, abs=0.1)
    assert found.two_places == pytest.approx(SPREAD.two_places, abs=0.05)
    assert found.one_shape == pytest.approx(SPREAD.one_shape, rel=0.1)
