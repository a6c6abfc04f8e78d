"""What the page says of a map and of the queries in it, as it is kept beside the page.

The rows of the page about maps.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter

from pc2grid.geometry import SE2
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Trajectory
from pc2grid_lab.experiments.recordings.catalogue import Recording
from pc2grid_lab.experiments.recordings.run import Finished, Folder, config_of, kept, mount, sessions
from pc2grid_lab.experiments.truth import Relations, read_relations, relation_error, trajectory_error

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


MISSING = "not in the data folder"
_ABOUT = {
    "bent": r"contradicts itself",
    "loose": r"^no loop ties",
    "height": r"^the height changes by",
    "parts": r"^the recording falls into \d+ parts",
    "lost": r"^registration was lost",
    "weak": r"did not fix the pose in every direction",
    "no tf": r"^the log has no tf",
    "gaps": r"gaps of more than",
    "empty scans": r"hold no returns",
}
_SHAPE = ("bent", "loose")
EXACT_M, WRONG_M = 0.1, 0.25
"""A map with a smaller error is not bent, one with a larger is. Chosen by hand: what a doubled wall needs."""


def map_row(recording: Recording, folder: Folder) -> MapRow:
    """The row of a recording as a map; what cannot be judged is a row that says why."""
    row: dict[str, Any] = {
        "name": recording.name,
        "building": recording.building,
        "sensor": recording.sensor_shown,
    }
    if folder.missing(recording):
        return MapRow(**row, problem=MISSING)
    done = kept(folder.result(recording.name))
    if done is None:
        return MapRow(**row, problem=NOT_RUN)
    if done.failed:
        return MapRow(**row, problem=done.error, cpu_s=done.cpu_s)
    try:
        return MapRow(**row, cpu_s=done.cpu_s, **_figures(recording, folder, done))
    except Exception as error:
        return MapRow(**row, problem=said(error))


def said(error: Exception) -> str:
    """What became of a row that cannot be judged."""
    return f"{type(error).__name__}: {error}"


def _figures(recording: Recording, folder: Folder, done: Finished) -> dict[str, Any]:
    stored = done.document["sessions"]
    reports = [session["report"] for session in stored]
    read = sum(report["scans_read"] for report in reports)
    skipped = sum(sum(report["scans_skipped"].values()) for report in reports)
    bare = kept(folder.bare(recording.name))
    bare_of: dict[str, Any] = {} if bare is None or bare.failed else bare.document
    error = _error(recording, folder)
    texts = itertools.chain.from_iterable(report["warnings"] for report in reports)
    sums = {name: sum(session[name] for session in stored) for name in ("duration_s", "path_m", "area_m2")}
    return {
        "minutes": sums["duration_s"] / 60.0,
        "metres": sums["path_m"],
        "area_m2": sums["area_m2"],
        "over_bare": done.cpu_s / bare_of["cpu_s"] if bare_of else None,
        "parts": len(stored),
        "lost": skipped / read if read else None,
        "warnings": warned(texts, error_m=error.get("error_m")),
        "bare_m": bare_of.get("ate_m"),
        **error,
    }


def _error(recording: Recording, folder: Folder) -> dict[str, Any]:
    """The error of a trajectory against its truth; of a recording in parts, that of each part by itself."""
    parts, truth = list(sessions(folder, recording.name).values()), folder.truth(recording)
    if recording.same_place:
        return {"truth": "loops", **_relation_error(parts, _loops(recording, folder), SE2())}
    if truth is None:
        return {}
    if truth.suffix == ".relations":
        T_base_sensor = SE2.from_matrix(mount(folder, recording))
        return {"truth": "relations", **_relation_error(parts, read_relations(truth), T_base_sensor)}
    return {"truth": "poses", **_pose_error(parts, truth)}


def _loops(recording: Recording, folder: Folder) -> Relations:
    """From each scan of `Recording.same_place` to the next one the sensor has not moved."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        stamps = {number: scan.stamp_ns for number, scan in enumerate(log.scans())}
    there = np.array([stamps[number] for number in recording.same_place])
    return Relations(first_ns=there[:-1], second_ns=there[1:], T_first_second=np.zeros((len(there) - 1, 3)))


def _relation_error(
    parts: Sequence[Trajectory], relations: Relations, T_base_sensor: SE2
) -> dict[str, float]:
    """Mean errors over the relations that lie in one part."""
    offset_m = (T_base_sensor.x, T_base_sensor.y)
    found = [relation_error(part, relations, base_to_reference_m=offset_m) for part in parts]
    found = [error for error in found if error.used]
    if not found:
        return {"compared": 0.0}
    used = [error.used for error in found]
    return {
        "error_m": float(np.average([error.translation_m for error in found], weights=used)),
        "error_deg": float(np.average([error.rotation_deg for error in found], weights=used)),
        "compared": sum(used) / found[0].total,
    }


def _pose_error(parts: Sequence[Trajectory], truth: Path) -> dict[str, float]:
    """RMS distance from the true poses, each part aligned by itself."""
    true = read_tum(truth)
    found = [error for part in parts if (error := trajectory_error(part, true)) is not None]
    if not found:
        return {"compared": 0.0}
    poses = [error.poses for error in found]
    return {
        "error_m": float(np.sqrt(np.average([error.ate_m**2 for error in found], weights=poses))),
        "compared": sum(poses) / max(sum(len(part) for part in parts), 1),
    }


def warned(texts: Iterable[str], *, error_m: float | None) -> tuple[Warned, ...]:
    """The warnings of `convert`, each with what it is about and whether it is right, where that is known.

    error_m : of the trajectory, None if it is not known.
    """
    return tuple(
        Warned(about=about, verdict=_verdict(about, error_m), text=text)
        for text in texts
        for about in [_about(text)]
    )


def _about(text: str) -> str:
    """What a warning is about; of one that is not known here, its first words."""
    for about, pattern in _ABOUT.items():
        if re.search(pattern, text):
            return about
    return " ".join(text.split()[:5])


def _verdict(about: str, error_m: float | None) -> Verdict:
    if about == "height":  # each of the recordings is of one floor
        return "false"
    if about in _SHAPE and error_m is not None:
        if error_m < EXACT_M:
            return "false"
        if error_m > WRONG_M:
            return "right"
    return "unknown"
