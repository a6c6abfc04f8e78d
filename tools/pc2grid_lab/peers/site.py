"""A building as all peers get it: a map of one part of a recording, and later parts as queries.

The map is drawn at the true poses, so that the decision is measured and not mapping. The queries are
registered as a user's would be; every peer gets the registered poses as its odometry, which is better than
that of wheels.

A site is a folder: `map.yaml` and `map.png` (nav2), `map.npz` (clouds along the path, of a lidar only) and
`queries/NN.*`: `.json` (the truth), `.pickle` (registered planar scans), `.ranges.npz` (the beams of a laser)
or `.cloud.npz` (the points of a lidar).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pc2grid.errors import ConfigError, LogNotFound
from pc2grid.geometry import F32, F64, SE2, transform_points
from pc2grid.io import Log, open_log
from pc2grid.io.maps import load_map, save_map
from pc2grid.io.trajectory import read_tum
from pc2grid.mapping.occupancy import GridBuilder
from pc2grid.model import SENSOR_MODELS, OccupancyGrid, RegisteredScan, Scan, SensorKind
from pc2grid.pipeline import follow
from pc2grid.simulate import Session, load_building, prepare_session
from pc2grid_lab.experiments.program import write_arrays, write_text
from pc2grid_lab.experiments.recordings.catalogue import drive_config
from pc2grid_lab.experiments.registered_session import register
from pc2grid_lab.experiments.sensor_matrix import MAP_SEED, start_on
from pc2grid_lab.experiments.trial import JUDGEMENT
from pc2grid_lab.experiments.truth import apart, nearest
from signature.config import Config


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteParameters:
    """How maps and queries are cut from recordings. All chosen by hand, before any peer was run.

    mapped : share of a recording that becomes the map, unless its seconds are given.
    query_s : a query lasts at most so long, and at most this share (`query_share`) of what is not mapped.
    gap : seconds between map and first query, as a share of the longest query.
    keyframe_m, keyframe_rad : a scan of the map is used if the robot has moved or turned so far; of a lidar,
        which sees all around, after `lidar_keyframe_m`.
    cloud_voxel_m : edge of the voxels that clouds are thinned to; each matcher thins further as it needs.
    near_m : a query is covered if the share `JudgementParameters.mapped` of its last planar scan lies so near
        to a wall of the map. Only covered queries have a right answer.
    map_length_m : driven in a 3D scan for a map of it, as by `compare recordings`.
    """

    mapped: float = 0.55
    query_s: float = 60.0
    query_share: float = 0.25
    gap: float = 1.0 / 30.0
    keyframe_m: float = 0.15
    lidar_keyframe_m: float = 0.5
    keyframe_rad: float = 0.1
    cloud_voxel_m: float = 0.1
    near_m: float = 0.2
    map_length_m: float = 150.0


SITE = SiteParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteQuery:
    """What a query is judged by.

    pose : true x, y, yaw of the base in the map at the last scan. covered : the map shows what was seen
        there. travel_m : metres driven.
    """

    pose: tuple[float, float, float]
    covered: bool
    travel_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A prepared building. folder : where its files are."""

    name: str
    sensor: SensorKind
    folder: Path

    @property
    def planar(self) -> bool:
        """Whether its sensor is a 2D laser."""
        return SENSOR_MODELS[self.sensor].planar

    @property
    def map_stem(self) -> Path:
        """`map.yaml`, `map.png` and, of a lidar, `map.npz` without their suffixes."""
        return self.folder / "map"

    def stem(self, number: int) -> Path:
        """The files of a query without their suffixes."""
        return self.folder / "queries" / f"{number:02d}"

    def queries(self) -> dict[int, SiteQuery]:
        """All queries by their numbers."""
        files = sorted((self.folder / "queries").glob("*.json"))
        return {int(file.stem): SiteQuery(**json.loads(file.read_text())) for file in files}


PosedScan = tuple[Scan, F64 | None]
"""A scan with its true pose T_world_base (4, 4)."""


def truth_file(log: Path) -> Path:
    """The true poses beside a recording: `NAME.tum` or `NAME_corrected.tum`.

    Raises LogNotFound if there is neither.
    """
    for file in (log.with_suffix(".tum"), log.with_name(f"{log.stem}_corrected.tum")):
        if file.is_file():
            return file
    raise LogNotFound(
        f"{log}: no true poses beside it", hint=f"put them into {log.stem}.tum, stamped as the scans"
    )


