"""How poses differ, and how frames lie to each other by the poses that are known in both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pc2grid.geometry import SE2, wrap_angle


def apart(a: SE2, b: SE2) -> tuple[float, float]:
    """Metres and radians between two poses in one frame."""
    error = a.inverse() @ b
    return math.hypot(error.x, error.y), abs(float(wrap_angle(error.yaw)))


def fit_frame(pairs: Sequence[tuple[SE2, SE2]], ahead_m: float) -> SE2:
    """T_b_a that brings poses in a frame a nearest to the same poses in a frame b, least squares.

    pairs : of poses in a and in b. ahead_m : a heading counts as much as the position of a point so far
        ahead.
    """
    ahead = np.array([(0.0, 0.0), (ahead_m, 0.0)])
    in_a, in_b = (np.concatenate([pair[k].apply(ahead) for pair in pairs]) for k in (0, 1))
    return SE2.fit(in_a, in_b)
