"""Tracking from scan to scan: predict, match, smooth, judge.

Each source counts by its information. Odometry measures the motion to a few percent in every direction. A
scan fixes the pose to millimetres, but only across the surfaces that it shows. A matcher (`PlanarMatcher` on
wheels, `SpatialMatcher` in the hand) matches the scan by itself; the smoother fuses that with odometry and
with the scans before. The result is judged by the fit of the scan with the local map.

The selection of a match (`place`) is the same with three and with six degrees of freedom. KISS-ICP
brings the scan near from each expected pose, and the matches begin there. If none fits, the scan is searched
for. The posterior density of a match is the product of the likelihood of the scan and of the density of the
expected pose. The best match is taken. Its covariance is widened by the spread of all matches: where two
places fit alike, neither is known.

`Odometer` compares odometry with the scans. Wheels slip, and odometry of real robots comes late, bunched or
repeated. The scans then show another motion, and tracking follows them: the poses are right, and the user is
warned of where and how often odometry was an outlier (`check_odometry`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, pairwise

import numpy as np

from pc2grid.clouds.cloud import deskew, random_subset
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.line_map import TRACKING, steps, weakest
from pc2grid.estimation.planar import PlanarMatcher
from pc2grid.estimation.smoother import (
    IN_THE_HAND,
    KERNEL,
    SMOOTHER,
    Measurement,
    PoseWithCovariance,
    ScanMatch,
    Smoother,
)
from pc2grid.estimation.spatial import SpatialMatcher, begin
from pc2grid.geometry import F32, F64, SE2, invert_pose, motion_size
from pc2grid.libraries import one_blas_thread_each
from pc2grid.model import MOST_LISTED, Health, OdometryCheck, OdometryOutlier, RegisteredScan, Scan
from pc2grid.observer import Observer
from pc2grid.settings import Config, ProjectionConfig, RegistrationConfig

ScanMatcher = PlanarMatcher | SpatialMatcher
"""Matches the scans of a session, one after another, with a local map."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """The result of tracking one scan.

    registered : the scan, deskewed, with its pose and health.
    planar_scan : the scan reduced to the plane.
    keyframe : True if the robot had moved enough for the scan to become part of the local map.
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
    """Tracks scans one by one: returns their poses and planar scans. Its memory is the size of two local
    maps.

    The session frame is the base at the first scan, levelled: z up.
    """

    def __init__(
        self,
        registration: RegistrationConfig,
        projection: ProjectionConfig = ProjectionConfig(),
        *,
        in_hand: bool,
    ) -> None:
        """Make a tracker. in_hand : see `pc2grid.estimation.spatial.begin`, which decides it."""
        self._config = registration
        self._last: Scan | None = None
        self._keyframe: SE2 | None = None  # where the last one was
        self._restarted = False  # no keyframe has been reported since tracking started again
        self._walls_changed = False  # why
        self._standstill = Standstill()
        self._in_hand = in_hand
        self._sensor: ScanMatcher = (
            SpatialMatcher(registration, projection) if in_hand else PlanarMatcher(registration, projection)
        )
        self._smoother = Smoother(self._sensor.free, IN_THE_HAND if in_hand else SMOOTHER)
        self._lost_scans = 0  # in a row

    def start(self, scan: Scan) -> Tracked:
        """Begin with the first scan: find the floor, and put the base at the origin of the session frame."""
        self._odometer = Odometer(scan.stamp_ns)
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
        # 1. Predict: by odometry, or by constant velocity. An implausible prediction comes last.
        turn, before = None, self._last.T_level_base
        if self._in_hand and reading is None and before is not None and scan.T_level_base is not None:
            turn = invert_pose(before) @ scan.T_level_base  # by its IMU
        steady = self._smoother.constant_velocity(seconds, turn)
        predictions = [partial(self._smoother.after, *steady)]
        if reading is not None and reported is not None:
            predictions.insert(0 if continues else 1, partial(self._smoother.by_odometry, reading))
        expected = (predict() for predict in predictions)  # the second only where it is needed
        first = next(expected)
        # 2. Undo the motion within the scan.
        motion = invert_pose(self._smoother.belief.pose) @ first.pose
        points = self._deskewed(scan, motion, seconds)
        # 3. Place the scan by itself, and weigh that against odometry and the scans before.
        placed = place(self._sensor, scan, points, first, expected)
        between = placed.motion if turn is None else (steady[0], np.diag(steady[1] ** -2))
        if placed.first:  # a new local map has no tie to the one before
            self._smoother.start(self._flat(placed.pose), reading, self._smoother.speed)
            estimate = self._smoother.belief
        else:
            estimate = self._smoother.add(placed.pose, seconds, reading, continues, placed.alone, between)
        # 4. Judge the pose, and start again if nothing fits any more.
        health = self._judged(scan, placed, estimate, first, continues=continues)
        pose = self._sensor.levelled(estimate.pose)
        tracked = self._finish(scan, points, pose, health)
        if self._lost_scans > TRACKING.give_up_scans:
            # Forget the local maps; the poses continue from the last one.
            self._sensor.restart()
            self._lost_scans, self._keyframe, self._restarted = 0, None, True
        return tracked

    def _judged(
        self,
        scan: Scan,
        placed: MatchedScan,
        estimate: PoseWithCovariance,
        expected: PoseWithCovariance,
        *,
        continues: bool,
    ) -> Health:
        """Judge a scan by its match, and count the lost ones in a row.

        A scan that fits is FINE; DEGENERATE if one direction of its position is not determined; LOST if a
        direction of its pose is not known. One that does not fit is also DEGENERATE if odometry gives its
        pose from a scan that was not lost; else LOST. So is one before which the walls have changed.
        """
        if self._walls_have_changed(scan, placed, expected):
            self._walls_changed, self._lost_scans = True, TRACKING.give_up_scans + 1
            return Health.LOST
        fits = placed.first or placed.alone is not None
        if fits and self._is_known(scan, estimate):
            self._lost_scans = 0
            return Health.FINE if placed.measured else Health.DEGENERATE
        bridged = placed.motion is not None or (scan.T_odom_base is not None and continues)
        if bridged and not self._lost_scans:
            return Health.DEGENERATE
        # A pose that fits anywhere along a wall does not become known by waiting.
        self._lost_scans += TRACKING.give_up_scans + 1 if fits else 1
        return Health.LOST

    def _walls_have_changed(self, scan: Scan, placed: MatchedScan, expected: PoseWithCovariance) -> bool:
        """Return True if a scan fits only the scans before it, which fix its position."""
        if not self._standstill.left(scan, sure=placed.sure):
            return False
        before = self._sensor.follow(expected)
        return before is not None and weakest(before[1]) > TRACKING.known_m**-2

    def _is_known(self, scan: Scan, estimate: PoseWithCovariance) -> bool:
        """Return True if no direction of a pose may slide: wheels do not along a wall, nor does odometry."""
        if not self._in_hand or scan.T_odom_base is not None:
            return True
        sigma_m, sigma_rad = estimate.sigmas
        return sigma_m <= TRACKING.known_m and sigma_rad <= TRACKING.known_rad

    def _finish(self, scan: Scan, points: F32, pose: F64, health: Health) -> Tracked:
        """Extend the maps by a scan that is due, and keep its final pose."""
        lost = health is Health.LOST
        planar_scan = self._sensor.cut(scan, points, pose, lost=lost)
        keyframe = not lost and len(planar_scan.hits_m) > 0 and self._is_due(pose)
        restart = keyframe and self._restarted
        walls_changed = restart and self._walls_changed
        if keyframe:
            self._keyframe = SE2.from_matrix(pose)
            self._sensor.extend(scan, points, pose)
            self._restarted = self._walls_changed = False
        found = None if lost else self._odometer.disagreement(scan, pose)
        if health is Health.FINE and found is not None and found.is_outlier:
            health = Health.OVERRULED
        self._last = scan
        self._odometer.remember(scan, pose)
        deskewed = replace(scan, points_m=points, offsets_s=None)
        return Tracked(
            registered=RegisteredScan(scan=deskewed, T_session_base=pose, health=health),
            planar_scan=planar_scan,
            keyframe=keyframe,
            restart=restart,
            walls_changed=walls_changed,
            disagreement=found,
        )

    def _is_due(self, pose: F64) -> bool:
        """Return True if the base has moved enough since the last keyframe for another one."""
        if self._keyframe is None:
            return True
        p, step = TRACKING, self._keyframe.inverse() @ SE2.from_matrix(pose)
        return math.hypot(step.x, step.y) >= p.keyframe_travel_m or abs(step.yaw) >= p.keyframe_turn_rad

    def _flat(self, pose: F64) -> F64:
        """Return a pose (4, 4) in the free directions: on wheels those of the plane."""
        return pose if self._in_hand else SE2.from_matrix(pose).lift()

    def _reading(self, scan: Scan) -> F64 | None:
        """Return the reading (4, 4) of odometry at a scan, or None."""
        return None if scan.T_odom_base is None else self._flat(scan.T_odom_base)

    def _deskewed(self, scan: Scan, motion: F64, seconds: float) -> F32:
        """Return the points (N, 3) of a scan that are used, without the motion while it was taken.

        motion : (4, 4) expected since the scan before, `seconds` ago. It is used only if odometry does not
        cover the time of the scan itself, since a turn begins and ends within a scan.
        """
        away = scan.points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        keep = np.flatnonzero(np.einsum("ij,ij->i", away, away) >= self._config.min_range_m**2)
        keep = keep[random_subset(len(keep), TRACKING.max_points)]
        points = scan.points_m[keep]
        if scan.offsets_s is None or not self._config.deskew or not len(points):
            return points
        offsets = scan.offsets_s[keep]
        span_s = float(np.ptp(offsets))
        if scan.T_first_last is not None and self._odometer.is_possible(scan.T_first_last, span_s):
            within = scan.T_first_last.copy()
            if scan.T_odom_base is None:  # an IMU measures the rotation alone
                within[:3, 3] = motion[:3, 3] * span_s / seconds
            motion, seconds = within, span_s
        return deskew(points, offsets, motion, seconds)


