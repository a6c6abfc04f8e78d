"""The truth about trajectories and answers.

- Poses that belong to a stamp, the difference of two poses, and the transform of two frames by poses that are
  known in both.
- The absolute error of a trajectory (ATE): Sturm et al., "A benchmark for the evaluation of RGB-D SLAM
  systems" (2012); computed as evo does, with alignment and without scale.
- The SLAM benchmark's error of a trajectory, which needs neither a map nor a reference frame: Kuemmerle et
  al., "On measuring the accuracy of SLAM algorithms" (2009), section III. The relative poses of a trajectory
  between chosen pairs of times are compared with relative poses that people have verified.
- Answers to one drive judge each other. Where nobody knows how a recording and a map lie to each other, every
  right answer still gives the same transform: that between the pose in the map and the pose in the
  recording's own trajectory. Wrong answers scatter. The transform that most answers agree with is taken for
  the truth, if at least three agree and no other transform has half as many. Neither map nor trajectory is
  rigid over a whole building, so what agrees may differ by a share of the distance between the two places,
  and an answer is judged by the others around it, never by itself.
- The transform of two recordings of one room by their clouds, in which no answer has a part. Each recording
  is one cloud along its own trajectory. The clouds are level, and stand on one floor, so that only a heading
  and a shift in the plane are searched for; the best few are refined in space by Open3D's point-to-plane ICP.
  The best is the truth if no other place has nearly as many points on surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pc2grid.clouds.cloud import VoxelCloud, random_subset
from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import F64, I64, SE2, interpolate_pose, invert_pose, transform_points, wrap_angle
from pc2grid.io.recording import Log
from pc2grid.model import SENSOR_MODELS, Health, Trajectory
from pc2grid.open3d_core import o3d


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgementParameters:
    """When an answer counts as right. All chosen by hand.

    right_m, right_rad : the pose is right within this of the true one.
    right_recorded_m : the same for real recordings, whose truth is another program's map and has an error of
        a few centimetres itself.
    mapped : a query counts as lying in the map if at least this share of its walls lies on ground that the
        map knows. Where the mapping robot has never been no answer could be right.
    """

    right_m: float = 0.25
    right_rad: float = math.radians(3.0)
    right_recorded_m: float = 0.3
    mapped: float = 0.5


JUDGEMENT = JudgementParameters()

SAME_NS = 5_000_000
"""A pose or a scan is the one of a stamp if its own differs by no more than this."""
AHEAD_M = 3.0
"""Of poses of a robot, the heading counts as much as the position of a point so far ahead; chosen by hand."""


def nearest(stamps_ns: I64, wanted_ns: I64, within_ns: float = SAME_NS) -> I64:
    """Return the numbers (N,) of the stamps (M,), increasing, that are nearest to the wanted ones (N,); -1
    where none is so near."""
    if not len(stamps_ns):
        return np.full(len(wanted_ns), -1)
    after = np.searchsorted(stamps_ns, wanted_ns).clip(max=len(stamps_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(stamps_ns[before] - wanted_ns) < np.abs(stamps_ns[after] - wanted_ns)
    number = np.where(is_before, before, after)
    return np.where(np.abs(stamps_ns[number] - wanted_ns) <= within_ns, number, -1)


def pose_at_stamp(trajectory: Trajectory, stamp_ns: int, *, same_ns: float, gap_ns: float) -> F64 | None:
    """Return t_session_base (4, 4) at a stamp: the pose whose stamp differs by no more than `same_ns`, else
    between two poses no more than `gap_ns` apart; None if there are none."""
    stamps_ns, poses = trajectory.stamps_ns, trajectory.T_session_base
    number = int(nearest(stamps_ns, np.array([stamp_ns]), same_ns)[0])
    if number >= 0:
        return np.asarray(poses[number])
    after = int(np.searchsorted(stamps_ns, stamp_ns))
    if not 0 < after < len(stamps_ns):
        return None
    before_ns, after_ns = int(stamps_ns[after - 1]), int(stamps_ns[after])
    if after_ns - before_ns > gap_ns:
        return None
    return interpolate_pose(poses[after - 1], poses[after], (stamp_ns - before_ns) / (after_ns - before_ns))


def apart(a: SE2, b: SE2) -> tuple[float, float]:
    """Return metres and radians between two poses in one frame."""
    error = a.inverse() @ b
    return math.hypot(error.x, error.y), abs(float(wrap_angle(error.yaw)))


def fit_frame(pairs: Sequence[tuple[SE2, SE2]], ahead_m: float) -> SE2:
    """Return t_b_a that brings poses in a frame a nearest to the same poses in a frame b, least squares.

    pairs : of poses in a and in b. ahead_m : a heading counts as much as the position of a point so far
        ahead.
    """
    ahead = np.array([(0.0, 0.0), (ahead_m, 0.0)])
    in_a, in_b = (np.concatenate([pair[k].apply(ahead) for pair in pairs]) for k in (0, 1))
    return SE2.fit(in_a, in_b)


MAX_GAP_S = 1.0
"""The truth is interpolated between two poses that differ by no more than this in time; chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryError:
    """The errors of a trajectory; poses of lost scans are left out.

    ate_m : RMS distance from the truth after the best rigid alignment. poses : how many were compared.
    """

    ate_m: float
    poses: int


