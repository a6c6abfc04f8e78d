"""The rows of the page, from what the commands answered."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.geometry import SE2, interpolate_pose
from pc2grid.model import OccupancyGrid, Trajectory
from pc2grid.time_span import TimeSpan
from pc2grid_lab.experiments.recordings.agreement import Clue, Frame, agreed_frame, is_right
from pc2grid_lab.experiments.recordings.catalogue import Catalogue, Pair, Recording
from pc2grid_lab.experiments.recordings.children import Finished, kept
from pc2grid_lab.experiments.recordings.rows import MapRow, PairRow, QueryRow, Table, Truth
from pc2grid_lab.experiments.recordings.run import Folder
from pc2grid_lab.experiments.recordings.warned import warned
from pc2grid_lab.experiments.trial import JUDGEMENT
from signature.config import Config

MISSING = "not in the data folder"
_NOT_RUN = "was not run"
_KNOWN_M = 0.2
"""A wall hit lies on known ground if the map knows a cell this near: noise puts hits behind the wall."""
_LAST_S = 2.0
"""The last scan of a window lies within this of its end."""
_SAME_NS = 5_000_000
"""Stamps that differ by no more than this are of one scan."""
_GAP_NS = 1_000_000_000
"""True poses farther apart are not interpolated; the recording's own trajectory carries on the nearest."""
_CARRIED_NS = 10_000_000_000
"""For no longer than this."""
_SESSION = "map"
"""The first session of a map, see `run`."""
Frames = dict[tuple[int, str], Frame]
"""By part of the drive and session of the map."""
_STEP_M = 0.3
"""Scans of a map place it in the world once on such a distance."""


def judged_table(
    catalogue: Catalogue,
    folder: Folder,
    *,
    program: str,
    commit: str,
    advance: Callable[[float], None] = lambda share: None,
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
    )


def map_row(recording: Recording, folder: Folder) -> MapRow:
    """The row of a recording as a map; what cannot be judged is a row that says why."""
    try:
        return _map_row(recording, folder)
    except Exception as error:
        name, building, sensor = recording.name, recording.building, recording.sensor
        return MapRow(name=name, building=building, sensor=sensor, problem=_said(error))


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _map_row(recording: Recording, folder: Folder) -> MapRow:
    row: dict[str, Any] = {
        "name": recording.name,
        "building": recording.building,
        "sensor": recording.sensor,
    }
    if folder.missing(recording):
        return MapRow(**row, problem=MISSING)
    done = kept(folder.result(recording.name))
    if done is None or done.failed:
        return MapRow(
            **row, problem=_NOT_RUN if done is None else done.error, cpu_s=done.cpu_s if done else None
        )
    sessions = done.document["sessions"]
    reports = [session["report"] for session in sessions]
    read = sum(report["scans_read"] for report in reports)
    skipped = sum(sum(report["scans_skipped"].values()) for report in reports)
    bare = kept(folder.bare(recording.name))
    bare_of: dict[str, Any] = {} if bare is None or bare.failed else bare.document
    error = _error(recording, folder)
    return MapRow(
        **row,
        minutes=sum(session["duration_s"] for session in sessions) / 60.0,
        metres=sum(session["path_m"] for session in sessions),
        area_m2=sum(session["area_m2"] for session in sessions),
        cpu_s=done.cpu_s,
        over_bare=done.cpu_s / bare_of["cpu_s"] if bare_of else None,
        parts=len(sessions),
        lost=skipped / read if read else None,
        warnings=warned(
            (text for report in reports for text in report["warnings"]),
            storeys=recording.storeys,
            error_m=error.get("error_m"),
        ),
        bare_m=bare_of.get("ate_m"),
        **error,
    )


def _error(recording: Recording, folder: Folder) -> dict[str, Any]:
    """The error of a trajectory against its truth; of a recording in parts, that of each part by itself."""
    if recording.truth is None:
        return {}
    parts = list(folder_sessions(folder, recording.name).values())
    truth = folder.data / recording.truth
    if truth.suffix == ".relations":
        return {"truth": "relations", **_relation_error(parts, truth, _mount(folder, recording))}
    return {"truth": "poses", **_pose_error(parts, truth)}


def _relation_error(parts: Sequence[Trajectory], truth: Path, T_base_sensor: SE2) -> dict[str, float]:
    """Mean errors over the relations that lie in one part."""
    from pc2grid_lab.experiments.slam_relations import read_relations, relation_error

    relations, mount = read_relations(truth), (T_base_sensor.x, T_base_sensor.y)
    found = [relation_error(part, relations, base_to_reference_m=mount) for part in parts]
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
    from pc2grid.io.trajectory import read_tum
    from pc2grid_lab.experiments.trajectory_error import TrajectoryError, trajectory_error

    true = read_tum(truth)

    def errors() -> Iterator[TrajectoryError]:
        for part in parts:
            try:
                yield trajectory_error(part, true)
            except ValueError:  # fewer than three poses of this part have a true one
                continue

    found = list(errors())
    if not found:
        return {"compared": 0.0}
    poses = [error.poses for error in found]
    return {
        "error_m": float(np.sqrt(np.average([error.ate_m**2 for error in found], weights=poses))),
        "compared": sum(poses) / max(sum(len(part) for part in parts), 1),
    }


