"""What the page says of a map and of the queries in it, as it is kept beside the page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, Literal

from pydantic import TypeAdapter

NOT_RUN = "was not run"
"""The problem of a row whose commands were not run, because the run ended early."""
FINE = 0.9
"""A missed window whose true pose is at least so probable by `--check` is missed by the search, not by the
walls; by hand."""
Verdict = Literal["right", "false", "unknown"]
Truth = Literal["poses", "trajectory", "hand", "clouds", "agreement", "elsewhere"]
"""How answers are judged: by true poses of query and map, by the trajectory of the recording whose beginning
is the map, by a pose found by hand, by clouds, by each other, or as nothing can be right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Warned:
    """A warning of `convert`: what it is about, whether it is right, and its sentence."""

    about: str
    verdict: Verdict
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRow:
    """What became of one recording as a map.

    problem : why there is no map; empty if there is one. parts : sessions it became. lost : share of its
        scans that are in no map. over_bare : processor time over that of bare KISS-ICP; lidar only.
    error_m, error_deg : of its trajectory, by relations and loops the mean error, by poses the RMS distance.
        bare_m : the same of bare KISS-ICP. compared : share of the relations or scans that could be compared.
    """

    name: str
    building: str
    sensor: str
    problem: str = ""
    minutes: float | None = None
    metres: float | None = None
    area_m2: float | None = None
    cpu_s: float | None = None
    over_bare: float | None = None
    parts: int | None = None
    lost: float | None = None
    warnings: tuple[Warned, ...] = ()
    truth: Literal["relations", "poses", "loops", "none"] = "none"
    error_m: float | None = None
    error_deg: float | None = None
    bare_m: float | None = None
    compared: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryRow:
    """One window, and the answer to it.

    window : its number among those of the pair. problem : why there is no answer. covered : whether the map
        knows the ground that the last scan saw; None if the true place is not known. right : whether the best
        hypothesis is right; None if that is not known. rank : how many other places come before the right
        one; None if it is not among the hypotheses. error_m : of the best hypothesis. fine : probability of
        the true pose of a missed window, where `--check` calls it fine.
    """

    window: int
    start_s: float
    status: str = ""
    problem: str = ""
    confidence: float | None = None
    travel_m: float | None = None
    covered: bool | None = None
    right: bool | None = None
    rank: int | None = None
    error_m: float | None = None
    in_space: str | None = None
    fine: float | None = None
    cpu_s: float | None = None

    @property
    def located(self) -> bool:
        """Whether one place was answered."""
        return self.status == "located"

    @property
    def missed(self) -> bool:
        """Whether it is covered, and the answer is not its place."""
        return self.covered is True and not (self.located and self.right)


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """The queries of a row, or of several.

    right, wrong : located and right, located and wrong, of those whose answer can be judged; unjudged :
        located, of the others. refused : not located. covered : judged, and in the map; covered_right : of
        those, located and right. overlooked : missed by the search alone, see `FINE`.
    """

    queries: int
    covered: int
    located: int
    right: int
    covered_right: int
    overlooked: int
    wrong: int
    unjudged: int
    failed: int

    @staticmethod
    def of(queries: Sequence[QueryRow]) -> Counts:
        """Counts of queries."""
        located = [q for q in queries if q.located]
        return Counts(
            queries=len(queries),
            covered=sum(q.covered is True for q in queries),
            located=len(located),
            right=sum(q.right is True for q in located),
            covered_right=sum(q.right is True and q.covered is True for q in located),
            overlooked=sum(q.missed and (q.fine or 0.0) >= FINE for q in queries),
            wrong=sum(q.right is False for q in located),
            unjudged=sum(q.right is None for q in located),
            failed=sum(bool(q.problem) for q in queries),
        )

    @property
    def refused(self) -> int:
        """Not located."""
        return self.queries - self.located - self.failed


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """The windows of one recording in one map. problem : why nothing was located.

    truth : how they are judged; None if they cannot be. agreeing : answers that agree, if they judge each
    other.
    """

    query: str
    map: str
    kind: str
    building: str
    sensors: str
    problem: str = ""
    truth: Truth | None = None
    agreeing: int | None = None
    queries: tuple[QueryRow, ...] = ()

    @property
    def name(self) -> str:
        """Of the row."""
        return f"{self.query} in {self.map}"

    @property
    def counts(self) -> Counts:
        """Of its queries."""
        return Counts.of(self.queries)

    @property
    def median_error_m(self) -> float | None:
        """Of the answers that are located and right."""
        errors = [q.error_m for q in self.queries if q.located and q.right and q.error_m is not None]
        return median(errors) if errors else None

    @property
    def ranks(self) -> list[int | None]:
        """Of the right place, of the covered queries that are not located."""
        return [q.rank for q in self.queries if not q.located and not q.problem and q.covered]


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowedRow:
    """A recording that `watch` followed in the map of another session.

    after : the recording that the robot was carried to; None: it was not carried away. problem : why there is
        no result. located, judged, wrong : looks that told a place, of them those that can be judged, and
        wrong ones; without those between the kidnap and its notice, which tell the old place. alarms : how
        often a right place was given up before it was carried away, though the map shows what it saw.
    shown : whether the map shows what the robot sees where it is put down. knew : whether it was located
        until it was carried away.
    noticed_s, noticed_m : time and travel until the first look that it is not where it was; again_s, again_m
        until it is located where it is; None: never.
    """

    before: str
    after: str | None
    map: str
    building: str
    problem: str = ""
    shown: bool = False
    located: int = 0
    judged: int = 0
    wrong: int = 0
    alarms: int = 0
    knew: bool = False
    noticed_s: float | None = None
    noticed_m: float | None = None
    again_s: float | None = None
    again_m: float | None = None

    @property
    def name(self) -> str:
        """Of the row."""
        return f"{self.before}{'' if self.after is None else f', {self.after}'} followed in {self.map}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """All rows of a run, and what made them: program, cpu_s (all commands together), quick."""

    program: str
    commit: str
    quick: bool
    cpu_s: float
    maps: tuple[MapRow, ...]
    pairs: tuple[PairRow, ...]
    followed: tuple[FollowedRow, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """In plain types; numbers are rounded to what the page could show."""
        text = json.dumps({"schema_version": 1, **asdict(self)})
        document: dict[str, Any] = json.loads(
            text, parse_float=lambda digits: round(float(digits), 4), parse_constant=lambda _: None
        )
        return document

    def to_text(self) -> str:
        """The same as a JSON text with a line for each row, so that versions can be compared."""
        document = self.to_json()
        rows = {name: document.pop(name) for name in ("maps", "pairs", "followed")}
        head = json.dumps(document)[1:-1]
        lists = (
            f'"{name}": [\n' + ",\n".join(json.dumps(row) for row in found) + "\n]"
            for name, found in rows.items()
        )
        return "{" + ",\n".join([head, *lists]) + "}\n"

    @staticmethod
    def from_json(document: dict[str, Any]) -> Table:
        """What `to_json` made. Raises ValueError for any other document."""
        return TypeAdapter(Table).validate_python(document)
