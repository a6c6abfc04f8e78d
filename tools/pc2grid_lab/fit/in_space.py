"""Fits the factor in space of the posterior, and judges it on buildings that were left out.

    python -m pc2grid_lab.fit.in_space EVIDENCE.json ...

Each file is one that `recorded_queries` has written. Prints for the masses in the plane, the parameters in
use, these with the rays of places drawn at random, those fitted, and those fitted without the buildings of
query and map, how many answers would be located, rightly and wrongly, by building; and the parameters for
`signature.localization.in_space`.

Queries whose place was found and all others weigh the same in the fit, as in `posterior`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from scipy.optimize import minimize

from pc2grid.geometry import F64
from pc2grid_lab.fit.posterior import LAPSE, PENALTY, is_right
from signature.config import Config
from signature.localization.in_space import SPACE, masses_in_space
from signature.localization.posterior import Evidence, masses

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
        """(P,) by the parameters on, through, before and left."""
        return masses_in_space(self.in_plane, self.terms @ x)[0]

    def of_truth(self, x: F64) -> float:
        """The probability of what is true."""
        masses = self.masses(x)
        return float(masses[min(self.right)] if self.right else max(1.0 - masses.sum(), 0.0))


def compared_of(rows: Iterable[dict[str, Any]]) -> Iterator[Compared]:
    """The queries whose places were compared in space, each once in a map."""
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
            right=frozenset(k for k, error in errors.items() if is_right(error)),
        )


def fit(queries: Sequence[Compared]) -> F64:
    """(4,) the parameters under which the truth is likeliest."""
    found = np.array([bool(q.right) for q in queries])
    weights = 0.5 * np.where(found, 1.0 / max(found.sum(), 1), 1.0 / max((~found).sum(), 1))

    def loss(x: F64) -> float:
        p = np.array([q.of_truth(x * _IN_USE) for q in queries])
        return float(-weights @ np.log((1.0 - LAPSE) * p + LAPSE) + 0.5 * PENALTY * x @ x)

    # The masses of alike places are those of the best of them, so the loss has edges.
    return np.asarray(minimize(loss, np.ones(4), method="Nelder-Mead", options={"xatol": 0.01}).x * _IN_USE)


def left_out(queries: Sequence[Compared]) -> list[F64]:
    """The masses of each query by the parameters fitted without the buildings of query and map."""
    models = {
        buildings: fit([q for q in queries if not q.buildings & buildings])
        for buildings in {q.buildings for q in queries}
    }
    return [q.masses(models[q.buildings]) for q in queries]


def shuffled(queries: Sequence[Compared]) -> list[Compared]:
    """The control that must fail: each place gets what the points tell for a place drawn at random."""
    rng = np.random.default_rng(0)
    every = np.concatenate([q.terms for q in queries])
    every = every[np.isfinite(every).all(axis=1)]

    def drawn(terms: F64) -> F64:
        compared = np.isfinite(terms).all(axis=1, keepdims=True)
        return np.where(compared, every[rng.integers(len(every), size=len(terms))], np.nan)

    return [replace(q, terms=drawn(q.terms)) for q in queries]


def print_judged(queries: Sequence[Compared], name: str, masses: Iterable[F64]) -> None:
    """Print what is located by masses (P,), rightly and wrongly, by building of the query."""
    asked, right, wrong = Counter[str](), Counter[str](), Counter[str]()
    for query, mass in zip(queries, masses, strict=True):
        asked[query.building] += len(query.buildings) == 1
        if mass.max(initial=0.0) >= Config().relocalize.accept:
            (right if int(mass.argmax()) in query.right else wrong)[query.building] += 1
    told = ", ".join(f"{b} {right[b]} of {asked[b]}, {wrong[b]} wrong" for b in sorted(asked))
    totals = f"{right.total()} of {asked.total()} right, {wrong.total()} of {len(queries)} wrong"
    print(f"{name}: {totals} ({told})")


def main(files: list[Path]) -> None:
    """Fit, judge and print. FILES: what `recorded_queries` has written."""
    queries = [q for file in files for q in compared_of(json.loads(file.read_text()))]
    fitted = fit(queries)
    print_judged(queries, "in the plane", (q.in_plane for q in queries))
    print_judged(queries, "in use", (q.masses(_IN_USE) for q in queries))
    print_judged(queries, "in use, shuffled", (q.masses(_IN_USE) for q in shuffled(queries)))
    print_judged(queries, "fitted", (q.masses(fitted) for q in queries))
    print_judged(queries, "fitted without the building", left_out(queries))
    print("on, through, before, left:", *(f"{value:.1f}" for value in fitted))


if __name__ == "__main__":
    typer.run(main)
