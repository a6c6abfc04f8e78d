"""A scan reduced to the plane, in one form for every sensor: obstacle points, their normals, and free ranges.

A beam of a laser, a ring of a lidar and a pixel of a camera give the same two facts about a floor plan: the
position of an obstacle, and the free range before it. Three details are kept with them:

- Normals. A thin wall has two faces, a door post three, a few centimetres apart. Scan matching that takes
  them for one surface has an error of half that distance at every door. The normals are estimated from the
  hits and not from the cloud, whose normals change more from scan to scan where no surface is clear
  (`docs/method.md`).
- Heights. A laser at 0.3 m sees the legs of a table, a camera at 1 m its top, a lidar both and the wall
  behind it. To make them comparable, an obstacle keeps the slices of heights (`SLICES`) in which the scan has
  a return from it, and those in which a ray passed it. Free ground keeps the slices that rays passed, too: a
  camera that looks level does not observe whether a box stands before it.
- The far limit of a depth camera (`DepthLimit`). The noise of a depth grows with its square, and the camera
  reports nothing beyond its farthest depth. Of a wall at this depth only the pixels whose noise makes them
  nearer are reported: their mean is several centimetres too short, and stays so while the camera approaches,
  so matching would underestimate the motion (`docs/method.md`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pc2grid.clouds.ground import CLOUD_PARAMETERS, CloudParameters, Ground
from pc2grid.geometry import F32, F64, U8, BoolGrid
from pc2grid.libraries import compiled
from pc2grid.model import SENSOR_MODELS, SLICE_BORDERS_M, SLICES, SensorKind
from pc2grid.settings import ProjectionConfig

BEARINGS = 1440
"""Bearings of a planar scan: a quarter of a degree is one grid cell of 5 cm at a range of 12 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanarScan:
    """What one scan shows of the plane.

    All coordinates are in the levelled base frame: the base's origin and heading, z up.

    stamp_ns : stamp of the scan.
    hits_m : (M, 2) float32, obstacle points within the height band, about one per grid cell.
    normal_rad : (M,) float32, direction of the surface normal at each hit, on the side of the sensor.
    origin_m : (2,) float64, position of the sensor.
    free_m : (B,) float32, how far from `origin_m` the plane is known to be free, for B equal bearings
        around it (entry 0 looks along +x, counter-clockwise); 0 where nothing is known.
    low_m : (L, 2) float32, things on the floor that are no walls (tables, chairs), about one point per grid
        cell: the sensor looks over them, so they do not end what is free. Empty where heights are not known.
    height_m : of the plane of a planar laser, above the base; None of sensors that measure at all heights.
    above_floor_m : height of the base above the floor, if a sensor in the hand measures it; else None.
    heights : (M + L,) uint8, of the hits and then of the things, in which slices they were observed to be
        occupied and to be free (`pc2grid.model.SLICES`), 0 where that is not known; or empty.
    passed_m : (SLICES, 2, B) float32, ranges from `origin_m` between which rays pass each slice, for the
        bearings of `free_m`; or empty. What is behind `free_m` does not count.
    """

    stamp_ns: int
    hits_m: F32
    normal_rad: F32
    origin_m: F64
    free_m: F32
    low_m: F32 = field(default_factory=lambda: np.empty((0, 2), np.float32))
    height_m: float | None = None
    above_floor_m: float | None = None
    heights: U8 = field(default_factory=lambda: np.empty(0, np.uint8))
    passed_m: F32 = field(default_factory=lambda: np.empty((0, 2, 0), np.float32))

    @staticmethod
    def of_hits(*, stamp_ns: int, hits_m: F32, origin_m: F64, free_m: F32) -> PlanarScan:
        """Return a planar scan whose normals are estimated from its hits."""
        return PlanarScan(
            stamp_ns=stamp_ns,
            hits_m=hits_m,
            normal_rad=planar_normals(hits_m, origin_m),
            origin_m=origin_m,
            free_m=free_m,
        )

    def only(self, kept: BoolGrid) -> PlanarScan:
        """Return the scan with the hits (M,) that are `kept`."""
        things = np.ones(len(self.low_m), np.bool_)
        return replace(
            self,
            hits_m=self.hits_m[kept],
            normal_rad=self.normal_rad[kept],
            heights=self.heights[np.concatenate((kept, things))] if len(self.heights) else self.heights,
        )

    def free_polygon(self, limit_m: float = np.inf) -> F64:
        """Return the outline (B, 2) of the free space up to `limit_m`, metres, levelled base frame."""
        return self.outline(np.minimum(self.free_m, limit_m))

    def outline(self, ranges_m: F32) -> F64:
        """Return the points (B, 2) at ranges (B,) from the sensor, metres, levelled base frame."""
        outline: F64 = self.origin_m + ranges_m[:, None] * _directions(len(ranges_m))
        return outline


