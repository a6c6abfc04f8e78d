"""Tracking from scan to scan: prediction, KISS-ICP, refinement in the plane, health.

Each source counts by what it measures. Odometry knows the motion to a few percent in every direction. A
scan knows the pose to millimetres, but only across the walls that it sees. So KISS-ICP brings the scan near,
and point-to-line Gauss-Newton against the local map, with the odometry as a prior, determines the pose:
along a corridor by the prior, across it by the walls.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.clouds.depth_limit import DepthLimit
from pc2grid.clouds.deskew import deskew
from pc2grid.clouds.planar_scan import PlanarScan, project_to_plane
from pc2grid.clouds.sampling import random_subset
from pc2grid.config import ProjectionConfig, RegistrationConfig
from pc2grid.geometry import SE2, invert_pose
from pc2grid.model import Health, RegisteredScan, Scan, Storey
from pc2grid.odometry.carried import CarriedSensor, first_pose
from pc2grid.odometry.ground_model import DECIDING_SCANS, GroundModel, is_rolling
from pc2grid.odometry.health import HealthJudge
from pc2grid.odometry.matching_maps import MatchingMaps
from pc2grid.odometry.motion_model import MotionModel, Prediction, not_credible
from pc2grid.odometry.overruled import Disagreement
from pc2grid.odometry.parameters import (
    CAMERA_MATCHING,
    MATCHING_PARAMETERS,
    TRACKING_PARAMETERS,
    TrackingParameters,
)
from pc2grid.odometry.point_to_line import Match
from pc2grid.odometry.registration import KissRegistration
from pc2grid.odometry.rides import Ride, RideWatch
from pc2grid.sensor_model import SENSOR_MODELS


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """The result of tracking one scan.

    registered : the scan, deskewed, with its pose and health.
    planar_scan : the scan reduced to the plane.
    keyframe : whether the robot had moved enough for the scan to become part of the local map.
    restart : the first keyframe after tracking was lost: its pose relative to those before is unknown.
    disagreement : of odometry with the pose; None for a lost scan, and where there is nothing to compare.
    mapped : the scan may become part of the map. riding : on the way to another floor: the scan belongs to
    none, see `Ride`. arrived : the first scan after a ride to another floor. storey : number of the floor,
    see `Tracker.storeys`.
    """

    registered: RegisteredScan
    planar_scan: PlanarScan
    keyframe: bool
    restart: bool = False
    disagreement: Disagreement | None = None
    mapped: bool = True
    riding: bool = False
    arrived: bool = False
    storey: int = 0


class Tracker:
    """Turns scans into poses and planar scans, one by one. Its memory is the size of two local maps.

    The session frame is the base at the first scan, levelled: z up.
    """

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig | None = None,
        parameters: TrackingParameters = TRACKING_PARAMETERS,
    ) -> None:
        self._config = registration
        self._projection = projection or ProjectionConfig()
        self._parameters = parameters
        self._first: Scan | None = None
        self._scans = 0  # since the first one
        self._motion = MotionModel(parameters)
        self._rides = RideWatch()
        self._restarted = False  # no keyframe has been reported since tracking started again
        # These depend on the sensor and on how it is carried; `start` makes them from the first scan.
        self._ground = GroundModel(None, rolling=True, parameters=parameters)
        self._maps = MatchingMaps(self._projection.max_range_m, parameters)
        self._camera_on_wheels = False
        self._carried: CarriedSensor | None = None  # None on wheels
        self._depth_limit = DepthLimit()
        self._health = HealthJudge(parameters)
        self.kiss = KissRegistration(registration, parameters=parameters)

    @property
    def storeys(self) -> tuple[Storey, ...]:
        """The floors so far, in the order in which they were first reached."""
        return tuple(self._rides.storeys)

    @property
    def carried(self) -> bool:
        """Whether the sensor is in the hand, so that tilts and heights say nothing of a slope."""
        return not self._ground.rolling

    def start(self, scan: Scan) -> Tracked:
        """Begin with the first scan: find the floor, and put the base at the origin of the session frame."""
        self._first, self._scans = scan, 0
        return self._begin(scan, SE2(), rolling=is_rolling(scan))

    def _begin(self, scan: Scan, at: SE2, *, rolling: bool) -> Tracked:
        """Begin with a scan whose base is at a place of the session frame, on wheels or in the hand."""
        points = self._deskewed(scan, *self._motion.within(scan, None))
        self._ground = GroundModel.start(points, scan, self._parameters, rolling=rolling)
        narrow = SENSOR_MODELS[scan.sensor].narrow
        self._camera_on_wheels = narrow and self._ground.rolling
        self._maps = MatchingMaps(
            self._projection.max_range_m,
            self._parameters,
            CAMERA_MATCHING if self._camera_on_wheels else MATCHING_PARAMETERS,
        )
        self._health = HealthJudge(self._parameters)
        self.kiss = self._new_kiss()
        self._carried = None
        if not self._ground.rolling:
            self._carried = CarriedSensor(self._projection)
            pose = at.lift() @ first_pose(scan, points)
            self._carried.place(scan, points, pose, Prediction(motion=np.eye(4), seconds=0.0))
            return self._finish_carried(scan, points, pose, Health.FINE)
        pose = at.lift() @ self._ground.start_pose()
        self._register(points, pose, Prediction(motion=np.eye(4), seconds=0.0))
        planar_scan = self._project(points, scan, _split(pose)[1])
        return self._finish(scan, points, planar_scan, pose, Health.FINE)

    def track(self, scan: Scan) -> Tracked:
        """Track the next scan; stamps must increase."""
        if self._first is None:
            return self.start(scan)
        # 1. Predict the motion, by odometry or as it was before. Implausible odometry is tested on the map.
        prediction = self._motion.predict(scan)
        self._scans += 1
        if self._ground.rolling and self._scans < DECIDING_SCANS and not is_rolling(scan, self._first):
            at = SE2.from_matrix(self._motion.last_pose @ prediction.motion)
            return self._begin(scan, at, rolling=False)
        if self._carried is not None and not self._motion.is_plausible(prediction):
            prediction = self._motion.continued(prediction.seconds)
        elif self._maps and not self._motion.is_plausible(prediction):
            prediction = self._examine(scan, prediction)
            self._motion.forget_window()
        if self._carried is not None:
            return self._track_carried(scan, prediction)
        last_pose = self._motion.last_pose
        predicted = SE2.from_matrix(last_pose @ prediction.motion)
        # 2. Undo the motion within the scan.
        points = self._deskewed(scan, *self._motion.within(scan, prediction))
        # 3. Follow a floor that is fixed to the robot: KISS-ICP is not given its points.
        self._ground.follow_fixed(points, scan)
        # 4. Let KISS-ICP bring the scan near, in space.
        pose = self._register(points, last_pose, prediction)
        planar, T_level_base = _split(self._ground.hold(pose))
        # 5. Reduce the scan to the plane.
        planar_scan = self._project(points, scan, T_level_base)
        # 6. Refine the pose in the plane.
        health = Health.FINE
        if self._maps:
            planar, match = self._refine(planar_scan, planar, predicted, prediction)
            # 7. Judge the pose.
            health = self._health.judge(match, prediction.odometry is not None)
        if not prediction.credible:
            health = Health.LOST
        # 8. Start again if nothing fits any more, else extend the local maps.
        if not prediction.credible or self._health.gives_up:
            self._restart()
        return self._finish(scan, points, planar_scan, planar.lift() @ T_level_base, health, prediction)

    def _track_carried(self, scan: Scan, prediction: Prediction) -> Tracked:
        """Track the next scan of a sensor in the hand, in space."""
        assert self._carried is not None
        points = self._deskewed(scan, *self._motion.within(scan, prediction))
        placed = self._carried.place(scan, points, self._motion.last_pose, prediction)
        health = self._health.judge(placed, prediction.odometry is not None)
        if self._health.gives_up:
            self._restart()
        return self._finish_carried(scan, points, placed.pose, health, prediction)

    def _finish_carried(
        self, scan: Scan, points: F32, pose: F64, health: Health, prediction: Prediction | None = None
    ) -> Tracked:
        """Extend the maps in space by a scan, cut its planar scan, and remember its pose."""
        assert self._carried is not None
        if health is not Health.LOST:
            self._carried.extend(scan, points, pose)
        planar_scan = self._carried.cut(scan, pose)
        return self._finish(scan, points, planar_scan, pose, health, prediction)

    def _finish(
        self,
        scan: Scan,
        points: F32,
        planar_scan: PlanarScan,
        pose: F64,
        health: Health,
        prediction: Prediction | None = None,
    ) -> Tracked:
        """Extend the maps by a scan if it is worth it, and remember its final pose."""
        ride = self._ride(scan, points, planar_scan, pose, prediction)
        if ride.arrived:
            self._restart()
        extended = (
            health is not Health.LOST
            and len(planar_scan.hits_m) > 0
            and self._maps.extend(planar_scan, SE2.from_matrix(pose))
        )
        if extended and self._carried is None:
            self.kiss.update_map(pose)
        mapped = not (ride.riding or ride.tilting)
        keyframe = extended and mapped
        restart = keyframe and self._restarted
        self._restarted &= not keyframe
        disagreement = None
        if prediction is not None and health is not Health.LOST:
            disagreement = self._motion.disagreement(prediction, pose)
        self._motion.observe(scan, pose, sure=health is Health.FINE)
        if health is Health.FINE and disagreement is not None and disagreement.overrules:
            health = Health.OVERRULED
        deskewed = dataclasses.replace(scan, points_m=points, offsets_s=None)
        return Tracked(
            registered=RegisteredScan(scan=deskewed, T_session_base=pose, health=health),
            planar_scan=planar_scan,
            keyframe=keyframe,
            restart=restart,
            disagreement=disagreement,
            mapped=mapped,
            riding=ride.riding,
            arrived=ride.arrived,
            storey=self._rides.storey,
        )

    def _ride(
        self, scan: Scan, points: F32, planar_scan: PlanarScan, pose: F64, prediction: Prediction | None
    ) -> Ride:
        """Look whether the robot leaves its floor. A sensor in the hand tilts as it likes.

        The travel is that of the wheels where they are known: tracking in the plane errs on stairs.
        """
        if not self._ground.rolling:
            return Ride()
        step = invert_pose(self._motion.last_pose) @ pose
        if prediction is not None and prediction.odometry is not None and prediction.credible:
            step = prediction.motion
        return self._rides.observe(scan, points, planar_scan, pose, float(step[0, 3]), self._ground.ground)

    def _restart(self) -> None:
        """Forget the local maps, of the plane and of KISS-ICP; the poses go on from the last one."""
        self._maps.restart()
        self._motion.heading_variance = 0.0  # the next local map has the heading of the last pose
        self._health.restart()
        self.kiss = self._new_kiss()
        if self._carried is not None:
            self._carried.restart()
        self._restarted = True

    def _register(self, points: F32, last_pose: F64, prediction: Prediction) -> F64:
        """The pose (4, 4) in space of the points (N, 3) of a scan after the last pose (4, 4)."""
        kept = self._ground.remove(points)
        return self.kiss.register(kept, last_pose, prediction.motion, prediction.seconds)

    def _search_window(self, prediction: Prediction) -> tuple[float, float] | None:
        """How far (m, rad) a scan is searched for around the predicted pose; None if little is open."""
        p = self._parameters
        window_m, window_rad = self._motion.search_window(prediction)
        if window_m > p.search_above_m or window_rad > p.search_above_rad:
            return window_m, window_rad
        return None

    def _is_sure(self, match: Match) -> bool:
        """Whether a placement alone decides between odometry and the motion before."""
        p = self._parameters
        return match.overlap >= p.sure_overlap and match.residual_m <= p.max_residual_m

    def _new_kiss(self) -> KissRegistration:
        return KissRegistration(self._config, parameters=self._parameters)

    def _examine(self, scan: Scan, prediction: Prediction) -> Prediction:
        """Decide on odometry that a restarted driver may have started again.

        It counts only if the scan fits where it leads, and better than where the motion before leads.
        """
        points = self._deskewed(scan, np.eye(4), 0.0)
        planar_scan = self._project(points, scan, _split(self._motion.last_pose)[1])
        best, best_quality = not_credible(prediction), -math.inf
        for candidate in (prediction, self._motion.continued(prediction.seconds)):
            match = self._maps.fit(planar_scan, SE2.from_matrix(self._motion.last_pose @ candidate.motion))
            fits = (
                match.overlap > self._parameters.sure_overlap
                and match.residual_m < self._parameters.max_residual_m
            )
            if fits and self._maps.quality(match) > best_quality:
                best, best_quality = candidate, self._maps.quality(match)
        return best

    def _deskewed(self, scan: Scan, motion: F64, motion_s: float) -> F32:
        """Return the points (N, 3) of a scan that are used, without the motion (4, 4) over `motion_s`."""
        points, offsets = scan.points_m, scan.offsets_s
        away = points - scan.T_base_sensor[:3, 3].astype(np.float32)
        keep = np.flatnonzero(np.einsum("ij,ij->i", away, away) >= self._config.min_range_m**2)
        keep = keep[random_subset(len(keep), self._parameters.max_points)]
        if len(keep) < len(points):
            points, offsets = points[keep], None if offsets is None else offsets[keep]
        if offsets is not None and self._config.deskew:
            points = deskew(points, offsets, motion, motion_s)
        return points

    def _project(self, points: F32, scan: Scan, T_level_base: F64) -> PlanarScan:
        """Reduce points (N, 3) of the base frame to the plane."""
        if SENSOR_MODELS[scan.sensor].noise_per_m2:
            self._depth_limit.observe(points, scan.T_base_sensor)
        sensor_m, ground = scan.T_base_sensor[:3, 3], self._ground.ground
        if ground is not None:
            R = T_level_base.copy()
            R[:3, 3] = 0.0  # a planar scan keeps the base's own origin; heights are relative to the ground
            points = points @ R[:3, :3].T.astype(np.float32)
            sensor_m, ground = R[:3, :3] @ sensor_m, ground.moved(R)
        planar_scan = project_to_plane(
            points,
            stamp_ns=scan.stamp_ns,
            sensor_m=sensor_m,
            ground=ground,
            config=self._projection,
            sensor=scan.sensor,
        )
        if not SENSOR_MODELS[scan.sensor].noise_per_m2:
            return planar_scan
        return self._depth_limit.before(planar_scan, T_level_base @ scan.T_base_sensor)

    def _refine(
        self, planar_scan: PlanarScan, guess: SE2, predicted: SE2, prediction: Prediction
    ) -> tuple[SE2, Match | None]:
        """Match a planar scan with the local map, from KISS-ICP's pose `guess`.

        The prior is the predicted pose if that rests on odometry, else the guess. Where the two disagree
        both start a refinement, and the better match is taken. For a camera on wheels the prior is always
        the predicted pose, without odometry as the motion before continues it, and the guess counts only if
        the scan does not fit there: KISS-ICP, which knows a quarter of the surroundings, slides along walls,
        by up to half a metre a scan, where a scan fits as well.
        """
        p = self._parameters
        prior = guess if prediction.odometry is None else predicted
        information = self._motion.information(prediction)
        punctual = self._motion.information_if_punctual(prediction)
        if self._camera_on_wheels:
            prior = predicted
            if prediction.odometry is None:
                information = self._motion.information_on_continued(prediction)
            else:
                information = self._motion.with_heading(information)
                punctual = None if punctual is None else self._motion.with_heading(punctual)
            match = self._match(planar_scan, [predicted], prior, information, punctual)
            if match is not None:
                match = self._without_leap(match, planar_scan, predicted, information, prediction)
            self._motion.observe_heading(information + (0.0 if match is None else match.information))
            if match is not None and self._is_sure(match):
                return match.pose, match
        guesses = [guess]
        apart = predicted.inverse() @ guess
        if math.hypot(apart.x, apart.y) > p.disagree_m or abs(apart.yaw) > p.disagree_rad:
            guesses.append(predicted)
        if prediction.windowed is not None and any(self._motion.owed(prediction)):
            guesses.append(SE2.from_matrix(self._motion.last_pose @ prediction.windowed))
        match = self._match(planar_scan, guesses, prior, information, punctual)
        if match is None:
            return predicted, None
        if not self._is_sure(match):
            window = self._search_window(prediction)
            if window is not None:
                found = self._maps.search(planar_scan, predicted, *window)
                searched = self._maps.refine(planar_scan, found, prior, information) if found else None
                if searched is not None and self._maps.quality(searched) > self._maps.quality(match):
                    match = searched
        return (match.pose if match.overlap >= p.min_overlap else prior), match

    def _without_leap(
        self, match: Match, planar_scan: PlanarScan, predicted: SE2, information: F64, prediction: Prediction
    ) -> Match:
        """The match or, if it leaps where the scan measures least, one at the predicted position there.

        Along a wall a scan may seem to fit half a metre off. With odometry that counts only if it fits better
        there. Without, it never counts: as the motion before continues, a single leap would go on for many
        scans.
        """
        held = match.held_along_weakest(predicted)
        leap_m = math.hypot(held.pose.x - match.pose.x, held.pose.y - match.pose.y)
        if leap_m <= self._motion.leap_m(information):
            return match
        if prediction.odometry is None:
            return held
        firm = self._maps.refine(planar_scan, [held.pose], predicted, self._parameters.firm * information)
        return match if firm is None else max(firm, match, key=self._maps.quality)

    def _match(
        self,
        planar_scan: PlanarScan,
        guesses: list[SE2],
        prior: SE2,
        information: F64,
        punctual: F64 | None,
    ) -> Match | None:
        """Match a planar scan from some guesses, held to a prior by its information (3, 3).

        Against odometry that owes a motion, only a scan decides that measures the position better than
        odometry would if it owed none, which is `punctual` (3, 3). A direction that the scan does not measure
        at all, such as along a corridor, is that of the prior.
        """
        match = self._maps.refine(planar_scan, guesses, prior, information)
        if match is None or punctual is None:
            return match
        if not match.measured:
            return match.held_along_weakest(prior)
        if match.measures_more_than(punctual):
            return match
        return self._maps.refine(planar_scan, [prior], prior, punctual)


def _split(pose: F64) -> tuple[SE2, F64]:
    """Split a pose (4, 4) T_session_base into its planar part and T_level_base (4, 4), tilt and height."""
    planar = SE2.from_matrix(pose)
    return planar, planar.inverse().lift() @ pose
