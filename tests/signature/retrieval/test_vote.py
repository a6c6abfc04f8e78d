"""Views, retrieval by signatures and isovists, and the calibration of the probabilities."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from pc2grid.geometry import SE2
from signature.localization.query import Query
from signature.retrieval.likeness import LIKENESS, peaks, rotate_and_compare
from signature.retrieval.vote import distinct_placements, retrieve, view_scores
from tests.helpers.simulated_drives import building, drive, office


def plain_rotate_and_compare(
    ranges_m: F32, seen: NDArray[np.bool_], others_m: F32, others_seen: NDArray[np.bool_]
) -> F64:
    """Likeness (V, B, N), 0..1, of isovists (V, B) with others (N, B), for each rotation by 2 pi s / B.

    The mean over the rays that both sides know of a triangular kernel of the difference of their ranges, with
    `LikenessParameters.prior_share` added to the number of rays.
    """
    bearings = ranges_m.shape[1]
    likeness = np.empty((len(ranges_m), bearings, len(others_m)))
    for shift in range(bearings):
        other, known = np.roll(others_m, -shift, axis=1), np.roll(others_seen, -shift, axis=1)
        both = seen[:, None] & known
        apart = np.abs(ranges_m[:, None] - other) / (2.0 * LIKENESS.range_scale_m)
        total = (np.maximum(0.0, 1.0 - apart) * both).sum(axis=2)
        likeness[:, shift] = total / (both.sum(axis=2) + LIKENESS.prior_share * bearings)
    return likeness


OFFICE = building({"office": office()})


def window(corners: list[tuple[float, float]], field_deg: float = 360.0) -> tuple[Query, SE2]:
    """The query map of a drive, and its frame in the office."""
    seen = Query(OFFICE.made_with, OFFICE.config)
    first: SE2 | None = None
    for registered, planar_scan, truth in drive(office(), corners, field_rad=math.radians(field_deg)):
        first = first or truth
        seen.add(registered, planar_scan)
    assert first is not None
    return seen, first


@pytest.mark.parametrize("field_deg", [360.0, 270.0, 90.0])
def test_the_right_place_is_among_the_first_twenty(field_deg: float) -> None:
    seen, T_map_query = window([(1.5, 7.0), (9.5, 7.0)], field_deg)
    query = seen.map()
    found = retrieve(
        query.views,
        (query.T_odom_base.x, query.T_odom_base.y),
        OFFICE.places,
        config=OFFICE.config,
        top_k=20,
    )
    assert len(found) == 20
    assert [p.likeness for p in found] == sorted((p.likeness for p in found), reverse=True)
    right = [
        p
        for p in found
        if math.dist(
            T_map_query.apply(np.array([query.views[p.view].center_m]))[0],
            OFFICE.places.table.center_m[p.row],
        )
        <= 1.0
    ]
    assert right
    turns = [abs(math.remainder(p.yaw_rad - T_map_query.yaw, 2 * math.pi)) for p in right]
    assert min(turns) < math.radians(10)
    bases = [SE2(*p.at_m, p.yaw_rad) @ SE2(*query.views[p.view].center_m).inverse() for p in found]
    poses = [b @ query.T_odom_base for b in bases]
    for i, a in enumerate(poses):
        for b in poses[:i]:
            turn = abs(math.remainder(a.yaw - b.yaw, 2 * math.pi))
            assert max(abs(a.x - b.x), abs(a.y - b.y)) > 0.7 or turn > math.radians(14)


def test_isovists_are_compared_only_at_the_places_that_the_signatures_select() -> None:
    seen, _ = window([(1.5, 7.0), (9.5, 7.0)])
    query = seen.map()
    for shortlist in (5, 20):
        config = OFFICE.config.model_copy(update={"shortlist": shortlist, "shortlist_share": 0.0})
        base_m = (query.T_odom_base.x, query.T_odom_base.y)
        found = retrieve(query.views, base_m, OFFICE.places, config=config)
        selected = OFFICE.places.select(query.views, config).rows
        assert len(selected) == shortlist
        assert OFFICE.places._last is not None
        assert np.array_equal(OFFICE.places._last[0], selected)
        assert {proposal.row for proposal in found} <= set(selected.tolist())


def test_every_view_has_a_viewpoint_beside_it_that_belongs_to_the_nearest_place() -> None:
    places, grid = OFFICE.places, office()
    rows = np.arange(len(places.table))
    stand = places.around(rows)
    cells = grid.to_cell(stand.at_m)
    assert grid.free[cells[:, 0], cells[:, 1]].all()
    apart = np.hypot(*(stand.at_m[:, None] - places.table.center_m[None]).transpose(2, 0, 1))
    # Viewpoints are kept to a thousandth of a millimetre.
    assert (apart[np.arange(len(apart)), stand.place] <= apart.min(axis=1) + 1e-5).all()
    rng = np.random.default_rng(0)
    on_the_way = rng.uniform((0.5, 6.6), (19.5, 7.4), (50, 2))
    found = stand.beside(on_the_way, np.zeros(50, np.int64))
    assert (found < len(stand.at_m)).all()
    assert np.hypot(*(stand.at_m[found] - on_the_way).T).max() < 0.29
    assert (stand.beside(on_the_way, np.ones(50, np.int64)) == len(stand.at_m)).all()


def test_views_lie_apart_and_on_what_was_seen() -> None:
    seen, _ = window([(1.5, 7.0), (9.5, 7.0)], 90.0)
    query = seen.map()
    centers = np.array([v.center_m for v in query.views])
    apart = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1))
    assert 2 <= len(centers) <= OFFICE.config.views
    assert apart[~np.eye(len(centers), dtype=bool)].min() >= OFFICE.config.view_spacing_m
    cells = query.grid.to_cell(centers)
    assert (query.grid.cells[cells[:, 0], cells[:, 1]] >= 0).all()


def test_a_window_forgets_what_lies_farther_back() -> None:
    config = OFFICE.config.model_copy(update={"window_m": 3.0})
    long, short = (
        Query(OFFICE.made_with, OFFICE.config),
        Query(OFFICE.made_with, config),
    )
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        for seen in (long, short):
            seen.add(registered, planar_scan)
    assert long.path_m == pytest.approx(short.path_m) == pytest.approx(7.8, abs=0.3)
    assert len(short.map().keyframes) < 20 < len(long.map().keyframes)


def test_standing_still_adds_nothing() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    registered, planar_scan, _ = next(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for _ in range(50):
        seen.add(registered, planar_scan)
    assert len(seen.map().keyframes) == 2 and seen.path_m == 0.0  # the first one and the newest


@pytest.mark.parametrize(("bearings", "longest_m"), [(48, 5.0), (90, 5.0), (48, 80.0)])
def test_the_compiled_comparison_is_the_plain_one(bearings: int, longest_m: float) -> None:
    rng = np.random.default_rng(0)
    ranges, others = (rng.uniform(0, longest_m, (n, bearings)).astype(np.float32) for n in (2, 700))
    seen, others_seen = rng.random((2, bearings)) < 0.8, rng.random((700, bearings)) < 0.8
    others[3], others_seen[3] = np.roll(ranges[1], 20), np.roll(seen[1], 20)
    seen[0, 5:] = False
    others_seen[600] = False
    fast = rotate_and_compare(ranges, seen, others, others_seen)
    assert fast.shape == (2, bearings, 700)
    plain = plain_rotate_and_compare(ranges, seen, others, others_seen)
    assert np.abs(fast - plain).max() < 0.002 * max(1.0, longest_m / 20)
    assert np.unravel_index(np.argmax(fast[1]), fast[1].shape) == (20, 3)


def test_a_view_scores_what_it_would_see_or_nothing() -> None:
    rng = np.random.default_rng(0)
    likeness = rng.random((3, 48, 10)).astype(np.float32)
    shift, beside = rng.integers(0, 48, 40), rng.integers(0, 11, (40, 3))
    scores = view_scores(likeness, shift, beside)
    for c, u in np.ndindex(scores.shape):
        near = (
            [likeness[u, (shift[c] + turn) % 48, beside[c, u]] for turn in (-1, 0, 1)]
            if beside[c, u] < 10
            else [-1]
        )
        assert scores[c, u] == max(near)


def test_peaks_are_found_around_the_circle_and_one_on_each_plateau() -> None:
    rng = np.random.default_rng(2)
    likeness = rng.integers(0, 4, (12, 30)).astype(np.float32)
    likeness[:, 0] = 1.0  # as good everywhere: no peak
    columns = rng.permutation(30)[:20]
    columns[0] = 0
    at, shift = peaks(likeness, columns)
    expected = [
        (column, k)
        for column in columns.tolist()
        for k in range(12)
        if likeness[k - 1, column] <= likeness[k, column] > likeness[(k + 1) % 12, column]
    ]
    assert list(zip(at.tolist(), shift.tolist(), strict=True)) == expected
    assert 0 in shift and 11 in shift and 0 not in at


def test_placements_beside_a_better_one_are_left_out() -> None:
    base = np.array([[0.0, 0.0], [0.3, 0.3], [0.3, 0.3], [0.3, 0.3], [0.0, 5.0], [9.0, 0.0]])
    yaw = np.array([math.pi - 0.01, 0.01 - math.pi, 0.0, 0.01 - math.pi, 0.0, 0.0])
    session = np.array([0, 0, 0, 1, 0, 0])
    order = np.array([0, 1, 2, 3, 4, 5])
    assert distinct_placements(order, base, yaw, session, 10).tolist() == [0, 2, 3, 4, 5]
    assert distinct_placements(order, base, yaw, session, 3).tolist() == [0, 2, 3]
    assert distinct_placements(order[::-1].copy(), base, yaw, session, 10).tolist() == [5, 4, 3, 2, 1]
