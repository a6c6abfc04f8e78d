"""What a robot has seen over its last metres, made ready to be looked up.

A robot rarely stands where it has seen most. So the query is described not where the robot is but at
those places of its own path whose surroundings it has observed best; each is a view, and all views vote.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from pc2grid.arrays import F64, cells_of
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import PartitionConfig, ProjectionConfig
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.matching.self_likeness import self_likeness
from pc2grid.matching.walls import Walls
from pc2grid.model import OccupancyGrid
from pc2grid.submaps.isovist import HIDDEN, isovist, look_around
from pc2grid.submaps.partition import view_at
from pc2grid.submaps.sampling import sample_evenly
from pc2grid.submaps.skeleton import skeleton_of
from signature.config import RelocalizeConfig, SignatureConfig
from signature.describe import Signature, describe
from signature.retrieval.view import View
from signature.seen_places import PROFILE_BEARINGS


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryParameters:
    """What a query is made of. All chosen by hand.

    keyframe_m, keyframe_rad : a scan is kept if the robot has moved or turned so far since the last one.
    clearance_m : views on the middle lines of the free space are at least so far from walls.
    every_m : distance of the candidates for views along the middle lines.
    path_candidates : candidates for views on the path, evenly spread.
    last_m : a query that is not located is asked again with only so many metres of its travel, longest first.
    """

    keyframe_m: float = 0.1
    keyframe_rad: float = math.radians(5.0)
    clearance_m: float = 0.3
    every_m: float = 0.5
    path_candidates: int = 40
    last_m: tuple[float, ...] = (8.0, 4.0)


QUERY = QueryParameters()


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A planar scan of a query, in the base frame, and the base there; path_m : metres driven until then."""

    planar_scan: PlanarScan
    T_odom_base: SE2
    path_m: float


@dataclass(frozen=True, kw_only=True)  # no slots, for what is computed once
class QueryMap:
    """The query at one moment of its travel.

    stamp_ns : the last scan. T_odom_base : pose of the base there. path_m : metres driven so far.
    grid : local map in the odom frame. views : best observed first. walls : the local map as verification
    takes it. center_m : (x, y) in the odom frame that poses of the query rotate about.
    part : number of times that registration was lost before; each part has an odom frame of its own.
    T_odom_prior : the base at the time that a prior is about; None if it is not known in this odom frame.
    since_prior_m : metres driven since that time.
    keyframes : the scans that it was drawn from, oldest first, and the last scan; none of a drawn map.
    """

    stamp_ns: int
    path_m: float
    T_odom_base: SE2
    grid: OccupancyGrid
    views: tuple[View, ...]
    walls: Walls
    center_m: tuple[float, float]
    part: int = 0
    T_odom_prior: SE2 | None = None
    since_prior_m: float = 0.0
    keyframes: tuple[Keyframe, ...] = ()

    @cached_property
    def likeness(self) -> float:
        """`pc2grid.matching.self_likeness` of the walls."""
        return self_likeness(self.walls)


