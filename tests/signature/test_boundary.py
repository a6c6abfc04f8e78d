"""Boundary histogram (paper III-B)."""

import itertools
import math

import cv2
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.distance import pdist

from pc2grid.geometry import cells_of
from pc2grid.model import FREE, OCCUPIED, UNKNOWN
from pc2grid.submaps.junction_graph import ROUNDING, sample_evenly, thin
from signature.boundary import (
    boundary_bins,
    boundary_edges,
    boundary_histogram,
    boundary_points,
    normalized,
)
from signature.config import SignatureConfig
from signature.freespace import (
    freespace_bins,
    freespace_graph,
    freespace_histogram,
    freespace_nodes,
    shortest_paths,
    visibility_graph,
)
from signature.symmetry import blurred, line_segments, reflection_score, symmetry_axes, symmetry_scores
from tests.helpers.rooms import (
    RESOLUTION_M,
    canvas,
    cross,
    grid_of,
    l_shape,
    random_rooms,
    rectangle,
    submap_of,
)

CONFIG = SignatureConfig()


def histogram(cells: np.ndarray, config: SignatureConfig = CONFIG) -> np.ndarray:
    points = boundary_points(boundary_edges(submap_of(cells), config), RESOLUTION_M, config)
    return boundary_histogram(points, 8.0, RESOLUTION_M, config)


def test_number_of_bins_is_that_of_the_paper() -> None:
    assert boundary_bins(8.0, CONFIG) == freespace_bins(8.0, CONFIG) == 80
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
    assert found[[15, 20, 25]] == pytest.approx(1 / 3) and np.count_nonzero(found) == 3


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
    """Eq. 1-2; of squares in whole cells as of distances, bit for bit; some are longer than 2 r."""
    config = SignatureConfig(boundary_bin_m=bin_m)
    points = np.random.default_rng(seed).integers(0, 400, (count, 2))
    bins = boundary_bins(8.0, config)
    at = (pdist(points * (cell_m / bin_m)) + ROUNDING).astype(np.int64)
    plain = np.bincount(np.minimum(at, bins - 1), minlength=bins)
    assert np.array_equal(boundary_histogram(points, 8.0, cell_m, config), normalized(plain))


def test_only_clearly_occupied_cells_are_boundary() -> None:
    cells = rectangle(6.0, 6.0)
    cells[100:200, 130] = 50  # perhaps a wall
    assert np.array_equal(histogram(cells), histogram(rectangle(6.0, 6.0)))
    cells[100:200, 130] = 65
    assert not np.array_equal(histogram(cells), histogram(rectangle(6.0, 6.0)))


# --- Free-space histogram (paper III-C) ---


