"""Fits the posterior to queries whose truth is known, and judges it on buildings that were left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import beta, mannwhitneyu

from pc2grid.arrays import F64
from signature.localization.posterior import POSTERIOR, Evidence, PosteriorParameters, masses

MOST_WRONG = 0.025
"""Of the answers that are given, at most this share is to be wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """A query whose truth is known, asked in one map.

    buildings : of the query and of the map; the answer is judged by a fit without any answer of these.
    session : the drive it belongs to; answers of one drive depend on each other.
    places : what tells for each place that was found, best first. first : number of the place that was
    truly the query's, None if it was none of them. weight : of the answer in a fit.
    """

    buildings: frozenset[str]
    session: str
    places: tuple[Evidence, ...]
    first: int | None
    weight: float = 1.0

    @property
    def right(self) -> bool:
        """Whether the best place is where the query truly was."""
        return self.first == 0

    def probability(self, p: PosteriorParameters) -> float:
        """Mass of the best place."""
        return float(masses(self.places, p=p)[0]) if self.places else 0.0


def fit(answers: Sequence[Known], share_found: float | None = None) -> PosteriorParameters:
    """The parameters bias, fit and lead under which the truth is likeliest; only the bias may be negative.

    The rate of slips stays as it is in use: queries in which tracking slips are too rare to tell it.

    share_found : the answers whose true place was found weigh so much of all together, 0..1, however many of
    each there are; None: as much as their weights say. Raises ValueError unless there are both kinds.
    """
    found = np.array([answer.first is not None for answer in answers])
    if found.all() or not found.any():
        raise ValueError("a fit needs queries whose place was found and others")
    weights = np.array([answer.weight for answer in answers])
    weights /= weights.sum()
    if share_found is not None:
        share = float(weights[found].sum())
        weights = weights * np.where(found, share_found / share, (1.0 - share_found) / (1.0 - share))
    likelihood = _Likelihood.of(answers)

    def loss(x: F64) -> float:
        p = (1.0 - _LAPSE) * likelihood.of_truth(x) + _LAPSE
        return float(-weights @ np.log(p) + 0.5 * _PENALTY * x @ x)

    in_use = POSTERIOR
    start = np.array([in_use.bias, in_use.fit, in_use.lead])
    bounds = [(None, None), (0.0, None), (0.0, None)]
    bias, fit_, lead = minimize(loss, start, bounds=bounds, method="L-BFGS-B").x.tolist()
    return replace(in_use, bias=bias, fit=fit_, lead=lead)


@dataclass(frozen=True, slots=True)
class _Likelihood:
    """Of N answers with up to K places: terms (N, K, 3), tails (N, T) of the best place, and the number of
    the true place (N,), K for none.

    Places that are missing or without walls have terms (inf, 0, 0); missing tails are inf.
    """

    terms: F64
    tails: F64
    first: NDArray[np.intp]

    @staticmethod
    def of(answers: Sequence[Known]) -> _Likelihood:
        most = max((len(a.places) for a in answers), default=0)
        longest = max((len(e.tail) for a in answers for e in a.places), default=0)
        terms = np.tile((np.inf, 0.0, 0.0), (len(answers), most, 1))
        tails = np.full((len(answers), longest), np.inf)
        for n, answer in enumerate(answers):
            for k, evidence in enumerate(answer.places):
                if evidence.walls:
                    terms[n, k] = evidence.terms
                tails[n, : len(evidence.tail)] = evidence.tail
        first = np.array([most if a.first is None else a.first for a in answers])
        return _Likelihood(terms, tails, first)

    def of_truth(self, x: F64) -> F64:
        """(N,) probability of what is true, by bias, fit and lead."""
        given = np.isfinite(self.terms[:, :, 0])
        z = np.where(given, np.nan_to_num(self.terms, posinf=0.0) @ x, -700.0)
        odds = np.exp(np.clip(z, -700.0, 300.0))
        lost = (
            POSTERIOR.slip
            * np.exp(-x[1] * np.minimum(self.tails, 700.0)).sum(axis=1)
            * odds[:, :1].sum(axis=1)
        )
        every = np.column_stack((odds, np.ones(len(odds))))
        lost_or_nowhere = np.where(self.first == odds.shape[1], lost, 0.0)
        truth = every[np.arange(len(odds)), self.first] + lost_or_nowhere
        return np.asarray(truth / (every.sum(axis=1) + lost))