@lru_cache(maxsize=4)
def _directions(count: int) -> F64:
    """Return `count` equally spaced unit vectors (count, 2), the first along +x."""
    bearings = np.arange(count) * (2.0 * np.pi / count)
    directions: F64 = np.column_stack((np.cos(bearings), np.sin(bearings)))
    directions.flags.writeable = False
    return directions


def project_to_plane(
    points_m: NDArray[np.floating],
    *,
    stamp_ns: int,
    sensor_m: F64,
    ground: Ground | None,
    config: ProjectionConfig,
    sensor: SensorKind = "lidar",
    parameters: CloudParameters = CLOUD_PARAMETERS,
) -> PlanarScan:
    """Reduce the points of a scan to the plane.

    points_m : (N, 3) in the levelled base frame. sensor_m : (3,) position of the sensor in that frame.
    ground : the floor in that frame, or None for a planar laser, whose every return is an obstacle.

    A bearing is free up to its nearest obstacle. Without an obstacle it is free up to the farthest return
    on the floor or, for a ray that rises to a ceiling or an overhang, up to where the ray leaves the
    height band. Obstacle points of one bearing that are no farther apart than the noise of the `sensor`
    become one hit at their mean, which is more accurate than each of them.
    """

    model = SENSOR_MODELS[sensor]
    origin = np.asarray(sensor_m, dtype=np.float64)
    points = np.asarray(points_m, dtype=np.float32)
    if ground is None:
        plane, band_m = np.zeros(4), (-np.inf, np.inf)
        cell_m = 0.5 * config.resolution_m  # a planar laser has few beams: nearly all of them are kept
    else:
        plane, band_m = np.array([*ground.normal, ground.offset_m]), (config.band_min_m, config.band_max_m)
        cell_m = config.resolution_m
    # Two standard deviations of the noise on either side of the mean.
    depths = (cell_m, 4.0 * model.noise_per_m2)
    edges_m = np.array([band_m[0], *SLICE_BORDERS_M, band_m[1]])
    nearest, reach, surfaces, passed_m = scan_bearings(
        points, origin, plane, edges_m, config.max_range_m, depths, BEARINGS
    )
    free = fill_gaps(np.where(np.isfinite(nearest), nearest, reach), parameters.max_gap_bins)
    hits, returns = mean_per_cell(surfaces, cell_m)
    return PlanarScan(
        stamp_ns=stamp_ns,
        hits_m=hits,
        normal_rad=planar_normals(hits, origin[:2], parameters),
        origin_m=origin[:2].copy(),
        free_m=np.minimum(free, config.max_range_m).astype(np.float32),
        height_m=float(origin[2]) if ground is None else None,
        heights=_heights(hits - origin[:2], returns, passed_m, depths)[: None if ground else 0],
        passed_m=passed_m[: None if ground else 0],
    )


def mean_per_cell(sums: F64, cell_m: float) -> tuple[F32, F64]:
    """Return one point (M, 2) for each cell: the mean of all that falls into it, by first occurrence; and the
    sums (M, K) of the other columns.

    sums : (N, 3 + K), sums of x and of y, the number of points in them, and more; their mean decides on the
    cell.
    """
    column, row = np.floor(sums[:, :2] / sums[:, 2:3] / cell_m).astype(np.int64).T
    _, first, cell = np.unique((column << 32) + row, return_index=True, return_inverse=True)
    total = np.column_stack([np.bincount(cell, weights) for weights in sums.T])[np.argsort(first)]
    return np.asarray(total[:, :2] / total[:, 2:3], np.float32), np.asarray(total[:, 3:], np.float64)