def folder_sessions(folder: Folder, name: str) -> dict[str, Trajectory]:
    """The trajectories of the sessions of a map, empty if there is none."""
    from signature.database import open_database

    if not folder.map(name).exists():
        return {}
    with open_database(folder.map(name)) as database:
        return {info.name: database.trajectory(info.name) for info in database.sessions()}


def _mount(folder: Folder, recording: Recording) -> SE2:
    """T_base_sensor of a recording's first scan."""
    from pc2grid.io import open_log

    with open_log(folder.source(recording), _config(recording).read) as log:
        return SE2.from_matrix(next(iter(log.scans())).T_base_sensor)


@dataclass(frozen=True)
class Drive:
    """A recording as it was driven: its own trajectories, and true poses if there are any.

    parts : the sessions of the map of the whole recording; none for a map that is no recording.
    world : name of the frame of the true poses, None without.
    """

    parts: tuple[Trajectory, ...]
    truth: Trajectory | None
    T_sensor_base: SE2

    @staticmethod
    def of(recording: Recording, folder: Folder) -> Drive:
        """Of a recording whose whole map is in the folder."""
        from pc2grid.io.trajectory import read_tum

        parts = tuple(folder_sessions(folder, recording.name).values())
        truth = None if recording.poses is None else read_tum(folder.data / recording.poses)
        mount = SE2() if recording.of_base or truth is None else _mount(folder, recording)
        return Drive(parts, truth, mount.inverse())

    def own_pose(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """The part and T_part_base of the scan with that stamp; None if no part has it."""
        for number, part in enumerate(self.parts):
            k = _nearest(part.stamps_ns, stamp_ns)
            if k is not None and abs(int(part.stamps_ns[k]) - stamp_ns) <= _SAME_NS:
                return number, SE2.from_matrix(part.T_session_base[k])
        return None

    def true_pose(self, stamp_ns: int) -> SE2 | None:
        """T_world_base by the true poses; where they are far apart, carried on by the own trajectory."""
        assert self.truth is not None
        stamps_ns = self.truth.stamps_ns
        after = int(np.searchsorted(stamps_ns, stamp_ns - _SAME_NS))
        if after < len(stamps_ns) and abs(int(stamps_ns[after]) - stamp_ns) <= _SAME_NS:
            return SE2.from_matrix(self.truth.T_session_base[after]) @ self.T_sensor_base
        if 0 < after < len(stamps_ns):
            before_ns, after_ns = int(stamps_ns[after - 1]), int(stamps_ns[after])
            if after_ns - before_ns <= _GAP_NS:
                part = (stamp_ns - before_ns) / (after_ns - before_ns)
                before, behind = self.truth.T_session_base[after - 1 : after + 1]
                return SE2.from_matrix(interpolate_pose(before, behind, part)) @ self.T_sensor_base
        return self._carried(stamp_ns)

    def _carried(self, stamp_ns: int) -> SE2 | None:
        assert self.truth is not None
        own = self.own_pose(stamp_ns)
        k = _nearest(self.truth.stamps_ns, stamp_ns)
        if own is None or k is None or abs(int(self.truth.stamps_ns[k]) - stamp_ns) > _CARRIED_NS:
            return None
        there = self.own_pose(int(self.truth.stamps_ns[k]))
        if there is None or there[0] != own[0]:
            return None
        T_world_base = SE2.from_matrix(self.truth.T_session_base[k]) @ self.T_sensor_base
        return T_world_base @ there[1].inverse() @ own[1]


def _nearest(stamps_ns: NDArray[np.int64], stamp_ns: int) -> int | None:
    if not len(stamps_ns):
        return None
    after = min(int(np.searchsorted(stamps_ns, stamp_ns)), len(stamps_ns) - 1)
    before = max(after - 1, 0)
    return before if stamp_ns - int(stamps_ns[before]) < int(stamps_ns[after]) - stamp_ns else after


@dataclass(frozen=True)
class Asked:
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
        self._drives: dict[str, Drive] = {}
        self._grids: dict[str, dict[str, OccupancyGrid]] = {}
        self._windows: dict[Pair, list[Asked]] = {}

    def row(self, pair: Pair) -> PairRow:
        """The row of a pair; what cannot be judged is a row that says why."""
        query, map_ = (self._catalogue.recordings[name] for name in (pair.query, pair.map))
        row: dict[str, Any] = {
            "query": pair.query,
            "map": pair.map_name,
            "kind": pair.kind,
            "building": map_.building,
            "sensors": query.sensor if query.sensor == map_.sensor else f"{query.sensor} in {map_.sensor}",
        }
        try:
            return self._judged(pair, query, map_, row)
        except Exception as error:
            return PairRow(**row, problem=_said(error))

    def _judged(self, pair: Pair, query: Recording, map_: Recording, row: dict[str, Any]) -> PairRow:
        problem = self._problem(pair)
        if problem:
            return PairRow(**row, problem=problem)
        if pair.kind == "elsewhere":
            queries = tuple(_elsewhere(one) for one in self._asked(pair))
            return PairRow(**row, truth="elsewhere", queries=queries)
        truth, asked, frames = self._frames(pair, query, map_)
        grids = self._grids_of(pair.map_name)
        return PairRow(
            **row,
            truth=truth,
            agreeing=sum(len(f.clues) for f in frames.values()) if truth == "agreement" else None,
            queries=tuple(_judged(one, frames, grids) for one in asked),
        )

    def _problem(self, pair: Pair) -> str:
        recordings = [self._catalogue.recordings[name] for name in (pair.query, pair.map)]
        gaps = [recording.file for recording in recordings if self._folder.missing(recording)]
        if gaps:
            return f"{gaps[0]}: {MISSING}"
        done = kept(self._folder.result(pair.map_name))
        if done is None:
            return f"{pair.map_name}: {_NOT_RUN}"
        return f"no map: {done.error}" if done.failed else ""

    def _asked(self, pair: Pair) -> list[Asked]:
        """The windows of a pair with their answers."""
        if pair not in self._windows:
            query = self._catalogue.recordings[pair.query]
            windows = self._catalogue.windows(pair, self._folder.length_s(query))
            self._windows[pair] = [self._one(pair, query, number, span) for number, span in windows]
        return self._windows[pair]

    def _one(self, pair: Pair, query: Recording, number: int, span: TimeSpan) -> Asked:
        done = kept(self._folder.answer(pair, span))
        if done is None or done.failed:
            return Asked(pair.query, number, span, done)
        stamp_ns = int(done.document["query"]["stamp_ns"])
        if pair.kind == "elsewhere":
            return Asked(pair.query, number, span, done)
        if pair.query not in self._drives:
            self._drives[pair.query] = Drive.of(query, self._folder)
        drive = self._drives[pair.query]
        where: tuple[int, SE2] | None
        if drive.truth is None:
            where = drive.own_pose(stamp_ns)
        else:
            true = drive.true_pose(stamp_ns)
            where = None if true is None else (-1, true)
        return Asked(pair.query, number, span, done, where, self._last_hits(query, span, stamp_ns))

    def _last_hits(self, query: Recording, span: TimeSpan, stamp_ns: int) -> F64:
        """(N, 2) walls that the last scan of a window shows, in the axes of the base."""
        from pc2grid.io import open_log
        from pc2grid.pipeline import follow

        config, end_s = _config(query), span.start_s + (span.duration_s or 0.0)
        start_s = max(end_s - _LAST_S, span.start_s)
        with open_log(self._folder.source(query), config.read) as log:
            last = None
            for scan in log.scans(start_s, end_s - start_s):
                last = scan if scan.stamp_ns <= stamp_ns or last is None else last
            assert last is not None  # `scans` raises NoScans
            ((_, planar_scan),) = follow([last], config)
        return np.asarray(planar_scan.hits_m, np.float64)

    def _frames(
        self, pair: Pair, query: Recording, map_: Recording
    ) -> tuple[Truth | None, list[Asked], Frames]:
        """The windows, and how the parts of the drive lie in the sessions of the map: by true poses, else by
        the answers.
        """
        asked = self._asked(pair)
        if query.poses is not None and query.poses == map_.poses:
            return (
                "poses",
                asked,
                {
                    (-1, session): frame
                    for session, trajectory in folder_sessions(self._folder, pair.map_name).items()
                    if (frame := self._true_frame(pair.query, trajectory)) is not None
                },
            )
        shared = self._shared(pair) if map_.sensor == "map" else None
        asked, frames = shared or (asked, _agreed(asked))
        return ("agreement" if frames else None), asked, frames

    def _shared(self, pair: Pair) -> tuple[list[Asked], Frames] | None:
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
                return drives[pair.query], _agreed([one for asked in drives.values() for one in asked])
        return None

    def _in_root(self, pair: Pair, root: str) -> list[Asked] | None:
        """The windows of a pair, in the trajectory of the recording `root`; None if not located there."""
        if pair.query == root:
            return self._asked(pair)
        wanted = (pair.query, root, None)
        link = next((p for p in self._catalogue.pairs if (p.query, p.map, p.until_s) == wanted), None)
        if link is None or self._problem(link):
            return None
        frame = _agreed(self._asked(link)).get((0, _SESSION))
        if frame is None:
            return None
        return [
            replace(one, where=(0, frame.place(one.where[1])[0]) if one.where and one.where[0] == 0 else None)
            for one in self._asked(pair)
        ]

    def _true_frame(self, query: str, trajectory: Trajectory) -> Frame | None:
        """The frame of a session of the map in the world, by its own scans, one on each `_STEP_M`."""
        drive = self._drives.get(query)
        if drive is None:
            return None
        steps = np.unique((trajectory.path_m() / _STEP_M).astype(int), return_index=True)[1]
        clues = [
            Clue(true, SE2.from_matrix(trajectory.T_session_base[k]))
            for k in steps.tolist()
            if (true := drive.true_pose(int(trajectory.stamps_ns[k]))) is not None
        ]
        return Frame(tuple(clues)) if len(clues) >= 2 else None

    def _grids_of(self, name: str) -> dict[str, OccupancyGrid]:
        from signature.database import open_database

        if name not in self._grids:
            with open_database(self._folder.map(name)) as database:
                self._grids[name] = {info.name: database.grid(info.name) for info in database.sessions()}
        return self._grids[name]


def _agreed(asked: Iterable[Asked]) -> Frames:
    """How the parts of drives lie in the sessions of a map, by the best place of every answer."""
    groups: dict[tuple[int, str], list[Clue]] = {}
    for one in asked:
        if one.where is not None and one.places and one.answer is not None:
            session, T_map_base, _ = one.places[0]
            clue = Clue(one.where[1], T_map_base, (one.query, one.window), float(one.answer["confidence"]))
            groups.setdefault((one.where[0], session), []).append(clue)
    found = ((key, agreed_frame(clues)) for key, clues in groups.items())
    return {key: frame for key, frame in found if frame is not None}


def _config(recording: Recording) -> Config:
    """The settings that the commands read a recording with."""
    from pc2grid_cli.options import make_config

    given = dict(zip(recording.options[::2], recording.options[1::2], strict=True))
    return make_config(None, None, topic=given.get("--topic"), odometry=given.get("--odometry"))


def _answered(one: Asked) -> dict[str, Any]:
    """What a row says of an answer before it is judged."""
    row: dict[str, Any] = {"window": one.window, "start_s": one.span.start_s}
    if one.done is None:
        return {**row, "problem": _NOT_RUN}
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


def _elsewhere(one: Asked) -> QueryRow:
    """An answer in the map of another building, where nothing is right."""
    return QueryRow(**_answered(one), right=None if one.answer is None else False, covered=False)


def _judged(one: Asked, frames: Frames, grids: Mapping[str, OccupancyGrid]) -> QueryRow:
    """An answer judged by where the query is in the sessions of the map."""
    row = _answered(one)
    if one.answer is None or one.where is None:
        return QueryRow(**row)
    part, T_drive_base = one.where
    expected = {
        session: frame.place(T_drive_base, without=(one.query, one.window))
        for (of_part, session), frame in frames.items()
        if of_part == part
    }
    if not expected:
        return QueryRow(**row)
    covered = any(
        known_share(grids[session], T_map_base.apply(one.hits_m)) >= JUDGEMENT.mapped
        for session, (T_map_base, _) in expected.items()
    )
    row["covered"] = bool(covered)
    if not one.places:
        return QueryRow(**row, right=False)
    judged = [
        is_right(pose, *expected[session]) if session in expected else None for session, pose, _ in one.places
    ]
    first = judged[0]
    order = [place for place, _ in groupby(place for _, _, place in one.places)]
    of_right = next(
        (place for (_, _, place), j in zip(one.places, judged, strict=True) if j is not None and j[0]), None
    )
    return QueryRow(
        **row,
        right=None if first is None else first[0],
        error_m=None if first is None else first[1],
        rank=None if of_right is None else list(dict.fromkeys(order)).index(of_right),
    )


def known_share(grid: OccupancyGrid, points_m: F64) -> float:
    """Share 0..1 of points (N, 2) in the map frame that have a known cell within `_KNOWN_M`; 0 without."""
    import cv2

    if not len(points_m):
        return 0.0
    reach = round(_KNOWN_M / grid.resolution_m)
    known = cv2.dilate((grid.cells >= 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    cells = grid.to_cell(points_m)
    inside = ((cells >= 0) & (cells < known.shape)).all(axis=1)
    return float(known[tuple(cells[inside].T)].sum() / len(points_m))
