"""Where a scan lies, as far as it tells by itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pc2grid.arrays import F64


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan placed on the local map; D directions of the pose are free, see `pc2grid.estimation.smoother`.

    pose : (4, 4) T_session_base, from which the smoother begins.
    alone : the pose by the points alone, with its information (D, D) in the axes of the base; None if the
        scan fits nowhere.
    overlap : share of the points that meet the map. residual_m : their mean distance from it. measured :
        whether they fix every direction of the position.
    first : there is no local map yet, nor any since tracking started again.
    motion : (4, 4) T_last_now by registration, with its standard deviations (D,), where that counts.
    """

    pose: F64
    alone: tuple[F64, F64] | None = None
    overlap: float = 0.0
    residual_m: float = math.inf
    measured: bool = False
    first: bool = False
    motion: tuple[F64, F64] | None = None
