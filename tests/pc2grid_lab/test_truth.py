"""What is right: answers that judge each other, relations and trajectories."""

import math

import numpy as np
import pytest

from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import SE2, pose_from_rotation_vector
from pc2grid.model import Health, Trajectory
from pc2grid_lab.truth import (
    Clue,
    Frame,
    agreed_frame,
    is_right,
    read_relations,
    relation_errors,
    rms,
    trajectory_errors,
)

TRUE = SE2(12.0, -3.0, 0.7)
OTHER = SE2(-4.0, 9.0, -2.0)


def driven(window: int) -> SE2:
    """Where the drive is at the end of a window: along a corridor of 40 m, turning."""
    return SE2(4.0 * window, 0.5 * math.sin(window), 0.3 * window)


def clues(*said: SE2, weight: float = 1.0) -> list[Clue]:
    """An answer a window, each by a transform of its own."""
    return [Clue(driven(k), T @ driven(k), ("drive", k), weight) for k, T in enumerate(said)]


def scattered(k: int) -> SE2:
    """No two of them bring a place to the same one."""
    return SE2(7.0 * k - 20.0, 3.0 * k * k, 1.1 * k)


def verdicts(answers: list[Clue], frame: Frame) -> list[bool]:
    return [is_right(c.T_map_base, *frame.place(c.T_drive_base, without=c.query))[0] for c in answers]


def test_right_answers_agree_and_wrong_ones_are_told() -> None:
    answers = clues(TRUE, TRUE, scattered(2), TRUE, TRUE, scattered(5), TRUE)
    frame = agreed_frame(answers)
    assert frame is not None and len(frame.clues) == 5
    assert verdicts(answers, frame) == [True, True, False, True, True, False, True]


def test_two_clusters_are_not_judged() -> None:
    answers = clues(TRUE, OTHER, TRUE, OTHER, TRUE, OTHER, TRUE)
    assert agreed_frame(answers) is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_answers_are_not_judged(count: int) -> None:
    assert agreed_frame(clues(*[TRUE] * count)) is None


def test_a_robot_that_stands_still_does_not_agree_with_itself() -> None:
    """The same wrong place again and again is one answer."""
    still = [Clue(SE2(0.1 * k, 0.0, 0.0), OTHER @ SE2(0.1 * k, 0.0, 0.0), ("drive", k)) for k in range(6)]
    assert agreed_frame(still) is None


def bent(k: int) -> Clue:
    """An answer in the map of a corridor that turns by 1 degree on 8 m: 1.7 m to the side after 40 m."""
    curve, pose = math.radians(1.0) / 8.0, driven(k)
    warped = SE2(pose.x, pose.y + curve * pose.x**2 / 2, pose.yaw + curve * pose.x)
    return Clue(pose, TRUE @ warped, ("drive", k))


def test_a_bent_map_makes_no_answer_wrong() -> None:
    answers = [bent(k) for k in range(11)]
    frame = agreed_frame(answers)
    assert frame is not None and len(frame.clues) == 11
    assert verdicts(answers, frame) == [True] * 11
    ends = Frame((answers[0], answers[1]))  # one transform for all would make the far ones wrong
    assert not all(verdicts(answers, ends))


def test_an_answer_in_a_bent_map_can_be_wrong() -> None:
    answers = [bent(k) for k in range(11)]
    answers[3] = Clue(answers[3].T_drive_base, answers[3].T_map_base @ SE2(0.0, 0.6, 0.0), answers[3].query)
    frame = agreed_frame(answers)
    assert frame is not None
    assert verdicts(answers, frame) == [k != 3 for k in range(11)]


def test_an_answer_is_not_judged_by_itself() -> None:
    """An answer .5 m off moves the transform of few answers to itself; it must not count there."""
    answers = clues(TRUE, TRUE, TRUE @ SE2(0.0, 0.5, 0.0))
    frame = Frame(tuple(answers))
    (expected, within_m) = frame.place(driven(2), without=("drive", 2))
    assert is_right(TRUE @ driven(2), expected, within_m)[0]
    assert not is_right(answers[2].T_map_base, expected, within_m)[0]


# --- The SLAM benchmark's measure, on a hand-made graph ---


def trajectory(poses, health=(), every_ns=100_000_000):
    stamps_ns = np.arange(len(poses)) * every_ns
    return Trajectory(stamps_ns=stamps_ns, T_session_base=np.array(poses), health=health)


