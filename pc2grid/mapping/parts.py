"""Checks of a whole session: which of its parts are connected, and whether odometry agrees with the scans.

Where tracking was lost and started again, the pose relative to earlier scans is unknown: a new segment
begins. Loops that were accepted between two segments join them again. A component of joined segments is a
part, and becomes a session of its own (`connected`).

Odometry that reports the opposite motion all the time, or none, does not merely slip: the sensor is mounted
upside down, or turned by half a turn, and tf does not contain it; or the odometry has a wrong sign, stands
still, or measures no turns. A map of such a recording may be mirrored (`odometry_warnings`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pc2grid.geometry import F64, I64, invert_pose, rotation_vector
from pc2grid.mapping.graph import Edge
from pc2grid.model import Health, Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class PartParameters:
    """Numbers of the division into parts.

    joining : different local maps on each of the two sides that must be in agreeing loops, to join
        them; a single room may look like another one. Chosen by hand.
    least_travel_m : a part with less travel is left out: later recordings are recognised by 8 m of travel and
        more.
    """

    joining: int = 2
    least_travel_m: float = 8.0


PARTS = PartParameters()


def connected(segment: I64, loops: Sequence[Edge]) -> I64:
    """Return the number (N,) of the part of each local map, in the order in which the parts begin.

    segment : (N,) number of the segment of each, from 0. loops : accepted ones. Two segments are joined if
    enough different local maps of the one overlap enough different ones of the other.
    """
    ends: dict[tuple[int, int], list[Edge]] = {}
    for loop in loops:
        ends.setdefault((int(segment[loop.first]), int(segment[loop.second])), []).append(loop)
    joined = [
        pair
        for pair, between in ends.items()
        if len({loop.first for loop in between}) >= PARTS.joining
        and len({loop.second for loop in between}) >= PARTS.joining
    ]
    count = int(segment.max(initial=-1)) + 1
    rows, columns = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, part = np.unique(label[segment], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[part], dtype=np.int64)


_APART_NS = 10**9
"""Motions are compared over this time at least: late or bunched odometry has caught up by then; by hand."""
_LEAST_MOTION = 0.1
"""Motions of less than this, in metres or radians, are noise; chosen by hand."""
_OPPOSITE, _LEAST, _MOST = -0.5, 0.25, 1.75
"""Shares of what the scans show. Odometry that reports less than the first has the sign wrong; what is not
between the others is no measure of it. In eight real recordings it reports .93 to 1.15."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of motion.

    columns : of motions (M, 6). least : with less in all, metres or radians, odometry is not judged; chosen
    by hand. opposite, otherwise : warnings for odometry that reports the opposite, and for odometry that does
    not measure it.
    """

    columns: slice
    least: float
    opposite: str
    otherwise: str


_KINDS = (
    _Kind(
        slice(3),
        2.0,
        "odometry reports travel the other way than the scans show: the sensor is mounted turned by half "
        "a turn and tf does not say so, or odometry counts backwards",
        "odometry reports {reported:.1f} m where the scans show {shown:.1f} m of travel, "
        "or in another direction: it stands still, has another unit, or the sensor is mounted otherwise "
        "than tf says; --odometry none ignores it",
    ),
    _Kind(
        slice(3, 6),
        1.5,
        "odometry turns the other way than the scans: the sensor is mounted upside down and tf does not "
        "say so, which mirrors the map, or odometry has left and right exchanged",
        "odometry reports {reported:.1f} rad where the scans show turns of {shown:.1f} rad "
        "in all, or about another axis; --odometry none ignores it",
    ),
)


def odometry_warnings(trajectory: Trajectory, readings: F64) -> list[str]:
    """Return at most two sentences for the user, on the travel and on the turns.

    readings : (N, 4, 4) T_odom_base at each scan, not finite where there is none.
    """
    motions = _motions(trajectory, readings)
    warnings = []
    for kind in _KINDS:
        shown, reported, share = _compared(*(motion[:, kind.columns] for motion in motions))
        if shown < kind.least or _LEAST <= share <= _MOST:
            continue
        text = kind.opposite if share < _OPPOSITE else kind.otherwise
        warnings.append(text.format(shown=shown, reported=reported))
    return warnings


def _motions(trajectory: Trajectory, readings: F64) -> tuple[F64, F64]:
    """Return motions (M, 6) by the scans and by odometry, in metres and as rotation vectors.

    They are between scans that fix the pose.
    """
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
    """Select scans of which consecutive ones are at least `_APART_NS` apart."""
    chosen: list[int] = []
    for scan in scans.tolist():
        if not chosen or stamps_ns[scan] - stamps_ns[chosen[-1]] >= _APART_NS:
            chosen.append(scan)
    return chosen


def _step(a: F64, b: F64) -> F64:
    """Return the motion (6,) from a pose (4, 4) to another one."""
    motion = invert_pose(a) @ b
    return np.concatenate((motion[:3, 3], rotation_vector(motion)))


def _compared(shown: F64, reported: F64) -> tuple[float, float, float]:
    """Compare motions (M, 3) by the scans with reported ones (M, 3).

    Returns the sums of their lengths, and the reported share of the motion by the scans; a jump counts no
    more than twice.
    """
    lengths = np.linalg.norm(shown, axis=1)
    moves = lengths >= _LEAST_MOTION
    shown, reported, lengths = shown[moves], reported[moves], lengths[moves]
    shares = np.clip(np.einsum("nk,nk->n", shown, reported) / lengths**2, -2.0, 2.0)
    total = float(lengths.sum())
    share = float((lengths * shares).sum()) / total if total else 1.0
    return total, float(np.linalg.norm(reported, axis=1).sum()), share
