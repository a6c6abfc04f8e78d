"""Counts the answers to real laser logs in maps of their own earlier part, or of other buildings.

    python -m pc2grid_lab.fit.real_answers DATA FOLDER [--logs fr079,intel] [--queries 24]
    python -m pc2grid_lab.fit.real_answers DATA FOLDER --elsewhere [--logs fr079,intel] [--queries 24]

The experiment of `real_queries`, but asked as a user asks: standing (six scans), after 3 m and
after 10 m. A query is covered if half of its last scan lies within 0.2 m of a wall of the map at its true
pose, be it the other side of that wall, seen from another room; and known if the map also knows half of the
ground that it has seen. An answer is right within 0.3 m and 5 degrees of the ground truth.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import OccupancyGrid
from pc2grid_lab.experiments.answers import localize, share_known
from pc2grid_lab.experiments.registered_session import RegisteredSession
from pc2grid_lab.fit.real_queries import STANDING_SCANS, parser_of, read_all
from pc2grid_lab.peers.site import is_covered
from signature.localization.answer import Answer
from signature.localization.map_index import MapIndex

TRAVEL_M = (0.0, 3.0, 10.0)
ELSEWHERE_M = (1.0, 3.0, 5.0, 8.0)
RIGHT_M, RIGHT_RAD = 0.3, math.radians(5.0)
KNOWN = 0.5


def scans_after(driven: RegisteredSession, travel_m: tuple[float, ...]) -> list[int]:
    """The numbers of scans after which the query has driven so far, as far as it goes."""
    path_m = driven.path_m()
    return [max(int(np.searchsorted(path_m, m)) + 1, STANDING_SCANS) for m in travel_m if m <= path_m[-1]]


def count(name: str, grid: OccupancyGrid, queries: list[RegisteredSession], index: MapIndex) -> None:
    """Print the answer to each query, and how many are right."""
    counts: dict[float, Counter[str]] = {travel_m: Counter() for travel_m in TRAVEL_M}
    for number, driven in enumerate(queries):
        after = set(scans_after(driven, TRAVEL_M))
        scans = ((registered, planar_scan) for registered, planar_scan, _ in driven.scans())
        for travel_m, found in zip(TRAVEL_M, localize(scans, [index], after=after), strict=False):
            (answer,) = found.answers
            truth = driven.true_pose(found.scans - 1)
            if truth is None:
                continue
            share = share_known(grid, found.query.grid, truth @ found.query.T_odom_base.inverse())
            kind = kind_of(grid, driven, found.scans - 1, truth, share)
            verdict, error = judged(answer, truth)
            counts[travel_m].update([kind, f"{kind} {verdict}"] if verdict else [kind])
            words = (name, number, travel_m, kind, answer.status, f"{answer.confidence:.3f}")
            print(*words, f"knows {share:.2f}", error, flush=True)
    for travel_m, counted in counts.items():
        print(name, f"{travel_m:g} m:", dict(sorted(counted.items())), flush=True)


def kind_of(grid: OccupancyGrid, driven: RegisteredSession, scan: int, truth: SE2, share: float) -> str:
    """What the map shows of a query. share : of the ground that it has seen, known to the map."""
    if not is_covered(grid, driven.planar_scans[scan].hits_m, truth):
        return "uncovered"
    return "covered, known" if share >= KNOWN else "covered"


def judged(answer: Answer, truth: SE2) -> tuple[str, str]:
    """What is counted of an answer, and its error in words; empty without a hypothesis."""
    if not answer.hypotheses:
        return "", ""
    error = truth.inverse() @ answer.hypotheses[0].fit.T_map_query @ answer.T_odom_base
    distance = math.hypot(error.x, error.y)
    right = distance <= RIGHT_M and abs(wrap_angle(error.yaw)) <= RIGHT_RAD
    words = f"{distance:.2f} m {math.degrees(error.yaw):.1f} deg"
    if answer.status == "located":
        return "right" if right else "wrong", words
    return f"right but {answer.status}" if right else "", words


def count_elsewhere(name: str, queries: list[RegisteredSession], others: dict[str, MapIndex]) -> None:
    """Print how many answers in maps of other buildings are located, and by how many of the queries."""
    answers: Counter[float] = Counter()
    located: list[tuple[int, str, float, float]] = []
    for number, driven in enumerate(queries):
        scans = ((registered, planar_scan) for registered, planar_scan, _ in driven.scans())
        after = set(scans_after(driven, ELSEWHERE_M))
        for travel_m, found in zip(
            ELSEWHERE_M, localize(scans, list(others.values()), after=after), strict=False
        ):
            for other, answer in zip(others, found.answers, strict=True):
                answers[travel_m] += 1
                if answer.status == "located":
                    located.append((number, other, travel_m, answer.confidence))
        print(name, number, dict(answers), located, flush=True)


def main() -> None:
    """Ask and count."""
    parser = parser_of(__doc__, "folder", "fr079,intel")
    parser.add_argument("--elsewhere", action="store_true", help="ask in maps of other buildings only")
    options = parser.parse_args()
    logs, indexes = read_all(options, options.folder)
    for name, (grid, driven) in logs.items():
        if options.elsewhere:
            others = {other: index for other, index in indexes.items() if other != name}
            count_elsewhere(name, driven, others)
        else:
            count(name, grid, driven, indexes[name])


if __name__ == "__main__":
    main()
