"""The nouns that travel between the stages: frozen, with units in their names.

Metres, radians, int64 nanoseconds. Arrays inside are made read-only, so a stage cannot change what
another one holds.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
BoolGrid = NDArray[np.bool_]

SensorKind = Literal["lidar", "laser", "depth"]

UNKNOWN = -1
FREE = 0
OCCUPIED = 100


def _freeze(owner: object, name: str, dtype: type, shape: tuple[int | None, ...]) -> None:
    """Check shape and type of an array field once, at the seam, and make it read-only."""
    value: NDArray[np.generic] = np.asarray(getattr(owner, name), dtype=dtype)
    if value.ndim != len(shape) or any(
        want is not None and want != got for want, got in zip(shape, value.shape, strict=True)
    ):
        wanted = tuple("N" if n is None else n for n in shape)
        raise ValueError(f"{type(owner).__name__}.{name}: expected shape {wanted}, got {value.shape}")
    if value.flags.writeable:
        value = value.view()
        value.flags.writeable = False
    object.__setattr__(owner, name, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """One sweep of one sensor, in the base frame.

    stamp_ns : when the sweep was taken (`header.stamp`).
    points_m : (N, 3) float32, returns in the base frame (x forward, y left, z up); finite.
    offsets_s : (N,) float32, when each point was taken relative to `stamp_ns`; None if not recorded.
    T_base_sensor : (4, 4) where the sensor sits on the base; its translation is where rays start.
    T_odom_base : (4, 4) odometry at `stamp_ns`, or None if the log has none there.
    T_first_last : (4, 4) how the base moved from the first to the last of the points' times, by odometry;
        None where that or the times are not recorded.
    sensor : which of the three kinds made it.
    dropped : how many returns were left out while decoding (NaN, inf, no return, out of range).

    >>> import numpy as np
    >>> scan = Scan(stamp_ns=0, points_m=np.ones((5, 3)), T_base_sensor=np.eye(4), sensor="lidar")
    >>> scan.points_m.dtype.name, scan.T_odom_base is None
    ('float32', True)
    """

    stamp_ns: int
    points_m: F32
    T_base_sensor: F64
    sensor: SensorKind
    offsets_s: F32 | None = None
    T_odom_base: F64 | None = None
    T_first_last: F64 | None = None
    dropped: int = 0

    def __post_init__(self) -> None:
        _freeze(self, "points_m", np.float32, (None, 3))
        _freeze(self, "T_base_sensor", np.float64, (4, 4))
        if self.T_odom_base is not None:
            _freeze(self, "T_odom_base", np.float64, (4, 4))
        if self.T_first_last is not None:
            _freeze(self, "T_first_last", np.float64, (4, 4))
        if self.offsets_s is not None:
            _freeze(self, "offsets_s", np.float32, (len(self.points_m),))


class Health(enum.Enum):
    """What registration can honestly say of one scan."""

    FINE = "fine"
    DEGENERATE = "degenerate"
    LOST = "lost"


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisteredScan:
    """A scan with its place in the session's map.

    scan : the scan, its points deskewed to `scan.stamp_ns` (base frame at that time).
    T_map_base : (4, 4) pose of the base at `scan.stamp_ns`. The map frame is the base at the first scan.
    health : FINE; DEGENERATE (some direction rests on odometry or the motion model); LOST (do not map).

    >>> import numpy as np
    >>> scan = Scan(stamp_ns=0, points_m=np.ones((5, 3)), T_base_sensor=np.eye(4), sensor="lidar")
    >>> RegisteredScan(scan=scan, T_map_base=np.eye(4)).health.value
    'fine'
    """

    scan: Scan
    T_map_base: F64
    health: Health = Health.FINE

    def __post_init__(self) -> None:
        _freeze(self, "T_map_base", np.float64, (4, 4))


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Poses of the base over time.

    stamps_ns : (N,) int64, increasing.
    T_map_base : (N, 4, 4) float64.
    health : N entries, parallel to `stamps_ns`; empty means all fine.

    >>> import numpy as np
    >>> from pc2grid import SE2
    >>> poses = np.array([SE2(x, 0.0, 0.0).lift() for x in (0.0, 1.0, 3.0)])
    >>> way = Trajectory(stamps_ns=np.array([0, 10, 20]), T_map_base=poses)
    >>> way.path_m().tolist(), way.planar()[-1].tolist()
    ([0.0, 1.0, 3.0], [3.0, 0.0, 0.0])
    """

    stamps_ns: I64
    T_map_base: F64
    health: tuple[Health, ...] = ()

    def __post_init__(self) -> None:
        _freeze(self, "stamps_ns", np.int64, (None,))
        _freeze(self, "T_map_base", np.float64, (len(self.stamps_ns), 4, 4))
        if self.health and len(self.health) != len(self.stamps_ns):
            raise ValueError(
                f"Trajectory.health: expected {len(self.stamps_ns)} entries, got {len(self.health)}"
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def planar(self) -> F64:
        """(N, 3): x, y, yaw of the base in the map frame; metres and radians."""
        T = self.T_map_base
        return np.column_stack((T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])))

    def path_m(self) -> F64:
        """(N,): planar distance driven up to each pose, metres."""
        steps = np.linalg.norm(np.diff(self.T_map_base[:, :2, 3], axis=0), axis=1)
        return np.concatenate(([0.0], np.cumsum(steps)))[: len(self)]

    def poses(self) -> Iterator[SE2]:
        """Planar pose of each entry."""
        for x, y, yaw in self.planar():
            yield SE2(float(x), float(y), float(yaw))


