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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import F64, I64, SE2, interpolate_pose, wrap_angle
from pc2grid.model import Health, Trajectory


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


def trajectory_errors(estimated: Trajectory, truth: Trajectory) -> F64:
    """Return the distances (N,) of the poses of a trajectory from the truth, which is interpolated at their
    stamps, after the best rigid alignment. Poses of lost scans are left out.

    Empty if fewer than three poses have a true pose.
    """
    found = [
        (estimated.T_session_base[k, :3, 3], true[:3, 3])
        for k, stamp_ns in enumerate(estimated.stamps_ns.tolist())
        if not (estimated.health and estimated.health[k] is Health.LOST)
        and (true := pose_at_stamp(truth, stamp_ns, same_ns=0.0, gap_ns=MAX_GAP_S * 1e9)) is not None
    ]
    if len(found) < 3:
        return np.empty(0)
    a, b = (points - points.mean(axis=0) for points in np.swapaxes(found, 0, 1))
    # The rotation nearest to the covariance of the two (Umeyama 1991).
    U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a))
    R = U @ np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt)))) @ Vt
    return np.asarray(np.linalg.norm(a @ R.T - b, axis=1))


def rms(errors_m: F64) -> float:
    """Return the root of the mean square of errors, for distances from the truth the ATE."""
    return float(np.sqrt(np.mean(np.square(errors_m))))


Relation = tuple[int, int, SE2]
"""Two stamps, nanoseconds, and the verified pose at the second one in the frame of that at the first one."""


def read_relations(path: Path) -> list[Relation]:
    """Read a `*.relations` file: `t1 t2 x y z roll pitch yaw` in each line, in seconds, metres, radians.

    Raises TrajectoryFileError if a line has another form.
    """
    try:
        rows = np.loadtxt(path, usecols=(0, 1, 2, 3, 7), ndmin=2).tolist()
    except ValueError as error:
        raise TrajectoryFileError(f"{path}: expected 't1 t2 x y z roll pitch yaw'; {error}") from None
    return [(round(t1_s * 1e9), round(t2_s * 1e9), SE2(x, y, yaw)) for t1_s, t2_s, x, y, yaw in rows]


def relation_errors(
    trajectory: Trajectory, relations: Sequence[Relation], T_base_reference: SE2 | None = None
) -> F64:
    """Return by how much a trajectory differs from relations, (R, 2) metres and radians, of those at whose
    times it has poses.

    T_base_reference : whose poses the relations describe (the benchmark's are those of the laser, not of the
        base); only where it is counts.
    """
    mounted = SE2() if T_base_reference is None else replace(T_base_reference, yaw=0.0)
    poses = [pose @ mounted for pose in trajectory.poses()]
    wanted_ns = np.array([(first_ns, second_ns) for first_ns, second_ns, _ in relations], np.int64)
    numbers = nearest(trajectory.stamps_ns, wanted_ns.ravel()).reshape(-1, 2).tolist()
    errors = [
        apart(expected, poses[i].inverse() @ poses[j])
        for (i, j), (_, _, expected) in zip(numbers, relations, strict=True)
        if min(i, j) >= 0
    ]
    return np.reshape(errors, (-1, 2))


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