# --- the most probable of several matches --------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MatchedScan:
    """The selected match of a scan with the local map.

    pose : (4, 4) initial T_session_base for the smoother. alone : as of `ScanMatch`; None if the scan fits
    nowhere. motion : T_last_now, if the scan shows new ground and fits only the scans before.
    sure : True if it fits the map well. measured : True if its points fix every direction of the position.
    first : True if there is no local map yet, nor any since tracking started again: then the pose is measured
    by definition.
    """

    pose: F64
    alone: Measurement | None = None
    motion: Measurement | None = None
    sure: bool = False
    measured: bool = False
    first: bool = False


@dataclass(frozen=True, slots=True, order=True)
class _Candidate:
    """A match with the logarithm of its posterior density, but for a constant.

    sure : True if the scan fits well there. near : True if it lies at an expected pose, False if it was
    searched for.
    """

    score: float
    fit: ScanMatch = field(compare=False)
    sure: bool = field(compare=False)
    near: bool = field(compare=False)


def place(
    sensor: ScanMatcher,
    scan: Scan,
    points_m: F32,
    belief: PoseWithCovariance,
    others: Iterable[PoseWithCovariance] = (),
) -> MatchedScan:
    """Match the next scan of a sensor with the local map, and select the most probable match.

    points_m : (N, 3) deskewed, base frame. belief : the most credible prediction of the pose, which a scan
    gets that fits nowhere, or is empty. others : less credible ones, made only where needed.
    """
    sensor.take(scan, points_m)
    if not sensor:
        return MatchedScan(belief.pose, measured=True, first=True)
    found = _candidates(sensor, belief, others)
    best = max(found)
    if best.fit.overlap < TRACKING.min_overlap or not (best.near or best.fit.credible):
        # Odometry is trusted more than the last scans.
        motion = None if scan.T_odom_base is not None else sensor.follow(belief)
        return MatchedScan(belief.pose, motion=motion)
    fit = sensor.observable(best.fit)
    alone, information = fit.alone
    if len(found) > 1:
        # The covariance of all candidates about the best one, in the axes of the base there.
        mass = np.exp([other.score - best.score for other in found])
        poses = np.array([other.fit.pose for other in found])
        away = steps(np.tile(best.fit.pose, (len(poses), 1, 1)), poses)[0]
        spread = np.einsum("n,na,nb->ab", mass / mass.sum(), away, away)[np.ix_(belief.free, belief.free)]
        # The inverse of the sum of both covariances, also where a match has none of a direction.
        information = np.linalg.solve(np.eye(len(spread)) + information @ spread, information)
    estimate = alone, 0.5 * (information + information.T)
    return MatchedScan(fit.pose, estimate, sure=best.sure, measured=fit.measured)


