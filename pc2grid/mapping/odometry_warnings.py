"""What is wrong with odometry, or with where tf puts the sensor, in a whole recording.

The scans show how the robot moves. Odometry that reports the opposite all the time, or nothing, does not
merely slip: the sensor is mounted upside down, or turned by half a turn, and tf does not say so; or the
odometry has a wrong sign, stands still, or knows no turns. A map of such a recording may be mirrored.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.geometry import invert_pose, rotation_vector
from pc2grid.model import Health, Trajectory

_APART_NS = 10**9
"""Motions are compared over this time at least: late or bunched odometry has caught up by then; by hand."""
_LEAST_MOTION = 0.1
"""Motions of less than this, in metres or radians, are noise; chosen by hand."""
_LEAST_TRAVEL_M, _LEAST_TURN_RAD = 2.0, 1.5
"""Less than this in all says nothing of odometry; chosen by hand."""
_OPPOSITE, _LEAST, _MOST = -0.5, 0.25, 1.75
"""Shares of what the scans show. Odometry that reports less than the first has the sign wrong; what is not
between the others is no measure of it. In eight real recordings it reports .93 to 1.15."""


class _Compared(NamedTuple):
    """Motions that the scans show, and what odometry reports of them.

    shown, reported : sums of their lengths. share : how much of what is shown odometry reports.
    """

    shown: float
    reported: float
    share: float


def odometry_warnings(trajectory: Trajectory, readings: F64) -> list[str]:
    """At most two sentences for the user, on the travel and on the turns.

    readings : (N, 4, 4) T_odom_base at each scan, not finite where there is none.
    """
    shown, reported = _motions(trajectory, readings)
    travel, turns = (_compared(shown[:, part], reported[:, part]) for part in (slice(3), slice(3, 6)))
    warnings = []
    if travel.shown >= _LEAST_TRAVEL_M and travel.share < _OPPOSITE:
        warnings.append(
            "odometry reports travel the other way than the scans show: the sensor is mounted turned by half "
            "a turn and tf does not say so, or odometry counts backwards"
        )
    elif travel.shown >= _LEAST_TRAVEL_M and not _LEAST <= travel.share <= _MOST:
        warnings.append(
            f"odometry reports {travel.reported:.1f} m where the scans show {travel.shown:.1f} m of travel, "
            "or in another direction: it stands still, has another unit, or the sensor is mounted otherwise "
            "than tf says; --odometry none ignores it"
        )
    if turns.shown >= _LEAST_TURN_RAD and turns.share < _OPPOSITE:
        warnings.append(
            "odometry turns the other way than the scans: the sensor is mounted upside down and tf does not "
            "say so, which mirrors the map, or odometry has left and right exchanged"
        )
    elif turns.shown >= _LEAST_TURN_RAD and not _LEAST <= turns.share <= _MOST:
        warnings.append(
            f"odometry reports {turns.reported:.1f} rad where the scans show turns of {turns.shown:.1f} rad "
            "in all, or about another axis; --odometry none ignores it"
        )
    return warnings


def _motions(trajectory: Trajectory, readings: F64) -> tuple[F64, F64]:
    """Motions (M, 6), in metres and as rotation vectors, by the scans and by odometry, between scans that fix
    the pose."""
    fixed = np.array([health in (Health.FINE, Health.OVERRULED) for health in trajectory.health], bool)
    lost = np.cumsum([health is Health.LOST for health in trajectory.health])
    usable = np.flatnonzero(fixed & np.isfinite(readings).all(axis=(1, 2)))
    ends = itertools.pairwise(_apart(trajectory.stamps_ns, usable))
    pairs = [(a, b) for a, b in ends if lost[a] == lost[b]]
    shown, reported = (
        np.array([_step(poses[a], poses[b]) for a, b in pairs]).reshape(-1, 6)
        for poses in (trajectory.T_session_base, readings)
    )
    return shown, reported


def _apart(stamps_ns: NDArray[np.int64], scans: NDArray[np.intp]) -> list[int]:
    """Of some scans, those that follow each other after the time over which motions are compared."""
    chosen: list[int] = []
    for scan in scans.tolist():
        if not chosen or stamps_ns[scan] - stamps_ns[chosen[-1]] >= _APART_NS:
            chosen.append(scan)
    return chosen


def _step(a: F64, b: F64) -> F64:
    """The motion (6,) from a pose (4, 4) to another one."""
    motion = invert_pose(a) @ b
    return np.concatenate((motion[:3, 3], rotation_vector(motion)))


def _compared(shown: F64, reported: F64) -> _Compared:
    """Motions (M, 3) beside those that are reported (M, 3). A jump of odometry counts no more than twice."""
    lengths = np.linalg.norm(shown, axis=1)
    moves = lengths >= _LEAST_MOTION
    shown, reported, lengths = shown[moves], reported[moves], lengths[moves]
    shares = np.clip(np.einsum("nk,nk->n", shown, reported) / lengths**2, -2.0, 2.0)
    total = float(lengths.sum())
    share = float((lengths * shares).sum()) / total if total else 1.0
    return _Compared(total, float(np.linalg.norm(reported, axis=1).sum()), share)
