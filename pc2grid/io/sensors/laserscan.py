"""LaserScan to points in the plane of the laser."""

from __future__ import annotations

import functools
import math

import numpy as np

from pc2grid.arrays import F32
from pc2grid.errors import LimitExceeded, PointCloudError
from pc2grid.io.messages.types import MOST_BEAMS, LaserScan
from pc2grid.io.sensors.pointcloud2 import LONGEST_SWEEP_S, NO_RETURN, Points, check_metres

# Drivers round the angles: so many ranges more or less than the angles make are accepted. Chosen by hand.
_EXTRA_BEAMS, _EXTRA_SHARE = 2.0, 0.02
_MOST_TURNS = 1.1  # that one scan covers
METRES_HINT = "ranges of a LaserScan are in metres: correct the driver, and record again"
_LEAST_INCREMENT_S = 1e-9  # a smaller time_increment is one that was not set


def decode(scan: LaserScan, *, max_points: int = 20_000_000, longest_s: float = LONGEST_SWEEP_S) -> Points:
    """Returns of a scan: beams with NaN, inf, or a range outside [range_min, range_max) are dropped.

    A limit that is not finite, and a range_max of 0, is one that was not set. Most drivers write a range of
    exactly range_max for a beam without a return. Beam i has the angle angle_min + i x angle_increment, also
    where that contradicts angle_max, as in ROS's laser_geometry.
    Offsets come from `time_increment` if it is set and the whole scan lasts `longest_s` at most.

    Raises PointCloudError for angles that no laser has.
    """
    count = len(scan.ranges)
    notes = _check_beams(scan, min(max_points, MOST_BEAMS))
    ranges = scan.ranges.astype(np.float32)
    returned = np.isfinite(ranges) & (ranges > 0)
    largest = _largest(ranges[returned])
    start = scan.range_min if math.isfinite(scan.range_min) else 0.0
    end = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0 else largest
    keep = returned & (ranges >= start) & (ranges < np.float32(end))
    kept = ranges[keep]
    if len(kept):
        check_metres(ranges[returned & (ranges < largest)], METRES_HINT)
    points = np.zeros((len(kept), 3), dtype=np.float32)
    points[:, :2] = kept[:, None] * _directions(count, scan.angle_min, scan.angle_increment)[keep]
    offsets = None
    if math.isfinite(scan.time_increment) and abs(scan.time_increment) > _LEAST_INCREMENT_S:
        if count * abs(scan.time_increment) <= longest_s:
            offsets = (np.flatnonzero(keep) * scan.time_increment).astype(np.float32)
        else:
            notes.append(f"time_increment makes a scan longer than {longest_s:.2g} s: it is ignored")
    outside = f"every range lies outside the limits, {start:g} to {end:g} m"
    return Points(points, offsets, count - len(kept), tuple(notes), outside if returned.any() else NO_RETURN)


def _largest(ranges: F32) -> float:
    """The largest of finite ranges if several have it to the last bit: drivers write one for no return."""
    largest = float(ranges.max(initial=0.0))
    return largest if np.count_nonzero(ranges == largest) > 1 else math.inf


def _check_beams(scan: LaserScan, most: int) -> list[str]:
    """Sentences on angles that contradict the number of beams.

    Raises LimitExceeded for too many beams, PointCloudError for angles that no laser has.
    """
    count, step = len(scan.ranges), scan.angle_increment
    if count > most:
        raise LimitExceeded(f"a scan of {count} beams; the limit is {most}")
    if not (math.isfinite(scan.angle_min) and math.isfinite(step)):
        raise PointCloudError(f"angles that are not finite: {(scan.angle_min, scan.angle_max, step)}")
    if count < 2:
        return []
    if step == 0:
        raise PointCloudError("field angle_increment: 0")
    span = (count - 1) * abs(step)
    if span > _MOST_TURNS * 2 * math.pi:
        raise PointCloudError(
            f"{count} beams {step:g} rad apart span {span:.4g} rad, more than a turn",
            hint="angles of a LaserScan are in radians: correct the driver, and record again",
        )
    declared = (scan.angle_max - scan.angle_min) / step + 1
    if abs(declared - count) <= max(_EXTRA_BEAMS, _EXTRA_SHARE * count):
        return []
    return [
        "some scans have another number of ranges than their angles make: angle_max is ignored, beam i is "
        "taken at angle_min + i x angle_increment"
    ]


@functools.lru_cache(maxsize=4)
def _directions(count: int, angle_min: float, angle_increment: float) -> F32:
    """(count, 2) unit vectors of the beams."""
    angles = angle_min + np.arange(count) * angle_increment
    return np.column_stack((np.cos(angles), np.sin(angles))).astype(np.float32)
