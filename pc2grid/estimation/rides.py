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

    level_every_m, every_m : travel from one measurement of the vertical to the next, on level ground, and on
        a slope and up to `settled_m` behind it. A measurement takes as long as tracking a scan.
    measurements : whose median is used.
    begin_rad, end_rad : tilt from which on a robot is on a slope, and below which it is not any more; 1 in 12
        is 4.8 degrees. camera_factor : these times, by a depth camera: in the real 3D scan of a level floor,
        the median of its measurements reaches 2.9 degrees.
    settled_m : level travel after which a slope has ended. More than the way over the landing between two
        flights of stairs.
    known_m : travel after a measurement for which it holds: farther on the ground is not known to be level.
    storey_m : a rise of at least this leads to another floor.
    same_m : floors whose heights differ by less are one.
    steep_rad : a steeper slope, such as stairs, is not mapped. Tracking in the plane measures wrong distances
        there, so the pose after it is not known, unless it rose or fell by less than `brief_m`. A flatter one
        is mapped like level ground.

    Lifts:

    sectors : of equal angle around a robot that stands.
    stands_m : a robot that moves no farther stands.
    near_m : in the cabin of a lift every wall is nearer than this.
    far_m : through an open door one sees farther than this.
    seen, open : least sectors that must have been seen, and most of these that may be open, in a shut cabin.
    shut_s, still_m : least time for which it is shut, and how far the robot moves meanwhile, and until the
        door is open, at most.
    door : neighbouring sectors that are open when the door is.
    """

    level_every_m: float = 0.3
    every_m: float = 0.1
    measurements: int = 3
    begin_rad: float = math.radians(2.5)
    end_rad: float = math.radians(1.5)
    camera_factor: float = 1.4
    settled_m: float = 4.0
    known_m: float = 1.0
    storey_m: float = 1.5
    same_m: float = 1.0
    steep_rad: float = CLOUD_PARAMETERS.steepest_floor_rad
    brief_m: float = 0.3

    sectors: int = 72
    stands_m: float = 0.5
    near_m: float = 2.2
    far_m: float = 3.0
    seen: int = 50
    open: int = 2
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
        if not on_slope and self._lift.observe(planar_scan, place, forward_m):
            self._slope = None
            self.storeys.append(Storey(group=self.storeys[-1].group + 1, height_m=0.0))
            self.storey = len(self.storeys) - 1
            return Ride(arrived=True)
        if ground is None:
            return Ride()
        if self._slope is None:
            self._slope = _Slope(scan.sensor, self._parameters)
        ended = self._slope.observe(points_m, forward_m, place.yaw, ground)
        return Ride(self._slope.riding, ended is not None and self._arrives(ended))

    def _arrives(self, slope: _Ended) -> bool:
        """Whether a slope led to another floor, which becomes the present one, or to an unknown place."""
        p = self._parameters
        if abs(slope.rise_m) < p.storey_m:
            return slope.steepest_rad > p.steep_rad and abs(slope.rise_m) > p.brief_m
        here = self.storeys[self.storey]
        height_m = here.height_m + slope.rise_m
        joined = [k for k, other in enumerate(self.storeys) if other.group == here.group]
        self.storey = min(joined, key=lambda k: abs(self.storeys[k].height_m - height_m))
        if abs(self.storeys[self.storey].height_m - height_m) >= p.same_m:
            self.storeys.append(Storey(group=here.group, height_m=height_m))
            self.storey = len(self.storeys) - 1
        return True


@dataclass(frozen=True, slots=True)
class _Ended:
    """A slope that the robot has left behind, with its largest tilt."""

    rise_m: float
    steepest_rad: float


class _Slope:
    """Measures the tilt of the base against the walls, and the rise on a slope."""

    def __init__(self, sensor: SensorKind, parameters: RideParameters) -> None:
        self._parameters = parameters
        model = SENSOR_MODELS[sensor]
        self._factor = parameters.camera_factor if model.narrow else 1.0
        self._upright = CAMERA_UPRIGHT if model.narrow else UPRIGHT
        self._latest: deque[tuple[float, float]] = deque(maxlen=parameters.measurements)
        self._ahead = FloorAhead() if model.narrow else None
        self._vertical: F64 | None = None
        self._unmeasured_m = math.inf
        self._tilted = False
        self._level_m = 0.0
        self._forward_m = 0.0  # travel since the last measurement, forward
        self._unknown_m = 0.0  # the same, to and fro
        self._travels_m: deque[float] = deque(maxlen=(parameters.measurements + 1) // 2)
        self._pitch_rad = 0.0  # the last median
        self._rise_m = 0.0
        self._steepest_rad = 0.0
        self.underway = False  # on a slope, or not far behind it

    @property
    def riding(self) -> bool:
        """Whether the slope is underway and too steep to be mapped, or leads to another floor."""
        p = self._parameters
        return self.underway and (self._steepest_rad > p.steep_rad or abs(self._rise_m) >= p.storey_m)

    def observe(self, points_m: F32, forward_m: float, yaw_rad: float, ground: Ground) -> _Ended | None:
        """Take in a scan; returns the slope that it shows to be over.

        points_m, ground : as in `RideWatch.observe`. forward_m : travel along the base's own x axis since the
        last scan. yaw_rad : heading of the base in the session frame.
        """
        p = self._parameters
        self._unmeasured_m += abs(forward_m)
        self._forward_m += forward_m
        self._unknown_m += abs(forward_m)
        measured = False
        due = self._unmeasured_m >= (p.level_every_m if self._is_level and not self.underway else p.every_m)
        if due:
            self._unmeasured_m = 0.0
            measured = self._measure(points_m, ground)
        if self._ahead is not None:
            self._ahead.move(forward_m, yaw_rad)
            if due and not measured:
                measured = self._foresee(self._ahead)
            self._ahead.look(points_m, ground, self._latest[-1][0] if self._latest else 0.0)
        if len(self._latest) < p.measurements:
            return None
        pitch_rad, tilt_rad = np.median(np.array(self._latest), axis=0).tolist()
        self._tilted = tilt_rad > self._factor * (p.end_rad if self._tilted else p.begin_rad)
        if self._tilted and not self.underway:
            self.underway, self._steepest_rad = True, 0.0
        if measured:
            self._unknown_m = 0.0
            rise_m = self._rise_between(pitch_rad)
            self._rise_m = self._rise_m + rise_m if self.underway else rise_m
        if self._tilted:
            self._level_m = 0.0
            self._steepest_rad = max(self._steepest_rad, tilt_rad)
            return None
        if self._unknown_m < p.known_m:
            self._level_m += abs(forward_m)
        if not self.underway or self._level_m < p.settled_m:
            return None
        self.underway = False
        return _Ended(self._rise_m, self._steepest_rad)

    def _foresee(self, ahead: FloorAhead) -> bool:
        """Where no scan shows the vertical, take the pitch from the floor that was seen ahead, if it was."""
        pitch_rad = ahead.pitch_rad
        if pitch_rad is None:
            return False
        self._latest.append((pitch_rad, abs(pitch_rad)))
        return True

    def _rise_between(self, pitch_rad: float) -> float:
        """The rise from the place of one median of the pitch to that of this one.

        A median belongs to the place of the measurement in the middle, so the travel is that between the
        measurements before.
        """
        self._travels_m.append(self._forward_m)
        self._forward_m = 0.0
        mean_sine = 0.5 * (math.sin(self._pitch_rad) + math.sin(pitch_rad))
        self._pitch_rad = pitch_rad
        return self._travels_m[0] * mean_sine

    @property
    def _is_level(self) -> bool:
        """Whether the latest measurement is that of level ground."""
        return bool(self._latest) and self._latest[-1][1] < self._factor * self._parameters.end_rad

    def _measure(self, points_m: F32, ground: Ground) -> bool:
        """Measure the tilt, if the scan shows the vertical, and return whether it does."""
        up = ground.normal
        last = up if self._vertical is None else self._vertical
        vertical = vertical_of(points_m, (up,) if last is up else (last, up), self._upright)
        if vertical is None:
            return False
        self._vertical = vertical
        level = ground.leveling()[:3, :3] @ vertical
        tilt_rad = math.acos(min(float(vertical @ up), 1.0))
        self._latest.append((math.asin(float(np.clip(level[0], -1.0, 1.0))), tilt_rad))
        return True


class _Lift:
    """Watches the walls around a robot that stands: near on all sides, then a door opens."""

    def __init__(self, parameters: RideParameters) -> None:
        self._parameters = parameters
        self._start(SE2())

    def _start(self, at: SE2) -> None:
        self._at = at
        self._far: I64 = np.full(self._parameters.sectors, -1)  # 1: far, 0: near, -1: not seen yet
        self._travel_m = 0.0
        self._shut = False
        # Stamp and travel when the door was first seen shut while the robot stood, and last.
        self._since = self._until = (0, 0.0)

    def observe(self, planar_scan: PlanarScan, pose: SE2, forward_m: float) -> bool:
        """Take in a scan at its pose; returns whether the door of a lift has opened before it.

        Whether the robot stands is said by its travel since the last scan, which the wheels measure: a shut
        door looks like the wall of a room that the map shows, and the pose jumps.
        """
        p = self._parameters
        self._travel_m += forward_m
        if math.hypot(pose.x - self._at.x, pose.y - self._at.y) > p.stands_m:
            self._start(pose)
        near_m, far_m = _ranges(planar_scan, p.sectors, pose.yaw)
        self._far[(near_m < p.near_m) & (far_m < p.far_m)] = 0
        self._far[far_m >= p.far_m] = 1
        shut = (self._far >= 0).sum() >= p.seen and (self._far == 1).sum() <= p.open
        if shut:
            self._until = (planar_scan.stamp_ns, self._travel_m)
            if not self._shut or abs(self._travel_m - self._since[1]) > p.still_m:
                self._since = self._until
        self._shut = bool(shut)
        # A robot that drives out of a dead end sees far, too, but only once it has moved.
        stands = abs(self._travel_m - self._until[1]) <= p.still_m
        waited = self._until[0] - self._since[0] >= p.shut_s * 1e9
        around = np.concatenate((self._far, self._far[: p.door - 1])) == 1
        door = sliding_window_view(around, p.door).all(axis=1).any()
        opened = bool(stands and waited and door and not shut)
        if opened or not (shut or (stands and waited)):
            self._since = self._until  # to begin again
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
