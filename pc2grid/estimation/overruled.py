"""Where the scans overruled odometry.

Wheels slip, and odometry of real robots comes late, bunched or repeated. The scans then show another motion,
and tracking follows them; the poses are fine, but a user wants to know where and how often that was so.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import invert_pose, motion_size
from pc2grid.model import OdometryCheck, Overruled

_INEXACT_M, _INEXACT_RAD, _INEXACT_SHARE = 0.1, 0.1, 0.1
"""Odometry that differs by less, or by less than this share of the motion, is merely inexact; by hand."""
_TOGETHER_NS = 10**9
"""Overruled scans that follow each other within this time are one stretch; chosen by hand."""
_SHOWN = 20
"""Stretches that are kept."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """By how much the motion to a scan that odometry reports differs from that which the scan shows.

    distance_m, turn_rad : size of the difference. overrules : whether it is more than odometry that is merely
        inexact explains.
    """

    distance_m: float
    turn_rad: float
    overrules: bool


def disagreement(reported: F64, moved: F64) -> Disagreement:
    """By how much the motion (4, 4) that odometry reports differs from that of the poses."""
    distance_m, turn_rad = motion_size(invert_pose(reported) @ moved)
    (reported_m, reported_rad), (moved_m, moved_rad) = motion_size(reported), motion_size(moved)
    overrules = distance_m > _INEXACT_M + _INEXACT_SHARE * max(
        reported_m, moved_m
    ) or turn_rad > _INEXACT_RAD + _INEXACT_SHARE * max(reported_rad, moved_rad)
    return Disagreement(distance_m, turn_rad, overrules)


def check_odometry(stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]) -> OdometryCheck:
    """What the scans of a session say of its odometry.

    disagreements : of each scan; None where there was nothing to compare.
    """
    compared = [(stamp, found) for stamp, found in zip(stamps_ns, disagreements, strict=True) if found]
    overruled = [(stamp_ns, found) for stamp_ns, found in compared if found.overrules]
    ends = np.flatnonzero(np.diff([stamp_ns for stamp_ns, _ in overruled]) > _TOGETHER_NS) + 1
    cuts = [0, *ends.tolist(), len(overruled)]
    stretches = [
        Overruled(
            from_ns=group[0][0],
            to_ns=group[-1][0],
            distance_m=max(found.distance_m for _, found in group),
            turn_rad=max(found.turn_rad for _, found in group),
        )
        for group in (overruled[first:end] for first, end in itertools.pairwise(cuts) if first < end)
    ]
    stretches.sort(key=lambda s: (-(s.distance_m + s.turn_rad), s.from_ns))
    return OdometryCheck(
        compared=len(compared), overruled=len(overruled), stretches=tuple(stretches[:_SHOWN])
    )