def trajectory_error(estimated: Trajectory, truth: Trajectory) -> TrajectoryError | None:
    """Return the error of a trajectory with respect to the truth, which is interpolated at its stamps.

    None if fewer than three poses have a true pose.
    """
    found = [
        (estimated.T_session_base[k, :3, 3], true[:3, 3])
        for k, stamp_ns in enumerate(estimated.stamps_ns.tolist())
        if not (estimated.health and estimated.health[k] is Health.LOST)
        and (true := pose_at_stamp(truth, stamp_ns, same_ns=0.0, gap_ns=MAX_GAP_S * 1e9)) is not None
    ]
    if len(found) < 3:
        return None
    a, b = (points - points.mean(axis=0) for points in np.swapaxes(found, 0, 1))
    # The rotation nearest to the covariance of the two (Umeyama 1991).
    U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a))
    R = U @ np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt)))) @ Vt
    apart_m = np.linalg.norm(a @ R.T - b, axis=1)
    return TrajectoryError(ate_m=float(np.sqrt(np.mean(apart_m**2))), poses=len(found))


@dataclass(frozen=True, slots=True, kw_only=True)
class Relations:
    """R verified relative poses.

    first_ns, second_ns : (R,) int64, the two times of each relation. T_first_second : (R, 3) x, y, yaw.
    """

    first_ns: I64
    second_ns: I64
    T_first_second: F64


@dataclass(frozen=True, slots=True, kw_only=True)
class RelationError:
    """Mean absolute errors over the relations, metres and degrees; NaN without any.

    used : number of relations, of `total`, for which the trajectory has poses at both times.
    """

    translation_m: float
    rotation_deg: float
    used: int
    total: int


def read_relations(path: Path) -> Relations:
    """Read a `*.relations` file: `t1 t2 x y z roll pitch yaw` in each line, in seconds, metres, radians.

    Raises TrajectoryFileError if a line has another form.
    """
    firsts, seconds, poses = [], [], []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            t1, t2, x, y, _, _, _, yaw = (float(word) for word in line.split())
        except ValueError:
            raise TrajectoryFileError(
                f"{path}, line {number}: expected 't1 t2 x y z roll pitch yaw'"
            ) from None
        firsts.append(round(t1 * 1e9))
        seconds.append(round(t2 * 1e9))
        poses.append((x, y, yaw))
    return Relations(
        first_ns=np.array(firsts, dtype=np.int64),
        second_ns=np.array(seconds, dtype=np.int64),
        T_first_second=np.array(poses, dtype=np.float64).reshape(-1, 3),
    )


