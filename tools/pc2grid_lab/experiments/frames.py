"""Which pose belongs to a scan, how poses differ, and how frames lie to each other by poses known in both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pc2grid.arrays import I64
from pc2grid.geometry import SE2, wrap_angle

_SAME_NS = 1_000_000
"""A true pose belongs to a scan if their stamps differ by no more than this."""


def number_at(stamps_ns: I64, stamp_ns: int) -> int | None:
    """The first of the stamps (N,), increasing, that is the one of a scan; None if there is none."""
    k = int(np.searchsorted(stamps_ns, stamp_ns - _SAME_NS))
    return k if k < len(stamps_ns) and stamps_ns[k] <= stamp_ns + _SAME_NS else None


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
