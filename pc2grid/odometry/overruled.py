"""Where the scans overruled odometry.

Wheels slip, and odometry of real robots comes late, bunched or repeated. The scans then show another motion,
and tracking follows them; the poses are fine, but a user wants to know where and how often that was so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pc2grid.model import OdometryCheck, Overruled

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
