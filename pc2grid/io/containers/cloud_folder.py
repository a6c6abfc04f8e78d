"""A folder of clouds (PCD, PLY or KITTI .bin), one scan per file, as a message source.

Times come from a `times.txt` as KITTI has it, from the names of the files, or from the poses, which are in a
TUM file in the folder or beside it.
"""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from pc2grid.errors import LimitExceeded, LogCorrupt, TrajectoryFileError
from pc2grid.io.messages.clouds import pack_cloud, pack_pose
from pc2grid.io.source import LFS_HINT, LIDAR_PERIOD_NS, LogInfo, RawMessage, Tally, TopicInfo, is_lfs_pointer
from pc2grid.io.trajectory import lines_of, read_tum, stamp_ns_from_text
from pc2grid.model import Trajectory
from pc2grid.settings import ReadConfig

SUFFIXES = (".pcd", ".ply", ".bin")
CLOUDS, POSES = "clouds", "poses"


class CloudFolder:
    """The clouds of a folder in the order of the numbers in their names.

    Raises TrajectoryFileError if the times or poses next to them do not fit.
    """

    def __init__(self, folder: Path, config: ReadConfig) -> None:
        self.tally = Tally()
        self.tally.warn("files of clouds carry no checksum: damage to their data would not be seen")
        self._max_bytes = config.max_record_bytes
        self._clouds = _clouds_of(folder, self.tally)
        tum, times = _tum_of(folder), _times_of(folder)
        self._poses = read_tum(tum) if tum else None
        self._stamps = _stamps_of(self._clouds, times, self._poses, self.tally)
        self.files: tuple[Path, ...] = (*self._clouds, *filter(None, (tum, times)))
        kind, count = self._clouds[0].suffix.lower()[1:], len(self._clouds)
        topics = [TopicInfo(topic=CLOUDS, type=f"cloud/{kind}", encoding=kind, message_count=count)]
        if self._poses is not None:
            count = len(self._poses)
            topics.append(TopicInfo(topic=POSES, type="cloud/pose", encoding="pose", message_count=count))
        self.info = LogInfo(
            path=folder,
            format=f"folder/{kind}",
            size_bytes=sum(path.stat().st_size for path in self.files),
            start_ns=self._stamps[0],
            end_ns=self._stamps[-1],
            message_count=sum(t.message_count or 0 for t in topics),
            topics=tuple(topics),
            warnings=tuple(self.tally.warnings),
        )

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages, see MessageSource.messages; each file is read when its message is due."""
        clouds, poses = self.info.topics[0], self.info.topics[-1]
        entries: list[tuple[int, int, Any]] = []  # poses come before the clouds of their stamps
        if POSES in topics and self._poses is not None:
            stamps = self._poses.stamps_ns.tolist()
            entries += [(t, 0, T) for t, T in zip(stamps, self._poses.T_session_base, strict=True)]
        if CLOUDS in topics:
            entries += [(t, 1, path) for t, path in zip(self._stamps, self._clouds, strict=True)]
        low_ns, high_ns = start_ns or 0, math.inf if end_ns is None else end_ns
        for stamp_ns, is_cloud, what in sorted(entries, key=lambda e: e[:2]):
            if not low_ns <= stamp_ns < high_ns:
                continue
            if is_cloud:
                yield RawMessage(clouds, stamp_ns, pack_cloud(stamp_ns, self._content(what)))
            else:
                yield RawMessage(poses, stamp_ns, pack_pose(stamp_ns, what))

    def _content(self, path: Path) -> bytes:
        size = path.stat().st_size
        if size > self._max_bytes:
            raise LimitExceeded(
                f"{path} has {size} bytes; the limit is {self._max_bytes}",
                hint="--set read.max_record_bytes=N raises it",
            )
        try:
            content = path.read_bytes()
        except OSError as error:
            raise LogCorrupt(f"{path}: cannot be read: {error.strerror}") from error
        if is_lfs_pointer(content):
            raise LogCorrupt(f"{path}: a Git LFS pointer to a cloud", hint=LFS_HINT)
        return content


def _clouds_of(folder: Path, tally: Tally) -> list[Path]:
    """Return the clouds of the most frequent kind, in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    counts = Counter(path.suffix.lower() for path in found)
    kind = min(counts, key=lambda suffix: (-counts[suffix], suffix))
    if len(counts) > 1:
        tally.warn(f"the folder holds several kinds of clouds: only its {kind} files are read")
    of_kind = [path for path in found if path.suffix.lower() == kind]
    return sorted(of_kind, key=lambda path: natural(path.name))


