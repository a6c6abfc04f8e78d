"""What a session keeps while it is tracked: the pose of every scan, and the planar scan and points of
keyframes.

Planar scans and points wait in a temporary file (`Spool`), so that memory does not grow with the length of a
session. The points of a keyframe are reduced to one a voxel, six bytes each: 0.4 GB for an hour of a lidar at
0.5 m/s. When the loops are closed they are added to the voxels of the session, so memory grows with the
surfaces that were observed.
"""

from __future__ import annotations

import math
import pickle
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pc2grid.clouds.cloud import VoxelCloud
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import OutputError
from pc2grid.estimation.tracker import Disagreement
from pc2grid.geometry import F32, F64, SE2, BoolGrid, transform_points
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.model import SENSOR_MODELS, OccupancyGrid, PointMap, Scan, Trajectory
from pc2grid.settings import ProjectionConfig


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A planar scan that becomes part of the map, because the robot had moved since the one before.

    index : number of its scan in the session. T_session_base : as tracked, before loops are closed.
    restart : True for the first keyframe after tracking was lost: its pose relative to those before is not
    measured.
    """

    index: int
    planar_scan: PlanarScan
    T_session_base: SE2
    restart: bool = False


TURN_M_PER_RAD = 0.3
"""Travel that a turn on the spot counts as; chosen by hand."""


class Keyframes:
    """The keyframes of a session, a sequence that only grows; their planar scans are in a `Spool`.

    scans : (K,) number of the scan of each. restarts : those whose pose relative to the one before is not
    known. above_floor_m : (K,) as of a `PlanarScan`, NaN for None.
    """

    def __init__(self) -> None:
        self._planar_scans = Spool("scans")
        self.scans, self.above_floor_m = array("q"), array("d")
        self.restarts: set[int] = set()
        self._poses = array("d")  # x, y, yaw of one after the other

    def __len__(self) -> int:
        return len(self.scans)

    def __getitem__(self, number: int) -> Keyframe:
        planar_scan = pickle.loads(self._planar_scans[number])
        return Keyframe(self.scans[number], planar_scan, self.pose(number), number in self.restarts)

    def append(self, keyframe: Keyframe) -> None:
        """Add one. Raises OutputError if the disk is full."""
        self._planar_scans.append(pickle.dumps(keyframe.planar_scan))
        if keyframe.restart:
            self.restarts.add(len(self))
        self.scans.append(keyframe.index)
        above_m = keyframe.planar_scan.above_floor_m
        self.above_floor_m.append(math.nan if above_m is None else above_m)
        pose = keyframe.T_session_base
        self._poses.extend((pose.x, pose.y, pose.yaw))

    def poses(self) -> F64:
        """Return T_session_base of all keyframes as tracked, (K, 3): x, y, yaw."""
        return np.array(self._poses).reshape(-1, 3)

    def pose(self, number: int) -> SE2:
        """Return T_session_base of a keyframe as tracked."""
        return SE2(*self._poses[3 * number : 3 * number + 3])

    def close(self) -> None:
        """Delete the file."""
        self._planar_scans.close()


def grid_of(keyframes: Iterable[tuple[Keyframe, SE2]], projection: ProjectionConfig) -> OccupancyGrid:
    """Draw the occupancy grid of keyframes, each with the pose of its base in the frame of the grid."""
    builder = GridBuilder(projection)
    for keyframe, pose in keyframes:
        builder.add(keyframe.planar_scan, pose)
    return builder.grid()


_STEPS = np.iinfo(np.int16).max  # from the origin of the base to the farthest point of a keyframe


class KeyframePoints:
    """The points of keyframes; a sequence that only grows.

    voxel_m : edge of a voxel. max_range_m : returns farther than this from the sensor are left out.
    """

    def __init__(self, voxel_m: float, max_range_m: float) -> None:
        self._voxel_m, self._max_range_m = voxel_m, max_range_m
        self._clouds = Spool("points")
        self._scans = array("q")

    def append(self, index: int, scan: Scan) -> None:
        """Add a deskewed scan, number `index` of the session. Raises OutputError if the disk is full."""
        # A camera measures farther surfaces with a noise that is larger than a voxel.
        range_m = min(self._max_range_m, SENSOR_MODELS[scan.sensor].range_of_noise_m(self._voxel_m))
        away = scan.points_m - scan.T_base_sensor[:3, 3].astype(np.float32)
        near = np.einsum("ij,ij->i", away, away) < range_m**2
        cloud = VoxelCloud(self._voxel_m)
        cloud.add(scan.points_m[near])
        points_m = cloud.points_m()
        step_m = np.float32(max(np.abs(points_m).max(initial=0.0), self._voxel_m) / _STEPS)
        self._clouds.append(step_m.tobytes() + np.rint(points_m / step_m).astype("<i2").tobytes())
        self._scans.append(index)

    def __iter__(self) -> Iterator[tuple[int, F32]]:
        """Yield the number of each scan in the session, and its points (N, 3) in the base frame."""
        for number, index in enumerate(self._scans):
            record = self._clouds[number]
            steps = np.frombuffer(record, "<i2", offset=np.float32().itemsize).reshape(-1, 3)
            yield index, steps * np.frombuffer(record, np.float32, count=1)

    def registered(self, T_session_base: F64, chosen: BoolGrid | None = None) -> PointMap | None:
        """Return the points at the poses (N, 4, 4) of their scans, one a voxel; None if there are none.

        chosen : (N,) mask of the scans to use; by default all.
        """
        cloud = VoxelCloud(self._voxel_m)
        for index, points_m in self:
            if chosen is None or chosen[index]:
                cloud.add(transform_points(T_session_base[index], points_m))
        if not len(cloud):
            return None
        return PointMap.of(cloud.points_m(), self._voxel_m, cloud.corner_m)

    def close(self) -> None:
        """Remove the temporary file."""
        self._clouds.close()


@dataclass(frozen=True, slots=True)
class Track:
    """The results of tracking for all scans of a session.

    trajectory : before loops are closed. disagreements : of odometry, at each scan. readings : (N, 4, 4) of
    odometry, NaN where there is none.
    walls_changed_ns : stamps of the scans before which the walls had changed while odometry stood still.
    left_out : number of scans before the first of the trajectory. warning : why, or an assumption about it.
    """

    trajectory: Trajectory
    disagreements: Sequence[Disagreement | None]
    readings: F64
    walls_changed_ns: tuple[int, ...] = ()
    left_out: int = 0
    warning: str | None = None

    @property
    def with_odometry(self) -> bool:
        """Return True if any scan has an odometry pose."""
        return bool(np.isfinite(self.readings).any())


IN_MEMORY_BYTES = 32 << 20  # chosen by hand: about an hour of the keyframes of a 2D laser


class Spool:
    """Byte strings in the order in which they were appended, read in any order.

    More than `IN_MEMORY_BYTES` of them are written to a temporary file without a name: a killed process
    leaves no file behind.

    what : a word for the records, for error messages.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._file = tempfile.SpooledTemporaryFile(max_size=IN_MEMORY_BYTES)  # noqa: SIM115
        self._ends = array("q", [0])

    def append(self, record: bytes) -> None:
        """Add one. Raises OutputError if the disk is full."""
        try:
            self._file.seek(self._ends[-1])
            self._file.write(record)
            self._file.flush()
        except OSError as error:
            raise OutputError(
                f"{tempfile.gettempdir()}: no room for the {self._what} of the map: {error.strerror}",
                hint="set TMPDIR to a folder on a larger disk",
            ) from error
        self._ends.append(self._ends[-1] + len(record))

    def __getitem__(self, number: int) -> bytes:
        begin, end = self._ends[number], self._ends[number + 1]
        self._file.seek(begin)
        return self._file.read(end - begin)

    def close(self) -> None:
        """Delete the file."""
        self._file.close()
