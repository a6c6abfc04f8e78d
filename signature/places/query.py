"""What a robot has seen over its last metres, made ready to be looked up.

A robot rarely stands where it has seen most. So the query is described not where the robot is but where it
has observed the surroundings best, half on its path and half on other free ground; each is a view.
"""

from __future__ import annotations

import math
from collections import deque
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pc2grid.clouds.cloud import VoxelCloud
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import NoScans
from pc2grid.geometry import F64, SE2, cells_of, transform_points
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.matching.icp_in_space import SpatialView
from pc2grid.matching.score import self_similarity
from pc2grid.matching.walls import Walls
from pc2grid.model import SENSOR_MODELS, Health, OccupancyGrid, RegisteredScan
from pc2grid.settings import PartitionConfig
from pc2grid.submaps.junction_graph import sample_evenly, skeleton_of
from pc2grid.submaps.submaps import HIDDEN, isovist, look_around
from signature.config import Config, RelocalizeConfig
from signature.visible import PROFILE_BEARINGS, View


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryParameters:
    """What a query is made of. All chosen by hand.

    keyframe_m, keyframe_rad : a scan is kept if the robot has moved or turned so far since the last one.
    space_every_m : travel between two scans that are compared in space.
    """

    keyframe_m: float = 0.1
    keyframe_rad: float = math.radians(5.0)
    space_every_m: float = 0.2


QUERY = QueryParameters()


@dataclass(frozen=True, slots=True)
class QueryKeyframe:
    """A planar scan of a query, in the base frame, and the base there; path_m : metres driven until then.
    weak : its pose, or that of a scan since the keyframe before, is not fine (`Health`)."""

    planar_scan: PlanarScan
    T_odom_base: SE2
    path_m: float
    weak: bool = False


