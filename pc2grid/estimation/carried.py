"""A carried sensor: followed in space, and reduced to the plane by the map of its last metres.

A narrow, tilted, noisy view shows neither where the floor is nor what is a wall. So each scan is registered
to what was seen before, by KISS-ICP and then by the shapes of the surfaces, with the odometry of the device,
where there is one, as what it is: six degrees of freedom that drift. The planar scan is cut out of the map
(`SpaceMap`). A scan that does not fit is searched for in all headings, and what then agrees with the surfaces
and the free space of the map is believed, else it is lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.level import LEVEL
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.clouds.upright import level_floor
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.estimation.belief import KERNEL, SPATIAL, Belief
from pc2grid.estimation.ground_model import DECIDING_SCANS, is_rolling
from pc2grid.estimation.manifold import moved, steps
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placing import Estimate, Fit
from pc2grid.estimation.space_map import SpaceMap, ThinnedScan
from pc2grid.estimation.surface_map import SURFACES, Placement
from pc2grid.geometry import invert_pose, leveling, motion_size
from pc2grid.model import Scan
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class CarriedParameters:
    """Numbers of carried sensors. Chosen by hand.

    least_agreement : of a pose with what is known where the points lie, -1..1, that is credible. In a hall,
        right poses have 0.89 and more, wrong ones 0.66 to 0.88 (lidar/hall).
    residual_weight_per_m : of two placements the one with the larger agreement - weight * residual is taken.
    starts : placements that a search refines in space. turned_rad : by how much these may be turned, a
        standard deviation: more than a step of the search.
    most_waiting : scans that wait for one that shows the floor, or for a motion, at most: some 50 MB.
    standing_s : a base that stands level for so long is on wheels: a robot that waits to be located must not
        wait for its own motion, and a hand has trembled by then.
    """

    least_agreement: float = 0.85
    residual_weight_per_m: float = 5.0
    starts: int = 10
    turned_rad: float = 0.1
    most_waiting: int = 100
    standing_s: float = 5.0


CARRIED = CarriedParameters()


class CarriedSensor:
    """Places the scans of a sensor in the hand, one after another, in the session frame: z up."""

    free = SPATIAL

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig,
        parameters: CarriedParameters = CARRIED,
        tracking: TrackingParameters = TRACKING_PARAMETERS,
    ) -> None:
        self._registration, self._projection = registration, projection
        self._parameters, self._tracking = parameters, tracking
        self._map: SpaceMap | None = None
        self._last: F64 = np.eye(4)  # pose of the last scan that was not lost
        self._thinned = ThinnedScan(np.empty((0, 3)), np.empty(0))  # the scan taken last

    @property
    def map(self) -> SpaceMap | None:
        """The local map in space; None before the first scan and after `restart`."""
        return self._map

    def restart(self) -> None:
        """Forget the map: the next scan begins a new one."""
        self._map = None

    def start(self, scan: Scan, points_m: F32) -> F64:
        """See `PlacingSensor`."""
        self.take(scan, points_m)
        return first_pose(scan, points_m)

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in space has its tilt and its height already."""
        return pose

    def __bool__(self) -> bool:
        """Whether there is a local map."""
        return bool(self._map)

    def take(self, scan: Scan, points_m: F32) -> None:
        """See `PlacingSensor`."""
        if self._map is None:
            self._map = SpaceMap(scan, points_m, self._registration, self._projection)
        self._thinned = self._map.thin(scan, points_m)

    def match(self, belief: Belief) -> list[Fit]:
        """See `PlacingSensor`."""
        return [self._matched(belief.pose, belief)]

    def search(self, belief: Belief) -> Iterator[Fit]:
        """Match in all headings around the last pose, with its height and tilt.

        A hand turns fast; then the predicted direction of the step says nothing.
        """
        p, t = self._parameters, self._tracking
        step_m = float(np.linalg.norm(belief.pose[:3, 3] - self._last[:3, 3]))
        window_m = min(step_m + KERNEL * belief.sigmas[0], t.search_most_m)
        covariance = np.diag([window_m**2] * 3 + [p.turned_rad**2] * 3)
        for guess in self._space.search(self._thinned, self._last, window_m, p.starts):
            yield self._matched(guess, Belief(guess, covariance, belief.free))

    def _matched(self, guess: F64, held: Belief) -> Fit:
        """The scan taken last matched with the map from a guess (4, 4), held to a belief."""
        space = self._space
        found = space.match(self._thinned, guess, held)
        of_known, of_all = space.agreement(self._thinned, found.pose)
        quality = of_all - self._parameters.residual_weight_per_m * found.residual_m
        return Fit(
            pose=found.pose,
            alone=_alone(found, held),
            overlap=found.overlap,
            measured=found.measured,
            evidence=SURFACES.independent(len(self._thinned.points_m)) * quality,
            credible=of_known >= self._parameters.least_agreement,
        )

    def held(self, fit: Fit) -> Fit:
        """See `PlacingSensor`."""
        alone, information = fit.alone
        placement = Placement(fit.pose, information, fit.overlap, 0.0, fit.measured)
        held = self._space.held(self._thinned, placement)
        return replace(fit, alone=(alone, held.information), measured=held.measured)

    def follow(self, belief: Belief) -> None:
        """Nothing: the surfaces of the last scans are in the map."""

    def fits_last(self, belief: Belief) -> bool:
        """Not known: see `follow`."""
        del belief
        return False

    def extend(self, pose: F64) -> None:
        """Nothing: scans join the map in space oftener than keyframes begin, see `cut`."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Add the scan taken last to the map at its final pose (4, 4), and cut its planar scan out of it.

        The planar scan is in the levelled base frame.
        """
        if not lost:
            self._space.extend(scan, points_m, self._thinned, pose)
            self._last = pose
        return self._space.cut(scan, pose)

    @property
    def _space(self) -> SpaceMap:
        """The map, of which there is one as soon as a scan has been taken."""
        if self._map is None:
            raise ValueError("no scan has been taken")
        return self._map


