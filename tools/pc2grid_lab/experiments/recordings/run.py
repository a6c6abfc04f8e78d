"""All recordings become maps and all windows are located: the results of the commands, in a folder.

Nothing is judged here. A command that fails is a result like any other, and a result that the folder holds
already is not computed again.

Commands of pc2grid as processes of their own, as a user runs them, with their processor time.

Processor time and error of bare KISS-ICP on a recording: `python -m ...bare_kiss LOG [TRUTH.tum]`.

An MCAP made of messages of other ones, as they are stored; and one with fewer scans.

A recording as it was driven: its own trajectories, true poses, and what its scans are read with.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer

from pc2grid.errors import Pc2GridError
from pc2grid.estimation.registration import BareKissIcp
from pc2grid.geometry import F64, SE2, invert_pose, leveling
from pc2grid.io import open_log
from pc2grid.io.atomic import replace_file
from pc2grid.io.trajectory import read_tum
from pc2grid.model import OccupancyGrid, Scan, Trajectory
from pc2grid.observer import TimeSpan
from pc2grid.pipeline import follow
from pc2grid_cli.options import make_config
from pc2grid_lab.experiments.program import ROOT, in_processes, run_in, write_text
from pc2grid_lab.experiments.recordings.catalogue import (
    Catalogue,
    Pair,
    Recording,
    digest_of_drive,
    write_drive,
)
from pc2grid_lab.experiments.truth import AHEAD_M, SAME_NS, fit_frame, nearest, pose_at, trajectory_error
from signature.config import Config
from signature.database import open_database

_CLI = "from pc2grid_cli.main import main; main()"
_ANSWERED = (0, 3, 4)
"""Exit codes of a command that did its work: done, with loss of data, without a confident answer."""
_STOPPED = (130, 143)
"""Exit codes of a command that was interrupted or asked to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What became of one command.

    code : its exit code, negative if a signal ended it. cpu_s : processor time, user and system, of all its
        processes.
    document : the JSON document on its standard output; None if there is none. error : the last line of its
        standard error, if it did not do its work.
    """

    code: int
    cpu_s: float
    document: Any
    error: str = ""

    @property
    def stopped(self) -> bool:
        """Whether somebody stopped it, so that nothing is known of what it would have done."""
        return self.code in _STOPPED

    @property
    def failed(self) -> bool:
        """Whether there is no result."""
        return self.code not in _ANSWERED or self.document is None


def pc2grid(*arguments: str | Path, limit_s: float = 1800.0) -> Finished:
    """Run `pc2grid` with these arguments; after `limit_s` of elapsed time it is stopped."""
    return run((sys.executable, "-c", _CLI, *map(str, arguments)), limit_s=limit_s)


def python_module(name: str, *arguments: str | Path, limit_s: float = 1800.0) -> Finished:
    """Run a module of this laboratory in a process of its own."""
    return run((sys.executable, "-m", name, *map(str, arguments)), limit_s=limit_s)


def run(command: Sequence[str], *, limit_s: float = math.inf) -> Finished:
    """Run a command that prints a JSON document; its paths are absolute."""
    # Byte code is kept, as it is where pc2grid is installed.
    environment = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tools"))),
    }
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        # `python -c` imports from the current folder first.
        child = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment
        )
        try:
            used = _wait(child, time.monotonic() + limit_s)
        except BaseException:
            child.kill()
            child.wait()
            raise
        out.seek(0)
        err.seek(0)
        document, complaint = _parsed(out.read()), err.read().decode(errors="replace")
    finished = Finished(
        code=child.returncode,
        cpu_s=used.ru_utime + used.ru_stime,
        document=document,
    )
    return replace(finished, error=_error(finished.code, complaint)) if finished.failed else finished


def _wait(child: subprocess.Popen[bytes], end_s: float) -> resource.struct_rusage:
    """Wait for a process, and end it after `end_s` of the monotonic clock; what it has used."""
    # `wait4` alone tells the time of this child, and not of all that ended so far.
    while True:
        pid, status, used = os.wait4(child.pid, os.WNOHANG)
        if pid:
            child.returncode = os.waitstatus_to_exitcode(status)
            return used
        if time.monotonic() > end_s:
            child.kill()
        time.sleep(0.02)


def _parsed(text: bytes) -> Any:
    """A JSON document, or several of them, one a line, as a list; None if it is neither."""
    for parse in (json.loads, lambda lines: [json.loads(line) for line in lines.splitlines()] or None):
        with contextlib.suppress(ValueError):
            return parse(text)
    return None


def _error(code: int, complaint: str) -> str:
    """Why a command failed: the error that it names, or the last that it said."""
    lines = [line for line in complaint.splitlines() if line.strip()] or ["nothing was printed"]
    said = next((line for line in lines if "error:" in line), lines[-1])
    return f"ended by signal {-code}" if code < 0 else said


def kept(file: Path) -> Finished | None:
    """What `keep` wrote to a file; None if it is not there."""
    return Finished(**json.loads(file.read_text())) if file.exists() else None


def keep(file: Path, finished: Finished) -> None:
    """Write a result to a file, completely or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, json.dumps(asdict(finished)))