def recorded_site(
    log: Path,
    folder: Path,
    config: Config,
    *,
    queries: int,
    travel_m: float,
    mapped_s: float | None = None,
    of_base: bool = False,
) -> Site:
    """The site of a recording with true poses beside it. What exists in `folder` is not made again.

    queries : how many, evenly spread over what is not mapped; fewer where it has fewer scans.
    mapped_s : seconds from the start that become the map; None: `SiteParameters.mapped` of all.
    of_base : the true poses are of the base, not of the sensor.

    Raises ConfigError if nothing is left to locate, and what `open_log` and `read_tum` do.
    """
    with open_log(log, config.read) as opened:
        end_s = (opened.info.end_ns - opened.info.start_ns) * 1e-9
        mapped_s = mapped_s if mapped_s is not None else SITE.mapped * end_s
        longest_s = min(SITE.query_s, SITE.query_share * (end_s - mapped_s))
        if longest_s <= 0.0:
            raise ConfigError(
                f"{log}: nothing is left to locate after {mapped_s:g} s; it lasts {end_s:.1f} s",
                hint=f"for example --mapped {log.stem}={end_s / 2:.0f}",
            )
        site = Site(name=log.stem, sensor=opened.choose().sensor, folder=folder)
        truth = read_tum(truth_file(log))

        def posed(start_s: float, duration_s: float) -> Iterator[PosedScan]:
            for scan in opened.scans(start_s, duration_s):
                (i,) = nearest(truth.stamps_ns, np.array([scan.stamp_ns]))
                T = None if i < 0 else truth.T_session_base[i]
                yield scan, T if T is None or of_base else T @ np.linalg.inv(scan.T_base_sensor)

        _save_map(site, posed(0.0, mapped_s), config)
        starts_s = np.linspace(mapped_s + SITE.gap * longest_s, end_s - longest_s, queries)
        for number, start_s in enumerate(_distinct(opened, starts_s.tolist())):
            _save_query(site, number, posed(start_s, longest_s), config, travel_m)
    return site


def simulated_site(
    building_file: Path, folder: Path, config: Config, *, queries: int, travel_m: float
) -> Site:
    """The site of a lidar that is simulated in a real 3D scan of a building (PLY, PCD or a mesh)."""
    building = load_building(building_file)
    site = Site(name=building_file.stem, sensor="lidar", folder=folder)

    def driven(length_m: float, seed: int, start_m: tuple[float, float] | None = None) -> Session:
        simulation = drive_config(length_m, seed, start_m)
        return prepare_session(sensor="lidar", grid=building, config=simulation)

    def posed(session: Session) -> Iterator[PosedScan]:
        return ((scan, truth.lift()) for scan, truth in session.scans())

    mapping = driven(SITE.map_length_m, MAP_SEED)
    _save_map(site, posed(mapping), config)
    for number in range(queries):
        start_m = start_on(mapping.drive, number + 1)
        _save_query(site, number, posed(driven(travel_m + 3.0, number + 1, start_m)), config, travel_m)
    return site


def _distinct(log: Log, starts_s: Iterable[float]) -> list[float]:
    """The starts, without those that begin with the same scan as an earlier one."""
    by_scan = {next(iter(log.scans(start_s))).stamp_ns: start_s for start_s in reversed([*starts_s])}
    return sorted(by_scan.values())


def _save_map(site: Site, scans: Iterable[PosedScan], config: Config) -> None:
    """Draw the grid at the true poses and, of a lidar, keep the clouds; unless there is a map."""
    if site.map_stem.with_suffix(".yaml").exists():
        return
    builder = GridBuilder(config.projection)
    path, clouds = [], []
    for scan, T_world_base in _keyframes(site, scans):
        ((registered, planar_scan),) = follow([scan], config)
        builder.add(planar_scan, SE2.from_matrix(T_world_base))
        path.append(T_world_base)
        clouds.append(_thinned(transform_points(T_world_base, registered.scan.points_m)))
    grid = builder.grid()
    site.folder.mkdir(parents=True, exist_ok=True)
    if not site.planar:
        write_arrays(
            site.map_stem.with_suffix(".npz"),
            T_map_base=np.array(path),
            points_m=np.concatenate(clouds),
            count=[len(c) for c in clouds],
        )
    save_map(grid, site.map_stem, image_format="png")  # last: it says that the map is complete


