"""The table of `compare recordings`: its rows, the page `real.md`, the table on a terminal, and what changed.

What is told to be worse between two runs is worse by more than chance.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median
from textwrap import wrap
from typing import Any, Literal

from pydantic import TypeAdapter

from pc2grid.display import counted
from pc2grid_cli import output
from pc2grid_lab.pages import ALPHA, Heads, by_chance, markdown, number, share, strong
from pc2grid_lab.recordings.catalogue import FOREIGN_MAPS, PAIR_KINDS
from pc2grid_lab.runner import NOT_RUN, grouped

MISSING = "not in the data folder"
FINE = 0.9
"""A missed window whose true pose is at least so probable by `--check` is missed by the search, not by the
walls; by hand."""
WarningVerdict = Literal["right", "false", "unknown"]
Truth = Literal["poses", "trajectory", "hand", "clouds", "agreement", "elsewhere"]
"""How answers are judged: by true poses of query and map, by the trajectory of the recording whose beginning
is the map, by a pose found by hand or by clouds, by each other, or as nothing can be right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Warned:
    """A warning of `convert`: what it is about, whether it is right, and its sentence."""

    about: str
    verdict: WarningVerdict
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
        """Return whether one place was answered."""
        return self.status == "located"

    @property
    def outcome(self) -> str:
        """Return what became of it, in a word."""
        if self.problem:
            return "failed"
        return judged(self.right) if self.located else "refused"

    @property
    def missed(self) -> bool:
        """Return whether it is covered, and the answer is not its place."""
        return self.covered is True and not (self.located and self.right)

    @property
    def overlooked(self) -> bool:
        """Return whether it is missed though `--check` calls its true pose fine, see `FINE`."""
        return self.missed and (self.fine or 0.0) >= FINE


def judged(right: bool | None) -> str:
    """Return whether what was found is right, in words."""
    return "not judged" if right is None else "right" if right else "wrong"


def counts_of(queries: Sequence[QueryRow]) -> Counter[str]:
    """Return how many queries have each outcome, and how many are of a kind.

    queries : all. located : right, wrong, or not judged. covered : judged, and in the map; covered right : of
    those, located and right. overlooked : missed by the search alone, see `FINE`.
    """
    covered = [query for query in queries if query.covered]
    return Counter(
        {
            **Counter(query.outcome for query in queries),
            "queries": len(queries),
            "located": sum(query.located for query in queries),
            "covered": len(covered),
            "covered right": sum(query.outcome == "right" for query in covered),
            "overlooked": sum(query.overlooked for query in queries),
        }
    )


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
        """Return the name of the row."""
        return f"{self.query} in {self.map}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowedRow:
    """A recording that `watch` followed in the map of another session.

    after : the recording that the robot was carried to; None: it was not carried away. problem : why there is
        no result. looks : all. located, judged, wrong : of them those that told a place, of these those that
        can be judged, and wrong ones; without those between the kidnap and its notice, which tell the old
        place. alarms : how
        often a right place was given up before it was carried away, though the map shows what it saw.
    shown : whether the map shows what the robot sees where it is put down. knew : whether it was located
        until it was carried away.
    noticed_s, noticed_m : time and travel since it was put down until the first look that it is not where it
        was; located_s, located_m : until it is located where it is, of a robot that is not carried away since
        its drive began; None: never.
    """

    before: str
    after: str | None
    map: str
    building: str
    problem: str = ""
    shown: bool = False
    looks: int = 0
    located: int = 0
    judged: int = 0
    wrong: int = 0
    alarms: int = 0
    knew: bool = False
    noticed_s: float | None = None
    noticed_m: float | None = None
    located_s: float | None = None
    located_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class JoinRow:
    """Two maps that were compared to be joined. problem : why there is no result.

    same : whether they are of one building. right : whether one lies in the other as was found, of one
    building; None if that is not known. error_m : how far off, in the middle of what agrees.
    """

    target: str
    source: str
    same: bool
    problem: str = ""
    status: str = ""
    probability: float | None = None
    common_m2: float | None = None
    right: bool | None = None
    error_m: float | None = None
    cpu_s: float | None = None

    @property
    def outcome(self) -> str:
        """Return what became of them, in a word."""
        if self.problem or self.status != "joined":
            return "failed" if self.problem else "not joined"
        return judged(self.right)


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
    joins: tuple[JoinRow, ...] = ()

    def to_text(self) -> str:
        """Return the table as a JSON text with a line for each row, so that versions can be compared; numbers
        are rounded to what the page could show."""
        document: dict[str, Any] = json.loads(
            json.dumps({"schema_version": 1, **asdict(self)}),
            parse_float=lambda digits: round(float(digits), 4),
            parse_constant=lambda _: None,
        )
        rows = {name: document.pop(name) for name in ("maps", "pairs", "followed", "joins")}
        head = json.dumps(document)[1:-1]
        lists = (
            f'"{name}": [\n' + ",\n".join(json.dumps(row) for row in found) + "\n]"
            for name, found in rows.items()
        )
        return "{" + ",\n".join([head, *lists]) + "}\n"

    @staticmethod
    def from_json(document: dict[str, Any]) -> Table:
        """Return the table that `to_text` wrote. Raises ValueError for any other document."""
        return TypeAdapter(Table).validate_python(document)