_RESULTS = ("maps", "bare", "answers", "followed")
"""Folders of results."""
_BARE = "pc2grid_lab.experiments.recordings.run"


@dataclass(frozen=True, slots=True)
class Folder:
    """Where the maps and answers of one run are.

    data : the folder of recordings. work : of everything that is made. Both are absolute, as the commands
        run in another folder.
    """

    data: Path
    work: Path

    def source(self, recording: Recording) -> Path:
        """The file that the commands read; if it is thinned or driven, `_make` makes it.

        Drives are kept beside the work of all versions: they are made again when they would differ.
        """
        file = self.data / recording.file
        if recording.drive is not None:
            made = f"{plain(recording.name)}.{digest_of_drive(file, recording.drive)}.mcap"
            return self.work.parents[1] / "drives" / made
        if recording.every > 1:
            return self.work / "thinned" / f"{file.stem}_{recording.every}{file.suffix}"
        return file

    def truth(self, recording: Recording) -> Path | None:
        """The file of `Recording.truth`."""
        return self._true(recording, recording.truth)

    def poses(self, recording: Recording) -> Path | None:
        """The file of `Recording.poses`."""
        return self._true(recording, recording.poses)

    def _true(self, recording: Recording, file: str | None) -> Path | None:
        if file is None:
            return None
        return self.data / file if recording.drive is None else self.source(recording).with_suffix(".tum")

    def map(self, name: str) -> Path:
        """The database of a map, beside the result of `convert`."""
        return self.work / "maps" / f"{plain(name)}.submaps"

    def result(self, name: str) -> Path:
        """The result of `convert` for a map."""
        return self.map(name).with_suffix(".json")

    def bare(self, name: str) -> Path:
        """The result of bare KISS-ICP."""
        return self.work / "bare" / f"{plain(name)}.json"

    def has_bare(self, recording: Recording) -> bool:
        """Whether bare KISS-ICP is asked: it knows lidars, and real ones are there to be compared."""
        return recording.sensor == "lidar" and recording.drive is None and not self.missing(recording)

    def answer(self, pair: Pair, window: TimeSpan) -> Path:
        """The result of `relocalize` for a window."""
        named = f"{plain(pair.query)}.in.{plain(pair.map_name)}"
        return self.work / "answers" / f"{named}.{window.start_s:.2f}s.{window.duration_s:g}s.json"

    def missing(self, recording: Recording) -> bool:
        """Whether the data folder lacks the recording, so that it is a gap of the page."""
        return not (self.data / recording.file).exists()

    def gaps(self, catalogue: Catalogue, pair: Pair) -> list[str]:
        """The files of a pair that the data folder lacks."""
        recordings = (catalogue.recordings[name] for name in (pair.query, pair.map))
        return [recording.file for recording in recordings if self.missing(recording)]

    def cpu_s(self) -> float:
        """Processor time of all commands whose result is here."""
        results = (kept(file) for kind in _RESULTS for file in (self.work / kind).glob("*.json"))
        return sum(done.cpu_s for done in results if done is not None)

    def length_s(self, recording: Recording) -> float:
        """How long a recording lasts. Raises the errors of `open_log`."""
        with open_log(self.source(recording)) as opened:
            return (opened.info.end_ns - opened.info.start_ns) * 1e-9


