"""The pose graph of a session as a g2o text file (g2o, GTSAM, Ceres and SE-Sync read it).

`VERTEX_SE2 id x y yaw` and `EDGE_SE2 from to dx dy dyaw`, followed by the upper triangle of the information
matrix, row by row. Poses are planar, because loops are closed in the plane.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.io.atomic import replace_file
from pc2grid.model import Health, Loop, Trajectory

# Standard deviation of tracking as a random walk, of the order that loop closure assumes; chosen by hand.
_WALK_M, _WALK_RAD = 0.03, math.radians(0.5)  # after one metre
_LEAST_M, _LEAST_RAD = 1e-3, 1e-3  # without motion
_LOST = 1e-3  # factor on the information of a step where registration was lost; chosen by hand
_UPPER = np.triu_indices(3)


def write_g2o(path: str | Path, trajectory: Trajectory, loops: Iterable[Loop]) -> None:
    """Write the trajectory and the loops that were accepted.

    Vertex k is pose k of the trajectory after loop closure. The edges between consecutive vertices are the
    steps of this trajectory; their uncertainty grows with the distance and is large where registration was
    lost. The edges of loops are the measured relative poses with their own information.
    Raises OutputError if the file cannot be written.
    """
    poses = list(trajectory.poses())
    health = trajectory.health or (Health.FINE,) * len(poses)
    lines = [_line("VERTEX_SE2", [k], pose) for k, pose in enumerate(poses)]
    for k in range(1, len(poses)):
        step = poses[k - 1].inverse() @ poses[k]
        trust = _LOST if Health.LOST in health[k - 1 : k + 1] else 1.0
        lines.append(_line("EDGE_SE2", [k - 1, k], step, trust * _information_of(step)))
    lines += [
        _line("EDGE_SE2", [loop.older, loop.newer], loop.T_older_newer, loop.information)
        for loop in loops
        if loop.accepted
    ]
    with replace_file(path) as temporary:
        temporary.write_text("".join(lines), encoding="ascii")


def _information_of(step: SE2) -> F64:
    """(3, 3) information of x, y, yaw of one step."""
    root = math.sqrt(math.hypot(step.x, step.y))
    sigma_m, sigma_rad = _LEAST_M + _WALK_M * root, _LEAST_RAD + _WALK_RAD * root
    return np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])


def _line(tag: str, ids: list[int], pose: SE2, information: F64 | None = None) -> str:
    numbers = [f"{value:.9f}" for value in (pose.x, pose.y, pose.yaw)]
    if information is not None:
        numbers += [f"{value:.9g}" for value in information[_UPPER]]
    return " ".join([tag, *map(str, ids), *numbers]) + "\n"
