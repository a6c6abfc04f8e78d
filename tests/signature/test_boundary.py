"""Boundary histogram (paper III-B)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from signature.boundary import (
    ROUNDING_BINS,
    boundary_bins,
    boundary_edges,
    boundary_histogram,
    boundary_points,
    normalized,
)
from signature.config import SignatureConfig
from tests.helpers.rooms import RESOLUTION_M, rectangle, submap_of

CONFIG = SignatureConfig()


def histogram(cells: np.ndarray, config: SignatureConfig = CONFIG) -> np.ndarray:
    points = boundary_points(boundary_edges(submap_of(cells), config), RESOLUTION_M, config)
    return boundary_histogram(points, 8.0, RESOLUTION_M, config)


def brute_force(points: np.ndarray, config: SignatureConfig) -> np.ndarray:
    """Eq. 1-2 pair by pair, exactly: bin k holds k * bin <= d < (k + 1) * bin, in whole cells squared."""
    bins = boundary_bins(8.0, config)
    counts = np.zeros(bins)
    edge_cells = config.boundary_bin_m / RESOLUTION_M
    edges2 = np.array([round((k * edge_cells) ** 2, 6) for k in range(1, bins)])
    for i, (r, c) in enumerate(points):
        for s, d in points[i + 1 :]:
            counts[np.searchsorted(edges2, (r - s) ** 2 + (c - d) ** 2, side="right")] += 1
    return counts / max(counts.sum(), 1)


def test_number_of_bins_is_that_of_the_paper() -> None:
    assert boundary_bins(8.0, CONFIG) == 80
    assert boundary_bins(8.0, SignatureConfig(boundary_bin_m=0.3)) == 54


def test_two_points_fill_one_bin_and_an_edge_goes_up() -> None:
    # 20 cells of 0.05 m are 1.0 m: the upper of the two bins that meet there, number 5.
    found = boundary_histogram(np.array([[0, 0], [0, 20]]), 8.0, RESOLUTION_M, CONFIG)
    assert np.flatnonzero(found).tolist() == [5]
    assert found[5] == 1.0


def test_the_longest_distance_counts_in_the_last_bin() -> None:
    found = boundary_histogram(np.array([[0, 0], [0, 320]]), 8.0, RESOLUTION_M, CONFIG)
    assert np.flatnonzero(found).tolist() == [79]


def test_three_corners_by_hand() -> None:
    # 3-4-5 triangle in metres: distances 3, 4 and 5 m, a third each.
    found = boundary_histogram(np.array([[0, 0], [0, 60], [80, 0]]), 8.0, RESOLUTION_M, CONFIG)
    assert {k: round(float(found[k]), 6) for k in np.flatnonzero(found)} == {
        15: 0.333333,
        20: 0.333333,
        25: 0.333333,
    }


@given(seed=st.integers(0, 10_000), count=st.integers(0, 60), bin_m=st.sampled_from([0.1, 0.2, 0.3, 0.25]))
@settings(max_examples=40, deadline=None)
def test_matches_brute_force(seed: int, count: int, bin_m: float) -> None:
    config = SignatureConfig(boundary_bin_m=bin_m)
    points = np.random.default_rng(seed).integers(0, 226, (count, 2))
    found = boundary_histogram(points, 8.0, RESOLUTION_M, config)
    assert found == pytest.approx(brute_force(points, config), abs=1e-6)


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(0, 200),
    cell_m=st.sampled_from([0.05, 0.05000000074505806, 0.1, 0.03]),
    bin_m=st.sampled_from([0.1, 0.2, 0.3, 0.25]),
)
@settings(max_examples=40, deadline=None)
def test_the_compiled_counts_of_cells_are_those_of_their_distances(
    seed: int, count: int, cell_m: float, bin_m: float
) -> None:
    """Of squares in whole cells as of distances as floating point, bit for bit; some are longer than 2 r."""
    config = SignatureConfig(boundary_bin_m=bin_m)
    points = np.random.default_rng(seed).integers(0, 400, (count, 2))
    bins = boundary_bins(8.0, config)
    at = (pdist(points * (cell_m / bin_m)) + ROUNDING_BINS).astype(np.int64)
    plain = np.bincount(np.minimum(at, bins - 1), minlength=bins)
    assert np.array_equal(boundary_histogram(points, 8.0, cell_m, config), normalized(plain))


def test_only_clearly_occupied_cells_are_boundary() -> None:
    cells = rectangle(6.0, 6.0)
    cells[100:200, 130] = 50  # perhaps a wall
    assert np.array_equal(histogram(cells), histogram(rectangle(6.0, 6.0)))
    cells[100:200, 130] = 65
    assert not np.array_equal(histogram(cells), histogram(rectangle(6.0, 6.0)))
