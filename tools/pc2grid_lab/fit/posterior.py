"""Fits the posterior to queries whose truth is known, and judges it on buildings that were left out.

    python -m pc2grid_lab.fit.posterior EVIDENCE.json ...

Each file is one that `recorded_queries` has written. An answer is judged by a fit without all answers whose
query or map is of one of its buildings. Prints by kind of query how many answers are right, and how many
would be located by the parameters in use and by those fitted without the building, rightly and wrongly; the
log loss; and the parameters for `signature.localization.posterior`.

Queries whose place was found and all others weigh the same in the fit, however many of each there are. So the
probability holds for queries half of which lie in the map.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.optimize import minimize
from sklearn.metrics import roc_auc_score

from pc2grid.geometry import F64
from pc2grid_lab.experiments.recordings.page import clopper_pearson
from signature.config import Config
from signature.localization.posterior import POSTERIOR, Evidence, PosteriorParameters, masses

RIGHT_M, RIGHT_RAD = 0.5, math.radians(5.0)
"""Errors of answers to real logs at the right place. How precise they are is not the question here; the poses
that count as true are good to some centimetres."""
NEAR_M = 1.0
"""Answers so near to the place of a query that is not in the map are left out: neither right nor wrong."""
KINDS = {
    "in the map": "in its own building",
    "elsewhere": "in another building",
    "blanked": "place blanked",
}
"""What is printed of the places of `recorded_queries`."""
LAPSE = 0.1
"""Share of the truths that are taken to be none: a query whose map is wrong, or whose place no equation would
find, does not decide the fit."""
PENALTY = 1e-3
"""Weight of the squared bias, fit and lead in the loss: keeps them finite where the answers can be told apart
without error. By hand; with a tenth of it, what is judged on buildings that were left out is too sure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """A query whose truth is known, asked in one map.

    kind : of query and map. buildings : of both. session : the drive it belongs to; answers of one drive
    depend on each other. places : what tells for each place that was found, best first. first : number of the
    place that was truly the query's, None if it was none of them.
    """

    kind: str
    buildings: frozenset[str]
    session: str
    places: tuple[Evidence, ...]
    first: int | None

    @property
    def right(self) -> bool:
        """Whether the best place is where the query truly was."""
        return self.first == 0

    def probability(self, p: PosteriorParameters) -> float:
        """Mass of the best place."""
        return float(masses(self.places, p=p)[0]) if self.places else 0.0


def known_of(rows: Iterable[dict[str, Any]]) -> Iterator[Known]:
    """Answers to real logs, without those to queries whose true pose is not known."""
    for row in rows:
        errors, own, blanked = row["errors"], row["log"] == row["map"], row["place"] == "blanked"
        beside = blanked and any(error_m < NEAR_M for error_m, _ in errors)
        if not errors or beside or (own and not math.isfinite(errors[0][0])):
            continue
        yield Known(
            kind=KINDS[row["place"]],
            buildings=frozenset((row["log"], row["map"])),
            session=f"{row['log']} {row['start']}",
            places=tuple(Evidence(**evidence) for evidence in row["evidence"]),
            first=_first_right(errors) if own else None,
        )


def _first_right(errors: Sequence[tuple[float, float]]) -> int | None:
    """The number of the first place that is right, by metres and radians from the truth."""
    return next((k for k, error in enumerate(errors) if is_right(error)), None)


def is_right(error: Sequence[float]) -> bool:
    """Whether a place is right, by metres and radians from the truth."""
    return error[0] <= RIGHT_M and error[1] <= RIGHT_RAD


def fit(answers: Sequence[Known]) -> PosteriorParameters:
    """The parameters bias, fit and lead under which the truth is likeliest; only the bias may be negative.

    The rate of slips stays as it is in use: queries in which tracking slips are too rare to tell it.
    Raises ValueError unless there are both queries whose place was found and others.
    """
    found = np.array([answer.first is not None for answer in answers])
    if found.all() or not found.any():
        raise ValueError("a fit needs queries whose place was found and others")
    weights = 0.5 * np.where(found, 1.0 / found.sum(), 1.0 / (~found).sum())
    likelihood = _Likelihood.of(answers)

    def loss(x: F64) -> float:
        p = (1.0 - LAPSE) * likelihood.of_truth(x) + LAPSE
        return float(-weights @ np.log(p) + 0.5 * PENALTY * x @ x)

    start = np.array([POSTERIOR.bias, POSTERIOR.fit, POSTERIOR.lead])
    bounds = [(None, None), (0.0, None), (0.0, None)]
    bias, fit_, lead = minimize(loss, start, bounds=bounds, method="L-BFGS-B").x.tolist()
    return replace(POSTERIOR, bias=bias, fit=fit_, lead=lead)


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


def left_out(answers: Sequence[Known]) -> F64:
    """(N,) mass of the best place of each answer by the parameters fitted to the answers in which neither
    query nor map is of one of its buildings."""
    models = {
        buildings: fit([a for a in answers if not a.buildings & buildings])
        for buildings in {answer.buildings for answer in answers}
    }
    return np.array([answer.probability(models[answer.buildings]) for answer in answers])


def log_loss(answers: Sequence[Known], probabilities: F64) -> float:
    """Mean negative logarithm of the probability (N,) of what is true."""
    right = np.array([answer.right for answer in answers])
    return float(-np.log(np.clip(np.where(right, probabilities, 1.0 - probabilities), 1e-4, 1.0)).mean())


def main(files: list[Path]) -> None:
    """Fit, judge and print. FILES: what `recorded_queries` has written."""
    known = [k for file in files for k in known_of(json.loads(file.read_text()))]
    for buildings in {k.buildings for k in known}:
        if len({k.first is None for k in known if not k.buildings & buildings}) < 2:
            raise SystemExit(
                "the fit is judged by leaving buildings out, and without"
                f" {' and '.join(sorted(buildings))} not both kinds of queries are left: found and not"
            )
    in_use = np.array([k.probability(POSTERIOR) for k in known])
    for name, probabilities in (("in use", in_use), ("fitted without the building", left_out(known))):
        print_judged(known, name, probabilities)
    print(fit(known))


def print_judged(known: Sequence[Known], name: str, probabilities: F64) -> None:
    """Print how good the probabilities (N,) are, and what is located by them, by kind of query."""
    located = [k for k, p in zip(known, probabilities, strict=True) if p >= Config().relocalize.accept]
    asked, found = (Counter((k.kind, k.right) for k in some) for some in (known, located))
    for kind in sorted({k.kind for k in known}):
        print(
            f"{name}, {kind}: of {asked[kind, True] + asked[kind, False]} located {found[kind, True]} of"
            f" {asked[kind, True]} right ones, {found[kind, False]} wrong ones"
        )
    # Windows of one drive depend on each other: a drive with a wrong answer counts once.
    drives, wrong_in = {k.session for k in located}, {k.session for k in located if not k.right}
    least, most = clopper_pearson(len(wrong_in), len(drives), 0.1) if drives else (0.0, 1.0)
    print(
        f"{name}: log loss {log_loss(known, probabilities):.4f}, area under the ROC curve"
        f" {roc_auc_score([k.right for k in known], probabilities):.4f}, wrong in {len(wrong_in)} of"
        f" {len(drives)} drives (90 %: {least:.2%} to {most:.2%})"
    )


if __name__ == "__main__":
    typer.run(main)
