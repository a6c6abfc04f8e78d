"""Partition into submaps (paper III-A)."""

from __future__ import annotations

import os
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from sklearn.cluster import DBSCAN

from pc2grid.config import PartitionConfig
from pc2grid.model import FREE, OCCUPIED, UNKNOWN
from pc2grid.partition import _clusters, junction_graph, partition, submap_at
from tests.rooms import canvas, cross, grid_of, rectangle

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).parents[1] / "../shared/data"))


def test_a_cross_has_one_junction_in_the_middle() -> None:
    submaps = partition(grid_of(cross(7.0, 2.0)))
    assert len(submaps) == 1
    assert np.hypot(*submaps[0].center_m) < 0.3


def test_junctions_nearer_than_the_cluster_distance_are_one() -> None:
    corridor = np.full((321, 800), UNKNOWN, np.int8)
    corridor[150:180, 50:750] = FREE
    for column in (200, 280, 600):  # side corridors, 4 m apart and farther
        corridor[100:150, column - 12 : column + 12] = FREE
    assert len(partition(grid_of(corridor))) == 3
    merged = partition(grid_of(corridor), PartitionConfig(cluster_m=4.5))
    assert len(merged) == 2


def test_a_map_without_junctions_has_one_submap_where_it_is_widest() -> None:
    cells = canvas()
    cells[100:220, 100:220] = FREE
    cells[155:165, 20:100] = FREE
    submaps = partition(grid_of(cells), PartitionConfig(clearance_m=2.5))
    assert len(submaps) == 1
    assert np.hypot(*submaps[0].center_m) < 0.3


@pytest.mark.parametrize("value", [UNKNOWN, OCCUPIED])
def test_a_map_without_free_space_has_no_submaps(value: int) -> None:
    nothing = grid_of(np.full((50, 60), value, np.int8))
    assert partition(nothing) == ()
    assert len(junction_graph(nothing)) == 0


def test_a_submap_is_a_disc_around_its_centre() -> None:
    grid = grid_of(np.full((400, 500), FREE, np.int8))
    submap = submap_at(grid, (1.0, -2.0), 3.0, submap_id=7)
    points = submap.grid.to_point(np.argwhere(submap.grid.cells == FREE))
    reach = np.hypot(*(points - submap.center_m).T)
    assert submap.submap_id == 7
    assert reach.max() <= 3.0 + 0.05
    assert len(points) * 0.05**2 == pytest.approx(np.pi * 3.0**2, rel=0.01)
    n = submap.grid.cells.shape[0]
    assert submap.grid.cells.shape == (n, n) and n % 2 == 1


def test_submaps_keep_the_cells_of_the_map() -> None:
    grid = grid_of(cross(7.0, 2.0))
    submap = partition(grid, PartitionConfig(radius_m=4.0))[0]
    for row, column in np.argwhere(submap.grid.cells != UNKNOWN)[::97]:
        there = grid.to_cell(submap.grid.to_point(np.array([[row, column]])))[0]
        assert grid.cells[tuple(there)] == submap.grid.cells[row, column]


def test_centres_are_free_and_sorted_and_repeat() -> None:
    corridor = np.full((321, 800), UNKNOWN, np.int8)
    corridor[150:180, 50:750] = FREE
    corridor[50:280, 200:230] = corridor[50:280, 500:530] = FREE
    grid = grid_of(corridor)
    submaps = partition(grid)
    assert [s.submap_id for s in submaps] == list(range(len(submaps)))
    cells = grid.to_cell(np.array([s.center_m for s in submaps]))
    assert (corridor[cells[:, 0], cells[:, 1]] == FREE).all()
    again = partition(grid)
    assert [s.center_m for s in again] == [s.center_m for s in submaps]


def test_spacing_fills_the_ways_between_junctions() -> None:
    grid = grid_of(cross(7.0, 2.0))
    centers = np.array([s.center_m for s in partition(grid, PartitionConfig(spacing_m=1.0))])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 10 * np.eye(len(centers))
    assert len(centers) > 15
    assert apart.min() >= 0.99
    assert apart.min(axis=1).max() < 2.1


def test_junction_graph_of_a_cross_is_a_star_with_four_arms() -> None:
    graph = junction_graph(grid_of(cross(7.0, 2.0)))
    middle = [n for n, kind in graph.nodes(data="kind") if kind == "junction"]
    assert len(middle) == 1
    assert nx.is_connected(graph)
    arms = [length for _, _, length in graph.edges(middle[0], data="length_m")]
    assert len(arms) >= 4
    assert max(arms) == pytest.approx(6.5, abs=1.0)


def test_junction_graph_measures_between_two_junctions() -> None:
    corridor = np.full((321, 800), UNKNOWN, np.int8)
    corridor[150:180, 50:750] = FREE
    corridor[50:280, 200:230] = corridor[50:280, 500:530] = FREE
    graph = junction_graph(grid_of(corridor))
    a, b = (n for n, kind in graph.nodes(data="kind") if kind == "junction")
    assert graph.edges[a, b]["length_m"] == pytest.approx(300 * 0.05, abs=0.6)


def test_a_room_alone_is_found() -> None:
    assert len(partition(grid_of(rectangle(6.0, 4.0)))) >= 1


@pytest.mark.skipif(not (DATA / "maps").is_dir(), reason="no real maps: set PC2GRID_DATA")
def test_number_of_submaps_is_near_table_1_with_one_set_of_parameters() -> None:
    from signature.evaluation.published import SUBMAPS
    from signature.evaluation.reproduce import read_map

    for name, published in SUBMAPS.items():
        found = len(partition(read_map(DATA / "maps" / f"{name}.yaml", "paper")))
        assert abs(found / published - 1) <= 0.25, name


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("resolution_m", [0.05, 0.03])
def test_clusters_are_those_of_dbscan(seed: int, resolution_m: float) -> None:
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(0, 200 * (seed + 2), (300, 2)), axis=0)
    config = PartitionConfig(cluster_m=0.5)
    labels = DBSCAN(eps=config.cluster_m / resolution_m, min_samples=1).fit_predict(cells)
    found = _clusters(cells, resolution_m, config)
    assert len(found) == labels.max() + 1 > 3
    for label, (middle, members) in enumerate(found):
        assert np.array_equal(members, cells[labels == label])
        away = np.linalg.norm(members - members.mean(axis=0), axis=1)
        assert np.linalg.norm(middle - members.mean(axis=0)) == pytest.approx(away.min())
