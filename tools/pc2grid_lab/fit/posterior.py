"""Fits the posterior and its factor in space to known truths, and judges both on buildings left out.

    python -m pc2grid_lab.fit.posterior EVIDENCE.json ... [--in-space]

Each file is one that `queries evidence` has written. An answer is judged by a fit without all answers whose
query or map is of one of its buildings. Prints for the parameters in use, for those fitted, and for those
fitted without the buildings of query and map: how many queries would be located, rightly and wrongly, in all
and by kind of query, and the log loss; and the parameters for `pc2grid.matching.evidence`. With --in-space
those for `signature.localization.posterior`, and the same also by the masses in the plane, and by the
parameters in use with the rays of places drawn at random.

Queries whose place was found and all others weigh the same in the fit, however many of each there are. So the
probability holds for queries half of which lie in the map.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from scipy.optimize import minimize
from scipy.special import softmax
from sklearn.metrics import roc_auc_score

from pc2grid.geometry import F64
from pc2grid.matching.evidence import EVIDENCE, Evidence, masses
from pc2grid_lab.pages import share
from signature.config import Config
from signature.localization.posterior import SPACE, masses_in_space

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
"""What is printed of the places of `queries evidence`."""
LAPSE = 0.1
"""Share of the truths that are taken to be none: a query whose map is wrong, or whose place no equation would
find, does not decide the fit."""
PENALTY = 1e-3
"""Weight of the squared parameters in the loss: keeps them finite where the answers can be told apart without
error. By hand; with a tenth of it, what is judged on buildings that were left out is too sure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """A query whose truth is known, asked in one map.

    kind : of query and map. buildings : of both. session : the drive it belongs to; answers of one drive
    depend on each other. terms : (P, K), what the parameters are multiplied with for each place that was
    found, NaN of a place without. right : the places that are truly the query's.
    in_plane : (P,) masses of the places in the plane, if they were compared in space.
    """

    kind: str
    buildings: frozenset[str]
    session: str
    terms: F64
    right: frozenset[int]
    in_plane: F64 | None = None

    def masses(self, x: F64) -> F64:
        """Return the masses (P,) of the places by parameters (K,): as `matching.evidence.masses` and
        `masses_in_space` do."""
        u = self.terms @ x
        if self.in_plane is not None:
            return masses_in_space(self.in_plane, u)[0]
        every = np.concatenate(([0.0], np.nan_to_num(u, nan=-math.inf)))
        return np.asarray(softmax(every)[1:])

    def of_truth(self, x: F64) -> float:
        """Return the probability of what is true."""
        every = self.masses(x)
        return float(every[min(self.right)] if self.right else max(1.0 - every.sum(), 0.0))


def known_of(rows: Iterable[dict[str, Any]]) -> Iterator[Known]:
    """Yield the answers to real logs, without those to queries whose true pose is not known."""
    for row in rows:
        errors, own, blanked = row["errors"], row["log"] == row["map"], row["place"] == "blanked"
        beside = blanked and any(error_m < NEAR_M for error_m, _ in errors)
        if not errors or beside or (own and not math.isfinite(errors[0][0])):
            continue
        places = [Evidence(**told) for told in row["evidence"]]
        terms = [place.terms if place.compared else (math.nan,) * 3 for place in places]
        yield _known(row, np.array(terms), errors if own else ())


def compared_of(rows: Iterable[dict[str, Any]]) -> Iterator[Known]:
    """Yield the queries whose places were compared in space, each once in a map."""
    compared = (row for row in rows if row.get("in_space"))
    # Two maps of one building have one name, but other evidence.
    once = {(row["start"], row["map"], str(row["evidence"])): row for row in compared}
    for row in once.values():
        places = [Evidence(**told) for told in row["evidence"]]
        terms, errors = np.full((len(places), len(IN_SPACE)), np.nan), list(row["errors"])
        for place, told in row["in_space"].items():
            terms[int(place)], errors[int(place)] = told["terms"], told["error"]
        yield replace(_known(row, terms, errors), in_plane=masses(places))


def _known(row: dict[str, Any], terms: F64, errors: Sequence[Sequence[float]]) -> Known:
    """Return a query. errors : metres and radians of its places from the truth."""
    right = (k for k, (off_m, off_rad) in enumerate(errors) if off_m <= RIGHT_M and off_rad <= RIGHT_RAD)
    return Known(
        kind=QUERY_KINDS[row["place"]],
        buildings=frozenset((row["log"], row["map"])),
        session=f"{row['log']} {row['start']}",
        terms=terms,
        right=frozenset(right),
    )


IN_PLANE = np.array([EVIDENCE.bias, EVIDENCE.fit, EVIDENCE.lead])
IN_SPACE = np.array([SPACE.on, SPACE.through, SPACE.before, SPACE.left])
"""The parameters in use."""


