"""The line on which the likely places of an ambiguous answer lie.

The walls of a corridor hold a query across it, and with its heading; along it the query fits again and again.
Then there are many places, and yet much is known: a line, and a heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.geometry import SE2, wrap_angle
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.posterior import POSTERIOR


@dataclass(frozen=True, slots=True, kw_only=True)
class AmbiguousLine:
    """A line on which likely places lie, all with one heading.

    begin_m, end_m : (x, y) of its ends, in the frame of the best hypothesis. yaw_rad : the heading there.
    probability : that the base is at one of these places.
    """

    begin_m: tuple[float, float]
    end_m: tuple[float, float]
    yaw_rad: float
    probability: float

    @property
    def length_m(self) -> float:
        """From one end to the other."""
        return math.dist(self.begin_m, self.end_m)


def ambiguous_line(bases: Sequence[SE2], masses: Sequence[float]) -> AmbiguousLine | None:
    """The line through the best place that most of the mass lies on, with the heading of that place.

    bases : the base at each place of one frame, best first. masses : of each. None if no other place has this
    heading, or if it is not likely that the base is at one of them.
    """
    lines = (_through(bases, masses, other) for other in range(1, len(bases)))
    likely = [line for line in lines if line is not None and line.probability >= POSTERIOR.likely]
    return max(likely, key=lambda line: line.probability, default=None)


def _through(bases: Sequence[SE2], masses: Sequence[float], other: int) -> AmbiguousLine | None:
    """The line through the best place and another one; None if their headings differ."""
    poses = np.array([(base.x, base.y, base.yaw) for base in bases])
    away_m, turned = poses[:, :2] - poses[0, :2], np.abs(wrap_angle(poses[:, 2] - poses[0, 2]))
    length_m = math.hypot(*away_m[other])
    if turned[other] >= HYPOTHESES.same_rad or not length_m:
        return None
    along = away_m[other] / length_m
    across_m = np.abs(away_m @ np.array((-along[1], along[0])))
    on_line = np.flatnonzero((turned < HYPOTHESES.same_rad) & (across_m < HYPOTHESES.same_m))
    at_m = away_m[on_line] @ along
    ends = on_line[[at_m.argmin(), at_m.argmax()]]
    (x, y), (to_x, to_y) = poses[ends, :2].tolist()
    mass = float(np.asarray(masses)[on_line].sum())
    return AmbiguousLine(begin_m=(x, y), end_m=(to_x, to_y), yaw_rad=bases[0].yaw, probability=mass)
