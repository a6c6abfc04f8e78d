"""Pairs of descriptions of one place, from which the weights of the signatures are learned."""

from __future__ import annotations

import numpy as np

from pc2grid.geometry import SE2
from pc2grid_lab.fit.queries import office_floor, pairs_of
from signature.config import Config
from signature.localization.query import Query
from tests.helpers.simulated_drives import building, drive, office

OFFICE = building({"office": office()})


def test_a_view_of_a_query_is_like_what_the_map_shows_there() -> None:
    """A drive of 8 m in the office, asked in its map; an office floor has the other places."""
    window, first = Query(OFFICE.made_with, OFFICE.config), None
    for registered, planar_scan, truth in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        first = first or truth
        window.add(registered, planar_scan)
    assert first is not None
    pairs = pairs_of([(window.map(), first, [(office(), SE2())])], [office_floor(1)], Config())
    assert pairs.queries.shape == pairs.same.shape and len(pairs.queries) >= 8
    one = np.linalg.norm(pairs.queries - pairs.same, axis=1)
    two = np.linalg.norm(pairs.queries[:, None] - pairs.other[None], axis=2)
    assert np.median(one) < np.percentile(two, 25)
