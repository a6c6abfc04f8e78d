"""What is seen from the viewpoints of places, in 8 bits a number."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.submaps.submaps import HIDDEN, look_around
from signature.visible import (
    AROUND_M,
    LATTICE_M,
    PROFILE_BEARINGS,
    SIGNATURE_COLUMNS,
    SeenPlaces,
    seen_signatures,
    viewpoints_of,
)
from tests.helpers.simulated_drives import office

SIGHT_M = 5.0
CENTERS_M = np.array([(x, y) for x in (1.5, 5.0, 9.0) for y in (2.0, 6.5)])


def test_signatures_are_those_of_the_isovists_but_for_rounding() -> None:
    grid = office().crop((6.0, 5.0), 4.5)
    seen = SeenPlaces.of(grid, CENTERS_M, SIGHT_M)
    at_m = seen.at_m.astype(np.float64)
    ranges_m, ends = look_around(grid, at_m, SIGHT_M, bearings=PROFILE_BEARINGS)
    assert (ends == HIDDEN).any() and not (ends == HIDDEN).all()
    assert seen.signatures.shape == (len(seen), SIGNATURE_COLUMNS)
    np.testing.assert_allclose(seen.shares, seen_signatures(ranges_m, ends, SIGHT_M), atol=0.5 / 255 + 1e-6)


def test_viewpoints_are_a_lattice_on_free_ground_around_each_place() -> None:
    grid = office()
    at_m, place = viewpoints_of(grid, CENTERS_M)
    squares = at_m / LATTICE_M
    np.testing.assert_allclose(squares, np.rint(squares), atol=1e-4)
    cells = grid.to_cell(at_m.astype(np.float64))
    assert grid.free[cells[:, 0], cells[:, 1]].all()
    apart = np.hypot(*(at_m[:, None] - CENTERS_M[None]).transpose(2, 0, 1))
    assert np.array_equal(place, apart.argmin(axis=1)) and apart.min(axis=1).max() <= AROUND_M + 1e-6
    assert np.array_equal(np.unique(place), np.arange(len(CENTERS_M))) and (np.diff(place) >= 0).all()
    # A disc of 1.2 m has 28 squares of 0.4 m; walls are in the way of some.
    assert 10 < np.bincount(place).mean() < 30


def test_a_place_without_room_is_its_own_viewpoint() -> None:
    in_the_wall = np.array([[0.02, 3.33]])
    at_m, place = viewpoints_of(office(), np.concatenate((CENTERS_M, in_the_wall)))
    mine = at_m[place == len(CENTERS_M)]
    assert len(mine) >= 1
    at_m, place = viewpoints_of(office(), np.array([[-50.0, -50.0]]))
    assert at_m.tolist() == [[-50.0, -50.0]] and place.tolist() == [0]
    assert len(viewpoints_of(office(), np.empty((0, 2)))[0]) == 0


def test_each_viewpoint_has_its_signatures() -> None:
    whole = SeenPlaces.of(office(), CENTERS_M, SIGHT_M)
    with pytest.raises(ValueError):
        SeenPlaces(at_m=whole.at_m, place=whole.place, signatures=whole.signatures[:2])