def plain(name: str) -> str:
    """A name as a part of the name of a file."""
    return "".join(c if c.isalnum() or c in "-.+" else "_" for c in name)


@dataclass(frozen=True, slots=True)
class Task:
    """One command: where its result is kept, what is done, and a guess of its time that orders the tasks."""

    file: Path
    do: Callable[[], Finished]
    weight: float


def run_all(
    catalogue: Catalogue,
    folder: Folder,
    *,
    mapped: Collection[str],
    further: Sequence[Task],
    jobs: int,
    advance: Callable[[float], None],
) -> None:
    """Run every command whose result the folder does not hold.

    further : commands beside those of the catalogue, in the maps of the recordings `mapped`. advance : called
        with the share of the commands that is done.
    """
    pairs = [p for p in catalogue.pairs if not folder.gaps(catalogue, p)]
    maps = _maps(catalogue, folder, pairs)
    maps |= {name: (catalogue.recordings[name], None) for name in mapped}
    read = {recording.name: recording for recording, _ in maps.values()}
    read |= {pair.query: catalogue.recordings[pair.query] for pair in pairs}
    waiting = [(folder, one) for one in read.values() if not folder.source(one).exists()]
    in_processes(_make, waiting, jobs=jobs, advance=lambda share: None)
    tasks = [_convert(folder, name, recording, until_s) for name, (recording, until_s) in maps.items()]
    tasks += [_bare(folder, one) for one in catalogue.mapped if folder.has_bare(one)]
    count = len(tasks) + sum(pair.windows for pair in pairs) + len(further)
    _run(tasks, jobs, lambda done: advance(done / count))
    questions = [task for pair in pairs for task in _questions(catalogue, folder, pair)]
    _run([*questions, *further], jobs, lambda done: advance((len(tasks) + done) / count))


def _maps(
    catalogue: Catalogue, folder: Folder, pairs: Sequence[Pair]
) -> dict[str, tuple[Recording, float | None]]:
    """The maps that are made, by name: of what recording, and of how much of it."""
    maps: dict[str, tuple[Recording, float | None]] = {}
    maps |= {r.name: (r, None) for r in catalogue.mapped if not folder.missing(r)}
    for pair in pairs:
        maps[pair.map_name] = (catalogue.recordings[pair.map], pair.until_s)
        query = catalogue.recordings[pair.query]
        if pair.kind != "elsewhere" and query.mapped:  # the trajectory of all of it places its windows
            maps[pair.query] = (query, None)
    return maps


def _make(folder: Folder, recording: Recording) -> None:
    """Make a recording that is thinned or driven."""
    file, target = folder.data / recording.file, folder.source(recording)
    if recording.drive is not None:
        for old in target.parent.glob(f"{plain(recording.name)}.*"):
            old.unlink()
        write_drive(file, target, recording.drive)
    elif recording.every > 1:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_thinned(file, target, recording.every)


def _questions(catalogue: Catalogue, folder: Folder, pair: Pair) -> list[Task]:
    """A task a window; none where there is no map, or where the recording cannot be opened."""
    query = catalogue.recordings[pair.query]
    if not folder.map(pair.map_name).exists():
        return []
    try:
        windows = catalogue.windows(pair, folder.length_s(query))
    except (Pc2GridError, OSError):
        return []
    return [_locate(folder, query, pair, window) for _, window in windows]


def _run(tasks: Sequence[Task], jobs: int, advance: Callable[[float], None]) -> None:
    """Do the tasks whose result is not there, the longest first. advance : called with how many are done."""
    waiting = sorted((task for task in tasks if kept(task.file) is None), key=lambda task: -task.weight)
    there = len(tasks) - len(waiting)
    run_in(
        ThreadPoolExecutor(jobs),
        _do,
        [(task,) for task in waiting],
        lambda share: advance(there + share * len(waiting)),
    )


