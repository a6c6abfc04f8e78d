"""The types that the stages exchange: frozen, with units in their names; and the properties of the sensors.

Metres, radians, int64 nanoseconds. The arrays inside are read-only, and no other code can write to them, so a
stage cannot change the data of another one. The kinds of sensors differ in one place:
`SENSOR_MODELS[scan.sensor]`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, PlainSerializer, computed_field

from pc2grid.display import html_picture, html_table, map_png, short
from pc2grid.geometry import F32, F64, I64, SE2, U8, BoolGrid, frozen_arrays, hand_over

if TYPE_CHECKING:
    import networkx as nx


SensorKind = Literal["lidar", "laser", "depth"]
MapOf = Literal["everything", "walls", "raw"]
"""What a map shows that leaves the program: all that stands somewhere; walls, with things unknown; or the
cells as they are, which nav2 takes for free below 100."""

# Numbers that a JSON document shows with so many digits.
TwoDigits = Annotated[float, PlainSerializer(lambda value: round(value, 2), float, when_used="json")]
ThreeDigits = Annotated[float, PlainSerializer(lambda value: round(value, 3), float, when_used="json")]
FourDigits = Annotated[float, PlainSerializer(lambda value: round(value, 4), float, when_used="json")]

# Values of nav_msgs/OccupancyGrid: a probability in percent, or -1.
UNKNOWN = -1
FREE = 0
OCCUPIED = 100
# The thresholds of nav2_map_server (trinary mode), in percent: occupied_thresh 0.65, free_thresh 0.196.
# A cell is occupied if it is >= OCCUPIED_FROM, free if 0 <= cell < FREE_BELOW, otherwise undecided.
OCCUPIED_FROM = 65
FREE_BELOW = 20
# A thing on the floor that is no wall, such as a table: an obstacle for robots, but no evidence for a place.
# Sums of `OccupancyParameters.hit` and `miss` make 56 or 62 percent, not this.
THING = 60

SLICE_BORDERS_M = (0.6, 1.1)
"""Heights above the floor between the slices in which something stands or not: seats and legs are below,
tables and worktops between, and only what is tall is above. Chosen by hand."""
SLICES = len(SLICE_BORDERS_M) + 1
"""Number of slices. A byte of heights has bit k set if slice k was observed to be occupied somewhere, and bit
k + SLICES if it was observed to be free and nowhere occupied."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(
    points_m=(np.float32, "N", 3),
    T_base_sensor=(np.float64, 4, 4),
    T_odom_base=(np.float64, 4, 4),
    T_first_last=(np.float64, 4, 4),
    T_level_base=(np.float64, 4, 4),
    offsets_s=(np.float32, "N"),
)
class Scan:
    """One scan of one sensor, in the base frame.

    stamp_ns : when the scan was taken (`header.stamp`).
    points_m : (N, 3) float32, returns in the base frame (x forward, y left, z up); finite.
    offsets_s : (N,) float32, when each point was taken relative to `stamp_ns`; None if not recorded.
    T_base_sensor : (4, 4) mounting of the sensor on the base; its translation is the origin of the rays.
    T_odom_base : (4, 4) odometry at `stamp_ns`, or None if the log has none there.
    odometry_gap_s : longest time without a reading of odometry since the last scan that has `T_odom_base`;
        infinite if that is not known.
    T_first_last : (4, 4) motion of the base from the first to the last of the points' times, by odometry;
        without odometry its rotation, by an IMU; None where that or the times are not recorded.
    T_level_base : (4, 4) attitude at `stamp_ns` by an IMU: z is up, the heading drifts, no translation; None
        if there is no IMU.
    sensor : kind of the sensor.
    dropped : number of returns that were left out while decoding (NaN, inf, no return, out of range).

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
    T_level_base: F64 | None = None
    odometry_gap_s: float = math.inf

    def __repr__(self) -> str:
        return f"Scan({self.sensor}, {len(self.points_m)} points, stamp_ns={self.stamp_ns})"


class Health(enum.Enum):
    """How well the pose of a scan is determined.

    FINE : in every direction, and odometry, if there is any, agrees. DEGENERATE : some direction rests on
    odometry or the motion before. LOST : not at all; the scan is not mapped. OVERRULED : as FINE, but
    odometry is an outlier (`pc2grid.estimation.tracker`).
    """

    FINE = "fine"
    DEGENERATE = "degenerate"
    LOST = "lost"
    OVERRULED = "overruled"


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(T_session_base=(np.float64, 4, 4))
class RegisteredScan:
    """A scan with its pose in the frame of its session.

    scan : the scan, its points deskewed to `scan.stamp_ns` (base frame at that time).
    T_session_base : (4, 4) pose of the base at `scan.stamp_ns`. The session frame is the base at the
        session's first scan, levelled (z up).
    health : how well the pose is determined.

    >>> import numpy as np
    >>> scan = Scan(stamp_ns=0, points_m=np.ones((5, 3)), T_base_sensor=np.eye(4), sensor="lidar")
    >>> RegisteredScan(scan=scan, T_session_base=np.eye(4)).health.value
    'fine'
    """

    scan: Scan
    T_session_base: F64
    health: Health = Health.FINE

    def __repr__(self) -> str:
        pose = SE2.from_matrix(self.T_session_base)
        return f"RegisteredScan({self.scan}, {self.health.value}, at x {pose.x:.2f} m, y {pose.y:.2f} m)"


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(stamps_ns=(np.int64, "N"), T_session_base=(np.float64, "N", 4, 4))
class Trajectory:
    """Poses of the base over time.

    stamps_ns : (N,) int64, increasing.
    T_session_base : (N, 4, 4) float64. The session frame is the base at the session's first scan, levelled
        (z up); for poses from a file it is the frame of that file.
    health : N entries, parallel to `stamps_ns`; empty means all fine.

    >>> import numpy as np
    >>> from pc2grid import SE2
    >>> poses = np.array([SE2(x, 0.0, 0.0).lift() for x in (0.0, 1.0, 3.0)])
    >>> way = Trajectory(stamps_ns=np.array([0, 10, 20]), T_session_base=poses)
    >>> way.path_m().tolist(), way.planar()[-1].tolist()
    ([0.0, 1.0, 3.0], [3.0, 0.0, 0.0])
    """

    stamps_ns: I64
    T_session_base: F64
    health: tuple[Health, ...] = ()

    def __post_init__(self) -> None:
        if self.health and len(self.health) != len(self.stamps_ns):
            raise ValueError(
                f"Trajectory.health: expected {len(self.stamps_ns)} entries, got {len(self.health)}"
            )

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} poses, {self.length_m:.1f} m in {self.duration_s:.1f} s)"

    def planar(self) -> F64:
        """Return (N, 3): x, y, yaw of the base in the session frame; metres and radians."""
        T = self.T_session_base
        return np.column_stack((T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])))

    def path_m(self) -> F64:
        """Return (N,): planar distance driven up to each pose, metres."""
        steps = np.linalg.norm(np.diff(self.T_session_base[:, :2, 3], axis=0), axis=1)
        return np.concatenate(([0.0], np.cumsum(steps)))[: len(self)]

    @property
    def length_m(self) -> float:
        """Return the planar distance driven, metres; 0 without poses."""
        return float(self.path_m()[-1]) if len(self) else 0.0

    @property
    def duration_s(self) -> float:
        """Return the time between the first and the last pose, seconds; 0 without poses."""
        return float(self.stamps_ns[-1] - self.stamps_ns[0]) * 1e-9 if len(self) else 0.0

    def poses(self) -> Iterator[SE2]:
        """Yield the planar pose of each entry."""
        for x, y, yaw in self.planar():
            yield SE2(float(x), float(y), float(yaw))


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(cells=(np.int8, "H", "W"), heights=(np.uint8, "H", "W"))
class OccupancyGrid:
    """A 2D occupancy grid with cells as in nav_msgs/OccupancyGrid.

    cells : (H, W) int8; -1 unknown, 0 free .. 100 occupied, `THING` a low obstacle.
        Row 0 holds the smallest y, column 0 the smallest x.
    resolution_m : edge of a cell.
    origin_m : (x, y) in the map frame of the lower-left corner of cell (0, 0).
    height_m : of the one plane that was observed, above the base; None: of all heights, or not known.
    heights : (H, W) uint8, the slices in which an occupied cell or a low obstacle was observed to be occupied
        and to be free (`SLICES`); 0 where that is not known. None if it is known of no cell.

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
    height_m: float | None = None
    heights: U8 | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.resolution_m) and self.resolution_m > 0):
            raise ValueError(f"OccupancyGrid.resolution_m: expected > 0, got {self.resolution_m}")

    def __repr__(self) -> str:
        height, width = self.cells.shape
        x, y = self.origin_m
        return (
            f"OccupancyGrid({width} x {height} cells of {self.resolution_m:g} m, origin ({x:.2f}, {y:.2f}) m,"
            f" {self.free_m2:.0f} m2 free)"
        )

    def _repr_png_(self) -> bytes:
        return map_png(self.cells, self.resolution_m, self.origin_m)

    @property
    def occupied(self) -> BoolGrid:
        """Return a mask (H, W) of the occupied cells: `OCCUPIED_FROM` percent or more."""
        return self.cells >= OCCUPIED_FROM

    @property
    def free(self) -> BoolGrid:
        """Return a mask (H, W) of the known free cells: below `FREE_BELOW` percent."""
        return (self.cells >= 0) & (self.cells < FREE_BELOW)

    @property
    def things(self) -> BoolGrid:
        """Return a mask (H, W) of the cells of low obstacles; empty where heights are not known."""
        things: BoolGrid = self.cells == THING
        return things

    @property
    def ground(self) -> BoolGrid:
        """Return a mask (H, W) of the cells where a sensor may be: free ones, and low obstacles, over which a
        hand reaches."""
        return self.free | self.things

    def told(self, of: MapOf = "everything") -> NDArray[np.int8]:
        """Return the cells (H, W) for other programs: 100 for an obstacle, 0 for a free cell, else -1.

        >>> import numpy as np
        >>> cells = np.array([[1, 50, THING, 82, -1]])
        >>> grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
        >>> grid.told().tolist(), grid.told("walls").tolist()
        ([[0, -1, 100, 100, -1]], [[0, -1, -1, 100, -1]])
        """
        if of == "raw":
            return self.cells
        stands = self.occupied | self.things if of == "everything" else self.occupied
        return np.select([stands, self.free], [np.int8(OCCUPIED), np.int8(FREE)], np.int8(UNKNOWN))

    @property
    def free_m2(self) -> float:
        """Return the area of the free cells, square metres."""
        return float(np.count_nonzero(self.free)) * self.resolution_m**2

    def is_free(self, x_m: float, y_m: float) -> bool:
        """Return True if a point of the map frame lies in a free cell of the grid."""
        (cell,) = self.look_up(self.cells, np.array([(x_m, y_m)]), UNKNOWN).tolist()
        return bool(0 <= cell < FREE_BELOW)

    def to_cell(self, points_m: NDArray[np.floating]) -> I64:
        """Return the cells (N, 2), as (row, column), of points (N, 2) in the map frame; they may lie
        outside."""
        xy = np.floor((np.asarray(points_m, dtype=np.float64) - self.origin_m) / self.resolution_m)
        return xy[:, ::-1].astype(np.int64)

    def to_point(self, cells: NDArray[np.integer]) -> F64:
        """Return the centres (N, 2) of cells (N, 2), given as (row, column), in the map frame, metres."""
        return (np.asarray(cells)[:, ::-1] + 0.5) * self.resolution_m + self.origin_m

    def look_up(self, values: NDArray[Any], points_m: NDArray[np.floating], outside: float) -> NDArray[Any]:
        """Return the values (N,) of cells (H, W) at points (N, 2) in the map frame. outside : of points that
        lie there."""
        at = self.to_cell(points_m)
        inside = ((at >= 0) & (at < values.shape)).all(axis=1)
        found = np.full(len(at), outside, values.dtype)
        found[inside] = values[tuple(at[inside].T)]
        return found

    def crop(self, center_m: tuple[float, float], half_width_m: float) -> OccupancyGrid:
        """Return the square of (2 n + 1)^2 cells around the cell that holds `center_m`; unknown past the
        edge.

        Heights are left out.
        """
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
        return replace(self, cells=hand_over(cells), origin_m=origin, heights=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Submap:
    """A part of a map around a centre (paper III-A).

    submap_id : number within its session, in the order of the partition.
    center_m : (x, y) in the map frame.
    radius_m : cells farther from the centre are unknown in `grid`.
    grid : square crop around the centre, cells outside the radius unknown.

    >>> import pc2grid
    >>> submap = pc2grid.submaps_of(pc2grid.load_map("map.yaml"))[0]
    >>> submap.submap_id, submap.radius_m, submap.grid.cells.shape
    (0, 5.0, (201, 201))
    """

    submap_id: int
    center_m: tuple[float, float]
    radius_m: float
    grid: OccupancyGrid

    def __repr__(self) -> str:
        x, y = self.center_m
        return f"Submap({self.submap_id} at ({x:.2f}, {y:.2f}) m, radius {self.radius_m:g} m)"

    def _repr_png_(self) -> bytes:
        return self.grid._repr_png_()


MISSING_FILES = "files of the recording that are missing"
"""The reason in `ReadReport.scans_skipped` for files of a split recording that are not there."""
MOST_LISTED = 20
"""Places of a recording that a report lists of one kind of fault, the longest first."""
SEVERE_SHARE = 0.01
"""Lost scans per scan read from which on a loss is severe; chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadReport:
    """Counts of what was read from a log, and of what was lost; if much was lost, the program exits with 3.

    scans_skipped counts by reason; warnings are whole sentences for the user.

    >>> few = ReadReport(scans_read=7373, scans_skipped={"registration lost": 1})
    >>> few.lossy, few.severe
    (True, False)
    """

    scans_read: int = 0
    points_dropped: int = 0
    scans_skipped: dict[str, int] = field(default_factory=dict)
    bytes_lost: int = 0
    warnings: tuple[str, ...] = ()

    @computed_field  # type: ignore[prop-decorator]  # mypy has no decorated properties
    @property
    def lossy(self) -> bool:
        """Return whether data was lost."""
        return bool(self.scans_skipped) or self.bytes_lost > 0

    @property
    def severe(self) -> bool:
        """Return whether so much was lost that the result may be incomplete.

        That is: a part of a file was damaged or a file was missing, or for each hundred scans that were read
        (`SEVERE_SHARE`) at least one was lost.
        """
        damaged = self.bytes_lost > 0 or MISSING_FILES in self.scans_skipped
        lost = sum(self.scans_skipped.values())
        return damaged or (lost > 0 and lost >= SEVERE_SHARE * self.scans_read)


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(information=(np.float64, 3, 3))
class Loop:
    """A place that a session came back to, with the relative pose measured there.

    older, newer : indices of the two poses in the trajectory.
    T_older_newer : the newer base in the frame of the older one, in the plane, by matching the two views.
        The trajectory agrees with it as far as the other loops and the odometry between allow.
    information : (3, 3) inverse covariance of its x, y, yaw in the older base's axes.
    accepted : True if it agrees with the other measurements; otherwise its weight in the pose graph is low.

    >>> import numpy as np
    >>> from pc2grid import SE2
    >>> home = Loop(older=0, newer=900, T_older_newer=SE2(0.2, 0.0, 3.1), information=np.eye(3))
    >>> home.accepted
    True
    """

    older: int
    newer: int
    T_older_newer: SE2
    information: Annotated[F64, BeforeValidator(np.asarray)]
    accepted: bool = True

    def __repr__(self) -> str:
        accepted = "accepted" if self.accepted else "not accepted"
        return f"Loop({self.older} to {self.newer}, {self.T_older_newer}, {accepted})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A part of a trajectory.

    from_ns, to_ns : stamps of its first and last scan. length_m : planar distance driven.
    x_m, y_m : position of the base, in the session frame, where it is worst.
    """

    from_ns: int
    to_ns: int
    x_m: TwoDigits
    y_m: TwoDigits
    length_m: TwoDigits


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction(Stretch):
    """A part of a trajectory along which the scans do not agree with the map that was drawn from them.

    share : of the wall hits at the worst place that lie on free ground of the map, 0..1.
    """

    share: FourDigits


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """The agreement of a map with its own scans (`signature.session.quality`).

    hits_on_free : share of all wall hits that lie on free ground of the map, 0..1. Hits on moving objects are
        not counted.
    contradicted : share of the travel along which many do, 0..1.
    bent : True if the share is so high that parts of the map are probably drawn in the wrong place.
    stretches : where this is so, the longest first; of very many the longest only.

    >>> Consistency().bent
    False
    """

    hits_on_free: FourDigits = 0.0
    contradicted: FourDigits = 0.0
    bent: bool = False
    stretches: tuple[Contradiction, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class UncertainSegment(Stretch):
    """A part of a trajectory whose place relative to the rest of the map is known only roughly.

    sigma_m : largest standard deviation of a position along it, in the least certain direction.
    """

    sigma_m: ThreeDigits


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """The precision of the places of a map relative to each other (`signature.session.quality`).

    stamps_ns : (N,) increasing, of scans along the travel, a few metres apart.
    sigma_m : (N,) standard deviation of the position there, in the least certain direction, relative to the
        well-constrained part of the map.
    loose : unconstrained segments, where it is too large to rely on, the least certain first.

    >>> round(Precision(stamps_ns=(0, 10), sigma_m=(0.1, 0.3)).at(5), 3)
    0.2
    """

    stamps_ns: tuple[int, ...] = ()
    sigma_m: tuple[float, ...] = ()
    loose: tuple[UncertainSegment, ...] = ()

    def __post_init__(self) -> None:
        if len(self.stamps_ns) != len(self.sigma_m):
            raise ValueError(
                f"Precision: expected as many stamps as sigmas, got {len(self.stamps_ns)}"
                f" and {len(self.sigma_m)}"
            )

    @property
    def worst_m(self) -> float:
        """Return the largest standard deviation, 0 without any."""
        return max(self.sigma_m, default=0.0)

    def at(self, stamp_ns: int) -> float:
        """Return the standard deviation at a time, interpolated; 0 if nothing is known."""
        if not self.stamps_ns:
            return 0.0
        since_s = np.array([stamp - self.stamps_ns[0] for stamp in self.stamps_ns]) * 1e-9
        return float(np.interp((stamp_ns - self.stamps_ns[0]) * 1e-9, since_s, self.sigma_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryOutlier:
    """A time in which the scans showed another motion than odometry.

    from_ns, to_ns : stamps of its first and last scan. distance_m, turn_rad : the largest difference between
        the two motions from one scan to the next.
    """

    from_ns: int
    to_ns: int
    distance_m: ThreeDigits
    turn_rad: FourDigits


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryCheck:
    """The comparison of a session's odometry with its scans (`pc2grid.estimation.tracker`).

    compared : number of scans that were tracked and have odometry. overruled : of these, number of scans at
        which odometry is an outlier.
    stretches : where that was so, the largest difference first; of very many the largest only.

    >>> OdometryCheck().compared
    0
    """

    compared: int = 0
    overruled: int = 0
    stretches: tuple[OdometryOutlier, ...] = ()


def _empty_graph() -> nx.Graph:
    import networkx as nx

    return nx.Graph()


POINT_STEPS = 64
"""Steps along the edge of a voxel in which a `PointMap` keeps a point: 0.8 mm of 5 cm."""


@dataclass(frozen=True, slots=True, kw_only=True)
@frozen_arrays(origin_m=(np.float64, 3), steps=(np.int32, "V", 3))
class PointMap:
    """The registered points of a session in space, one for each voxel that holds any: their mean.

    voxel_m : edge of a voxel. origin_m : (3,) in the map frame, lowest corner of all voxels.
    steps : (V, 3) int32 from there, in steps of voxel_m / POINT_STEPS; by increasing x, y, z of the voxels.

    >>> points = PointMap.of(np.array([[0.0, 0.0, 0.02], [1.0, 0.0, 2.0]]), 0.05)
    >>> len(points), points.points_m().round(2).tolist()
    (2, [[0.0, 0.0, 0.02], [1.0, 0.0, 2.0]])
    """

    voxel_m: float
    origin_m: F64
    steps: NDArray[np.int32]

    @staticmethod
    def of(points_m: NDArray[np.floating], voxel_m: float, corner_m: F64 | None = None) -> PointMap:
        """Make the map of points (N, 3) in the map frame; of several in a voxel the first is kept.

        corner_m : (3,) a corner of any voxel; by default the lowest coordinates.
        """
        points = np.asarray(points_m, np.float64).reshape(-1, 3)
        origin_m = points.min(axis=0) if len(points) else np.zeros(3)
        if corner_m is not None:
            origin_m = corner_m + np.floor((origin_m - corner_m) / voxel_m) * voxel_m
        steps = np.floor((points - origin_m) * (POINT_STEPS / voxel_m)).astype(np.int32)
        x, y, z = (steps // POINT_STEPS).astype(np.int64).T
        _, first = np.unique((x << 42) + (y << 21) + z, return_index=True)
        return PointMap(voxel_m=voxel_m, origin_m=origin_m, steps=hand_over(steps[first]))

    def __len__(self) -> int:
        return len(self.steps)

    def points_m(self) -> F64:
        """Return the points (V, 3) in the map frame."""
        return (self.steps + 0.5) * (self.voxel_m / POINT_STEPS) + self.origin_m


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionMap:
    """The map made of one recording: the result of the point-cloud half of pc2grid.

    session : name, unique within a database.
    sensor : the kind that made the map, or "map" for an imported map.yaml.
    grid : the whole occupancy grid, in the session frame.
    submaps : its partition.
    trajectory : poses of the base; empty for an imported map.
    loops : between visits of the same place.
    graph : the junction graph of the free space (`pc2grid.submaps.junction_graph`) from which the submaps
        were made; empty if none was made.
    consistency : agreement of the map with its own scans; None if that is not known.
    odometry : agreement of odometry with the scans; None if that is not known.
    precision : of its places relative to each other; None if that is not known.
    points : the points of the recording in space; None if they were not asked for, or there are none.

    >>> import numpy as np
    >>> import pc2grid
    >>> grid = pc2grid.load_map("map.yaml")
    >>> none = Trajectory(stamps_ns=np.empty(0), T_session_base=np.empty((0, 4, 4)))
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
    graph: nx.Graph = field(default_factory=_empty_graph)
    consistency: Consistency | None = None
    odometry: OdometryCheck | None = None
    precision: Precision | None = None
    points: PointMap | None = None
    report: ReadReport = field(default_factory=ReadReport)

    def __post_init__(self) -> None:
        for loop in self.loops:
            if not 0 <= min(loop.older, loop.newer) <= max(loop.older, loop.newer) < len(self.trajectory):
                raise ValueError(
                    f"SessionMap.loops: expected poses of 0..{len(self.trajectory) - 1},"
                    f" got {loop.older} and {loop.newer}"
                )

    def __repr__(self) -> str:
        travel = self.trajectory
        driven = f"{travel.length_m:.1f} m in {travel.duration_s:.0f} s, " if len(travel) else ""
        counts = f"{len(self.submaps)} submaps, {len(self.loops)} loops"
        return (
            f"SessionMap({short(self.session)}, {self.sensor}, {driven}{self.grid.free_m2:.0f} m2, {counts})"
        )

    def _repr_html_(self) -> str:
        grid, travel = self.grid, self.trajectory
        rows = [
            ("sensor", self.sensor),
            ("scans", len(travel)),
            ("driven", f"{travel.length_m:.1f} m in {travel.duration_s:.0f} s"),
            ("free space", f"{grid.free_m2:.0f} m2"),
            ("submaps", len(self.submaps)),
            ("loops closed", sum(loop.accepted for loop in self.loops)),
        ]
        if self.consistency is not None and self.consistency.bent:
            rows.append(("probably bent", f"along {100 * self.consistency.contradicted:.0f} % of the travel"))
        if self.precision is not None and self.precision.loose:
            rows.append(("loosely tied", f"+- {self.precision.worst_m:.1f} m"))
        rows += [("warning", text) for text in self.report.warnings]
        centers_m = np.array([submap.center_m for submap in self.submaps]).reshape(-1, 2)
        path_m = travel.planar()[:, :2]
        png = map_png(grid.cells, grid.resolution_m, grid.origin_m, path_m=path_m, centers_m=centers_m)
        picture = html_picture(png, "the map, the path of the robot, and the centres of the submaps")
        return html_table(f"session {self.session}", rows) + picture


def part_name(session: str, number: int) -> str:
    """Return the name of part `number`, from 0, of a recording in several parts.

    >>> part_name("monday", 0), part_name("monday", 1)
    ('monday', 'monday#2')
    """
    return f"{session}#{number + 1}" if number else session


def is_part_of(name: str, session: str) -> bool:
    """Return True if `name` is that of another part of the recording whose first part is `session`.

    >>> is_part_of("monday#2", "monday"), is_part_of("monday", "monday"), is_part_of("monday#b", "monday")
    (True, False, False)
    """
    head, mark, number = name.rpartition("#")
    return mark == "#" and head == session and number.isdecimal()


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """A kind of sensor.

    planar : it measures in one plane, so it shows no floor, no slope, and no points in space. image : its
    scans are images in optical axes (REP-103), with a CameraInfo, of one moment; others sweep. narrow : it
    looks ahead only, and there densely: it shows the floor ahead, and its walls constrain a pose in fewer
    directions than those all around. noise_per_m2 : standard deviation of a range over its square; 0: the
    noise does not grow with the range.
    """

    planar: bool = False
    image: bool = False
    narrow: bool = False
    noise_per_m2: float = 0.0

    def range_of_noise_m(self, sigma_m: float) -> float:
        """Return the range at which the noise has this standard deviation; infinite if it does not grow."""
        return math.sqrt(sigma_m / self.noise_per_m2) if self.noise_per_m2 else math.inf


SENSOR_MODELS: dict[SensorKind, SensorModel] = {
    "lidar": SensorModel(),
    "laser": SensorModel(planar=True),
    # Of stereo and structured light; Khoshelham and Elberink (2012) give 0.0014 for the Kinect.
    "depth": SensorModel(image=True, narrow=True, noise_per_m2=0.0015),
}
