"""Walls that change for good while the base stands, and those that only seem to."""

from __future__ import annotations

import numpy as np
import pytest

from pc2grid.estimation.tracker import Standstill
from pc2grid.model import Scan


def at(second: float, x_m: float) -> Scan:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return Scan(
        stamp_ns=int(second * 1e9),
        points_m=np.zeros((1, 3), np.float32),
        T_base_sensor=np.eye(4),
        sensor="laser",
        T_odom_base=pose,
    )


@pytest.mark.parametrize(
    ("fits_before", "left"),
    [
        (True, True),
        (False, False),  # a robot that stands from the start, and of which no scan ever fitted well
    ],
)
def test_walls_have_changed_only_where_they_were_known(fits_before: bool, left: bool) -> None:
    standstill = Standstill()
    assert not standstill.left(at(0.0, 0.0), sure=fits_before)
    assert not any(standstill.left(at(0.1 * k, 0.0), sure=False) for k in range(1, 60))
    assert standstill.left(at(6.0, 0.3), sure=False) == left
