"""Recordings of a folder that the catalogue does not name: one's own, with true poses beside them.

Later parts of each are located in the map of its beginning.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from pc2grid.errors import ConfigError, Pc2GridError
from pc2grid.io import open_log
from pc2grid_lab.experiments.recordings import catalogue
from pc2grid_lab.experiments.recordings.catalogue import Pair, Recording, Source

_SUFFIXES = (".mcap", ".bag", ".db3")
_MAPPED_S, _WINDOW_S, _WINDOWS = 600.0, 20.0, 10
"""The beginning, and windows of what comes after it: at most so long, and so many. As in the catalogue."""


def own_recordings(data: Path, *, without: Path, of_base: bool) -> tuple[list[Recording], list[Pair]]:
    """The recordings of a folder that the catalogue does not name, and the pairs of each with its beginning.

    without : a folder that is left out. of_base : whether the poses in `NAME.tum` are of the base, not of the
        sensor. Raises ConfigError if the folder is not there.
    """
    if not data.is_dir():
        raise ConfigError(f"{data}: no such folder", hint="give the folder of recordings")
    rows, named = [], {recording.file for recording in catalogue.RECORDINGS}
    for file in _recordings(data, without.resolve()):
        name = file.relative_to(data).as_posix()
        if name not in named:
            rows.append(_row(file, name, of_base))
    return [recording for recording, _ in rows], [pair for _, pair in rows if pair is not None]


def state_of(data: Path, recordings: Sequence[Recording]) -> str:
    """Digits that change when a file of one of these recordings is written; empty without recordings."""
    found = hashlib.sha256()
    for recording in recordings:
        path = data / recording.file
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            about = file.stat()
            found.update(f"{file} {about.st_size} {about.st_mtime_ns}\n".encode())
    return found.hexdigest()[:8] if recordings else ""


def _recordings(folder: Path, without: Path) -> Iterator[Path]:
    """The recordings in a folder and in those below it. One of rosbag2, which is a folder, is one."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and path.resolve() != without:
            if (path / "metadata.yaml").exists():
                yield path
            else:
                yield from _recordings(path, without)
        elif path.suffix in _SUFFIXES:
            yield path


def _row(file: Path, name: str, of_base: bool) -> tuple[Recording, Pair | None]:
    """A recording, and windows of its end in the map of its beginning; none if it cannot be read."""
    beside = {suffix: Path(name).with_suffix(suffix).as_posix() for suffix in (".tum", ".relations")}
    there = [beside[suffix] for suffix in beside if file.with_suffix(suffix).exists()]
    sensor: Source = "unknown"  # if it cannot be read: `convert` says why, in the row of its map
    pair = None
    try:
        with open_log(file) as log:
            sensor = log.choose().sensor
            pair = _later_parts(name, (log.info.end_ns - log.info.start_ns) * 1e-9)
    except (Pc2GridError, OSError):
        pass
    recording = Recording(
        name=name,
        file=name,
        building=file.resolve().parent.name,
        sensor=sensor,
        truth=there[-1] if there else None,
        poses=beside[".tum"] if beside[".tum"] in there else None,
        of_base=of_base,
        quick=True,
    )
    return recording, pair


def _later_parts(name: str, length_s: float) -> Pair:
    until_s = round(min(_MAPPED_S, length_s / 2), 1)
    left_s = length_s - until_s
    window_s = round(min(_WINDOW_S, left_s / 2), 1)
    return Pair(
        query=name,
        map=name,
        kind="later part",
        window_s=window_s,
        windows=min(_WINDOWS, round(2 * left_s / max(window_s, 0.1))),
        until_s=until_s,
        quick=True,
    )
