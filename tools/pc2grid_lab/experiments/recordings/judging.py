"""The rows of the page about places: each answer judged by true poses, by clouds, or by the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pc2grid.geometry import F64, SE2
from pc2grid.io import open_log
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.observer import TimeSpan
from pc2grid.pipeline import follow
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair, PlacedByHand, Recording
from pc2grid_lab.experiments.recordings.kidnaps import Followed, FollowedJudge
from pc2grid_lab.experiments.recordings.rows import (
    MISSING,
    NOT_RUN,
    PairRow,
    QueryRow,
    Table,
    Truth,
    map_row,
    said,
)
from pc2grid_lab.experiments.recordings.run import (
    Finished,
    Folder,
    config_of,
    drive_of,
    grids,
    hits_at,
    kept,
    known_share,
    sessions,
)
from pc2grid_lab.experiments.trial import JUDGEMENT
from pc2grid_lab.experiments.truth import (
    Clue,
    Frame,
    agreed_frame,
    cloud_along,
    is_right,
    nearest,
    registered_clouds,
)
from signature.database import open_database
from signature.localization.map_index import MapIndex
from signature.localization.pose_check import check_pose

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
    """All rows of a run. advance : called with the share that is done."""
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
        followed=tuple(map(FollowedJudge(catalogue, folder).row, followed)),
    )


@dataclass(frozen=True)
class LocatedWindow:
    """A window, its answer, and what it has last seen.

    answer : the document of `relocalize`; None if it failed. where : the part of the drive, and the pose of
        the base there at the last scan; of a drive with true poses the part is -1 and the pose the true one.
    """

    query: str
    window: int
    span: TimeSpan
    done: Finished | None
    where: tuple[int, SE2] | None = None
    hits_m: F64 = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def answer(self) -> dict[str, Any] | None:
        """The document of `relocalize`."""
        return None if self.done is None or self.done.failed else self.done.document

    @property
    def places(self) -> list[tuple[str, SE2, int]]:
        """Session, pose and number of the place of each hypothesis, best first."""
        if self.answer is None:
            return []
        return [(h["session"], SE2(h["x"], h["y"], h["yaw"]), h["place"]) for h in self.answer["hypotheses"]]


class Judge:
    """Judges the pairs of one run; what several pairs need is read once."""

    def __init__(self, catalogue: Catalogue, folder: Folder) -> None:
        self._catalogue, self._folder = catalogue, folder
        self._windows: dict[Pair, list[LocatedWindow]] = {}

    def row(self, pair: Pair) -> PairRow:
        """The row of a pair; what cannot be judged is a row that says why."""
        query, map_ = (self._catalogue.recordings[name] for name in (pair.query, pair.map))
        row: dict[str, Any] = {
            "query": pair.query,
            "map": pair.map_name,
            "kind": pair.kind,
            "building": map_.building,
            "sensors": " in ".join(dict.fromkeys((query.sensor_shown, map_.sensor_shown))),
        }
        try:
            return self._judged(pair, query, map_, row)
        except Exception as error:
            return PairRow(**row, problem=said(error))

    def truths(self, pair: Pair) -> Iterator[tuple[TimeSpan, dict[str, SE2], bool]]:
        """The windows of a pair whose place is known: the window, the base at its end in each session of the
        map that shows it, and whether the map knows what is seen there.

        Of a pair with another building, every window, and no place.
        """
        query, map_ = (self._catalogue.recordings[name] for name in (pair.query, pair.map))
        if pair.kind == "elsewhere":
            yield from ((one.span, {}, False) for one in self._located_windows(pair))
            return
        _, windows, frames = self._frames(pair, query, map_)
        known = grids(self._folder, pair.map_name)
        for one in windows:
            expected = _expected(one, frames)
            if expected:
                poses = {session: pose for session, (pose, _) in expected.items()}
                yield one.span, poses, _covered(one, expected, known)

    def _judged(self, pair: Pair, query: Recording, map_: Recording, row: dict[str, Any]) -> PairRow:
        problem = self._problem(pair)
        if problem:
            return PairRow(**row, problem=problem)
        if pair.kind == "elsewhere":
            queries = tuple(_elsewhere(one) for one in self._located_windows(pair))
            return PairRow(**row, truth="elsewhere", queries=queries)
        truth, windows, frames = self._frames(pair, query, map_)
        known = grids(self._folder, pair.map_name)
        return PairRow(
            **row,
            truth=truth,
            agreeing=sum(len(f.clues) for f in frames.values()) if truth == "agreement" else None,
            queries=tuple(self._row_of(pair, one, frames, known) for one in windows),
        )

    def _row_of(
        self, pair: Pair, one: LocatedWindow, frames: Frames, known: Mapping[str, OccupancyGrid]
    ) -> QueryRow:
        """The row of a window; where it is missed, with what `--check` says of its true pose."""
        row = _judged(one, frames, known)
        if not row.missed:
            return row
        query = self._catalogue.recordings[pair.query]
        return replace(row, fine=self._fine(pair, query, one, _expected(one, frames)))

    def _fine(
        self, pair: Pair, query: Recording, one: LocatedWindow, expected: Mapping[str, tuple[SE2, float]]
    ) -> float | None:
        """Probability of the true pose of a window by `check_pose`; None if that does not call it fine."""
        config, folder, found = config_of(query), self._folder, []
        for session, (T_map_base, _) in expected.items():
            with (
                open_database(folder.map(pair.map_name)) as database,
                open_log(folder.source(query), config.read) as log,
            ):
                scans = follow(log.scans(one.span.start_s, one.span.duration_s), config)
                checked = check_pose(scans, MapIndex.of(database, config), T_map_base, session=session)
            found += [checked.probability] if checked.status == "fine" else []
        return max(found, default=None)

    def _problem(self, pair: Pair) -> str:
        if gaps := self._folder.gaps(self._catalogue, pair):
            return f"{gaps[0]}: {MISSING}"
        done = kept(self._folder.result(pair.map_name))
        if done is None:
            return f"{pair.map_name}: {NOT_RUN}"
        return f"no map: {done.error}" if done.failed else ""

    def _located_windows(self, pair: Pair) -> list[LocatedWindow]:
        """The windows of a pair with their answers."""
        if pair not in self._windows:
            query = self._catalogue.recordings[pair.query]
            windows = self._catalogue.windows(pair, self._folder.length_s(query))
            self._windows[pair] = [self._one(pair, query, number, span) for number, span in windows]
        return self._windows[pair]

    def _one(self, pair: Pair, query: Recording, number: int, span: TimeSpan) -> LocatedWindow:
        one = LocatedWindow(pair.query, number, span, kept(self._folder.answer(pair, span)))
        if one.answer is None or pair.kind == "elsewhere":
            return one
        stamp_ns = int(one.answer["query"]["stamp_ns"])
        where = drive_of(query, self._folder).where(stamp_ns)
        return replace(one, where=where, hits_m=hits_at(self._folder, query, stamp_ns))

    def _frames(
        self, pair: Pair, query: Recording, map_: Recording
    ) -> tuple[Truth | None, list[LocatedWindow], Frames]:
        """The windows, and how the parts of the drive lie in the sessions of the map: by true poses, by the
        trajectory of the whole recording, by hand, by the clouds of both, or else by the answers.
        """
        windows = self._located_windows(pair)
        if query.poses is not None and query.poses == map_.poses:
            return "poses", windows, self._by_scans(pair, map_)
        if pair.query == pair.map:
            return "trajectory", windows, self._by_scans(pair, map_)
        if pair.by_hand is not None:
            return "hand", windows, self._by_hand(query, pair.by_hand)
        if pair.until_s is None and (by_clouds := self._by_clouds(query, map_)) is not None:
            own = [replace(one, where=self._own(query, one)) for one in windows]
            return "clouds", own, {(0, _SESSION): by_clouds}
        shared = self._shared(pair) if map_.sensor == "map" else None
        windows, frames = shared or (windows, _agreed([*_said(windows), *self._said_back(pair)]))
        return ("agreement" if frames else None), windows, frames

    def _said_back(self, pair: Pair) -> Iterator[tuple[tuple[int, str], Clue]]:
        """What the drive of the map says, asked in the map of this query: it is of the same two trajectories.

        Nothing where true poses place one of them, or where it was not asked.
        """
        wanted = (pair.map, pair.query, pair.until_s)
        back = next((p for p in self._catalogue.pairs if (p.query, p.map, p.until_s) == wanted), None)
        recordings = [self._catalogue.recordings[name] for name in (pair.query, pair.map)]
        if (
            pair.until_s is not None
            or back is None
            or any(r.poses for r in recordings)
            or self._problem(back)
        ):
            return
        parts, names = (list(sessions(self._folder, r.name)) for r in recordings)
        for (number, session), clue in _said(self._located_windows(back)):
            turned = Clue(clue.T_map_base, clue.T_drive_base, clue.query, clue.weight)
            yield (parts.index(session), names[number]), turned

    def _own(self, query: Recording, one: LocatedWindow) -> tuple[int, SE2] | None:
        """Where the base is at the end of a window, by the trajectory that its cloud lies along."""
        if one.answer is None:
            return None
        return drive_of(query, self._folder).own_pose(int(one.answer["query"]["stamp_ns"]))

    def _by_clouds(self, query: Recording, map_: Recording) -> Frame | None:
        """The frame of a recording in the map of another one, by the clouds of both; None if they have none,
        or do not tell."""
        if any(r.sensor not in ("lidar", "depth") for r in (query, map_)):
            return None
        drives, clouds = [drive_of(one, self._folder).parts[0] for one in (query, map_)], []
        for recording, drive in zip((query, map_), drives, strict=True):
            with open_log(self._folder.source(recording), config_of(recording).read) as log:
                clouds.append(cloud_along(log, drive))
        T_map_query = registered_clouds(clouds[0], clouds[1])
        if T_map_query is None:
            return None
        ways = [SE2.from_matrix(drives[0].T_session_base[k]) for k in _steps(drives[0])]
        return Frame(tuple(Clue(pose, T_map_query @ pose) for pose in ways))

    def _shared(self, pair: Pair) -> tuple[list[LocatedWindow], Frames] | None:
        """The same of several drives in one map, whose answers judge each other: those that are known to lie
        in the trajectory of one of them, or of another recording of the building.

        None if there are not several.
        """
        building = self._catalogue.recordings[pair.map].building
        in_map = [p for p in self._catalogue.pairs if p.map_name == pair.map_name and p.kind != "elsewhere"]
        for root in self._catalogue.recordings.values():
            if root.building != building or len(in_map) < 2:
                continue
            drives = {p.query: moved for p in in_map if (moved := self._in_root(p, root.name)) is not None}
            if pair.query in drives and len(drives) > 1:
                return drives[pair.query], _agreed(_said(one for found in drives.values() for one in found))
        return None

    def _in_root(self, pair: Pair, root: str) -> list[LocatedWindow] | None:
        """The windows of a pair, in the trajectory of the recording `root`; None if not located there."""
        if pair.query == root:
            return self._located_windows(pair)
        wanted = (pair.query, root, None)
        link = next((p for p in self._catalogue.pairs if (p.query, p.map, p.until_s) == wanted), None)
        if link is None or self._problem(link):
            return None
        frame = _agreed(_said(self._located_windows(link))).get((0, _SESSION))
        if frame is None:
            return None
        return [
            replace(one, where=(0, frame.place(one.where[1])[0]) if one.where and one.where[0] == 0 else None)
            for one in self._located_windows(pair)
        ]

    def _by_scans(self, pair: Pair, map_: Recording) -> Frames:
        """How the sessions of the map lie in the world, or in the whole drive that they are a part of: by
        their own scans, one on each `_STEP_M`."""
        drive = drive_of(map_, self._folder)
        clues: dict[tuple[int, str], list[Clue]] = {}
        for session, trajectory in sessions(self._folder, pair.map_name).items():
            for k in _steps(trajectory):
                where = drive.where(int(trajectory.stamps_ns[k]))
                if where is not None:
                    clue = Clue(where[1], SE2.from_matrix(trajectory.T_session_base[k]))
                    clues.setdefault((where[0], session), []).append(clue)
        return {key: Frame(tuple(found)) for key, found in clues.items() if len(found) >= 2}

    def _by_hand(self, query: Recording, known: PlacedByHand) -> Frames:
        """The frame of the recording's first part in the map, by one pose."""
        drive = drive_of(query, self._folder).parts[0]
        at_ns = drive.stamps_ns[0] + round(known.at_s * 1e9)
        (k,) = nearest(drive.stamps_ns, np.array([at_ns]), math.inf)
        T_map_base = SE2(known.x_m, known.y_m, math.radians(known.yaw_deg))
        clue = Clue(SE2.from_matrix(drive.T_session_base[k]), T_map_base)
        return {(0, _SESSION): Frame((clue,), known.within_m)}


