"""A folder of clouds (PCD, PLY or KITTI .bin), one scan per file, as a message source.

Times and poses come from a TUM file, from KITTI's `times.txt`, `poses.txt` and `calib.txt`, or, for times,
from the names of the files.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt, TrajectoryFileError
from pc2grid.geometry import invert_pose
from pc2grid.io.error_translation import LFS_HINT, is_lfs_pointer
from pc2grid.io.message_source import LogInfo, RawMessage, Tally, TopicInfo
from pc2grid.io.messages.cloud_messages import pack_cloud, pack_pose
from pc2grid.io.trajectory import is_rigid, lines_of, read_kitti, read_tum, stamp_ns_from_text
from pc2grid.model import Trajectory

SUFFIXES = (".pcd", ".ply", ".bin")
CLOUDS, POSES = "clouds", "poses"
_ASSUMED_PERIOD_NS = 100_000_000  # 10 Hz, of most lidars and of KITTI


class CloudFolder:
    """The clouds of a folder in the order of the numbers in their names.

    Raises TrajectoryFileError if the times or poses next to them do not fit.
    """

    def __init__(self, folder: Path, config: ReadConfig) -> None:
        self.tally = Tally()
        self.tally.warn("files of clouds carry no checksum: damage to their data would not be seen")
        self._max_bytes = config.max_record_bytes
        self._clouds = _clouds_of(folder, self.tally)
        side = Sidecars(folder)
        self._stamps, poses = side.stamps_and_poses(self._clouds, self.tally)
        self._poses = poses
        self.files: tuple[Path, ...] = (*self._clouds, *side.used)
        kind = self._clouds[0].suffix.lower()[1:]
        topics = [
            TopicInfo(topic=CLOUDS, type=f"cloud/{kind}", encoding=kind, message_count=len(self._clouds))
        ]
        if poses is not None:
            topics.append(
                TopicInfo(topic=POSES, type="cloud/pose", encoding="pose", message_count=len(poses))
            )
        self._topics = {t.topic: t for t in topics}
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
        """Nothing stays open."""

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RawMessage]:
        """See MessageSource.messages; each file is read when its message is due."""
        for stamp_ns, is_cloud, what in sorted(self._entries(topics), key=lambda e: e[:2]):
            if (start_ns is not None and stamp_ns < start_ns) or (end_ns is not None and stamp_ns >= end_ns):
                continue
            if is_cloud:
                yield RawMessage(self._topics[CLOUDS], stamp_ns, pack_cloud(stamp_ns, self._content(what)))
            else:
                yield RawMessage(self._topics[POSES], stamp_ns, pack_pose(stamp_ns, what))

    def _entries(self, topics: Collection[str]) -> Iterator[tuple[int, int, Any]]:
        """Stamp, whether it is a cloud, and its file or pose; poses before the clouds of their stamps."""
        if POSES in topics and self._poses is not None:
            poses = self._poses
            yield from ((int(t), 0, T) for t, T in zip(poses.stamps_ns, poses.T_session_base, strict=True))
        if CLOUDS in topics:
            yield from ((t, 1, path) for t, path in zip(self._stamps, self._clouds, strict=True))

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
    """The clouds of the most frequent kind, in the order of the numbers in their names."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    counts = Counter(path.suffix.lower() for path in found)
    kind = min(counts, key=lambda suffix: (-counts[suffix], suffix))
    if len(counts) > 1:
        tally.warn(f"the folder holds several kinds of clouds: only its {kind} files are read")
    of_kind = [path for path in found if path.suffix.lower() == kind]
    return sorted(of_kind, key=lambda path: natural(path.name))


