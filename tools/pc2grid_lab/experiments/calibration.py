"""Fits the confidence to answers whose truth is known, and judges it on buildings that were left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import mannwhitneyu

from pc2grid.arrays import F64
from signature.localization.confidence import Calibration, Evidence


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """An answer whose truth is known.

    buildings : of the query and of the map; the answer is judged by a fit without any answer of these.
    right : whether the best hypothesis is where the query truly was. session : the drive it belongs to;
    answers of one drive depend on each other. weight : of the answer in a fit.
    """

    buildings: frozenset[str]
    session: str
    evidence: Evidence
    right: bool
    weight: float = 1.0


def fit(answers: Sequence[Known], share_right: float | None = None) -> Calibration:
    """Coefficients of highest likelihood (logistic regression), none of them but the bias below 0.

    share_right : the right answers weigh so much of all together, 0..1, however many of each there are; None:
    as much as their weights say. Raises ValueError unless there are both right and wrong answers.
    """
    right = np.array([answer.right for answer in answers])
    if right.all() or not right.any():
        raise ValueError("a fit needs right and wrong answers")
    terms = np.array([answer.evidence.terms for answer in answers])
    sign = np.where(right, 1.0, -1.0)
    weights = np.array([answer.weight for answer in answers])
    weights /= weights.sum()
    if share_right is not None:
        share = float(weights[right].sum())
        weights = weights * np.where(right, share_right / share, (1.0 - share_right) / (1.0 - share))

    def loss(x: F64) -> tuple[float, F64]:
        margin = sign * (terms @ x)
        slope = -weights * sign / (1.0 + np.exp(np.clip(margin, -500.0, 500.0)))
        penalty = _PENALTY * x
        return float(weights @ np.logaddexp(0.0, -margin) + 0.5 * penalty @ x), slope @ terms + penalty

    bounds = [(None, None), (0.0, None), (0.0, None)]
    found = minimize(loss, np.array([0.0, 1.0, 1.0]), jac=True, bounds=bounds, method="L-BFGS-B")
    bias, support, clearance = found.x.tolist()
    return Calibration(bias=bias, support=support, clearance=clearance)


def left_out(
    answers: Sequence[Known], share_right: float | None = None, *, fitted_to: Sequence[Known] | None = None
) -> F64:
    """(N,) probability of each answer by the coefficients fitted (see `fit`) to the answers in which neither
    query nor map is of one of its buildings.

    fitted_to : answers that the coefficients are fitted to; None: `answers`.
    """
    models = {
        buildings: fit([a for a in fitted_to or answers if not a.buildings & buildings], share_right)
        for buildings in {answer.buildings for answer in answers}
    }
    return np.array([models[answer.buildings].probability(answer.evidence) for answer in answers])


def log_losses(answers: Sequence[Known], probabilities: F64) -> F64:
    """(N,) negative logarithm of the probability of what is true."""
    right = np.array([answer.right for answer in answers])
    return np.asarray(-np.log(np.clip(np.where(right, probabilities, 1.0 - probabilities), 1e-4, 1.0)))


def log_loss(answers: Sequence[Known], probabilities: F64) -> float:
    """Mean of `log_losses`."""
    return float(log_losses(answers, probabilities).mean())


def roc_area(answers: Sequence[Known], probabilities: F64) -> float:
    """Area under the ROC curve: how often a right answer is surer than a wrong one."""
    right = np.array([answer.right for answer in answers])
    return area(probabilities[right], probabilities[~right])


def area(larger: F64, smaller: F64) -> float:
    """Probability that a value of `larger` exceeds one of `smaller`: the area under the ROC curve.

    It is computed by the Mann-Whitney statistic. 0.5 is chance, 1 is perfect; NaN if either is empty.
    """
    if not len(larger) or not len(smaller):
        return float("nan")
    statistic = mannwhitneyu(larger, smaller, method="asymptotic").statistic
    return float(statistic / (len(larger) * len(smaller)))


def share_by_session(
    sessions: Sequence[str | int],
    yes: NDArray[np.bool_],
    *,
    draws: int = 1000,
    seed: int = 0,
    percentiles: tuple[float, float] = (5.0, 95.0),
) -> tuple[float, float, float]:
    """A share, and its percentiles when whole sessions are drawn anew (bootstrap).

    sessions : of each answer, which need not be independent within one. yes : (N,).
    """
    names, number = np.unique(np.asarray(sessions), return_inverse=True)
    count, hits = np.bincount(number), np.bincount(number, weights=yes)
    drawn = np.random.default_rng(seed).integers(0, len(names), (draws, len(names)))
    shares = hits[drawn].sum(axis=1) / count[drawn].sum(axis=1)
    low, high = np.percentile(shares, percentiles).tolist()
    return float(np.mean(yes)), low, high


_PENALTY = 1e-4
"""Weight of the squared coefficients in the loss: keeps them finite where the answers can be told apart
without error."""
