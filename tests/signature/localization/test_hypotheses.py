"""Which wall points the coarse search takes."""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F32
from signature.localization.hypotheses import HYPOTHESES, coarse_points

CENTER_M = (3.0, -2.0)


def ring(radius_m: float, count: int) -> F32:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    around = radius_m * np.column_stack((np.cos(angles), np.sin(angles))) + CENTER_M
    return np.asarray(around, np.float32)


def test_near_and_far_walls_have_the_same_share() -> None:
    """Boxes around the robot give many points; the walls of the hall behind them must count as well."""
    boxes = np.concatenate([ring(r, 200) for r in (1.0, 2.0, 3.0, 4.0)])
    chosen = coarse_points(np.concatenate((boxes, ring(15.0, 500), ring(30.0, 500))), CENTER_M)
    away_m = np.hypot(*chosen.T)
    assert np.count_nonzero(away_m < 8.0) == HYPOTHESES.few_points
    assert np.count_nonzero(np.abs(away_m - 15.0) < 0.1) == HYPOTHESES.few_points
    assert away_m.max() < HYPOTHESES.far_m


def test_a_room_has_near_walls_only() -> None:
    chosen = coarse_points(ring(4.0, 400), CENTER_M)
    assert 0 < len(chosen) <= HYPOTHESES.few_points
    assert coarse_points(np.empty((0, 2), np.float32), CENTER_M).shape == (0, 2)