@dataclass(frozen=True, kw_only=True)  # no slots, for what is computed once
class QueryMap:
    """The query at one moment of its travel.

    stamp_ns : the last scan. T_odom_base : pose of the base there. path_m : metres driven so far.
    grid : local map in the odom frame. views : best observed first. walls : the local map as verification
    takes it. center_m : (x, y) in the odom frame that poses of the query rotate about.
    part : number of times that the scans did not go on before; each part has an odom frame of its own.
    slipped_m : metres driven until the robot was likely carried away or tracking slipped; none counts before.
    T_odom_prior : the base at the scan nearest to the time that a prior is about; None if it is not known in
    this odom frame. since_prior_m : metres driven since that scan.
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
    slipped_m: float = 0.0
    T_odom_prior: SE2 | None = None
    since_prior_m: float = 0.0
    keyframes: tuple[QueryKeyframe, ...] = ()

    @cached_property
    def likeness(self) -> float:
        """Return the `self_similarity` of the walls."""
        return self_similarity(self.walls)


class ViewSpacing:
    """Which scans of a query are compared in space: one every `QueryParameters.space_every_m` of travel."""

    def __init__(self) -> None:
        self.path_m = 0.0
        self._last_m: F64 | None = None

    def takes(self, registered: RegisteredScan) -> bool:
        """Return whether the next scan is one of them. One that registration was lost on begins anew."""
        if registered.health is Health.LOST:
            self.path_m, self._last_m = 0.0, None
            return False
        at_m = registered.T_session_base[:3, 3]
        step_m = math.inf if self._last_m is None else float(np.linalg.norm(at_m - self._last_m))
        if SENSOR_MODELS[registered.scan.sensor].planar or step_m < QUERY.space_every_m:
            return False
        self.path_m += 0.0 if self._last_m is None else step_m
        self._last_m = at_m
        return True


class QueryInSpace:
    """The scans of the last metres of a query, in its odom frame: as many as a place is described by
    (`PartitionConfig.radius_m`). Memory is bounded by the metres."""

    def __init__(self, made_with: Config) -> None:
        """Begin without any scan. made_with : of the database; points are as close as in its maps."""
        self._made_with = made_with
        self._views: deque[tuple[float, SpatialView]] = deque()
        self._spacing = ViewSpacing()
        self.T_odom_base: F64 | None = None

    def add(self, registered: RegisteredScan) -> None:
        """Take in the next scan, which registration was not lost on."""
        scan, T = registered.scan, registered.T_session_base
        self.T_odom_base = T
        # A scan may come without its points, which `Follower` leaves out.
        if not len(scan.points_m) or not self._spacing.takes(registered):
            return
        cloud = VoxelCloud(self._made_with.projection.resolution_m)
        cloud.add(scan.points_m)
        sensor_m = (T @ scan.T_base_sensor)[:3, 3]
        view = SpatialView(sensor_m=sensor_m, points_m=transform_points(T, cloud.points_m()))
        self._views.append((self._spacing.path_m, view))
        while self._spacing.path_m - self._views[0][0] > self._made_with.partition.radius_m:
            self._views.popleft()

    def since(self, travel_m: float) -> QueryInSpace:
        """Return the query without the scans from before the last so many metres of travel."""
        later, first_m = copy(self), self._spacing.path_m - travel_m
        later._spacing = copy(self._spacing)
        later._views = deque(view for view in self._views if view[0] >= first_m)
        return later

    @property
    def views(self) -> tuple[SpatialView, ...]:
        """Return the scans, oldest first."""
        return tuple(view for _, view in self._views)


class Query:
    """The last metres of a recording, scan by scan. Memory is bounded by the metres.

    Scans on which registration was lost are not used, and nothing seen before them is kept, because the
    motion between the two parts is unknown. If registration was lost on the last scan, this scan alone is the
    query.

    in_space : the same scans in space; None if their points are not needed. part : number of times that
    registration was lost or the scans began anew. lost_scans : on how many of the last scans in a row it was
    lost. first_ns : stamp of the first scan of the part.
    """

    def __init__(
        self,
        made_with: Config,
        config: RelocalizeConfig,
        *,
        prior_ns: int | None = None,
        in_space: bool = False,
    ) -> None:
        """Begin without any scan. made_with : of the database; the query is drawn and described as its maps
        are.

        prior_ns : the time of a prior; the pose there is remembered.
        """
        self._made_with, self._config, self._prior_ns = made_with, config, prior_ns
        self.in_space = QueryInSpace(made_with) if in_space else None
        self.part = self.lost_scans = 0
        self._slipped_m = 0.0
        self.first_ns: int | None = None
        self._keyframes: deque[QueryKeyframe] = deque()
        self._newest: QueryKeyframe | None = None
        self._at_prior: tuple[float, QueryKeyframe | None] = (
            math.inf,
            None,
        )  # time to the nearest scan; that scan
        self._drawn: QueryMap | None = None

    @property
    def path_m(self) -> float:
        """Return the metres driven since the start, or since registration was lost."""
        return self._newest.path_m if self._newest is not None else 0.0

    def add(self, registered: RegisteredScan, planar_scan: PlanarScan) -> None:
        """Take in the next scan; forget what lies more than `relocalize.window_m` of travel back."""
        pose = SE2.from_matrix(registered.T_session_base)
        self._drawn = None
        self.first_ns = registered.scan.stamp_ns if self.first_ns is None else self.first_ns
        if registered.health is Health.LOST:
            self.lost_scans += 1
            self._at_prior = min(self._at_prior[0], self._off_prior(planar_scan)), None
            self.restart()
            self._newest = QueryKeyframe(planar_scan, pose, 0.0) if len(planar_scan.hits_m) else None
            return
        self.lost_scans = 0
        if self.in_space is not None:
            self.in_space.add(registered)
        path_m, weak = 0.0, registered.health is not Health.FINE
        if self._keyframes and self._newest is not None:
            weak |= self._newest.weak and self._newest is not self._keyframes[-1]
            step = self._newest.T_odom_base.inverse() @ pose
            path_m = self._newest.path_m + math.hypot(step.x, step.y)
        self._newest = QueryKeyframe(planar_scan, pose, path_m, weak)
        if self._off_prior(planar_scan) < self._at_prior[0]:
            self._at_prior = self._off_prior(planar_scan), self._newest
        self._keep(self._newest)

    def _off_prior(self, planar_scan: PlanarScan) -> float:
        """Return the nanoseconds between a scan and the time of the prior; infinite without one."""
        return math.inf if self._prior_ns is None else abs(planar_scan.stamp_ns - self._prior_ns)

    def _keep(self, newest: QueryKeyframe) -> None:
        """Keep a scan if the robot has moved since the last one that was kept."""
        if self._keyframes:
            last = self._keyframes[-1].T_odom_base.inverse() @ newest.T_odom_base
            if math.hypot(last.x, last.y) < QUERY.keyframe_m and abs(last.yaw) < QUERY.keyframe_rad:
                return
        self._keyframes.append(newest)
        while newest.path_m - self._keyframes[0].path_m > self._config.window_m:
            self._keyframes.popleft()

    def restart(self) -> None:
        """Forget the scans: the next ones do not continue them, and an earlier prior does not apply."""
        self.part += 1
        self._slipped_m, self.first_ns = 0.0, None
        self._keyframes.clear()
        self._newest = self._drawn = None
        self._at_prior = self._at_prior[0], None
        self.in_space = self.in_space and QueryInSpace(self._made_with)

    def since(self, scans: int) -> Query:
        """Return the query that begins with the last so many `QueryMap.keyframes`, before which tracking
        slipped."""
        later = copy(self)
        later._keyframes = deque(self.map().keyframes[-scans:])
        later._drawn = None
        later._slipped_m = later._keyframes[0].path_m
        later.in_space = self.in_space and self.in_space.since(self.path_m - later._slipped_m)
        off_ns, at_prior = self._at_prior
        if at_prior is not None and at_prior.path_m < later._slipped_m:
            later._at_prior = off_ns, None
        return later

    def map(self) -> QueryMap:
        """Return the grid of the last metres, described as the database is.

        Raises NoScans if no scan could be used.
        """
        if self._newest is None:
            raise NoScans("no scan of the query shows anything", hint="look at it with `pc2grid info`")
        if self._drawn is None:
            self._drawn = self._draw(self._newest)
        return self._drawn

    def _draw(self, newest: QueryKeyframe) -> QueryMap:
        keyframes = tuple(self._keyframes) or (newest,)
        builder = GridBuilder(self._made_with.projection)
        for keyframe in keyframes:
            builder.add(keyframe.planar_scan, keyframe.T_odom_base)
        path = np.array([(k.T_odom_base.x, k.T_odom_base.y) for k in keyframes])
        grid = builder.grid()
        query = query_of(grid, path, self._made_with, self._config, newest.T_odom_base)
        at_prior = self._at_prior[1]
        return replace(
            query,
            walls=query.walls.seen_from(grid.free.astype(np.float32)),
            stamp_ns=newest.planar_scan.stamp_ns,
            path_m=newest.path_m,
            part=self.part,
            slipped_m=self._slipped_m,
            T_odom_prior=None if at_prior is None else at_prior.T_odom_base,
            since_prior_m=0.0 if at_prior is None else newest.path_m - at_prior.path_m,
            keyframes=keyframes if newest is keyframes[-1] else (*keyframes, newest),
        )


def query_of(
    grid: OccupancyGrid,
    path_xy_m: F64,
    made_with: Config,
    config: RelocalizeConfig,
    T_odom_base: SE2 | None = None,
) -> QueryMap:
    """Describe a local map (odom frame) that was seen from `path_xy_m` (K, 2).

    made_with : how the database was made, or the two sides are not comparable.
    """
    T_odom_base = T_odom_base or SE2()
    partition = made_with.partition
    views = tuple(
        View(center_m=center, profile=isovist(grid, center, partition.radius_m, bearings=PROFILE_BEARINGS))
        for center in best_observed(grid, path_xy_m, partition, config)
    )
    return QueryMap(
        stamp_ns=0,
        path_m=0.0,
        T_odom_base=T_odom_base,
        grid=grid,
        views=views,
        walls=Walls.of(grid),
        center_m=(T_odom_base.x, T_odom_base.y),
    )


def map_as_query(
    grid: OccupancyGrid, made_with: Config, config: RelocalizeConfig, *, drawn: bool = False
) -> QueryMap:
    """Describe a map, or a part of one, of which it is not known from where it was seen.

    The origin of a map may lie anywhere, even far outside its walls. Poses turn about the best observed point
    instead: it is free, and the walls around it are known.

    drawn : see `Walls.of`.
    """
    query = query_of(grid, np.empty((0, 2)), made_with, config)
    if drawn:
        query = replace(query, walls=Walls.of(grid, drawn=True))
    if not query.views:
        return query
    center = query.views[0].center_m
    return replace(query, T_odom_base=SE2(*center), center_m=center)


def best_observed(
    grid: OccupancyGrid, path_xy_m: F64, partition: PartitionConfig, config: RelocalizeConfig
) -> tuple[tuple[float, float], ...]:
    """Return up to `config.views` points, `config.view_spacing_m` apart, best observed first.

    Half of them lie on the path, where the robot has looked around; the others on the middle lines of all
    the free space seen, because much of what surrounds a place is seen from elsewhere. How well a place
    is observed is the share of the rays from it that end on something known.

    partition : the middle lines and the sight are those of the database.
    """
    middle = skeleton_of(grid.ground, grid.resolution_m, partition.clearance_m)
    chosen: list[tuple[float, float]] = []
    for points, most in (
        (path_xy_m, (config.views + 1) // 2),
        (grid.to_point(cells_of(middle)), config.views),
    ):
        points = sample_evenly(points, 0.5 * config.view_spacing_m)
        _, ends = look_around(grid, points, partition.radius_m, bearings=PROFILE_BEARINGS)
        hidden = np.count_nonzero(ends == HIDDEN, axis=1)
        for x, y in points[np.argsort(hidden, kind="stable")].tolist():
            if len(chosen) == most:
                break
            if all(math.dist((x, y), c) >= config.view_spacing_m for c in chosen):
                chosen.append((x, y))
    return tuple(chosen)