def _keyframes(site: Site, scans: Iterable[PosedScan]) -> Iterator[tuple[Scan, F64]]:
    """The scans with a true pose between which the robot has moved or, with a laser, turned."""
    step_m, last = SITE.keyframe_m if site.planar else SITE.lidar_keyframe_m, None
    for scan, T_world_base in scans:
        if T_world_base is None:
            continue
        pose = SE2.from_matrix(T_world_base)
        metres, radians = (math.inf, math.inf) if last is None else apart(last, pose)
        if metres >= step_m or (site.planar and radians >= SITE.keyframe_rad):
            last = pose
            yield scan, T_world_base


def _save_query(site: Site, number: int, scans: Iterable[PosedScan], config: Config, travel_m: float) -> None:
    """Register a query and keep what the peers need of it, unless it exists; without a true pose, nothing."""
    stem = site.stem(number)
    if stem.with_suffix(".json").exists():
        return
    stem.parent.mkdir(parents=True, exist_ok=True)
    seen: list[RegisteredScan] = []
    posed = ((scan, None if T is None else SE2.from_matrix(T)) for scan, T in scans)
    session = register(posed, config, sensor=site.sensor, until_m=travel_m, see=seen.append)
    if np.isnan(session.T_world_base[:, 0]).all():
        return
    truth = session.T_world_odom() @ SE2(*session.T_odom_base[-1].tolist())
    session.save(stem.with_suffix(".pickle"))
    if site.planar:
        save_beams(stem.with_suffix(".ranges.npz"), [registered.scan for registered in seen])
    else:
        T_query_odom = np.linalg.inv(seen[-1].T_session_base)
        cloud = [transform_points(T_query_odom @ r.T_session_base, r.scan.points_m) for r in seen]
        write_arrays(stem.with_suffix(".cloud.npz"), points_m=_thinned(np.concatenate(cloud)))
    # What registration made of the scans before must not decide which queries count.
    ((_, alone),) = follow([seen[-1].scan], config)
    grid = load_map(site.map_stem.with_suffix(".yaml"))
    query = SiteQuery(
        pose=(truth.x, truth.y, truth.yaw),
        covered=is_covered(grid, truth.apply(alone.hits_m)),
        travel_m=float(session.path_m()[-1]),
    )
    write_text(stem.with_suffix(".json"), json.dumps(asdict(query)))  # last: the query is complete


def is_covered(grid: OccupancyGrid, hits_m: F64) -> bool:
    """Whether a map shows the walls (M, 2), in its frame, that the last scan of a query has seen."""
    walls_m = grid.to_point(np.argwhere(grid.occupied))
    if not len(hits_m) or not len(walls_m):
        return False
    distance_m, _ = cKDTree(walls_m).query(hits_m)
    return float(np.mean(distance_m <= SITE.near_m)) >= JUDGEMENT.mapped


def save_beams(path: Path, scans: list[Scan]) -> None:
    """Write the ranges of a 2D laser, one row a scan, for beams that are evenly spread.

    `ranges_m` (N, B), infinite where nothing came back; `fov_rad` from the first beam to the last;
    `T_base_middle` (4, 4), a frame in the sensor whose x axis is in the middle of them. The
    bearings of the beams are found from the points that a `Scan` holds.
    """
    T_base_sensor = scans[0].T_base_sensor
    T_sensor_base = np.asarray(np.linalg.inv(T_base_sensor), np.float64)
    points_m = [transform_points(T_sensor_base, scan.points_m) for scan in scans]
    bearings_rad = [np.arctan2(p[:, 1], p[:, 0]) for p in points_m]
    step_rad = float(np.median(np.diff(np.sort(max(bearings_rad, key=len)))))
    first_rad, last_rad = (f(np.concatenate(bearings_rad)) for f in (np.min, np.max))
    beams = round((last_rad - first_rad) / step_rad) + 1
    rows = np.full((len(scans), beams), np.inf, np.float32)
    for row, bearing_rad, p in zip(rows, bearings_rad, points_m, strict=True):
        row[np.rint((bearing_rad - first_rad) / step_rad).astype(int)] = np.hypot(p[:, 0], p[:, 1])
    T_sensor_middle = SE2(0.0, 0.0, float(first_rad + last_rad) / 2.0).lift()
    write_arrays(
        path,
        ranges_m=rows,
        fov_rad=float(last_rad - first_rad),
        T_base_middle=T_base_sensor @ T_sensor_middle,
    )


def _thinned(points_m: F64) -> F32:
    """One point for each voxel."""
    voxels = np.floor(points_m / SITE.cloud_voxel_m).astype(np.int32)
    _, first = np.unique(voxels, axis=0, return_index=True)
    return points_m[np.sort(first)].astype(np.float32)