def _alone(found: Placement, held: Belief) -> Estimate:
    """The pose (4, 4) by the points alone, with its information (6, 6). held : what drew it aside."""
    away, _, J = (of_belief[0] for of_belief in steps(held.pose[None], found.pose[None]))
    information = found.information + 1e-3 * np.eye(6)
    change = np.linalg.solve(information, J.T @ held.information @ away)
    return moved(found.pose[None], change[None])[0], information


def first_pose(scan: Scan, points_m: F32) -> F64:
    """T_session_base (4, 4) of the first scan of a carried sensor: the session frame is the base, levelled.

    The vertical is that of the odometry, which has six degrees of freedom; else that of the floor in the
    points (N, 3), unless an IMU contradicts it, which measures it less exactly; else that of the IMU, else
    the z axis of the base.
    """
    if scan.T_odom_base is not None:
        return leveling(scan.T_odom_base[2, :3])
    ground = level_floor(scan, points_m)
    if scan.T_level_base is not None:
        up = scan.T_level_base[2, :3]
        if ground is None or ground.normal @ up < LEVEL.level:
            return leveling(up)
    return np.eye(4) if ground is None else ground.leveling()


@dataclass(frozen=True, slots=True)
class Beginning:
    """The first scans of a session, of which none is missing but those `left_out`.

    in_hand : how the sensor is carried: in the hand, else on wheels. All stages are given this.
    warning : what was left out, or assumed, as a sentence for the user; None: nothing.
    """

    scans: Sequence[Scan]
    in_hand: bool = False
    left_out: int = 0
    warning: str | None = None


def begin(scans: Iterator[Scan], parameters: CarriedParameters = CARRIED) -> Beginning:
    """Look ahead until it is known how the sensor is carried, and in the hand, which way is up.

    A session in the hand begins with the first scan that shows which way is up. If none of the first scans
    does, all of them are kept: the sensor is taken to be held level.
    """
    ahead = islice(scans, parameters.most_waiting)
    waiting, in_hand = _until_decided(ahead, parameters.standing_s)
    if not in_hand:
        return Beginning(waiting)
    unknown = "no floor, and neither odometry nor an IMU says which way is up"
    seen: list[Scan] = []
    for scan in chain(waiting, ahead):
        if _knows_vertical(scan):
            said = f"{len(seen)} scans show {unknown}: they are left out; begin with the floor in view"
            rest = [scan, *waiting[len(seen) + 1 :]]
            return Beginning(rest, True, len(seen), said if seen else None)
        seen.append(scan)
    said = f"the scans show {unknown}: the sensor is taken to be held level; begin with the floor in view"
    return Beginning(seen, True, warning=said)


def _until_decided(scans: Iterator[Scan], standing_s: float) -> tuple[list[Scan], bool]:
    """Take scans until they tell whether the sensor is in the hand; returns them, and whether it is.

    A hand may be level for a moment. So only scans count after which the base has moved, or of which that is
    not known; or a base that has stood for so long.
    """
    waiting: list[Scan] = []
    moving = 0
    for scan in scans:
        waiting.append(scan)
        if not is_rolling(scan, waiting[0]):
            return waiting, True
        moving += _has_moved(waiting[0], scan)
        stands = not moving and scan.stamp_ns - waiting[0].stamp_ns > standing_s * 1e9
        if SENSOR_MODELS[scan.sensor].planar or moving == DECIDING_SCANS or stands:
            break
    return waiting, False


def _has_moved(first: Scan, scan: Scan) -> bool:
    """Whether a base has moved since the first scan as far as makes a keyframe, unless that is not known."""
    if first.T_odom_base is None or scan.T_odom_base is None:
        return True
    distance_m, turn_rad = motion_size(invert_pose(first.T_odom_base) @ scan.T_odom_base)
    p = TRACKING_PARAMETERS
    return distance_m >= p.keyframe_travel_m or turn_rad >= p.keyframe_turn_rad


def _knows_vertical(scan: Scan) -> bool:
    """Whether odometry, an IMU or a floor in view tells the vertical."""
    known = scan.T_odom_base is not None or scan.T_level_base is not None
    return known or level_floor(scan, scan.points_m) is not None
