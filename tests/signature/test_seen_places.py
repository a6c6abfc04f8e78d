"""What is seen from places, in 8 bits a number."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.submaps.isovist import HIDDEN, look_around
from signature.seen import seen_signatures
from signature.seen_places import (
    PROFILE_BEARINGS,
    RANGE_UNITS,
    SIGNATURE_COLUMNS,
    UNSEEN,
    SeenPlaces,
    in_units,
)
from tests.helpers.simulated_drives import office

SIGHT_M = 5.0
CENTERS_M = np.array([(x, y) for x in (1.5, 5.0, 9.0) for y in (2.0, 6.5)])


def test_ranges_and_signatures_are_those_of_the_isovists_but_for_rounding() -> None:
    grid = office().crop((6.0, 5.0), 4.5)
    seen = SeenPlaces.of(grid, CENTERS_M, SIGHT_M)
    ranges_m, ends = look_around(grid, CENTERS_M, SIGHT_M, bearings=PROFILE_BEARINGS)
    hidden = ends == HIDDEN
    assert hidden.any() and not hidden.all()
    assert np.array_equal(seen.ranges == UNSEEN, hidden)
    step_m = SIGHT_M / RANGE_UNITS
    np.testing.assert_allclose(seen.ranges[~hidden] * step_m, ranges_m[~hidden], atol=0.5 * step_m + 1e-5)
    signatures = seen_signatures(ranges_m, ends, SIGHT_M)
    assert seen.signatures.shape == (len(CENTERS_M), SIGNATURE_COLUMNS)
    np.testing.assert_allclose(seen.shares, signatures, atol=0.5 / 255 + 1e-6)


def test_the_longest_range_is_not_taken_for_a_hidden_one() -> None:
    assert in_units(np.array([[0.0, 5.0, 5.02]], np.float32), 5.0).tolist() == [[0, 254, 254]]


def test_parts_make_the_whole() -> None:
    whole = SeenPlaces.of(office(), CENTERS_M, SIGHT_M)
    joined = SeenPlaces.concatenated(
        [SeenPlaces.of(office(), CENTERS_M[part], SIGHT_M) for part in (slice(0, 2), slice(2, None))]
    )
    assert np.array_equal(joined.ranges, whole.ranges) and np.array_equal(joined.signatures, whole.signatures)
    assert len(joined) == len(CENTERS_M) and joined.sight_m == SIGHT_M
    with pytest.raises(ValueError):
        SeenPlaces(sight_m=5.0, ranges=whole.ranges, signatures=whole.signatures[:2])
