"""Which pose belongs to a scan, how poses differ, and how frames lie to each other by poses known in both."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import SE2, interpolate_pose, wrap_angle
from pc2grid.model import Trajectory

SAME_NS = 5_000_000
"""A pose or a scan is the one of a stamp if its own differs by no more than this."""
AHEAD_M = 3.0
"""Of poses of a robot, the heading counts as much as the position of a point so far ahead; chosen by hand."""


def nearest(stamps_ns: I64, wanted_ns: I64, within_ns: float = SAME_NS) -> I64:
    """(N,) numbers of the stamps (M,), increasing, that are nearest to the wanted ones (N,); -1 where none is
    so near."""
    if not len(stamps_ns):
        return np.full(len(wanted_ns), -1)
    after = np.searchsorted(stamps_ns, wanted_ns).clip(max=len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(stamps_ns[before] - wanted_ns) < np.abs(stamps_ns[after] - wanted_ns)
    number = np.where(is_before, before, after)
    return np.where(np.abs(stamps_ns[number] - wanted_ns) <= within_ns, number, -1)


def pose_at(trajectory: Trajectory, stamp_ns: int, *, same_ns: float, gap_ns: float) -> F64 | None:
    """T_session_base (4, 4) at a stamp: the pose whose stamp differs by no more than `same_ns`, else between
    two poses no more than `gap_ns` apart; None if there are none."""
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    number = int(nearest(stamps_ns, np.array([stamp_ns]), same_ns)[0])
    if number >= 0:
        return np.asarray(poses[number])
    after = int(np.searchsorted(stamps_ns, stamp_ns))
    if not 0 < after < len(stamps_ns):
        return None
    before_ns, after_ns = int(stamps_ns[after - 1]), int(stamps_ns[after])
    if after_ns - before_ns > gap_ns:
        return None
    return interpolate_pose(poses[after - 1], poses[after], (stamp_ns - before_ns) / (after_ns - before_ns))


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
