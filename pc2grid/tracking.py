"""Following a robot from scan to scan: prediction, KISS-ICP, refinement in the plane, health.

Each source is weighed by what it observes. Odometry knows the motion to a few percent in every
direction; the scan knows the pose to millimetres, but only across the walls that it sees. So KISS-ICP
brings the scan near, and a point-to-line Gauss-Newton against the local map, with the odometry as a
prior, settles it: along a corridor the prior decides, across it the walls do.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.deskew import deskew
from pc2grid.facing import facing
from pc2grid.floor import Ground, assumed_ground, find_ground
from pc2grid.geometry import F64, SE2, interpolate_pose, invert_pose, rotation_vector
from pc2grid.matching import Match, PointGrid, evenly
from pc2grid.model import F32, Health, RegisteredScan, Scan
from pc2grid.odometry_trust import OdometryTrust
from pc2grid.registration import KissRegistration, thin
from pc2grid.sweep import Sweep, flatten

KEYFRAME_TRAVEL_M = 0.2
KEYFRAME_TURN_RAD = math.radians(10.0)
LOCAL_MAP_TRAVEL_M = 5.0
_ROLLING_GAIN = 0.2  # how fast the floor follows what is seen of it
_ROLLING_EVERY = 4
_CARRIED_GAIN = 0.3
_MIN_HITS, _MATCHED_HITS = 10, 700
_MIN_OVERLAP = 0.3
_MIN_OVERLAP_CARRIED = 0.1  # the plane shows less of a scene when the sensor tilts
_MAX_RESIDUAL_M = 0.1
_MAX_SIGMA_M = 0.15  # a direction known worse than this rests on odometry or on the motion model
_BRIDGED_SCANS = 30
_GIVE_UP_SCANS = 10
_STEADY_S = 0.3
_GAP_S = 1.0
_FASTEST_MPS, _FASTEST_RPS = 4.0, 4.0
_SURE_OVERLAP = 0.6  # of a scan with the local map, where odometry alone does not tell
_DISAGREE_M = 0.03
_DISAGREE_RAD = 0.02
_MAX_POINTS = 40_000  # of a camera's 300 000 pixels
_ICP_POINTS = 6_000  # floor and ceiling included


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """What became of one scan.

    sweep : the scan reduced to the plane.
    keyframe : whether the robot had moved enough for the scan to become part of the local map.
    restart : the first keyframe after a lost stretch: where it is relative to those before is a guess.
    """

    registered: RegisteredScan
    sweep: Sweep
    keyframe: bool
    restart: bool = False


class Tracker:
    """Turns scans into poses and sweeps, one by one; its memory is one local map.

    The map frame is the base at the first scan, levelled: z up.
    """

    def __init__(self, registration: RegistrationConfig, projection: ProjectionConfig | None = None) -> None:
        self._config = registration
        self._projection = projection or ProjectionConfig()
        self._kiss = KissRegistration(registration)
        self._ground: Ground | None = None
        self._last: Scan | None = None
        self._last_pose = np.eye(4)
        self._measured: tuple[F64, F64] | None = None  # T_odom_base, T_map_base when odometry was last known
        self._odometry = OdometryTrust()
        self._recent: list[tuple[int, F64]] = []  # stamp, T_map_base of the last scans
        self._maps: list[tuple[PointGrid, float]] = []
        self._last_keyframe: SE2 | None = None
        self._travel_m = 0.0
        self._rolling = True
        self._scans = 0
        self._poor_scans = 0
        self._lost_scans = 0
        self._restarted = False

    def track(self, scan: Scan) -> Tracked:
        """Follow the next scan; stamps must increase."""
        motion, motion_s, odometry = self._predict(scan)
        believed = True
        if odometry is not None and self._maps and _is_odd(odometry, motion_s):
            motion, odometry, believed = self._examine(scan, motion, motion_s, odometry)
        trusted = odometry is not None or self._last is None
        points = self._usable(scan, *_motion_within(scan, motion, motion_s, trusted))
        predicted: F64 = self._last_pose @ motion
        if self._last is None:
            self._rolling = scan.sensor == "laser" or _rolls(scan)
            self._kiss = KissRegistration(self._config, carried=not self._rolling)
            if scan.sensor != "laser":
                self._ground = _ground_at_start(points, scan.T_base_sensor)
                predicted = self._ground.leveling()
            pose = predicted
            self._kiss.register(self._without_floor(points), pose, np.eye(4), 0.0)
        else:
            self._follow_ground(points, scan, motion)
            pose = self._kiss.register(self._without_floor(points), self._last_pose, motion, motion_s)
            pose = self._hold_to_floor(pose)
        planar = SE2.flatten(pose)
        T_level_base = planar.inverse().lift() @ pose
        sweep = self._flatten(points, scan, T_level_base)
        health = Health.FINE
        if self._maps:
            refined, match = self._refine(sweep, planar, predicted, odometry)
            if self._rolling:
                planar = refined
                pose = planar.lift() @ T_level_base
            health = self._judge(match, odometry is not None)
        if not believed:
            health, self._lost_scans = Health.LOST, _GIVE_UP_SCANS + 1
        was_restarted = self._restarted
        restart = self._lost_scans > _GIVE_UP_SCANS
        if restart:
            # Nothing fits any more: begin anew from here, and say so by `restart`.
            self._maps, self._last_keyframe, self._lost_scans = [], None, 0
            self._kiss = KissRegistration(self._config, carried=not self._rolling)
        keyframe = health is not Health.LOST and len(sweep.hits_m) > 0 and self._extend_maps(sweep, planar)
        if keyframe:
            self._kiss.integrate(pose)
        self._recent = [*self._recent[-2:], (scan.stamp_ns, pose)]
        self._last, self._last_pose = scan, pose
        if scan.T_odom_base is not None:
            self._measured = scan.T_odom_base, pose
            self._odometry.observe(scan.T_odom_base, pose, health is Health.FINE)
        deskewed = dataclasses.replace(scan, points_m=points, offsets_s=None)
        registered = RegisteredScan(scan=deskewed, T_map_base=pose, health=health)
        self._restarted = (self._restarted or restart) and not keyframe
        return Tracked(
            registered=registered,
            sweep=sweep,
            keyframe=keyframe,
            restart=keyframe and was_restarted,
        )

    def _predict(self, scan: Scan) -> tuple[F64, float, F64 | None]:
        """Motion since the last scan, over how many seconds, and the odometry that it rests on, if any.

        The odometry spans the scans that had none: where those were put was a guess, and what is built on
        a guess is lost for good. Only for such a scan itself is the motion before all there is.
        """
        if self._last is None:
            return np.eye(4), 0.0, None
        seconds = (scan.stamp_ns - self._last.stamp_ns) * 1e-9
        if scan.T_odom_base is None or self._measured is None:
            return self._steady_motion(seconds), seconds, None
        T_odom_then, T_map_then = self._measured
        odometry: F64 = invert_pose(T_odom_then) @ scan.T_odom_base
        if self._last.T_odom_base is not None:
            return odometry, seconds, odometry
        return invert_pose(self._last_pose) @ T_map_then @ odometry, seconds, odometry

    def _examine(
        self, scan: Scan, motion: F64, seconds: float, odometry: F64
    ) -> tuple[F64, F64 | None, bool]:
        """Motion, odometry and whether to believe in either, for odometry that a restarted driver may have
        begun anew: it counts only if the scan fits where it leads, and better than where the robot was."""
        points = self._usable(scan, np.eye(4), 0.0)
        upright = SE2.flatten(self._last_pose)
        sweep = self._flatten(points, scan, upright.inverse().lift() @ self._last_pose)
        hits, face = sweep.hits_m, facing(sweep.hits_m, sweep.origin_m)
        fits = []
        for moved, measured in ((motion, odometry), (self._steady_motion(seconds), None)):
            guess = SE2.flatten(self._last_pose @ moved)
            match = self._maps[0][0].match(hits, face, guess, guess, np.zeros((3, 3)))
            if match.overlap > _SURE_OVERLAP and match.residual_m < _MAX_RESIDUAL_M:
                fits.append((match.overlap - 5.0 * match.residual_m, moved, measured))
        if not fits:
            return motion, odometry, False
        _, moved, measured = max(fits, key=lambda fit: fit[0])
        return moved, measured, True

    def _steady_motion(self, seconds: float) -> F64:
        """The motion before, if it goes on for so long.

        Over two scans where they follow closely: the motion undoes the skew of the next scan, and an error
        of one pose, taken for motion, would come back in the next pose with the other sign, and grow.
        """
        now_ns, T_map_now = self._recent[-1]
        for stamp_ns, T_map_then in self._recent[:-1]:
            span = (now_ns - stamp_ns) * 1e-9
            if span < _STEADY_S or stamp_ns == self._recent[-2][0]:
                return interpolate_pose(
                    np.eye(4), invert_pose(T_map_then) @ T_map_now, min(seconds / span, 1.0)
                )
        return np.eye(4)

    def _usable(self, scan: Scan, motion: F64, motion_s: float) -> F32:
        points, offsets = scan.points_m, scan.offsets_s
        away = points - scan.T_base_sensor[:3, 3].astype(np.float32)
        keep = np.flatnonzero(np.einsum("ij,ij->i", away, away) >= self._config.min_range_m**2)
        keep = keep[thin(keep, _MAX_POINTS)]
        if len(keep) < len(points):
            points, offsets = points[keep], None if offsets is None else offsets[keep]
        if offsets is not None and self._config.deskew:
            points = deskew(points, offsets, motion, motion_s)
        return points

    def _follow_ground(self, points: F32, scan: Scan, motion: F64) -> None:
        """Where the floor is now: fixed to a robot that rolls on it, else where the motion has taken it."""
        if self._ground is None:
            return
        if self._rolling:
            # A floor that is fixed to the robot need not be looked for in every scan.
            self._scans += 1
            if self._scans % _ROLLING_EVERY:
                return
        expected = self._ground if self._rolling else self._ground.moved(invert_pose(motion))
        found = find_ground(points, scan.T_base_sensor[:3, 3], expected)
        gain = _ROLLING_GAIN if self._rolling else _CARRIED_GAIN
        self._ground = expected if found is None else expected.toward(found, gain)

    def _without_floor(self, points: F32) -> F32:
        """What KISS-ICP gets."""
        if self._ground is None or not len(points) or not self._rolling:
            return points  # in the hand, the floor is what holds tilt and height
        points = points[thin(points, _ICP_POINTS)]
        heights = self._ground.heights(points)
        slack = 0.1 + 0.01 * np.hypot(points[:, 0], points[:, 1])
        keep = heights > slack
        if self._ground.ceiling_m is not None:
            keep &= heights < self._ground.ceiling_m - slack
        return points[keep] if keep.sum() > 100 else points

    def _hold_to_floor(self, pose: F64) -> F64:
        """Tilt and height from the floor: walls alone let them drift."""
        heading = SE2.flatten(pose).lift()
        if self._ground is None:
            return heading
        if not self._rolling:
            return pose
        held: F64 = heading @ self._ground.leveling()
        # Levelling turns the shortest way; the heading must survive it.
        held[:3, :3] = (
            SE2(0.0, 0.0, SE2.flatten(pose).yaw - SE2.flatten(held).yaw).lift()[:3, :3] @ held[:3, :3]
        )
        return held

    def _flatten(self, points: F32, scan: Scan, T_level_base: F64) -> Sweep:
        level, sensor, ground = points, scan.T_base_sensor[:3, 3], None
        if self._ground is not None:
            R = T_level_base.copy()
            R[:3, 3] = 0.0  # the sweep keeps the base's own origin; heights come from the ground
            level = points @ R[:3, :3].T.astype(np.float32)
            sensor = R[:3, :3] @ sensor
            ground = self._ground.moved(R)
        return flatten(
            level,
            stamp_ns=scan.stamp_ns,
            sensor_m=sensor,
            ground=ground,
            config=self._projection,
            sensor=scan.sensor,
        )

    def _refine(
        self, sweep: Sweep, guess: SE2, predicted: F64, odometry: F64 | None
    ) -> tuple[SE2, Match | None]:
        if len(sweep.hits_m) < _MIN_HITS:
            return SE2.flatten(predicted), None
        prior = guess if odometry is None else SE2.flatten(predicted)
        if odometry is not None:
            information = self._odometry.information(odometry)
        else:
            information = np.diag([0.03**-2, 0.03**-2, 0.01**-2])
        grid = self._maps[0][0]
        chosen = evenly(len(sweep.hits_m), _MATCHED_HITS)
        hits, face = sweep.hits_m[chosen], facing(sweep.hits_m, sweep.origin_m)[chosen]
        match = grid.match(hits, face, guess, prior, information)
        apart = SE2.flatten(predicted).inverse() @ guess
        if math.hypot(apart.x, apart.y) > _DISAGREE_M or abs(apart.yaw) > _DISAGREE_RAD:
            # KISS-ICP and the prediction differ: let each lead the refinement, and the walls decide.
            other = grid.match(hits, face, SE2.flatten(predicted), prior, information)
            match = max(match, other, key=lambda m: m.overlap - 5.0 * m.residual_m)
        return (match.pose if match.overlap >= _MIN_OVERLAP else prior), match

    def _judge(self, match: Match | None, measured: bool) -> Health:
        """What the match against the local map is worth.

        A scan that shows too little is bridged by odometry for a while (DEGENERATE); one that does not fit,
        without odometry or for too long, is LOST.
        """
        floor = _MIN_OVERLAP if self._rolling else _MIN_OVERLAP_CARRIED
        if match is None or match.overlap < floor or match.residual_m > _MAX_RESIDUAL_M:
            self._poor_scans += 1
            lost = not measured or self._poor_scans > _BRIDGED_SCANS
            self._lost_scans += lost
            return Health.LOST if lost else Health.DEGENERATE
        self._poor_scans = self._lost_scans = 0
        J = match.information
        across = J[:2, :2] - np.outer(J[:2, 2], J[2, :2]) / max(J[2, 2], 1e-9)
        weakest = float(np.linalg.eigvalsh(across)[0])
        return Health.FINE if weakest > _MAX_SIGMA_M**-2 else Health.DEGENERATE

    def _extend_maps(self, sweep: Sweep, pose: SE2) -> bool:
        """Two overlapping local maps: the older one is matched against, the younger takes over in time.

        Returns whether the scan became part of them: a robot that stands still adds nothing.
        """
        last = self._last_keyframe
        if last is not None:
            step = last.inverse() @ pose
            if math.hypot(step.x, step.y) < KEYFRAME_TRAVEL_M and abs(step.yaw) < KEYFRAME_TURN_RAD:
                return False
            self._travel_m += math.hypot(step.x, step.y)
        if not self._maps or self._travel_m - self._maps[-1][1] > LOCAL_MAP_TRAVEL_M:
            half = self._projection.max_range_m + 2 * LOCAL_MAP_TRAVEL_M
            self._maps.append(
                (PointGrid((pose.x - half, pose.y - half), (pose.x + half, pose.y + half)), self._travel_m)
            )
        if len(self._maps) > 2:
            del self._maps[0]
        hits, face = pose.apply(sweep.hits_m), facing(sweep.hits_m, sweep.origin_m) + pose.yaw
        for grid, _ in self._maps:
            grid.add(hits, face)
        self._last_keyframe = pose
        return True


def _ground_at_start(points: F32, T_base_sensor: F64) -> Ground:
    """Near where the mounting puts it, else the lowest level plane, else assumed."""
    sensor = T_base_sensor[:3, 3]
    assumed = assumed_ground(T_base_sensor)
    mounted = find_ground(points, sensor, assumed) if assumed.offset_m == 0.0 else None
    return mounted or find_ground(points, sensor) or assumed


def _motion_within(scan: Scan, motion: F64, motion_s: float, trusted: bool) -> tuple[F64, float]:
    """How the base moves while the scan is taken, and in how many seconds.

    By odometry if that is to be trusted, for a turn begins and ends within a scan; else as it moved before.
    """
    if trusted and scan.T_first_last is not None and scan.offsets_s is not None:
        seconds = float(scan.offsets_s.max() - scan.offsets_s.min())
        if not _is_odd(scan.T_first_last, seconds):
            return scan.T_first_last, seconds
    return motion, motion_s


def _is_odd(odometry: F64, seconds: float) -> bool:
    """Whether odometry passes over a gap, or claims what no robot indoors can do."""
    distance, turn = float(np.linalg.norm(odometry[:3, 3])), float(np.linalg.norm(rotation_vector(odometry)))
    return seconds > _GAP_S or distance > 0.2 + _FASTEST_MPS * seconds or turn > 0.3 + _FASTEST_RPS * seconds


def _rolls(scan: Scan) -> bool:
    """Whether the base stays upright: its odometry is planar, or without odometry it carries the sensor."""
    T = scan.T_odom_base
    if T is None:
        return float(scan.T_base_sensor[2, 3]) > 0.05
    return abs(float(T[2, 3])) < 1e-3 and float(T[2, 2]) > 1.0 - 1e-6
