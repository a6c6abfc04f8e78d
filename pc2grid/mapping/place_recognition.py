"""What loop closure needs from place recognition, which is implemented in a package above this one.

Tracking drifts, so after a long way a loop can be farther off than loop closure searches (some metres, some
degrees). A recognizer compares the map of the last metres with those of all earlier stretches of the same
session, without using their poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pc2grid.arrays import F64, I64, freeze
from pc2grid.geometry import SE2
from pc2grid.model import OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """The map of a few metres of travel, long enough to be recognised.

    index : number of the stretch among those of its session that the recognizer is given, from 0, in the
        order of travel. The last one of a session may be shorter, and overlap the one before.
    grid : its occupancy grid, in its own frame: the base at one of its keyframes, in the middle.
    poses : (K, 3) x, y, yaw of its keyframes in the same frame, metres and radians.
    scans : (K,) number of each keyframe's scan within the session.
    """

    index: int
    grid: OccupancyGrid
    poses: F64
    scans: I64

    def __post_init__(self) -> None:
        freeze(self, "poses", float, (None, 3))
        freeze(self, "scans", np.int64, (None,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Recognition:
    """Two stretches that show the same place, and how they lie to each other.

    older, newer : their indices.
    T_older_newer : the frame of the newer stretch in the frame of the older one. Exact to some decimetres;
        loop closure refines it on the local maps.
    probability : 0..1, calibrated, that both show the same place, by what they look like.

    Of the recognitions of one newer stretch, which show it at several places, at most one is right, or those
    at one place that several older stretches saw.
    """

    older: int
    newer: int
    T_older_newer: SE2
    probability: float


class PlaceRecognizer(Protocol):
    """Proposes and verifies earlier stretches of a session that show the same place as the newest one."""

    def recognize(self, newest: Stretch) -> Sequence[Recognition]:
        """The earlier stretches that the newest one overlaps, each with its verified relative pose.

        Called once for every stretch that does not overlap known ones throughout, in the order of their
        indices, from 0. A recognizer therefore keeps what it needs of those that it was given: signatures to
        propose with, grids to verify with.

        It must not return `older >= newest.index`. All places that look like the newest stretch may be
        returned, right or wrong: loop closure accepts those that agree with the drift of tracking and with
        each other (`pc2grid.mapping.loop_candidates`).
        """
        ...