def _do(task: Task) -> None:
    done = task.do()
    if not done.stopped:  # else the next run does it
        keep(task.file, done)


def _convert(folder: Folder, name: str, recording: Recording, until_s: float | None) -> Task:
    database, source = folder.map(name), folder.source(recording)
    options = [*recording.options, "--name", "map", "--json", "--force", "-o", str(database)]
    if until_s is not None:
        options += ["--duration", f"{until_s:g}"]

    def do() -> Finished:
        database.parent.mkdir(parents=True, exist_ok=True)
        database.unlink(missing_ok=True)
        return pc2grid("-q", "convert", source, *options)

    size = source.stat().st_size if source.exists() else 0
    return Task(folder.result(name), do, float(size))


def _bare(folder: Folder, recording: Recording) -> Task:
    truth = folder.truth(recording)
    poses = () if truth is None or truth.suffix != ".tum" else (truth,)
    return Task(
        folder.bare(recording.name), lambda: python_module(_BARE, folder.source(recording), *poses), 0.0
    )


def _locate(folder: Folder, recording: Recording, pair: Pair, window: TimeSpan) -> Task:
    span = ("--start", f"{window.start_s:.3f}", "--duration", f"{window.duration_s:g}")
    options = (*recording.options, *span)
    where = (folder.source(recording), "-d", folder.map(pair.map_name))
    return Task(
        folder.answer(pair, window), lambda: pc2grid("-q", "relocalize", *where, *options, "--json"), 0.0
    )


VOXELS_PER_RANGE = 40.0
"""The 75th percentile of the ranges over the voxel: 0.3 m in rooms and halls. Chosen by hand."""
_WALK_MPS, _WALK_MOST_M = 1.0, 0.5
"""A voxel is the way between two scans at least, as partners of points are found no farther; by hand."""


def indoors(first: Scan, second: Scan) -> tuple[float, float]:
    """The voxel and the range, metres, with which KISS-ICP maps the surroundings of the first two scans.

    Its own, 1 m and 100 m, are for streets: with these it is ten times faster, and makes no map of a room.
    """
    ranges_m = np.linalg.norm(first.points_m, axis=1)
    walked_m = min(_WALK_MPS * (second.stamp_ns - first.stamp_ns) * 1e-9, _WALK_MOST_M)
    voxel_m = np.clip(max(np.percentile(ranges_m, 75) / VOXELS_PER_RANGE, walked_m), 0.3, 1.0)
    return float(voxel_m), float(np.clip(1.5 * np.percentile(ranges_m, 98), 10.0, 100.0))


def main() -> None:
    """Print one JSON document: scans, cpu_s, and ate_m or null.

    cpu_s is the processor time of `register_frame` alone, over all points of each scan, with a voxel and a
    range for indoors. ate_m is the error with KISS-ICP's own settings.
    """
    log, truth = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    with open_log(log) as opened:
        config: Any = KISSConfig()
        config.mapping.voxel_size, config.data.max_range = indoors(*islice(opened.scans(), 2))
        config.data.deskew = False
        config.registration.max_num_threads = 1
        kiss, own = KissICP(config), BareKissIcp()
        stamps, poses, cpu_s = [], [], 0.0
        for scan in opened.scans():
            points_m = np.asarray(scan.points_m, np.float64)
            begin = time.process_time()
            kiss.register_frame(points_m, np.empty(0))
            cpu_s += time.process_time() - begin
            last_s = 0.0 if scan.offsets_s is None or not len(scan.offsets_s) else float(scan.offsets_s.max())
            stamps.append(scan.stamp_ns + round(last_s * 1e9))
            if truth is not None:
                poses.append(own.register(scan))
    ate_m = None
    if truth is not None:
        trajectory = Trajectory(stamps_ns=np.array(stamps, np.int64), T_session_base=np.array(poses))
        error = trajectory_error(trajectory, read_tum(Path(truth)))
        ate_m = None if error is None else error.ate_m
    print(json.dumps({"scans": len(stamps), "cpu_s": cpu_s, "ate_m": ate_m}))


if __name__ == "__main__":
    main()


