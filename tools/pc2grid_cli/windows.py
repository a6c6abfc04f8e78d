"""Several queries at once: recordings, or windows along them, each with a line of its own.

What `watch` follows: a robot, or a finished recording, of which every scan is used.
"""

from __future__ import annotations

import contextlib
import csv
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pc2grid.display import probability
from pc2grid.errors import ConfigError, LogError, TrackingLost, one_line
from pc2grid.io import open_log
from pc2grid.io.atomic import replace_file
from pc2grid.io.live.feed import FeedCounts, News
from pc2grid.io.live.live_log import LiveLog, is_robot, open_live
from pc2grid.io.map_pose import BelievedPose
from pc2grid.io.trajectory import stamp_text, write_trajectory
from pc2grid.mapping.drawn import is_drawn_map
from pc2grid.model import Trajectory
from pc2grid.observer import Observer, TimeSpan
from pc2grid.pipeline import follow
from pc2grid_cli import console
from pc2grid_cli.known_pose import KnownPose, in_map
from signature.localization.answer_json import TypedDict
from signature.localization.map_index import MapIndex
from signature.localization.shown.page import Found
from signature.sessions import find, query_config

if TYPE_CHECKING:
    from pc2grid.geometry import F64
    from pc2grid.io import Log
    from pc2grid.io.map_pose import MapPose
    from pc2grid.io.source import Choice, RawMessage
    from pc2grid.model import ReadReport, RegisteredScan, Scan
    from pc2grid.settings import ReadConfig
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer
    from signature.localization.localizer import Follower


_COLUMNS = (
    "recording", "start_s", "time_s", "status", "session", "frame", "x_m", "y_m", "yaw_rad", "confidence",
    "sigma_x_m", "sigma_y_m", "sigma_yaw_rad",
)  # fmt: skip
"""Of --csv. start_s: of the query, after the start of its recording. time_s: of its last scan, as in TUM."""
_DIGITS = 6
"""Of numbers in --csv: micrometres."""


@dataclass(frozen=True, slots=True)
class Window:
    """A query: a part of a recording, or a map."""

    path: Path
    span: TimeSpan

    def __str__(self) -> str:
        return one_line(f"{self.path.name} from {self.span.start_s:g} s")


def windows_of(
    paths: Sequence[Path], every_s: float | None, span: TimeSpan, config: Config, *, recover: bool
) -> list[Window]:
    """The queries: of each path one, or one every `every_s` seconds, from the start of `span` on.

    A window is as long as `span`, by default `every_s`. It ends within its recording, unless it is the first.

    Raises ConfigError for a map with `every_s`, and the errors of `open_log`.
    """
    if every_s is None:
        return [Window(path, span) for path in paths]
    length_s = span.duration_s or every_s
    windows = []
    for path in paths:
        if is_drawn_map(path):
            raise ConfigError(f"--every: {path} is a map, and no time passes in it", hint="leave it out")
        with open_log(path, config.read, recover=recover) as log:
            left_s = (log.info.end_ns - log.info.start_ns) * 1e-9 - span.start_s - length_s
        starts_s = span.start_s + every_s * np.arange(max(math.floor(left_s / every_s), 0) + 1)
        windows += [Window(path, TimeSpan(float(start_s), length_s)) for start_s in starts_s]
    return windows


class _Part(Observer):
    """The news of one query of several: its progress is a part of that of all."""

    def __init__(self, all_: Observer, done: int, count: int) -> None:
        self._all, self._done, self._count = all_, done, count
        self.on_note, self.on_warning = all_.on_note, all_.on_warning  # type: ignore[method-assign]

    def on_progress(self, share: float) -> None:
        """Moves the bar of all."""
        self._all.on_progress((self._done + share) / self._count)


def find_all(
    windows: Sequence[Window],
    database: SubmapDatabase,
    config: Config,
    known: KnownPose,
    *,
    recover: bool,
    observer: Observer,
) -> Generator[tuple[Window, Found | None]]:
    """Locate each query, by one index of the database. One that cannot be read is warned of, and is None."""
    index = MapIndex.of(database, query_config(database, config), observer)
    with observer.step(f"locate {len(windows)} queries"):
        for number, window in enumerate(windows):
            found = None
            try:
                found = find(
                    window.path,
                    database,
                    config,
                    span=window.span,
                    recover=recover,
                    observer=_Part(observer, number, len(windows)),
                    prior=known.prior,
                    index=index,
                )
            except LogError as error:
                console.warn(f"{window}: {error.message}")
            observer.on_progress((number + 1) / len(windows))
            yield window, found


def show(answers: Sequence[tuple[Window, Answer | None]]) -> None:
    """Print a table with a line for each query."""
    from pc2grid_cli import output as tables

    counts = Counter("failed" if answer is None else answer.status for _, answer in answers)
    title = ", ".join(f"{number} {status.replace('_', ' ')}" for status, number in counts.most_common())
    texts = ("recording", "answer", "in")
    numbers = ("from, s", "x, m", "y, m", "yaw, deg", "confidence", "travel, m")
    table = tables.table(f"{len(answers)} queries: {title}", texts, numbers)
    for window, answer in answers:
        name, start_s = one_line(window.path.name), f"{window.span.start_s:g}"
        if answer is None:
            table.add_row(name, "failed", "", start_s)
            continue
        pose = answer.T_map_base
        at = (f"{pose.x:.2f}", f"{pose.y:.2f}", f"{math.degrees(pose.yaw):.1f}") if pose else ("", "", "")
        sure = probability(answer.confidence), f"{answer.path_m:.1f}"
        where = one_line(answer.frame or answer.session or "")
        table.add_row(name, answer.status.replace("_", " "), where, start_s, *at, *sure)
    tables.show(table)


