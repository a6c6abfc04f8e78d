"""Partition into submaps (paper III-A)."""

import math

import cv2
import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN

from pc2grid.geometry import F32, F64
from pc2grid.model import FREE, OCCUPIED, OCCUPIED_FROM, UNKNOWN, OccupancyGrid
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.junction_graph import (
    clusters,
    junction_graph,
    junctions_and_ends,
    map_skeleton,
    pixel_steps,
)
from pc2grid.submaps.submaps import (
    _STEP_CELLS,
    HIDDEN,
    OPEN,
    WALL,
    cast_rays,
    isovist,
    partition,
    polygon_mask,
    view_at,
)
from tests.helpers.field import DATA
from tests.helpers.rooms import RESOLUTION_M, canvas, cross, grid_of
from tests.helpers.simulated_drives import plan

PAPER = PartitionConfig.paper()


def test_junctions_nearer_than_the_cluster_distance_are_one() -> None:
    corridor = np.full((321, 800), UNKNOWN, np.int8)
    corridor[150:180, 50:750] = FREE
    for column in (200, 280, 600):  # side corridors, 4 m apart and farther
        corridor[100:150, column - 12 : column + 12] = FREE
    assert len(partition(grid_of(corridor), PAPER)) == 3
    merged = partition(grid_of(corridor), PAPER.model_copy(update={"cluster_m": 4.5}))
    assert len(merged) == 2


def test_a_map_without_junctions_has_one_submap_where_it_is_widest() -> None:
    cells = canvas()
    cells[100:220, 100:220] = FREE
    cells[155:165, 20:100] = FREE
    submaps = partition(grid_of(cells), PAPER.model_copy(update={"clearance_m": 2.5}))
    assert len(submaps) == 1
    assert np.hypot(*submaps[0].center_m) < 0.3


@pytest.mark.parametrize("value", [UNKNOWN, OCCUPIED])
def test_a_map_without_free_space_has_no_submaps(value: int) -> None:
    nothing = grid_of(np.full((50, 60), value, np.int8))
    assert partition(nothing, PAPER) == ()
    assert len(junction_graph(nothing)) == 0


def test_a_submap_is_a_disc_around_its_centre() -> None:
    grid = grid_of(np.full((400, 500), FREE, np.int8))
    submap = view_at(grid, (1.0, -2.0), PartitionConfig.paper(3.0), submap_id=7)
    points = submap.grid.to_point(np.argwhere(submap.grid.cells == FREE))
    reach = np.hypot(*(points - submap.center_m).T)
    assert submap.submap_id == 7
    assert reach.max() <= 3.0 + 0.05
    assert len(points) * 0.05**2 == pytest.approx(np.pi * 3.0**2, rel=0.01)
    n = submap.grid.cells.shape[0]
    assert submap.grid.cells.shape == (n, n) and n % 2 == 1


def test_centres_are_free_and_numbered() -> None:
    corridor = np.full((321, 800), UNKNOWN, np.int8)
    corridor[150:180, 50:750] = FREE
    corridor[50:280, 200:230] = corridor[50:280, 500:530] = FREE
    grid = grid_of(corridor)
    submaps = partition(grid, PAPER)
    assert [s.submap_id for s in submaps] == list(range(len(submaps)))
    cells = grid.to_cell(np.array([s.center_m for s in submaps]))
    assert (corridor[cells[:, 0], cells[:, 1]] == FREE).all()


def test_spacing_fills_the_ways_between_junctions() -> None:
    grid = grid_of(cross(7.0, 2.0))
    centers = np.array([s.center_m for s in partition(grid, PAPER.model_copy(update={"spacing_m": 1.0}))])
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


@pytest.mark.skipif(not (DATA / "maps").is_dir(), reason="no real maps: set PC2GRID_DATA")
def test_number_of_submaps_is_near_table_1_with_one_set_of_parameters() -> None:
    from pc2grid_lab.paper.tables import SUBMAPS, read_map

    for name, published in SUBMAPS.items():
        found = len(partition(read_map(DATA / "maps" / f"{name}.yaml"), PAPER))
        assert abs(found / published - 1) <= 0.25, name