def parts(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    submap = submap_of(cells)
    lengths = shortest_paths(freespace_graph(submap, CONFIG))
    return freespace_nodes(submap, CONFIG), lengths, freespace_histogram(lengths, 8.0, CONFIG)


def joined(nodes: np.ndarray, occupied: np.ndarray, config: SignatureConfig = CONFIG) -> nx.Graph:
    """The visibility graph of places of a grid with these walls."""
    cells = np.where(occupied, OCCUPIED, FREE).astype(np.int8)
    return visibility_graph(grid_of(cells), nodes, config)


def adjacency(nodes: np.ndarray, occupied: np.ndarray, config: SignatureConfig = CONFIG) -> np.ndarray:
    """The matrix A of III-C 2, in metres; inf where two nodes are not joined."""
    return nx.to_numpy_array(joined(nodes, occupied, config), weight="length_m", nonedge=np.inf)


@given(seed=st.integers(0, 500))
@settings(max_examples=12, deadline=None)
def test_path_lengths_are_those_of_networkx_dijkstra(seed: int) -> None:
    submap = submap_of(random_rooms(seed))
    graph = freespace_graph(submap, CONFIG)
    assert len(graph) == len(freespace_nodes(submap, CONFIG))
    plain = dict(nx.all_pairs_dijkstra_path_length(graph, weight="length_m"))
    expected = [[plain[i].get(j, np.inf) for j in range(len(graph))] for i in range(len(graph))]
    np.testing.assert_allclose(shortest_paths(graph), np.reshape(expected, (len(graph),) * 2), rtol=1e-5)


@pytest.mark.parametrize("size_m", [0.0, 0.8])
def test_no_node_and_one_node_have_no_path(size_m: float) -> None:
    submap = submap_of(rectangle(size_m, size_m) if size_m else np.full((321, 321), UNKNOWN, np.int8))
    lengths = shortest_paths(freespace_graph(submap, CONFIG))
    assert lengths.shape == (int(size_m > 0),) * 2 and not lengths.any()


def test_the_letter_erodes_no_free_space_and_has_two_thinnings() -> None:
    """III-C 1 names binarization, distance transform and thinning, as III-A; III-B cites another work."""
    submap, config = submap_of(random_rooms(3)), SignatureConfig.paper()
    skeleton = thin(submap.grid.free, "zhang_suen")
    expected = sample_evenly(cells_of(skeleton), config.freespace_spacing_m / RESOLUTION_M)
    assert np.array_equal(freespace_nodes(submap, config), expected)
    walls = submap.grid.occupied
    assert np.array_equal(boundary_edges(submap, config), thin(walls, "guo_hall"))
    assert not np.array_equal(thin(walls, "guo_hall"), thin(walls, "zhang_suen"))


@given(seed=st.integers(0, 500))
@settings(max_examples=12, deadline=None)
def test_nodes_are_joined_exactly_when_they_see_each_other(seed: int) -> None:
    cells = random_rooms(seed)
    occupied = grid_of(cells).occupied
    nodes = freespace_nodes(submap_of(cells), CONFIG)[:18]
    weights = adjacency(nodes, occupied)
    assert np.array_equal(weights, weights.T)
    for i, j in itertools.combinations(range(len(nodes)), 2):
        a, b = nodes[i], nodes[j]
        # Hundreds of points along the line, none of them on the border of two cells.
        along = a + (b - a) * np.linspace(0, 1, 4001)[:, None]
        met = np.rint(along[(np.abs(along % 1.0 - 0.5) > 1e-3).all(axis=1)]).astype(int)
        blocked = occupied[met[:, 0], met[:, 1]].any()
        assert np.isinf(weights[i, j]) == blocked


@pytest.mark.parametrize("turns", range(4))
def test_a_line_through_a_corner_is_blocked_by_both_cells_beside_it(turns: int) -> None:
    """From (2, 2) to (5, 5); and by a wall at either end."""
    free, blocked = ([], [(3, 4)], [(4, 3)]), ([(3, 4), (4, 3)], [(2, 2)], [(5, 5)])
    for walls, visible in [*((walls, True) for walls in free), *((walls, False) for walls in blocked)]:
        occupied, ends = np.zeros((8, 11), np.bool_), np.zeros((8, 11), np.bool_)
        ends[2, 2] = ends[5, 5] = True
        for cell in walls:
            occupied[cell] = True
        nodes = np.argwhere(np.rot90(ends, turns))
        assert joined(nodes, np.rot90(occupied, turns)).has_edge(0, 1) == visible


def test_unknown_does_not_block_and_reach_does() -> None:
    nodes = np.array([[10, 10], [10, 70]])
    nothing = np.zeros((80, 80), bool)
    assert adjacency(nodes, nothing)[0, 1] == pytest.approx(3.0)
    short = SignatureConfig(freespace_join_m=2.9)
    assert np.isinf(adjacency(nodes, nothing, short)[0, 1])


def test_lengths_by_hand_in_a_square_with_a_corner() -> None:
    # Three nodes around a wall's end: the straight way is blocked, the way over the third is 3 + 4 m.
    occupied = np.zeros((120, 120), bool)
    occupied[15:61, 40] = True
    nodes = np.array([[70, 10], [10, 10], [10, 90]])
    graph = joined(nodes, occupied)
    assert not graph.has_edge(0, 2)
    lengths = shortest_paths(graph)
    assert lengths[0, 2] == pytest.approx(3.0 + 4.0)
    found = freespace_histogram(lengths, 8.0, CONFIG)
    # 3, 4 and 7 m in bins of 0.4 m: 7.5 -> 7, 10, 17.5 -> 17.
    assert np.flatnonzero(found).tolist() == [7, 10, 17]


def test_rooms_without_a_door_are_not_connected() -> None:
    cells = rectangle(12.0, 6.0)
    cells[:, 160] = np.where(cells[:, 160] >= 0, OCCUPIED, cells[:, 160])
    nodes, lengths, _ = parts(cells)
    left = nodes[:, 1] < 160
    assert left.any() and (~left).any()
    assert np.isinf(lengths[np.ix_(left, ~left)]).all()
    assert np.isfinite(lengths[np.ix_(left, left)]).all()


# --- Reflection symmetry scores (paper III-D) ---


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
