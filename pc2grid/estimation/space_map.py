"""The local map of a carried sensor in space: its surfaces, its columns, and the floor in them.

The registered clouds of the last metres are fused in two ways: as shapes that scans are registered to
(`SurfaceMap`), and as columns of occupied and free cells that planar scans are cut out of (`ColumnMap`).
Memory is that of the surroundings, whatever the length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pc2grid.arrays import F32, F64, BoolGrid
from pc2grid.clouds.column_map import ColumnMap
from pc2grid.clouds.level import FloorBelow
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.estimation.belief import Belief
from pc2grid.estimation.point_to_line import best_placements, evenly
from pc2grid.estimation.surface_map import Placement, SurfaceMap
from pc2grid.geometry import SE2, invert_pose, motion_size
from pc2grid.model import Scan
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class SpaceMapParameters:
    """Numbers of the local map in space. Chosen by hand.

    noise_m : points whose deviation is larger are not used. good_m : points whose deviation is smaller count
        fully when a scan is registered.
    step_m, step_rad : a scan joins the map after this motion.
    assumed_m : height of the sensor above the floor as long as no floor is seen.
    search_sigma_m : of the likelihood field that is searched. search_points : points that are searched with.
    """

    noise_m: float = 0.025
    good_m: float = 0.01
    step_m: float = 0.05
    step_rad: float = math.radians(3.0)
    assumed_m: float = 1.4
    search_sigma_m: float = 0.15
    search_points: int = 200


SPACE_MAP = SpaceMapParameters()
_DOWN = np.array([(0.05 * i, 0.05 * j, -1.0) for i, j in np.ndindex(9, 9)]) - (0.2, 0.2, 0.0)
"""Rays from a sensor to the floor, in its height above that: who carries it walks on ground 0.4 m wide.
So it is free, unless what was measured there says more."""


@dataclass(frozen=True, slots=True)
class ThinnedScan:
    """The points of a scan that are registered.

    points_m : (N, 3) about one for each half voxel, base frame. weights : (N,) 0..1, by their noise.
    """

    points_m: F64
    weights: F64

    def placed(self, pose: F64) -> F64:
        """The points (N, 3) at a pose (4, 4)."""
        moved: F64 = self.points_m @ pose[:3, :3].T + pose[:3, 3]
        return moved


class SpaceMap:
    """What a carried sensor has seen around it, in the session frame (z up).

    Its columns stand on their own floor: each scan is entered at its height above the floor that was seen
    around it, so that the passes of a pose that rises or sinks lie over each other.
    """

    def __init__(
        self,
        scan: Scan,
        points_m: F32,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
        parameters: SpaceMapParameters = SPACE_MAP,
    ) -> None:
        """An empty map with voxels as the points (N, 3) of a scan, base frame, ask for."""
        self._projection, self._parameters = projection, parameters
        self._noise_per_m2 = SENSOR_MODELS[scan.sensor].noise_per_m2
        noise_range_m = SENSOR_MODELS[scan.sensor].range_of_noise_m(parameters.noise_m)
        self._reach_m = min(projection.max_range_m, noise_range_m)
        ranges_m = np.linalg.norm(points_m - scan.T_base_sensor[:3, 3], axis=1)
        self._surfaces = SurfaceMap.of_first_scan(ranges_m, 2.0 * projection.max_range_m, registration)
        self._columns = ColumnMap(self._reach_m, scan.sensor, projection)
        self._added_at: F64 | None = None  # pose of the last scan that joined
        self._floor = FloorBelow()
        self._above_floor_m: float | None = None  # the base, by the last scan

    def __bool__(self) -> bool:
        return self._added_at is not None and bool(self.surfaces)

    @property
    def surfaces(self) -> SurfaceMap:
        """The shapes that scans are registered to."""
        return self._surfaces

    def thin(self, scan: Scan, points_m: F32) -> ThinnedScan:
        """The points (N, 3) of a deskewed scan, base frame, thinned."""
        thinned = self._surfaces.thinned(points_m[self._near(scan, points_m)])
        away = thinned - scan.T_base_sensor[:3, 3]
        sigma_m = self._noise_per_m2 * np.einsum("ij,ij->i", away, away)
        return ThinnedScan(thinned, 1.0 / (1.0 + (sigma_m / self._parameters.good_m) ** 2))

    def match(self, thinned: ThinnedScan, guess: F64, prior: Belief) -> Placement:
        """Register a scan from a guess (4, 4), by KISS-ICP and then exactly; it is held to a prior."""
        near = self._surfaces.near(thinned.points_m, thinned.weights, guess, prior)
        return self._surfaces.match(thinned.points_m, thinned.weights, near, prior)

    def held(self, thinned: ThinnedScan, placement: Placement) -> Placement:
        """A placement of a scan with the information that surfaces give; see `SurfaceMap.held`."""
        return self._surfaces.held(thinned.points_m, thinned.weights, placement)

    def agreement(self, thinned: ThinnedScan, pose: F64) -> tuple[float, float]:
        """How a scan at a pose (4, 4) agrees with surfaces and free space, see `ColumnMap.agreement`."""
        return self._columns.agreement(self._lowered(thinned.placed(pose)))

    def search(self, thinned: ThinnedScan, guess: F64, window_m: float, count: int) -> list[F64]:
        """The best few poses (4, 4) in all headings, with the height and the tilt of a guess (4, 4).

        The points at the height of walls are searched for in the plane, within `window_m` along x and y.
        """
        p = self._parameters
        planar = SE2.from_matrix(guess)
        T_level_base = planar.inverse().lift() @ guess
        level = thinned.placed(T_level_base)
        heights = level[:, 2] - self._floor_m(guess[:3, 3])
        band = level[(heights > self._projection.band_min_m) & (heights < self._projection.band_max_m), :2]
        if not len(band):
            return []
        field, corner_m = self._columns.walls(p.search_sigma_m)
        chosen = band[evenly(len(band), p.search_points)]
        found = best_placements(
            field, corner_m, self._projection.resolution_m, chosen, planar, window_m, math.pi, count=count
        )
        return [pose.lift() @ T_level_base for _, pose in found]

    def extend(self, scan: Scan, points_m: F32, thinned: ThinnedScan, pose: F64) -> None:
        """Add a scan at its final pose (4, 4), if the sensor has moved enough since the last one."""
        p = self._parameters
        self._above_floor_m, travel_m = None, 0.0
        if self._added_at is not None:
            travel_m, turned_rad = motion_size(invert_pose(self._added_at) @ pose)
            if travel_m < p.step_m and turned_rad < p.step_rad:
                return
        self._added_at = pose
        self._surfaces.add(thinned.points_m, pose)
        sensor_m, placed = (pose @ scan.T_base_sensor)[:3, 3], thinned.placed(pose)
        near_m = points_m[self._near(scan, points_m)].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        fine = self._surfaces.fine
        seen_m = self._floor.follow(
            travel_m, self._surfaces.alone(near_m), fine.shapes, fine.edge_m, sensor_m
        )
        if seen_m is not None:
            self._above_floor_m = float(pose[2, 3]) - seen_m
        rays_m = placed
        if travel_m >= p.step_m:  # who turns on the spot may hold the sensor over a table
            rays_m = np.concatenate(
                (placed, sensor_m + _DOWN * (1.0, 1.0, sensor_m[2] - self._floor_m(sensor_m)))
            )
        self._columns.add(
            self._lowered(near_m),
            self._lowered(rays_m),
            self._lowered(sensor_m),
            self._floor_m(sensor_m) - self._floor.risen_m,
            2.0 * self._floor.sigma_m,
        )

    def cut(self, scan: Scan, pose: F64) -> PlanarScan:
        """The planar scan of a scan at its pose (4, 4), in the levelled base frame."""
        planar = self._columns.cut(SE2.from_matrix(pose), (pose @ scan.T_base_sensor)[:3, 3], scan.stamp_ns)
        # Without a floor, heights above it are not known.
        heights = planar.heights[:0] if self._floor.z_m is None else planar.heights
        return replace(planar, heights=heights, above_floor_m=self._above_floor_m)

    def _floor_m(self, sensor_m: F64) -> float:
        """z of the floor below a sensor at (3,)."""
        assumed_m = float(sensor_m[2]) - self._parameters.assumed_m
        return assumed_m if self._floor.z_m is None else self._floor.z_m

    def _lowered(self, points_m: F64) -> F64:
        """Points (..., 3), session frame, by as much lower as the poses have risen."""
        return points_m - (0.0, 0.0, self._floor.risen_m)

    def _near(self, scan: Scan, points_m: F32) -> BoolGrid:
        """The points (N, 3) that are near enough to be exact."""
        away = points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        near: BoolGrid = np.einsum("ij,ij->i", away, away) < self._reach_m**2
        return near
