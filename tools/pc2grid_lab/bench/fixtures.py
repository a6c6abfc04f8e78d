"""Inputs of any size, made from seeds: recordings, maps, databases."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from pc2grid.arrays import F32
from pc2grid.clouds.deskew import deskew
from pc2grid.clouds.ground import assumed_ground
from pc2grid.clouds.planar_scan import PlanarScan, project_to_plane
from pc2grid.geometry import SE2
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import OccupancyGrid, Scan, SessionMap, Submap, Trajectory
from pc2grid.simulate import SimulationConfig, office_floorplan, prepare_session, simulate_session
from pc2grid.simulate.config import LidarConfig
from pc2grid.submaps.partition import partition
from signature.config import Config
from signature.database.maintenance import store
from signature.describe import Signature, describe
from signature.localization.localizer import MapIndex
from signature.localization.query import QueryMap, query_of
from signature.sessions import provenance
from signature.similarity import SignatureTable

SPARSE = LidarConfig(beams=8, columns=240, rate_hz=5.0)
"""A lidar with few points a scan, for long recordings."""


def data_file(name: str) -> Path | None:
    """A file of the real recordings in the folder PC2GRID_DATA; None if it is not there."""
    path = Path(os.environ.get("PC2GRID_DATA", "")) / name
    return path if os.environ.get("PC2GRID_DATA") and path.exists() else None


def lidar_log(path: Path, length_m: float, *, seed: int = 0, lidar: LidarConfig | None = None) -> int:
    """Write a recording of a drive through the office; returns how many scans it has."""
    config = SimulationConfig(length_m=length_m, seed=seed, lidar=lidar or LidarConfig())
    return simulate_session(path, sensor="lidar", config=config).scans


def huge_log(path: Path, size_bytes: int, message_bytes: int = 16_000_000) -> None:
    """Write an indexed MCAP of clouds whose points are zero. The zeros use no space on the disk."""
    points = message_bytes // 16
    name, store = "sensor_msgs/msg/PointCloud2", get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "lidar")
    fields = [types["sensor_msgs/msg/PointField"](axis, 4 * i, 7, 1) for i, axis in enumerate("xyz")]
    zeros = np.zeros(16 * points, np.uint8)
    cloud = types[name](header, 1, points, fields, False, 16, 16 * points, zeros, False)
    message = bytes(store.serialize_cdr(cloud, name))
    with path.open("wb") as file:
        writer = Writer(_Sparse(file), compression=CompressionType.NONE, enable_crcs=False)
        writer.start(profile="ros2", library="bench")
        definition, _ = store.generate_msgdef(name, ros_version=2)
        schema = writer.register_schema(name=name, encoding="ros2msg", data=definition.encode())
        channel = writer.register_channel(topic="/points", message_encoding="cdr", schema_id=schema)
        for k in range(size_bytes // len(message)):
            stamp_ns = 100_000_000 * (k + 1)
            writer.add_message(channel, log_time=stamp_ns, publish_time=stamp_ns, data=message)
        writer.finish()


class _Sparse:
    """A file in which zeros at the end of a write become a hole."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def write(self, data: bytes) -> int:
        content = data.rstrip(b"\0")
        self._file.write(content)
        self._file.seek(len(data) - len(content), 1)
        return len(data)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


@dataclass(frozen=True, slots=True)
class PosedScan:
    """One scan of a drive with its true pose: the planar scan, and the points in the map frame."""

    T_map_base: SE2
    stamp_ns: int
    planar_scan: PlanarScan
    points_m: F32


