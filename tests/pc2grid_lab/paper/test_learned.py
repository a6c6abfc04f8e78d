"""The boundary at several radii, compared by a metric that was learned on other maps."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist, pdist, squareform

from pc2grid.errors import MapFileError
from pc2grid.io.maps import save_map
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import partition
from pc2grid_lab.paper import methods
from pc2grid_lab.paper.methods import COLUMNS, CONFIG, learned, submap_vector, unlearned, weight
from pc2grid_lab.paper.tables import computed_cells, paper_tasks, read_map
from signature.boundary import boundary_edges, boundary_points
from signature.paper import describe
from tests.helpers.field import DATA
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


def test_a_vector_has_the_shares_of_weighed_pairs() -> None:
    submap = submap_of(random_rooms(2))
    found = submap_vector(submap)
    edges = boundary_edges(submap, CONFIG)
    points_m = (boundary_points(edges, RESOLUTION_M, CONFIG) - (np.array(edges.shape) - 1) / 2) * RESOLUTION_M
    away_m = np.hypot(*points_m.T)
    apart = squareform((pdist(points_m) / 0.2 + 1e-6).astype(int))
    first, second = np.triu_indices(len(points_m), 1)
    at = np.minimum(apart[first, second], 79)
    for part, weights in (
        ("boundary", np.ones(len(away_m))),
        ("soft", weight(away_m, 2.0, 8.0)),
        ("near", weight(away_m, 2.5, 4.5)),
    ):
        sums = np.bincount(at, weights[first] * weights[second], 80)
        size = COLUMNS[part].stop - COLUMNS[part].start
        assert sums[size:].sum() == 0  # pairs near the centre are at most 9 m apart
        np.testing.assert_allclose(found[COLUMNS[part]], np.sqrt(sums / sums.sum())[:size], atol=1e-9)
    rings = np.bincount(np.minimum(away_m / 0.8, 9).astype(int), minlength=10)
    np.testing.assert_allclose(found[COLUMNS["radial"]] ** 2, rings / rings.sum(), atol=1e-12)
    signature = describe(submap, CONFIG)
    np.testing.assert_allclose(found[COLUMNS["boundary"]] ** 2, signature.boundary, atol=1e-6)
    np.testing.assert_allclose(found[COLUMNS["freespace"]] ** 2, signature.freespace, atol=1e-6)
    np.testing.assert_allclose(found[COLUMNS["symmetry"]] * 255, signature.symmetry, rtol=1e-6)


def test_of_an_empty_submap_all_is_zero() -> None:
    assert not submap_vector(submap_of(canvas())).any()


def test_a_point_weighs_less_the_farther_it_is() -> None:
    assert weight(np.array([0.0, 2.0, 5.0, 8.0, 9.0]), 2.0, 8.0).tolist() == [1.0, 1.0, 0.5, 0.0, 0.0]


def test_the_distance_is_that_of_mahalanobis_with_a_shrunk_covariance() -> None:
    rng = np.random.default_rng(3)
    within = rng.normal(size=(600, 300)) * rng.uniform(0.1, 0.3, 300)
    within[:, 1::2] += within[:, ::2]
    rooms = [submap_of(shape) for shape in (rectangle(8.0, 5.0), cross(6.0, 2.0), l_shape())]
    parts = ("boundary", "radial")
    columns = np.r_[COLUMNS["boundary"], COLUMNS["radial"]]
    covariance = within[:, columns].T @ within[:, columns] / 600
    covariance = 0.4 * covariance + 0.6 * np.diag(np.diag(covariance))
    query = submap_of(random_rooms(1))
    rows, wanted = (
        np.array([submap_vector(room) for room in rooms])[:, columns],
        submap_vector(query)[None, columns],
    )
    plain = cdist(wanted, rows, "mahalanobis", VI=np.linalg.inv(covariance))[0]
    found = learned(submap_vector, parts, within, rooms)(query)
    np.testing.assert_allclose(-found, plain, rtol=1e-4)


def test_without_learning_the_distances_of_the_parts_are_added() -> None:
    rooms, query = [submap_of(rectangle(8.0, 5.0)), submap_of(l_shape())], submap_of(random_rooms(1))
    found = unlearned(submap_vector, {"boundary": 0.7, "radial": 0.3}, rooms)(query)
    asked = submap_vector(query)
    for room, similarity in zip(rooms, found, strict=True):
        bc = [(asked * submap_vector(room))[COLUMNS[part]].sum() for part in ("boundary", "radial")]
        assert -similarity == pytest.approx(0.7 * (1 - bc[0]) ** 0.5 + 0.3 * (1 - bc[1]) ** 0.5, abs=1e-6)


def test_nothing_is_learned_from_the_map_that_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(methods, "LEARNED_FROM", 3)
    (tmp_path / "maps").mkdir()
    shapes = {"a": cross(6.0, 2.0), "b": l_shape(), "c": random_rooms(1)}
    for name, shape in shapes.items():
        save_map(grid_of(np.hstack([shape, cross(6.0, 2.0)])), tmp_path / "maps" / name)
    (task,) = (
        t
        for t in paper_tasks(
            [tmp_path / "maps/a.yaml"], methods=["learned"], offsets_m=[1.0], queries=3, seed=1
        )
        if t.level == 2
    )
    (cell,) = computed_cells([task], tmp_path / "cells")
    kept = sorted(file.name.split(".")[1] for file in (tmp_path / "cells").glob("differences.*"))
    assert kept == ["b", "c"] and len(cell.matches.correct) == 3
    (tmp_path / "maps/b.yaml").unlink()
    (tmp_path / "maps/c.yaml").unlink()
    with pytest.raises(MapFileError, match="no other map to learn from"):
        computed_cells([replace(task, level=0)], tmp_path / "cells")


@pytest.mark.nightly
def test_on_a_real_floor_it_is_right_more_often_than_the_paper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Learned on one floor, asked on another one, under noise."""
    maps = DATA / "maps"
    if not (maps / "csail.yaml").is_file():
        pytest.skip("the maps of the paper are not in PC2GRID_DATA")
    monkeypatch.setattr(methods, "LEARNED_FROM", 60)
    grid = read_map(maps / "intel.yaml")
    within = methods.differences(grid, partition(grid, PartitionConfig.paper()), 1)
    monkeypatch.setattr("pc2grid_lab.paper.tables.within_others", lambda *_: within)
    names = ["learned", "unlearned", "proposed"]
    tasks = [
        t
        for t in paper_tasks([maps / "csail.yaml"], methods=names, offsets_m=[1.0], queries=40, seed=1)
        if (t.level, t.radius_m) == (2, 8.0)
    ]
    right = {cell.task.method: cell.measures.r_at_1 for cell in computed_cells(tasks, tmp_path)}
    assert right["learned"] > right["unlearned"] > right["proposed"], right
