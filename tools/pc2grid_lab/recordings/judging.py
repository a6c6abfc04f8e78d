"""The one judge: maps by the truth of their trajectories, answers by true poses, or by each other.

A recording that is followed as it is, too, says how it lies in the map: its surest looks agree on that. So a
place after a kidnap is judged by what the robot said there when nobody had carried it away.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, TypeVar

import cv2
import networkx as nx
import numpy as np

from pc2grid.estimation.tracker import follow
from pc2grid.geometry import F64, SE2, invert_pose, leveling
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.observer import TimeSpan
from pc2grid_cli.options import Reading
from pc2grid_lab.recordings.catalogue import Catalogue, Pair, Placed, Recording
from pc2grid_lab.recordings.run import Folder, Followed
from pc2grid_lab.recordings.table import (
    MISSING,
    FollowedRow,
    JoinRow,
    MapRow,
    PairRow,
    QueryRow,
    Table,
    Truth,
    Warned,
    WarningVerdict,
)
from pc2grid_lab.runner import NOT_RUN, Finished, grouped, kept_result
from pc2grid_lab.truth import (
    AGREEMENT,
    AHEAD_M,
    JUDGEMENT,
    SAME_NS,
    Clue,
    Frame,
    Relation,
    agreed_frame,
    fit_frame,
    is_right,
    nearest,
    pose_at_stamp,
    read_relations,
    relation_errors,
    rms,
    trajectory_errors,
)
from signature.config import Config
from signature.database import open_database
from signature.localization.pose_check import check_pose
from signature.places.map_index import MapIndex

_GAP_NS = 200_000_000
"""True poses farther apart are not interpolated, as a robot turns between them."""
_CARRIED_NS = 5_000_000_000
"""The own trajectory is laid on the true poses of so long before and after."""
_BEFORE_S = 2.0
"""A scan is looked for from so long before its stamp on."""
_KNOWN_M = 0.2
"""A wall hit lies on known ground if the map knows a cell this near: noise puts hits behind the wall."""


def sessions(folder: Folder, name: str) -> dict[str, Trajectory]:
    """Return the trajectories of the sessions of a map, empty if there is none."""
    if not folder.map(name).exists():
        return {}
    with open_database(folder.map(name)) as database:
        return {info.name: database.trajectory(info.name) for info in database.sessions()}


def mount(folder: Folder, recording: Recording) -> F64:
    """Return t_base_sensor (4, 4) of a recording's first scan."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        return next(iter(log.scans())).T_base_sensor


