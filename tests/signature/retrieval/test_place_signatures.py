"""The first look: which places the signatures of the paper leave for a closer one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pc2grid.simulate import office_floorplan
from pc2grid.submaps.partition import partition
from signature.config import Config
from signature.describe import describe
from signature.localization.query import query_of
from signature.retrieval.place_signatures import (
    SHARE,
    PlaceSignatures,
    columns_of,
    table_rows,
    view_rows,
)
from signature.similarity import SignatureTable
from tests.helpers.simulated_drives import building, office

OFFICE = building({"office": office()})
CONFIG = Config()
OWN = OFFICE.places.table


def with_floors(floors: int) -> SignatureTable:
    """The places of the office among those of floors of other buildings."""
    tables = [OWN]
    for seed in range(1, floors + 1):
        submaps = partition(office_floorplan(seed), CONFIG.partition)
        signatures = [describe(submap, CONFIG.signature) for submap in submaps]
        centers_m = [submap.center_m for submap in submaps]
        tables.append(SignatureTable.of(signatures, centers_m, session_index=np.full(len(submaps), seed)))
    return SignatureTable.concatenated(tables)


TABLE = with_floors(3)
VIEWS = query_of(office(), np.array([(3.0, 7.0), (9.0, 7.0)]), CONFIG, CONFIG.relocalize).views


def test_the_places_of_the_query_stay_and_most_others_do_not() -> None:
    look = PlaceSignatures.of(TABLE)
    assert look is not None
    stays = look.likely(VIEWS, 1)
    each = np.ceil(SHARE * len(TABLE))
    assert each <= stays.sum() <= len(VIEWS) * each
    assert stays.mean() < 0.6
    views_m = np.array([view.center_m for view in VIEWS])
    apart_m = np.hypot(*(TABLE.center_m[:, None] - views_m[None]).transpose(2, 0, 1)).min(axis=1)
    # The views see the whole map, so that a place half a metre from one is described almost equally.
    here = (TABLE.session_index == 0) & (apart_m < 0.5)
    assert here.sum() >= 3
    assert stays[here].mean() >= 0.8


def test_without_the_signatures_of_the_places_the_look_is_worth_nothing() -> None:
    """With the signatures of the places shuffled, another place looks like each view."""
    order = np.random.default_rng(0).permutation(len(TABLE))
    histograms = {name: getattr(TABLE, name)[order] for name in ("boundary", "freespace", "symmetry")}
    look, mixed = PlaceSignatures.of(TABLE), PlaceSignatures.of(replace(TABLE, **histograms))
    assert look is not None and mixed is not None
    np.testing.assert_allclose(mixed.distances(VIEWS), look.distances(VIEWS)[order], rtol=1e-4, atol=1e-2)
    assert not np.array_equal(mixed.likely(VIEWS, 1), look.likely(VIEWS, 1))


def test_each_view_keeps_its_own_places() -> None:
    """A view of which little was seen does not push out those that the others keep."""
    look = PlaceSignatures.of(TABLE)
    assert look is not None
    together = look.likely(VIEWS, 1)
    one_by_one = np.array([look.likely([view], 1) for view in VIEWS])
    np.testing.assert_array_equal(together, one_by_one.any(axis=0))


def test_no_fewer_places_stay_than_can_be_selected_and_all_without_a_view() -> None:
    look = PlaceSignatures.of(TABLE)
    assert look is not None
    count = len(TABLE)
    for most in (1, count // 4, count // 2, count, 10 * count):
        assert look.likely(VIEWS, most).sum() >= min(most, count)
    assert look.likely((), 1).all()


def test_histograms_with_other_bins_cannot_be_looked_at() -> None:
    """The discs of the paper, of 8 m, have more bins than the weights were learned for."""
    paper = Config.paper()
    submaps = partition(office(), paper.partition)
    table = SignatureTable.of(
        [describe(submap, paper.signature) for submap in submaps], [submap.center_m for submap in submaps]
    )
    assert PlaceSignatures.of(table) is None


def test_rows_are_roots_of_shares_and_what_was_seen() -> None:
    rows, (boundary, freespace, _) = table_rows(OWN), columns_of(OWN)
    squares = rows.astype(np.float64) ** 2
    np.testing.assert_allclose(squares[:, :boundary].sum(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(squares[:, boundary : boundary + freespace].sum(axis=1), 1.0, atol=1e-5)
    assert (rows[:, -1] == 1.0).all()
    assert view_rows(VIEWS)[:, -1] == pytest.approx([view.profile.observed for view in VIEWS])
