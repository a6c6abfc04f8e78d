"""PointCloud2 to points and per-point times, in every layout that the message allows.

Points and times are selected by the same rows, so they belong together.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import LimitExceeded, PointCloudError
from pc2grid.geometry import F32, F64
from pc2grid.io.messages.types import PointCloud2
from pc2grid.io.source import GAP_NS

# sensor_msgs/PointField; 9 to 11 are PCL's, absent from the definition (ros2/common_interfaces#300).
_DATATYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    8: "f8",
    9: "i8",
    10: "u8",
    11: "u1",
}
_TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "offset_time", "time_offset", "time_stamp", "ts")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# One turn of a lidar takes between 2 ms and 2 s, a factor of 1000. So the span of the times is a possible
# turn in one unit only.
LONGEST_SWEEP_S = 2.0
_SWEEP_S = (2e-3, LONGEST_SWEEP_S)
FARTHEST_HALF_M = 100.0  # half of the returns of a scan in a building are nearer; chosen by hand
NO_RETURN = "nothing came back (0, NaN or inf)"
_NEAR_STAMP_S = GAP_NS * 1e-9  # times this near to zero are relative to the stamp, those near it absolute
# Half of the times of a scan lie together. Those farther away than so many times their span are no times of
# the scan. That needs many points, of which some are looked at. Chosen by hand.
_FARTHEST_SPANS, _LEAST_TIMES, _SAMPLED_TIMES = 20.0, 50, 1000


@dataclass(frozen=True, slots=True)
class Points:
    """Returns of one scan in the sensor's frame.

    xyz_m : (N, 3) finite. offsets_s : (N,) relative to the stamp, or None. dropped : returns left out.
    notes : sentences for the user on how the message was interpreted. empty : why there is no point at all,
    if there is none. unit_m : of the numbers in the message.
    """

    xyz_m: F32 | F64
    offsets_s: F32 | None
    dropped: int
    notes: tuple[str, ...] = ()
    empty: str = NO_RETURN
    unit_m: float = 1.0


def check_metres(ranges: NDArray[np.floating], hint: str) -> None:
    """Raise PointCloudError for the ranges of a scan that cannot be metres: no building is so wide."""
    if len(ranges) and float(np.median(ranges)) > FARTHEST_HALF_M:
        raise PointCloudError(
            f"half of its returns are farther than {FARTHEST_HALF_M:g} m; metres are expected", hint=hint
        )


def decode(cloud: PointCloud2, *, unit: str = "auto", max_points: int = 20_000_000) -> Points:
    """Decode the points of a cloud: finite, and not exactly at the origin, where drivers put beams without a
    return.

    unit : of the time field: `s`, `ms`, `us`, `ns`, `auto` (from the span), `none` (times are ignored).

    Raises PointCloudError if the message contradicts itself, LimitExceeded above `max_points`.
    """
    rows = _rows(cloud, max_points)
    xyz, index = _returns(rows)
    name = _time_field(cloud) if unit != "none" else None
    offsets: F32 | None = None
    note: str | None = None
    if name is not None:
        values = rows[name].reshape(-1)[index]
        timed = _timed(values)
        seconds, note = _offsets(values[timed], cloud.header.stamp_ns, unit, name)
        if seconds is not None:
            offsets = seconds.astype(np.float32, copy=False)
            if len(offsets) < len(xyz):
                xyz = xyz[timed]
                note = note or f"points whose times in field {name} are not of their scan are left out"
    return Points(xyz, offsets, rows.size - len(xyz), () if note is None else (note,))


def _returns(rows: NDArray[Any]) -> tuple[F32 | F64, NDArray[np.integer]]:
    """Return usable returns (N, 3), and their rows (N,); float32 if the message's numbers fit in it."""
    exact = all(np.can_cast(rows.dtype[name], np.float32) for name in ("x", "y", "z"))
    # One row for each coordinate: numpy works along rows of thousands, not along points of three numbers.
    xyz = np.empty((3, rows.size), dtype=np.float32 if exact else np.float64)
    for axis, name in enumerate(("x", "y", "z")):
        xyz[axis] = rows[name].reshape(-1)
    x, y, z = xyz
    usable: NDArray[np.bool_] = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    usable &= (x != 0) | (y != 0) | (z != 0)
    index = np.flatnonzero(usable)
    return xyz.take(index, axis=1).T, index


def _rows(cloud: PointCloud2, max_points: int) -> NDArray[Any]:
    """Return the message's data as a structured (H, W) view of the fields that are used; nothing is
    copied."""
    height, width, step = cloud.height, cloud.width, cloud.point_step
    if height * width > max_points:
        raise LimitExceeded(
            f"a scan of {height * width} points; the limit is {max_points}",
            hint="--set read.max_points=N raises it",
        )
    dtype = _layout(cloud.fields, step, cloud.is_bigendian)
    if height * width == 0:
        return np.empty((0, 0), dtype=dtype)
    row_step = cloud.row_step if height > 1 and cloud.row_step else width * step
    if row_step < width * step:
        raise PointCloudError(f"rows of {row_step} bytes cannot hold {width} points of {step} bytes")
    needed = (height - 1) * row_step + width * step
    if len(cloud.data) < needed:
        raise PointCloudError(f"{len(cloud.data)} bytes of data where {needed} are declared")
    return np.ndarray((height, width), dtype=dtype, buffer=cloud.data, strides=(row_step, step))


