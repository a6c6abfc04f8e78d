"""Fits the posterior to queries whose truth is known, and judges it on buildings that were left out.

    python -m pc2grid_lab.fit.posterior EVIDENCE.json ...

Each file is one that `real_queries` or `recorded_queries` has written, or one of the folder trials/ of
`pc2grid compare sensors`. An answer is judged by a fit without all answers whose query or map is of one of
its buildings. Prints the parameters for `signature.localization.posterior`, the log loss, by kind of pair
and distance how many answers are right, and how many would be located by the parameters in use and by those
fitted without the building, rightly and wrongly; the risk at several coverages; and what would be located
if the least mass to answer were chosen without the building, too.

Queries whose place was found and all others weigh the same in the fit, however many of each there are.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid_lab.experiments.calibration import (
    MOST_WRONG,
    Known,
    accepted,
    clopper_pearson,
    fit,
    left_out,
    log_loss,
    roc_area,
    share_by_building,
)
from signature.config import Config
from signature.localization.posterior import POSTERIOR, Evidence

RIGHT_M, RIGHT_RAD = 0.5, math.radians(5.0)
"""Errors of answers to real logs at the right place. How precise they are is not the question here; the poses
that count as true are good to some centimetres."""
NEAR_M = 1.0
"""Answers so near to the place of a query that is not in the map are left out: neither right nor wrong."""
SHARE_FOUND = 0.5
"""Weight of the queries whose place was found. So the probability holds for queries half of which lie in the
map."""
COVERAGES = (0.5, 0.6, 0.7, 0.8, 0.9)
"""At which the risk is printed."""
PARTS_OF = {"fr079_floor": "fr079"}
"""Physical building of what the data call otherwise: the 3D scan is one floor of fr079."""


@dataclass(frozen=True, slots=True)
class Answered:
    """An answer of a kind of pair of sensors, after some metres."""

    kind: str
    travel_m: float
    known: Known


def physical(*names: str) -> frozenset[str]:
    """The buildings that the logs, scans and plans of these names are of."""
    return frozenset(PARTS_OF.get(name, name) for name in names)


def of_rows(rows: list[dict[str, Any]]) -> Iterator[Answered]:
    """Answers to real logs, without those to queries whose true pose is not known."""
    for row in rows:
        own, blanked = row["log"] == row["map"], row["place"] == "blanked"
        if not row["errors"] or (own and not math.isfinite(row["errors"][0][0])):
            continue
        errors_m = [error_m for error_m, _ in row["errors"]]
        if blanked and min(errors_m) < NEAR_M:
            continue
        right = [
            k
            for k, (error_m, error_rad) in enumerate(row["errors"])
            if own and not blanked and error_m <= RIGHT_M and error_rad <= RIGHT_RAD
        ]
        where = "its own building" if own else "another building"
        yield Answered(
            f"laser log in {where}{', place blanked' if blanked else ''}",
            row["travel_m"],
            Known(
                buildings=physical(row["log"], row["map"]),
                session=f"{row['log']} {row['start']}",
                places=tuple(Evidence(**evidence) for evidence in row["evidence"]),
                first=right[0] if right else None,
            ),
        )


def of_trials(trials: list[dict[str, Any]]) -> Iterator[Answered]:
    """Answers of `compare sensors`."""
    names = ("forward", "walls", "backward", "looked_at", "lead", "likeness")
    for trial in trials:
        if trial.get("likeness") is None or trial.get("query_building") is None:
            raise SystemExit("results of an earlier version, without all evidence; measure them again")
        where = "" if trial["in_building"] else " in another building"
        yield Answered(
            f"{trial['query_sensor']} in a map by {trial['map_sensor']}{where}",
            trial["travel_m"],
            Known(
                buildings=physical(trial["building"], trial["query_building"]),
                session=f"{trial['query_building']} {trial['query_sensor']} {trial['seed']}",
                places=(Evidence(**{name: trial[name] for name in names}),),
                first=0 if trial["right"] else None,
            ),
        )


def read(file: Path) -> list[Answered]:
    """The answers of one file. Raises SystemExit for results of an earlier version."""
    document = json.loads(file.read_text())
    if document and "in_building" in document[0]:
        return list(of_trials(document))
    # Before equal places shared their mass, each was compared with them.
    if any("place" not in row or any("apart" in one for one in row["evidence"]) for row in document):
        raise SystemExit(f"{file}: evidence of an earlier version; collect it again by real_queries.py")
    return list(of_rows(document))


@dataclass(slots=True)
class Count:
    """Answers, right ones, and those located [in use, refitted], rightly and wrongly."""

    answers: int = 0
    right: int = 0
    located_right: list[int] = field(default_factory=lambda: [0, 0])
    located_wrong: list[int] = field(default_factory=lambda: [0, 0])


def main() -> None:
    """Fit, judge and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", type=Path, nargs="+")
    answered = [a for file in parser.parse_args().files for a in read(file)]
    known = [a.known for a in answered]
    refuse(known)
    in_use = np.array([k.probability(POSTERIOR) for k in known])
    refitted = left_out(known, SHARE_FOUND)
    print_counts(answered, in_use, refitted)
    accept = Config().relocalize.accept
    print_sums(known, "in use", in_use, in_use >= accept)
    print_sums(known, "fitted without the building", refitted, refitted >= accept)
    given = accepted(known, SHARE_FOUND)
    print_sums(known, f"and the least mass for {MOST_WRONG:.0%} wrong chosen without it", refitted, given)
    print_risk(known, refitted)
    print(fit(known, SHARE_FOUND))


