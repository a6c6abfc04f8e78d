"""The signatures of what was seen: what they are, and what does not change them."""

from __future__ import annotations

import itertools
import math

import networkx as nx
import numpy as np
import pytest
from numpy.typing import NDArray

from pc2grid.geometry import F32
from pc2grid.submaps.submaps import HIDDEN, OPEN, WALL, look_around
from signature.boundary import PAIR_BINS, RANGE_BINS, RIMS, boundary_seen, rim_columns, within
from signature.freespace import DETOUR_BINS, PATH_BINS, path_lengths, seen_nodes
from signature.visible import (
    AROUND_M,
    LATTICE_M,
    PARTS,
    PROFILE_BEARINGS,
    SIGNATURE_COLUMNS,
    SeenPlaces,
    seen_signatures,
    viewpoints_of,
)
from tests.helpers.simulated_drives import office

SIGHT_M, BEARINGS = 5.0, 48
Ends = NDArray[np.int8]


def random_views(count: int = 6) -> tuple[F32, Ends]:
    """Isovists with walls near and far, some rays without a wall and some hidden."""
    rng = np.random.default_rng(0)
    steps = rng.uniform(0.5, SIGHT_M, (count, BEARINGS // 4))
    ends = rng.choice([WALL, WALL, WALL, OPEN, HIDDEN], (count, BEARINGS // 4)).astype(np.int8)
    ranges_m = (np.repeat(steps, 4, axis=1) - rng.uniform(0, 0.2, (count, BEARINGS))).astype(np.float32)
    ends = np.repeat(ends, 4, axis=1)
    ranges_m[ends == OPEN] = SIGHT_M
    return ranges_m, ends


def test_turning_a_view_changes_nothing() -> None:
    ranges_m, ends = random_views()
    turned = [np.roll(values, 2 * 5, axis=1) for values in (ranges_m, ends)]
    # A turn by whole steps of the free-space nodes, up to rounding at the edge of a bin.
    before, after = seen_signatures(ranges_m, ends, SIGHT_M), seen_signatures(*turned, SIGHT_M)
    np.testing.assert_allclose(before, after, atol=0.05)
    assert np.abs(before - after).mean() < 1e-3


def test_each_histogram_is_a_share_of_what_was_seen() -> None:
    found = seen_signatures(*random_views(), SIGHT_M)
    columns = PARTS
    assert found.shape[1] == columns["symmetry"].stop + 1
    squares = found.astype(np.float64) ** 2
    ranges = RANGE_BINS + 1
    paths = columns["freespace"].start + PATH_BINS
    rims = np.cumsum([ranges, *(len(rim_columns(rim)) for rim in RIMS)]).tolist()
    edges = [0, *rims, paths, paths + DETOUR_BINS, columns["freespace"].stop]
    for start, stop in itertools.pairwise(edges):
        np.testing.assert_allclose(squares[:, start:stop].sum(axis=1), 1.0, atol=1e-5)
    assert (found[:, columns["symmetry"]] >= 0).all() and (found[:, columns["symmetry"]] <= 1).all()
    np.testing.assert_allclose(found[:, -1], (random_views()[1] != HIDDEN).mean(axis=1))


def test_pair_distances_are_those_of_all_pairs_of_wall_points() -> None:
    ranges_m, ends = random_views(1)
    angles = 2 * math.pi * np.arange(BEARINGS) / BEARINGS
    counts = np.zeros(PAIR_BINS + 2)
    for i in range(BEARINGS):
        for j in range(i):
            pair = ends[0, i], ends[0, j]
            if HIDDEN in pair:
                continue
            a, b = (
                complex(r * math.cos(t), r * math.sin(t))
                for r, t in zip(ranges_m[0, [i, j]], angles[[i, j]], strict=True)
            )
            at = min(int(abs(a - b) / (2 * SIGHT_M) * PAIR_BINS), PAIR_BINS - 1)
            counts[PAIR_BINS + pair.count(OPEN) - 1 if OPEN in pair else at] += 1
    found = boundary_seen(ranges_m, ends, SIGHT_M)[0, RANGE_BINS + 1 :][: PAIR_BINS + 2]
    np.testing.assert_allclose(found**2, counts / counts.sum(), atol=0.01)


def test_what_is_hidden_beyond_a_rim_does_not_change_the_pairs_within_it() -> None:
    ranges_m, ends = random_views()
    ends = np.where(ends == HIDDEN, WALL, ends).astype(np.int8)
    hidden = np.where(ranges_m >= RIMS[-1][1] * SIGHT_M, HIDDEN, ends).astype(np.int8)
    whole, part = (boundary_seen(ranges_m, e, SIGHT_M) for e in (ends, hidden))
    near = len(rim_columns(RIMS[-1]))
    np.testing.assert_allclose(whole[:, -near:], part[:, -near:], atol=1e-6)
    assert not np.allclose(whole, part, atol=0.1)
    # Pairs of walls that are nearer than the rim's beginning count in full, those beyond its end not at all.
    assert within(np.array([0.0, RIMS[-1][0], RIMS[-1][1], 1.0]), *RIMS[-1]).tolist() == [1.0, 1.0, 0.0, 0.0]
    assert within(np.array([0.5, 1.0]), *RIMS[0]).tolist() == [1.0, 1.0]


def seen_graph(ranges_m: F32, ends: NDArray[np.int8]) -> nx.Graph:
    """The graph of one isovist (B,)."""
    points_m, known, visible = seen_nodes(ranges_m[None], ends[None])
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(known[0]).tolist())
    for a, b in np.argwhere(np.triu(visible[0], 1)).tolist():
        graph.add_edge(a, b, length_m=math.dist(points_m[0, a], points_m[0, b]))
    return graph


def test_path_lengths_are_those_of_the_free_space_graph() -> None:
    ranges_m, ends = random_views()
    lengths_m, straight_m = path_lengths(ranges_m, ends)
    longer = 0
    for n in range(len(ranges_m)):
        graph = seen_graph(ranges_m[n], ends[n])
        expected = dict(nx.all_pairs_dijkstra_path_length(graph, weight="length_m"))
        for a in graph:
            for b in graph:
                if a != b:
                    assert lengths_m[n, a, b] == pytest.approx(expected[a][b], abs=1e-6)
                    assert lengths_m[n, a, b] >= straight_m[n, a, b] - 1e-6
                    longer += lengths_m[n, a, b] > straight_m[n, a, b] + 0.1
    assert longer  # some lie around a corner


def test_a_part_has_about_the_histograms_of_the_whole_and_a_part_taken_for_a_whole_has_not() -> None:
    rng = np.random.default_rng(1)
    ranges_m = (2.5 + 1.5 * np.sin(np.arange(BEARINGS) * 0.9) + rng.uniform(0, 0.2, BEARINGS)).astype(
        np.float32
    )[None]
    ends = np.full((1, BEARINGS), WALL, np.int8)
    hidden = ends.copy()
    hidden[0, :24] = HIDDEN
    whole, part = (boundary_seen(ranges_m, e, SIGHT_M)[0, :21] for e in (ends, hidden))
    short = np.where(hidden == HIDDEN, np.float32(0.1), ranges_m)
    mistaken = boundary_seen(short, ends, SIGHT_M)[0, :21]
    assert np.sum((whole - part) ** 2) < 0.3 * np.sum((whole - mistaken) ** 2)


def test_a_view_that_has_seen_nothing_has_empty_histograms() -> None:
    ranges_m, ends = np.zeros((1, BEARINGS), np.float32), np.full((1, BEARINGS), HIDDEN, np.int8)
    found = seen_signatures(ranges_m, ends, SIGHT_M)
    assert np.isfinite(found).all() and not found.any()
    assert seen_signatures(ranges_m[:0], ends[:0], SIGHT_M).shape == (0, found.shape[1])


# --- What is seen from the viewpoints of places, in 8 bits a number ---


REACH_M = 5.0
CENTERS_M = np.array([(x, y) for x in (1.5, 5.0, 9.0) for y in (2.0, 6.5)])


def test_signatures_are_those_of_the_isovists_but_for_rounding() -> None:
    grid = office().crop((6.0, 5.0), 4.5)
    seen = SeenPlaces.of(grid, CENTERS_M, REACH_M)
    at_m = seen.at_m.astype(np.float64)
    ranges_m, ends = look_around(grid, at_m, REACH_M, bearings=PROFILE_BEARINGS)
    assert (ends == HIDDEN).any() and not (ends == HIDDEN).all()
    assert seen.signatures.shape == (len(seen), SIGNATURE_COLUMNS)
    np.testing.assert_allclose(seen.shares, seen_signatures(ranges_m, ends, REACH_M), atol=0.5 / 255 + 1e-6)


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
    whole = SeenPlaces.of(office(), CENTERS_M, REACH_M)
    with pytest.raises(ValueError):
        SeenPlaces(at_m=whole.at_m, place=whole.place, signatures=whole.signatures[:2])
