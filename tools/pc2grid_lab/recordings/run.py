"""All recordings become maps and all windows are located: the commands of a run, and what they read.

Nothing is judged here. Recordings are used as they are, with fewer scans, or joined: a robot that is carried
away is two recordings, or two parts of one, as a single recording. The second part follows a second after
the first. Its odometry goes on from where that of the first part ended, because wheels do not turn while a
robot is carried.

Processor time and error of bare KISS-ICP on a recording: `python -m pc2grid_lab.recordings.run LOG [TRUTH]`.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from itertools import chain, islice, permutations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from kiss_icp.config import KISSConfig, load_config
from kiss_icp.kiss_icp import KissICP
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore

from pc2grid.display import plain
from pc2grid.errors import Pc2GridError
from pc2grid.geometry import SE2, pose_from_xyz_quat
from pc2grid.io.atomic import replace_file
from pc2grid.io.recording import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Scan, Trajectory
from pc2grid.observer import TimeSpan
from pc2grid_lab.recordings.catalogue import (
    UNTIL_S,
    Catalogue,
    Pair,
    Recording,
    beginning_of,
    digest_of_drive,
    write_drive,
)
from pc2grid_lab.runner import Finished, Task, in_processes, kept_result, pc2grid, run, run_tasks
from pc2grid_lab.truth import rms, trajectory_errors
from signature.database import open_database
from signature.join.join import JoinableMap, join_maps
from signature.places.map_index import MapIndex

RESULTS = ("maps", "bare", "answers", "followed", "joins")
"""Folders of the results: of `convert`, of bare KISS-ICP, of `relocalize` for each window, of `watch`, and of
comparing two maps."""


@dataclass(frozen=True, slots=True)
class Folder:
    """Where the maps and answers of one run are.

    data : the folder of recordings. work : of everything that is made. Both are absolute, as the commands
        run in another folder.
    """

    data: Path
    work: Path

    def source(self, recording: Recording) -> Path:
        """Return the file that the commands read; if it is thinned, disturbed or driven, `_make` makes it.

        Drives are kept beside the work of all versions: they are made again when they would differ.
        """
        file = self.data / recording.file
        if recording.drive is not None:
            made = f"{as_file_name(recording.name)}.{digest_of_drive(file, recording.drive)}.mcap"
            return self.work.parents[1] / "drives" / made
        if recording.every > 1 or recording.disturbed:
            return self.work / "made" / f"{as_file_name(recording.name)}{file.suffix}"
        return file

    def true(self, recording: Recording, file: str | None) -> Path | None:
        """Return the path of a recording's `truth` or `poses`."""
        if file is None:
            return None
        return self.data / file if recording.drive is None else self.source(recording).with_suffix(".tum")

    def kept(self, kind: str, name: str) -> Path:
        """Return the result of a command. kind : one of `RESULTS`. name : of the map, the pair of maps, or
        the row and its map."""
        return self.work / kind / f"{as_file_name(name)}.json"

    def map(self, name: str) -> Path:
        """Return the database of a map, beside the result of `convert`."""
        return self.kept("maps", name).with_suffix(".submaps")

    def answer(self, pair: Pair, window: TimeSpan) -> Path:
        """Return the result of `relocalize` for a window."""
        asked = f"{pair.query}.in.{pair.map_name}.{window.start_s:.2f}s.{window.duration_s:g}s"
        return self.kept("answers", asked)

    def missing(self, recording: Recording) -> bool:
        """Return whether the data folder lacks the recording, so that it is a gap of the page."""
        return not (self.data / recording.file).exists()

    def gaps(self, catalogue: Catalogue, pair: Pair) -> list[str]:
        """Return the files of a pair that the data folder lacks."""
        recordings = (catalogue.recordings[name] for name in (pair.query, pair.map))
        return [recording.file for recording in recordings if self.missing(recording)]

    def cpu_s(self) -> float:
        """Return the processor time of all commands whose result is here."""
        files = (file for kind in RESULTS for file in (self.work / kind).glob("*.json"))
        return sum(kept_result(file).cpu_s for file in files)

    def length_s(self, recording: Recording) -> float:
        """Return how long a recording lasts. Raises the errors of `open_log`."""
        with open_log(self.source(recording)) as opened:
            return (opened.info.end_ns - opened.info.start_ns) * 1e-9