def relation_error(
    trajectory: Trajectory,
    relations: Relations,
    *,
    base_to_reference_m: tuple[float, float] = (0.0, 0.0),
) -> RelationError:
    """Return the errors of a trajectory with respect to the relations.

    base_to_reference_m : position on the base of the point that the relations describe (the benchmark's poses
        are those of the laser, not of the base).

    A relation is left out if there is no pose at one of its times.
    """
    poses = trajectory.planar()
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = base_to_reference_m
    poses[:, 0] += c * dx - s * dy
    poses[:, 1] += s * dx + c * dy
    i, j = (
        nearest(trajectory.stamps_ns, wanted_ns) for wanted_ns in (relations.first_ns, relations.second_ns)
    )
    used = (i >= 0) & (j >= 0)
    error = _relative(relations.T_first_second[used], _relative(poses[i[used]], poses[j[used]]))
    off_m, off_deg = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(wrap_angle(error[:, 2])))
    return RelationError(
        translation_m=float(off_m.mean()) if len(error) else math.nan,
        rotation_deg=float(off_deg.mean()) if len(error) else math.nan,
        used=len(error),
        total=len(used),
    )


def _relative(a: F64, b: F64) -> F64:
    """Return t_a_b (N, 3) of poses (N, 3) in one frame."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack((c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]))


@dataclass(frozen=True, slots=True, kw_only=True)
class AgreementParameters:
    """When answers agree, and when their agreement is the truth. All chosen by hand.

    bend : what lies a metre apart may be bent by so much. least : answers that must agree, from places that
        are `place_m` apart: a robot that stands still says the same wrong thing again and again. rival :
        another transform must have less than this share of their weight.
    around_m : an answer is judged by the others this near. lever_m : the heading of an answer counts as much
        as the position of a point so far ahead.
    """

    bend: float = 0.02
    least: int = 3
    place_m: float = 1.0
    rival: float = 0.5
    around_m: float = 10.0
    lever_m: float = 1.0


AGREEMENT = AgreementParameters()


@dataclass(frozen=True, slots=True)
class Clue:
    """A place in both frames: where the base was in the recording's own frame, and in the map.

    query : the recording and the number of the window that it is about; None for a scan of the map.
    weight : of the vote, the confidence of an answer.
    """

    T_drive_base: SE2
    T_map_base: SE2
    query: tuple[str, int] | None = None
    weight: float = 1.0

    @property
    def T_map_drive(self) -> SE2:
        """Return the transform that the clue stands for."""
        return self.T_map_base @ self.T_drive_base.inverse()


@dataclass(frozen=True, slots=True)
class Frame:
    """How a recording lies in a map, by places that are known in both; the map may be bent.

    clues : at least two of them, at different places or with headings. within_m : how far a right answer may
    be from where they say, beside the bend.
    """

    clues: tuple[Clue, ...]
    within_m: float = JUDGEMENT.right_recorded_m

    def place(self, T_drive_base: SE2, *, without: tuple[str, int] | None = None) -> tuple[SE2, float]:
        """Return where a pose of the recording is in the map, and how far from there a right answer may be,
        metres.

        By the clues around it, or by the nearest ones, leaving out that of one query.
        """
        clues = [clue for clue in self.clues if without is None or clue.query != without]
        away_m = np.array([_apart_m(clue.T_drive_base, T_drive_base) for clue in clues])
        order = np.argsort(away_m, kind="stable")
        near = max(int(np.sum(away_m <= AGREEMENT.around_m)), min(2, len(clues)))
        pairs = [(clues[k].T_drive_base, clues[k].T_map_base) for k in order[:near]]
        T_map_drive = fit_frame(pairs, AGREEMENT.lever_m)
        within_m = self.within_m + AGREEMENT.bend * float(away_m[order[0]])
        return T_map_drive @ T_drive_base, within_m


def agreed_frame(clues: Sequence[Clue]) -> Frame | None:
    """Return the transform that most answers agree on, with those that do; None if that does not settle the
    truth.

    clues : the best place of every answer, sure or not.
    """
    agree = _agreement(clues)
    weights = np.array([clue.weight for clue in clues])
    members = _heaviest(agree, weights)
    agreeing = tuple(clue for clue, is_member in zip(clues, members, strict=True) if is_member)
    if _places(agreeing) < AGREEMENT.least:
        return None
    others = ~members
    rival = _heaviest(agree[np.ix_(others, others)], weights[others])
    if rival.sum() >= 2 and weights[others][rival].sum() >= AGREEMENT.rival * weights[members].sum():
        return None
    return Frame(agreeing)


def is_right(T_map_base: SE2, expected: SE2, within_m: float) -> tuple[bool, float]:
    """Return whether an answer is right, and how far it is from the expected pose, metres."""
    apart_m, apart_rad = apart(expected, T_map_base)
    return apart_m <= within_m and apart_rad <= JUDGEMENT.right_rad, apart_m


def _agreement(clues: Sequence[Clue]) -> NDArray[np.bool_]:
    """Return whether two clues agree on the transform, as exactly as their distance allows, (N, N)."""
    agree = np.eye(len(clues), dtype=bool)
    for i, a in enumerate(clues):
        for j, b in enumerate(clues[:i]):
            within_m = JUDGEMENT.right_recorded_m + AGREEMENT.bend * _apart_m(a.T_drive_base, b.T_drive_base)
            agree[i, j] = agree[j, i] = (
                is_right(b.T_map_base, a.T_map_drive @ b.T_drive_base, within_m)[0]
                and is_right(a.T_map_base, b.T_map_drive @ a.T_drive_base, within_m)[0]
            )
    return agree


def _heaviest(agree: NDArray[np.bool_], weights: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the clues that agree with the one whose agreeing clues weigh most; of equals, the first."""
    if not len(weights):
        return np.zeros(0, bool)
    return np.asarray(agree[int(np.argmax(agree @ weights))])


