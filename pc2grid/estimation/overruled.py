"""Where the scans overruled odometry.

Wheels slip, and odometry of real robots comes late, bunched or repeated. The scans then show another motion,
and tracking follows them; the poses are fine, but a user wants to know where and how often that was so.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pc2grid.arrays import F64, BoolGrid
from pc2grid.geometry import invert_pose, motion_size
from pc2grid.model import OdometryCheck, Overruled

T = TypeVar("T")

_INEXACT_M, _INEXACT_RAD, _INEXACT_SHARE = 0.1, 0.1, 0.1
"""Odometry that differs by less, or by less than this share of the motion, is merely inexact; by hand."""
_TOGETHER_NS = 10**9
"""Overruled scans that follow each other within this time are one stretch; chosen by hand."""
_SHOWN = 20
"""Stretches that are kept."""

_STALLED_M = 2.0
"""Odometry and scans are compared over this travel: late or bunched odometry has caught up by then."""
_STALLED_SHARE = 0.5
"""Of that travel, what the poses must make at least. Wheels slip by a few percent."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """By how much the motion to a scan that odometry reports differs from that which the scan shows.

    distance_m, turn_rad : size of the difference. overrules : whether it is more than odometry that is merely
        inexact explains. reported_m, moved_m : length of both motions.
    """

    distance_m: float
    turn_rad: float
    overrules: bool
    reported_m: float = 0.0
    moved_m: float = 0.0


def disagreement(reported: F64, moved: F64) -> Disagreement:
    """By how much the motion (4, 4) that odometry reports differs from that of the poses."""
    distance_m, turn_rad = motion_size(invert_pose(reported) @ moved)
    (reported_m, reported_rad), (moved_m, moved_rad) = motion_size(reported), motion_size(moved)
    overrules = distance_m > _INEXACT_M + _INEXACT_SHARE * max(
        reported_m, moved_m
    ) or turn_rad > _INEXACT_RAD + _INEXACT_SHARE * max(reported_rad, moved_rad)
    return Disagreement(distance_m, turn_rad, overrules, reported_m=reported_m, moved_m=moved_m)


@dataclass(frozen=True, slots=True)
class Stall:
    """A stretch of metres over which wheels turn and poses stay behind.

    from_ns, to_ns : its first and its last scan. reported_m, moved_m : travel by odometry and by the poses.
    """

    from_ns: int
    to_ns: int
    reported_m: float
    moved_m: float


def check_odometry(stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]) -> OdometryCheck:
    """What the scans of a session say of its odometry.

    disagreements : of each scan; None where there was nothing to compare.
    """
    compared = _known(stamps_ns, disagreements)
    overruled = [(stamp_ns, found) for stamp_ns, found in compared if found.overrules]
    apart = np.diff([stamp_ns for stamp_ns, _ in overruled]) > _TOGETHER_NS
    stretches = [
        Overruled(
            from_ns=group[0][0],
            to_ns=group[-1][0],
            distance_m=max(found.distance_m for _, found in group),
            turn_rad=max(found.turn_rad for _, found in group),
        )
        for group in _split(overruled, apart)
    ]
    stretches.sort(key=lambda s: (-(s.distance_m + s.turn_rad), s.from_ns))
    return OdometryCheck(
        compared=len(compared), overruled=len(overruled), stretches=tuple(stretches[:_SHOWN])
    )


def stalls(stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]) -> list[Stall]:
    """Where the poses make less than half of the travel that odometry reports, in the order of time.

    From scan to scan that may be too little to be noticed. Either the wheels spin, or the scans show
    something that goes along with the robot, such as the floor ahead on a slope that was not noticed. The
    lengths of the ways are compared, since odometry may have the direction wrong (fr079: forwards for
    backwards).
    """
    known = _known(stamps_ns, disagreements)
    steps_m = np.array([(found.reported_m, found.moved_m) for _, found in known]).reshape(-1, 2)
    reported_m, moved_m = np.vstack((np.zeros((1, 2)), steps_m.cumsum(axis=0))).T
    # Of each scan, the shortest way up to it over which the two are compared.
    first = np.searchsorted(reported_m, reported_m - _STALLED_M, side="right") - 1
    share = (moved_m - moved_m[first]) / np.maximum(reported_m - reported_m[first], _STALLED_M)
    last = np.flatnonzero((first >= 0) & (share < _STALLED_SHARE))
    ends = np.bincount(first[last], minlength=len(first)) - np.bincount(last, minlength=len(first))
    behind = np.flatnonzero(ends.cumsum()[:-1] > 0)
    return [
        Stall(
            known[k][0],
            known[m][0],
            float(reported_m[m + 1] - reported_m[k]),
            float(moved_m[m + 1] - moved_m[k]),
        )
        for k, m in ((group[0], group[-1]) for group in _split(behind.tolist(), np.diff(behind) > 1))
    ]


def _known(
    stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]
) -> list[tuple[int, Disagreement]]:
    """The scans where there was something to compare, with their stamps."""
    return [(stamp, found) for stamp, found in zip(stamps_ns, disagreements, strict=True) if found]


def _split(items: Sequence[T], ends: BoolGrid) -> list[Sequence[T]]:
    """Items (N,) in groups; `ends` (N - 1,): whether an item is the last of its group."""
    cuts = [0, *(np.flatnonzero(ends) + 1).tolist(), len(items)]
    return [items[first:end] for first, end in itertools.pairwise(cuts) if first < end]
