"""One answer together with the truth, and what many of them say: the cells of the sensor matrix."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from signature.localization.answer import Status

RECALL_AT = (1, 5, 20)
"""Numbers of retrieved places for which the recall is given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgementParameters:
    """When an answer counts as right. All chosen by hand.

    right_m, right_rad : the pose is right within this of the true one.
    right_recorded_m : the same for real recordings, whose truth is another program's map and has an error of
        a few centimetres itself.
    mapped : a query counts as lying in the map if at least this share of its walls lies on ground that the
        map knows. Where the mapping robot has never been no answer could be right.
    retrieved_m : a retrieved place is right within this of the true position of the view that retrieved it.
    """

    right_m: float = 0.25
    right_rad: float = math.radians(3.0)
    right_recorded_m: float = 0.3
    mapped: float = 0.5
    retrieved_m: float = 1.0


JUDGEMENT = JudgementParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A query whose true place is known, and the answer to it.

    building: of the map. in_building: the query comes from that building; if not, nothing is right. mapped:
    share of the query's walls, placed as they truly are, that lie on ground that the map knows, 0..1. status,
    confidence, error_m: of the best hypothesis; the error is null if there is none. right: the error of the
    best hypothesis is small enough. rank: of the first right place among those retrieved, -1 if there is
    none.
    """

    building: str
    map_sensor: str
    query_sensor: str
    seed: int
    travel_m: float
    in_building: bool
    mapped: float
    status: Status
    confidence: float
    right: bool
    error_m: float | None
    rank: int
    look_up_ms: float

    @property
    def in_map(self) -> bool:
        """Whether the query lies where the map has been made, so that there is a right answer."""
        return self.in_building and self.mapped >= JUDGEMENT.mapped


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixCell:
    """Queries of one sensor in maps made by another, after some metres of travel.

    Shares are 0..1 of its trials. located_right: located, and right. wrong: share of the located ones that
    are not right. recall: of the first right place among the first `RECALL_AT` retrieved ones. Errors are of
    the answers that are located and right, in metres; null if there are none.
    """

    map_sensor: str
    query_sensor: str
    travel_m: float
    trials: int
    located_right: float
    wrong: float
    ambiguous: float
    not_found: float
    recall: tuple[float, ...]
    median_error_m: float | None
    p95_error_m: float | None
    look_up_ms: float


def matrix(trials: Sequence[Trial]) -> list[MatrixCell]:
    """The trials that lie in the map of their own building, by map sensor, query sensor and travel."""
    groups: dict[tuple[str, str, float], list[Trial]] = {}
    for trial in trials:
        if trial.in_map:
            groups.setdefault((trial.map_sensor, trial.query_sensor, trial.travel_m), []).append(trial)
    return [_cell(*key, members) for key, members in sorted(groups.items())]


def _cell(map_sensor: str, query_sensor: str, travel_m: float, trials: Sequence[Trial]) -> MatrixCell:
    located = [t for t in trials if t.status == "located"]
    right = [t for t in located if t.right]
    statuses, count = Counter(t.status for t in trials), len(trials)
    errors_m = [t.error_m for t in right if t.error_m is not None]
    median_m, p95_m = np.percentile(errors_m, (50, 95)).tolist() if errors_m else (None, None)
    return MatrixCell(
        map_sensor=map_sensor,
        query_sensor=query_sensor,
        travel_m=travel_m,
        trials=count,
        located_right=len(right) / count,
        wrong=(len(located) - len(right)) / max(len(located), 1),
        ambiguous=statuses["ambiguous"] / count,
        not_found=statuses["not_found"] / count,
        recall=tuple(sum(0 <= t.rank < k for t in trials) / count for k in RECALL_AT),
        median_error_m=median_m,
        p95_error_m=p95_m,
        look_up_ms=float(np.median([t.look_up_ms for t in trials])),
    )


def reliability(trials: Sequence[Trial], bands: int = 10) -> list[tuple[float, float, int]]:
    """For each band of confidence that has trials: mean confidence, share that was right, how many."""
    members: dict[int, list[Trial]] = {}
    for trial in trials:
        members.setdefault(min(int(trial.confidence * bands), bands - 1), []).append(trial)
    return [
        (float(np.mean([t.confidence for t in band])), sum(t.right for t in band) / len(band), len(band))
        for _, band in sorted(members.items())
    ]