class Sidecars:
    """The files of times and poses beside the clouds; `used` are those that were read."""

    def __init__(self, folder: Path) -> None:
        # KITTI keeps poses.txt beside the folder velodyne/ of the clouds; elsewhere all is in one folder.
        self._places = [folder, folder.parent] if folder.name in ("velodyne", "velodyne_points") else [folder]
        self._folder = folder
        self.used: list[Path] = []

    def stamps_and_poses(self, clouds: list[Path], tally: Tally) -> tuple[list[int], Trajectory | None]:
        """A stamp (ns) for each cloud, and the trajectory, if there is one.

        Raises TrajectoryFileError if a file does not fit the clouds.
        """
        tum, kitti = self._pose_files()
        stamps = self._times(len(clouds)) or _from_names(clouds)
        poses = read_tum(tum) if tum else None
        if stamps is None and poses is not None:
            if len(poses) != len(clouds):
                raise TrajectoryFileError(
                    f"{tum}: {len(poses)} poses for {len(clouds)} clouds whose names are no times"
                )
            stamps = poses.stamps_ns.tolist()
        stamps = stamps or _assumed(len(clouds), tally)
        if stamps[0] <= 0:  # KITTI counts from zero, but a stamp of zero means that there is none
            stamps = [t - stamps[0] + 1_000_000_000 for t in stamps]
        if kitti is not None:
            T = self._in_sensor_axes(read_kitti(kitti))
            if len(T) != len(clouds):
                raise TrajectoryFileError(f"{kitti}: {len(T)} poses for {len(clouds)} clouds")
            poses = Trajectory(stamps_ns=np.array(stamps), T_session_base=T)
        return stamps, poses

    def _find(self, *names: str) -> Path | None:
        for place in self._places:
            for name in names:
                if (place / name).is_file():
                    self.used.append(place / name)
                    return place / name
        return None

    def _pose_files(self) -> tuple[Path | None, Path | None]:
        """A TUM file and a KITTI file; at most one of them."""
        tums = sorted(path for path in self._folder.glob("*.tum") if path.is_file())
        beside = self._folder.with_name(self._folder.name + ".tum")
        tums = tums or ([beside] if beside.is_file() else [])
        if len(tums) > 1:
            raise TrajectoryFileError(
                f"{self._folder}: several .tum files: {', '.join(p.name for p in tums)}"
            )
        if tums:
            self.used.append(tums[0])
            return tums[0], None
        text = self._find("poses.txt", "trajectory.txt", "groundtruth.txt")
        if text is None:
            return None, None
        return (None, text) if _numbers_per_line(text) == 12 else (text, None)

    def _times(self, count: int) -> list[int] | None:
        path = self._find("times.txt", "timestamps.txt")
        if path is None:
            return None
        try:
            stamps = [stamp_ns_from_text(word) for line in lines_of(path) for word in line.split()]
        except (ValueError, ArithmeticError) as error:
            raise TrajectoryFileError(f"{path}: not seconds, one per line: {error}") from error
        if len(stamps) != count:
            raise TrajectoryFileError(f"{path}: {len(stamps)} times for {count} clouds")
        if any(b <= a for a, b in itertools.pairwise(stamps)):
            raise TrajectoryFileError(f"{path}: time does not increase")
        return stamps

    def _in_sensor_axes(self, T_cam0_cam: F64) -> F64:
        """Poses of the lidar, (N, 4, 4), from KITTI's poses of its left camera and `Tr` in calib.txt."""
        path = self._find("calib.txt")
        if path is None:
            return T_cam0_cam
        T_cam_lidar = np.eye(4)
        for line in lines_of(path):
            name, _, values = line.partition(":")
            if name.strip() in ("Tr", "Tr_velo_to_cam"):
                try:
                    T_cam_lidar[:3] = np.array([float(v) for v in values.split()]).reshape(3, 4)
                except ValueError as error:
                    raise TrajectoryFileError(f"{path}: {name} is not a 3x4 matrix") from error
                if not is_rigid(T_cam_lidar):
                    raise TrajectoryFileError(f"{path}: {name} is not a rigid pose")
        result: F64 = invert_pose(T_cam_lidar) @ T_cam0_cam @ T_cam_lidar
        return result


def _assumed(count: int, tally: Tally) -> list[int]:
    tally.warn("neither a file nor the names of the clouds tell the time: 10 clouds a second are assumed")
    return [(i + 10) * _ASSUMED_PERIOD_NS for i in range(count)]


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key by which `scan_10` comes after `scan_9`."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]


def _from_names(clouds: list[Path]) -> list[int] | None:
    """Stamps from names such as 1305031102.175304.pcd (s) or 1305031102175304000.pcd (ns, us); else None."""
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


def _numbers_per_line(path: Path) -> int:
    for line in lines_of(path):
        if line.strip() and not line.startswith("#"):
            return len(line.split())
    return 0
