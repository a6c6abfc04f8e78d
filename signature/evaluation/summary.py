"""Many trials in few numbers: the cells of the sensor matrix, and whether confidence is true."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from signature.evaluation.contribution import COMBINATIONS
from signature.evaluation.trial import MAPPED, Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One cell of the matrix after some metres: shares of its trials, 0..1, and errors of the right ones.

    located_right : answered located, and it was. wrong : of those answered located, how many were not.
    recall : of the first right place among the first 1, 5 and 20 retrieved.
    """

    map_sensor: str
    query_sensor: str
    travel_m: float
    trials: int
    located_right: float
    wrong: float
    ambiguous: float
    not_found: float
    recall: dict[int, float]
    median_error_m: float
    p95_error_m: float
    look_up_ms: float


def matrix(trials: Sequence[Trial]) -> list[Cell]:
    """The trials in mapped parts of their own building, by map sensor, query sensor and travel."""
    groups: dict[tuple[str, str, float], list[Trial]] = {}
    for trial in trials:
        if trial.in_building and trial.mapped >= MAPPED:
            groups.setdefault((trial.map_sensor, trial.query_sensor, trial.travel_m), []).append(trial)
    cells = []
    for (map_sensor, query_sensor, travel_m), members in sorted(groups.items()):
        located = [t for t in members if t.status == "located"]
        errors = np.array([t.error_m for t in located if t.right]) if located else np.empty(0)
        cells.append(
            Cell(
                map_sensor=map_sensor,
                query_sensor=query_sensor,
                travel_m=travel_m,
                trials=len(members),
                located_right=sum(t.right for t in located) / len(members),
                wrong=sum(not t.right for t in located) / max(len(located), 1),
                ambiguous=sum(t.status == "ambiguous" for t in members) / len(members),
                not_found=sum(t.status == "not_found" for t in members) / len(members),
                recall=_recall([t.rank for t in members]),
                median_error_m=float(np.median(errors)) if len(errors) else math.nan,
                p95_error_m=float(np.percentile(errors, 95)) if len(errors) else math.nan,
                look_up_ms=float(np.median([t.look_up_ms for t in members])),
            )
        )
    return cells


def reliability(trials: Sequence[Trial], bins: int = 10) -> list[tuple[float, float, int]]:
    """For each band of confidence with trials in it: mean confidence, share that was right, how many."""
    rows = []
    for k in range(bins):
        members = [
            t
            for t in trials
            if k / bins <= t.confidence < (k + 1) / bins or (k + 1 == bins and t.confidence == 1)
        ]
        if members:
            rows.append(
                (
                    float(np.mean([t.confidence for t in members])),
                    sum(t.right for t in members) / len(members),
                    len(members),
                )
            )
    return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Truthfulness:
    """How far confidence can be believed.

    brier : mean squared difference of confidence and truth (0 or 1); 0 is best.
    expected_error : mean difference of confidence and the share that was right, over ten bands (ECE).
    """

    trials: int
    brier: float
    expected_error: float

    @staticmethod
    def of(trials: Sequence[Trial]) -> Truthfulness:
        """Over all answers, those about other buildings too, where nothing is right."""
        differences = [(t.confidence - t.right) ** 2 for t in trials]
        bands = reliability(trials)
        return Truthfulness(
            trials=len(trials),
            brier=float(np.mean(differences)) if trials else math.nan,
            expected_error=sum(abs(said - true) * count for said, true, count in bands) / len(trials)
            if trials
            else math.nan,
        )


def ablation(trials: Sequence[Trial], travel_m: float) -> dict[str, dict[str, dict[int, float]]]:
    """Recall at 1, 5 and 20 after some metres, by query sensor (and "all") and by what is used: each of
    `COMBINATIONS`, and "with isovists", all three with the comparison of isovists behind them."""
    members = [t for t in trials if t.in_building and t.mapped >= MAPPED and t.travel_m == travel_m]
    found: dict[str, dict[str, dict[int, float]]] = {}
    for sensor in ("all", *sorted({t.query_sensor for t in members})):
        chosen = [t for t in members if sensor in ("all", t.query_sensor)]
        found[sensor] = {name: _recall([t.alone[name] for t in chosen]) for name in COMBINATIONS}
        found[sensor]["with isovists"] = _recall([t.rank for t in chosen])
    return found


def _recall(ranks: Sequence[int]) -> dict[int, float]:
    found = np.array([rank if rank >= 0 else 10**6 for rank in ranks])
    return {k: float(np.mean(found < k)) if len(found) else math.nan for k in (1, 5, 20)}