@dataclass(frozen=True, slots=True, kw_only=True)
class OccupancyGrid:
    """A 2D occupancy grid with cells as in nav_msgs/OccupancyGrid.

    cells : (H, W) int8; -1 unknown, 0 free .. 100 occupied. Row 0 holds the smallest y, column 0 the
        smallest x.
    resolution_m : edge of a cell.
    origin_m : (x, y) in the map frame of the lower-left corner of cell (0, 0).

    >>> import numpy as np
    >>> grid = OccupancyGrid(cells=np.array([[0, 100], [-1, 0]]), resolution_m=0.5, origin_m=(-1.0, 2.0))
    >>> grid.to_cell(np.array([[-0.4, 2.1]])).tolist()
    [[0, 1]]
    >>> grid.to_point(np.argwhere(grid.occupied)).tolist()
    [[-0.25, 2.25]]
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float]

    def __post_init__(self) -> None:
        _freeze(self, "cells", np.int8, (None, None))
        if not (np.isfinite(self.resolution_m) and self.resolution_m > 0):
            raise ValueError(f"OccupancyGrid.resolution_m: expected > 0, got {self.resolution_m}")

    @property
    def occupied(self) -> BoolGrid:
        """(H, W) cells at or above 65 (nav2's occupied_thresh)."""
        return self.cells >= 65

    @property
    def free(self) -> BoolGrid:
        """(H, W) cells known to be below 20 (nav2's free_thresh, 0.196, in percent)."""
        return (self.cells >= 0) & (self.cells < 20)

    def to_cell(self, points_m: NDArray[np.floating]) -> I64:
        """Map points (N, 2) in the map frame to (N, 2) cells as (row, column); may lie outside."""
        xy = np.floor((np.asarray(points_m, dtype=np.float64) - self.origin_m) / self.resolution_m)
        return xy[:, ::-1].astype(np.int64)

    def to_point(self, cells: NDArray[np.integer]) -> F64:
        """Cells (N, 2) as (row, column) to their centres (N, 2) in the map frame, metres."""
        return (np.asarray(cells)[:, ::-1] + 0.5) * self.resolution_m + self.origin_m

    def crop(self, center_m: tuple[float, float], half_width_m: float) -> OccupancyGrid:
        """The square of (2 n + 1)^2 cells around the cell that holds `center_m`; unknown past the edge."""
        n = round(half_width_m / self.resolution_m)
        row, column = (int(v) for v in self.to_cell(np.array([center_m]))[0])
        cells = np.full((2 * n + 1, 2 * n + 1), UNKNOWN, dtype=np.int8)
        height, width = self.cells.shape
        r0, r1 = max(row - n, 0), min(row + n + 1, height)
        c0, c1 = max(column - n, 0), min(column + n + 1, width)
        if r0 < r1 and c0 < c1:
            cells[r0 - row + n : r1 - row + n, c0 - column + n : c1 - column + n] = self.cells[r0:r1, c0:c1]
        origin = (
            self.origin_m[0] + (column - n) * self.resolution_m,
            self.origin_m[1] + (row - n) * self.resolution_m,
        )
        return OccupancyGrid(cells=cells, resolution_m=self.resolution_m, origin_m=origin)


@dataclass(frozen=True, slots=True, kw_only=True)
class Submap:
    """A part of a map around a centre (paper III-A).

    submap_id : number within its session, in the order of the partition.
    center_m : (x, y) in the map frame.
    radius_m : what lies farther from the centre is unknown in `grid`.
    grid : square crop around the centre, cells outside the radius unknown.

    >>> import pc2grid
    >>> submap = pc2grid.submaps_of(pc2grid.load_map("map.yaml"))[0]
    >>> submap.submap_id, submap.radius_m, submap.grid.cells.shape
    (0, 8.0, (321, 321))
    """

    submap_id: int
    center_m: tuple[float, float]
    radius_m: float
    grid: OccupancyGrid


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadReport:
    """What was read from a log and what was lost on the way; any loss makes the program exit with 3.

    scans_skipped counts by reason; warnings are whole sentences for the user.
    """

    scans_read: int = 0
    points_dropped: int = 0
    scans_skipped: dict[str, int] = field(default_factory=dict)
    bytes_lost: int = 0
    warnings: tuple[str, ...] = ()

    @property
    def lossy(self) -> bool:
        """Whether data was lost."""
        return bool(self.scans_skipped) or self.bytes_lost > 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """A place that a session came back to, as measured there: what closed a loop, or would have.

    older, newer : which poses of the trajectory saw it.
    T_older_newer : the newer base in the older one's frame, in the plane, as the two views fit each other.
        The trajectory honours it as far as the other loops and the way between agree.
    information : (3, 3) inverse covariance of its x, y, yaw in the older base's axes.
    accepted : whether the others bear it out; otherwise it has lost most of its say.

    >>> import numpy as np
    >>> from pc2grid import SE2
    >>> home = Loop(older=0, newer=900, T_older_newer=SE2(0.2, 0.0, 3.1), information=np.eye(3))
    >>> home.accepted
    True
    """

    older: int
    newer: int
    T_older_newer: SE2
    information: F64
    accepted: bool = True

    def __post_init__(self) -> None:
        _freeze(self, "information", np.float64, (3, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionMap:
    """What one recording became: the end of the point-cloud half of pc2grid.

    session : name, unique within a database.
    sensor : the kind that made the map, or "map" for an imported map.yaml.
    grid : the whole occupancy grid in the session's map frame.
    submaps : its partition.
    trajectory : poses of the base; empty for an imported map.
    loops : where the recording came back to a place it had seen.

    >>> import numpy as np
    >>> import pc2grid
    >>> grid = pc2grid.load_map("map.yaml")
    >>> none = Trajectory(stamps_ns=np.empty(0), T_map_base=np.empty((0, 4, 4)))
    >>> plan = SessionMap(
    ...     session="plan", sensor="map", grid=grid, submaps=pc2grid.submaps_of(grid), trajectory=none
    ... )
    >>> plan.report.lossy
    False
    """

    session: str
    sensor: str
    grid: OccupancyGrid
    submaps: tuple[Submap, ...]
    trajectory: Trajectory
    loops: tuple[Loop, ...] = ()
    report: ReadReport = field(default_factory=ReadReport)

    def __post_init__(self) -> None:
        for loop in self.loops:
            if not 0 <= min(loop.older, loop.newer) <= max(loop.older, loop.newer) < len(self.trajectory):
                raise ValueError(
                    f"SessionMap.loops: expected poses of 0..{len(self.trajectory) - 1},"
                    f" got {loop.older} and {loop.newer}"
                )