def _heights(away_m: F64, returns: F64, passed_m: F32, depths: tuple[float, float]) -> U8:
    """Return the observed heights (M,) of hits (M, 2) seen from the sensor, see `pc2grid.model.SLICES`.

    returns : (M, SLICES) of each. passed_m : see `PlanarScan`. depths : (d, q), a ray that goes on for
    d + q * r**2 behind a hit at the range r has passed it.
    """
    ranges_m = np.hypot(away_m[:, 0], away_m[:, 1])
    bearing = np.rint(np.arctan2(away_m[:, 1], away_m[:, 0]) * (BEARINGS / (2.0 * np.pi))).astype(int)
    # A mean of returns of several beams may lie between two of them.
    near_m, far_m = passed_m[:, :, (bearing + np.array([[-1], [0], [1]])) % BEARINGS].swapaxes(0, 1)
    behind_m = ranges_m + depths[0] + depths[1] * ranges_m**2
    filled = returns.T > 0.0
    empty = ((near_m <= ranges_m) & (far_m > behind_m)).any(axis=1) & ~filled
    return np.asarray(np.packbits(np.concatenate((filled, empty)), axis=0, bitorder="little")[0])


def fill_gaps(free_m: F64, max_gap_bins: int) -> F64:
    """Return free ranges (B,) in which narrow gaps, zeros between two ranges, take the shorter of the two."""
    filled = free_m.copy()
    right = np.flatnonzero(free_m > 0.0)
    left = np.roll(right, 1)
    gap = (right - left - 1) % len(free_m)
    shorter = np.minimum(free_m[left], free_m[right])
    for step in range(1, max_gap_bins + 1):
        inside = (gap >= step) & (gap <= max_gap_bins)
        filled[(left[inside] + step) % len(free_m)] = shorter[inside]
    return filled


def planar_normals(hits_m: F32, origin_m: F64, parameters: CloudParameters = CLOUD_PARAMETERS) -> F32:
    """Return the direction (M,) in radians of the surface normal at hits (M, 2), on the sensor's side.

    origin_m : (2,) position of the sensor. The normal is the minor axis of the hits within a distance of
    `reach_m` + `reach_per_m` * range. Where these are fewer than three, the distance is `sparse_factor`
    times as large. Hits that do not lie along a line get the direction to the sensor.
    """

    p = parameters
    away = hits_m.astype(np.float64) - origin_m
    bearings = np.arctan2(away[:, 1], away[:, 0])
    order = np.argsort(bearings, kind="stable")
    return _compiled_normals(away, order, bearings, p.reach_m, p.reach_per_m, p.sparse_factor, p.max_flatness)


class DepthLimit:
    """Learns the farthest depth that a camera reports, and removes the hits near it, which are biased.

    If nothing cuts depths off, the farthest pixel of a wall lies more than three standard deviations behind
    the mean of its thousands of pixels. So a hit, which is a mean, is not removed.
    """

    def __init__(self, parameters: CloudParameters = CLOUD_PARAMETERS) -> None:
        self._parameters = parameters
        self._farthest_m = 0.0

    @property
    def unbiased_m(self) -> float:
        """Return the depth up to which the limit cuts off less than one pixel in forty."""
        noise_per_m2 = SENSOR_MODELS["depth"].noise_per_m2
        return self._farthest_m - self._parameters.limit_sigmas * noise_per_m2 * self._farthest_m**2

    def observe(self, points_m: NDArray[np.floating], T_base_sensor: F64) -> None:
        """Update the limit with the points (N, 3) of a scan, base frame, of a camera at `T_base_sensor` (4,
        4).
        """
        if len(points_m):
            axis = T_base_sensor[:3, 2]
            farthest_m = float((points_m @ axis.astype(points_m.dtype)).max() - T_base_sensor[:3, 3] @ axis)
            self._farthest_m = max(self._farthest_m, farthest_m)

    def before(self, planar_scan: PlanarScan, T_level_sensor: F64) -> PlanarScan:
        """Return the planar scan without its hits at depths beyond `unbiased_m`.

        T_level_sensor : (4, 4) pose of the camera in the levelled base frame, optical axes (z forward). The
        depth of a hit is that at the height of the camera.
        """
        depth_m = (planar_scan.hits_m - planar_scan.origin_m) @ T_level_sensor[:2, 2]
        return planar_scan.only(depth_m <= self.unbiased_m)


