"""Tracking from scan to scan: what is expected, where the scan lies, the smoother, health.

Each source counts by what it measures. Odometry knows the motion to a few percent in every direction. A scan
knows the pose to millimetres, but only across the surfaces that it shows. A sensor places a scan by itself
(`SensorOnWheels` in the plane, `CarriedSensor` in space); the smoother weighs that against odometry and
against the scans before.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.deskew import deskew
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.clouds.sampling import random_subset
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.estimation.belief import Belief
from pc2grid.estimation.carried import CarriedSensor
from pc2grid.estimation.health import HealthJudge, Standstill
from pc2grid.estimation.odometer import Odometer
from pc2grid.estimation.on_wheels import SensorOnWheels
from pc2grid.estimation.overruled import Disagreement
from pc2grid.estimation.parameters import TRACKING_PARAMETERS, TrackingParameters
from pc2grid.estimation.placing import Placed, Placer, PlacingSensor
from pc2grid.estimation.smoother import Evidence, Smoother
from pc2grid.estimation.window import IN_THE_HAND, SMOOTHER
from pc2grid.geometry import SE2, invert_pose
from pc2grid.model import Health, RegisteredScan, Scan


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """The result of tracking one scan.

    registered : the scan, deskewed, with its pose and health.
    planar_scan : the scan reduced to the plane.
    keyframe : whether the robot had moved enough for the scan to become part of the local map.
    restart : the first keyframe after tracking was lost: its pose relative to those before is unknown.
    walls_changed : it was lost because the walls had changed while odometry stood still.
    disagreement : of odometry with the pose; None for a lost scan, and where there is nothing to compare.
    """

    registered: RegisteredScan
    planar_scan: PlanarScan
    keyframe: bool
    restart: bool = False
    walls_changed: bool = False
    disagreement: Disagreement | None = None


class Tracker:
    """Turns scans into poses and planar scans, one by one. Its memory is the size of two local maps.

    The session frame is the base at the first scan, levelled: z up.
    """

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig | None = None,
        parameters: TrackingParameters = TRACKING_PARAMETERS,
        *,
        in_hand: bool,
    ) -> None:
        """in_hand : how the sensor is carried; `pc2grid.estimation.carried.begin` finds it out."""
        self._config = registration
        self._parameters = parameters
        self._last: Scan | None = None
        self._odometer = Odometer(parameters=parameters)
        self._keyframe: SE2 | None = None  # where the last one was
        self._restarted = False  # no keyframe has been reported since tracking started again
        self._walls_changed = False  # why
        self._standstill = Standstill(parameters)
        self._in_hand = in_hand
        projection = projection or ProjectionConfig()
        self._sensor: PlacingSensor
        if in_hand:
            self._sensor = CarriedSensor(registration, projection)
        else:
            self._sensor = SensorOnWheels(registration, projection, parameters)
        self._smoother = Smoother(self._sensor.free, IN_THE_HAND if in_hand else SMOOTHER)
        self._health = HealthJudge(parameters)

    def start(self, scan: Scan) -> Tracked:
        """Begin with the first scan: find the floor, and put the base at the origin of the session frame."""
        self._odometer = Odometer(scan.stamp_ns, self._parameters)
        points = self._deskewed(scan, np.eye(4), 1.0)
        pose = self._sensor.start(scan, points)
        self._smoother.start(self._flat(pose), self._reading(scan))
        return self._finish(scan, points, pose, Health.FINE)

    def track(self, scan: Scan) -> Tracked:
        """Track the next scan; stamps must increase."""
        if self._last is None:
            return self.start(scan)
        seconds = (scan.stamp_ns - self._last.stamp_ns) * 1e-9
        reading, reported = self._reading(scan), self._odometer.reported(scan)
        continues = self._odometer.continues(scan, seconds)
        # 1. What is expected: by odometry, or that the motion goes on. What is not plausible comes last.
        steady = self._smoother.steady(seconds, turn := self._turn(scan))
        expected = [self._smoother.after(*steady)]
        if reading is not None and reported is not None:
            expected.insert(0 if continues else 1, self._smoother.by_odometry(reading))
        # 2. Undo the motion within the scan.
        motion = invert_pose(self._smoother.belief.pose) @ expected[0].pose
        points = self._deskewed(scan, motion, seconds)
        # 3. Place the scan by itself, and weigh that against odometry and the scans before.
        placed = Placer(self._sensor, self._parameters).place(scan, points, expected)
        between = placed.motion if turn is None else (steady[0], np.diag(steady[1] ** -2))
        evidence = Evidence(seconds, reading, continues, placed.alone, between)
        estimate = self._estimated(placed, evidence)
        # 4. Judge the pose, and start again if nothing fits any more.
        health = self._judged(placed, estimate, evidence)
        sure = placed.sure and not placed.first
        if self._standstill.left(scan, sure=sure) and self._sensor.fits_last(expected[0]):
            self._walls_changed, health = True, self._health.give_up()
        pose = self._sensor.levelled(estimate.pose)
        tracked = self._finish(scan, points, pose, health)
        if self._health.gives_up:
            self._restart()
        return tracked

    def _estimated(self, placed: Placed, evidence: Evidence) -> Belief:
        """The pose of a scan by all that is known of it. Nothing ties a new local map to what was before."""
        if not placed.first:
            return self._smoother.add(placed.pose, evidence)
        self._smoother.start(self._flat(placed.pose), evidence.T_odom_base, self._smoother.speed)
        return self._smoother.belief

    def _judged(self, placed: Placed, estimate: Belief, evidence: Evidence) -> Health:
        """What the pose of a scan is worth."""
        read = evidence.T_odom_base is not None
        bridged = placed.motion is not None or (read and evidence.continues)
        unaided = estimate if self._in_hand and not read else None
        return self._health.judge(placed, unaided, bridged=bridged)

    def _finish(self, scan: Scan, points: F32, pose: F64, health: Health) -> Tracked:
        """Extend the maps by a scan if it is worth it, and remember its final pose."""
        lost = health is Health.LOST
        planar_scan = self._sensor.cut(scan, points, pose, lost=lost)
        keyframe = not lost and len(planar_scan.hits_m) > 0 and self._is_due(pose)
        if keyframe:
            self._keyframe = SE2.from_matrix(pose)
            self._sensor.extend(pose)
        restart = keyframe and self._restarted
        walls_changed = restart and self._walls_changed
        if keyframe:
            self._restarted = self._walls_changed = False
        found = None if lost else self._odometer.disagreement(scan, pose)
        if health is Health.FINE and found is not None and found.overrules:
            health = Health.OVERRULED
        self._last = scan
        self._odometer.remember(scan, pose)
        deskewed = dataclasses.replace(scan, points_m=points, offsets_s=None)
        return Tracked(
            registered=RegisteredScan(scan=deskewed, T_session_base=pose, health=health),
            planar_scan=planar_scan,
            keyframe=keyframe,
            restart=restart,
            walls_changed=walls_changed,
            disagreement=found,
        )

    def _is_due(self, pose: F64) -> bool:
        """Whether the base has moved so far since the last keyframe that another one is worth it."""
        if self._keyframe is None:
            return True
        p, step = self._parameters, self._keyframe.inverse() @ SE2.from_matrix(pose)
        return math.hypot(step.x, step.y) >= p.keyframe_travel_m or abs(step.yaw) >= p.keyframe_turn_rad

    def _restart(self) -> None:
        """Forget the local maps; the poses go on from the last one."""
        self._sensor.restart()
        self._health.restart()
        self._keyframe = None
        self._restarted = True

    def _flat(self, pose: F64) -> F64:
        """A pose (4, 4) in the directions that are free: on wheels those of the plane."""
        return pose if self._in_hand else SE2.from_matrix(pose).lift()

    def _reading(self, scan: Scan) -> F64 | None:
        """The reading (4, 4) of odometry at a scan."""
        return None if scan.T_odom_base is None else self._flat(scan.T_odom_base)

    def _turn(self, scan: Scan) -> F64 | None:
        """The turn (4, 4) of a sensor in the hand since the last scan, by its IMU; None if that is not known,
        and beside odometry."""
        before = None if self._last is None else self._last.T_level_base
        unaided = self._in_hand and scan.T_odom_base is None
        if not unaided or before is None or scan.T_level_base is None:
            return None
        return invert_pose(before) @ scan.T_level_base

    def _deskewed(self, scan: Scan, motion: F64, seconds: float) -> F32:
        """The points (N, 3) of a scan that are used, without the motion while it was taken.

        motion : (4, 4) expected since the scan before, `seconds` ago. It counts only where odometry says
        nothing of the time of the scan itself, since a turn begins and ends within a scan.
        """
        away = scan.points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        keep = np.flatnonzero(np.einsum("ij,ij->i", away, away) >= self._config.min_range_m**2)
        keep = keep[random_subset(len(keep), self._parameters.max_points)]
        points = scan.points_m[keep]
        if scan.offsets_s is None or not self._config.deskew or not len(points):
            return points
        offsets = scan.offsets_s[keep]
        span_s = float(np.ptp(offsets))
        if scan.T_first_last is not None and self._odometer.is_possible(scan.T_first_last, span_s):
            within = scan.T_first_last.copy()
            if scan.T_odom_base is None:  # an IMU tells the turn alone
                within[:3, 3] = motion[:3, 3] * span_s / seconds
            motion, seconds = within, span_s
        return deskew(points, offsets, motion, seconds)