_DISTURBED = ", disturbed "
"""In the name of a recording that is disturbed."""
_MARKS = {"right": "", "false": " (false)", "unknown": " (?)"}
_READING = ("no tf", "gaps", "empty scans")
"""Warnings about the file, that say nothing of the map."""


def markdown_page(table: Table, changed: Sequence[RowChange] = ()) -> str:
    """Return the page in Markdown. changed : against the run before."""
    as_recorded = replace(table, pairs=tuple(row for row in table.pairs if row.kind != "disturbed"))
    return "\n".join(
        [
            "# Real recordings",
            "",
            *_about(table),
            "",
            "## Maps",
            "",
            *markdown(_MAPS, [_map_cells(row) for row in table.maps]),
            "",
            *_notes_on_maps(table),
            "",
            *_disturbed(table),
            "",
            *_followed(table),
            "## Places",
            "",
            *_places(table),
            "",
            *_joined(table),
            "## By sensor",
            "",
            *sensor_matrix(as_recorded),
            "",
            "## By building",
            "",
            *_by_building(as_recorded),
            "",
            "## By confidence",
            "",
            *_by_confidence(as_recorded),
            "",
            *_failures(table),
            *_changed(changed),
        ]
    )


def _about(table: Table) -> list[str]:
    form = "The quick form of `compare recordings`" if table.quick else "`pc2grid compare recordings`"
    return [
        f"{form}: every recording of a folder goes through `convert`, and parts of them through",
        "`relocalize`, each as a process of its own with default threads. The next run is compared with this",
        "page (`real.json`). Times are processor time, user and system, with the start of the program.",
        "",
        f"Program {table.program} ({table.commit}), {table.cpu_s / 60:.0f} minutes of processor time.",
    ]


_MAPS = (
    ("recording", "building", "sensor"),
    (
        "min",
        "m",
        "cpu, s",
        "over KISS-ICP",
        "parts",
        "lost, %",
        "error, m",
        "bare KISS-ICP",
    ),
    ("truth", "warnings"),
)


def _map_cells(row: MapRow) -> list[str]:
    if row.problem:
        return [row.name, row.building, row.sensor, *[""] * 9, row.problem]
    return [
        row.name,
        row.building,
        row.sensor,
        number(row.minutes, 1) if row.sensor != "map" else "",
        number(row.metres, 0) if row.sensor != "map" else "",
        number(row.cpu_s, 1),
        number(row.over_bare, 1),
        str(row.parts),
        "" if row.sensor == "map" else number(100 * (row.lost or 0.0), 1),
        number(row.error_m, 3),
        number(row.bare_m, 3),
        "" if row.sensor == "map" else _truth(row),
        "; ".join(w.about + _MARKS[w.verdict] for w in row.warnings if w.about not in _READING),
    ]


def _truth(row: MapRow) -> str:
    if row.truth == "none":
        return "none"
    part = "" if row.compared is None or row.compared > 0.995 else f", {100 * row.compared:.0f} %"
    return row.truth + part