def way(*poses):
    """A planar pose a second."""
    return trajectory([SE2(*pose).lift() for pose in poses], every_ns=1_000_000_000)


def relations(tmp_path, lines):
    path = tmp_path / "x.relations"
    path.write_text("\n".join(lines) + "\n")
    return read_relations(path)


def test_exact_trajectory_anywhere_has_no_error(tmp_path):
    truth = relations(tmp_path, ["0 1 1 0 0 0 0 1.570796327", "1 2 1 0 0 0 0 0"])
    moved = SE2(5, -3, 1.0)
    poses = [moved @ p for p in (SE2(), SE2(1, 0, np.pi / 2), SE2(1, 1, np.pi / 2))]
    errors = relation_errors(way(*((p.x, p.y, p.yaw) for p in poses)), truth)
    assert errors == pytest.approx(np.zeros((2, 2)), abs=1e-6)


def test_errors_by_hand_of_the_relations_that_the_trajectory_has(tmp_path):
    truth = relations(tmp_path, ["0 1 1 0 0 0 0 0", "1 2 1 0 0 0 0 0", "0 7 1 0 0 0 0 0"])
    errors = relation_errors(way((0, 0, 0), (1.3, 0.4, 0), (2.3, 0.4, np.radians(2))), truth)
    assert errors == pytest.approx(np.array([(0.5, 0.0), (0.0, np.radians(2))]))


def test_relations_may_describe_the_laser_instead_of_the_base(tmp_path):
    truth = relations(tmp_path, ["0 1 -0.2 0 0 0 0 3.141592654"])
    turned = way((0, 0, 0), (-0.4, 0, np.pi))
    assert relation_errors(turned, truth)[:, 0] == pytest.approx([0.2])
    of_laser = relation_errors(turned, truth, SE2(-0.1, 0.0, 0.5))
    assert of_laser == pytest.approx(np.zeros((1, 2)), abs=1e-8)


def test_a_malformed_line_is_named(tmp_path):
    with pytest.raises(TrajectoryFileError, match=r"x\.relations.*row 2"):
        relations(tmp_path, ["0 1 1 0 0 0 0 0", "0 1 2"])


# --- Trajectories compared with the truth: by hand ---


def bend(count=60):
    return [SE2(0.1 * k, 0.002 * k * k, 0.04 * k).lift() for k in range(count)]


def test_a_trajectory_anywhere_and_in_other_axes_has_no_error():
    moved = pose_from_rotation_vector((0.3, -0.2, 1.0), (5.0, 2.0, 1.0))
    optical = pose_from_rotation_vector((-1.2, 1.2, -1.2))
    errors_m = trajectory_errors(trajectory([moved @ T @ optical for T in bend()]), trajectory(bend()))
    assert errors_m == pytest.approx(np.zeros(60), abs=1e-9)


def test_scale_is_an_error_by_hand():
    straight = [SE2(0.1 * k, 0.0, 0.0).lift() for k in range(41)]
    longer = [SE2(0.11 * k, 0.0, 0.0).lift() for k in range(41)]
    errors_m = trajectory_errors(trajectory(longer), trajectory(straight))
    assert errors_m == pytest.approx(0.01 * np.abs(np.arange(41) - 20.0))
    assert rms(errors_m) == pytest.approx(0.01 * np.sqrt(np.mean((np.arange(41) - 20.0) ** 2)))


def test_lost_poses_are_not_judged_and_truth_is_interpolated_but_not_over_gaps():
    truth = trajectory(bend())
    wrong = bend()
    wrong[7] = SE2(9.0, 9.0, 0.0).lift()
    health = [Health.FINE] * 60
    health[7] = Health.LOST
    assert rms(trajectory_errors(trajectory(wrong, tuple(health)), truth)) == pytest.approx(0, abs=1e-9)
    sparse = Trajectory(stamps_ns=truth.stamps_ns[::2], T_session_base=truth.T_session_base[::2])
    assert rms(trajectory_errors(truth, sparse)) < 0.001
    assert len(trajectory_errors(truth, sparse)) == 59  # not past the end
    gap = Trajectory(stamps_ns=truth.stamps_ns[::20], T_session_base=truth.T_session_base[::20])
    assert len(trajectory_errors(truth, gap)) == 3
    assert not len(trajectory_errors(trajectory(bend(2)), truth))