_SCANS = ("PointCloud2", "PointCloud", "LaserScan", "Image", "CompressedImage")


class Stored(NamedTuple):
    """A message as it is stored."""

    schema: Schema
    channel: Channel
    log_time_ns: int
    data: bytes


def stored_messages(path: Path) -> Iterator[Stored]:
    """All messages of an MCAP. Raises OSError, and the errors of the `mcap` library."""
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield Stored(schema, channel, message.log_time, message.data)


class McapCopy:
    """Writes messages to an MCAP, each topic as one channel."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}

    def add(self, message: Stored) -> None:
        """Write a message."""
        schema, channel = message.schema, message.channel
        if channel.topic not in self._channels:
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[channel.topic] = self._writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        time_ns = message.log_time_ns
        self._writer.add_message(self._channels[channel.topic], time_ns, message.data, time_ns)


@contextmanager
def mcap_copy(target: Path) -> Iterator[McapCopy]:
    """The MCAP file `target`, which is there when the body ends."""
    with replace_file(target) as draft, draft.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        yield McapCopy(writer)
        writer.finish()  # type: ignore[no-untyped-call]


def write_thinned(source: Path, target: Path, every: int) -> None:
    """Write the MCAP file `target` with every nth message of each topic of scans in `source`.

    Raises OSError, and the errors of the `mcap` library.
    """
    counts: Counter[str] = Counter()
    with mcap_copy(target) as copy:
        for message in stored_messages(source):
            topic, is_scan = message.channel.topic, message.schema.name.split("/")[-1] in _SCANS
            if not is_scan or counts[topic] % every == 0:
                copy.add(message)
            counts[topic] += 1


_GAP_NS = 200_000_000
"""True poses farther apart are not interpolated, as a robot turns between them."""
_CARRIED_NS = 5_000_000_000
"""The own trajectory is laid on the true poses of so long before and after."""
_BEFORE_S = 2.0
"""A scan is looked for from so long before its stamp on."""
_KNOWN_M = 0.2
"""A wall hit lies on known ground if the map knows a cell this near: noise puts hits behind the wall."""


def sessions(folder: Folder, name: str) -> dict[str, Trajectory]:
    """The trajectories of the sessions of a map, empty if there is none."""
    if not folder.map(name).exists():
        return {}
    with open_database(folder.map(name)) as database:
        return {info.name: database.trajectory(info.name) for info in database.sessions()}


def mount(folder: Folder, recording: Recording) -> F64:
    """T_base_sensor (4, 4) of a recording's first scan."""
    with open_log(folder.source(recording), config_of(recording).read) as log:
        return next(iter(log.scans())).T_base_sensor