def left_out(
    answers: Sequence[Known], share_found: float | None = None, *, fitted_to: Sequence[Known] | None = None
) -> F64:
    """(N,) mass of the best place of each answer by the parameters fitted (see `fit`) to the answers in which
    neither query nor map is of one of its buildings.

    fitted_to : answers that the parameters are fitted to; None: `answers`.
    """
    models = {
        buildings: fit([a for a in fitted_to or answers if not a.buildings & buildings], share_found)
        for buildings in {answer.buildings for answer in answers}
    }
    return np.array([answer.probability(models[answer.buildings]) for answer in answers])


def accept_of(
    right: NDArray[np.bool_], probabilities: F64, most_wrong: float = MOST_WRONG, least: float = 0.5
) -> float:
    """The least mass from which an answer is given such that at most the share `most_wrong` of those that are
    given, with this mass or more, is wrong; 1 if there is none.

    right, probabilities : (N,) of the answers. least : lower values are not tried: what is less probable than
    all else is no answer.
    """
    order = np.argsort(-probabilities, kind="stable")
    wrong = np.cumsum(~right[order])
    enough = (wrong <= most_wrong * np.arange(1, len(order) + 1)) & (probabilities[order] >= least)
    # Answers of equal mass are given together or not at all.
    enough &= np.append(np.diff(probabilities[order]) < 0.0, True)
    return float(probabilities[order][enough].min(initial=1.0))


def accepted(
    answers: Sequence[Known], share_found: float | None = None, most_wrong: float = MOST_WRONG
) -> NDArray[np.bool_]:
    """(N,) whether each answer is given, by parameters and by a least mass (see `accept_of`) that are both
    chosen without its buildings."""
    given = np.zeros(len(answers), bool)
    for buildings in {answer.buildings for answer in answers}:
        others = [a for a in answers if not a.buildings & buildings]
        p = fit(others, share_found)
        right = np.array([a.right for a in others])
        least = accept_of(right, np.array([a.probability(p) for a in others]), most_wrong)
        for k, answer in enumerate(answers):
            if answer.buildings == buildings:
                given[k] = answer.probability(p) >= least
    return given


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


def share_by_building(
    buildings: Sequence[frozenset[str]],
    sessions: Sequence[str],
    yes: NDArray[np.bool_],
    *,
    draws: int = 1000,
    seed: int = 0,
    percentiles: tuple[float, float] = (5.0, 95.0),
) -> tuple[float, float, float]:
    """A share, and its percentiles when buildings are drawn anew, and of each of these its drives: in other
    buildings and drives it will lie between them.

    buildings, sessions : of each answer. yes : (N,).
    """
    drives: dict[frozenset[str], dict[str, list[int]]] = {}
    for k, (building, session) in enumerate(zip(buildings, sessions, strict=True)):
        drives.setdefault(building, {}).setdefault(session, []).append(k)
    # (drives, 2) of each building: answers, and those that are counted.
    counts = [
        np.array([(len(rows), np.count_nonzero(yes[rows])) for rows in of_building.values()])
        for of_building in drives.values()
    ]
    rng = np.random.default_rng(seed)
    shares = []
    for _ in range(draws):
        drawn = [counts[b] for b in rng.integers(0, len(counts), len(counts))]
        answers, hits = sum(c[rng.integers(0, len(c), len(c))].sum(axis=0) for c in drawn)
        shares.append(hits / answers)
    low, high = np.percentile(shares, percentiles).tolist()
    return float(np.mean(yes)), low, high


def clopper_pearson(hits: int, of: int, confidence: float = 0.9) -> tuple[float, float]:
    """The interval of a share by `hits` of `of` independent trials (Clopper and Pearson 1934)."""
    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, hits, of - hits + 1)) if hits else 0.0
    return low, float(beta.ppf(1.0 - tail, hits + 1, of - hits)) if hits < of else 1.0


_LAPSE = 0.1
"""Share of the truths that are taken to be none: a query whose map is wrong, or whose place no equation would
find, does not decide the fit."""
_PENALTY = 1e-3
"""Weight of the squared bias, fit and lead in the loss: keeps them finite where the answers can be told apart
without error. By hand; with a tenth of it, what is judged on buildings that were left out is too sure."""
