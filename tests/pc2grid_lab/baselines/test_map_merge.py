"""The rival that merges maps by image features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid_lab.baselines.map_merge import CONFIDENT, merge
from tests.helpers.simulated_drives import office


def test_a_map_is_merged_with_itself_where_it_was_put() -> None:
    grid = office()
    moved = replace(grid, cells=np.rot90(grid.cells).copy(), origin_m=(3.0, -1.0))
    found = merge(grid, moved)
    assert found.confidence >= CONFIDENT and found.T_target_source is not None
    # A quarter turn of the cells: row r, column c becomes row (W - 1 - c), column r.
    corner = moved.to_point(np.array([[0, 0]]))[0]
    back = found.T_target_source.apply(np.array([corner]))[0]
    expected = grid.to_point(np.array([[0, grid.cells.shape[1] - 1]]))[0]
    assert np.linalg.norm(back - expected) < 0.1
    assert found.scale == pytest.approx(1.0, abs=0.01)
    assert isinstance(found.T_target_source, SE2)


def test_a_mirror_image_is_not_merged() -> None:
    grid = office()
    assert merge(grid, replace(grid, cells=grid.cells[:, ::-1].copy())).confidence < CONFIDENT
