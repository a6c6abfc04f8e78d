"""The likelihood field against its definition, with distances by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from pc2grid.matching.walls import LIKELIHOOD, LikelihoodField, LikelihoodParameters
from pc2grid.model import OccupancyGrid


def a_grid(resolution_m: float = 0.05) -> OccupancyGrid:
    cells = np.random.default_rng(0).choice([-1, 0, 50, 100], (90, 140), p=[0.2, 0.75, 0.03, 0.02])
    cells[:, 100:] = np.where(cells[:, 100:] == 100, 0, cells[:, 100:])
    return OccupancyGrid(cells=cells.astype(np.int8), resolution_m=resolution_m, origin_m=(-1.0, 2.0))


@pytest.mark.parametrize(("resolution_m", "sigma_m"), [(0.05, 0.1), (0.1, 0.1), (0.03, 0.07)])
def test_the_field_is_a_gaussian_of_the_exact_distance(resolution_m: float, sigma_m: float) -> None:
    grid = a_grid(resolution_m)
    distance = distance_transform_edt(~grid.occupied)
    expected = np.exp(-0.5 * (distance * (resolution_m / sigma_m)) ** 2) * 255.0
    unknown = ~(grid.occupied | grid.free)  # never observed, or neither free nor occupied
    expected[unknown] = np.maximum(expected[unknown], LIKELIHOOD.neutral * 255.0)
    field = LikelihoodField.of(grid, LikelihoodParameters(sigma_m=sigma_m))
    assert np.abs(field.values - np.floor(expected)).max() <= 1  # float32 against float64
    assert np.mean(field.values == np.floor(expected)) > 0.999
    assert np.array_equal(field.known, ~unknown)


def test_points_are_looked_up_in_their_cells_and_outside_nothing_is_known() -> None:
    grid = a_grid()
    field = LikelihoodField.of(grid)
    cells = np.argwhere(grid.occupied)
    likelihood, known = field.at(grid.to_point(cells))
    assert (likelihood == 1.0).all() and known.all()
    likelihood, known = field.at(np.array([[-1.01, 3.0], [0.0, 1.99], [6.01, 3.0], [0.0, 6.51]]))
    assert not likelihood.any() and not known.any()