@functools.lru_cache(maxsize=16)
def _layout(fields: tuple[tuple[str, int, int, int], ...], step: int, big: bool) -> np.dtype[Any]:
    """Return the fields that are used as a type of `step` bytes; the same for all clouds of a topic."""
    if step >= 1 << 31:
        raise PointCloudError(f"points of {step} bytes")
    names, formats, offsets = [], [], []
    seen: set[str] = set()
    for name, offset, datatype, count in fields:
        if name not in ("x", "y", "z") and name.lower() not in _TIME_FIELDS:
            continue
        if name in seen:
            raise PointCloudError(f"field {name}: defined twice")
        seen.add(name)
        if datatype not in _DATATYPES:
            raise PointCloudError(f"field {name}: unknown datatype {datatype}")
        kind = np.dtype(("<", ">")[big] + _DATATYPES[datatype])
        if count > 1:
            raise PointCloudError(f"field {name}: {count} values per point instead of one")
        if offset + kind.itemsize > step:
            raise PointCloudError(
                f"field {name}: ends at byte {offset + kind.itemsize} of a {step}-byte point"
            )
        names.append(name)
        formats.append(kind)
        offsets.append(offset)
    for name in ("x", "y", "z"):
        if name not in seen:
            raise PointCloudError(f"field {name}: missing")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def _time_field(cloud: PointCloud2) -> str | None:
    names = {name.lower(): name for name, *_ in cloud.fields}
    return next((names[n] for n in _TIME_FIELDS if n in names), None)


def _timed(values: NDArray[Any]) -> NDArray[np.bool_] | slice:
    """Return a mask of the times (N,) that are finite, and near those of the other points.

    Drivers leave the time of some points at zero: these must not decide on the unit of the others.
    """
    low, high = -math.inf, math.inf
    sample = values[:: max(len(values) // _SAMPLED_TIMES, 1)].astype(np.float64)
    sample = np.sort(sample[np.isfinite(sample)])
    if len(sample) >= _LEAST_TIMES:
        half = len(sample) // 2
        with np.errstate(over="ignore"):
            spans = sample[half:] - sample[:-half]
        first = int(spans.argmin())
        reach = _FARTHEST_SPANS * float(spans[first])
        if reach > 0.0:
            low, high = float(sample[first]) - reach, float(sample[first + half]) + reach
    least, most = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    if low <= least and most <= high and math.isfinite(most - least):
        return slice(None)
    return np.asarray(np.isfinite(values) & (values >= low) & (values <= high))


def _scale(span: float, unit: str, name: str) -> float:
    """Return the seconds of a unit. Raises PointCloudError if none fits, or the times span longer than any
    scan."""
    if unit == "auto":
        fitting = [u for u, s in _SECONDS.items() if _SWEEP_S[0] <= span * s <= _SWEEP_S[1]]
        if not fitting:
            raise PointCloudError(
                f"field {name}: times that span {span} fit no unit",
                hint="--set read.point_time=s|ms|us|ns|none says which",
            )
        unit = fitting[0]
    scale = _SECONDS[unit]
    if span * scale > LONGEST_SWEEP_S:
        raise PointCloudError(
            f"field {name}: times that span {span * scale:g} s, read as {unit}",
            hint="--set read.point_time=s|ms|us|ns says otherwise, none ignores them",
        )
    return scale


def _offsets(
    values: NDArray[Any], stamp_ns: int, unit: str, name: str
) -> tuple[NDArray[Any] | None, str | None]:
    """Return seconds relative to the stamp from finite times, or None if all times are the same; and a note.

    Raises PointCloudError if no unit fits, or the times span longer than any scan.
    """
    whole = values.dtype.kind in "iu"
    if not len(values):
        return None, None
    first, last = values.min(), values.max()
    span = int(last) - int(first) if whole else float(last) - float(first)
    if span == 0:
        return None, f"the per-point times in field {name} are all the same: no deskewing"
    scale = _scale(span, unit, name)
    stamp = stamp_ns * 1e-9
    if max(abs(float(first) * scale), abs(float(last) * scale)) <= _NEAR_STAMP_S:
        return values if scale == 1.0 else values.astype(np.float64) * scale, None
    note = None
    if abs(float(first) * scale - stamp) <= _NEAR_STAMP_S:
        if whole and scale == 1e-9:
            relative = (values.astype(np.int64) - stamp_ns).astype(np.float64)  # in integers: exact
        else:
            relative = values.astype(np.float64) - stamp / scale
    else:
        note = f"the times in field {name} are of another clock: the first point is taken to be at the stamp"
        relative = (values - first).astype(np.float64)
    return relative * scale, note
