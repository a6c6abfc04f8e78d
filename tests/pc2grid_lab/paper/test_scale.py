"""`pc2grid compare scale`: recall against the number of places."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pc2grid.io.maps import load_map, save_map
from pc2grid.model import OccupancyGrid
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import partition
from pc2grid_cli.main import app
from pc2grid_lab.paper import methods, tables
from pc2grid_lab.paper.experiment import NOISE_LEVELS, Experiment, draw_queries
from pc2grid_lab.paper.methods import make_methods
from pc2grid_lab.paper.tables import Counted, count, mean_recall, rescaled, sources_of, within_others
from tests.helpers.rooms import cross, grid_of, l_shape, random_rooms, rectangle


@pytest.fixture
def maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three small buildings, no simulated floor."""
    monkeypatch.setattr(methods, "LEARNED_FROM", 6)
    monkeypatch.setattr(tables, "FLOORS", 0)
    monkeypatch.setattr(tables, "FACTORS", (1.0, 0.8))
    folder = tmp_path / "maps"
    folder.mkdir()
    for name, shapes in {
        "a": (cross(6.0, 2.0), l_shape()),
        "b": (random_rooms(1),),
        "c": (l_shape(),),
    }.items():
        save_map(grid_of(np.hstack(shapes)), folder / name)
    return folder


def test_of_places_drawn_at_random_the_recall_is_hypergeometric() -> None:
    """Here by counting: how many sets of n - 1 of 50 places have less than k of those that come before."""
    places = np.tile([50, 0, 0, 30], (2, 1))
    before = np.array([[3, 0, 0, 0], [0, 0, 0, 30]])
    counted = Counted("a", 0, places, {"learned": before})
    for number in (1, 2, 20, 51):
        none = math.comb(47, number - 1) / math.comb(50, number - 1)
        one = 3 * math.comb(47, number - 2) / math.comb(50, number - 1) if number > 1 else 0.0
        assert counted.recall("learned", (0, 1, 2), 1, number) == pytest.approx([none, 1.0])
        assert counted.recall("learned", (0, 1, 2), 2, number) == pytest.approx([none + one, 1.0])
    assert counted.recall("learned", (3,), 20, 31).tolist() == pytest.approx([1.0, 0.0])
    mean, half = mean_recall([counted, counted], "learned", (0, 1, 2), 1, 51)
    assert mean == pytest.approx(0.5) and 0.2 < half <= 0.5


@pytest.mark.parametrize("level", [pytest.param(0, marks=pytest.mark.nightly), 2])
def test_counts_are_those_of_the_methods_of_the_tables(level: int, maps: Path, tmp_path: Path) -> None:
    """Fitted to all places at once, and asked one query after the other."""
    asked, kept, experiment = maps / "a.yaml", tmp_path / "kept", Experiment(queries=5)
    sources = sources_of(maps)
    counted = count(asked, level, experiment, sources, kept)
    grid = load_map(asked)
    junctions = partition(grid, PartitionConfig.paper())
    own = partition(grid, tables.PLACES)
    others = [
        (s.kind, place) for s in sources if s.building != "a" for place in partition(s.load(), tables.PLACES)
    ]
    kinds = np.array([3] * len(own) + [kind for kind, _ in others])
    assert {0, 1, 3} == set(kinds.tolist())
    within = within_others(asked, 8.0, 1, kept)
    centers_m = np.array([junction.center_m for junction in junctions])
    queries = list(draw_queries(grid, centers_m, 8.0, experiment, NOISE_LEVELS[level]))
    for name, method in make_methods(tables.METHODS, within).items():
        matcher = method([*own, *(place for _, place in others)])
        for row, query in enumerate(queries):
            similar = matcher(query)
            nearest = min(junctions, key=lambda junction: math.dist(junction.center_m, query.center_m))
            right = [place.center_m for place in own].index(nearest.center_m)
            other = np.array([math.dist(place.center_m, query.center_m) > 3.0 for place in own])
            other = np.append(other, np.ones(len(others), bool))
            assert counted.places[row].tolist() == np.bincount(kinds[other], minlength=4).tolist()
            before = np.bincount(kinds[other & (similar >= similar[right])], minlength=4)
            assert counted.before[name][row].tolist() == before.tolist(), (name, row)


def test_a_run_draws_the_curves_and_the_next_one_only_reads_its_counts(
    maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["compare", "scale", "--maps", str(maps), "--out", str(tmp_path / "out")]
    arguments += ["--queries", "3", "--jobs", "1"]
    first = CliRunner().invoke(app, arguments)
    assert first.exit_code == 0, first.output
    assert (tmp_path / "out/scale.png").read_bytes().startswith(b"\x89PNG")
    curves = json.loads((tmp_path / "out/results.json").read_text())["curves"]
    assert len(curves) == 16  # 2 levels, 2 databases, 2 methods, 2 ranks
    for curve in curves:
        assert curve["places"] == sorted(curve["places"]) and np.all(np.diff(curve["recall"]) <= 1e-12)
    assert {row["database"] for row in curves} == {"other buildings", "own building"}
    monkeypatch.setattr(tables, "_count", None)
    second = CliRunner().invoke(app, arguments)
    assert second.exit_code == 0 and second.stdout == first.stdout


def test_a_smaller_map_keeps_every_wall() -> None:
    grid = grid_of(rectangle(8.0, 5.0))
    small, large = rescaled(grid, 0.8), rescaled(grid, 1.25)
    for other, factor in ((small, 0.8), (large, 1.25)):
        assert other.resolution_m == grid.resolution_m
        free = other.free.sum() * grid.resolution_m**2
        assert free == pytest.approx(8.0 * 5.0 * factor**2, rel=0.05)
        assert _enclosed(other)
    even = grid_of(rectangle(8.0, 5.0)[:320, :320])
    blocks = even.occupied.reshape(160, 2, 160, 2).any(axis=(1, 3))
    assert np.array_equal(rescaled(even, 0.5).occupied, blocks)


def _enclosed(grid: OccupancyGrid) -> bool:
    """No free cell touches an unknown one."""
    from scipy.ndimage import binary_dilation

    return not (binary_dilation(grid.free) & ~grid.free & ~grid.occupied).any()
