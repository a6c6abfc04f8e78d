"""A carried sensor: followed in space, and reduced to the plane by the map of its last metres.

A narrow, tilted, noisy view shows neither where the floor is nor what is a wall. So each scan is registered
to the surfaces seen before, with the odometry of the device, where there is one, as what it is: six degrees
of freedom that drift. The planar scan is cut out of the map (`SpaceMap`). A scan that does not fit is
searched for in all headings, and what then agrees with the surfaces and the free space of the map is
believed, else it is lost.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.ground import Ground, find_ground
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig
from pc2grid.estimation.manifold import moved, steps
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placed import Placed
from pc2grid.estimation.smoother import SMOOTHER, SPATIAL, Belief
from pc2grid.estimation.space_map import SpaceMap, ThinnedScan
from pc2grid.estimation.surface_map import Placement, PosePrior
from pc2grid.geometry import SE2
from pc2grid.model import Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class CarriedParameters:
    """Numbers of carried sensors. Chosen by hand, unless noted.

    sure_agreement : a scan long after the one before that agrees less with the map is searched for. In a
        hall, right poses have 0.89 and more, wrong ones 0.66 to 0.88 (lidar/hall).
    least_agreement : with less at the best place that is found, the scan is lost.
    starts : placements that a search refines in space. turned_rad : by how much these may be turned, a
        standard deviation: more than a step of the search.
    """

    sure_agreement: float = 0.9
    least_agreement: float = 0.85
    starts: int = 10
    turned_rad: float = 0.1


CARRIED = CarriedParameters()


class CarriedSensor:
    """Places the scans of a sensor in the hand, one after another, in the session frame: z up."""

    free = SPATIAL

    def __init__(
        self,
        projection: ProjectionConfig,
        parameters: CarriedParameters = CARRIED,
        tracking: TrackingParameters = TRACKING_PARAMETERS,
    ) -> None:
        self._projection, self._parameters, self._tracking = projection, parameters, tracking
        self._map: SpaceMap | None = None
        self._found: F64 = np.eye(4)  # pose of the last scan that was
        self._thinned = ThinnedScan(np.empty((0, 3)), np.empty(0))  # the scan placed last

    @property
    def map(self) -> SpaceMap | None:
        """The local map in space; None before the first scan and after `restart`."""
        return self._map

    def restart(self) -> None:
        """Forget the map: the next scan begins a new one."""
        self._map = None

    def start(self, scan: Scan, points_m: F32, at: SE2) -> F64:
        """Begin with a scan whose base is at a place of the session frame; returns its pose (4, 4),
        levelled."""
        self._map = SpaceMap(scan, points_m, self._projection)
        self._thinned = self._map.thin(scan, points_m)
        self._found = at.lift() @ first_pose(scan, points_m)
        return self._found

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in space has its tilt and its height already."""
        return pose

    def place(self, scan: Scan, points_m: F32, seconds: float, expected: Sequence[Belief]) -> Placed:
        """Place the deskewed points (N, 3) of a scan, `seconds` after the one before.

        expected : where the base may be, the most credible first. A scan that fits nowhere, or shows nothing,
        is placed there.
        """
        first = expected[0]
        axes = _axes(first.pose)
        prior = PosePrior(first.pose, axes @ np.linalg.inv(first.covariance) @ axes.T)
        if self._map is None:
            self._map = SpaceMap(scan, points_m, self._projection)
        self._thinned = thinned = self._map.thin(scan, points_m)
        if not self._map or not len(thinned.points_m):
            self._found = prior.pose
            return Placed(prior.pose, first=not self._map)
        found = self._map.match(thinned, prior.pose, prior)
        alone_s = 0.0 if scan.T_odom_base is not None else seconds  # without any word of its motion
        if self._is_doubtful(found, alone_s, self._map):
            found = self._search(prior, found, self._map)
        fits = found.overlap > 0.0
        if fits:
            self._found = found.pose
        return Placed(
            found.pose,
            _alone(found, prior) if fits else None,
            found.overlap,
            found.residual_m,
            found.measured,
        )

    def extend(self, pose: F64) -> None:
        """Scans join the map in space oftener than keyframes begin, see `cut`."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Add the scan placed last to the map at its final pose (4, 4), and cut its planar scan out of it.

        The planar scan is in the levelled base frame.
        """
        if self._map is None:
            raise ValueError("no scan has been placed")
        if not lost:
            self._map.extend(scan, points_m, self._thinned, pose)
        return self._map.cut(scan, pose)

    def _is_doubtful(self, found: Placement, seconds: float, space: SpaceMap) -> bool:
        """Whether the scan placed last may lie elsewhere: it does not fit, or hardly, after a long time."""
        t = self._tracking
        if found.overlap < t.sure_overlap:
            return True
        if t.search_sigmas * SMOOTHER.unsteady_radps * seconds < t.search_above_rad:
            return False
        return space.agreement(self._thinned, found.pose)[0] < self._parameters.sure_agreement

    def _search(self, prior: PosePrior, found: Placement, space: SpaceMap) -> Placement:
        """The best placement in all headings around the last pose that was found, with its height and tilt.

        A hand turns fast; then the predicted direction of the step says nothing.
        """
        p, t = self._parameters, self._tracking
        step_m = float(np.linalg.norm(prior.pose[:3, 3] - self._found[:3, 3]))
        window_m = min(step_m + t.search_sigmas / math.sqrt(prior.information[3, 3]), t.search_most_m)
        loose = PosePrior(self._found, np.diag([p.turned_rad**-2] * 3 + [window_m**-2] * 3))
        placements = [found]
        placements += (
            space.match(self._thinned, guess, dataclasses.replace(loose, pose=guess))
            for guess in space.search(self._thinned, self._found, window_m, p.starts)
        )
        best = max(placements, key=lambda placement: space.agreement(self._thinned, placement.pose)[1])
        if space.agreement(self._thinned, best.pose)[0] < p.least_agreement:
            return Placement(prior.pose, np.zeros((6, 6)), 0.0, 0.0, False)
        return best


def _axes(pose: F64) -> F64:
    """The matrix (6, 6) from a change in the axes of the base, shift first, to one as in `Placement`."""
    axes = np.zeros((6, 6))
    axes[:3, 3:] = axes[3:, :3] = pose[:3, :3]
    return axes


def _alone(found: Placement, prior: PosePrior) -> tuple[F64, F64]:
    """The pose (4, 4) by the points alone, with its information (6, 6) in the axes of the base."""
    axes = _axes(found.pose)
    away, _, _ = steps(prior.pose[None], found.pose[None])
    pulled = axes.T @ prior.information @ axes @ away[0]
    information = axes.T @ found.information @ axes
    change = np.linalg.solve(information + 1e-3 * np.eye(6), pulled)
    return moved(found.pose[None], change[None])[0], information


def first_pose(scan: Scan, points_m: F32) -> F64:
    """T_session_base (4, 4) of the first scan of a carried sensor: the session frame is the base, levelled.

    The vertical is that of the odometry, which has six degrees of freedom, else that of the floor in the
    points (N, 3), else the z axis of the base.
    """
    if scan.T_odom_base is not None:
        return Ground(scan.T_odom_base[2, :3].copy(), 0.0).leveling()
    ground = find_ground(points_m, scan.T_base_sensor[:3, 3])
    return np.eye(4) if ground is None else ground.leveling()