@pytest.mark.parametrize(("seed", "resolution_m"), [(0, 0.05), (1, 0.03), (2, 0.05)])
def test_clusters_are_those_of_dbscan(seed: int, resolution_m: float) -> None:
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(0, 200 * (seed + 2), (300, 2)), axis=0)
    chosen = np.sort(rng.choice(len(cells), 200, replace=False))
    radius_cells = 0.5 / resolution_m
    labels = DBSCAN(eps=radius_cells, min_samples=1).fit_predict(cells[chosen])
    found = clusters(cells, chosen, radius_cells)
    assert len(found) == labels.max() + 1 > 3
    # Single linkage: the components of the graph that joins cells within the radius.
    near = nx.Graph(cKDTree(cells[chosen]).query_pairs(radius_cells))
    near.add_nodes_from(range(len(chosen)))
    assert nx.number_connected_components(near) == len(found)
    for label, (middle, members) in enumerate(found):
        assert np.array_equal(members, chosen[labels == label])
        points = cells[members]
        away = np.linalg.norm(points - points.mean(axis=0), axis=1)
        assert np.linalg.norm(cells[middle] - points.mean(axis=0)) == pytest.approx(away.min())


def rooms(seed: int) -> OccupancyGrid:
    """Free space of random shape, with loops, dead ends and several ways between two places."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).random((160, 200)), 8.0)
    return grid_of(np.where(noise > np.median(noise), FREE, OCCUPIED).astype(np.int8))


@pytest.mark.parametrize("seed", range(3))
def test_edges_are_the_shortest_ways_along_the_skeleton(seed: int) -> None:
    """Against a search of networkx on the pixels of the skeleton."""
    grid, config = rooms(seed), PAPER.model_copy(update={"clearance_m": 0.1, "cluster_m": 0.3})
    graph = junction_graph(grid, config)
    assert graph.number_of_edges() > 5
    pixels, steps, lengths = pixel_steps(map_skeleton(grid, config))
    skeleton = nx.Graph()
    skeleton.add_nodes_from(range(len(pixels)))
    skeleton.add_weighted_edges_from((*step, length) for step, length in zip(steps, lengths, strict=True))
    is_junction, is_end = junctions_and_ends(map_skeleton(grid, config), pixels)
    places = [members for _, members in clusters(pixels, np.flatnonzero(is_junction), 0.3 / 0.05)]
    places += [np.array([k]) for k in np.flatnonzero(is_end)]
    assert len(places) == len(graph)
    place_of = {int(k): place for place, members in enumerate(places) for k in members}
    for a in graph:

        def leaving(u: int, v: int, data: dict[str, float], a: int = a) -> float | None:
            """Ways start at place a and end at the first other place; within a place no way leads on."""
            if u in place_of and (place_of[u] != a or place_of.get(v) == a):
                return None
            return data["weight"]

        found = nx.multi_source_dijkstra_path_length(skeleton, set(places[a].tolist()), weight=leaving)
        shortest = {place_of[k]: math.inf for k in found if k in place_of and place_of[k] != a}
        for k in found:
            if place_of.get(k, a) != a:
                shortest[place_of[k]] = min(shortest[place_of[k]], found[k] * grid.resolution_m)
        assert set(shortest) == set(graph[a])
        for b, length_m in shortest.items():
            assert graph.edges[a, b]["length_m"] == pytest.approx(length_m)
    for a, b, way in graph.edges(data=True):
        path_m = way["path_m"]
        step_m = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
        assert step_m.sum() == pytest.approx(way["length_m"], rel=1e-5)
        for node, end in ((min(a, b), path_m[0]), (max(a, b), path_m[-1])):
            members = grid.to_point(pixels[places[node]])
            assert np.linalg.norm(members - end, axis=1).min() < 1e-5


# --- Isovists against hand-made rooms and a slow oracle ---


def cast_rays_plain(
    cells: NDArray[np.int8], rows: F64, columns: F64, limit: float, bearings: int, patience: int
) -> tuple[F32, NDArray[np.int8]]:
    """Follow the rays of each place (N,) in steps of half a cell.

    cells : (H, W). rows, columns : (N,) where the rays start, in cells from the grid's corner. limit : length
    of a ray, in cells. patience : steps through unknown cells after which a ray is HIDDEN.

    Returns how far each ray is known to be free (or its wall), in cells, and how it ends; (N, B) each.
    """
    shape = (len(rows), bearings)
    angles = 2.0 * np.pi * np.arange(bearings) / bearings
    r, c = np.broadcast_to(rows[:, None], shape).copy(), np.broadcast_to(columns[:, None], shape).copy()
    ranges, ends = np.zeros(shape), np.full(shape, OPEN, np.int8)
    unknown_run, running = np.zeros(shape, np.int64), np.ones(shape, np.bool_)
    length = 0.0
    while length < limit and running.any():
        r += np.sin(angles) * _STEP_CELLS
        c += np.cos(angles) * _STEP_CELLS
        length += _STEP_CELLS
        inside = (r >= 0) & (r < cells.shape[0]) & (c >= 0) & (c < cells.shape[1])
        value = np.full(shape, UNKNOWN, np.int8)
        value[inside] = cells[r[inside].astype(np.int64), c[inside].astype(np.int64)]
        unknown_run = np.where(value < 0, unknown_run + 1, 0)
        ranges[running & (value >= 0)] = length
        ends[running & (value >= OCCUPIED_FROM)] = WALL
        ends[running & (~inside | (unknown_run > patience))] = HIDDEN
        running &= ends == OPEN
    return ranges.astype(np.float32), ends


def test_rays_in_a_square_room_end_on_its_walls() -> None:
    room = plan(6, 6, [])
    view = isovist(room, (3.0, 3.0), 10.0)
    assert (view.ends == WALL).all()
    assert view.ranges_m[0] == view.ranges_m.min() or abs(view.ranges_m[0] - 3.0) < 3 * RESOLUTION_M
    assert abs(view.ranges_m[45] - 3.0 * math.sqrt(2)) < 0.2
    assert abs(np.mean(view.ranges_m.astype(float) ** 2) * math.pi - 36.0) < 2.5


def test_rays_beyond_the_sight_are_open_and_into_the_unknown_hidden() -> None:
    cells = np.zeros((200, 200), np.int8)
    cells[:, 150:] = UNKNOWN
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    view = isovist(grid, (5.0, 5.0), 3.0)
    assert view.ends[180] == OPEN and abs(view.ranges_m[180] - 3.0) < RESOLUTION_M
    assert view.ends[0] == HIDDEN and abs(view.ranges_m[0] - 2.5) < 2 * RESOLUTION_M
    assert abs(np.mean(view.ends != HIDDEN) - (1 - 2 * math.acos(2.5 / 3) / (2 * math.pi))) < 0.03


def test_a_few_unobserved_cells_do_not_hide_the_wall_behind_them() -> None:
    room = plan(6, 6, [])
    cells = room.cells.copy()
    cells[:, 80] = UNKNOWN
    view = isovist(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), (3.0, 3.0), 10.0)
    assert view.ends[0] == WALL and abs(view.ranges_m[0] - 3.0) < 3 * RESOLUTION_M


def test_a_visible_submap_hides_the_next_room_and_keeps_the_wall() -> None:
    rooms = plan(12, 6, [(6, 0, 6, 6)])
    submap = view_at(rooms, (3.0, 3.0), PartitionConfig(view="isovist", radius_m=8.0), submap_id=7)
    assert submap.submap_id == 7
    next_room = submap.grid.to_cell(np.array([[8.0, 3.0], [9.0, 1.0]]))
    assert (submap.grid.cells[next_room[:, 0], next_room[:, 1]] == UNKNOWN).all()
    wall = submap.grid.to_cell(np.array([[6.0, 3.0]]))[0]
    assert submap.grid.occupied[wall[0], wall[1] - 2 : wall[1] + 3].any()
    assert submap.grid.free.sum() * 0.05**2 > 0.9 * 36 * 0.9


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_what_is_inside_the_polygon_is_seen(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walls = [(*rng.uniform(0.5, 7.5, 2), *rng.uniform(0.5, 7.5, 2)) for _ in range(4)]
    room = plan(8, 8, walls)
    free = room.to_point(np.argwhere(cv2.distanceTransform(room.free.astype(np.uint8), 2, 5) > 6))
    center = free[rng.integers(len(free))]
    view = isovist(room, (float(center[0]), float(center[1])), 5.0)
    inside = np.argwhere(polygon_mask(view, room) & room.free)
    if not len(inside):
        return
    seen = 0
    sample = inside[rng.integers(len(inside), size=40)]
    for point in room.to_point(sample):
        steps = np.linspace(0, 1, 200)[:, None]
        cells = room.to_cell(center + steps * (point - center))
        seen += not room.occupied[cells[:, 0], cells[:, 1]].any()
    assert seen >= 0.9 * len(sample)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), patience=st.integers(0, 4))
def test_compiled_rays_are_the_plain_ones(seed: int, patience: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice([UNKNOWN, 0, 100], (80, 120), p=[0.05, 0.94, 0.01]).astype(np.int8)
    rows, columns = rng.uniform(-2, 82, 30), rng.uniform(-2, 122, 30)
    compiled = cast_rays(cells, rows, columns, 60.0, 90, patience)
    plain = cast_rays_plain(cells, rows, columns, 60.0, 90, patience)
    assert np.array_equal(compiled[0], plain[0]) and np.array_equal(compiled[1], plain[1])