# --- compiled functions -------------------------------------------------------------------------------


@compiled()
def scan_bearings(
    points: F32,
    sensor: F64,
    plane: F64,
    edges: F64,
    limit: float,
    depths: tuple[float, float],
    bearings: int,
) -> tuple[F64, F64, F64, F32]:
    """Sort points (N, 3) by bearing.

    sensor : (3,). plane : (4,) with height = plane[:3] . p + plane[3]. edges : (SLICES + 1,) of the slices,
    from the lowest to the highest height of an obstacle. limit : farthest range of an obstacle point.
    depths : (d, q), obstacle points of one bearing belong to one surface up to a range difference of d + q *
    range**2.

    Returns for each bearing the range of the nearest obstacle (inf: none) and the range up to which floor and
    ceiling show it to be free (0: none); for each surface (S, 3 + SLICES) the sums of x and y of its points,
    their number, and that in each slice, by increasing bearing and range; and the ranges (SLICES, 2,
    bearings) between which rays pass each slice, both 0 where none does.

    Measured: 0.6 ms instead of 23 ms a scan of a lidar, 0.015 instead of 0.7 ms of a planar laser.
    """
    nearest, reach = np.empty(bearings), np.empty(bearings)
    for b in range(bearings):
        nearest[b], reach[b] = math.inf, 0.0
    passed = np.zeros((SLICES, 2, bearings), np.float32)
    passed[:, 0] = math.inf
    count = points.shape[0]
    bearing_of, slice_of, ranges = np.empty(count, np.int32), np.zeros(count, np.int32), np.empty(count)
    sensor_height = plane[0] * sensor[0] + plane[1] * sensor[1] + plane[2] * sensor[2] + plane[3]
    for k in range(count):
        px, py = float(points[k, 0]), float(points[k, 1])
        x, y = px - sensor[0], py - sensor[1]
        ranges[k] = distance = math.hypot(x, y)
        bearing = round(math.atan2(y, x) * (bearings / (2.0 * math.pi))) % bearings
        height = plane[0] * px + plane[1] * py + plane[2] * points[k, 2] + plane[3]
        bearing_of[k] = -1
        rise = height - sensor_height or 1e-9
        for n in range(SLICES):
            slice_of[k] += n > 0 and height >= edges[n]
            enters, leaves = (edges[n] - sensor_height) / rise, (edges[n + 1] - sensor_height) / rise
            first, last = max(min(enters, leaves), 0.0), min(max(enters, leaves), 1.0)
            if first < last:
                passed[n, 0, bearing] = min(passed[n, 0, bearing], first * distance)
                passed[n, 1, bearing] = max(passed[n, 1, bearing], last * distance)
        if height < edges[0]:
            reach[bearing] = max(reach[bearing], distance)
        elif height > edges[-1]:
            if sensor_height < edges[-1]:
                part = (edges[-1] - sensor_height) / rise
                reach[bearing] = max(reach[bearing], distance * part)
        else:
            nearest[bearing] = min(nearest[bearing], distance)
            if distance <= limit:
                bearing_of[k] = bearing
    order, starts = _by_bearing(bearing_of, ranges, bearings)
    passed[:, 0] = np.minimum(passed[:, 0], passed[:, 1])
    return nearest, reach, _surfaces(points, ranges, slice_of, order, starts, depths), passed