def as_file_name(name: str) -> str:
    """Return a name as a part of the name of a file."""
    return "".join(c if c.isalnum() or c in "-.+" else "_" for c in name)


KIND = "carried away"
"""How `--only` names these rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Followed:
    """A recording that is followed in the map of another session.

    after : what the robot is carried to; if that is the same recording, from its later half to its earlier
        one. None: it is not carried away. until_s : the first so many seconds of `map` become the map, and
        what comes after them is followed; None: all of it.
    """

    before: str
    map: str
    after: str | None = None
    until_s: float | None = None

    @property
    def name(self) -> str:
        """Return of the row."""
        return self.before if self.after is None else f"{self.before}, {self.after}"

    @property
    def map_name(self) -> str:
        """Return the map, with the part of the recording that it is made from."""
        return beginning_of(self.map, self.until_s)

    @property
    def asked(self) -> str:
        """Return the name of the result."""
        return f"{self.name}.in.{self.map_name}"


def _in(map_: str, *others: str) -> Iterator[Followed]:
    """Yield each of the others as it is, and carried away to each of them."""
    yield from (Followed(before=name, map=map_) for name in others)
    pairs = permutations(others, 2) if len(others) > 1 else [(others[0], others[0])]
    yield from (Followed(before=before, map=map_, after=after) for before, after in pairs)


_DEC13, _DEC13_AFTER, _DEC14 = "kidnap dec13 before", "kidnap dec13 after", "kidnap dec14 before"
_MAY9, _MAY9_AFTER = "kidnap may9 before", "kidnap may9 after"
QUICK = (
    Followed(before=_DEC13_AFTER, map=_DEC13),
    Followed(before=_DEC14, map=_DEC13),
    Followed(before=_DEC14, map=_DEC13, after=_DEC13_AFTER),
)
"""The rows of the quick form."""
FOLLOWED: tuple[Followed, ...] = (
    *_in(_DEC13, _DEC13_AFTER, _DEC14, _MAY9, _MAY9_AFTER),
    *_in(_MAY9, _DEC13, _DEC13_AFTER, _DEC14, _MAY9_AFTER),
    *_in("wean 1", "wean 2", "wean 3"),
    *_in("wean 2", "wean 1", "wean 3"),
    *_in("wean 3", "wean 1", "wean 2"),
    *_in("hallway", "hallway2"),
    *_in("hallway2", "hallway"),
    *_in("workshop_1", "workshop_1_changed"),
    *_in("workshop_1_changed", "workshop_1"),
    *(Followed(before="fr079", map=name) for name in ("fr079 lidar", "fr079 depth", "fr079_floor.ply")),
    *(Followed(before=name, map=name, until_s=UNTIL_S[name]) for name in ("fr079", "intel", "csail")),
)
"""All rows, in the order of the page."""


def followed_in(catalogue: Catalogue, folder: Folder, only: str | None) -> tuple[Followed, ...]:
    """Return the rows of a run whose recordings are there. only : a pattern, see `Catalogue.of`."""

    def there(name: str | None) -> bool:
        return name is None or (
            name in catalogue.recordings and not folder.missing(catalogue.recordings[name])
        )

    return tuple(
        one
        for one in FOLLOWED
        if (one in QUICK or not catalogue.quick)
        and all(map(there, (one.before, one.after, one.map)))
        and any(
            fnmatch(name, only or "*")
            for name in (KIND, one.before, one.map, catalogue.recordings[one.map].building)
        )
    )


def _watched(catalogue: Catalogue, folder: Folder, one: Followed) -> Task:
    """Return the task that watches every scan of a row."""

    def do() -> Finished:
        before = source = folder.source(catalogue.recordings[one.before])
        put_down_ns = shift_ns = None
        made = folder.work / "carried" / f"{as_file_name(one.name)}.mcap"
        made.parent.mkdir(parents=True, exist_ok=True)
        if one.until_s is not None:
            source = made
            write_part(before, one.until_s, made)
        elif one.after is not None:
            source, after = made, folder.source(catalogue.recordings[one.after])
            half_s = 0.5 * folder.length_s(catalogue.recordings[one.before]) if before == after else None
            put_down_ns, shift_ns = write_joined(before, after, made, half_s)
        done = pc2grid("-q", "watch", source, "-d", folder.map(one.map_name), "--json")
        looks = done.document if isinstance(done.document, list) else [done.document]
        document = {"looks": looks, "put_down_ns": put_down_ns, "shift_ns": shift_ns}
        return done if done.failed else replace(done, document=document)

    return Task(folder.kept("followed", one.asked), do)


def run_all(
    catalogue: Catalogue,
    folder: Folder,
    *,
    followed: Sequence[Followed],
    jobs: int,
    advance: Callable[[float], None],
) -> None:
    """Run every command whose result the folder does not hold.

    advance : called with the share of the commands that is done.
    """
    pairs = [p for p in catalogue.pairs if not folder.gaps(catalogue, p)]
    maps = _maps(catalogue, folder, pairs)
    for one in followed:
        maps[one.before] = (catalogue.recordings[one.before], None)
        maps[one.map_name] = (catalogue.recordings[one.map], one.until_s)
    further = [_watched(catalogue, folder, one) for one in followed]
    read = {recording.name: recording for recording, _ in maps.values()}
    read |= {pair.query: catalogue.recordings[pair.query] for pair in pairs}
    waiting = [(folder, one) for one in read.values() if not folder.source(one).exists()]
    in_processes(_make, waiting, jobs=jobs, progress=nullcontext(lambda share: None))
    tasks = [_convert(folder, name, recording, until_s) for name, (recording, until_s) in maps.items()]
    # Bare KISS-ICP knows lidars, and the real ones are there to be compared.
    real = [r for r in catalogue.mapped if r.drive is None and not folder.missing(r)]
    tasks += [_bare(folder, one) for one in real if one.sensor == "lidar"]
    joins = [_joined(folder, *pair) for pair in catalogue.joins]
    count = len(tasks) + sum(pair.windows for pair in pairs) + len(further) + len(joins)
    run_tasks(tasks, jobs, lambda done: advance(done / count))
    questions = [task for pair in pairs for task in _questions(catalogue, folder, pair)] + joins
    run_tasks([*questions, *further], jobs, lambda done: advance((len(tasks) + done) / count))


def _maps(
    catalogue: Catalogue, folder: Folder, pairs: Sequence[Pair]
) -> dict[str, tuple[Recording, float | None]]:
    """Return the maps that are made, by name: of what recording, and of how much of it."""
    maps: dict[str, tuple[Recording, float | None]] = {
        r.name: (r, None) for r in catalogue.mapped if not folder.missing(r)
    }
    for pair in pairs:
        maps[pair.map_name] = (catalogue.recordings[pair.map], pair.until_s)
        query = catalogue.recordings[pair.query]
        if pair.kind != "elsewhere" and query.mapped:  # the trajectory of all of it places its windows
            maps[pair.query] = (query, None)
    return maps


def _make(folder: Folder, recording: Recording) -> None:
    """Make a recording that is thinned, disturbed or driven."""
    file, target = folder.data / recording.file, folder.source(recording)
    target.parent.mkdir(parents=True, exist_ok=True)
    if recording.drive is not None:
        for old in target.parent.glob(f"{as_file_name(recording.name)}.*"):
            old.unlink()
        write_drive(file, target, recording.drive)
    elif recording.every > 1:
        write_thinned(file, target, recording.every)
    elif recording.disturbed:
        write_disturbed(file, target, recording.disturbed)


def _questions(catalogue: Catalogue, folder: Folder, pair: Pair) -> list[Task]:
    """Return a task a window; none where there is no map, or where the recording cannot be opened."""
    query = catalogue.recordings[pair.query]
    if not folder.map(pair.map_name).exists():
        return []
    try:
        windows = catalogue.windows(pair, folder.length_s(query))
    except (Pc2GridError, OSError):
        return []
    asked: tuple[str | Path, ...] = (folder.source(query), "-d", folder.map(pair.map_name), *query.options)

    tasks = []
    for _, window in windows:
        span = ("--start", f"{window.start_s:.3f}", "--duration", f"{window.duration_s:g}", "--json")
        tasks.append(Task(folder.answer(pair, window), partial(pc2grid, "-q", "relocalize", *asked, *span)))
    return tasks


def _convert(folder: Folder, name: str, recording: Recording, until_s: float | None) -> Task:
    database, source = folder.map(name), folder.source(recording)
    part = () if until_s is None else ("--duration", f"{until_s:g}")
    options = (*recording.options, "--name", "map", "--json", "--force", "-o", database, *part)

    def do() -> Finished:
        database.unlink(missing_ok=True)
        return pc2grid("-q", "convert", source, *options)

    size = source.stat().st_size if source.exists() else 0
    return Task(folder.kept("maps", name), do, float(size))


def _bare(folder: Folder, recording: Recording) -> Task:
    truth = folder.true(recording, recording.truth)
    poses = () if truth is None or truth.suffix != ".tum" else (truth,)
    command = (sys.executable, "-m", "pc2grid_lab.recordings.run", folder.source(recording), *poses)
    return Task(folder.kept("bare", recording.name), lambda: run(*command, limit_s=1800.0))


_JOIN = "from pc2grid_lab.recordings.run import print_join; print_join()"


def _joined(folder: Folder, target: str, source: str) -> Task:
    """Return the task that compares two maps."""
    command = (sys.executable, "-c", _JOIN, folder.map(target), folder.map(source))
    return Task(folder.kept("joins", f"{source}.in.{target}"), lambda: run(*command, limit_s=1800.0))


def print_join() -> None:
    """Print how the first session of one database lies in that of another, as one JSON document.

    Both databases are arguments. middle : of the pieces that agree, in the second one.
    """
    with open_database(sys.argv[1]) as target, open_database(sys.argv[2]) as source:
        maps = [MapIndex.of_session(one, one.sessions()[0].name) for one in (target, source)]
        found = join_maps(*map(JoinableMap, maps))
    middle = SE2(*np.mean([link.center_m for link in found.links] or [(0.0, 0.0)], axis=0).tolist())
    told = {
        "status": found.status,
        "probability": found.probability,
        "T_target_source": found.T_target_source,
        "common_m2": found.common_m2,
        "middle": middle,
    }
    print(json.dumps(plain(told)))


_SCANS = ("PointCloud2", "PointCloud", "LaserScan", "Image", "CompressedImage")


class Stored(NamedTuple):
    """A message as it is stored."""

    schema: Schema
    channel: Channel
    log_time_ns: int
    data: bytes


def stored_messages(path: Path) -> Iterator[Stored]:
    """Yield all messages of an MCAP. Raises OSError, and the errors of the `mcap` library."""
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            yield Stored(schema, channel, message.log_time, message.data)


def write_messages(target: Path, messages: Iterable[Stored]) -> None:
    """Write the MCAP file `target`, each topic as one channel."""
    channels: dict[str, int] = {}
    with replace_file(target) as draft, draft.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for schema, channel, time_ns, data in messages:
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                about = (channel.topic, channel.message_encoding, schema_id, channel.metadata)
                channels[channel.topic] = writer.register_channel(*about)
            writer.add_message(channels[channel.topic], time_ns, data, time_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def write_thinned(source: Path, target: Path, every: int) -> None:
    """Write the MCAP file `target` with every nth message of each topic of scans in `source`.

    Raises OSError, and the errors of the `mcap` library.
    """
    counts: Counter[str] = Counter()

    def few() -> Iterator[Stored]:
        for message in stored_messages(source):
            topic, is_scan = message.channel.topic, message.schema.name.split("/")[-1] in _SCANS
            if not is_scan or counts[topic] % every == 0:
                yield message
            counts[topic] += 1

    write_messages(target, few())


_DISTURBED = 1e-5
"""Metres of a coordinate, and share of a focal length: far below what a sensor measures."""


def write_disturbed(source: Path, target: Path, seed: int) -> None:
    """Write the MCAP file `target`: `source` with points that are moved by at most `_DISTURBED`, those of a
    depth image by its focal length.

    What changes with that hangs on the last bit. Raises OSError, and the errors of the `mcap` library.
    """
    draw = np.random.default_rng(seed)

    def moved(message: Stored) -> Stored:
        """Return a message with other numbers, if it has such."""
        if not message.schema.name.endswith(("/CameraInfo", "/PointCloud2")):
            return message
        content = _decoded(message)
        if message.schema.name.endswith("/CameraInfo"):
            focal = 1.0 + draw.uniform(-_DISTURBED, _DISTURBED)
            content.k, content.p = (np.append(m[0] * focal, m[1:]) for m in (content.k, content.p))
        else:
            points = content.data.copy().view(np.float32).reshape(-1, content.point_step // 4)
            points[:, :3] += draw.uniform(-_DISTURBED, _DISTURBED, (len(points), 3))
            content.data = points.view(np.uint8).ravel()
        return message._replace(data=bytes(_TYPES.serialize_cdr(content, message.schema.name)))

    write_messages(target, map(moved, stored_messages(source)))


_CARRIED_NS = 1_000_000_000
"""Time without scans while the robot is carried; chosen by hand, short: a longer one is easier to notice."""
_TYPES = get_typestore(Stores.ROS2_HUMBLE)
_STATIC = "/tf_static"


def write_part(source: Path, begin_s: float, target: Path) -> None:
    """Write the MCAP file `target`: scans and odometry of a recording from `begin_s` on, and its
    static transforms.

    begin_s : seconds after its first scan. Raises OSError, and the errors of `mcap` and `rosbags`.
    """
    messages = _messages(source, begin_s)
    write_messages(target, chain(_static(source, messages[0].log_time_ns), messages))


def write_joined(before: Path, after: Path, target: Path, half_s: float | None = None) -> tuple[int, int]:
    """Write the MCAP file `target`: the scans and odometry of `before`, then those of `after`.

    half_s : only what comes after that in `before`, and what comes before it in `after`. Moving transforms
    are left out, as they may hold the odometry; static ones are those of `before`.
    Returns, in nanoseconds of the recording, the first scan after the robot was carried, and by how much the
    stamps of the second part are later than in its own recording.
    Raises OSError, and the errors of `mcap` and `rosbags`.
    """
    first, second = _messages(before, half_s or 0.0), _messages(after, end_s=half_s)
    shift_ns = first[-1].log_time_ns + _CARRIED_NS - second[0].log_time_ns
    last, next_ = (next(filter(_is_odometry, some), None) for some in (first[::-1], second))
    T = None if last is None or next_ is None else _pose_of(last) @ _pose_of(next_).inverse()
    moved = (_moved(message, shift_ns, T) for message in second)
    write_messages(target, chain(_static(before, first[0].log_time_ns), first, moved))
    return second[0].log_time_ns + shift_ns, shift_ns


def _static(source: Path, time_ns: int) -> Iterator[Stored]:
    """Yield the static transforms of a recording, as if stored at a time."""
    for message in stored_messages(source):
        if message.channel.topic == _STATIC:
            yield message._replace(log_time_ns=time_ns)


def _messages(source: Path, begin_s: float = 0.0, end_s: float | None = None) -> list[Stored]:
    """Return scans and odometry of a part of a recording, from its first scan to its last one.

    begin_s, end_s : seconds after the first scan of the recording; end_s None: to its last scan.
    """
    found = [m for m in stored_messages(source) if m.schema.name.endswith(("/LaserScan", "/Odometry"))]
    scans_ns = [m.log_time_ns for m in found if not _is_odometry(m)]
    begin_ns = scans_ns[0] + round(begin_s * 1e9)
    end_ns = scans_ns[-1] if end_s is None else scans_ns[0] + round(end_s * 1e9)
    wanted_ns = [time_ns for time_ns in scans_ns if begin_ns <= time_ns <= end_ns]
    return [m for m in found if wanted_ns[0] <= m.log_time_ns <= wanted_ns[-1]]


def _moved(message: Stored, shift_ns: int, T: SE2 | None) -> Stored:
    """Return a message at another time; an odometry at the pose that `T` moves it to."""
    content = _decoded(message)
    stamp = content.header.stamp
    stamp.sec, stamp.nanosec = divmod(stamp.sec * 10**9 + stamp.nanosec + shift_ns, 10**9)
    if T is not None and _is_odometry(message):
        place, to = T @ _pose_of(message), content.pose.pose
        to.position.x, to.position.y = place.x, place.y
        to.orientation.x, to.orientation.y = 0.0, 0.0
        to.orientation.z, to.orientation.w = math.sin(place.yaw / 2), math.cos(place.yaw / 2)
    data = bytes(_TYPES.serialize_cdr(content, message.schema.name))
    return message._replace(log_time_ns=message.log_time_ns + shift_ns, data=data)


def _decoded(message: Stored) -> Any:
    return _TYPES.deserialize_cdr(message.data, message.schema.name)


def _pose_of(odometry: Stored) -> SE2:
    pose = _decoded(odometry).pose.pose
    p, q = pose.position, pose.orientation
    return SE2.from_matrix(pose_from_xyz_quat((p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))


def _is_odometry(message: Stored) -> bool:
    return message.schema.name.endswith("/Odometry")


VOXELS_PER_RANGE = 40.0
"""The 75th percentile of the ranges over the voxel: 0.3 m in rooms and halls. Chosen by hand."""
_WALK_MPS, _WALK_MOST_M = 1.0, 0.5
"""A voxel is the way between two scans at least, as partners of points are found no farther; by hand."""


def indoors(first: Scan, second: Scan) -> tuple[float, float]:
    """Return the voxel and the range, metres, with which KISS-ICP maps the surroundings of the first two
    scans.

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
        own_config: Any = load_config(None)
        config.registration.max_num_threads = own_config.registration.max_num_threads = 1
        kiss, own = KissICP(config), KissICP(own_config)
        stamps, poses, cpu_s = [], [], 0.0
        for scan in opened.scans():
            points_m = np.asarray(scan.points_m, np.float64)
            begin = time.process_time()
            kiss.register_frame(points_m, np.empty(0))
            cpu_s += time.process_time() - begin
            # It deskews to the time of the last point.
            offsets_s = np.asarray(() if scan.offsets_s is None else scan.offsets_s, np.float64)
            stamps.append(scan.stamp_ns + round(float(offsets_s.max(initial=0.0)) * 1e9))
            if truth is not None and len(points_m):
                own.register_frame(points_m, offsets_s)
            poses.append(np.array(own.last_pose, np.float64))
    ate_m = None
    if truth is not None:
        trajectory = Trajectory(stamps_ns=np.array(stamps, np.int64), T_session_base=np.array(poses))
        errors_m = trajectory_errors(trajectory, read_tum(Path(truth)))
        ate_m = rms(errors_m) if len(errors_m) else None
    print(json.dumps({"scans": len(stamps), "cpu_s": cpu_s, "ate_m": ate_m}))


if __name__ == "__main__":
    main()
