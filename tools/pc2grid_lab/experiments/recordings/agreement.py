"""Answers to one drive judge each other: they lie on one rigid transform of the drive's own trajectory.

Where nobody knows how a recording and a map lie to each other, every right answer still says the same about
it: the pose in the map, and the pose in the recording's own trajectory, differ by one rigid transform. Wrong
answers scatter. The transform that most answers agree with is taken for the truth, if at least three agree
and no other transform has half as many. Neither map nor trajectory is rigid over a whole building, so what
agrees may differ by a share of the distance between the two places, and an answer is judged by the others
around it, never by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import SE2
from pc2grid_lab.experiments.frames import apart, fit_frame
from pc2grid_lab.experiments.trial import JUDGEMENT


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
        """The transform that it says."""
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
        """Where a pose of the recording is in the map, and how far from there a right answer may be, metres.

        By the clues around it, or by the nearest ones, leaving out that of one query.
        """
        clues = [clue for clue in self.clues if without is None or clue.query != without]
        away_m = np.array([_apart_m(clue.T_drive_base, T_drive_base) for clue in clues])
        order = np.argsort(away_m, kind="stable")
        near = max(int(np.sum(away_m <= AGREEMENT.around_m)), min(2, len(clues)))
        T_map_drive = _fit([clues[k] for k in order[:near]])
        within_m = self.within_m + AGREEMENT.bend * float(away_m[order[0]])
        return T_map_drive @ T_drive_base, within_m


def agreed_frame(clues: Sequence[Clue]) -> Frame | None:
    """The transform that most answers say, as those that say it; None if that does not tell the truth.

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
    """Whether an answer is right, and how far it is from the expected pose, metres."""
    apart_m, apart_rad = apart(expected, T_map_base)
    return apart_m <= within_m and apart_rad <= JUDGEMENT.right_rad, apart_m


def _agreement(clues: Sequence[Clue]) -> NDArray[np.bool_]:
    """(N, N) whether two clues say the same transform, as exactly as their distance lets expect."""
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
    """The clues that agree with the one whose agreeing clues weigh most; of equals, the first."""
    if not len(weights):
        return np.zeros(0, bool)
    best: NDArray[np.bool_] = agree[int(np.argmax(agree @ weights))]
    return best


def _places(clues: Sequence[Clue]) -> int:
    """How many different places the robot was at."""
    kept: list[SE2] = []
    for clue in clues:
        if all(_apart_m(clue.T_drive_base, other) >= AGREEMENT.place_m for other in kept):
            kept.append(clue.T_drive_base)
    return len(kept)


def _fit(clues: Sequence[Clue]) -> SE2:
    """The transform nearest to what the clues say, least squares."""
    return fit_frame([(clue.T_drive_base, clue.T_map_base) for clue in clues], AGREEMENT.lever_m)


def _apart_m(a: SE2, b: SE2) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)