def drive(
    length_m: float, *, seed: int, start_m: tuple[float, float] | None = None, every: int = 3
) -> Iterator[PosedScan]:
    """A lidar's drive through the office with true poses; every third scan, which are 0.2 m apart.

    start_m : (x, y) in the plan; None for a random place.
    """
    config = SimulationConfig(length_m=length_m, seed=seed, start_m=start_m)
    last: tuple[Scan, SE2] | None = None
    for count, (scan, truth) in enumerate(prepare_session(sensor="lidar", config=config).scans()):
        if last is not None and count % every == 0:
            motion = (last[1].inverse() @ truth).lift()
            assert scan.offsets_s is not None
            points = deskew(scan.points_m, scan.offsets_s, motion, (scan.stamp_ns - last[0].stamp_ns) * 1e-9)
            planar_scan = project_to_plane(
                points,
                stamp_ns=scan.stamp_ns,
                sensor_m=scan.T_base_sensor[:3, 3],
                ground=assumed_ground(scan.T_base_sensor),
                config=Config().projection,
            )
            T = truth.lift()
            yield PosedScan(
                truth, scan.stamp_ns, planar_scan, (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
            )
        last = scan, truth


def grid_of(scans: Iterable[PosedScan]) -> OccupancyGrid:
    """The map of a drive."""
    builder = GridBuilder(Config().projection)
    for scan in scans:
        builder.add(scan.planar_scan, scan.T_map_base)
    return builder.grid()


def query_map(scans: Sequence[PosedScan], config: Config, grid: OccupancyGrid | None = None) -> QueryMap:
    """What a robot has seen on a drive, in the map frame, described like a query.

    grid : the result of `grid_of` if it is known already.
    """
    return query_of(
        grid or grid_of(scans),
        np.array([(scan.T_map_base.x, scan.T_map_base.y) for scan in scans]),
        config,
        config.relocalize,
        scans[-1].T_map_base,
    )


def index_of(grid: OccupancyGrid, config: Config) -> MapIndex:
    """The map index of one session."""
    submaps = partition(grid, config.partition)
    table = SignatureTable.of(
        [describe(submap, config.signature) for submap in submaps],
        [submap.center_m for submap in submaps],
        submap_id=[submap.submap_id for submap in submaps],
    )
    return MapIndex({"office": grid}, table, config, config)


def office(seed: int, side: int = 1) -> OccupancyGrid:
    """side x side office floors side by side, all of them different."""
    rows = [
        np.hstack([office_floorplan(seed + side * r + c).cells for c in range(side)]) for r in range(side)
    ]
    return OccupancyGrid(cells=np.vstack(rows), resolution_m=0.05, origin_m=(0.0, 0.0))


def many_signatures(count: int, config: Config) -> SignatureTable:
    """Signatures similar to those of real places: those of office floors, mixed and disturbed at random.

    Uniform noise cannot be used, because all its rows have about the same distance from each other.
    """
    real = [
        describe(submap, config.signature)
        for seed in range(2)
        for submap in partition(office_floorplan(seed), config.partition)
    ]
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, len(real), (2, count))
    share = rng.random((count, 1), np.float32)

    def mixed(name: str, spread: float) -> F32:
        rows = np.stack([getattr(signature, name) for signature in real])
        out = np.empty((count, rows.shape[1]), np.float32)
        for k in range(0, count, 100_000):
            s = np.s_[k : k + 100_000]
            out[s] = share[s] * rows[first[s]] + (1 - share[s]) * rows[second[s]]
            out[s] *= np.exp(spread * rng.standard_normal(out[s].shape, np.float32))
            if name != "symmetry":
                out[s] /= np.maximum(out[s].sum(axis=1, keepdims=True), 1e-9)
        return out

    return SignatureTable(
        boundary=mixed("boundary", 0.15),
        freespace=mixed("freespace", 0.15),
        symmetry=mixed("symmetry", 0.1),
        session_index=np.zeros(count, np.int32),
        submap_id=np.arange(count, dtype=np.int32),
        center_m=np.zeros((count, 2)),
    )


def large_database(path: Path, table: SignatureTable, sessions: int, config: Config) -> None:
    """Write a table as a database of `sessions` sessions. The grids of the submaps are two cells wide."""
    grid = OccupancyGrid(cells=np.zeros((2, 2), np.int8), resolution_m=0.05, origin_m=(0.0, 0.0))
    empty = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    origin = provenance(Path("bench"), "0" * 64, config)
    each = len(table) // sessions
    parts = tuple(
        Submap(submap_id=i, center_m=(0.0, 0.0), radius_m=config.partition.radius_m, grid=grid)
        for i in range(each)
    )
    entries = []
    for s in range(sessions):
        signatures = [signature_of(table, s * each + i) for i in range(each)]
        session = SessionMap(session=f"s{s}", sensor="map", grid=grid, submaps=parts, trajectory=empty)
        entries.append((session, signatures, origin))
    store(path, entries, keep=False)


def floors(path: Path, count: int, copies: int, config: Config) -> tuple[int, float]:
    """Write a database of `count` office floors, each of them `copies` times under different names.

    Returns the number of sessions and their free area in square metres.
    """
    still = Trajectory(stamps_ns=np.empty(0, np.int64), T_session_base=np.empty((0, 4, 4)))
    origin, entries, area_m2 = provenance(Path("bench"), "0" * 64, config), [], 0.0
    for seed in range(count):
        grid = office_floorplan(seed)
        submaps = partition(grid, config.partition)
        signatures = [describe(submap, config.signature) for submap in submaps]
        for copy in range(copies):
            name = f"s{seed}" if copy == 0 else f"s{seed}copy{copy}"
            made = SessionMap(session=name, sensor="map", grid=grid, submaps=submaps, trajectory=still)
            entries.append((made, signatures, origin))
            area_m2 += grid.free_m2
    store(path, entries, keep=False)
    return len(entries), area_m2


def signature_of(table: SignatureTable, row: int) -> Signature:
    """One row of a table."""
    return Signature(
        boundary=table.boundary[row], freespace=table.freespace[row], symmetry=table.symmetry[row]
    )
