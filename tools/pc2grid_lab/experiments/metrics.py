"""Measures over many trials: the cells of the sensor matrix, and the errors of the confidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid_lab.experiments.trial import Trial

RECALL_AT = (1, 5, 20)
"""Numbers of retrieved places for which the recall is given."""

_NOT_RETRIEVED = 10**6  # rank of a place that was not retrieved


@dataclass(frozen=True, slots=True, kw_only=True)
class MatrixCell:
    """Queries of one sensor in maps made by another, after some metres of travel.

    Shares are 0..1 of its trials. located_right: located, and right. wrong: share of the located ones that
    are not right. recall: of the first right place among the first 1, 5 and 20 retrieved ones. Errors are of
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
    recall: dict[int, float | None]
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
    statuses = Counter(t.status for t in trials)
    return MatrixCell(
        map_sensor=map_sensor,
        query_sensor=query_sensor,
        travel_m=travel_m,
        trials=len(trials),
        located_right=len(right) / len(trials),
        wrong=(len(located) - len(right)) / max(len(located), 1),
        ambiguous=statuses["ambiguous"] / len(trials),
        not_found=statuses["not_found"] / len(trials),
        recall=recall([t.rank for t in trials]),
        look_up_ms=float(np.median([t.look_up_ms for t in trials])),
        **errors_m(right),
    )


def errors_m(trials: Sequence[Trial]) -> dict[str, float | None]:
    """`median_error_m` and `p95_error_m` of a cell, by its answers that are located and right."""
    known = [t.error_m for t in trials if t.error_m is not None]
    median, p95 = (float(np.median(known)), float(np.percentile(known, 95))) if known else (None, None)
    return {"median_error_m": median, "p95_error_m": p95}


def recall(ranks: Sequence[int]) -> dict[int, float | None]:
    """Share of the ranks below each of `RECALL_AT`; None without ranks. A rank of -1: not retrieved."""
    found = np.array([rank if rank >= 0 else _NOT_RETRIEVED for rank in ranks])
    return {k: float(np.mean(found < k)) if len(found) else None for k in RECALL_AT}


def reliability(trials: Sequence[Trial], bands: int = 10) -> list[tuple[float, float, int]]:
    """For each band of confidence that has trials: mean confidence, share that was right, how many."""
    members: dict[int, list[Trial]] = {}
    for trial in trials:
        members.setdefault(min(int(trial.confidence * bands), bands - 1), []).append(trial)
    return [
        (float(np.mean([t.confidence for t in band])), sum(t.right for t in band) / len(band), len(band))
        for _, band in sorted(members.items())
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfidenceError:
    """How well the confidence is calibrated; null without trials.

    brier: mean squared difference of confidence and truth (0 or 1); 0 is best. expected_error: mean
    difference of confidence and the share that was right, over ten bands of confidence (ECE). reliability:
    for each band its mean confidence, the share that was right, and how many.
    """

    trials: int
    brier: float | None
    expected_error: float | None
    reliability: list[tuple[float, float, int]]

    @staticmethod
    def of(trials: Sequence[Trial]) -> ConfidenceError:
        """Over all answers, including those in maps of other buildings, where nothing is right."""
        bands = reliability(trials)
        squares = [(t.confidence - t.right) ** 2 for t in trials]
        differences = [abs(confidence - right) * count for confidence, right, count in bands]
        return ConfidenceError(
            trials=len(trials),
            brier=float(np.mean(squares)) if trials else None,
            expected_error=sum(differences) / len(trials) if trials else None,
            reliability=bands,
        )