def _notes_on_maps(table: Table) -> list[str]:
    warnings = [w for row in table.maps for w in row.warnings if w.about not in _READING]
    verdicts = [warning.verdict for warning in warnings]
    return [
        "driven: in simulation, through the real 3D scan of fr079's floor, among further things.",
        "error: of relations the mean over pairs of poses, of poses the RMS distance after alignment (ATE),",
        "of loops the mean distance between scans at one place, to which a hand came back to decimetres;",
        "a recording in parts by each part. bare KISS-ICP: with its own settings. over KISS-ICP: `convert`",
        "from start to end over `register_frame` alone at the same voxel. truth: the share of it that could",
        "be compared, if not all. lost: scans that are in no map. disturbed: points moved by 1e-5 m.",
        f"Of {len(warnings)} warnings {verdicts.count('right')} are right, {verdicts.count('false')} false;",
        f"of {verdicts.count('unknown')} (?) that is not known.",
    ]


def _disturbed(table: Table) -> list[str]:
    """Return how far maps and answers hang on the last bit: a line for each disturbed recording."""
    errors = grouped((row.name.partition(_DISTURBED)[0], row.error_m or math.nan) for row in table.maps)
    verdicts = grouped(
        ((re.sub(rf"{_DISTURBED}\d+| 0\.\..*", "", pair.map), pair.query, query.window), query.right)
        for pair in table.pairs
        for query in pair.queries
        if query.located
    )
    return [
        f"- {name}, disturbed: {min(found):.3f} to {max(found):.3f} m, {max(found) / min(found):.2f} times;"
        f" windows right in one of its maps and wrong in another:"
        f" {sum(at[0] == name and {*rights} >= {True, False} for at, rights in verdicts.items())}"
        for name, found in errors.items()
        if len(found) > 1
    ]


_PLACES = (
    ("query", "map", "sensor"),
    (
        "queries",
        "covered",
        "located",
        "right",
        "wrong",
        "not judged",
        "refused",
        "right of covered",
        "overlooked",
        "rank",
        "error, m",
        "in space",
        "cpu, s",
    ),
    ("judged by",),
)


def _places(table: Table) -> list[str]:
    lines: list[str] = []
    for kind in PAIR_KINDS:
        rows = [row for row in table.pairs if row.kind == kind]
        if rows:
            lines += [f"### {kind.capitalize()}", "", *markdown(_PLACES, [_pair_cells(r) for r in rows]), ""]
    return [
        *lines,
        "covered: the map knows half of the ground that the last scan sees there. right: within 0.3 m and 3",
        "degrees. overlooked: covered and missed, though `--check` of the true pose calls it fine, at",
        f"{FINE:.1f} and more: missed by the search, not by the walls. rank: places before the right one, of",
        "covered queries that are not located (-: it is not among the hypotheses). error: median of the",
        "right ones. in space: answers with which the points of",
        "the map agree / do not tell / disagree, if it has points. judged by: true poses of both; the",
        "trajectory of the whole recording, whose beginning is the map; a pose found by hand in a drawn",
        "map, within 1 m; the clouds of both, registered in space; or the answers themselves, which must",
        "lie on one rigid transform of the drive's own trajectory (how many do); elsewhere: another",
        "building, where every answer is wrong. not judged: located, where the true place is not known.",
        "In brackets the 95 % interval of Clopper and Pearson.",
    ]


