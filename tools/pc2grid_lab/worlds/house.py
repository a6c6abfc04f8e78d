"""A house of several floors, and a drive through it by stairs or by lift.

All floors have the plan of one procedural office. A shaft stands against its eastern outer wall. It holds
either stairs, in each storey two flights side by side with a landing between them, or the cabin of a lift.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage

from pc2grid.arrays import F32, F64, I64, freeze
from pc2grid.config import Section
from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2, transform_points
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, Scan, SensorKind
from pc2grid.simulate.clutter import Furniture, covered, place_clutter
from pc2grid.simulate.config import SimulationConfig
from pc2grid.simulate.drive import RATE_HZ, Drive, drive_along
from pc2grid.simulate.floorplan import OUTER_WALL_M, office_floorplan
from pc2grid.simulate.odometry import SimulatedOdometry, odometry_of
from pc2grid.simulate.passage import clearance_m
from pc2grid.simulate.route import Route, plan_route, plan_way
from pc2grid.simulate.scene import Mesh, Scene, extrude, quads
from pc2grid.simulate.sensors import Sensor, make_sensor
from pc2grid.simulate.session import RAYS_PER_CAST, Reading, scan_of

_DOOR_M = 1.2  # width of the door to the shaft
_INSIDE_M = 0.9  # from that door to where rides begin and end
_LANDING_M = 1.6  # depth of the landings of stairs
_LANE_M = 1.35  # width of a flight
_SPINE_M = 0.1  # thickness of the wall between two flights
_CABIN_M = 2.0  # width and depth of the cabin of a lift
_RISER_M = 0.17  # largest height of a step
_STEPS_ABOVE = 0.3  # flights that are steeper have steps; others are ramps
_WHEELBASE_M = 0.5
_DOOR_S = 1.5  # from the stop in the cabin until the door is shut, and from the arrival until it opens
_STOREY_S = 4.0  # time of a lift for a storey

_CLUTTER, _ROUTE, _DRIVE, _ODOMETRY, _NOISE = range(20, 25)


class HouseConfig(Section):
    """A house and the way through it."""

    visits: tuple[int, ...] = Field(
        default=(0, 1, 2), min_length=1, description="floors in the order in which they are visited"
    )
    floors: int | None = Field(default=None, ge=1, le=20, description="null: up to the highest visited")
    ride: Literal["stairs", "lift"] = Field(default="stairs", description="how the robot changes floors")
    storey_m: float = Field(default=3.0, ge=2.6, le=8, description="height from one floor to the next")
    slope: float = Field(
        default=0.6, gt=0, le=0.8, description="rise of a flight over its length in the plan"
    )
    furniture_seed: int | None = Field(
        default=None, ge=0, description="of the movable objects; null: that of the session"
    )
    alike: bool = Field(default=False, description="the same movable objects in the same places everywhere")

    @property
    def storeys(self) -> int:
        """How many floors the house has."""
        return max(self.floors or 1, max(self.visits) + 1)


@dataclass(frozen=True, slots=True)
class SpatialDrive:
    """A motion in space: the drive in the plan, with height and pitch.

    planar : x, y, yaw, sampled evenly. height_m, pitch_rad : (N,) of the base at the same times; a positive
    pitch lifts the front. scene : (N,) number of the scene that is seen. floor : (N,) the floor where the
    robot is; on stairs the last one.
    """

    planar: Drive
    height_m: F64
    pitch_rad: F64
    scene: I64
    floor: I64

    def __post_init__(self) -> None:
        count = len(self.planar.poses)
        for name in ("height_m", "pitch_rad"):
            freeze(self, name, np.float64, (count,))
        for name in ("scene", "floor"):
            freeze(self, name, np.int64, (count,))

    @property
    def duration_s(self) -> float:
        """Time of the last pose."""
        return self.planar.duration_s

    @property
    def length_m(self) -> float:
        """Distance driven in the plan."""
        return self.planar.length_m

    def at(self, times_s: F64) -> tuple[F64, F64]:
        """Positions (..., 3) and rotations (..., 3, 3) of the base at times (...) in seconds."""
        planar = self.planar.at(times_s)
        position = np.clip(np.asarray(times_s) * RATE_HZ, 0, len(self.height_m) - 1)
        number = np.arange(len(self.height_m))
        pitch = np.interp(position, number, self.pitch_rad)
        where = np.concatenate(
            (planar[..., :2], np.interp(position, number, self.height_m)[..., None]), axis=-1
        )
        c, s, cp, sp = np.cos(planar[..., 2]), np.sin(planar[..., 2]), np.cos(pitch), np.sin(pitch)
        zero = np.zeros_like(c)
        rotation = np.stack(
            [
                np.stack([c * cp, -s, -c * sp], axis=-1),
                np.stack([s * cp, c, -s * sp], axis=-1),
                np.stack([sp, zero, cp], axis=-1),
            ],
            axis=-2,
        )
        return where, rotation

    def pose(self, time_s: float) -> F64:
        """T_house_base (4, 4)."""
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = self.at(np.array(time_s))
        return T

    def of_sample(self, values: I64, time_s: float) -> int:
        """The value (N,) at a time."""
        return int(values[min(int(time_s * RATE_HZ), len(values) - 1)])


@dataclass(frozen=True, slots=True)
class House:
    """A house: one plan for each floor, with the shaft.

    office : the plan of a floor with the door to the shaft. plan : the same with what lies behind the door
    on the level of the floor, for routes. door_m : middle of the door, on the outer face of the wall.
    """

    config: HouseConfig
    office: OccupancyGrid
    plan: OccupancyGrid
    door_m: tuple[float, float]

    @staticmethod
    def of(office: OccupancyGrid, config: HouseConfig, robot_m: float) -> House:
        """A house whose floors have this plan. Raises ConfigError if its eastern wall has no room for a
        door."""
        cells = office.cells
        east = int(np.flatnonzero((cells == OCCUPIED).any(axis=0))[-1]) + 1
        cells = cells[:, :east].copy()
        cell_m = office.resolution_m
        wall, half = round(OUTER_WALL_M / cell_m), round(_DOOR_M / 2 / cell_m)
        row = _door_row(cells == FREE, east - wall, cell_m, half, robot_m)
        cells[row - half : row + half, east - wall - round(_INSIDE_M / cell_m) :] = FREE
        door_m = (office.origin_m[0] + east * cell_m, office.origin_m[1] + row * cell_m)
        depth_m, width_m = (
            (_LANDING_M, 2 * _LANE_M + _SPINE_M) if config.ride == "stairs" else (_CABIN_M, _CABIN_M)
        )
        deep, side = round(depth_m / cell_m), round(width_m / 2 / cell_m)
        shaft = np.full((len(cells), deep + 1), UNKNOWN, np.int8)
        shaft[row - side - 1 : row + side + 1] = OCCUPIED
        shaft[row - side : row + side, :-1] = FREE
        return House(
            config, replace(office, cells=cells), replace(office, cells=np.hstack((cells, shaft))), door_m
        )

    @property
    def flight_m(self) -> float:
        """Length of a flight in the plan."""
        return 0.5 * self.config.storey_m / self.config.slope

    @property
    def inside_m(self) -> tuple[float, float]:
        """Where rides begin and end on each floor."""
        return self.door_m[0] - OUTER_WALL_M - _INSIDE_M, self.door_m[1]

    def way(self, up: bool) -> tuple[F64, I64]:
        """The line (N, 2) of a ride, from `inside_m` and back, and where on it the robot turns in place."""
        x, y = self.door_m
        if self.config.ride == "lift":
            corners = [self.inside_m, (x + 0.5 * _CABIN_M, y), self.inside_m]
        else:
            near, far = x + 0.5 * _LANDING_M, x + 1.5 * _LANDING_M + self.flight_m
            lane = 0.5 * (_LANE_M + _SPINE_M)
            corners = [
                self.inside_m,
                (x, y),
                (near, y - lane),
                (far, y - lane),
                (far, y + lane),
                (near, y + lane),
            ]
            corners = [*corners, (x, y), self.inside_m]
            if not up:
                corners.reverse()
        points, turns = [np.array(corners[:1])], []
        for begin, end in pairwise(corners):
            count = max(round(math.dist(begin, end) / 0.05), 1)
            points.append(np.linspace(begin, end, count + 1)[1:])
            turns.append(sum(map(len, points)) - 1)
        return np.concatenate(points), np.array(turns[:-1], dtype=np.int64)

    def rises(self, planar: Drive, first: int) -> tuple[F64, F64, I64]:
        """Height, pitch and floor (N,) along a drive by the stairs, which begins on floor `first`."""
        x, y, yaw = planar.poses.T
        upper = y > self.door_m[1]
        changes = np.diff(upper.astype(np.int64), prepend=int(upper[0]))
        middle = x > self.door_m[0] + _LANDING_M + 0.5 * self.flight_m
        floor = first + np.cumsum(np.where(middle, changes, 0))

        def height(along_m: F64) -> F64:
            rise = np.clip(along_m - self.door_m[0] - _LANDING_M, 0.0, self.flight_m) * self.config.slope
            return floor * self.config.storey_m + np.where(upper, -rise, rise)

        ahead = 0.5 * _WHEELBASE_M * np.cos(yaw)
        front, rear = height(x + ahead), height(x - ahead)
        return 0.5 * (front + rear), np.arctan2(front - rear, _WHEELBASE_M), floor

    def stairs(self) -> Mesh:
        """Landings, flights and the walls of the staircase, of all storeys."""
        (x0, y), storey_m, flight_m = self.door_m, self.config.storey_m, self.flight_m
        floors = self.config.storeys
        half, spine = _LANE_M + 0.5 * _SPINE_M, 0.5 * _SPINE_M
        x1, x2, x3 = x0 + _LANDING_M, x0 + _LANDING_M + flight_m, x0 + 2 * _LANDING_M + flight_m
        top_m = floors * storey_m
        faces = [
            _upright((x0, y - half), (x3, y - half), 0.0, top_m),
            _upright((x0, y + half), (x3, y + half), 0.0, top_m),
            _upright((x3, y - half), (x3, y + half), 0.0, top_m),
            _upright((x1, y - spine), (x2, y - spine), 0.0, top_m),
            _upright((x1, y + spine), (x2, y + spine), 0.0, top_m),
            _level((x0, y - half), (x3, y + half), 0.0),
            _level((x0, y - half), (x3, y + half), top_m),
            # No flight arrives at the lowest floor, and none leaves the highest.
            _upright((x1, y + spine), (x1, y + half), 0.0, storey_m),
            _upright((x1, y - half), (x1, y - spine), top_m - storey_m, top_m),
        ]
        for floor in range(floors):
            z = floor * storey_m
            faces.append(_level((x0, y - half), (x1, y + half), z))
            faces.append(_upright((x0, y - half), (x0, y + half), z - 0.5, z))
            if floor + 1 < floors:
                middle = z + 0.5 * storey_m
                faces.append(_level((x2, y - half), (x3, y + half), middle))
                faces += self._flight((y - half, y - spine), x1, z, +1)
                faces += self._flight((y + spine, y + half), x2, middle, -1)
        return quads(np.array(faces))

    def _flight(self, lane_m: tuple[float, float], x: float, z: float, direction: int) -> list[F64]:
        """The faces of a flight that rises from (x, z) towards +x or -x."""
        low, high = lane_m
        rise_m, length_m = 0.5 * self.config.storey_m, direction * self.flight_m
        if self.config.slope <= _STEPS_ABOVE:
            end, top = x + length_m, z + rise_m
            return [np.array([(x, low, z), (end, low, top), (end, high, top), (x, high, z)])]
        count = math.ceil(rise_m / _RISER_M)
        faces = []
        for k in range(count):
            a, b = x + length_m * k / count, x + length_m * (k + 1) / count
            below, above = z + rise_m * k / count, z + rise_m * (k + 1) / count
            faces += [_level((a, low), (b, high), below), _upright((b, low), (b, high), below, above)]
        return faces

    def cabin(self, shut: bool) -> Mesh:
        """The cabin of a lift, on the level of a floor."""
        x, y = self.door_m
        half, height_m, door = 0.5 * _CABIN_M, 2.2, 0.5 * _DOOR_M
        sides = [
            _upright((x, y - half), (x + _CABIN_M, y - half), 0.0, height_m),
            _upright((x, y + half), (x + _CABIN_M, y + half), 0.0, height_m),
            _upright((x + _CABIN_M, y - half), (x + _CABIN_M, y + half), 0.0, height_m),
            _upright((x, y - half), (x, y - door), 0.0, height_m),
            _upright((x, y + door), (x, y + half), 0.0, height_m),
            _level((x, y - half), (x + _CABIN_M, y + half), 0.0),
            _level((x, y - half), (x + _CABIN_M, y + half), height_m),
        ]
        if shut:
            sides.append(_upright((x, y - door), (x, y + door), 0.0, height_m))
        return quads(np.array(sides))


def _door_row(free: NDArray[np.bool_], column: int, cell_m: float, half: int, robot_m: float) -> int:
    """The row of the middle of a door in the wall behind a column: a wide place that the robot reaches."""
    clearance = clearance_m(free, cell_m)
    labels, _ = ndimage.label(clearance >= robot_m, np.ones((3, 3), bool))
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    inside = column - round(_INSIDE_M / cell_m)
    margin = round((_LANE_M + _SPINE_M) / cell_m) + 2
    rows = [row for row in range(margin, len(free) - margin) if labels[row, inside] == np.argmax(sizes)]
    if not rows:
        raise ConfigError("no room for a shaft at the eastern wall", hint="choose another --building-seed")
    return max(rows, key=lambda row: (float(clearance[row, inside]), -abs(row - len(free) // 2)))


def _upright(a: tuple[float, float], b: tuple[float, float], low: float, high: float) -> F64:
    return np.array([(*a, low), (*b, low), (*b, high), (*a, high)])


def _level(a: tuple[float, float], b: tuple[float, float], z: float) -> F64:
    return np.array([(a[0], a[1], z), (b[0], a[1], z), (b[0], b[1], z), (a[0], b[1], z)])


@dataclass(frozen=True, slots=True)
class HouseSession:
    """A session in a house, as `pc2grid.simulate.session.Session` is one on a single floor.

    clutter : of all floors; scenes : what the rays hit, by the numbers in `drive.scene`.
    """

    sensor: Sensor
    house: House
    clutter: tuple[Furniture, ...]
    scenes: tuple[Mesh, ...]
    drive: SpatialDrive
    odometry: SimulatedOdometry | None
    config: SimulationConfig

    @property
    def scan_count(self) -> int:
        """Whole scans from start to end of the drive."""
        return max(int(self.drive.duration_s * self.sensor.rate_hz), 1)

    def floor_at(self, time_s: float) -> int:
        """The true floor; on stairs and in a lift the one that it was entered from or left to."""
        return self.drive.of_sample(self.drive.floor, time_s)

    def pose(self, time_s: float) -> F64:
        """T_house_base (4, 4), z = 0 on floor 0; in a lift z is that of the floor it left or reaches."""
        T = self.drive.pose(time_s)
        if self.house.config.ride == "lift":
            T[2, 3] = self.floor_at(time_s) * self.house.config.storey_m
        return T

    def in_space(self, pose: SE2, time_s: float) -> F64:
        """Odometry of wheels is planar."""
        return pose.lift()

    def readings(self) -> Iterator[Reading]:
        """Cast all scans, several in a call; each ray starts at the robot's pose at the time of the ray."""
        sensor = self.sensor
        T = sensor.T_base_sensor
        directions = sensor.directions @ T[:3, :3].T
        batch = max(RAYS_PER_CAST // len(directions), 1)
        seen, scene = -1, None
        first = 0
        while first < self.scan_count:
            number = self.drive.of_sample(self.drive.scene, first / sensor.rate_hz)
            end = first + 1
            while (
                end < min(first + batch, self.scan_count)
                and self.drive.of_sample(self.drive.scene, end / sensor.rate_hz) == number
            ):
                end += 1
            if number != seen or scene is None:
                seen, scene = number, Scene(self.scenes[number])
            indices = np.arange(first, end)
            times_s = indices[:, None] / sensor.rate_hz + sensor.offsets_s
            rays = _rays(*self.drive.at(times_s), T[:3, 3], directions)
            true_m = scene.cast(rays.reshape(-1, 6)).reshape(times_s.shape)
            for index, ranges in zip(indices.tolist(), true_m, strict=True):
                rng = np.random.default_rng([self.config.seed, _NOISE, index])
                yield Reading(index, index / sensor.rate_hz, sensor.measure(ranges, rng))
            first = end

    @property
    def imu(self) -> None:
        """There is none."""
        return

    def scan(self, reading: Reading) -> Scan:
        """A reading as the scan that `pc2grid.io` decodes from the recording."""
        return scan_of(reading, self.sensor, self.odometry)

    def scans(self) -> Iterator[tuple[Scan, F64]]:
        """Scans in the base frame, not deskewed, with the true T_house_base (4, 4) at their stamps."""
        for reading in self.readings():
            yield self.scan(reading), self.pose(reading.time_s)


def _rays(where_m: F64, rotation: F64, mount_m: F64, directions: F64) -> F32:
    """Rays (S, R, 6) from base positions (S, R, 3) and rotations (S, R, 3, 3)."""
    rays = np.empty((*where_m.shape[:2], 6), np.float32)
    rays[..., :3] = where_m + rotation @ mount_m
    rays[..., 3:] = np.einsum("srij,rj->sri", rotation, directions)
    return rays


def prepare_house_session(
    *, sensor: SensorKind, house: HouseConfig, config: SimulationConfig | None = None
) -> HouseSession:
    """Place the clutter of each floor, plan the drive through the house and compute its odometry.

    `config.length_m` is driven on each floor, before the robot returns to the shaft.
    Raises ConfigError if the house has no room for the robot or the shaft.
    """
    config = config or SimulationConfig()
    built = House.of(office_floorplan(config.building_seed), house, config.drive.clearance_m)

    def stream(*numbers: int) -> np.random.Generator:
        return np.random.default_rng([config.seed, *numbers])

    clutter = _clutter(built, config)
    planar = drive_along(_route(built, clutter, config, stream), config.drive, stream(_DRIVE))
    drive = _by_stairs(planar, built) if house.ride == "stairs" else _by_lift(planar, built)
    return HouseSession(
        make_sensor(sensor, config),
        built,
        tuple(piece for floor in clutter.values() for piece in floor),
        _scenes(built, clutter, config.wall_height_m),
        drive,
        _odometry(drive, config, stream(_ODOMETRY)),
        config,
    )


def _clutter(built: House, config: SimulationConfig) -> dict[int, tuple[Furniture, ...]]:
    """What stands on each floor that is visited; the way to the shaft is kept free."""
    house, (x, y) = built.config, built.door_m
    seed = config.seed if house.furniture_seed is None else house.furniture_seed
    clear_m = (built.inside_m, (x, y), (x + 0.5 * _LANDING_M, y - 0.7), (x + 0.5 * _LANDING_M, y + 0.7))
    return {
        floor: place_clutter(
            built.plan,
            config.clutter,
            np.random.default_rng([seed, _CLUTTER, 0 if house.alike else floor]),
            robot_m=config.drive.clearance_m,
            keep_free_m=clear_m,
        )
        for floor in sorted(set(house.visits))
    }


def _route(
    built: House,
    clutter: dict[int, tuple[Furniture, ...]],
    config: SimulationConfig,
    stream: Callable[..., np.random.Generator],
) -> Route:
    """The way through the house: on each floor `config.length_m`, and back to the shaft."""
    robot_m, visits = config.drive.clearance_m, built.config.visits
    points: list[F64] = [np.array([built.inside_m])]
    turns: list[int] = []

    def append(line: F64, at: I64) -> None:
        """Add a line that begins where the last one ends; the robot turns in place there."""
        begin = sum(map(len, points)) - 1
        turns.extend([begin, *(begin + at).tolist()])
        points.append(line[1:])

    for number, floor in enumerate(visits):
        blocked = covered(built.plan, clutter[floor])
        if number:
            append(*built.way(up=floor > visits[number - 1]))
        route = plan_route(
            built.plan,
            blocked,
            config.length_m,
            start_m=built.inside_m,
            least_m=robot_m,
            rng=stream(_ROUTE, number),
        )
        append(np.concatenate(([built.inside_m], route.points_m)), route.turns + 1)
        if number + 1 < len(visits):
            end = (float(route.points_m[-1, 0]), float(route.points_m[-1, 1]))
            append(plan_way(built.plan, blocked, end, built.inside_m, robot_m), np.empty(0, np.int64))
    return Route(np.concatenate(points), np.unique([t for t in turns if t > 0]))


def _by_stairs(planar: Drive, house: House) -> SpatialDrive:
    visits = house.config.visits
    if any(abs(b - a) != 1 for a, b in pairwise(visits)):
        raise ConfigError(f"by stairs a floor leads to the next one, not {visits}")
    height_m, pitch_rad, floor = house.rises(planar, visits[0])
    return SpatialDrive(planar, height_m, pitch_rad, np.zeros_like(floor), floor)


def _by_lift(planar: Drive, house: House) -> SpatialDrive:
    """Adds the time of the rides. Scene 2 k is floor k, 2 k + 1 the shut cabin there."""
    visits, poses = house.config.visits, planar.poses
    middle = np.array([house.door_m[0] + 0.5 * _CABIN_M, house.door_m[1]])
    standing = np.linalg.norm(poses[:, :2] - middle, axis=1) < 0.03
    ends = np.flatnonzero(standing[:-1] & ~standing[1:])
    parts, scenes, floors, begin = [], [], [], 0
    for number, end in enumerate([*ends.tolist(), len(poses) - 1]):
        floor = visits[number]
        parts.append(poses[begin : end + 1])
        scenes.append(np.full(end + 1 - begin, 2 * floor))
        floors.append(np.full(end + 1 - begin, floor))
        begin = end + 1
        if number + 1 < len(visits):
            storeys = abs(visits[number + 1] - floor)
            for seconds, scene, at in (
                (_DOOR_S, 2 * floor, floor),
                (0.5 * _STOREY_S * storeys, 2 * floor + 1, floor),
                (0.5 * _STOREY_S * storeys + _DOOR_S, 2 * visits[number + 1] + 1, visits[number + 1]),
                (_DOOR_S, 2 * visits[number + 1], visits[number + 1]),
            ):
                count = round(seconds * RATE_HZ)
                parts.append(np.repeat(poses[end : end + 1], count, axis=0))
                scenes.append(np.full(count, scene))
                floors.append(np.full(count, at))
    # Rays are cast in the frame of the floor that is seen: each scene has its floor at z = 0.
    level = np.zeros(sum(map(len, parts)))
    return SpatialDrive(
        Drive(np.concatenate(parts)), level, level, np.concatenate(scenes), np.concatenate(floors)
    )


def _scenes(
    house: House, clutter: dict[int, tuple[Furniture, ...]], wall_height_m: float
) -> tuple[Mesh, ...]:
    shell = extrude(house.office, wall_height_m)
    floors = {
        floor: Mesh.join([shell, *(piece.mesh() for piece in pieces)]) for floor, pieces in clutter.items()
    }
    if house.config.ride == "stairs":
        raised = [
            _raised(shell, k * house.config.storey_m) for k in range(house.config.storeys) if k not in floors
        ]
        raised += [_raised(mesh, floor * house.config.storey_m) for floor, mesh in floors.items()]
        return (Mesh.join([*raised, house.stairs()]),)
    empty = Mesh.join([])
    return tuple(
        Mesh.join([floors[floor], house.cabin(shut)]) if floor in floors else empty
        for floor in range(max(floors) + 1)
        for shut in (False, True)
    )


def _raised(mesh: Mesh, height_m: float) -> Mesh:
    T = np.eye(4)
    T[2, 3] = height_m
    return Mesh(transform_points(T, mesh.vertices_m).astype(np.float32), mesh.triangles)


def _odometry(
    drive: SpatialDrive, config: SimulationConfig, rng: np.random.Generator
) -> SimulatedOdometry | None:
    """Wheels measure the distance along a slope, not in the plan."""
    if not config.odometry.enabled:
        return None
    poses = drive.planar.poses.copy()
    steps = np.diff(poses[:, :2], axis=0) / np.cos(drive.pitch_rad[1:, None])
    poses[1:, :2] = poses[0, :2] + np.cumsum(steps, axis=0)
    return odometry_of(Drive(poses), config.odometry, rng)