@dataclass(frozen=True)
class RecordedDrive:
    """A recording as it was driven: its own trajectories, and true poses if there are any.

    parts : the sessions of the map of the whole recording; none for a map that is no recording.
    truth : poses of the base in the world, whose z is up; None without. late_ns : see `Recording.late_s`.
    """

    parts: tuple[Trajectory, ...]
    truth: Trajectory | None
    late_ns: int = 0

    def own_pose(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """The part and T_part_base of the scan with that stamp; None if no part has it."""
        for number, part in enumerate(self.parts):
            (k,) = nearest(part.stamps_ns, np.array([stamp_ns]))
            if k >= 0:
                return number, SE2.from_matrix(part.T_session_base[k])
        return None

    def where(self, stamp_ns: int) -> tuple[int, SE2] | None:
        """The same; of a recording with true poses the part is -1, and the pose the true one."""
        if self.truth is None:
            return self.own_pose(stamp_ns)
        true = self.true_pose(stamp_ns)
        return None if true is None else (-1, true)

    def true_pose(self, stamp_ns: int) -> SE2 | None:
        """T_world_base by the true poses; where they are far apart, carried on by the own trajectory."""
        assert self.truth is not None
        T = pose_at(self.truth, stamp_ns - self.late_ns, same_ns=SAME_NS, gap_ns=_GAP_NS)
        return self._carried(stamp_ns - self.late_ns) if T is None else SE2.from_matrix(T)

    def _carried(self, stamp_ns: int) -> SE2 | None:
        """The own trajectory around a stamp, laid on the true poses there."""
        assert self.truth is not None
        own = self.own_pose(stamp_ns + self.late_ns)
        near = np.flatnonzero(np.abs(self.truth.stamps_ns - stamp_ns) <= _CARRIED_NS)
        if own is None or not len(near):
            return None
        pairs = [
            (there[1], SE2.from_matrix(self.truth.T_session_base[k]))
            for k in near.tolist()
            if (there := self.own_pose(int(self.truth.stamps_ns[k]) + self.late_ns)) is not None
            and there[0] == own[0]
        ]
        if not pairs:
            return None
        return fit_frame(pairs, AHEAD_M) @ own[1]


@cache
def drive_of(recording: Recording, folder: Folder) -> RecordedDrive:
    """The drive of a recording whose whole map is in the folder."""
    parts = tuple(sessions(folder, recording.name).values())
    late_ns = round(recording.late_s * 1e9)
    poses = folder.poses(recording)
    if poses is None:
        return RecordedDrive(parts, None, late_ns)
    truth = read_tum(poses)
    if not recording.of_base:
        T_sensor_base = invert_pose(mount(folder, recording))
        truth = replace(truth, T_session_base=truth.T_session_base @ T_sensor_base)
    return RecordedDrive(parts, levelled(truth, parts, late_ns), late_ns)


@cache
def grids(folder: Folder, name: str) -> dict[str, OccupancyGrid]:
    """The sessions of a map by name."""
    with open_database(folder.map(name)) as database:
        return {info.name: database.grid(info.name) for info in database.sessions()}


def levelled(truth: Trajectory, parts: Sequence[Trajectory], late_ns: int = 0) -> Trajectory:
    """True poses of the base, turned so that z of the world is up.

    The world of a camera's poses may lie as its first image does. Which way is up in it is told by the own
    trajectories, which are levelled; without scans that have a true pose it stays as it is.
    """
    up = np.zeros(3)
    for part in parts:
        at = np.searchsorted(part.stamps_ns, truth.stamps_ns + late_ns).clip(max=len(part) - 1)
        same = np.abs(part.stamps_ns[at] - truth.stamps_ns - late_ns) <= SAME_NS
        # The third row of a rotation is the vertical of its frame, as the base sees it.
        vertical = part.T_session_base[at[same], 2, :3, None]
        up += (truth.T_session_base[same, :3, :3] @ vertical).sum(axis=(0, 2))
    if not up.any():
        return truth
    return replace(truth, T_session_base=leveling(up / np.linalg.norm(up)) @ truth.T_session_base)


def config_of(recording: Recording) -> Config:
    """The settings that the commands read a recording with."""
    given = dict(zip(recording.options[::2], recording.options[1::2], strict=True))
    return make_config(None, None, topic=given.get("--topic"), odometry=given.get("--odometry"))


def hits_at(folder: Folder, recording: Recording, stamp_ns: int) -> F64:
    """(N, 2) walls that the scan with that stamp shows, in the axes of the base."""
    config = config_of(recording)
    with open_log(folder.source(recording), config.read) as log:
        start_s = max((stamp_ns - log.info.start_ns) * 1e-9 - _BEFORE_S, 0.0)
        last = None
        for scan in log.scans(start_s, 2.0 * _BEFORE_S):
            if last is not None and scan.stamp_ns > stamp_ns:
                break
            last = scan
        assert last is not None  # `scans` raises NoScans
        ((_, planar_scan),) = follow([last], config)
    return np.asarray(planar_scan.hits_m, np.float64)


def known_share(grid: OccupancyGrid, points_m: F64) -> float:
    """Share 0..1 of points (N, 2) in the map frame that have a known cell within `_KNOWN_M`; 0 without."""
    if not len(points_m):
        return 0.0
    reach = round(_KNOWN_M / grid.resolution_m)
    known = cv2.dilate((grid.cells >= 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    cells = grid.to_cell(points_m)
    inside = ((cells >= 0) & (cells < known.shape)).all(axis=1)
    return float(known[tuple(cells[inside].T)].sum() / len(points_m))