def _places(clues: Sequence[Clue]) -> int:
    """Return the number of different places the robot was at."""
    kept: list[SE2] = []
    for clue in clues:
        if all(_apart_m(clue.T_drive_base, other) >= AGREEMENT.place_m for other in kept):
            kept.append(clue.T_drive_base)
    return len(kept)


def _apart_m(a: SE2, b: SE2) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredCloudsParameters:
    """How two clouds are registered. Chosen by hand for single rooms.

    voxel_m : points are thinned to one a voxel. every : scan of a recording that is used. noise_m : points
        whose deviation is larger are left out.
    step_m, step_rad, near_m : grid of the search, and how near to a surface a point counts. points : of the
        search. starts : that are refined.
    rounds_m : reach of ICP, one after the other.
    Places nearer than a step are one. rival : another place has less than this share of the
        points on surfaces of the best one.
    """

    voxel_m: float = 0.05
    every: int = 6
    noise_m: float = 0.02
    step_m: float = 0.5
    step_rad: float = math.radians(10.0)
    near_m: float = 0.3
    points: int = 250
    starts: int = 12
    rounds_m: tuple[float, ...] = (0.4, 0.2, 0.1)
    rival: float = 0.9


REGISTERED_CLOUDS = RegisteredCloudsParameters()


def cloud_along(log: Log, trajectory: Trajectory, p: RegisteredCloudsParameters = REGISTERED_CLOUDS) -> F64:
    """Return the points (N, 3) of a recording, thinned, in the frame of its trajectory."""
    cloud = VoxelCloud(p.voxel_m)
    for number, scan in enumerate(log.scans()):
        k = int(np.searchsorted(trajectory.stamps_ns, scan.stamp_ns))
        if number % p.every or k == len(trajectory) or trajectory.stamps_ns[k] != scan.stamp_ns:
            continue
        away_m = np.linalg.norm(scan.points_m - scan.T_base_sensor[:3, 3], axis=1)
        near = away_m < SENSOR_MODELS[scan.sensor].range_of_noise_m(p.noise_m)
        cloud.add(transform_points(trajectory.T_session_base[k], scan.points_m[near]))
    return cloud.points_m()


