"""The likeness of isovists at every rotation."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.arrays import F32, F64
from signature.retrieval.likeness import LIKENESS, peaks, rotate_and_compare


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
