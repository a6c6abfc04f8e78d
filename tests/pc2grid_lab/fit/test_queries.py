"""Pairs of descriptions of one place, from which the weights of the signatures are learned."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pc2grid.observer import TimeSpan
from pc2grid_lab.fit import queries
from pc2grid_lab.fit.queries import KnownWindow, office_floor, pairs_of
from pc2grid_lab.recordings.catalogue import Catalogue
from pc2grid_lab.recordings.run import Folder
from signature.config import Config
from signature.places.query import Query
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})


def test_a_view_of_a_query_is_like_what_the_map_shows_there() -> None:
    """A drive of 8 m in the office, asked in its map; an office floor has the other places."""
    window, first = Query(OFFICE.made_with, OFFICE.config), None
    for registered, planar_scan, truth in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        first = first or truth
        window.add(registered, planar_scan)
    assert first is not None
    pairs = pairs_of([(window.map(), first, office())], [office_floor(1)], Config())
    assert pairs.queries.shape == pairs.same.shape and len(pairs.queries) >= 8
    one = np.linalg.norm(pairs.queries - pairs.same, axis=1)
    two = np.linalg.norm(pairs.queries[:, None] - pairs.other[None], axis=2)
    assert np.median(one) < np.percentile(two, 25)


def test_windows_are_taken_one_at_a_time_where_the_map_knows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    window, taken = Query(OFFICE.made_with, OFFICE.config), []
    for registered, planar_scan, truth in drive(office(), [(1.5, 7.0), (4.5, 7.0)]):
        window.add(registered, planar_scan)
        end = truth
    query, pair = window.map(), Catalogue.of().pairs[0]

    def known() -> Iterator[KnownWindow]:
        for covered in (False, True, True):
            taken.append(covered)
            yield KnownWindow(pair, TimeSpan(0.0, 3.0), query, None, query, {"office": end}, covered)

    monkeypatch.setattr(queries, "index_of_database", lambda _: OFFICE)
    asked = queries.in_maps(known(), Folder(Path("data"), Path("work")))
    _, T_map_query, grid = next(asked)
    assert taken == [False, True] and grid is OFFICE.grid_of(0)
    assert T_map_query.apply(np.array([query.center_m]))[0] == pytest.approx((end.x, end.y))
    assert len(list(asked)) == 1
