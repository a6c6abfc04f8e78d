"""LaserScan to points in the plane of the laser."""

from __future__ import annotations

import functools
import math

import numpy as np

from pc2grid.arrays import F32
from pc2grid.errors import LimitExceeded, PointCloudError
from pc2grid.io.messages.types import MOST_BEAMS, LaserScan
from pc2grid.io.sensors.pointcloud2 import LONGEST_SWEEP_S, Points

# Drivers round the angles: so many ranges more or less than the angles make are accepted. Chosen by hand.
_EXTRA_BEAMS, _EXTRA_SHARE = 2.0, 0.02
_LEAST_INCREMENT_S = 1e-9  # a smaller time_increment is one that was not set


def decode(scan: LaserScan, *, max_points: int = 20_000_000) -> Points:
    """Returns of a scan: beams with NaN, inf, or a range outside [range_min, range_max) are dropped.

    Most drivers write a range of exactly range_max for a beam without a return.
    Offsets come from `time_increment` if it is set and the whole scan lasts `LONGEST_SWEEP_S` at most.

    Raises PointCloudError if the angles contradict the number of ranges.
    """
    count = len(scan.ranges)
    _check_beams(scan, min(max_points, MOST_BEAMS))
    ranges = scan.ranges.astype(np.float32)
    end = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0 else math.inf
    with np.errstate(invalid="ignore"):
        keep = (ranges > 0) & (ranges >= scan.range_min) & (ranges < np.float32(end))
    kept = ranges[keep]
    points = np.zeros((len(kept), 3), dtype=np.float32)
    points[:, :2] = kept[:, None] * _directions(count, scan.angle_min, scan.angle_increment)[keep]
    offsets, note = None, None
    if math.isfinite(scan.time_increment) and abs(scan.time_increment) > _LEAST_INCREMENT_S:
        if count * abs(scan.time_increment) <= LONGEST_SWEEP_S:
            offsets = (np.flatnonzero(keep) * scan.time_increment).astype(np.float32)
        else:
            note = f"time_increment makes a scan longer than {LONGEST_SWEEP_S:g} s: no deskewing"
    return Points(points, offsets, count - len(kept), note)


def _check_beams(scan: LaserScan, most: int) -> None:
    """Raises LimitExceeded for too many beams, PointCloudError if the angles contradict their number."""
    count = len(scan.ranges)
    if count > most:
        raise LimitExceeded(f"a scan of {count} beams; the limit is {most}")
    numbers = (scan.angle_min, scan.angle_max, scan.angle_increment)
    if not all(map(math.isfinite, numbers)):
        raise PointCloudError(f"angles that are not finite: {numbers}")
    if count > 1:
        if scan.angle_increment == 0:
            raise PointCloudError("field angle_increment: 0")
        declared = (scan.angle_max - scan.angle_min) / scan.angle_increment + 1
        if abs(declared - count) > max(_EXTRA_BEAMS, _EXTRA_SHARE * count):
            raise PointCloudError(f"{count} ranges where the angles make {declared:.0f}")


@functools.lru_cache(maxsize=4)
def _directions(count: int, angle_min: float, angle_increment: float) -> F32:
    """(count, 2) unit vectors of the beams."""
    angles = angle_min + np.arange(count) * angle_increment
    return np.column_stack((np.cos(angles), np.sin(angles))).astype(np.float32)