def _pair_cells(row: PairRow) -> list[str]:
    if row.problem:
        return [row.query, row.map, row.sensors, *[""] * 13, row.problem]
    counts, known = counts_of(row.queries), row.truth is not None
    failed = f" ({counts['failed']} failed)" if counts["failed"] else ""
    errors_m = [q.error_m for q in row.queries if q.outcome == "right" and q.error_m is not None]
    # Of the right place, of the covered queries that are not located.
    ranks = [q.rank for q in row.queries if q.outcome == "refused" and q.covered]
    seconds = [q.cpu_s for q in row.queries if q.cpu_s is not None]
    return [
        row.query,
        row.map,
        row.sensors,
        f"{counts['queries']}{failed}",
        str(counts["covered"]) if known else "",
        str(counts["located"]),
        str(counts["right"]) if known else "",
        strong(counts["wrong"]) if known else "",
        str(counts["not judged"]),
        str(counts["refused"]),
        share(counts["covered right"], counts["covered"]),
        strong(counts["overlooked"]) if known else "",
        " ".join("-" if rank is None else str(rank) for rank in ranks),
        number(median(errors_m) if errors_m else None, 3),
        _in_space(row),
        number(sorted(seconds)[len(seconds) // 2] if seconds else None, 1),
        f"{row.agreeing} answers" if row.truth == "agreement" else row.truth or "not judged",
    ]


def _in_space(row: PairRow) -> str:
    """Return how many answers the points of the map confirm, leave open and contradict; empty without
    points."""
    said = [query.in_space for query in row.queries if query.in_space is not None]
    return "/".join(str(said.count(status)) for status in ("agrees", "unsure", "contradicts")) if said else ""


_SENSORS = ("lidar", "depth", "laser")
_DRIVEN = ("driven lidar", "driven depth")
"""Sensors that were driven, in simulation, through a real 3D scan."""


def sensor_matrix(table: Table) -> list[str]:
    """Count queries by each kind of sensor in maps by each, over all pairs of one building; then those of
    which one was driven.

    A dash: no two recordings of one building have these sensors, so that nothing was measured.
    """
    inside = [row for row in table.pairs if row.kind != "elsewhere" and not row.problem]
    sensors = (row.sensors.split(" in ") for row in inside)
    groups = grouped(zip(((some[0], some[-1]) for some in sensors), inside, strict=True))
    driven = {pair: rows for pair, rows in groups.items() if set(pair) & set(_DRIVEN)}
    return [
        *_matrix(groups, _SENSORS, _SENSORS),
        "",
        "Right of covered, wrong, and located but not judged. -: there is no such pair of real recordings.",
        "",
        *_matrix(driven, ("laser", *_DRIVEN), (*_DRIVEN, "laser")),
        "",
        "driven: in simulation, through the real 3D scan of a floor; laser and log of that floor are real.",
    ]


def _matrix(
    groups: Mapping[tuple[str, str], Sequence[PairRow]], queries: Sequence[str], maps: Sequence[str]
) -> list[str]:
    """Return a table of the pairs of sensors: a row for each of the queries, a column for each of the
    maps."""
    heads = (("query by", *(f"in a map by {name}" for name in maps), "in a map.yaml or a 3D scan"), (), ())
    cells = [
        [query, *(_sensor_cell(groups.get((query, name), [])) for name in (*maps, "map"))]
        for query in queries
    ]
    return markdown(heads, cells)


def _sensor_cell(rows: Sequence[PairRow]) -> str:
    if not rows:
        return "-"
    counts, buildings = _total(rows), len({row.building for row in rows})
    said = f"{counts['covered right']} of {counts['covered']}, {counts['wrong']} wrong"
    if all(row.truth is None for row in rows):
        said = f"{counts['located']} of {counts['queries']} located, not judged"
    elif counts["not judged"]:
        said += f", {counts['not judged']} not judged"
    return f"{said} ({counted(buildings, 'building')})"


def _by_building(table: Table) -> list[str]:
    """Return a row a building, over the pairs within it; and those from elsewhere."""
    inside = [row for row in table.pairs if row.kind != "elsewhere" and not row.problem]
    outside = [row for row in table.pairs if row.kind == "elsewhere" and not row.problem]
    heads = (
        ("building",),
        (
            "recordings",
            "queries",
            "covered",
            "right of covered",
            "overlooked",
            "wrong of judged",
            "not judged",
            "elsewhere: wrong of asked",
        ),
        (),
    )
    cells = [
        _building_cells(building, _of(building, inside), _of(building, outside))
        for building in dict.fromkeys(row.building for row in table.pairs)
    ]
    cells.append(_building_cells("all queries", inside, outside))
    buildings = sorted({row.building for row in inside + outside})
    wrong = [building for building in buildings if _total(_of(building, inside + outside))["wrong"]]
    first = [query.rank == 0 for row in inside for query in row.queries if query.overlooked]
    return [
        *markdown(heads, cells),
        "",
        f"Of {len(first)} overlooked queries {sum(first)} have the right place first, but not surely:"
        " `--check` is surer, because it expects the robot there before it looks.",
        "",
        "Queries of one building are not independent. By buildings, which are, one at least wrong answer:"
        f" {share(len(wrong), len(buildings))}{' (' + ', '.join(wrong) + ')' if wrong else ''}.",
    ]


def _of(building: str, rows: Sequence[PairRow]) -> list[PairRow]:
    return [row for row in rows if row.building == building]


def _building_cells(name: str, inside: Sequence[PairRow], outside: Sequence[PairRow]) -> list[str]:
    counts, other = _total(inside), _total(outside)
    return [
        name,
        str(len({row.query for row in inside})),
        str(counts["queries"]),
        str(counts["covered"]),
        share(counts["covered right"], counts["covered"]),
        strong(counts["overlooked"]),
        share(counts["wrong"], counts["right"] + counts["wrong"]),
        str(counts["not judged"]),
        share(other["wrong"], other["queries"]),
    ]


_BANDS = (0.0, 0.5, 0.75, 0.9, 0.99)
"""Confidences at which a band begins; the last one ends at 1."""


def _by_confidence(table: Table) -> list[str]:
    """Return a row a band of confidence: how many of the likeliest places are wrong, and on how many
    drives."""
    judged = [(row.query, query) for row in table.pairs for query in row.queries if query.right is not None]
    cells = []
    for low, high in zip(_BANDS, (*_BANDS[1:], math.inf), strict=True):
        of = [(drive, query) for drive, query in judged if low <= (query.confidence or 0.0) < high]
        drives, wrong = {drive for drive, _ in of}, [drive for drive, query in of if not query.right]
        band = f"{low:.2f} to {high:.2f}" if math.isfinite(high) else f"{low:.2f} and above"
        located = sum(query.located for _, query in of)
        cells.append([band, str(located), share(len(wrong), len(of)), share(len(set(wrong)), len(drives))])
    heads = (("confidence",), ("located", "the likeliest place is wrong", "drives with a wrong one"), ())
    return [
        *markdown(heads, cells),
        "",
        "All answers that can be judged, also those that do not say `located`, and those from elsewhere.",
    ]


_DRIVES = (
    ("map", "recording"),
    ("located first, s", "m", "looks", "told", "judged", "wrong", "false alarms"),
    ("",),
)
_CARRIED = (
    ("map", "recording", "carried to"),
    ("noticed, s", "m", "located again, s", "m", "told", "judged", "wrong", "false alarms"),
    ("",),
)


def _followed(table: Table) -> list[str]:
    """Return the recordings that were followed, and those that were followed as one robot that is carried."""
    drives, carried = _drives_and_carried(table)
    page = []
    if drives:
        page += _section("Along drives", _DRIVES, map(_followed_cells, drives), _about_drives(drives))
    if carried:
        page += _section("Carried away", _CARRIED, map(_followed_cells, carried), _about_carried(carried))
    return page


def _drives_and_carried(table: Table) -> tuple[list[FollowedRow], list[FollowedRow]]:
    drives = [row for row in table.followed if row.after is None]
    return drives, [row for row in table.followed if row.after is not None]


def _section(title: str, heads: Heads, cells: Iterable[list[str]], about: str) -> list[str]:
    """Return a table of the page with what is said of it."""
    return [f"## {title}", "", *markdown(heads, list(cells)), "", *wrap(about, 105), ""]


def _about_drives(rows: Sequence[FollowedRow]) -> str:
    looks, told = sum(row.looks for row in rows), sum(row.located for row in rows)
    return (
        "`watch` follows a recording from its beginning on, as a robot that does not know where it is, and "
        "looks after each metre. The map is of another session, or of the time before. "
        f"{_count('located_s', rows)} of {len(rows)} robots are located, {_middle('located_s', rows)} s and "
        f"{_middle('located_m', rows)} m after they began, in the median; what never happens counts as "
        f"longest. Of {looks} looks, also where the map shows nothing, {told} tell a place. {_wrong(rows)}"
    )


def _about_carried(rows: Sequence[FollowedRow]) -> str:
    knew = [row for row in rows if row.knew]
    shown = [row for row in knew if row.shown]
    return (
        "`watch` follows two recordings as one, the second a second after the first, with wheels that did "
        f"not turn in between. Of {len(knew)} kidnaps of a robot that knew where it was, "
        f"{_count('noticed_s', knew)} are noticed, "
        f"{_middle('noticed_s', knew)} s and {_middle('noticed_m', knew)} m after it was put down, in the "
        f"median. In {len(shown)} of them the map shows what it sees there; it is located again "
        f"{_count('located_s', shown)} times, {_middle('located_s', shown)} s and "
        f"{_middle('located_m', shown)} m after, in the median. {_wrong(rows)}"
    )


def _wrong(rows: Sequence[FollowedRow]) -> str:
    judged, wrong = sum(row.judged for row in rows), sum(row.wrong for row in rows)
    return (
        f"Of {judged} places that can be judged, {wrong} are wrong, in {sum(row.wrong > 0 for row in rows)} "
        f"of {len(rows)} rows. A false alarm gives up a right place though nobody carried the robot and the "
        f"map shows what it sees: {sum(row.alarms for row in rows)}."
    )


_JOINS = (
    ("map", "other map", "buildings"),
    ("status", "probability", "in common, m2", "off, m", "cpu, s"),
    ("outcome",),
)


def _joined(table: Table) -> list[str]:
    """Return the pairs of maps that are of one building or were joined, and how many there are."""
    if not table.joins:
        return []
    same, others = ([row for row in table.joins if row.same is of] for of in (True, False))
    count = Counter(row.outcome for row in same)
    wrong = [row for row in others if row.outcome == "wrong"]
    about = (
        "As `db join` does, all maps of one building are compared with each other, and each with "
        f"{FOREIGN_MAPS} of other buildings. Of {len(same)} pairs of one building {count['right']} join "
        f"right, {count['wrong']} wrong; of {count['not judged']} that are joined nobody knows how they lie; "
        f"{count['not joined']} are not joined. Of {len(others)} pairs of two buildings {len(wrong)} are "
        "joined; each would be wrong. right: as answers are, in the middle of what agrees."
    )
    return _section("Joined", _JOINS, map(_join_cells, (*same, *wrong)), about)


def _join_cells(row: JoinRow) -> list[str]:
    return [
        row.target,
        row.source,
        "one" if row.same else "two",
        row.status,
        number(row.probability, 3),
        number(row.common_m2, 0),
        number(row.error_m, 2),
        number(row.cpu_s, 1),
        row.problem or (f"**{row.outcome}**" if row.outcome == "wrong" else row.outcome),
    ]


def _count(name: str, rows: Sequence[FollowedRow]) -> int:
    return sum(getattr(row, name) is not None for row in rows)


def _middle(name: str, rows: Sequence[FollowedRow]) -> str:
    """Return the median, where what never happened is longest."""
    values = (getattr(row, name) for row in rows)
    ordered = sorted(math.inf if value is None else value for value in values)
    middle = ordered[len(ordered) // 2] if ordered else math.inf
    return f"{middle:.1f}" if math.isfinite(middle) else "no"


def _followed_cells(row: FollowedRow) -> list[str]:
    names, note = [row.map, row.before], ""
    cells = [number(row.located_s, 1), number(row.located_m, 1)]
    if row.after is None:
        cells.append(str(row.looks))
    else:
        names.append(row.after)
        cells = [number(row.noticed_s, 1), number(row.noticed_m, 1), *cells]
        note = "" if row.shown else "the map does not show where it was put down"
        note = note if row.knew else "was not located before"
    cells += [str(row.located), str(row.judged), strong(row.wrong), strong(row.alarms)]
    return [*names, *[""] * len(cells), row.problem] if row.problem else [*names, *cells, note]


def _failures(table: Table) -> list[str]:
    """Return every wrong answer, and every one that is not judged, with what is needed to ask for it
    again."""
    wrong, unjudged = (
        [
            f"- {row.name}, {row.kind}: the window from {query.start_s:.1f} s, "
            + (f"{query.error_m:.2f} m off, " if query.error_m is not None else "")
            + f"confidence {query.confidence or 0:.3f}"
            for row in table.pairs
            for query in row.queries
            if query.located and query.right is right
        ]
        for right in (False, None)
    )
    problems = [
        f"- {row.name}: the window from {query.start_s:.1f} s: {query.problem}"
        for row in table.pairs
        for query in row.queries
        if query.problem not in ("", NOT_RUN)
    ]
    counts = _total(table.pairs)
    located, not_judged = counts["located"], counts["not judged"]
    none = f"Of {located} located answers none is known to be wrong; {not_judged} are not judged."
    found = ["## Wrong answers", "", *wrong, ""] if wrong else [none, ""]
    for title, lines in (("Not judged", unjudged), ("Failed", problems)):
        found += [f"## {title}", "", *lines, ""] if lines else []
    return found


_HIDDEN = {"building", "over KISS-ICP", "bare KISS-ICP", "right of covered", "overlooked", "rank", "in space"}
"""Columns of the page that a terminal has no room for."""


def show(table: Table) -> None:
    """Print the rows on a terminal, and which answers are wrong."""
    tables, (drives, carried) = [], _drives_and_carried(table)
    for title, heads, cells in (
        ("Maps", _MAPS, [_map_cells(row) for row in table.maps]),
        ("Places", _PLACES, [_pair_cells(row) for row in table.pairs]),
        ("Along drives", _DRIVES, [_followed_cells(row) for row in drives]),
        ("Carried away", _CARRIED, [_followed_cells(row) for row in carried]),
        ("Joined", _JOINS, [_join_cells(row) for row in table.joins]),
    ):
        names = [name for side in heads for name in side]
        shown = [k for k, name in enumerate(names) if name not in _HIDDEN]
        texts = len([k for k in shown if k < len(heads[0])])
        lines = output.table(title, [names[k] for k in shown[:texts]], [names[k] for k in shown[texts:]])
        for row in cells:
            lines.add_row(*(row[k].replace("*", "") for k in shown))
        tables += [lines] if cells else []
    output.show(*tables, *_disturbed(table), *_failures(table))


def _changed(changed: Sequence[RowChange]) -> list[str]:
    if not changed:
        return []
    return ["## Changed since the run before", "", *change_lines(changed), ""]


def change_lines(changed: Sequence[RowChange]) -> list[str]:
    """Return a line for each change; what became worse by more than chance is marked."""
    return [f"- {'**worse** ' if change.worse else ''}{change.row}: {change.text}" for change in changed]


def _total(rows: Iterable[PairRow]) -> Counter[str]:
    return counts_of([query for row in rows for query in row.queries])


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangeParameters:
    """From when on a difference is told. All chosen by hand.

    share : of an error or of a time, which vary by less from one machine or version to the next. error_m : an
        error that changed by less is not told. seconds : the same of a processor time.
    """

    share: float = 0.25
    error_m: float = 0.01
    seconds: float = 1.0


CHANGE = ChangeParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class RowChange:
    """A line of what changed. row : of the page. worse : by more than chance."""

    row: str
    text: str
    worse: bool = False


def changes(before: Table, after: Table) -> list[RowChange]:
    """Return what changed in the rows that both runs have; times relative to the change that half of them
    exceed."""
    maps = [(old, new) for new in after.maps for old in before.maps if old.name == new.name]
    recorded = filter(lambda row: row.kind != "disturbed", after.pairs)  # the others ask the same again
    asked = {(row.kind, row.name): row for row in before.pairs}
    pairs = [(asked[new.kind, new.name], new) for new in recorded if (new.kind, new.name) in asked]
    pace = _pace(maps)
    same_form = before.quick == after.quick
    found = [change for old, new in maps for change in _map_changes(old, new, pace)]
    for old, new in pairs:
        windows = _same_windows([(old, new)], same_form=same_form)
        found += _pair_changes(new.name, old.problem, new.problem, windows)
    for building in dict.fromkeys(new.building for _, new in pairs):
        rows = [(old, new) for old, new in pairs if new.building == building]
        found += _worse(f"building {building}", _same_windows(rows, same_form=same_form))
    found += _worse("all queries", _same_windows(pairs, same_form=same_form))
    joined = {(row.target, row.source): row.outcome for row in before.joins}
    for row in after.joins:
        was = joined.get((row.target, row.source), row.outcome)
        if row.outcome != was:
            name, text = f"{row.source} joined with {row.target}", f"{was} -> {row.outcome}"
            found.append(RowChange(row=name, text=text, worse=row.outcome in ("wrong", "failed")))
    return found


def _pace(maps: Sequence[tuple[MapRow, MapRow]]) -> float:
    """Return the processor time of this run over that of the other one, in the median: machines differ."""
    ratios = [new.cpu_s / old.cpu_s for old, new in maps if old.cpu_s and new.cpu_s]
    return median(ratios) if ratios else 1.0


def _map_changes(old: MapRow, new: MapRow, pace: float) -> Iterator[RowChange]:
    if old.problem != new.problem:
        yield _problem(new.name, old.problem, new.problem, "mapped")
        return
    for text, was, is_, told in _figures(old, new, pace):
        if told:
            yield RowChange(row=new.name, text=text, worse=is_ > was)
    verdicts = [{warning.about: warning.verdict for warning in row.warnings} for row in (old, new)]
    for words, some, others, bad in (
        ("new warning", verdicts[1], verdicts[0], "false"),
        ("no longer warned of", verdicts[0], verdicts[1], "right"),
    ):
        for about in sorted(some.keys() - others.keys()):
            verdict = some[about]
            yield RowChange(row=new.name, text=f"{words}: {about} ({verdict})", worse=verdict == bad)


def _figures(old: MapRow, new: MapRow, pace: float) -> Iterator[tuple[str, float, float, bool]]:
    """Yield the words for each figure of a map, the two values (more is worse), and whether it is
    printed."""
    if old.error_m is not None and new.error_m is not None:
        text = f"error {old.error_m:.3f} -> {new.error_m:.3f} m"
        yield text, old.error_m, new.error_m, _moved(old.error_m, new.error_m, CHANGE.error_m)
    if old.cpu_s and new.cpu_s:
        cpu_s = new.cpu_s / pace
        ratio = f"({cpu_s / old.cpu_s:.2f} of what all changed by)"
        text = f"processor time {old.cpu_s:.1f} -> {new.cpu_s:.1f} s {ratio}"
        yield text, old.cpu_s, cpu_s, _moved(old.cpu_s, cpu_s, CHANGE.seconds)
    yield f"parts {old.parts} -> {new.parts}", old.parts or 0, new.parts or 0, old.parts != new.parts
    was, is_ = (100 * (row.lost or 0.0) for row in (old, new))
    yield f"scans lost {was:.0f} -> {is_:.0f} %", was, is_, round(was) != round(is_)


def _moved(old: float, new: float, least: float) -> bool:
    """Return whether a value differs by `least` and by more than `ChangeParameters.share`."""
    ratio, most = new / max(old, 1e-6), 1 + CHANGE.share
    return abs(new - old) >= least and not 1 / most < ratio < most


def _problem(row: str, old: str, new: str, without: str) -> RowChange:
    """Return two problems that differ. without : the word for none."""
    return RowChange(row=row, text=f"{old or without} -> {new or without}", worse=bool(new) and not old)


def _same_windows(
    rows: Sequence[tuple[PairRow, PairRow]], *, same_form: bool
) -> list[tuple[QueryRow, QueryRow]]:
    """Return the answers of both runs to the same windows.

    same_form : whether both runs are quick, or none. If not, fewer answers judge each other in one of them,
        and what is judged in one only is left out.
    """
    return [
        (a, b)
        for old, new in rows
        for b in new.queries
        for a in old.queries
        if (a.window, a.start_s) == (b.window, b.start_s)
        and (same_form or (a.right is None) == (b.right is None))
    ]


def _pair_changes(
    name: str, old_problem: str, new_problem: str, windows: Sequence[tuple[QueryRow, QueryRow]]
) -> Iterator[RowChange]:
    if old_problem != new_problem:
        yield _problem(name, old_problem, new_problem, "asked")
    before, after = (Counter(pair[k].outcome for pair in windows) for k in (0, 1))
    for what in ("right", "wrong", "refused", "not judged", "failed"):
        if before[what] != after[what]:
            text = f"{what} {before[what]} -> {after[what]} of {len(windows)}"
            yield RowChange(row=name, text=text, worse=what == "failed" and after[what] > before[what])
    for old, new in windows:
        if new.outcome == "wrong" != old.outcome:
            sure = f" at {new.confidence:.3f}" if new.confidence is not None else ""
            off = f", {new.error_m:.2f} m off" if new.error_m is not None else ""
            text = f"newly wrong: the window from {old.start_s:.1f} s{off}{sure} ({old.outcome} before)"
            yield RowChange(row=name, text=text, worse=True)


def _worse(name: str, windows: Sequence[tuple[QueryRow, QueryRow]]) -> Iterator[RowChange]:
    """Yield how many are located and right now and were not, or no longer; worse by a sign test."""
    counts = Counter((a.outcome == "right", b.outcome == "right") for a, b in windows)
    lost, won = counts[True, False], counts[False, True]
    if lost == won:
        return
    chance = by_chance(max(lost, won), min(lost, won))
    text = f"{won} windows more are located and right, {lost} are no longer (p {chance:.3f})"
    if chance < ALPHA or name == "all queries":
        yield RowChange(row=name, text=text, worse=lost > won and chance < ALPHA)
