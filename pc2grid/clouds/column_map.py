"""The last metres in space as columns of cells, out of which planar scans are cut.

Where a surface is measured a cell is hit, and along the ray to it cells are free. What a column is follows
from its cells between the floor and 1.8 m: a wall is occupied over most of the height that was observed; a
table, a chair or a lintel only in a part of it, while rays pass over it. The planar scan of a place is what
is visible from there: the walls, and how far the floor before them is known. So one view of a tilted camera
shows the wall above it and the floor below it that other views have seen.

Hornung et al., "OctoMap" (2013) for the evidence; memory is that of the window, whatever the length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from pc2grid.arrays import F32, F64, I64, U8
from pc2grid.clouds import _column_kernels as kernels
from pc2grid.clouds.normals import planar_normals
from pc2grid.clouds.planar_scan import BEARINGS, PlanarScan, mean_per_cell
from pc2grid.config import ProjectionConfig
from pc2grid.geometry import SE2
from pc2grid.model import SLICE_BORDERS_M, SensorKind
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnParameters:
    """Numbers of the columns. Chosen by hand, unless noted.

    layer_m : height of a cell. layers : of the window, most of them below the sensor.
    below : share of the layers that lie below the sensor.
    hit, miss : evidence of a scan for a surface in a cell, and against. limits : of the evidence, so that
        what has gone is forgotten after a few scans.
    margin_m, margin_sigmas : a ray ends so far before its point, and this many standard deviations of it.
    wall_share, wall_layers : a wall is occupied in so large a share of the observed cells between
        `band_min_m` and `band_max_m`, and in so many at least.
    over : what rays pass over in so many layers is no wall but a thing. Walls reach up as far as they are
        observed: of the columns of a real room, walls have 0 or 1 such layers, chairs and persons 2 to 6.
    gap_m : unknown ground that free ground continues behind.
    depth_m : thickness of a wall that becomes one line; the noise of the sensor comes on top.
    """

    layer_m: float = 0.1
    layers: int = 48
    below: float = 0.6
    hit: int = 2
    miss: int = 1
    limits: tuple[int, int] = (-6, 12)
    margin_m: float = 0.1
    margin_sigmas: float = 2.0
    wall_share: float = 0.5
    wall_layers: int = 3
    over: int = 2
    gap_m: float = 0.3
    depth_m: float = 0.1


COLUMNS = ColumnParameters()
_STAMPS = 250
"""Scans after which the stamps of cells begin again; they are of one byte."""


class ColumnMap:
    """The columns around a sensor, in the session frame (z up).

    reach_m : from the sensor; what lies beyond is forgotten.
    """

    def __init__(
        self,
        reach_m: float,
        sensor: SensorKind,
        config: ProjectionConfig,
        parameters: ColumnParameters = COLUMNS,
    ) -> None:
        self._reach_m, self._config, self._parameters = reach_m, config, parameters
        self._noise_per_m2 = SENSOR_MODELS[sensor].noise_per_m2
        size = 2 * math.ceil(1.25 * reach_m / config.resolution_m)
        self._evidence = np.zeros((size, size, parameters.layers), np.int8)
        self._seen = np.zeros((size, size, parameters.layers), np.uint8)
        self._touched = np.zeros((size, size), np.uint8)
        self._columns = np.zeros((2, size, size), np.uint8)  # what each is, and its heights (`SLICES`)
        self._sums = np.zeros((size, size, 3), np.float32)
        self._low: I64 = np.zeros(3, np.int64)  # lowest cell of the window
        self._stamp = 0
        self._floor_m = math.nan  # z of the floor that the states are for

    def add(self, points_m: F64, rays_m: F64, sensor_m: F64, floor_m: float, doubt_m: float = 0.0) -> None:
        """Enter a scan at its place in the session frame.

        points_m : (N, 3) returns. rays_m : (M, 3) of these, those whose rays clear what is before them.
        sensor_m : (3,) origin of the rays. floor_m : z of the floor. doubt_m : the floor may lie higher or
        lower by so much: what is there is no obstacle.
        """
        p, edge_m = self._parameters, self._config.resolution_m
        self._center(sensor_m)
        self._stamp += 1
        if self._stamp > _STAMPS:
            self._stamp = 1
            self._seen[:] = 0
            self._touched[:] = 0
        cell, margin = (edge_m, p.layer_m), (p.margin_m, p.margin_sigmas * self._noise_per_m2)
        kernels.observe_points(
            self._evidence, self._seen, self._touched, self._sums, self._low, points_m, cell,
            self._band_m(floor_m), self._stamp, p.hit, p.limits[1],
        )  # fmt: skip
        kernels.observe_rays(
            self._evidence, self._seen, self._touched, self._low, rays_m, sensor_m, cell, margin,
            self._stamp, p.miss, p.limits[0],
        )  # fmt: skip
        same_floor = abs(floor_m - self._floor_m) < 0.5 * p.layer_m
        if not same_floor:
            self._floor_m = floor_m
        low, high = (round(z / p.layer_m) for z in self._band_m(self._floor_m))
        floor, doubt = math.floor(self._floor_m / p.layer_m), round(doubt_m / p.layer_m)
        first, second = (round((self._floor_m + border_m) / p.layer_m) for border_m in SLICE_BORDERS_M)
        changed = self._stamp if same_floor else 0
        kernels.classify(
            self._evidence, self._columns[0], self._columns[1], self._touched, self._sums, self._low, changed,
            (floor - 1 - doubt, floor + 2 + doubt), (low + doubt, high), (first, second), p.wall_share,
            p.wall_layers, p.over,
        )  # fmt: skip

    def cut(self, T_session_base: SE2, sensor_m: F64, stamp_ns: int) -> PlanarScan:
        """The planar scan at a place: what a sensor at (3,), session frame, sees of walls and floor.

        T_session_base : planar pose of the base, in whose frame the planar scan is.
        """
        p, pose = self._parameters, T_session_base
        to_base = pose.inverse()
        origin = to_base.apply(sensor_m[None, :2])[0]
        if not self._stamp:
            nothing = np.empty((0, 2), np.float32)
            return PlanarScan.of_hits(
                stamp_ns=stamp_ns, hits_m=nothing, origin_m=origin, free_m=np.zeros(BEARINGS, np.float32)
            )
        edge_m = self._config.resolution_m
        free_m, sums, low_m = kernels.view(
            self._columns[0], self._sums, self._low, sensor_m[:2], pose.yaw, self._reach_m, edge_m, p.gap_m,
            (p.depth_m, 4.0 * self._noise_per_m2), BEARINGS,
        )  # fmt: skip
        walls_m = mean_per_cell(sums, edge_m) if len(sums) else low_m[:0]
        hits: F32 = to_base.apply(walls_m).astype(np.float32)
        return PlanarScan(
            stamp_ns=stamp_ns,
            hits_m=hits,
            normal_rad=planar_normals(hits, origin),
            origin_m=origin,
            free_m=free_m.astype(np.float32),
            low_m=to_base.apply(low_m).astype(np.float32),
            heights=self._heights_at(np.concatenate((walls_m, low_m))),
        )

    def agreement(self, points_m: F64) -> tuple[float, float]:
        """How points (N, 3), session frame, agree with surfaces and observed free space, -1..1.

        The share of points on surfaces less that in free space: of the points in observed cells, and of all
        in the window.
        """
        if not self._stamp:
            return 0.0, 0.0
        cell = self._config.resolution_m, self._parameters.layer_m
        met, against, inside = kernels.agreement(self._evidence, self._low, points_m, cell)
        return (met - against) / max(met + against, 1), (met - against) / max(inside, 1)

    def walls(self, sigma_m: float) -> tuple[F32, F64]:
        """The likelihood field (H, W), 0..1, of what stands, rows along y, and the corner (2,) of it."""
        edge_m = self._config.resolution_m
        walls = np.roll(
            self._columns[0] >= kernels.LOW, (-self._low[:2] % self._columns.shape[1]).tolist(), (0, 1)
        ).T
        away_m = edge_m * cv2.distanceTransform((~walls).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
        field: F32 = np.exp(np.float32(-0.5 / sigma_m**2) * away_m**2)
        return field, edge_m * self._low[:2].astype(np.float64)

    def _heights_at(self, points_m: F64) -> U8:
        """The heights (N,) of the columns of points (N, 2), session frame; see `pc2grid.model.SLICES`."""
        column, row = (
            np.floor(points_m.T / self._config.resolution_m).astype(np.int64) % self._columns.shape[1]
        )
        return np.asarray(self._columns[1, column, row], np.uint8)

    def _band_m(self, floor_m: float) -> tuple[float, float]:
        return floor_m + self._config.band_min_m, floor_m + self._config.band_max_m

    def _center(self, sensor_m: F64) -> None:
        """Move the window if the sensor is no longer near its middle."""
        p, edge_m = self._parameters, self._config.resolution_m
        size = self._columns.shape[1]
        cell = np.array([edge_m, edge_m, p.layer_m])
        half = np.array([size // 2, size // 2, round(p.below * p.layers)])
        low = np.floor(sensor_m / cell).astype(np.int64) - half
        if not self._stamp:
            self._low = low
        slack = np.array([size // 10, size // 10, p.layers // 10])
        if (np.abs(low - self._low) > slack).any():
            kernels.clear(self._evidence, self._sums, self._low, low)
            self._low = low
            self._floor_m = math.nan  # states are made again
