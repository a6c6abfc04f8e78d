"""Where a scan lies, as far as it tells by itself, and what places it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pc2grid.arrays import F32, F64
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.belief import Belief
from pc2grid.geometry import SE2
from pc2grid.model import Scan


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan placed on the local map; D directions of the pose are free, see `pc2grid.estimation.smoother`.

    pose : (4, 4) T_session_base, from which the smoother begins.
    alone : the pose by the points alone, with its information (D, D) in the axes of the base; None if the
        scan fits nowhere.
    overlap : share of the points that meet the map. residual_m : their mean distance from it. measured :
        whether they fix every direction of the position.
    first : there is no local map yet, nor any since tracking started again.
    motion : (4, 4) T_last_now by registration, with its information (D, D), where that counts. followed : the
        scan fits the one before, if not the map: what it shows is new.
    """

    pose: F64
    alone: tuple[F64, F64] | None = None
    overlap: float = 0.0
    residual_m: float = math.inf
    measured: bool = False
    first: bool = False
    motion: tuple[F64, F64] | None = None
    followed: bool = False


class PlacingSensor(Protocol):
    """Places the scans of a session, one after another, on a local map of its last metres.

    free : directions of the pose that can change, `PLANAR` or `SPATIAL` of `pc2grid.estimation.belief`.
    points_m : (N, 3) deskewed points of a scan in the base frame.
    """

    free: tuple[int, ...]

    @property
    def ground(self) -> Ground | None:
        """The floor in the base frame; None where that changes or is not seen."""

    def start(self, scan: Scan, points_m: F32, at: SE2) -> F64:
        """Begin with a scan whose base is at a place of the session frame; returns its pose (4, 4),
        levelled."""

    def place(self, scan: Scan, points_m: F32, seconds: float, expected: Sequence[Belief]) -> Placed:
        """Place a scan, `seconds` after the one before.

        expected : where the base may be, the most credible first. A scan that fits nowhere, or shows nothing,
        is placed there.
        """

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in the free directions, with the tilt and the height that are known besides."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """The planar scan, in the levelled base frame, of the scan placed last at its final pose (4, 4)."""

    def extend(self, pose: F64) -> None:
        """The scan placed last is a keyframe, at its final pose (4, 4)."""

    def restart(self) -> None:
        """Forget the local map: the next scan that is not lost begins a new one."""