def registered_clouds(
    source: F64, target: F64, p: RegisteredCloudsParameters = REGISTERED_CLOUDS
) -> SE2 | None:
    """Return t_target_source of two clouds (N, 3) and (M, 3) of one room, z up; None if it is not clear.

    Neither cloud is preferred: each is registered to the other one, as one of the two ways may end beside the
    place, and a place counts by the points on surfaces of both (geometric mean).
    """
    placed = [*_refined(source, target, p), *map(invert_pose, _refined(target, source, p))]
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    found: list[tuple[float, SE2]] = []
    for T in placed:
        there, back = (
            o3d.pipelines.registration.evaluate_registration(*pair, p.rounds_m[-1], pose).fitness
            for pair, pose in ((clouds, T), (clouds[::-1], invert_pose(T)))
        )
        found.append((math.sqrt(there * back), SE2.from_matrix(T)))
    share, best = max(found, key=lambda one: one[0])
    rivals = [other for other, pose in found if not _same(pose, best, p)]
    return best if max(rivals, default=0.0) < p.rival * share else None


def _refined(source: F64, target: F64, p: RegisteredCloudsParameters) -> list[F64]:
    """Refine the poses (4, 4) at which a search ends."""
    steps = o3d.pipelines.registration
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
    clouds[1].estimate_normals()
    poses = []
    for T in _starts(source, target, p):
        for reach_m in p.rounds_m:
            loss = steps.TransformationEstimationPointToPlane(steps.TukeyLoss(k=0.5 * reach_m))
            T = steps.registration_icp(*clouds, reach_m, T, loss).transformation
        poses.append(np.asarray(T, np.float64))
    return poses


def _starts(source: F64, target: F64, p: RegisteredCloudsParameters) -> list[F64]:
    """Return the poses (4, 4) of a grid at which most points of the source are near the target, best
    first."""
    tree = cKDTree(target)
    few = source[random_subset(len(source), p.points)]
    (x0, y0), (x1, y1) = (_middle(points) for points in (source, target))
    floors_m = [float(np.percentile(points[:, 2], 2.0)) for points in (source, target)]
    half_m = 0.5 * np.ptp(target[:, :2], axis=0)
    shifts = [np.arange(-half, half + p.step_m, p.step_m) for half in half_m.tolist()]
    tried: list[tuple[float, SE2]] = []
    for yaw, x, y in product(np.arange(-math.pi, math.pi, p.step_rad).tolist(), *shifts):
        pose = SE2(x1 + x, y1 + y, yaw) @ SE2(-x0, -y0, 0.0)
        placed = transform_points(_lifted(pose, floors_m), few)
        away_m, _ = tree.query(placed, distance_upper_bound=p.near_m)
        tried.append((float(np.mean(away_m < p.near_m)), pose))
    kept: list[SE2] = []
    for _, pose in sorted(tried, key=lambda one: -one[0]):
        if len(kept) < p.starts and not any(_same(pose, other, p) for other in kept):
            kept.append(pose)
    return [_lifted(pose, floors_m) for pose in kept]


def _middle(points: F64) -> tuple[float, float]:
    """Return the middle of the ground that points (N, 3) lie on."""
    x, y = (0.5 * (points[:, :2].min(axis=0) + points[:, :2].max(axis=0))).tolist()
    return x, y


def _lifted(pose: SE2, floors_m: list[float]) -> F64:
    """Return a planar pose in space, that brings one floor onto the other."""
    T = pose.lift()
    T[2, 3] = floors_m[1] - floors_m[0]
    return T


def _same(a: SE2, b: SE2, p: RegisteredCloudsParameters) -> bool:
    apart_m, apart_rad = apart(a, b)
    return apart_m < p.step_m and apart_rad < p.step_rad
