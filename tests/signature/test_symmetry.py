"""Reflection symmetry scores (paper III-D)."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from signature.boundary import boundary_edges
from signature.config import SignatureConfig
from signature.symmetry import blurred, line_segments, reflection_score, symmetry_axes, symmetry_scores
from tests.helpers.rooms import (
    RESOLUTION_M,
    canvas,
    cross,
    l_shape,
    rectangle,
    submap_of,
)

CONFIG = SignatureConfig()


def edges_of(cells: np.ndarray) -> np.ndarray:
    return boundary_edges(submap_of(cells), CONFIG)


def scores(cells: np.ndarray) -> np.ndarray:
    return symmetry_scores(edges_of(cells), RESOLUTION_M, CONFIG)


def line(angle_deg: float, length: float = 100.0) -> list[float]:
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return [0.0, 0.0, length * c, length * s]


def test_axes_are_the_directions_with_the_most_length() -> None:
    axes = symmetry_axes(np.array([line(20), line(20), line(110, 150), line(70, 30)]), CONFIG)
    assert axes is not None
    assert math.degrees(axes.alpha_rad) == pytest.approx(20, abs=0.5)
    assert math.degrees(axes.beta_rad) == pytest.approx(110, abs=0.5)


def test_a_plain_vote_counts_segments_not_metres() -> None:
    segments = np.array([line(20.4, 300), line(80, 10), line(80, 10), line(110, 10)])
    by_length = symmetry_axes(segments, CONFIG)
    plain = symmetry_axes(segments, CONFIG.model_copy(update={"axis_vote": "plain"}))
    assert by_length is not None and plain is not None
    assert math.degrees(by_length.alpha_rad) == pytest.approx(20.4, abs=0.1)
    assert math.degrees(plain.alpha_rad) == pytest.approx(80)  # a whole degree
    assert math.degrees(plain.beta_rad) == pytest.approx(20)


def test_short_segments_are_not_lines() -> None:
    edges = np.zeros((321, 321), bool)
    edges[100, 100:105] = True  # 0.25 m
    assert len(line_segments(edges, RESOLUTION_M, CONFIG)) == 0
    edges[200, 100:140] = True
    segments = line_segments(edges, RESOLUTION_M, CONFIG)
    assert len(segments) >= 1
    assert (np.hypot(*(segments[:, 2:] - segments[:, :2]).T) * RESOLUTION_M >= 0.3 - 1e-6).all()


def test_a_straight_line_peaks_at_the_stated_value() -> None:
    edges = np.zeros((101, 101), bool)
    edges[50, 10:91] = True
    assert blurred(edges, RESOLUTION_M, CONFIG)[50, 50] == pytest.approx(CONFIG.symmetry_peak, rel=0.02)


def test_eq_5_by_hand() -> None:
    image = np.zeros((5, 5), np.float32)
    image[1, 3], image[4, 0] = 10.0, 30.0
    # Upright axis: columns swap, (1, 1) -> (1, 3) and (4, 4) -> (4, 0), (0, 0) -> (0, 4).
    cells = np.array([[1, 1], [4, 4], [0, 0]])
    assert reflection_score(cells, image, math.pi / 2) == pytest.approx(40 / 3)
    # Level axis: rows swap, (3, 3) -> (1, 3).
    assert reflection_score(np.array([[3, 3]]), image, 0.0) == pytest.approx(10.0)
    # Diagonal axis: row and column swap.
    assert reflection_score(np.array([[3, 1], [0, 4]]), image, math.pi / 4) == pytest.approx((10 + 30) / 2)


@pytest.mark.parametrize("shape", [(1, 1), (7, 40), (101, 90)])
@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_a_few_cells_are_blurred_as_opencv_blurs_all_of_them(shape: tuple[int, int], share: float) -> None:
    edges = np.random.default_rng(1).random(shape) < share
    sigma, peak = CONFIG.symmetry_blur_m / RESOLUTION_M, CONFIG.symmetry_peak
    plain = cv2.GaussianBlur(
        edges.astype(np.float32), (2 * math.ceil(3 * sigma) + 1,) * 2, sigma, borderType=cv2.BORDER_CONSTANT
    )
    expected = np.minimum(plain * peak * sigma * math.sqrt(2 * math.pi), peak)
    assert blurred(edges, RESOLUTION_M, CONFIG) == pytest.approx(expected, abs=1e-4)


def test_a_mirrored_room_scores_higher_than_an_l_shape() -> None:
    for symmetric in (rectangle(8.0, 6.0), cross(6.0, 2.0)):
        assert scores(symmetric).min() > 1.5 * scores(l_shape()).max()
    assert scores(rectangle(8.0, 6.0)).min() > 0.9 * CONFIG.symmetry_peak


def test_without_walls_there_is_no_axis() -> None:
    assert symmetry_axes(np.empty((0, 4)), CONFIG) is None
    assert scores(canvas()).tolist() == [0.0, 0.0]