def _candidates(
    sensor: ScanMatcher, first: PoseWithCovariance, others: Iterable[PoseWithCovariance]
) -> list[_Candidate]:
    """Return the matches at the expected poses, as many as are needed until one fits that an exact belief has
    led to; if none fits, also those of a search.
    """
    expected: list[PoseWithCovariance] = []
    fits: list[ScanMatch] = []
    for belief in chain((first,), others):
        expected.append(belief)
        fits += sensor.match(belief)
        found = [_candidate(fit, expected) for fit in fits]
        if max(found).sure and max(found).near and not _is_vague(belief):
            return found
    if not max(found).sure and (_is_vague(first) or not max(found).near):
        found += [replace(_candidate(fit, expected), near=False) for fit in sensor.search(first)]
    return found


def _candidate(fit: ScanMatch, expected: Sequence[PoseWithCovariance]) -> _Candidate:
    """Weight a match by the expected pose that explains it best."""
    chi2 = [belief.chi2(fit.pose) for belief in expected]
    density = max(belief.log_density(c) for belief, c in zip(expected, chi2, strict=True))
    sure = fit.credible and fit.overlap >= TRACKING.sure_overlap
    return _Candidate(fit.evidence + density, fit, sure, near=min(chi2) < KERNEL**2)


def _is_vague(belief: PoseWithCovariance) -> bool:
    """Return True if a belief is wider than the reach of a match."""
    sigma_m, sigma_rad = belief.sigmas
    return KERNEL * max(sigma_m / TRACKING.reach_m, sigma_rad / TRACKING.reach_rad) > 1.0


