"""The planar scans that the map of a session is made of; those of a long session are kept in a file."""

from __future__ import annotations

import math
import struct
import tempfile
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.config import ProjectionConfig
from pc2grid.errors import OutputError
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import OccupancyGrid

IN_MEMORY_BYTES = 32 << 20  # chosen by hand: about an hour of a 2D laser
# stamp; origin of the sensor and height of its plane (NaN: none); hits, bearings, low things and heights
_HEADER = struct.Struct("<q 3d 4q")


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A planar scan that becomes part of the map, because the robot had moved since the one before.

    index : number of its scan in the session. T_session_base : as tracked, before loops are closed.
    restart : the first keyframe after tracking was lost: its pose relative to those before is not measured.
    """

    index: int
    planar_scan: PlanarScan
    T_session_base: SE2
    restart: bool = False


class Keyframes:
    """The keyframes of a session, a sequence that only grows.

    If their planar scans exceed `in_memory_bytes`, they are written to a temporary file without a name:
    memory does not grow with the length of the session, and a killed process leaves no file behind.

    scans : (K,) number of the scan of each. restarts : those whose pose relative to the one before is not
    known.
    """

    def __init__(self, in_memory_bytes: int = IN_MEMORY_BYTES) -> None:
        self._file = tempfile.SpooledTemporaryFile(max_size=in_memory_bytes)  # noqa: SIM115
        self._starts = array("q", [0])
        self.scans = array("q")
        self.restarts: set[int] = set()
        self._poses = array("d")  # x, y, yaw of one after the other

    def __len__(self) -> int:
        return len(self._starts) - 1

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, number: int) -> Keyframe:
        start, end = self._starts[number], self._starts[number + 1]
        self._file.seek(start)
        data = self._file.read(end - start)
        stamp_ns, *origin, hits, bearings, low, _ = _HEADER.unpack_from(data)
        values = np.frombuffer(data, np.float32, offset=_HEADER.size)
        ends = np.cumsum((2 * hits, hits, bearings, 2 * low))
        hits_m, normal_rad, free_m, low_m, seen_at = np.split(values, ends)
        return Keyframe(
            self.scans[number],
            PlanarScan(
                stamp_ns=stamp_ns,
                hits_m=hits_m.reshape(-1, 2),
                origin_m=np.array(origin[:2]),
                normal_rad=normal_rad,
                free_m=free_m,
                low_m=low_m.reshape(-1, 2),
                height_m=None if math.isnan(origin[2]) else origin[2],
                heights=seen_at.astype(np.uint8),
            ),
            self.pose(number),
            number in self.restarts,
        )

    def append(self, keyframe: Keyframe) -> None:
        """Add one. Raises OutputError if the disk is full."""
        planar_scan, pose = keyframe.planar_scan, keyframe.T_session_base
        header = _HEADER.pack(
            planar_scan.stamp_ns,
            *planar_scan.origin_m,
            math.nan if planar_scan.height_m is None else planar_scan.height_m,
            *(
                len(a)
                for a in (planar_scan.hits_m, planar_scan.free_m, planar_scan.low_m, planar_scan.heights)
            ),
        )
        arrays = (
            *(planar_scan.hits_m, planar_scan.normal_rad, planar_scan.free_m, planar_scan.low_m),
            planar_scan.heights,
        )
        data = header + b"".join(np.ascontiguousarray(a, np.float32).tobytes() for a in arrays)
        try:
            self._file.seek(self._starts[-1])
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: no room for the scans of the map: {error.strerror}",
                hint="set TMPDIR to a folder on a larger disk",
            ) from error
        if keyframe.restart:
            self.restarts.add(len(self))
        self._starts.append(self._starts[-1] + len(data))
        self.scans.append(keyframe.index)
        self._poses.extend((pose.x, pose.y, pose.yaw))

    def poses(self) -> F64:
        """T_session_base of all as tracked, (K, 3): x, y, yaw."""
        return np.array(self._poses).reshape(-1, 3)

    def pose(self, number: int) -> SE2:
        """T_session_base of one as tracked."""
        return SE2(*self._poses[3 * number : 3 * number + 3])

    def close(self) -> None:
        """Delete the file."""
        self._file.close()


def grid_of(keyframes: Iterable[tuple[Keyframe, SE2]], projection: ProjectionConfig) -> OccupancyGrid:
    """The occupancy grid of keyframes, each with the pose of its base in the frame of the grid."""
    builder = GridBuilder(projection)
    for keyframe, pose in keyframes:
        builder.add(keyframe.planar_scan, pose)
    return builder.grid()