def _steps(trajectory: Trajectory) -> list[int]:
    """Numbers of its scans, one on each `_STEP_M`."""
    first: list[int] = np.unique((trajectory.path_m() / _STEP_M).astype(int), return_index=True)[1].tolist()
    return first


def _said(windows: Iterable[LocatedWindow]) -> Iterator[tuple[tuple[int, str], Clue]]:
    """The part of the drive, the session of the map, and the best place of every answer."""
    for one in windows:
        if one.where is not None and one.places and one.answer is not None:
            session, T_map_base, _ = one.places[0]
            clue = Clue(one.where[1], T_map_base, (one.query, one.window), float(one.answer["confidence"]))
            yield (one.where[0], session), clue


def _agreed(said: Iterable[tuple[tuple[int, str], Clue]]) -> Frames:
    """How the parts of drives lie in the sessions of a map, by what answers have said."""
    groups: dict[tuple[int, str], list[Clue]] = {}
    for key, clue in said:
        groups.setdefault(key, []).append(clue)
    found = ((key, agreed_frame(clues)) for key, clues in groups.items())
    return {key: frame for key, frame in found if frame is not None}


def _answered(one: LocatedWindow) -> dict[str, Any]:
    """What a row says of an answer before it is judged."""
    row: dict[str, Any] = {"window": one.window, "start_s": one.span.start_s}
    if one.done is None:
        return {**row, "problem": NOT_RUN}
    if one.answer is None:
        return {**row, "problem": one.done.error, "cpu_s": one.done.cpu_s}
    space = one.answer.get("in_space")
    return {
        **row,
        "status": one.answer["status"],
        "confidence": one.answer["confidence"],
        "travel_m": one.answer["query"]["path_m"],
        "in_space": None if space is None else space["status"],
        "cpu_s": one.done.cpu_s,
    }


