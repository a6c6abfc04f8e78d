"""The truth of a registered session is that of its last part."""

import math

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.geometry import SE2
from pc2grid_lab.sensors import RegisteredSession

T_WORLD_ODOM = SE2(5.0, -3.0, math.radians(40.0))


def driven(lost_at: int | None, jump: SE2) -> RegisteredSession:
    """Twenty scans, 0.1 m apart; from the lost one on, registered poses are wrong by `jump`."""
    T_odom_base = [SE2(0.1 * k, 0.0, 0.0) for k in range(20)]
    registered = [jump @ T if lost_at is not None and k >= lost_at else T for k, T in enumerate(T_odom_base)]
    truth = [T_WORLD_ODOM @ T for T in T_odom_base]
    lost = np.zeros(20, bool)
    if lost_at is not None:
        lost[lost_at] = True
    nothing = {
        "hits_m": np.empty((0, 2), np.float32),
        "origin_m": np.zeros(2),
        "free_m": np.zeros(8, np.float32),
    }
    return RegisteredSession(
        sensor="laser",
        planar_scans=tuple(
            PlanarScan(stamp_ns=k, normal_rad=np.empty(0, np.float32), **nothing) for k in range(20)
        ),
        T_odom_base=np.array([(T.x, T.y, T.yaw) for T in registered]),
        lost=lost,
        T_world_base=np.array([(T.x, T.y, T.yaw) for T in truth]),
    )


@pytest.mark.parametrize("lost_at", [None, 3, 12, 19])
def test_scans_from_before_registration_was_lost_do_not_count(lost_at: int | None) -> None:
    jump = SE2(0.2, 0.1, math.radians(30.0)) if lost_at is not None else SE2()
    error = T_WORLD_ODOM.inverse() @ driven(lost_at, jump).T_world_odom() @ jump
    assert math.hypot(error.x, error.y) < 1e-6 and abs(error.yaw) < 1e-6
