"""The shortlist by the signatures of what was seen."""

from __future__ import annotations

import numpy as np

from pc2grid.submaps.isovist import Isovist, isovist
from signature.retrieval.seen_index import SeenIndex
from signature.seen import seen_signatures
from signature.seen_places import PROFILE_BEARINGS
from tests.helpers.simulated_drives import building, office

OFFICE = building({"office": office()})


def profiles(count: int) -> list[Isovist]:
    """The isovists of some places of the office."""
    places = OFFICE.places
    return [
        isovist(office(), (x, y), places.sight_m, bearings=PROFILE_BEARINGS)
        for x, y in places.table.center_m[:count].tolist()
    ]


def test_the_nearest_places_are_those_with_the_shortest_distance() -> None:
    seen = OFFICE.places.seen()
    views = profiles(3)
    signatures = seen_signatures(
        np.stack([v.ranges_m for v in views]), np.stack([v.ends for v in views]), views[0].sight_m
    )
    queries = seen.weights.of_queries(signatures)
    found = seen.nearest_to_each(views, 7)
    for query, near in zip(queries, found, strict=True):
        half = 0.5 * ((seen.vectors.astype(np.float64) - query) ** 2).sum(axis=1)
        assert near.rows.tolist() == np.argsort(half, kind="stable")[:7].tolist()
        np.testing.assert_allclose(near.scores, half[near.rows], rtol=1e-3, atol=1e-2)
        np.testing.assert_allclose((near.mean, near.spread), (half.mean(), half.std()), rtol=1e-3)


def test_a_place_is_nearest_to_itself_and_more_than_all_cannot_be_asked_for() -> None:
    seen, many = OFFICE.places.seen(), len(OFFICE.places.table)
    found = seen.nearest_to_each(profiles(5), 2 * many)
    assert all(sorted(near.rows.tolist()) == list(range(many)) for near in found)
    assert all(i in near.rows[:5] for i, near in enumerate(found))
    assert seen.nearest_to_each([], 3) == ()


def test_an_index_without_places_finds_none() -> None:
    columns = seen_signatures(np.zeros((1, 48), np.float32), np.zeros((1, 48), np.int8), 5.0).shape[1]
    empty = SeenIndex.of(np.empty((0, columns), np.float32))
    assert [len(near.rows) for near in empty.nearest_to_each(profiles(1), 3)] == [0]
