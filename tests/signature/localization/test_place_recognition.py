"""A session that recognises its own earlier places."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.mapping.loops import PlaceMap
from pc2grid.matching.score import Fit
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from signature.config import Config
from signature.localization.place_recognition import RECOGNITION, RecognitionParameters, SessionRecognizer
from tests.helpers.simulated_drives import with_tables


def rooms(seed: int) -> OccupancyGrid:
    """A furnished hall between walls, 0.8 m wider than that of the seed before; the origin lies in its
    middle. (Halls of one outline are one place, as far as their walls go.)"""
    rng = np.random.default_rng(seed)
    n = round((9.0 + 0.8 * seed) / 0.05)
    cells = np.full((n + 40, n + 40), UNKNOWN, np.int8)
    cells[20:-20, 20:-20] = FREE
    cells[[20, 21, -22, -21], 20:-20] = OCCUPIED
    cells[20:-20, [20, 21, -22, -21]] = OCCUPIED
    for _ in range(9):
        row, column = rng.integers(24, n - 20, 2)
        long, wide = rng.integers(4, 10), rng.integers(16, 36)
        if rng.random() < 0.5:
            long, wide = wide, long
        cells[row : row + long, column : column + wide] = OCCUPIED
    middle = (n + 40) // 2
    cells[middle - 12 : middle + 12, middle - 30 : middle + 30] = FREE
    half_m = 0.05 * middle
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(-half_m, -half_m))


def seen_from(grid: OccupancyGrid, pose: SE2) -> OccupancyGrid:
    """The same map in another frame, which lies at `pose` in it."""
    n = grid.cells.shape[0] + 120
    origin_m = (-0.025 * n, -0.025 * n)
    empty = OccupancyGrid(cells=np.full((n, n), UNKNOWN, np.int8), resolution_m=0.05, origin_m=origin_m)
    rows, columns = np.indices((n, n)).reshape(2, -1)
    at = grid.to_cell(pose.apply(empty.to_point(np.column_stack((rows, columns)))))
    inside = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    cells = empty.cells.copy()
    cells[rows[inside], columns[inside]] = grid.cells[at[inside, 0], at[inside, 1]]
    return OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=origin_m)


def stretch(index: int, grid: OccupancyGrid) -> PlaceMap:
    poses = np.column_stack((np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)))
    return PlaceMap(index=index, grid=grid, poses=poses, scans=np.arange(9))


def test_an_earlier_place_is_recognised_and_a_new_one_is_not() -> None:
    recognizer = SessionRecognizer(Config(), RecognitionParameters(maps=2))
    assert list(recognizer.recognize(stretch(0, rooms(0)))) == []
    for index in (1, 2, 3):
        found = recognizer.recognize(stretch(index, rooms(index)))
        assert all(recognition.probability < 0.9 for recognition in found)
    again = SE2(0.7, -0.4, 2.0)
    found = recognizer.recognize(stretch(4, seen_from(rooms(1), again)))
    best = max(found, key=lambda recognition: recognition.probability)
    assert (best.older, best.newer) == (1, 4) and best.probability > 0.95
    assert math.hypot(best.T_older_newer.x - again.x, best.T_older_newer.y - again.y) < 0.1
    assert abs(wrap_angle(best.T_older_newer.yaw - again.yaw)) < 0.02
    assert all(recognition.older < 4 for recognition in found)


def test_tables_that_were_seen_over_and_under_do_not_hide_an_earlier_place() -> None:
    """They were carried away since. They hide it if nothing tells at which heights they stood."""
    tables, probable = with_tables(rooms(1)), []
    for earlier in (tables, replace(tables, heights=None)):
        recognizer = SessionRecognizer(Config())
        recognizer.recognize(stretch(0, earlier))
        found, *_ = recognizer.recognize(stretch(1, rooms(1)))
        probable.append(found.probability)
    assert probable[0] > 0.99 > 0.9 > probable[1]


def test_two_maps_show_one_place_the_surer_the_more_walls_agree() -> None:
    def probability(score: float, compared: float) -> float:
        return RECOGNITION.probability(cast(Fit, SimpleNamespace(score=score, compared=compared)))

    assert probability(0.627, 1000.0) == pytest.approx(0.5)
    assert probability(0.9, 100.0) > 0.99 > probability(0.9, 10.0) > 0.5
    assert probability(0.3, 1000.0) < 0.01
