"""Where the scans overruled odometry.

Wheels slip, and odometry of real robots comes late, bunched or repeated. The scans then show another motion,
and tracking follows them; the poses are fine, but a user wants to know where and how often that was so.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from pc2grid.arrays import F64
from pc2grid.geometry import invert_pose, motion_size
from pc2grid.model import OdometryCheck, Overruled

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
    stretches: list[Overruled] = []
    compared = overruled = 0
    for stamp_ns, found in zip(stamps_ns, disagreements, strict=True):
        if found is None:
            continue
        compared += 1
        if not found.overrules:
            continue
        overruled += 1
        stretch = Overruled(
            from_ns=stamp_ns, to_ns=stamp_ns, distance_m=found.distance_m, turn_rad=found.turn_rad
        )
        if stretches and stamp_ns - stretches[-1].to_ns <= _TOGETHER_NS:
            last = stretches.pop()
            stretch = Overruled(
                from_ns=last.from_ns,
                to_ns=stamp_ns,
                distance_m=max(last.distance_m, stretch.distance_m),
                turn_rad=max(last.turn_rad, stretch.turn_rad),
            )
        stretches.append(stretch)
    stretches.sort(key=lambda s: (-(s.distance_m + s.turn_rad), s.from_ns))
    return OdometryCheck(compared=compared, overruled=overruled, stretches=tuple(stretches[:_SHOWN]))


def stalls(stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]) -> list[Stall]:
    """Where the poses make less than half of the travel that odometry reports, in the order of time.

    From scan to scan that may be too little to be noticed. Either the wheels spin, or the scans show
    something that goes along with the robot, such as the floor ahead on a slope that was not noticed. The
    lengths of the ways are compared, since odometry may have the direction wrong (fr079: forwards for
    backwards).
    """
    known = [(stamp, found) for stamp, found in zip(stamps_ns, disagreements, strict=True) if found]
    behind = [False] * len(known)
    first, reported_m, moved_m = 0, 0.0, 0.0
    for last, (_, found) in enumerate(known):
        reported_m += found.reported_m
        moved_m += found.moved_m
        while reported_m - known[first][1].reported_m >= _STALLED_M:
            reported_m -= known[first][1].reported_m
            moved_m -= known[first][1].moved_m
            first += 1
        if reported_m >= _STALLED_M and moved_m < _STALLED_SHARE * reported_m:
            behind[first : last + 1] = [True] * (last + 1 - first)
    return [
        Stall(
            from_ns=known[members[0]][0],
            to_ns=known[members[-1]][0],
            reported_m=sum(known[k][1].reported_m for k in members),
            moved_m=sum(known[k][1].moved_m for k in members),
        )
        for stalled, group in itertools.groupby(range(len(known)), key=behind.__getitem__)
        if stalled and (members := list(group))
    ]
