"""One message of a topic of scans to one `Scan` in the base frame.

A PointCloud2 becomes points and per-point times, in every layout that the message allows; points and times
are selected by the same rows, so they belong together. A LaserScan becomes points in its plane.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import LimitExceeded, PointCloudError, UnsupportedSchema
from pc2grid.geometry import F32, F64, I64, pose_from_xyz_quat
from pc2grid.io.messages.types import (
    NO_RETURN,
    CameraInfo,
    LaserScan,
    PointCloud2,
    Points,
    ScanMessage,
    valid_pose,
)
from pc2grid.io.sensors import depth
from pc2grid.io.sensors.depth import FloorDepth
from pc2grid.io.source import GAP_NS
from pc2grid.model import SENSOR_MODELS, Scan, SensorKind
from pc2grid.settings import ReadConfig

_LEVEL = math.cos(math.radians(60.0))  # more than that is no laser that was mounted a little askew
METRES_HINT = "ranges of a LaserScan are in metres: correct the driver, and record again"
_UNIT_HINTS: dict[SensorKind, str] = {
    "depth": "32FC1 is in metres, 16UC1 in millimetres (REP 118); --set read.depth_unit_m=0.001 says another",
    "laser": METRES_HINT,
    "lidar": "coordinates are in metres, in the sensor's frame: are these in a global frame such as UTM?",
}


class ScanDecoder:
    """Turns the messages of one sensor into scans; keeps the camera's calibration between them.

    notes : sentences for the user. empty : reason of the last scan without a return.
    """

    def __init__(
        self,
        topic: str,
        sensor: SensorKind,
        config: ReadConfig,
        *,
        camera_topic: str = "",
        camera: CameraInfo | None = None,
        depth_unit_m: float | None = None,
        fixed_frame: bool = False,
        longest_s: float = math.inf,
    ) -> None:
        """Make the decoder of one sensor.

        depth_unit_m : None: that of the encoding. fixed_frame : points are in a fixed frame, not in the
        sensor's. longest_s : time from one scan to the next, in which the beams of a laser must fit.
        """
        self.camera = camera
        self._longest_s = min(longest_s, LONGEST_SWEEP_S)
        self.notes: list[str] = []
        self.empty = ""
        self._floor = FloorDepth()
        self._camera_topic = camera_topic
        self._depth_unit_m = depth_unit_m
        self._fixed_frame = fixed_frame
        self._sensor = sensor
        self._config = config
        self._rectified = "rect" in topic

    def returns(self, message: ScanMessage) -> int:
        """Return the number of points of a message; 0 if it cannot be used."""
        try:
            return len(self._points(message, self.camera).xyz_m)
        except (PointCloudError, LimitExceeded, UnsupportedSchema):
            return 0

    def scan(
        self,
        message: ScanMessage,
        stamp_ns: int,
        T_base_sensor: F64,
        T_odom_base: F64 | None,
        camera: CameraInfo | None = None,
    ) -> Scan:
        """Decode the whole scan. camera : of an image. Raises PointCloudError, LimitExceeded or
        UnsupportedSchema."""
        found = self._points(message, camera)
        origin = getattr(message, "origin", None)
        if origin is not None:
            if not valid_pose(origin):
                raise PointCloudError("the origin of the points is not finite")
            T_base_sensor = T_base_sensor @ pose_from_xyz_quat(origin[:3], origin[3:])
        self._check_plane(message.header.frame, T_base_sensor)
        self._note(found)
        xyz, offsets = found.xyz_m, found.offsets_s
        near = self._near(xyz)
        if near is not None:
            xyz, offsets = xyz[near], None if offsets is None else offsets[near]
        points = _to_base(xyz, T_base_sensor)
        if SENSOR_MODELS[self._sensor].image:
            self.notes += self._floor.warnings(points, T_base_sensor, found.unit_m)
        return Scan(
            stamp_ns=stamp_ns,
            points_m=points,
            T_base_sensor=T_base_sensor,
            sensor=self._sensor,
            offsets_s=offsets,
            T_odom_base=T_odom_base,
            dropped=found.dropped + len(found.xyz_m) - len(points),
        )

    def _note(self, found: Points) -> None:
        notes = found.notes
        if not len(found.xyz_m):
            self.empty = found.empty
            notes = (*notes, f"some scans hold no returns at all: {found.empty}")
        self.notes += [note for note in notes if note not in self.notes]

    def _check_plane(self, frame: str, T_base_sensor: F64) -> None:
        """Raise PointCloudError for a laser whose plane cuts no floor plan."""
        if SENSOR_MODELS[self._sensor].planar and abs(T_base_sensor[2, 2]) < _LEVEL:
            raise PointCloudError(
                f"tf says that the plane of the laser stands upright: x-y of frame {frame or '(empty)'}",
                hint="the frame of a LaserScan is the one in whose x-y plane the beams are: no optical frame",
            )

    def _near(self, xyz: F32 | F64) -> I64 | None:
        """Return the indices of points (N, 3) within range; None if all are.

        Raises PointCloudError if none is, or if they cannot be metres.
        """
        limit, hint = self._config.max_range_m, _UNIT_HINTS[self._sensor]
        if not len(xyz) or max(float(xyz.max()), -float(xyz.min())) <= min(limit, FARTHEST_HALF_M) / 3**0.5:
            return None
        # Rare, so the exact distance is computed only here; in float64, as 1e30 squared overflows float32.
        ranges = np.sqrt(np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64))
        near = np.flatnonzero(ranges <= limit)
        if not len(near):
            raise PointCloudError(f"every point is farther than {limit:g} m from the sensor", hint=hint)
        if not self._fixed_frame:
            check_metres(ranges[near], hint)
        return None if len(near) == len(xyz) else near

    def _points(self, message: Any, camera: CameraInfo | None) -> Points:
        limit = self._config.max_points
        if self._sensor == "lidar":
            return decode_cloud(message, unit=self._config.point_time, max_points=limit)
        if self._sensor == "laser":
            return decode_laser(message, max_points=limit, longest_s=self._longest_s)
        if camera is None:
            raise PointCloudError("no CameraInfo was recorded for the depth image")
        return depth.decode(
            message,
            camera,
            rectified=self._rectified,
            stride=self._config.depth_stride,
            max_points=limit,
            unit_m=self._depth_unit_m,
            camera=self._camera_topic,
        )


def _to_base(xyz: F32 | F64, T_base_sensor: F64) -> F32:
    """Transform points (N, 3) of the sensor into the base frame."""
    # float32 is kept: half the memory, and a rounding of micrometres.
    kind: type = np.float32 if xyz.dtype == np.float32 else np.float64
    T: NDArray[Any] = T_base_sensor.astype(kind)
    return np.asarray((xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32, copy=False))


# --- PointCloud2 --------------------------------------------------------------------------------------

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
_NEAR_STAMP_S = GAP_NS * 1e-9  # times this near to zero are relative to the stamp, those near it absolute
# Half of the times of a scan lie together. Those farther away than so many times their span are no times of
# the scan. That needs many points, of which some are looked at. Chosen by hand.
_FARTHEST_SPANS, _LEAST_TIMES, _SAMPLED_TIMES = 20.0, 50, 1000


def check_metres(ranges: NDArray[np.floating], hint: str) -> None:
    """Raise PointCloudError for the ranges of a scan that cannot be metres: no building is so wide."""
    if len(ranges) and float(np.median(ranges)) > FARTHEST_HALF_M:
        raise PointCloudError(
            f"half of its returns are farther than {FARTHEST_HALF_M:g} m; metres are expected", hint=hint
        )


def decode_cloud(cloud: PointCloud2, *, unit: str = "auto", max_points: int = 20_000_000) -> Points:
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


# --- LaserScan ----------------------------------------------------------------------------------------

# Drivers round the angles: so many ranges more or less than the angles make are accepted. Chosen by hand.
_EXTRA_BEAMS, _EXTRA_SHARE = 2.0, 0.02
MOST_TURNS = 1.1  # that one scan covers, or lasts: stamps jitter


def decode_laser(
    scan: LaserScan, *, max_points: int = 20_000_000, longest_s: float = LONGEST_SWEEP_S
) -> Points:
    """Decode a LaserScan: beams with NaN, inf, or a range outside [range_min, range_max) are dropped.

    A limit that is not finite, and a range_max of 0, are taken as not set. Most drivers write a range of
    exactly range_max for a beam without a return. Beam i has the angle angle_min + i x angle_increment, also
    where that contradicts angle_max, as in ROS's laser_geometry. Offsets come from `time_increment` if it is
    set and the whole scan lasts `longest_s` at most.

    Raises PointCloudError for angles that no laser has.
    """
    count = len(scan.ranges)
    notes = _check_beams(scan, max_points)
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
    if math.isfinite(scan.time_increment) and scan.time_increment:
        if count * abs(scan.time_increment) <= longest_s:
            offsets = (np.flatnonzero(keep) * scan.time_increment).astype(np.float32)
        else:
            notes.append(f"time_increment makes a scan longer than {longest_s:.2g} s: it is ignored")
    outside = f"every range lies outside the limits, {start:g} to {end:g} m"
    return Points(points, offsets, count - len(kept), tuple(notes), outside if returned.any() else NO_RETURN)


def _largest(ranges: F32) -> float:
    """Return the largest of finite ranges if several have it to the last bit: drivers write one for no
    return."""
    largest = float(ranges.max(initial=0.0))
    return largest if np.count_nonzero(ranges == largest) > 1 else math.inf


def _check_beams(scan: LaserScan, most: int) -> list[str]:
    """Return sentences on angles that contradict the number of beams.

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
    if span > MOST_TURNS * 2 * math.pi:
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
    """Return the unit vectors (count, 2) of the beams."""
    angles = angle_min + np.arange(count) * angle_increment
    return np.column_stack((np.cos(angles), np.sin(angles))).astype(np.float32)
