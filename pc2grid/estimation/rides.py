"""Rides from floor to floor: slopes and stairs, by the tilt against the walls, and lifts, by their doors.

A map in the plane ends where a ride begins. On a slope the floor tilts with the robot, and the height is the
travel times the sine of the pitch. A lift shows no motion at all: the robot stands in a small room whose
door shuts and opens again, and how high it is then is not known.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pc2grid.arrays import F32, F64, I64
from pc2grid.clouds.ground import Ground
from pc2grid.clouds.parameters import CLOUD_PARAMETERS
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.clouds.upright import CAMERA_UPRIGHT, UPRIGHT, vertical_of
from pc2grid.estimation.floor_ahead import FloorAhead
from pc2grid.geometry import SE2
from pc2grid.model import Scan, SensorKind, Storey
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class RideParameters:
    """When a robot is on a slope, in a lift, or on another floor. Chosen by hand, on simulated houses.

    Slopes:

    every_m : travel from one measurement of the vertical to the next, each of which takes as long as tracking
        a scan. measurements : whose median is used.
    begin_rad : tilt from which on a robot is on a slope; 1 in 12 is 4.8 degrees. In the real 3D scan of a
        level floor, the median of a camera's measurements reaches 2.9 degrees.
    settled_m : level travel after which a slope has ended. More than the way over the landing between two
        flights of stairs.
    storey_m : a rise of at least this leads to another floor.
    same_m : floors whose heights differ by less are one.
    steep_rad : a steeper slope, such as stairs, is not mapped. Tracking in the plane measures wrong distances
        there, so the pose after it is not known, unless it rose or fell by less than `same_m`. A flatter one
        is mapped like level ground.

    Lifts:

    sectors : of equal angle around a robot that stands.
    near_m : in the cabin of a lift every wall is nearer than this.
    far_m : through an open door one sees farther than this.
    seen : least sectors that must have been seen in a shut cabin.
    shut_s, still_m : least time for which it is shut, and how far a robot that stands moves, at most,
        meanwhile and until the door is open.
    door : neighbouring sectors that are open when the door is; as many are not in a shut cabin.
    """

    every_m: float = 0.3
    measurements: int = 3
    begin_rad: float = math.radians(3.0)
    settled_m: float = 4.0
    storey_m: float = 1.5
    same_m: float = 1.0
    steep_rad: float = CLOUD_PARAMETERS.steepest_floor_rad

    sectors: int = 72
    near_m: float = 2.2
    far_m: float = 3.0
    seen: int = 50
    shut_s: float = 3.0
    still_m: float = 0.1
    door: int = 4


RIDES = RideParameters()


@dataclass(frozen=True, slots=True)
class Ride:
    """What a scan says of a ride.

    riding : the robot is on its way to another floor, or on stairs, or not far behind them: the scan shows no
    floor that could be mapped. arrived : with this scan the robot is somewhere whose place relative to what
    was before is not known.
    """

    riding: bool = False
    arrived: bool = False


class RideWatch:
    """Follows the rides of a session, scan by scan.

    storeys : the floors so far, in the order in which they were first reached. storey : number of the
    present one.
    """

    def __init__(self, parameters: RideParameters = RIDES) -> None:
        self._parameters = parameters
        self._slope: _Slope | None = None
        self._lift = _Lift(parameters)
        self.storeys: list[Storey] = [Storey(group=0, height_m=0.0)]
        self.storey = 0

    def observe(
        self,
        scan: Scan,
        points_m: F32,
        planar_scan: PlanarScan,
        pose: F64,
        forward_m: float,
        ground: Ground | None,
    ) -> Ride:
        """Take in a scan at its pose (4, 4) T_session_base.

        points_m : (N, 3) deskewed, base frame. forward_m : travel of the base along its own x axis since the
        last scan. ground : the floor in the base frame; None for a planar laser and for a sensor in the hand.
        """
        on_slope = self._slope is not None and self._slope.underway  # where landings are as small as cabins
        place = SE2.from_matrix(pose)
        if not on_slope and self._lift.observe(planar_scan, place.yaw, forward_m):
            self._slope = None
            self.storeys.append(Storey(group=self.storeys[-1].group + 1, height_m=0.0))
            self.storey = len(self.storeys) - 1
            return Ride(arrived=True)
        if ground is None:
            return Ride()
        if self._slope is None:
            self._slope = _Slope(scan.sensor, ground, self._parameters)
        ended = self._slope.observe(points_m, forward_m, place.yaw, ground)
        return Ride(self._slope.riding, ended and self._arrives(self._slope))

    def _arrives(self, slope: _Slope) -> bool:
        """Whether a slope led to another floor, which becomes the present one, or to an unknown place."""
        p = self._parameters
        if abs(slope.rise_m) < p.storey_m:
            return slope.steep and abs(slope.rise_m) > p.same_m
        here = self.storeys[self.storey]
        height_m = here.height_m + slope.rise_m
        joined = [k for k, other in enumerate(self.storeys) if other.group == here.group]
        self.storey = min(joined, key=lambda k: abs(self.storeys[k].height_m - height_m))
        if abs(self.storeys[self.storey].height_m - height_m) >= p.same_m:
            self.storeys.append(Storey(group=here.group, height_m=height_m))
            self.storey = len(self.storeys) - 1
        return True


class _Slope:
    """Measures the tilt of the base against the walls, and the rise on a slope.

    rise_m : since the slope that is underway began.
    """

    def __init__(self, sensor: SensorKind, ground: Ground, parameters: RideParameters) -> None:
        p = self._parameters = parameters
        self._narrow = SENSOR_MODELS[sensor].narrow
        self._upright = CAMERA_UPRIGHT if self._narrow else UPRIGHT
        self._ahead = FloorAhead()
        self._vertical = ground.normal
        # The latest measurements: pitch and tilt.
        self._tilts: deque[tuple[float, float]] = deque([(0.0, 0.0)] * p.measurements, p.measurements)
        self._unmeasured_m = math.inf
        self._level_m = math.inf  # measured travel since the last tilt
        self._steepest_rad = 0.0
        self.rise_m = 0.0

    @property
    def underway(self) -> bool:
        """Whether the robot is on a slope, or not far behind it."""
        return self._level_m < self._parameters.settled_m

    @property
    def steep(self) -> bool:
        """Whether the slope is too steep to be mapped."""
        return self._steepest_rad > self._parameters.steep_rad

    @property
    def riding(self) -> bool:
        """Whether the slope is underway and too steep to be mapped, or leads to another floor."""
        return self.underway and (self.steep or abs(self.rise_m) >= self._parameters.storey_m)

    def observe(self, points_m: F32, forward_m: float, yaw_rad: float, ground: Ground) -> bool:
        """Take in a scan; returns whether it shows that a slope is over.

        points_m, ground : as in `RideWatch.observe`. forward_m : travel along the base's own x axis since the
        last scan. yaw_rad : heading of the base in the session frame.
        """
        p = self._parameters
        self._unmeasured_m += abs(forward_m)
        self._ahead.move(forward_m, yaw_rad)
        before, level_m = self.underway, 0.0
        if self._unmeasured_m >= p.every_m:
            # What was not measured may be level or not.
            level_m = self._unmeasured_m if self._measure(points_m, ground) else 0.0
            self._unmeasured_m = 0.0
        if self._narrow:
            self._ahead.look(points_m, ground, self._tilts[-1][0])
        pitch_rad, tilt_rad = np.median(np.array(self._tilts), axis=0).tolist()  # of pitches and of tilts
        self._level_m = 0.0 if tilt_rad > p.begin_rad else self._level_m + level_m
        if self.underway and not before:
            self.rise_m = self._steepest_rad = 0.0
        self.rise_m += forward_m * math.sin(pitch_rad)
        self._steepest_rad = max(self._steepest_rad, tilt_rad)
        return before and not self.underway

    def _measure(self, points_m: F32, ground: Ground) -> bool:
        """Measure pitch and tilt by the walls, and return whether that was possible.

        Where these do not show the vertical, the pitch is that of the floor that a camera saw ahead, if it
        did.
        """
        up = ground.normal
        vertical = vertical_of(points_m, (self._vertical, up), self._upright)
        foreseen_rad = self._ahead.pitch_rad
        if vertical is not None:
            self._vertical = vertical
            level = ground.leveling()[:3, :3] @ vertical
            tilt_rad = math.acos(min(float(vertical @ up), 1.0))
            self._tilts.append((math.asin(float(np.clip(level[0], -1.0, 1.0))), tilt_rad))
        elif foreseen_rad is not None:
            self._tilts.append((foreseen_rad, abs(foreseen_rad)))
        return vertical is not None or foreseen_rad is not None


class _Lift:
    """Watches the walls around a robot that stands: near on all sides, then a door opens.

    Whether it stands is said by the wheels: a shut door looks like the wall of a room that the map shows, and
    the pose jumps.
    """

    def __init__(self, parameters: RideParameters) -> None:
        self._parameters = parameters
        self._start()

    def _start(self) -> None:
        self._far: I64 = np.full(self._parameters.sectors, -1)  # 1: far, 0: near, -1: not seen yet
        self._travel_m = 0.0
        self._shut_ns: list[int] = []  # first and last stamp at which the door was seen shut

    def observe(self, planar_scan: PlanarScan, yaw_rad: float, forward_m: float) -> bool:
        """Take in a scan; returns whether the door of a lift has opened before it.

        yaw_rad : heading of the base. forward_m : its travel since the last scan.
        """
        p = self._parameters
        self._travel_m += forward_m
        if abs(self._travel_m) > p.still_m:
            self._start()
        near_m, far_m = _ranges(planar_scan, p.sectors, yaw_rad)
        self._far[(near_m < p.near_m) & (far_m < p.far_m)] = 0
        self._far[far_m >= p.far_m] = 1
        if (self._far >= 0).sum() >= p.seen and (self._far == 1).sum() < p.door:
            self._shut_ns = [*self._shut_ns[:1], planar_scan.stamp_ns]
            return False
        if not self._shut_ns or self._shut_ns[-1] - self._shut_ns[0] < p.shut_s * 1e9:
            self._shut_ns = []
            return False
        around = np.concatenate((self._far, self._far[: p.door - 1])) == 1
        opened = bool(sliding_window_view(around, p.door).all(axis=1).any())
        if opened:
            self._shut_ns = []
        return opened


def _ranges(planar_scan: PlanarScan, sectors: int, yaw_rad: float) -> tuple[F64, F64]:
    """The nearest hit and the farthest free range (sectors,), metres, in sectors of the session frame; inf
    and 0 where there is none."""
    turn = 2.0 * math.pi / sectors
    away = planar_scan.hits_m - planar_scan.origin_m
    sector = np.floor((np.arctan2(away[:, 1], away[:, 0]) + yaw_rad) / turn).astype(np.int64) % sectors
    near_m = np.full(sectors, np.inf)
    np.minimum.at(near_m, sector, np.linalg.norm(away, axis=1))
    bearing = np.arange(len(planar_scan.free_m)) * (2.0 * math.pi / len(planar_scan.free_m))
    sector = np.floor((bearing + yaw_rad) / turn).astype(np.int64) % sectors
    far_m = np.zeros(sectors)
    np.maximum.at(far_m, sector, planar_scan.free_m)
    return near_m, far_m
