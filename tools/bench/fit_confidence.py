"""Fits the confidence to answers whose truth is known, and judges it on buildings that were left out.

    python tools/bench/fit_confidence.py EVIDENCE.json ...

Each file is one that `tools/bench/real_queries.py` has written, or the document of `pc2grid compare sensors`,
`compare real` or `compare log --json`. Prints the coefficients for `signature.relocalization.confidence`, the
log loss, and by kind of pair and distance how many answers are right, and how many would be located by the
coefficients in use and by those fitted without the building, rightly and wrongly.
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

from signature.config import Config
from signature.evaluation.calibration import Known, fit, left_out, log_loss, roc_area
from signature.relocalization.confidence import CALIBRATION, Evidence

RIGHT_M, RIGHT_RAD = 0.35, math.radians(5.0)
"""Errors of right answers to real logs; the poses that count as true are good to some centimetres."""


@dataclass(frozen=True, slots=True)
class Answered:
    """An answer of a kind of pair of sensors, after some metres."""

    kind: str
    travel_m: float
    known: Known


def of_rows(rows: list[dict[str, Any]]) -> Iterator[Answered]:
    """Answers to real logs, without those to queries whose true pose is not known."""
    for row in rows:
        own = row["log"] == row["map"]
        if not row["errors"] or (own and not math.isfinite(row["errors"][0][0])):
            continue
        error_m, error_rad = row["errors"][0]
        yield Answered(
            "laser log in its own building" if own else "laser log in another building",
            row["travel_m"],
            Known(
                group=row["log"],
                session=f"{row['log']} {row['start']}",
                evidence=Evidence(**row["evidence"]),
                right=own and error_m <= RIGHT_M and error_rad <= RIGHT_RAD,
            ),
        )


def of_trials(trials: list[dict[str, Any]]) -> Iterator[Answered]:
    """Answers of the `compare` commands."""
    names = ("forward", "walls", "backward", "looked_at", "lead")
    for trial in trials:
        if trial.get("forward") is None:
            raise SystemExit("results of an earlier version, without the evidence; measure them again")
        where = "" if trial["in_building"] else " in another building"
        yield Answered(
            f"{trial['query_sensor']} in a map by {trial['map_sensor']}{where}",
            trial["travel_m"],
            Known(
                group=trial["building"],
                session=f"{trial['building']} {trial['query_sensor']} {trial['seed']}",
                evidence=Evidence(**{name: trial[name] for name in names}),
                right=trial["right"],
            ),
        )


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
    answered: list[Answered] = []
    for file in parser.parse_args().files:
        document = json.loads(file.read_text())
        answered += of_rows(document) if isinstance(document, list) else of_trials(document["trials"])
    known = [a.known for a in answered]
    in_use = np.array([CALIBRATION.probability(k.evidence) for k in known])
    refitted = left_out(known)
    accept = Config().relocalize.accept
    counts: dict[tuple[str, int], Count] = {}
    for a, *probabilities in zip(answered, in_use, refitted, strict=True):
        count = counts.setdefault((a.kind, math.floor(a.travel_m)), Count())
        count.answers += 1
        count.right += a.known.right
        for i, probability in enumerate(probabilities):
            if probability >= accept:
                (count.located_right if a.known.right else count.located_wrong)[i] += 1
    print(f"{'kind':45} {'m':>3} answers right | in use: right wrong | left out: right wrong")
    for (kind, metres), c in sorted(counts.items()):
        print(
            f"{kind:45} {metres:3d} {c.answers:7d} {c.right:5d}"
            f" | {c.located_right[0]:13d} {c.located_wrong[0]:5d} |"
            f" {c.located_right[1]:15d} {c.located_wrong[1]:5d}"
        )
    for name, probabilities in (("in use", in_use), ("fitted without the building", refitted)):
        loss, area = log_loss(known, probabilities), roc_area(known, probabilities)
        print(f"{name}: log loss {loss:.4f}, area under the ROC curve {area:.4f}")
    print(fit(known))


if __name__ == "__main__":
    main()