def _elsewhere(one: LocatedWindow) -> QueryRow:
    """An answer in the map of another building, where nothing is right."""
    return QueryRow(**_answered(one), right=None if one.answer is None else False, covered=False)


def _judged(one: LocatedWindow, frames: Frames, grids: Mapping[str, OccupancyGrid]) -> QueryRow:
    """An answer judged by where the query is in the sessions of the map."""
    row = _answered(one)
    if one.answer is None or one.where is None:
        return QueryRow(**row)
    expected = _expected(one, frames)
    if not expected:
        return QueryRow(**row)
    return QueryRow(**row, covered=_covered(one, expected, grids), **_best(one.places, expected))


def _expected(one: LocatedWindow, frames: Frames) -> dict[str, tuple[SE2, float]]:
    """Where the base is at the end of a window, by session of the map, and how far a right answer may be."""
    if one.where is None:
        return {}
    part, T_drive_base = one.where
    return {
        session: frame.place(T_drive_base, without=(one.query, one.window))
        for (of_part, session), frame in frames.items()
        if of_part == part
    }


def _covered(
    one: LocatedWindow, expected: Mapping[str, tuple[SE2, float]], grids: Mapping[str, OccupancyGrid]
) -> bool:
    return any(
        known_share(grids[session], T_map_base.apply(one.hits_m)) >= JUDGEMENT.mapped
        for session, (T_map_base, _) in expected.items()
    )


def _best(
    places: Sequence[tuple[str, SE2, int]], expected: Mapping[str, tuple[SE2, float]]
) -> dict[str, Any]:
    """`right` and `error_m` of the first hypothesis, and `rank` of the first right one, by its place."""
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