@dataclass(frozen=True)
class RecordedDrive:
    """A recording as it was driven: its own trajectories, and true poses if there are any.

    parts : the sessions of the map of the whole recording; none for a map that is no recording.
    truth : poses of the base in the world, whose z is up, stamped as the scans are; None without.
    """

    parts: tuple[Trajectory, ...]
    truth: Trajectory | None

    def own_pose(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """Return the part and T_part_base of the scan with that stamp; None if no part has it."""
        for number, part in enumerate(self.parts):
            (k,) = nearest(part.stamps_ns, np.array([stamp_ns]))
            if k >= 0:
                return number, SE2.from_matrix(part.T_session_base[k])
        return None

    def where(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """Return the same; of a recording with true poses the part is -1, and the pose the true one.

        Where true poses are far apart, the own trajectory around the stamp is laid on those there.
        """
        own, truth = self.own_pose(stamp_ns), self.truth
        if truth is None:
            return own
        T = pose_at_stamp(truth, stamp_ns, same_ns=SAME_NS, gap_ns=_GAP_NS)
        if T is not None:
            return -1, SE2.from_matrix(T)
        if own is None:
            return None
        near = np.flatnonzero(np.abs(truth.stamps_ns - stamp_ns) <= _CARRIED_NS)
        pairs = [
            (there[1], SE2.from_matrix(truth.T_session_base[k]))
            for k in near.tolist()
            if (there := self.own_pose(int(truth.stamps_ns[k]))) is not None and there[0] == own[0]
        ]
        return (-1, fit_frame(pairs, AHEAD_M) @ own[1]) if pairs else None


@cache
def drive_of(recording: Recording, folder: Folder) -> RecordedDrive:
    """Return the drive of a recording whose whole map is in the folder."""
    parts = tuple(sessions(folder, recording.name).values())
    poses = folder.true(recording, recording.poses)
    if poses is None:
        return RecordedDrive(parts, None)
    truth = read_tum(poses)
    truth = replace(truth, stamps_ns=truth.stamps_ns + round(recording.late_s * 1e9))
    if not recording.of_base:
        T_sensor_base = invert_pose(mount(folder, recording))
        truth = replace(truth, T_session_base=truth.T_session_base @ T_sensor_base)
    return RecordedDrive(parts, levelled(truth, parts))


@cache
def grids(folder: Folder, name: str) -> dict[str, OccupancyGrid]:
    """Return the sessions of a map by name."""
    with open_database(folder.map(name)) as database:
        return {info.name: database.grid(info.name) for info in database.sessions()}


def levelled(truth: Trajectory, parts: Sequence[Trajectory]) -> Trajectory:
    """Turn true poses of the base so that z of the world is up.

    The world of a camera's poses may lie as its first image does. Which way is up in it is told by the own
    trajectories, which are levelled; without scans that have a true pose it stays as it is.
    """
    up = np.zeros(3)
    for part in parts:
        at = np.searchsorted(part.stamps_ns, truth.stamps_ns).clip(max=len(part) - 1)
        same = np.abs(part.stamps_ns[at] - truth.stamps_ns) <= SAME_NS
        # The third row of a rotation is the vertical of its frame, as the base sees it.
        vertical = part.T_session_base[at[same], 2, :3, None]
        up += (truth.T_session_base[same, :3, :3] @ vertical).sum(axis=(0, 2))
    if not up.any():
        return truth
    return replace(truth, T_session_base=leveling(up / np.linalg.norm(up)) @ truth.T_session_base)


def config_of(recording: Recording) -> Config:
    """Return the settings that the commands read a recording with."""
    given = dict(zip(recording.options[::2], recording.options[1::2], strict=True))
    return Reading(topic=given.get("--topic"), odometry=given.get("--odometry")).settings()


def hits_at(folder: Folder, recording: Recording, stamp_ns: int) -> F64:
    """Return the walls (N, 2) that the scan with that stamp shows, in the axes of the base."""
    config = config_of(recording)
    with open_log(folder.source(recording), config.read) as log:
        start_s = max((stamp_ns - log.info.start_ns) * 1e-9 - _BEFORE_S, 0.0)
        scans = iter(log.scans(start_s, 2.0 * _BEFORE_S))
        last = next(scans)
        for scan in itertools.takewhile(lambda scan: scan.stamp_ns <= stamp_ns, scans):
            last = scan
        ((_, planar_scan),) = follow([last], config)
    return np.asarray(planar_scan.hits_m, np.float64)


def known_share(grid: OccupancyGrid, points_m: F64) -> float:
    """Return the share 0..1 of points (N, 2) in the map frame that have a known cell within `_KNOWN_M`; 0
    without."""
    if not len(points_m):
        return 0.0
    reach = round(_KNOWN_M / grid.resolution_m)
    known = cv2.dilate((grid.cells >= 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    return float(grid.look_up(known, points_m, outside=0).sum() / len(points_m))


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
    """Return the row of a recording as a map; what cannot be judged is a row that says why."""
    row = MapRow(name=recording.name, building=recording.building, sensor=recording.sensor_shown)
    done = kept_result(folder.kept("maps", recording.name))
    problem = MISSING if folder.missing(recording) else done.error
    if problem:
        return replace(row, problem=problem, cpu_s=done.cpu_s or None)
    return _judged(row, lambda: _figures(recording, folder, done))


Row = TypeVar("Row", MapRow, PairRow, FollowedRow, JoinRow)


def _judged(row: Row, judge: Callable[[], dict[str, Any]]) -> Row:
    """Return a row with what `judge` says of it; if it cannot be judged, with the reason."""
    try:
        return replace(row, **judge())
    except Exception as error:
        return replace(row, problem=f"{type(error).__name__}: {error}")


def _figures(recording: Recording, folder: Folder, done: Finished) -> dict[str, Any]:
    stored = done.document["sessions"]
    reports = [session["report"] for session in stored]
    read = sum(report["scans_read"] for report in reports)
    skipped = sum(sum(report["scans_skipped"].values()) for report in reports)
    bare = kept_result(folder.kept("bare", recording.name)).result or {}
    error = _error(recording, folder)
    texts = itertools.chain.from_iterable(report["warnings"] for report in reports)
    sums = {name: sum(session[name] for session in stored) for name in ("duration_s", "path_m", "area_m2")}
    return {
        "minutes": sums["duration_s"] / 60.0,
        "metres": sums["path_m"],
        "area_m2": sums["area_m2"],
        "cpu_s": done.cpu_s,
        "over_bare": done.cpu_s / bare["cpu_s"] if bare else None,
        "parts": len(stored),
        "lost": skipped / read if read else None,
        "warnings": warned(texts, error_m=error.get("error_m")),
        "bare_m": bare.get("ate_m"),
        **error,
    }


def _error(recording: Recording, folder: Folder) -> dict[str, Any]:
    """Return the error of a trajectory against its truth; of a recording in parts, that of each part by
    itself."""
    parts, truth = list(sessions(folder, recording.name).values()), folder.true(recording, recording.truth)
    if recording.same_place:
        return {"truth": "loops", **_relation_error(parts, _loops(recording, folder))}
    if truth is None:
        return {}
    if truth.suffix == ".relations":
        T_base_sensor = SE2.from_matrix(mount(folder, recording))
        return {"truth": "relations", **_relation_error(parts, read_relations(truth), T_base_sensor)}
    true = read_tum(truth)
    errors_m = np.concatenate([trajectory_errors(part, true) for part in parts])
    compared = len(errors_m) / max(sum(len(part) for part in parts), 1)
    return {"truth": "poses", "compared": compared} | ({"error_m": rms(errors_m)} if len(errors_m) else {})


def _loops(recording: Recording, folder: Folder) -> list[Relation]:
    """Return relations: from each scan of `Recording.same_place` to the next one the sensor has not moved."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        stamps = [scan.stamp_ns for scan in log.scans()]
    there = [stamps[number] for number in recording.same_place]
    return [(first_ns, second_ns, SE2()) for first_ns, second_ns in itertools.pairwise(there)]


def _relation_error(
    parts: Sequence[Trajectory], relations: Sequence[Relation], T_base_sensor: SE2 | None = None
) -> dict[str, float]:
    """Return mean errors over the relations that lie in one part."""
    errors = np.concatenate([relation_errors(part, relations, T_base_sensor) for part in parts])
    if not len(errors):
        return {"compared": 0.0}
    error_m, error_rad = errors.mean(axis=0).tolist()
    compared = len(errors) / len(relations)
    return {"error_m": error_m, "error_deg": math.degrees(error_rad), "compared": compared}


def warned(texts: Iterable[str], *, error_m: float | None) -> tuple[Warned, ...]:
    """Return the warnings of `convert`, each with what it is about and whether it is right, where that is
    known.

    error_m : of the trajectory, None if it is not known.
    """
    found = []
    for text in texts:
        known = (about for about, pattern in _ABOUT.items() if re.search(pattern, text))
        about = next(known, " ".join(text.split()[:5]))  # of one that is not known here, its first words
        found.append(Warned(about=about, verdict=_verdict(about, error_m), text=text))
    return tuple(found)


def _verdict(about: str, error_m: float | None) -> WarningVerdict:
    if about == "height":  # each of the recordings is of one floor
        return "false"
    if about not in _SHAPE or error_m is None or EXACT_M <= error_m <= WRONG_M:
        return "unknown"
    return "false" if error_m < EXACT_M else "right"


_SESSION = "map"
"""The first session of a map, see `run`."""
Frames = dict[tuple[int, str], Frame]
"""By part of the drive and session of the map."""
_STEP_M = 0.3
"""Scans of a map place it in the world once on such a distance."""


def judged_table(
    catalogue: Catalogue,
    folder: Folder,
    followed: Sequence[Followed],
    *,
    program: str,
    commit: str,
    advance: Callable[[float], None],
) -> Table:
    """Judge all rows of a run. advance : called with the share that is done."""
    judge, rows = Judge(catalogue, folder), []
    maps = tuple(map_row(recording, folder) for recording in catalogue.mapped)
    for done, pair in enumerate(catalogue.pairs, start=1):
        rows.append(judge.row(pair))
        advance(done / len(catalogue.pairs))
    return Table(
        program=program,
        commit=commit,
        quick=catalogue.quick,
        cpu_s=folder.cpu_s(),
        maps=maps,
        pairs=tuple(rows),
        followed=tuple(map(judge.followed_row, followed)),
        joins=tuple(judge.join_row(*pair) for pair in catalogue.joins),
    )


@dataclass(frozen=True)
class LocatedWindow:
    """A window, its answer, and what it has last seen.

    where : the part of the drive, and the pose of the base there at the last scan; of a drive with true poses
        the part is -1 and the pose the true one.
    """

    query: str
    window: int
    span: TimeSpan
    done: Finished
    where: tuple[int, SE2] | None = None
    hits_m: F64 = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def answer(self) -> dict[str, Any] | None:
        """Return the document of `relocalize`; None if it failed."""
        answer: dict[str, Any] | None = self.done.result
        return answer

    @property
    def places(self) -> list[tuple[str, SE2, int]]:
        """Return session, pose and number of the place of each hypothesis, best first."""
        hypotheses = [] if self.answer is None else self.answer["hypotheses"]
        return [(h["session"], SE2(h["x"], h["y"], h["yaw"]), h["place"]) for h in hypotheses]


class Judge:
    """Judges the rows of one run; what several of them need is read once."""

    def __init__(self, catalogue: Catalogue, folder: Folder) -> None:
        self._catalogue, self._folder = catalogue, folder
        self._windows: dict[Pair, list[LocatedWindow]] = {}
        self._followed: dict[Followed, Frame | None] = {}
        self._lie: dict[str, nx.DiGraph] = {}

    def row(self, pair: Pair) -> PairRow:
        """Return the row of a pair; what cannot be judged is a row that says why."""
        query, map_ = (self._catalogue.recordings[name] for name in (pair.query, pair.map))
        row = PairRow(
            query=pair.query,
            map=pair.map_name,
            kind=pair.kind,
            building=map_.building,
            sensors=" in ".join(dict.fromkeys((query.sensor_shown, map_.sensor_shown))),
        )
        return _judged(row, lambda: self._answers(pair))

    def _answers(self, pair: Pair) -> dict[str, Any]:
        """Return what a row holds of the answers of a pair."""
        problem = self._problem(pair)
        if problem:
            return {"problem": problem}
        truth, windows, frames = self._frames(pair)
        agreeing = sum(len(f.clues) for f in frames.values()) if truth == "agreement" else None
        queries = tuple(self._row_of(pair, one, frames) for one in windows)
        return {"truth": truth, "agreeing": agreeing, "queries": queries}

    def truths(self, pair: Pair) -> Iterator[tuple[TimeSpan, dict[str, SE2], bool]]:
        """Yield the windows of a pair whose place is known: the window, the base at its end in each session
        of the map that shows it, and whether the map knows what is seen there.

        Of a pair with another building, every window, and no place.
        """
        _, windows, frames = self._frames(pair)
        for one in windows:
            expected = _expected(one, frames)
            if expected or pair.kind == "elsewhere":
                poses = {session: pose for session, (pose, _) in expected.items()}
                yield one.span, poses, self._covered(pair, one, expected)

    def _row_of(self, pair: Pair, one: LocatedWindow, frames: Frames) -> QueryRow:
        """Judge an answer by where the query is in the sessions of the map; where it is missed, with what
        `--check` says of its true pose."""
        row = QueryRow(
            window=one.window,
            start_s=one.span.start_s,
            problem=one.done.error,
            cpu_s=one.done.cpu_s or None,
        )
        if one.answer is None:
            return row
        expected, space = _expected(one, frames), one.answer.get("in_space")
        row = replace(
            row,
            status=one.answer["status"],
            confidence=one.answer["confidence"],
            travel_m=one.answer["query"]["path_m"],
            in_space=None if space is None else space["status"],
        )
        if pair.kind == "elsewhere":
            return replace(row, right=False, covered=False)
        if not expected:
            return row
        row = replace(row, covered=self._covered(pair, one, expected), **_best(one.places, expected))
        return replace(row, fine=self._fine(pair, one, expected)) if row.missed else row

    def _covered(self, pair: Pair, one: LocatedWindow, expected: Mapping[str, tuple[SE2, float]]) -> bool:
        """Return whether a map knows the ground that a window has last seen."""
        known = grids(self._folder, pair.map_name)
        return any(
            known_share(known[session], T_map_base.apply(one.hits_m)) >= JUDGEMENT.mapped
            for session, (T_map_base, _) in expected.items()
        )

    def _fine(
        self, pair: Pair, one: LocatedWindow, expected: Mapping[str, tuple[SE2, float]]
    ) -> float | None:
        """Return the probability of the true pose of a window by `check_pose`; None if that does not call it
        fine."""
        query, folder, sure = self._catalogue.recordings[pair.query], self._folder, []
        config = config_of(query)
        for session, (T_map_base, _) in expected.items():
            with (
                open_database(folder.map(pair.map_name)) as database,
                open_log(folder.source(query), config.read) as log,
            ):
                scans = follow(log.scans(one.span.start_s, one.span.duration_s), config)
                checked = check_pose(scans, MapIndex.of(database, config), T_map_base, session=session)
            if checked.status == "fine":
                sure.append(checked.probability)
        return max(sure, default=None)

    def followed_row(self, one: Followed) -> FollowedRow:
        """Return the row of a recording that was followed; where there is no result, one that says why."""
        building = self._catalogue.building(one.map)
        row = FollowedRow(before=one.before, after=one.after, map=one.map_name, building=building)
        done = kept_result(self._folder.kept("followed", one.asked))
        if done.failed:
            return replace(row, problem=done.error)
        if one.after is not None:
            begin_ns = done.document["put_down_ns"] - done.document["shift_ns"]
            row = replace(row, shown=self._shows(one, one.after, begin_ns) is True)
        return followed_row(row, self._looks(one, done))

    def _looks(self, one: Followed, done: Finished) -> list[Look]:
        """Return the looks, each with whether its place is right."""
        put_down_ns, shift_ns = done.document["put_down_ns"], done.document["shift_ns"]
        looks: list[Look] = []
        for said in done.document["looks"]:
            carried = put_down_ns is not None and said["stamp_ns"] >= put_down_ns
            name = one.after if carried and one.after is not None else one.before
            own_ns = said["stamp_ns"] - (shift_ns if carried else 0)
            place = self._followed_place(one, name, own_ns)
            right = is_right(_pose(said), *place)[0] if said["pose"] is not None and place else None
            parts = drive_of(self._catalogue.recordings[name], self._folder).parts
            began_ns = int(parts[0].stamps_ns[0]) + round((one.until_s or 0.0) * 1e9)
            begin_ns = put_down_ns - shift_ns if carried else began_ns
            ways = [np.interp((begin_ns, own_ns), part.stamps_ns, part.path_m()) for part in parts]
            since_s, since_m = (own_ns - begin_ns) * 1e-9, float(sum(np.ptp(way) for way in ways))
            given_up = said["state"] in NOTICED and _was_right(looks)
            alarm = given_up and self._shows(one, name, own_ns) is not False
            looks.append(Look(said["state"], right, since_s, since_m, carried=carried, alarm=alarm))
        return looks

    def _shows(self, one: Followed, name: str, stamp_ns: int) -> bool | None:
        """Return whether the map knows what the robot sees; None if nobody knows where that is."""
        place = self._followed_place(one, name, stamp_ns)
        if place is None:
            return None
        hits_m = hits_at(self._folder, self._catalogue.recordings[name], stamp_ns)
        grid = grids(self._folder, one.map_name)[_SESSION]
        return known_share(grid, place[0].apply(hits_m)) >= JUDGEMENT.mapped

    def _followed_place(self, one: Followed, name: str, stamp_ns: int) -> tuple[SE2, float] | None:
        """Return T_map_base at a scan of a recording, and how far a right answer may be from there, metres.

        By the looks at the recording as it is; None if they do not tell how it lies in the map.
        """
        drive = drive_of(self._catalogue.recordings[name], self._folder)
        alone = replace(one, before=name, after=None)
        if alone not in self._followed:
            found = kept_result(self._folder.kept("followed", alone.asked)).result or {"looks": []}
            clues = [
                Clue(own[1], _pose(said), (name, number), said["confidence"])
                for number, said in enumerate(found["looks"])
                if said["pose"] is not None and (own := drive.own_pose(said["stamp_ns"])) is not None
            ]
            self._followed[alone] = agreed_frame(clues) if clues else None
        frame, at = self._followed[alone], drive.own_pose(stamp_ns)
        return None if frame is None or at is None else frame.place(at[1])

    def join_row(self, target: str, source: str) -> JoinRow:
        """Return the row of two maps that were compared; where there is no result, one that says why."""
        building, other = (self._catalogue.building(name) for name in (target, source))
        row = JoinRow(target=target, source=source, same=building == other)
        done = kept_result(self._folder.kept("joins", f"{source}.in.{target}"))
        if done.failed:
            return replace(row, problem=done.error)
        told = {name: done.document[name] for name in ("status", "probability", "common_m2")}
        return _judged(row, lambda: {**told, **self._joined(row, done.document), "cpu_s": done.cpu_s})

    def _joined(self, row: JoinRow, found: dict[str, Any]) -> dict[str, Any]:
        """Return whether two maps lie to each other as was found, and how far off that is."""
        if not row.same:
            return {"right": False}
        lie = self._lying(self._catalogue.building(row.target))
        if not {row.target, row.source} <= {*lie} or not nx.has_path(lie, row.source, row.target):
            return {}
        T, middle = (SE2(**found[name]) for name in ("T_target_source", "middle"))
        expected, within_m = middle, 0.0
        for a, b in itertools.pairwise(nx.shortest_path(lie, row.source, row.target)):
            expected, hop_m = lie.edges[a, b]["frame"].place(expected)
            within_m += hop_m
        right, error_m = is_right(T @ middle, expected, within_m)
        return {"right": right, "error_m": error_m}

    def _lying(self, building: str) -> nx.DiGraph:
        """Return which maps of a building are known to lie how in which: an edge from a map to another one
        has the `Frame` that places poses of the first in the second."""
        if building in self._lie:
            return self._lie[building]
        lie = self._lie[building] = nx.DiGraph()
        known = [r for r in self._catalogue.mapped if r.building == building and not r.disturbed]
        for query, map_ in itertools.permutations(known, 2):
            if lie.has_edge(query.name, map_.name) or query.sensor == "map":
                continue
            pair = self._asked(query.name, map_.name)
            known_by = {} if pair is None else self._frames(pair)[2]
            places = [
                (SE2.from_matrix(part.T_session_base[k]), place)
                for part in drive_of(query, self._folder).parts[:1]
                for k in _steps(part, AGREEMENT.place_m)
                if (place := self._lies_at(query, map_, int(part.stamps_ns[k]), known_by)) is not None
            ]
            if len(places) >= 2:
                within_m = min(within_m for _, (_, within_m) in places)
                there = tuple(Clue(own, pose) for own, (pose, _) in places)
                back = tuple(Clue(pose, own) for own, (pose, _) in places)
                lie.add_edge(query.name, map_.name, frame=Frame(there, within_m))
                lie.add_edge(map_.name, query.name, frame=Frame(back, within_m))
        return lie

    def _lies_at(
        self, query: Recording, map_: Recording, stamp_ns: int, frames: Frames
    ) -> tuple[SE2, float] | None:
        """Return where a scan of a recording is in the map of another one, and how far off a right answer may
        be: by the answers to its windows, which give `frames`, or else to its scans; None if these were not
        asked, or do not tell."""
        if not frames:
            return self._followed_place(Followed(before=query.name, map=map_.name), query.name, stamp_ns)
        drive = drive_of(query, self._folder)
        places = [where for where in (drive.where(stamp_ns), drive.own_pose(stamp_ns)) if where is not None]
        found = (frames[n, _SESSION].place(pose) for n, pose in places if (n, _SESSION) in frames)
        return next(found, None)

    def _problem(self, pair: Pair) -> str:
        if gaps := self._folder.gaps(self._catalogue, pair):
            return f"{gaps[0]}: {MISSING}"
        done = kept_result(self._folder.kept("maps", pair.map_name))
        return f"{pair.map_name if done.error == NOT_RUN else 'no map'}: {done.error}" if done.failed else ""

    def _asked(self, query: str, map_: str) -> Pair | None:
        """Return the pair of a recording that was located in the map of another one, if there is one."""
        pairs = (p for p in self._catalogue.pairs if (p.query, p.map, p.until_s) == (query, map_, None))
        pair = next(pairs, None)
        return None if pair is None or self._problem(pair) else pair

    def _located_windows(self, pair: Pair) -> list[LocatedWindow]:
        """Return the windows of a pair with their answers."""
        if pair not in self._windows:
            query = self._catalogue.recordings[pair.query]
            windows = self._catalogue.windows(pair, self._folder.length_s(query))
            self._windows[pair] = [self._one(pair, query, number, span) for number, span in windows]
        return self._windows[pair]

    def _one(self, pair: Pair, query: Recording, number: int, span: TimeSpan) -> LocatedWindow:
        one = LocatedWindow(pair.query, number, span, kept_result(self._folder.answer(pair, span)))
        if one.answer is None or pair.kind == "elsewhere":
            return one
        stamp_ns, drive = int(one.answer["query"]["stamp_ns"]), drive_of(query, self._folder)
        where = drive.where(stamp_ns) if pair.placed is None else drive.own_pose(stamp_ns)
        return replace(one, where=where, hits_m=hits_at(self._folder, query, stamp_ns))

    def _frames(self, pair: Pair) -> tuple[Truth | None, list[LocatedWindow], Frames]:
        """Return the windows, and how the parts of the drive lie in the sessions of the map: by true poses,
        by the trajectory of the whole recording, by a pose that was found once, or else by the answers."""
        query, map_ = (self._catalogue.recordings[name] for name in (pair.query, pair.map))
        windows = self._located_windows(pair)
        if pair.kind == "elsewhere":
            return "elsewhere", windows, {}
        if query.poses is not None and query.poses == map_.poses:
            return "poses", windows, self._by_scans(pair, map_)
        if pair.query == pair.map:
            return "trajectory", windows, self._by_scans(pair, map_)
        if pair.placed is not None:
            return pair.placed.by, windows, self._placed(query, pair.placed)
        shared = self._shared(pair) if map_.sensor == "map" else None
        windows, frames = shared or (windows, _agreed([*_said(windows), *self._said_back(pair)]))
        return ("agreement" if frames else None), windows, frames

    def _said_back(self, pair: Pair) -> Iterator[tuple[tuple[int, str], Clue]]:
        """Yield the answers of the reverse pair: the map's recording located in the query's map. They relate
        the same two trajectories.

        Nothing where true poses place one of them, or where it was not asked.
        """
        back = self._asked(pair.map, pair.query)
        recordings = [self._catalogue.recordings[name] for name in (pair.query, pair.map)]
        if pair.until_s is not None or back is None or any(r.poses for r in recordings):
            return
        parts, names = (list(sessions(self._folder, r.name)) for r in recordings)
        for (number, session), clue in _said(self._located_windows(back)):
            turned = Clue(clue.T_map_base, clue.T_drive_base, clue.query, clue.weight)
            yield (parts.index(session), names[number]), turned

    def _shared(self, pair: Pair) -> tuple[list[LocatedWindow], Frames] | None:
        """Return the windows and frames of several drives in one map, whose answers judge each other: those
        that are known to lie in the trajectory of one of them, or of another recording of the building.

        None if there are not several.
        """
        building = self._catalogue.building(pair.map)
        in_map = [p for p in self._catalogue.pairs if p.map_name == pair.map_name and p.kind != "elsewhere"]
        for root in self._catalogue.recordings.values():
            if root.building != building or len(in_map) < 2:
                continue
            drives = {p.query: moved for p in in_map if (moved := self._in_root(p, root.name)) is not None}
            if pair.query in drives and len(drives) > 1:
                return drives[pair.query], _agreed(_said(one for found in drives.values() for one in found))
        return None

    def _in_root(self, pair: Pair, root: str) -> list[LocatedWindow] | None:
        """Return the windows of a pair, in the trajectory of the recording `root`; None if not located
        there."""
        if pair.query == root:
            return self._located_windows(pair)
        link = self._asked(pair.query, root)
        frames = {} if link is None else _agreed(_said(self._located_windows(link)))
        if (0, _SESSION) not in frames:
            return None
        frame = frames[0, _SESSION]
        return [
            replace(one, where=(0, frame.place(one.where[1])[0]) if one.where and one.where[0] == 0 else None)
            for one in self._located_windows(pair)
        ]

    def _by_scans(self, pair: Pair, map_: Recording) -> Frames:
        """Return how the sessions of the map lie in the world, or in the whole drive that they are a part of:
        by their own scans, one on each `_STEP_M`."""
        drive = drive_of(map_, self._folder)
        found = (
            ((where[0], session), Clue(where[1], SE2.from_matrix(trajectory.T_session_base[k])))
            for session, trajectory in sessions(self._folder, pair.map_name).items()
            for k in _steps(trajectory)
            if (where := drive.where(int(trajectory.stamps_ns[k]))) is not None
        )
        return _frames_by(found, lambda clues: Frame(tuple(clues)) if len(clues) >= 2 else None)

    def _placed(self, query: Recording, known: Placed) -> Frames:
        """Return the frame of the recording's first part in the map, by one pose."""
        drive = drive_of(query, self._folder).parts[0]
        at_ns = drive.stamps_ns[0] + round(known.at_s * 1e9)
        (k,) = nearest(drive.stamps_ns, np.array([at_ns]), math.inf)
        T_map_base = SE2(known.x_m, known.y_m, math.radians(known.yaw_deg))
        clue = Clue(SE2.from_matrix(drive.T_session_base[k]), T_map_base)
        return {(0, _SESSION): Frame((clue,), known.within_m)}


def _steps(trajectory: Trajectory, step_m: float = _STEP_M) -> list[int]:
    """Return the numbers of its scans, one on each step."""
    first: list[int] = np.unique((trajectory.path_m() / step_m).astype(int), return_index=True)[1].tolist()
    return first


def _said(windows: Iterable[LocatedWindow]) -> Iterator[tuple[tuple[int, str], Clue]]:
    """Yield the part of the drive, the session of the map, and the best place of every answer."""
    for one in windows:
        if one.where is not None and one.places and one.answer is not None:
            session, T_map_base, _ = one.places[0]
            clue = Clue(one.where[1], T_map_base, (one.query, one.window), float(one.answer["confidence"]))
            yield (one.where[0], session), clue


def _agreed(said: Iterable[tuple[tuple[int, str], Clue]]) -> Frames:
    """Return how the parts of drives lie in the sessions of a map, by what answers agree on."""
    return _frames_by(said, agreed_frame)


def _frames_by(
    said: Iterable[tuple[tuple[int, str], Clue]], frame_of: Callable[[list[Clue]], Frame | None]
) -> Frames:
    """Return the frames that follow from the clues of each part of a drive and session of a map."""
    found = ((key, frame_of(clues)) for key, clues in grouped(said).items())
    return {key: frame for key, frame in found if frame is not None}


def _expected(one: LocatedWindow, frames: Frames) -> dict[str, tuple[SE2, float]]:
    """Return where the base is at the end of a window, by session of the map, and how far a right answer may
    be."""
    if one.where is None:
        return {}
    part, T_drive_base = one.where
    return {
        session: frame.place(T_drive_base, without=(one.query, one.window))
        for (of_part, session), frame in frames.items()
        if of_part == part
    }


def _best(
    places: Sequence[tuple[str, SE2, int]], expected: Mapping[str, tuple[SE2, float]]
) -> dict[str, Any]:
    """Return `right` and `error_m` of the first hypothesis, and `rank` of the first right one, by its
    place."""
    if not places:
        return {"right": False}
    judged = [
        is_right(pose, *expected[session]) if session in expected else (None, None)
        for session, pose, _ in places
    ]
    order = list(dict.fromkeys(place for _, _, place in places))
    ranks = (order.index(place) for (_, _, place), (right, _) in zip(places, judged, strict=True) if right)
    right, error_m = judged[0]
    return {"right": right, "error_m": error_m, "rank": next(ranks, None)}


NOTICED = ("lost", "recovered")
"""States that say that the robot is not where it was located last."""


@dataclass(frozen=True, slots=True)
class Look:
    """What `watch` said after a scan.

    right : None if no place was told, or it cannot be judged. since_s, since_m : time and travel since the
        robot was put down, or of one that is not carried away, since its drive began. carried : whether it
        has been carried away. alarm : whether the robot is given up where it was located, though that was not
        wrong, and the map shows what it sees.
    """

    state: str
    right: bool | None
    since_s: float = 0.0
    since_m: float = 0.0
    carried: bool = False
    alarm: bool = False

    @property
    def tells(self) -> bool:
        """Return whether it names a place."""
        return self.state in ("located", "recovered")


def _was_right(looks: Sequence[Look]) -> bool:
    """Return whether the robot was located, and the last place that it was sent is not known to be wrong."""
    told = [look for look in looks if look.tells]
    return bool(told) and looks[-1].state != "lost" and told[-1].right is not False


def _pose(said: dict[str, Any]) -> SE2:
    return SE2(said["pose"]["x"], said["pose"]["y"], said["pose"]["yaw"])


def followed_row(row: FollowedRow, looks: Sequence[Look]) -> FollowedRow:
    """Return what a row holds of its looks."""
    before = [look for look in looks if not look.carried]
    after = looks[len(before) :]
    knew = bool(before) and before[-1].state in ("located", "recovered", "off_map", "doubtful")
    if knew:  # until it is noticed, the old place is told
        after = [*itertools.dropwhile(lambda look: look.state not in NOTICED, after)]
    rights = [look.right for look in (*before, *after) if look.tells]
    row = replace(
        row,
        looks=len(looks),
        located=len(rights),
        judged=len(rights) - rights.count(None),
        wrong=rights.count(False),
        alarms=sum(look.alarm for look in before),
        knew=knew,
    )
    if row.after is None:
        after = before
    elif knew and after:
        row = replace(row, noticed_s=after[0].since_s, noticed_m=after[0].since_m)
    else:
        return row
    first = next((look for look in after if look.tells and look.right is not False), None)
    return row if first is None else replace(row, located_s=first.since_s, located_m=first.since_m)
