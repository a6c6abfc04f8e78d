"""The paper's experiment (paper IV-B): queries, noise, precision and recall."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.model import FREE, OCCUPIED, OccupancyGrid
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.submaps import view_at
from pc2grid_lab.paper.experiment import (
    NOISE_LEVELS,
    BestMatches,
    Experiment,
    Matcher,
    Noise,
    add_noise,
    draw_queries,
    evaluate,
)
from pc2grid_lab.paper.methods import make_methods
from tests.helpers.rooms import canvas, cross, disc, grid_of, l_shape, rectangle, submap_of

SILENT = NOISE_LEVELS[0]
PAPER = PartitionConfig.paper()


def floor() -> OccupancyGrid:
    """Four different rooms side by side, 16 m apart."""
    return grid_of(np.hstack([rectangle(8.0, 5.0), disc(4.0), cross(6.0, 2.0), l_shape()]))


def centers() -> np.ndarray:
    return np.array([[-24.075, 0.0], [-8.025, 0.0], [8.025, 0.0], [21.0, -3.0]])


def test_precision_and_recall_by_hand() -> None:
    correct = np.array([True, True, False, True, False])
    matches = BestMatches(similarity=np.array([0.9, 0.8, 0.7, 0.6, 0.5]), correct=correct)
    curve, measures = matches.curve(), matches.measures()
    assert curve.recall.tolist() == pytest.approx([1 / 3, 2 / 3, 2 / 3, 1, 1])
    assert curve.precision.tolist() == pytest.approx([1, 1, 2 / 3, 3 / 4, 3 / 5])
    assert measures.auc == pytest.approx(2 / 3 + (2 / 3 + 3 / 4) / 2 / 3)
    assert measures.rp9 == pytest.approx(2 / 3)
    assert measures.f1 == pytest.approx(2 * 0.75 / 1.75)


def test_nothing_true_has_no_area() -> None:
    matches = BestMatches(similarity=np.array([0.5, 0.4]), correct=np.array([False, False]))
    assert matches.measures() == (0.0, 0.0, 0.0, 0.0)


def test_queries_lie_near_centres_on_free_cells_and_repeat() -> None:
    grid, experiment = floor(), Experiment(queries=60, offset_m=0.5, seed=3)
    queries = list(draw_queries(grid, centers(), 8.0, experiment, SILENT))
    places = np.array([q.center_m for q in queries])
    nearest = np.linalg.norm(places[:, None] - centers()[None], axis=2).min(axis=1)
    assert nearest.max() <= 0.5 and nearest.max() > 0.4
    cells = grid.to_cell(places)
    assert (grid.cells[cells[:, 0], cells[:, 1]] == FREE).all()
    for one, other in zip(queries, draw_queries(grid, centers(), 8.0, experiment, SILENT), strict=True):
        assert one.center_m == other.center_m and np.array_equal(one.grid.cells, other.grid.cells)
    other_seed = next(draw_queries(grid, centers(), 8.0, Experiment(queries=1, seed=4), SILENT))
    assert other_seed.center_m != queries[0].center_m


def test_a_plan_without_a_free_place_is_refused() -> None:
    with pytest.raises(ValueError, match="no free cell"):
        next(draw_queries(grid_of(canvas()), np.zeros((1, 2)), 8.0, Experiment(queries=1), SILENT))


def test_noise_has_the_given_counts_and_places() -> None:
    submap = submap_of(rectangle(10.0, 10.0))
    noisy = add_noise(submap, Noise(boundary=0, freespace=4), np.random.default_rng(0))
    added = noisy.grid.occupied & ~submap.grid.occupied
    # Four obstacles of a circle's or a square's area, less where they overlap each other or the wall.
    area = added.sum() * 0.05**2
    assert 0.5 * 4 * np.pi * 0.25**2 < area <= 4 * 0.55**2
    speckled = add_noise(submap, Noise(boundary=30, freespace=0), np.random.default_rng(0))
    added = np.argwhere(speckled.grid.occupied & ~submap.grid.occupied)
    walls = np.argwhere(submap.grid.occupied)
    reach = np.linalg.norm(added[:, None] - walls[None], axis=2).min(axis=1) * 0.05
    assert 0 < reach.max() < 0.6
    assert 100 < len(added) <= 300


def test_obstacles_stand_on_unknown_cells_too() -> None:
    """The paper puts them on unoccupied pixels. Here one in ten is free; all lie within the disc."""
    cells = canvas()
    cells[:, 145:177] = FREE
    cells[100:220, 140] = OCCUPIED
    submap = submap_of(cells)
    noisy = add_noise(submap, Noise(boundary=0, freespace=200), np.random.default_rng(0))
    added = noisy.grid.occupied & ~submap.grid.occupied
    on_free = added & submap.grid.free
    assert on_free.any() and on_free.sum() < 0.3 * added.sum()
    reach = np.linalg.norm(np.argwhere(added) - 160, axis=1) * 0.05
    assert 7.5 < reach.max() <= 8.0


def test_the_paper_method_finds_rooms_that_differ() -> None:
    grid = floor()
    submaps = [view_at(grid, (float(x), float(y)), PAPER, submap_id=i) for i, (x, y) in enumerate(centers())]
    outcomes = evaluate(make_methods(["proposed"]), grid, submaps, Experiment(queries=40), SILENT)
    assert outcomes["proposed"].correct.mean() > 0.95
    again = evaluate(make_methods(["proposed"]), grid, submaps, Experiment(queries=40), SILENT)
    assert np.array_equal(outcomes["proposed"].similarity, again["proposed"].similarity)


def test_a_match_elsewhere_is_false() -> None:
    grid = floor()
    submaps = [view_at(grid, (float(x), float(y)), PAPER) for x, y in centers()]

    def stubborn(_submaps: object) -> Matcher:
        return lambda query: np.array([1.0, 0.0, 0.0, 0.0])

    outcome = evaluate({"stubborn": stubborn}, grid, submaps, Experiment(queries=100), SILENT)["stubborn"]
    assert outcome.correct.mean() == pytest.approx(0.25, abs=0.12)
    with pytest.raises(ValueError, match="without submaps"):
        evaluate({"stubborn": stubborn}, grid, [], Experiment(queries=1), SILENT)