class QueryWindow:
    """The last metres of travel as keyframes: what a query is built from. Memory is bounded by the metres."""

    def __init__(self, projection: ProjectionConfig, config: RelocalizeConfig) -> None:
        self._projection = projection
        self._config = config
        self._keyframes: deque[Keyframe] = deque()
        self.path_m = 0.0
        self.stamp_ns = 0
        self.T_odom_base = SE2()
        self._newest: Keyframe | None = None

    def add(self, planar_scan: PlanarScan, T_odom_base: SE2) -> None:
        """Take in the next planar scan and its pose; forgets what lies more than `window_m` of travel
        back."""
        if self._newest is not None:
            step = self.T_odom_base.inverse() @ T_odom_base
            self.path_m += math.hypot(step.x, step.y)
        self.stamp_ns, self.T_odom_base = planar_scan.stamp_ns, T_odom_base
        self._newest = Keyframe(planar_scan, T_odom_base, self.path_m)
        if self._keyframes:
            last = self._keyframes[-1].T_odom_base.inverse() @ T_odom_base
            if math.hypot(last.x, last.y) < QUERY.keyframe_m and abs(last.yaw) < QUERY.keyframe_rad:
                return
        self._keyframes.append(self._newest)
        while self.path_m - self._keyframes[0].path_m > self._config.window_m:
            self._keyframes.popleft()

    def __len__(self) -> int:
        return len(self._keyframes)

    def query(
        self, partition: PartitionConfig, signature: SignatureConfig, last_m: float = math.inf
    ) -> QueryMap:
        """Draw the window, or its last `last_m` of travel, and describe it. Needs at least one keyframe."""
        builder = GridBuilder(self._projection)
        newest_m = self._keyframes[-1].path_m
        keyframes = [k for k in self._keyframes if newest_m - k.path_m <= last_m]
        for keyframe in keyframes:
            builder.add(keyframe.planar_scan, keyframe.T_odom_base)
        path = np.array([(k.T_odom_base.x, k.T_odom_base.y) for k in keyframes])
        query = query_of(
            builder.grid(),
            path,
            partition=partition,
            signature=signature,
            config=self._config,
            T_odom_base=self.T_odom_base,
            stamp_ns=self.stamp_ns,
            path_m=self.path_m,
        )
        assert self._newest is not None
        newest = () if self._newest is keyframes[-1] else (self._newest,)
        return replace(query, keyframes=(*keyframes, *newest))


def query_of(
    grid: OccupancyGrid,
    path_xy_m: F64,
    *,
    partition: PartitionConfig,
    signature: SignatureConfig,
    config: RelocalizeConfig,
    T_odom_base: SE2,
    stamp_ns: int = 0,
    path_m: float = 0.0,
) -> QueryMap:
    """Describe a local map (odom frame) that was seen from `path_xy_m` (K, 2).

    partition, signature : as the database was made, or the two sides are not comparable.
    """
    centers = best_observed(grid, path_xy_m, partition.radius_m, config)
    views = tuple(
        View(
            center_m=center,
            profile=isovist(grid, center, partition.radius_m, bearings=PROFILE_BEARINGS),
            describe=partial(_signature_at, grid, center, partition, signature),
        )
        for center in centers
    )
    return QueryMap(
        stamp_ns=stamp_ns,
        path_m=path_m,
        T_odom_base=T_odom_base,
        grid=grid,
        views=views,
        walls=Walls.of(grid),
        center_m=(T_odom_base.x, T_odom_base.y),
    )


def _signature_at(
    grid: OccupancyGrid, center_m: tuple[float, float], partition: PartitionConfig, config: SignatureConfig
) -> Signature:
    return describe(view_at(grid, center_m, partition), config)


def best_observed(
    grid: OccupancyGrid, path_xy_m: F64, sight_m: float, config: RelocalizeConfig
) -> tuple[tuple[float, float], ...]:
    """Up to `config.views` points, `config.view_spacing_m` apart, best observed first.

    Half of them lie on the path, where the robot has looked around; the others on the middle lines of all
    the free space seen, because much of what surrounds a place is seen from elsewhere. How well a place
    is observed is the share of the rays from it that end on something known.
    """
    middle = skeleton_of(grid.free, grid.resolution_m, QUERY.clearance_m)
    spaced = sample_evenly(cells_of(middle), QUERY.every_m / grid.resolution_m)
    chosen: list[tuple[float, float]] = []
    for points, most in (
        (path_xy_m[:: max(1, len(path_xy_m) // QUERY.path_candidates)], (config.views + 1) // 2),
        (grid.to_point(spaced), config.views),
    ):
        _, ends = look_around(grid, points, sight_m, bearings=PROFILE_BEARINGS)
        hidden = np.count_nonzero(ends == HIDDEN, axis=1)
        for x, y in points[np.argsort(hidden, kind="stable")].tolist():
            if len(chosen) == most:
                break
            if all(math.dist((x, y), c) >= config.view_spacing_m for c in chosen):
                chosen.append((x, y))
    return tuple(chosen)