@compiled()
def _by_bearing(
    bearing_of: NDArray[np.int32], ranges: F64, bearings: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort the points with a bearing (not -1) by bearing and range; returns their order and the start of each
    bearing.
    """
    starts = np.zeros(bearings + 1, dtype=np.int64)
    for bearing in bearing_of:
        if bearing >= 0:
            starts[bearing + 1] += 1
    filled = np.empty(bearings + 1, dtype=np.int64)
    filled[0] = 0
    for b in range(bearings):
        starts[b + 1] += starts[b]
        filled[b + 1] = starts[b + 1]
    order = np.empty(starts[bearings], dtype=np.int64)
    for k in range(len(bearing_of)):
        bearing = bearing_of[k]
        if bearing >= 0:
            place = filled[bearing]  # insertion sort by range: one bearing has a few dozen points
            while place > starts[bearing] and ranges[order[place - 1]] > ranges[k]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = k
            filled[bearing] += 1
    return order, starts


@compiled()
def _surfaces(
    points: F32,
    ranges: F64,
    slice_of: NDArray[np.int32],
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    depths: tuple[float, float],
) -> F64:
    """Return for each surface (S, 3 + SLICES) the sums of x and y of its points, their number, and that in
    each slice.
    """
    surfaces = np.zeros((len(order), 3 + SLICES))
    found = 0
    for bearing in range(len(starts) - 1):
        first = 0.0
        for place in range(starts[bearing], starts[bearing + 1]):
            k = order[place]
            if place == starts[bearing] or ranges[k] - first > depths[0] + depths[1] * ranges[k] * ranges[k]:
                first = ranges[k]
                found += 1
            surfaces[found - 1, 0] += points[k, 0]
            surfaces[found - 1, 1] += points[k, 1]
            surfaces[found - 1, 2] += 1.0
            surfaces[found - 1, 3 + slice_of[k]] += 1.0
    return surfaces[:found].copy()


@compiled()
def _compiled_normals(
    away: F64,
    order: NDArray[np.intp],
    bearings: F64,
    reach_m: float,
    reach_per_m: float,
    sparse_factor: float,
    max_flatness: float,
) -> F32:
    """Return the angle of the surface normal at each hit, see `planar_normals`.

    away : (N, 2) hits from the sensor. order : sorts them by their `bearings`.

    Measured: 0.06 ms instead of 16 ms a scan of a planar laser, 0.11 instead of 86 ms of a lidar; all of the
    tracking of a scan takes 2 ms and 6 ms.
    """
    count = len(order)
    angles = np.empty(count, dtype=np.float32)
    for place in range(count):
        i = order[place]
        x, y = away[i, 0], away[i, 1]
        distance = math.hypot(x, y)
        towards = math.atan2(-y, -x)
        angles[i] = towards
        for factor in (1.0, sparse_factor):
            reach = factor * (reach_m + reach_per_m * distance)
            window = reach / max(distance, reach)
            n = 1.0
            sx = sy = sxx = sxy = syy = 0.0
            # Half of the hits on either side at most, so that each neighbour is counted once.
            for step, farthest in ((-1, (count - 1) // 2), (1, count // 2)):
                for k in range(1, farthest + 1):
                    j = order[(place + step * k) % count]
                    turn = abs(bearings[j] - bearings[i])
                    if min(turn, 2.0 * math.pi - turn) > window:
                        break
                    dx, dy = away[j, 0] - x, away[j, 1] - y
                    if dx * dx + dy * dy < reach * reach:
                        n += 1.0
                        sx += dx
                        sy += dy
                        sxx += dx * dx
                        sxy += dx * dy
                        syy += dy * dy
            if n < 3.0:
                continue
            mx, my = sx / n, sy / n
            a, b, d = sxx / n - mx * mx, sxy / n - mx * my, syy / n - my * my
            spread = math.sqrt(0.25 * (a - d) * (a - d) + b * b)
            if 0.5 * (a + d) - spread < max_flatness * (0.5 * (a + d) + spread):
                normal = 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
                if math.cos(normal - towards) < 0.0:
                    normal += math.pi
                angles[i] = normal
            break
    return angles
