"""Places selected from very many, by signatures, isovists and the votes of all views."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.arrays import F32
from pc2grid.geometry import SE2
from signature.localization.query import Query, QueryMap
from signature.retrieval import place_index
from signature.retrieval.likeness import LIKENESS, plain_rotate_and_compare
from signature.retrieval.place_index import (
    SELECTION,
    PlaceBlock,
    PlaceIndex,
    PlaceRaster,
    likeness_beside,
    plain_likeness_beside,
    summed_votes,
)
from signature.seen_places import PROFILE_BEARINGS, SeenPlaces
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})
OWN = OFFICE.places.described()


def query(field_deg: float = 360.0) -> tuple[QueryMap, SE2]:
    """What a drive of 8 m in the office has seen, and its frame there."""
    window, first = Query(OFFICE.made_with, OFFICE.config), None
    corners = [(1.5, 7.0), (9.5, 7.0)]
    for registered, planar_scan, truth in drive(office(), corners, field_rad=math.radians(field_deg)):
        first = first or truth
        window.add(registered, planar_scan)
    assert first is not None
    return window.map(), first


def scrambled(copies: int) -> PlaceBlock:
    """Places of other sessions with the signatures of the office and other isovists: the rays in another
    order, which no signature notices that has no direction."""
    rng, blocks = np.random.default_rng(0), []
    for session in range(1, copies + 1):
        rays = rng.permutation(PROFILE_BEARINGS)
        seen = replace(OWN.seen, ranges=OWN.seen.ranges[:, rays])
        blocks.append(OWN._replace(seen=seen, session=np.full(len(OWN.session), session)))
    return PlaceBlock.concatenated(blocks)


@pytest.mark.parametrize("field_deg", [360.0, 90.0])
def test_isovists_tell_places_apart_that_have_equal_signatures(field_deg: float) -> None:
    seen, T_map_query = query(field_deg)
    index = PlaceIndex.of([OWN, scrambled(30)], OFFICE.places.sight_m)
    assert len(index) == 31 * len(OWN.session)
    best = index.placements(seen.views, index.nearest_to_each(seen.views))
    first = int(best.row[0])
    assert index.session[first] == 0
    views_m = T_map_query.apply(np.array([view.center_m for view in seen.views]))
    assert np.hypot(*(views_m - OWN.center_m[first]).T).min() < 1.0
    assert (np.diff(best.votes) <= 0).all()
    # The places beside the other views are where they truly are.
    for view, place in zip(views_m, best.beside[0].tolist(), strict=True):
        if place >= 0:
            assert math.dist(view, OWN.center_m[place]) < 2.0


def test_the_selected_places_are_as_many_as_asked_for() -> None:
    seen, _ = query()
    index = PlaceIndex.of([OWN, scrambled(3)], OFFICE.places.sight_m)
    near = index.nearest_to_each(seen.views)
    for most in (1, 10, len(near[0].rows), len(index) - 1):
        rows = index.select(seen.views, near, most)
        assert len(rows) == most or (len(near[0].rows) < len(rows) < most == len(index) - 1)
        assert len(np.unique(rows)) == len(rows)
        assert np.array_equal(rows, index.select(seen.views, near, most))
    assert np.sort(index.select(seen.views, near, len(index))).tolist() == list(range(len(index)))


def test_an_index_is_the_same_from_one_block_and_from_many() -> None:
    whole = PlaceIndex.of([OWN], OFFICE.places.sight_m)
    parts = PlaceIndex.of(
        (
            PlaceBlock(
                SeenPlaces(
                    sight_m=OWN.seen.sight_m,
                    ranges=OWN.seen.ranges[k::3],
                    signatures=OWN.seen.signatures[k::3],
                ),
                OWN.center_m[k::3],
                OWN.session[k::3],
            )
            for k in range(3)
        ),
        OFFICE.places.sight_m,
    )
    order = np.argsort(np.concatenate([np.arange(k, len(whole), 3) for k in range(3)]), kind="stable")
    assert np.array_equal(whole.ranges, parts.ranges[order])
    np.testing.assert_allclose(whole.seen.vectors, parts.seen.vectors[order], atol=1e-4)
    assert whole.nbytes < 200 * len(whole) + 4 * len(whole.raster.rows)
    assert len(PlaceIndex.of([], 5.0)) == 0


def random_ranges(rng: np.random.Generator, count: int) -> tuple[F32, np.ndarray]:
    hidden = rng.random((count, 48)) < 0.3
    return rng.uniform(0, 5, (count, 48)).astype(np.float32), hidden


def test_the_likeness_of_views_and_the_places_beside_them_is_that_of_isovists() -> None:
    rng = np.random.default_rng(1)
    (own_m, own_hidden), (others_m, others_hidden) = random_ranges(rng, 3), random_ranges(rng, 50)
    shift, beside = rng.integers(0, 48, 40), rng.integers(-1, 50, (40, 3))
    others_m[9], others_hidden[9] = (np.roll(v[1], shift[7]) for v in (own_m, own_hidden))
    beside[7, 1] = 9
    own, others = (
        np.where(hidden, 255, np.rint(m * 254 / 5)).astype(np.uint8)
        for m, hidden in ((own_m, own_hidden), (others_m, others_hidden))
    )
    width = int(2 * LIKENESS.range_scale_m * 254 / 5)
    fast = likeness_beside(own, others, shift, beside, width, LIKENESS.prior_share)
    plain = plain_likeness_beside(own, others, shift, beside, width, LIKENESS.prior_share)
    np.testing.assert_allclose(fast, plain, rtol=1e-6)
    assert (fast[beside < 0] == 0).all() and fast[7, 1] == fast.max() > 0.7
    exact = plain_rotate_and_compare(own_m, ~own_hidden, others_m, ~others_hidden)
    for c, u in np.argwhere(beside >= 0).tolist():
        best = max(exact[u, (shift[c] + turn) % 48, beside[c, u]] for turn in (-1, 0, 1))
        assert fast[c, u] == pytest.approx(best, abs=0.03)


def test_a_raster_gives_the_place_next_to_the_middle_of_the_square_in_the_same_session() -> None:
    rng = np.random.default_rng(2)
    center_m = rng.uniform(-10, 10, (300, 2)).astype(np.float32)
    session = rng.choice([3, 70_000], 300).astype(np.int32)
    raster = PlaceRaster.of(center_m, session)
    points = rng.uniform(-14, 14, (200, 2, 2))
    sought = rng.choice([3, 70_000], 200).astype(np.int32)
    found = raster.beside(points, sought)
    square = place_index._SQUARE_M
    for point, number, places in zip(points, sought, found, strict=True):
        members = np.flatnonzero(session == number)
        for at, place in zip(point, places, strict=True):
            middle = (np.floor(at / square) + 0.5) * square
            apart = np.hypot(*(center_m[members] - middle).T)
            expected = members[apart.argmin()] if apart.min() < SELECTION.beside_m - 1e-6 else -1
            assert place == expected


def test_views_outside_of_a_map_count_neither_for_nor_against() -> None:
    evidence = np.array([[3.0, 3.0, 9.0, -9.0], [1.5, 1.5, 1.5, 1.5], [0.0, -7.0, 9.0, 9.0]])
    known = np.array([[1, 1, 0, 0], [1, 1, 1, 1], [1, 1, 0, 0]], bool)
    votes = summed_votes(evidence, known)
    np.testing.assert_allclose(votes, [6.0 / math.sqrt(2.0), 3.0, SELECTION.least_vote / math.sqrt(2.0)])
    # By chance, a placement has the same votes however many of its views lie on the map.
    chance = np.random.default_rng(0).normal(0.5, 0.1, (4000, 8))
    lie_on_it = [np.broadcast_to(np.arange(8) < count, chance.shape) for count in (1, 4, 8)]
    spread = [summed_votes(chance - 0.5, known).std() for known in lie_on_it]
    assert max(spread) / min(spread) < 1.1