# --- odometry ------------------------------------------------------------------------------------------


class Standstill:
    """Detects that the walls have changed while odometry stood still, as after a ride in a lift.

    Walls that come back, while the base stands or when it leaves, have not changed.
    """

    def __init__(self) -> None:
        self._known: tuple[int, F64] | None = None  # stamp and T_odom_base of the last scan that fits well

    def left(self, scan: Scan, *, sure: bool) -> bool:
        """Update with the next scan; returns True if the base leaves a place whose walls have changed.

        sure : True if the scan fits the local map well; False for the first scan of a map, which fits in any
        case. If no scan has fitted well yet, as behind glass, a change cannot be detected.
        """
        T_odom_base = scan.T_odom_base
        if sure and T_odom_base is not None:
            self._known = scan.stamp_ns, T_odom_base
        if sure or self._known is None or T_odom_base is None:
            return False
        since_ns, stood = self._known
        distance_m, turn_rad = motion_size(invert_pose(stood) @ T_odom_base)
        if distance_m <= KERNEL * SMOOTHER.reading_m and turn_rad <= KERNEL * SMOOTHER.reading_rad:
            return False
        self._known = scan.stamp_ns, T_odom_base
        return (scan.stamp_ns - since_ns) * 1e-9 > TRACKING.standing_s


class Odometer:
    """Keeps the last reading, and the pose of the base then. begin_ns : stamp of the first scan."""

    def __init__(self, begin_ns: int) -> None:
        self._begin_ns = begin_ns
        self._scans = 0
        self._last: tuple[F64, F64] | None = None  # T_base_odom and T_session_base

    def remember(self, scan: Scan, pose: F64) -> None:
        """Keep the reading of a scan, if it has one, with its final pose (4, 4)."""
        self._scans += 1
        if scan.T_odom_base is not None:
            self._last = invert_pose(scan.T_odom_base), pose

    def reported(self, scan: Scan) -> F64 | None:
        """Return the motion (4, 4) since the last reading; None if there is none."""
        if scan.T_odom_base is None or self._last is None:
            return None
        return self._last[0] @ scan.T_odom_base

    def continues(self, scan: Scan, seconds: float) -> bool:
        """Return True if odometry continues from its last reading; `seconds` since the last scan.

        It does not after an impossible motion, nor over a gap in which the log has neither scans nor
        readings: its driver may have been restarted meanwhile. Nor does its first reading: odometry may begin
        after the first scan, anywhere.
        """
        if scan.T_odom_base is None:
            return True
        reported = self.reported(scan)
        usual_s = (scan.stamp_ns - self._begin_ns) * 1e-9 / max(self._scans, 1)
        gap = min(seconds, scan.odometry_gap_s) > TRACKING.give_up_scans * usual_s
        return reported is not None and not gap and self.is_possible(reported, seconds)

    def is_possible(self, motion: F64, seconds: float) -> bool:
        """Return True if a robot or a person indoors can make a motion (4, 4) in a time."""
        p, (distance_m, turn_rad) = TRACKING, motion_size(motion)
        return max(distance_m, turn_rad) <= p.reach_m + p.fastest * seconds

    def disagreement(self, scan: Scan, pose: F64) -> Disagreement | None:
        """Compare the reported motion with the one to the final pose (4, 4) of a scan."""
        reported = self.reported(scan)
        if reported is None or self._last is None:
            return None
        moved = invert_pose(self._last[1]) @ pose
        distance_m, turn_rad = motion_size(invert_pose(reported) @ moved)
        (reported_m, reported_rad), (moved_m, moved_rad) = motion_size(reported), motion_size(moved)
        is_outlier = distance_m > _INEXACT_M + _INEXACT_SHARE * max(
            reported_m, moved_m
        ) or turn_rad > _INEXACT_RAD + _INEXACT_SHARE * max(reported_rad, moved_rad)
        return Disagreement(distance_m, turn_rad, is_outlier)


