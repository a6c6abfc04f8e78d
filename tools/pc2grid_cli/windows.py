"""Several queries at once: recordings, or windows along them, each with a line of its own."""

from __future__ import annotations

import csv
import math
from collections import Counter, defaultdict
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.display import probability
from pc2grid.errors import ConfigError, LogError, one_line
from pc2grid.io import open_log
from pc2grid.io.atomic import replace_file
from pc2grid.io.trajectory import stamp_text, write_trajectory
from pc2grid.mapping.drawn_map import is_drawn_map
from pc2grid.model import Trajectory
from pc2grid.observer import Observer
from pc2grid.time_span import TimeSpan
from pc2grid_cli import console
from pc2grid_cli.known_pose import KnownPose
from pc2grid_cli.locate import in_map
from signature.files import find, query_config
from signature.localization.map_index import MapIndex
from signature.localization.shown.report import Found

if TYPE_CHECKING:
    from pc2grid.arrays import F64
    from signature.config import Config
    from signature.database import SubmapDatabase
    from signature.localization.answer import Answer

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
    from pc2grid_cli import tables

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
