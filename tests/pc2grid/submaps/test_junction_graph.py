"""Thinning, clearance, even sampling and the steps along a skeleton (paper III-A)."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import ndimage
from scipy.spatial import cKDTree

from pc2grid.submaps.junction_graph import (
    _DELETABLE,
    Thinning,
    clearance_of,
    junctions_and_ends,
    sample_evenly,
    thin,
)

EIGHT = np.ones((3, 3))


def plain_thinning(mask: np.ndarray, rule: Thinning) -> np.ndarray:
    """The parallel algorithm as its authors write it: all pixels in every half of every iteration."""
    image = np.pad(mask, 1).astype(np.uint8)
    idle, half = 0, 0
    while idle < 2:
        ring = [
            image[:-2, 1:-1], image[:-2, 2:], image[1:-1, 2:], image[2:, 2:],
            image[2:, 1:-1], image[2:, :-2], image[1:-1, :-2], image[:-2, :-2],
        ]  # fmt: skip
        code = sum(pixel.astype(int) << k for k, pixel in enumerate(ring))
        doomed = (image[1:-1, 1:-1] > 0) & _DELETABLE[rule][half][code]
        idle = 0 if doomed.any() else idle + 1
        image[1:-1, 1:-1][doomed] = 0
        half = 1 - half
    return np.asarray(image[1:-1, 1:-1] > 0)


def blobs(seed: int, size: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.asarray(ndimage.gaussian_filter(rng.random((size, size)), rng.uniform(0.3, 3)) > 0.5)


@pytest.mark.parametrize("rule", ["guo_hall", "zhang_suen"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_work_lists_give_what_the_parallel_algorithm_gives(rule: Thinning, seed: int) -> None:
    mask = blobs(seed)
    assert np.array_equal(thin(mask, rule), plain_thinning(mask, rule))


@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_guo_hall_keeps_components_and_holes(seed: int) -> None:
    mask = np.pad(blobs(seed), 1)
    thinned = thin(mask)
    assert not (thinned & ~mask).any()
    assert ndimage.label(thinned, EIGHT)[1] == ndimage.label(mask, EIGHT)[1]
    assert ndimage.label(~thinned)[1] == ndimage.label(~mask)[1]


def test_clearance_is_the_distance_to_the_nearest_cell_that_is_not_free() -> None:
    free = np.ones((41, 41), bool)
    free[20, 20] = False
    clearance = clearance_of(free, 0.05)
    exact = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * 0.05
    assert np.abs(clearance - exact).max() <= 0.03 * exact.max()


def junctions(skeleton: np.ndarray) -> np.ndarray:
    pixels = np.argwhere(skeleton)
    return pixels[junctions_and_ends(skeleton, pixels)[0]]


def ends(skeleton: np.ndarray) -> np.ndarray:
    pixels = np.argwhere(skeleton)
    return pixels[junctions_and_ends(skeleton, pixels)[1]]


def test_junctions_and_ends_of_a_cross() -> None:
    cross = np.zeros((31, 31), bool)
    cross[15, 3:28] = cross[3:28, 15] = True
    assert [15, 15] in junctions(cross).tolist()
    assert np.abs(junctions(cross) - 15).max() <= 1
    assert sorted(ends(cross).tolist()) == [[3, 15], [15, 3], [15, 27], [27, 15]]
    line = np.zeros((9, 9), bool)
    np.fill_diagonal(line, True)
    assert not len(junctions(line))


@given(seed=st.integers(0, 10_000), spacing=st.floats(1.0, 12.0))
@settings(max_examples=25, deadline=None)
def test_samples_are_apart_and_cover(seed: int, spacing: float) -> None:
    cells = np.argwhere(np.random.default_rng(seed).random((50, 50)) < 0.1)
    kept = sample_evenly(cells, spacing)
    if len(kept) > 1:
        assert cKDTree(kept).query(kept, k=2)[0][:, 1].min() >= spacing - 1e-6
    if len(cells):
        assert cKDTree(kept).query(cells)[0].max() < spacing


@given(seed=st.integers(0, 10_000), spacing=st.sampled_from([1.0, 2.0, 3.7, 10.0, 25.0]))
@settings(max_examples=25, deadline=None)
def test_sampling_is_greedy_in_the_order_given(seed: int, spacing: float) -> None:
    cells = np.argwhere(np.random.default_rng(seed).random((60, 60)) < 0.2)
    kept: list[np.ndarray] = []
    for cell in cells:
        if not kept or np.linalg.norm(np.array(kept) - cell, axis=1).min() >= spacing - 1e-9:
            kept.append(cell)
    assert np.array_equal(sample_evenly(cells, spacing), kept)