_INEXACT_M, _INEXACT_RAD, _INEXACT_SHARE = 0.1, 0.1, 0.1
"""Odometry that differs by less, or by less than this share of the motion, is merely inexact; by hand."""
_TOGETHER_NS = 10**9
"""OdometryOutlier scans that follow each other within this time are one stretch; chosen by hand."""


@dataclass(frozen=True, slots=True)
class Disagreement:
    """The difference between the motion to a scan as reported by odometry and as shown by the scan.

    distance_m, turn_rad : size of the difference. is_outlier : True if it is larger than that of odometry
        that is merely inexact.
    """

    distance_m: float
    turn_rad: float
    is_outlier: bool


def check_odometry(stamps_ns: Sequence[int], disagreements: Sequence[Disagreement | None]) -> OdometryCheck:
    """Summarise the disagreements of a session with its odometry.

    disagreements : of each scan; None where there was nothing to compare.
    """
    compared = [(stamp, found) for stamp, found in zip(stamps_ns, disagreements, strict=True) if found]
    overruled = [(stamp_ns, found) for stamp_ns, found in compared if found.is_outlier]
    ends = np.flatnonzero(np.diff([stamp_ns for stamp_ns, _ in overruled]) > _TOGETHER_NS) + 1
    cuts = [0, *ends.tolist(), len(overruled)]
    stretches = [
        OdometryOutlier(
            from_ns=group[0][0],
            to_ns=group[-1][0],
            distance_m=max(found.distance_m for _, found in group),
            turn_rad=max(found.turn_rad for _, found in group),
        )
        for group in (overruled[first:end] for first, end in pairwise(cuts) if first < end)
    ]
    stretches.sort(key=lambda s: (-(s.distance_m + s.turn_rad), s.from_ns))
    return OdometryCheck(
        compared=len(compared), overruled=len(overruled), stretches=tuple(stretches[:MOST_LISTED])
    )


def follow(
    scans: Iterable[Scan], config: Config = Config(), observer: Observer = Observer()
) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
    """Yield each scan with its pose, and its planar scan, as they come.

    The memory needed is that of one local map, however many scans there are.

    observer : gets a warning of scans that are left out before the first that shows which way is up
        (`pc2grid.estimation.spatial.begin`).

    >>> import pc2grid
    >>> with pc2grid.open_log("tuesday.mcap") as log:
    ...     poses = [scan.T_session_base for scan, _ in follow(log.scans(0.0, 1.0))]
    >>> poses[0].shape, float(poses[0][0, 3])
    ((4, 4), 0.0)
    """
    return one_blas_thread_each(_followed(scans, config, observer))


def _followed(
    scans: Iterable[Scan], config: Config, observer: Observer
) -> Iterator[tuple[RegisteredScan, PlanarScan]]:
    rest = iter(scans)
    beginning = begin(rest)
    tracker = Tracker(config.registration, config.projection, in_hand=beginning.in_hand)
    if beginning.warning is not None:
        observer.on_warning(beginning.warning)
    for scan in chain(beginning.scans, rest):
        tracked = tracker.track(scan)
        yield tracked.registered, tracked.planar_scan
