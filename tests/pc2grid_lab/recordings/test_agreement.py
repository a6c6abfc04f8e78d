"""Answers to one drive judge each other."""

from __future__ import annotations

import math

import pytest

from pc2grid.geometry import SE2
from pc2grid_lab.truth import Clue, Frame, agreed_frame, is_right

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
