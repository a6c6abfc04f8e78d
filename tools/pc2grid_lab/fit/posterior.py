"""Fits the posterior and its factor in space to known truths, and judges both on buildings left out.

    python -m pc2grid_lab.fit.posterior EVIDENCE.json ... [--in-space]

Each file is one that `queries evidence` has written. An answer is judged by a fit without all answers whose
query or map is of one of its buildings. Prints by kind of query how many answers are right, and how many
would be located by the parameters in use and by those fitted without the building, rightly and wrongly; the
log loss; and the parameters for `pc2grid.matching.evidence`. With --in-space the same of
`signature.localization.in_space`: by the masses in the plane, the parameters in use, these with the
rays of places drawn at random, those fitted, and those fitted without the buildings of query and map.

Queries whose place was found and all others weigh the same in the fit, however many of each there are. So the
probability holds for queries half of which lie in the map.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from numpy.typing import NDArray
from scipy.optimize import minimize
from sklearn.metrics import roc_auc_score

from pc2grid.geometry import F64
from pc2grid.matching.evidence import EVIDENCE, Evidence, EvidenceParameters, masses
from pc2grid_lab.pages import clopper_pearson
from signature.config import Config
from signature.localization.in_space import SPACE, masses_in_space

RIGHT_M, RIGHT_RAD = 0.5, math.radians(5.0)
"""Errors of answers to real logs at the right place. How precise they are is not the question here; the poses
that count as true are good to some centimetres."""
NEAR_M = 1.0
"""Answers so near to the place of a query that is not in the map are left out: neither right nor wrong."""
QUERY_KINDS = {
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
        """Return whether the best place is where the query truly was."""
        return self.first == 0

    def probability(self, p: EvidenceParameters) -> float:
        """Return the mass of the best place."""
        return float(masses(self.places, p=p)[0]) if self.places else 0.0


def known_of(rows: Iterable[dict[str, Any]]) -> Iterator[Known]:
    """Yield the answers to real logs, without those to queries whose true pose is not known."""
    for row in rows:
        errors, own, blanked = row["errors"], row["log"] == row["map"], row["place"] == "blanked"
        beside = blanked and any(error_m < NEAR_M for error_m, _ in errors)
        if not errors or beside or (own and not math.isfinite(errors[0][0])):
            continue
        yield Known(
            kind=QUERY_KINDS[row["place"]],
            buildings=frozenset((row["log"], row["map"])),
            session=f"{row['log']} {row['start']}",
            places=tuple(Evidence(**evidence) for evidence in row["evidence"]),
            first=next((k for k, error in enumerate(errors) if own and is_near(error)), None),
        )


Q = TypeVar("Q", "Known", "Compared")
P = TypeVar("P")


def is_near(error: Sequence[float]) -> bool:
    """Return whether a place is right, by metres and radians from the truth."""
    return error[0] <= RIGHT_M and error[1] <= RIGHT_RAD


def fit(answers: Sequence[Known]) -> EvidenceParameters:
    """Fit the parameters bias, fit and lead under which the truth is likeliest; only the bias may be
    negative.

    Raises ValueError unless there are both queries whose place was found and others.
    """
    found = np.array([answer.first is not None for answer in answers])
    if found.all() or not found.any():
        raise ValueError("a fit needs queries whose place was found and others")
    weights = balanced(found)
    likelihood = _Likelihood.of(answers)

    def loss(x: F64) -> float:
        p = (1.0 - LAPSE) * likelihood.of_truth(x) + LAPSE
        return float(-weights @ np.log(p) + 0.5 * PENALTY * x @ x)

    start = np.array([EVIDENCE.bias, EVIDENCE.fit, EVIDENCE.lead])
    bounds = [(None, None), (0.0, None), (0.0, None)]
    bias, fit_, lead = minimize(loss, start, bounds=bounds, method="L-BFGS-B").x.tolist()
    return replace(EVIDENCE, bias=bias, fit=fit_, lead=lead)


@dataclass(frozen=True, slots=True)
class _Likelihood:
    """Of N answers with up to K places: terms (N, K, 3), and the number of the true place (N,), K for none.

    Places that are missing or without walls have terms (inf, 0, 0).
    """

    terms: F64
    first: NDArray[np.intp]

    @staticmethod
    def of(answers: Sequence[Known]) -> _Likelihood:
        most = max((len(a.places) for a in answers), default=0)
        terms = np.tile((np.inf, 0.0, 0.0), (len(answers), most, 1))
        for n, answer in enumerate(answers):
            for k, evidence in enumerate(answer.places):
                if evidence.compared:
                    terms[n, k] = evidence.terms
        first = np.array([most if a.first is None else a.first for a in answers])
        return _Likelihood(terms, first)

    def of_truth(self, x: F64) -> F64:
        """Return the probability (N,) of what is true, by bias, fit and lead."""
        given = np.isfinite(self.terms[:, :, 0])
        z = np.where(given, np.nan_to_num(self.terms, posinf=0.0) @ x, -700.0)
        odds = np.exp(np.clip(z, -700.0, 300.0))
        every = np.column_stack((odds, np.ones(len(odds))))
        return np.asarray(every[np.arange(len(odds)), self.first] / every.sum(axis=1))


def balanced(found: NDArray[np.bool_]) -> F64:
    """Return weights (N,), by which queries whose place was found weigh as much as all others."""
    return np.asarray(0.5 * np.where(found, 1.0 / max(found.sum(), 1), 1.0 / max((~found).sum(), 1)))


def left_out(queries: Sequence[Q], fit: Callable[[Sequence[Q]], P]) -> list[P]:
    """Return for each query what is fitted to those whose query and map are of none of its buildings."""
    models = {
        buildings: fit([q for q in queries if not q.buildings & buildings])
        for buildings in {q.buildings for q in queries}
    }
    return [models[q.buildings] for q in queries]


def log_loss(answers: Sequence[Known], probabilities: F64) -> float:
    """Return the mean negative logarithm of the probability (N,) of what is true."""
    right = np.array([answer.right for answer in answers])
    return float(-np.log(np.clip(np.where(right, probabilities, 1.0 - probabilities), 1e-4, 1.0)).mean())


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


_IN_USE = np.array([SPACE.on, SPACE.through, SPACE.before, SPACE.left])


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """A query whose places were compared in space.

    building : of the query. buildings : of query and map. in_plane : (P,) masses of its places in the plane.
    terms : (P, 4), what the parameters are multiplied with, NaN of a place that is not compared. right : the
    places that are truly the query's.
    """

    building: str
    buildings: frozenset[str]
    in_plane: F64
    terms: F64
    right: frozenset[int]

    def masses(self, x: F64) -> F64:
        """Return the masses (P,) by the parameters on, through, before and left."""
        return masses_in_space(self.in_plane, self.terms @ x)[0]

    def of_truth(self, x: F64) -> float:
        """Return the probability of what is true."""
        masses = self.masses(x)
        return float(masses[min(self.right)] if self.right else max(1.0 - masses.sum(), 0.0))


def compared_of(rows: Iterable[dict[str, Any]]) -> Iterator[Compared]:
    """Yield the queries whose places were compared in space, each once in a map."""
    compared = (row for row in rows if row.get("in_space"))
    # Two maps of one building have one name, but other evidence.
    once = {(row["start"], row["map"], str(row["evidence"])): row for row in compared}
    for row in once.values():
        places = [Evidence(**told) for told in row["evidence"]]
        terms, errors = np.full((len(places), 4), np.nan), dict(enumerate(row["errors"]))
        for place, told in row["in_space"].items():
            terms[int(place)], errors[int(place)] = told["terms"], told["error"]
        yield Compared(
            building=row["log"],
            buildings=frozenset((row["log"], row["map"])),
            in_plane=masses(places),
            terms=terms,
            right=frozenset(k for k, error in errors.items() if is_near(error)),
        )


def fit_factor_in_space(queries: Sequence[Compared]) -> F64:
    """Fit the parameters (4,) under which the truth is likeliest."""
    weights = balanced(np.array([bool(q.right) for q in queries]))

    def loss(x: F64) -> float:
        p = np.array([q.of_truth(x * _IN_USE) for q in queries])
        return float(-weights @ np.log((1.0 - LAPSE) * p + LAPSE) + 0.5 * PENALTY * x @ x)

    # The masses of alike places are those of the best of them, so the loss has edges.
    return np.asarray(minimize(loss, np.ones(4), method="Nelder-Mead", options={"xatol": 0.01}).x * _IN_USE)


def shuffled(queries: Sequence[Compared]) -> list[Compared]:
    """Return the control that must fail: each place gets the rays of a place drawn at random."""
    rng = np.random.default_rng(0)
    every = np.concatenate([q.terms for q in queries])
    every = every[np.isfinite(every).all(axis=1)]

    def drawn(terms: F64) -> F64:
        compared = np.isfinite(terms).all(axis=1, keepdims=True)
        return np.where(compared, every[rng.integers(len(every), size=len(terms))], np.nan)

    return [replace(q, terms=drawn(q.terms)) for q in queries]


def print_in_space(queries: Sequence[Compared], name: str, masses: Iterable[F64]) -> None:
    """Print what is located by masses (P,), rightly and wrongly, by building of the query."""
    asked, right, wrong = Counter[str](), Counter[str](), Counter[str]()
    for query, mass in zip(queries, masses, strict=True):
        asked[query.building] += len(query.buildings) == 1
        if mass.max(initial=0.0) >= Config().relocalize.accept:
            (right if int(mass.argmax()) in query.right else wrong)[query.building] += 1
    told = ", ".join(f"{b} {right[b]} of {asked[b]}, {wrong[b]} wrong" for b in sorted(asked))
    totals = f"{right.total()} of {asked.total()} right, {wrong.total()} of {len(queries)} wrong"
    print(f"{name}: {totals} ({told})")


def print_plane(rows: Sequence[dict[str, Any]]) -> None:
    """Fit, judge and print the numbers of the posterior in the plane."""
    known = list(known_of(rows))
    for buildings in {k.buildings for k in known}:
        if len({k.first is None for k in known if not k.buildings & buildings}) < 2:
            raise SystemExit(
                "the fit is judged by leaving buildings out, and without"
                f" {' and '.join(sorted(buildings))} not both kinds of queries are left: found and not"
            )
    in_use = np.array([k.probability(EVIDENCE) for k in known])
    judged_by = [k.probability(p) for k, p in zip(known, left_out(known, fit), strict=True)]
    for name, probabilities in (("in use", in_use), ("fitted without the building", np.array(judged_by))):
        print_judged(known, name, probabilities)
    print(fit(known))


def print_space(rows: Sequence[dict[str, Any]]) -> None:
    """Fit, judge and print those of its factor in space."""
    queries = list(compared_of(rows))
    in_space = fit_factor_in_space(queries)
    judged = (q.masses(x) for q, x in zip(queries, left_out(queries, fit_factor_in_space), strict=True))
    print_in_space(queries, "in the plane", (q.in_plane for q in queries))
    print_in_space(queries, "in use", (q.masses(_IN_USE) for q in queries))
    print_in_space(queries, "in use, shuffled", (q.masses(_IN_USE) for q in shuffled(queries)))
    print_in_space(queries, "fitted", (q.masses(in_space) for q in queries))
    print_in_space(queries, "fitted without the building", judged)
    print("on, through, before, left:", *(f"{value:.1f}" for value in in_space))


def main(
    files: list[Path],
    in_space: Annotated[bool, typer.Option("--in-space", help="its factor in space")] = False,
) -> None:
    """Fit, judge and print. FILES: what `queries evidence` has written."""
    rows = [row for file in files for row in json.loads(file.read_text())]
    (print_space if in_space else print_plane)(rows)


if __name__ == "__main__":
    typer.run(main)