def _tum_of(folder: Path) -> Path | None:
    """Return the file of poses in a folder or beside it; None if there is none."""
    beside = folder.with_name(folder.name + ".tum")
    found = sorted(folder.glob("*.tum")) or [beside]
    if len(found) > 1:
        raise TrajectoryFileError(f"{folder}: several .tum files: {', '.join(p.name for p in found)}")
    return found[0] if found[0].is_file() else None


def _times_of(folder: Path) -> Path | None:
    """Return the file of times in a folder; KITTI keeps it beside the folder velodyne/ of the clouds."""
    places = [folder, folder.parent] if folder.name in ("velodyne", "velodyne_points") else [folder]
    files = [place / name for place in places for name in ("times.txt", "timestamps.txt")]
    return next((path for path in files if path.is_file()), None)


def _stamps_of(clouds: list[Path], times: Path | None, poses: Trajectory | None, tally: Tally) -> list[int]:
    """Return a stamp (ns) for each cloud. Raises TrajectoryFileError if a file does not fit the clouds."""
    count, folder = len(clouds), clouds[0].parent
    stamps = _from_names(clouds) if times is None else _listed(times, count)
    if stamps is None and poses is not None:
        if len(poses) != count:
            raise TrajectoryFileError(
                f"{folder}: a .tum of {len(poses)} poses for {count} clouds, whose names are no times"
            )
        stamps = poses.stamps_ns.tolist()
    if stamps is None:
        tally.warn("neither a file nor the names of the clouds tell the time: 10 clouds a second are assumed")
        return [(i + 10) * LIDAR_PERIOD_NS for i in range(count)]
    if stamps[0] <= 0:  # KITTI counts from zero, but a stamp of zero means that there is none
        stamps = [t - stamps[0] + 1_000_000_000 for t in stamps]
    return stamps


def _listed(path: Path, count: int) -> list[int]:
    """Return the stamps in a file of times."""
    try:
        stamps = [stamp_ns_from_text(word) for line in lines_of(path) for word in line.split()]
    except (ValueError, ArithmeticError) as error:
        raise TrajectoryFileError(f"{path}: not seconds, one per line: {error}") from error
    if len(stamps) != count:
        raise TrajectoryFileError(f"{path}: {len(stamps)} times for {count} clouds")
    if any(b <= a for a, b in itertools.pairwise(stamps)):
        raise TrajectoryFileError(f"{path}: time does not increase")
    return stamps


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key by which `scan_10` comes after `scan_9`."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _from_names(clouds: list[Path]) -> list[int] | None:
    """Return stamps from names such as 1305031102.175304.pcd (s) or 1305031102175304000.pcd (ns, us); else
    None."""
    stamps = []
    for path in clouds:
        if not (kind := re.fullmatch(r"(\d{9,10}\.\d+)|(\d{18,19})|\d{15,16}", path.stem)):
            return None
        seconds, nanoseconds = kind.groups()
        text = seconds or (f"{path.stem}e-9" if nanoseconds else f"{path.stem}e-6")
        try:
            stamps.append(stamp_ns_from_text(text))
        except ValueError:  # past the year 2262
            return None
    return stamps if all(b > a for a, b in itertools.pairwise(stamps)) else None
