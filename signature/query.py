"""What a robot has seen over its last metres, made ready to be looked up.

A robot rarely stands where it has seen most. So the query is described not where the robot is but at
those places of its own path whose surroundings it has observed best; each is a view, and all views vote.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from pc2grid.alignment import Query as AlignedQuery
from pc2grid.alignment import prepare_query
from pc2grid.config import PartitionConfig, ProjectionConfig
from pc2grid.geometry import F64, SE2
from pc2grid.model import OccupancyGrid
from pc2grid.partition import view_at
from pc2grid.projection import GridBuilder
from pc2grid.skeleton import cells_of, sample_evenly, skeleton_of
from pc2grid.sweep import Sweep
from pc2grid.visibility import HIDDEN, Isovist, isovist, look_around
from signature.config import RelocalizeConfig, SignatureConfig
from signature.describe import Signature, describe

_CLEARANCE_M = 0.3
PROFILE_BEARINGS = 48
"""Rays of the isovists that are compared by their ranges: one every 7.5 degrees, and a round number for
the processor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The query described at one place.

    center_m : (x, y) in the query's odom frame.
    profile : its isovist with `PROFILE_BEARINGS` rays.
    signature : the three signatures of the submap around it, cut like those of the database.
    """

    center_m: tuple[float, float]
    profile: Isovist
    signature: Signature


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryMap:
    """The query at one moment of its travel.

    stamp_ns : the last scan. T_odom_base : pose of the base there. path_m : driven so far.
    grid : local map in the odom frame. views : best observed first. aligned : prepared for alignment.
    """

    stamp_ns: int
    path_m: float
    T_odom_base: SE2
    grid: OccupancyGrid
    views: tuple[View, ...]
    aligned: AlignedQuery


@dataclass(frozen=True, slots=True)
class _Keyframe:
    sweep: Sweep
    T_odom_base: SE2
    path_m: float


class Window:
    """The last metres of travel as keyframes: what a query is built from. Memory is bounded by the metres."""

    def __init__(self, projection: ProjectionConfig, config: RelocalizeConfig) -> None:
        self._projection = projection
        self._config = config
        self._keyframes: deque[_Keyframe] = deque()
        self.path_m = 0.0
        self.stamp_ns = 0
        self.T_odom_base = SE2()
        self._started = False

    def add(self, sweep: Sweep, T_odom_base: SE2) -> None:
        """Take in the next sweep and its pose; forgets what lies more than `window_m` of travel back."""
        if self._started:
            step = self.T_odom_base.inverse() @ T_odom_base
            self.path_m += math.hypot(step.x, step.y)
        self._started = True
        self.stamp_ns, self.T_odom_base = sweep.stamp_ns, T_odom_base
        if self._keyframes:
            last = self._keyframes[-1].T_odom_base.inverse() @ T_odom_base
            if math.hypot(last.x, last.y) < 0.1 and abs(last.yaw) < math.radians(5.0):
                return
        self._keyframes.append(_Keyframe(sweep, T_odom_base, self.path_m))
        while self.path_m - self._keyframes[0].path_m > self._config.window_m:
            self._keyframes.popleft()

    def __len__(self) -> int:
        return len(self._keyframes)

    def query(self, partition: PartitionConfig, signature: SignatureConfig) -> QueryMap:
        """Draw the window and describe it. Needs at least one keyframe."""
        builder = GridBuilder(self._projection)
        for keyframe in self._keyframes:
            builder.add(keyframe.sweep, keyframe.T_odom_base)
        path = np.array([(k.T_odom_base.x, k.T_odom_base.y) for k in self._keyframes])
        return query_of(
            builder.grid(),
            path,
            partition=partition,
            signature=signature,
            config=self._config,
            T_odom_base=self.T_odom_base,
            stamp_ns=self.stamp_ns,
            path_m=self.path_m,
        )


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
            signature=describe(view_at(grid, center, partition), signature),
        )
        for center in centers
    )
    return QueryMap(
        stamp_ns=stamp_ns,
        path_m=path_m,
        T_odom_base=T_odom_base,
        grid=grid,
        views=views,
        aligned=prepare_query(grid, center_m=(T_odom_base.x, T_odom_base.y)),
    )


def best_observed(
    grid: OccupancyGrid, path_xy_m: F64, sight_m: float, config: RelocalizeConfig
) -> tuple[tuple[float, float], ...]:
    """Up to `config.views` points, `config.view_spacing_m` apart, best observed first.

    Half of them lie on the path, where the robot has looked around; the others on the middle lines of all
    the free space seen, because much of what surrounds a place is seen from elsewhere. How well a place
    is observed is the share of the rays from it that end on something known.
    """
    middle = skeleton_of(grid.free, grid.resolution_m, _CLEARANCE_M)
    spaced = sample_evenly(cells_of(middle), 0.5 / grid.resolution_m)
    chosen: list[tuple[float, float]] = []
    for points, most in (
        (path_xy_m[:: max(1, len(path_xy_m) // 40)], (config.views + 1) // 2),
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