def refuse(known: list[Known]) -> None:
    """Raises SystemExit if a building cannot be left out."""
    for buildings in {k.buildings for k in known}:
        if len({k.first is None for k in known if not k.buildings & buildings}) < 2:
            raise SystemExit(
                "the fit is judged by leaving buildings out, and without"
                f" {' and '.join(sorted(buildings))} not both kinds of queries are left: found and not"
            )


def print_counts(answered: list[Answered], *probabilities: F64) -> None:
    """Print a row for each kind of query and metres driven. probabilities : (N,) in use, and refitted."""
    counts: dict[tuple[str, int], Count] = {}
    for a, *each in zip(answered, *probabilities, strict=True):
        count = counts.setdefault((a.kind, math.floor(a.travel_m)), Count())
        count.answers += 1
        count.right += a.known.right
        for i, probability in enumerate(each):
            if probability >= Config().relocalize.accept:
                (count.located_right if a.known.right else count.located_wrong)[i] += 1
    print(f"{'kind':50} {'m':>3} answers right | in use: right wrong | left out: right wrong")
    for (kind, metres), c in sorted(counts.items()):
        print(
            f"{kind:50} {metres:3d} {c.answers:7d} {c.right:5d}"
            f" | {c.located_right[0]:13d} {c.located_wrong[0]:5d} |"
            f" {c.located_right[1]:15d} {c.located_wrong[1]:5d}"
        )


def print_sums(known: list[Known], name: str, probabilities: F64, located: NDArray[np.bool_]) -> None:
    """Print how good the probabilities (N,) are, and what is located (N,) by them."""
    right = np.array([k.right for k in known])
    buildings, drives = [k.buildings for k in known], [k.session for k in known]
    _, low, high = share_by_building(buildings, drives, located & ~right)
    # Windows of one drive depend on each other: a drive with a wrong answer counts once.
    in_drives = {drive for drive, is_located in zip(drives, located, strict=True) if is_located}
    wrong_drives = {drive for drive, is_wrong in zip(drives, located & ~right, strict=True) if is_wrong}
    least, most = clopper_pearson(len(wrong_drives), len(in_drives))
    print(
        f"{name}: log loss {log_loss(known, probabilities):.4f},"
        f" area under the ROC curve {roc_area(known, probabilities):.4f}, located"
        f" {np.count_nonzero(located & right)} of {np.count_nonzero(right)} right ones,"
        f" {np.count_nonzero(located & ~right)} of {np.count_nonzero(~right)} wrong ones"
        f" ({np.mean(located & ~right):.2%} of all answers; 5 to 95 %, by building and drive: {low:.2%} to"
        f" {high:.2%}); wrong in {len(wrong_drives)} of {len(in_drives)} queries that are located"
        f" (Clopper-Pearson 90 %: {least:.2%} to {most:.2%})"
    )


def print_risk(known: list[Known], probabilities: F64) -> None:
    """Print which share of the answers that are given is wrong (the risk), if the surest share of those whose
    place comes first is given (the coverage)."""
    right = np.array([k.right for k in known])
    order = np.argsort(-probabilities, kind="stable")
    found, wrong = np.cumsum(right[order]), np.cumsum(~right[order])
    for coverage in COVERAGES:
        k = int(np.searchsorted(found, coverage * found[-1]))
        print(f"coverage {coverage:.2f}: mass {probabilities[order][k]:.3f}, wrong {wrong[k]} of {k + 1}")


if __name__ == "__main__":
    main()