def fit(queries: Sequence[Known], in_use: F64, unit: F64 | float = 1.0) -> F64:
    """Fit the parameters under which the truth is likeliest, from those in use on; each keeps its sign.

    unit : in which the squared parameters are small. Raises ValueError unless there are both queries whose
    place was found and others.
    """
    found = np.array([bool(q.right) for q in queries])
    if found.all() or not found.any():
        raise ValueError("a fit needs queries whose place was found and others")
    # Those whose place was found weigh as much as all others.
    weights = 0.5 * np.where(found, 1.0 / found.sum(), 1.0 / (~found).sum())

    def loss(x: F64) -> float:
        p = np.array([q.of_truth(x * unit) for q in queries])
        return float(-weights @ np.log((1.0 - LAPSE) * p + LAPSE) + 0.5 * PENALTY * x @ x)

    start = in_use / unit
    bounds = [(0.0, None) if value > 0.0 else (None, 0.0) for value in start]
    # The masses of alike places are those of the best of them, so the loss has edges.
    options = {"xatol": 0.01}
    return np.asarray(minimize(loss, start, bounds=bounds, method="Nelder-Mead", options=options).x * unit)


def left_out(queries: Sequence[Known], fit: Callable[[Sequence[Known]], F64]) -> list[F64]:
    """Return for each query what is fitted to those whose query and map are of none of its buildings."""
    models = {
        buildings: fit([q for q in queries if not q.buildings & buildings])
        for buildings in {q.buildings for q in queries}
    }
    return [models[q.buildings] for q in queries]


def shuffled(queries: Sequence[Known]) -> list[Known]:
    """Return the control that must fail: each place gets the rays of a place drawn at random."""
    rng = np.random.default_rng(0)
    every = np.concatenate([q.terms for q in queries])
    every = every[np.isfinite(every).all(axis=1)]

    def drawn(terms: F64) -> F64:
        compared = np.isfinite(terms).all(axis=1, keepdims=True)
        return np.where(compared, every[rng.integers(len(every), size=len(terms))], np.nan)

    return [replace(q, terms=drawn(q.terms)) for q in queries]


def print_judged(queries: Sequence[Known], name: str, masses: Iterable[F64]) -> None:
    """Print what is located by the masses (P,) of each query, rightly and wrongly, and how good they are."""
    best = [(int(mass.argmax()), float(mass.max())) for mass in masses]
    rights, sure = ([k in q.right for q, (k, _) in zip(queries, best, strict=True)], np.array(best)[:, 1])
    located = (sure >= Config().relocalize.accept).tolist()
    count = Counter(zip((q.kind for q in queries), located, rights, strict=True))
    for kind in sorted({q.kind for q in queries}):
        right, wrong = count[kind, True, True], count[kind, True, False]
        all_right = right + count[kind, False, True]
        every = all_right + wrong + count[kind, False, False]
        print(f"{name}, {kind}: of {every} located {right} of {all_right} right ones, {wrong} wrong ones")
    loss = -np.log(np.clip(np.where(rights, sure, 1.0 - sure), 1e-4, 1.0)).mean()
    # Windows of one drive depend on each other: a drive with a wrong answer counts once.
    some = [(q.session, right) for q, is_in, right in zip(queries, located, rights, strict=True) if is_in]
    drives, wrong_in = {session for session, _ in some}, {session for session, right in some if not right}
    print(
        f"{name}: log loss {loss:.4f}, area under the ROC curve {roc_auc_score(rights, sure):.4f},"
        f" drives with a wrong answer: {share(len(wrong_in), len(drives))}"
    )


def main(
    files: list[Path],
    in_space: Annotated[bool, typer.Option("--in-space", help="its factor in space")] = False,
) -> None:
    """Fit, judge and print. FILES: what `queries evidence` has written."""
    rows = [row for file in files for row in json.loads(file.read_text())]
    queries = list(compared_of(rows) if in_space else known_of(rows))
    for buildings in {q.buildings for q in queries}:
        if len({bool(q.right) for q in queries if not q.buildings & buildings}) < 2:
            raise SystemExit(
                "the fit is judged by leaving buildings out, and without"
                f" {' and '.join(sorted(buildings))} not both kinds of queries are left: found and not"
            )
    in_use = IN_SPACE if in_space else IN_PLANE
    fitted_to = partial(fit, in_use=in_use, unit=in_use if in_space else 1.0)
    if in_space:
        print_judged(queries, "in the plane", (q.in_plane for q in queries if q.in_plane is not None))
        print_judged(queries, "in use, shuffled", (q.masses(in_use) for q in shuffled(queries)))
    fitted, without = fitted_to(queries), left_out(queries, fitted_to)
    print_judged(queries, "in use", (q.masses(in_use) for q in queries))
    print_judged(queries, "fitted", (q.masses(fitted) for q in queries))
    pairs = zip(queries, without, strict=True)
    print_judged(queries, "fitted without the building", (q.masses(x) for q, x in pairs))
    names = "on, through, before, left:" if in_space else "bias, fit, lead:"
    print(names, *(f"{value:.2f}" for value in fitted))


if __name__ == "__main__":
    typer.run(main)