def write_csv(path: Path, answers: Sequence[tuple[Window, Answer | None]]) -> None:
    """Write a line for each query; what is not known of it is empty. Raises OutputError."""
    with replace_file(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        for window, answer in answers:
            row: list[object] = [window.path.name, window.span.start_s]
            if answer is None:
                writer.writerow([*row, "", "failed", *[""] * 9])
                continue
            pose, covariance = answer.T_map_base, answer.covariance
            at = ("", "", "") if pose is None else (pose.x, pose.y, pose.yaw)
            sigmas = ("", "", "") if covariance is None else np.sqrt(np.diag(covariance)).tolist()
            where = (answer.session or "", answer.frame or answer.session or "")
            time_s = stamp_text(answer.stamp_ns) if answer.stamp_ns else ""  # no time passes in a map
            row += [time_s, answer.status, *where, *at, answer.confidence, *sigmas]
            writer.writerow([round(cell, _DIGITS) if isinstance(cell, float) else cell for cell in row])


def write_places(path: Path, found: Sequence[tuple[Trajectory, Answer]]) -> None:
    """Write where queries were located, in the order of time, as a trajectory. Raises OutputError.

    found : the poses of each query, and its answer. A trajectory is in one frame: answers in another one than
    most are left out, and warned of.
    """
    located: dict[str, dict[int, F64]] = defaultdict(dict)
    for poses, answer in found:
        placed = in_map(poses, answer)
        if placed is not None:
            located[answer.frame or answer.session or ""][answer.stamp_ns] = placed.T_session_base[-1]
    frame = max(located, key=lambda name: len(located[name]))
    for other in located.keys() - {frame}:
        console.warn(f"{path}: is in the frame of {frame}; {len(located[other])} poses in {other} left out")
    stamps_ns = sorted(located[frame])
    T = np.array([located[frame][stamp_ns] for stamp_ns in stamps_ns])
    write_trajectory(path, Trajectory(stamps_ns=np.array(stamps_ns), T_session_base=T))


class Live(TypedDict):
    """How a running robot is followed. scans: used so far. dropped: left out because the computer is too
    slow. reconnected: lost connections made again. lag_s, elapsed_s: seconds from a scan's arrival to its
    use, and for this estimate."""

    scans: int
    dropped: int
    reconnected: int
    lag_s: float
    elapsed_s: float


@contextlib.contextmanager
def followed(source: str, config: ReadConfig, *, real_time: bool = False) -> Iterator[Followed]:
    """A robot by its address, or a recording by its path.

    real_time : a recording is replayed at its own pace. Raises what `open_live` and `open_log` do.
    """
    if real_time or is_robot(source):
        with open_live(source, config) as live:
            yield live
    else:
        with open_log(Path(source), config) as log:
            yield WholeRecording(log)


class WholeRecording:
    """A finished recording, read as by all other commands: each scan once, as fast as it can be used."""

    realtime = False
    lag_s = 0.0

    def __init__(self, log: Log) -> None:
        self.on_poll: Callable[[], bool] = lambda: False
        self.name = str(log.info.path)
        self.counts, self.news = FeedCounts(), News()
        self._log = log
        self._pose: BelievedPose | None = None
        self._messages: Iterator[RawMessage] = iter(())
        self._next: RawMessage | None = None

    def choose(self) -> Choice:
        """See LiveLog."""
        return self._log.choose()

    def parts(self) -> Iterator[Iterator[Scan]]:
        """See LiveLog."""
        yield self._log.scans()
        if self._pose is not None and self._pose.problem is not None:
            self.news.tell(str(self._pose.problem))

    def report(self) -> ReadReport:
        """See LiveLog."""
        return self._log.report()

    def listen_to_pose(self, topic: str) -> None:
        """See LiveLog."""
        self._pose = BelievedPose(topic)
        self._pose.find(self._log.info.topics, self.choose().base_frame)
        self._messages = self._log.messages(self._pose.topics)
        self._next = next(self._messages, None)

    @property
    def believed(self) -> MapPose | None:
        """The newest pose that was recorded before the last scan."""
        if self._pose is None:
            return None
        while self._next is not None and self._next.log_time_ns <= self._log.last_scan_ns:
            self._pose.take(self._next)
            self._next = next(self._messages, None)
        return self._pose.newest


Followed = LiveLog | WholeRecording
"""Scans, part after part, and what is known of how they come."""


def run(
    drive: Followed,
    follower: Follower[Any],
    config: Config,
    poll: Callable[[], bool],
    *,
    see: Callable[[RegisteredScan | None], None] = lambda registered: None,
    observer: Observer = Observer(),
) -> None:
    """Feed a follower with all scans of a robot or a recording.

    poll : called after each scan, and while none comes; true if that was enough.
    see : called with each registered scan; None: what follows does not go on from what was before.
    """
    drive.on_poll = poll
    for scans in drive.parts():
        try:
            for registered, planar_scan in follow(scans, config, observer):
                see(registered)
                follower.add(registered, planar_scan)
                if poll():
                    return
        except TrackingLost as error:
            console.warn(error.in_short)
        if poll():
            return
        follower.restart()
        see(None)
    follower.finish()
    poll()


def live(drive: Followed, elapsed_s: float) -> Live:
    """How it is followed so far. elapsed_s : time that the estimate took."""
    return {
        "scans": drive.report().scans_read,
        "dropped": drive.counts.dropped,
        "reconnected": drive.counts.reconnected,
        "lag_s": drive.lag_s,
        "elapsed_s": elapsed_s,
    }
