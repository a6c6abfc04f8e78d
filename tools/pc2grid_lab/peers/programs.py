"""`pc2grid compare peers`: other programs that locate a robot, with the same maps and queries.

A site is a building as all programs get it: a map of one part of a recording, and later parts as queries. The
map is drawn at the true poses, so that the decision is measured and not mapping. The queries are registered
as a user's would be; every program gets the registered poses as its odometry, which is better than that of
wheels. A site is a folder: `map.yaml` and `map.png` (nav2), `map.npz` (clouds along the path, of a lidar
only) and `queries/NN.*`: `.json` (the truth), `.pickle` (registered planar scans), `.ranges.npz` (the beams
of a laser) or `.cloud.npz` (the points of a lidar).

MapClosures and KISS-Matcher need other versions of libraries than pc2grid, so they live in a virtual
environment of their own. Open3D and pc2grid are in this one.

MRPT's particle filter is as Debian installs it (`apt-get install mrpt-apps`). `ros-map-yaml2mrpt` converts
the map, `carmen2rawlog` the scans with the odometry, and `pf-localization` tells the mean pose and its spread
after each scan on its standard output. It seeds itself by the clock, so its answers differ a little from run
to run.

`python programs.py NAME MAP_STEM ANSWERS.json QUERY_STEM...` asks pc2grid or the particle filter.

pc2grid decides by itself whether it answers. The others give an answer and a score. Their threshold is chosen
on these very answers, which is more than a user could do: it is the one with the most right answers less the
wrong ones, in the own building and in another one. So the comparison is in favour of the others.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal, TypeVar

import numpy as np

from pc2grid.errors import ConfigError, LogNotFound, Pc2GridError
from pc2grid.estimation.line_map import TRACKING
from pc2grid.estimation.tracker import follow
from pc2grid.geometry import F32, F64, SE2, transform_points
from pc2grid.grids.occupancy import GridBuilder
from pc2grid.io.atomic import replace_file
from pc2grid.io.building_file import is_building_file
from pc2grid.io.maps import load_map, save_map
from pc2grid.io.recording import Log, open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.matching.icp_in_space import REGISTRATION
from pc2grid.model import SENSOR_MODELS, RegisteredScan, Scan, SensorKind
from pc2grid.simulate import Session, load_building, prepare_session
from pc2grid_cli.console import Console, json_text, warn
from pc2grid_cli.output import make_folder
from pc2grid_lab.commands import ComparePeers
from pc2grid_lab.pages import Cell, clopper_pearson, print_cells
from pc2grid_lab.peers.cloud_matchers import PoseAndScore, serve, thinned
from pc2grid_lab.recordings.catalogue import MAP_DRIVE, beginning_s, drive_config
from pc2grid_lab.recordings.judging import known_share
from pc2grid_lab.runner import (
    BACK,
    FRONT,
    LABORATORY,
    digest_of_sources,
    keep,
    kept,
    names_of,
    run,
    write_text,
)
from pc2grid_lab.sensors import RegisteredSession, index_of, register, start_on
from pc2grid_lab.truth import JUDGEMENT, apart, is_right, nearest
from signature.config import Config
from signature.localization.localizer import Localizer
from signature.sessions import digest_of


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteParameters:
    """How maps and queries are cut from recordings. All chosen by hand, before any peer was run.

    query_s : a query lasts at most so long, and at most this share (`query_share`) of what is not mapped.
    gap : seconds between map and first query, as a share of the longest query.
    """

    query_s: float = 60.0
    query_share: float = 0.25
    gap: float = 1.0 / 30.0


SITE = SiteParameters()


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteQuery:
    """What a query is judged by.

    pose : true x, y, yaw of the base in the map at the last scan. covered : the map shows what was seen
        there.
    """

    pose: tuple[float, float, float]
    covered: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A prepared building. folder : where its files are."""

    name: str
    sensor: SensorKind
    folder: Path

    @property
    def planar(self) -> bool:
        """Return whether its sensor is a 2D laser."""
        return SENSOR_MODELS[self.sensor].planar

    @property
    def map_stem(self) -> Path:
        """Return `map.yaml`, `map.png` and, of a lidar, `map.npz` without their suffixes."""
        return self.folder / "map"

    def stem(self, number: int) -> Path:
        """Return the files of a query without their suffixes."""
        return self.folder / "queries" / f"{number:02d}"

    def queries(self) -> dict[int, SiteQuery]:
        """Return all queries by their numbers."""
        files = sorted((self.folder / "queries").glob("*.json"))
        return {int(file.stem): SiteQuery(**json.loads(file.read_text())) for file in files}


PosedScan = tuple[Scan, F64 | None]
"""A scan with its true pose T_world_base (4, 4)."""


def truth_file(log: Path) -> Path:
    """Return the file of the true poses beside a recording: `NAME.tum` or `NAME_corrected.tum`.

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
    """Prepare the site of a recording with true poses beside it. What exists in `folder` is not made again.

    queries : how many, evenly spread over what is not mapped; fewer where it has fewer scans.
    mapped_s : seconds from the start that become the map; None: as of one's own by `compare recordings`.
    of_base : the true poses are of the base, not of the sensor.

    Raises ConfigError if nothing is left to locate, and what `open_log` and `read_tum` do.
    """
    with open_log(log, config.read) as opened:
        end_s = (opened.info.end_ns - opened.info.start_ns) * 1e-9
        mapped_s = beginning_s(end_s) if mapped_s is None else mapped_s
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
    """Prepare the site of a lidar that is simulated in a real 3D scan of a building (PLY, PCD or a mesh)."""
    building = load_building(building_file)
    site = Site(name=building_file.stem, sensor="lidar", folder=folder)

    def driven(length_m: float, seed: int, start_m: tuple[float, float] | None = None) -> Session:
        simulation = drive_config(length_m, seed, start_m)
        return prepare_session(sensor="lidar", grid=building, config=simulation)

    def posed(session: Session) -> Iterator[PosedScan]:
        return ((scan, truth.lift()) for scan, truth in session.scans())

    mapping = driven(MAP_DRIVE.length_m, MAP_DRIVE.seed)
    _save_map(site, posed(mapping), config)
    for k in range(queries):
        start_m = start_on(mapping.drive, k + 1)
        _save_query(site, k, posed(driven(travel_m + 3.0, k + 1, start_m)), config, travel_m)
    return site


def _distinct(log: Log, starts_s: Iterable[float]) -> list[float]:
    """Return the starts, without those that begin with the same scan as an earlier one."""
    by_scan = {next(iter(log.scans(start_s))).stamp_ns: start_s for start_s in reversed([*starts_s])}
    return sorted(by_scan.values())


def _save_map(site: Site, scans: Iterable[PosedScan], config: Config) -> None:
    """Draw the grid at the true poses and, of a lidar, keep the clouds; unless there is a map."""
    if site.map_stem.with_suffix(".yaml").exists():
        return
    builder = GridBuilder(config.projection)
    path, clouds = [], []
    for scan, T_world_base in after_motion((scan, T) for scan, T in scans if T is not None):
        ((registered, planar_scan),) = follow([scan], config)
        builder.add(planar_scan, SE2.from_matrix(T_world_base))
        path.append(T_world_base)
        points_m = transform_points(T_world_base, registered.scan.points_m)
        clouds.append(thinned(points_m, REGISTRATION.voxel_m).astype(np.float32))
    grid = builder.grid()
    site.folder.mkdir(parents=True, exist_ok=True)
    if not site.planar:
        _write_arrays(
            site.map_stem.with_suffix(".npz"),
            T_map_base=np.array(path),
            points_m=np.concatenate(clouds),
            count=[len(c) for c in clouds],
        )
    save_map(grid, site.map_stem, image_format="png")  # last: it says that the map is complete


T = TypeVar("T")


def after_motion(posed: Iterable[tuple[T, F64]]) -> Iterator[tuple[T, F64]]:
    """Yield those with a pose (4, 4) after which the robot has moved or turned as far as a keyframe of the
    product needs."""
    p, last = TRACKING, None
    for one, pose in posed:
        step_m, step_rad = (math.inf, math.inf) if last is None else apart(last, SE2.from_matrix(pose))
        if step_m >= p.keyframe_travel_m or step_rad >= p.keyframe_turn_rad:
            last = SE2.from_matrix(pose)
            yield one, pose


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
    truth = session.T_world_odom() @ [*session.trajectory.poses()][-1]
    keep(stem.with_suffix(".pickle"), session)
    if site.planar:
        save_beams(stem.with_suffix(".ranges.npz"), [registered.scan for registered in seen])
    else:
        T_query_odom = np.linalg.inv(seen[-1].T_session_base)
        cloud = [transform_points(T_query_odom @ r.T_session_base, r.scan.points_m) for r in seen]
        _write_arrays(
            stem.with_suffix(".cloud.npz"),
            points_m=thinned(np.concatenate(cloud), REGISTRATION.voxel_m).astype(np.float32),
        )
    # What registration made of the scans before must not decide which queries count.
    ((_, alone),) = follow([seen[-1].scan], config)
    grid = load_map(site.map_stem.with_suffix(".yaml"))
    query = SiteQuery(
        pose=(truth.x, truth.y, truth.yaw),
        covered=known_share(grid, truth.apply(alone.hits_m)) >= JUDGEMENT.mapped,
    )
    write_text(stem.with_suffix(".json"), json.dumps(asdict(query)))  # last: the query is complete


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
    _write_arrays(
        path,
        ranges_m=rows,
        fov_rad=float(last_rad - first_rad),
        T_base_middle=T_base_sensor @ T_sensor_middle,
    )


def _write_arrays(path: Path, **arrays: Any) -> None:
    with replace_file(path) as draft, draft.open("wb") as file:
        np.savez(file, **arrays)


# --- the programs -------------------------------------------------------------------------------------

PINS = ("map-closures==2.2.0", "kiss-matcher==1.0.2")
"""The versions that the parameters of `cloud_matchers` were chosen for."""
ENVIRONMENT = Path(sys.prefix) / "peers"
"""The virtual environment of these two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerKind:
    """A program that can be run.

    sensors : whose recordings are its input. file : of this folder, which asks it. apart : whether it is in
    `ENVIRONMENT`.
    """

    name: str
    sensors: tuple[SensorKind, ...]
    file: str = "cloud_matchers.py"
    apart: bool = False

    @property
    def python(self) -> Path:
        """Return the interpreter of its environment."""
        return ENVIRONMENT / "bin" / "python" if self.apart else Path(sys.executable)


PEERS = (
    PeerKind(name="pc2grid", sensors=("laser", "lidar"), file="programs.py"),
    PeerKind(
        name="particle-filter",
        sensors=("laser",),
        file="programs.py",
    ),
    PeerKind(name="kiss-matcher", sensors=("lidar",), apart=True),
    PeerKind(name="map-closures", sensors=("lidar",), apart=True),
    PeerKind(name="fpfh-ransac", sensors=("lidar",)),
)


class PeerFailed(Pc2GridError):
    """A program has not answered."""


def how_to_install(kind: PeerKind) -> str | None:
    """Return the command that installs a program; None if it can be run."""
    if kind.name == "particle-filter" and not all(map(shutil.which, PROGRAMS)):
        return "apt-get install mrpt-apps"
    if kind.apart:
        imports = [str(kind.python), "-c", f"import {kind.name.replace('-', '_')}"]
        if not kind.python.exists() or subprocess.run(imports, check=False).returncode:
            return f"python -m venv {ENVIRONMENT} && {kind.python} -m pip install {' '.join(PINS)}"
    return None


def answers(kind: PeerKind, map_stem: Path, queries: Sequence[Path], file: Path) -> list[dict[str, Any]]:
    """Return what a program says to each query in a map: pose (x, y, yaw of the base in the map, None without
    an answer), score (larger is surer, in a unit of its own), cpu_s (processor time from the registered query
    to the pose), peak_mb (largest memory of the process so far, with the map and the libraries).

    file : of the answers; if it exists, it is read. Raises PeerFailed.
    """
    if not file.exists():
        paths = (path.absolute() for path in (map_stem, file, *queries))
        done = run(kind.python, Path(__file__).with_name(kind.file), kind.name, *paths)
        if not file.exists():
            raise PeerFailed(f"{kind.name}: no answers to the queries of {queries[0].parent}: {done.error}")
    found: list[dict[str, Any]] = json.loads(file.read_text())
    return found


# --- those of this environment, by planar scans -------------------------------------------------------

PROGRAMS = ("pf-localization", "carmen2rawlog", "ros-map-yaml2mrpt")


@dataclass(frozen=True, slots=True, kw_only=True)
class ParticleFilterParameters:
    """Settings of `pf-localization`; others are those of its demonstration of global localization.

    per_m2, least : particles at the start for each square metre of free floor, and at least; twice as many at
        most. 27 on 376 m2 found nothing, and 60,000 take 43 s a query.
    max_range_m : beams that are as long came back from nothing.

    The least noise of the odometry between two scans (`DummyOdometryParams` below) is that of registration.
    """

    per_m2: float = 80.0
    least: int = 30_000
    max_range_m: float = 40.0


PARTICLE_FILTER = ParticleFilterParameters()

_ESTIMATE = re.compile(r"PDF estimation: \(([^,]+),([^,]+),([^)]+?)deg\).*tr\(cov\): (\S+)")

_CONFIG = """\
[KLD_options]
KLD_binSize_PHI_deg=10
KLD_binSize_XY=0.10
KLD_delta=0.01
KLD_epsilon=0.01
KLD_maxSampleSize={particles}
KLD_minSampleSize=500
KLD_minSamplesPerBin=0
[PF_options]
PF_algorithm=0
resamplingMethod=0
adaptiveSampleSize=1
BETA=0.5
sampleSize=1
[DummyOdometryParams]
minStdXY=0.05
minStdPHI=2.0
[LocalizationExperiment]
use_3D_poses=false
map_file={map_file}
rawlog_file={rawlog}
logOutput_dir={log}
3DSceneFrequency=-1
experimentRepetitions=1
particles_count={particles}
init_PDF_mode=0
init_PDF_min_x={x0}
init_PDF_max_x={x1}
init_PDF_min_y={y0}
init_PDF_max_y={y1}
SHOW_PROGRESS_3D_REAL_TIME=false
[MetricMap]
occupancyGrid_count=1
gasGrid_count=0
landmarksMap_count=0
pointsMap_count=0
beaconMap_count=0
likelihoodMapSelection=-1
[MetricMap_occupancyGrid_00_creationOpts]
resolution={resolution_m}
[MetricMap_occupancyGrid_00_likelihoodOpts]
likelihoodMethod=4
LF_decimation={decimation}
LF_stdHit=0.40
LF_maxCorrsDistance=0.30
LF_zHit=0.95
LF_zRandom=0.05
LF_maxRange=80
LF_alternateAverageMethod=0
"""


def particle_filter(map_stem: str) -> Callable[[str], PoseAndScore]:
    """Prepare MRPT: the pose is the mean of the particles at the last scan, in one map.

    The score is minus the root of the trace of their covariance, metres and radians: particles in several
    places are far from each other. Raises Pc2GridError if one of the programs fails.
    """
    grid, p = load_map(Path(f"{map_stem}.yaml")), PARTICLE_FILTER
    (x0, y0), (height, width) = grid.origin_m, grid.cells.shape
    free_m2 = float(np.count_nonzero(grid.free)) * grid.resolution_m**2
    folder = tempfile.TemporaryDirectory(prefix="particle-filter-")
    setting = {
        "particles": round(min(max(p.per_m2 * free_m2, p.least), 2 * p.least)),
        "map_file": f"{folder.name}/map.gridmap.gz",
        "rawlog": f"{folder.name}/query.rawlog",
        "log": f"{folder.name}/log",
        "x0": x0,
        "x1": x0 + width * grid.resolution_m,
        "y0": y0,
        "y1": y0 + height * grid.resolution_m,
        "resolution_m": grid.resolution_m,
    }
    _output_of("ros-map-yaml2mrpt", "-q", "-w", "-i", f"{map_stem}.yaml", "-d", folder.name)

    def locate(query: str) -> PoseAndScore:
        log, config = Path(folder.name, "query.log"), Path(folder.name, "query.ini")
        with np.load(f"{query}.ranges.npz") as file:
            ranges_m, fov_rad, T_base_middle = file["ranges_m"], float(file["fov_rad"]), file["T_base_middle"]
        session = kept(Path(f"{query}.pickle"))
        log.write_text(carmen_log(session, ranges_m, fov_rad, SE2.from_matrix(T_base_middle)))
        _output_of("carmen2rawlog", "-q", "-w", "-i", str(log), "-o", setting["rawlog"])
        config.write_text(_CONFIG.format(**setting, decimation=max(ranges_m.shape[1] // 36, 1)))
        output = _output_of("pf-localization", str(config))
        found = _ESTIMATE.findall(output)
        if not found:
            raise Pc2GridError(f"pf-localization: no estimate for {query}: {output[-300:]}")
        x, y, yaw_deg, spread = (float(value) for value in found[-1])
        return SE2(x, y, math.radians(yaw_deg)).lift(), -spread

    return locate


def _output_of(*command: str) -> str:
    """Run a program to its end: its output. Raises Pc2GridError if it fails."""
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        raise Pc2GridError(f"{command[0]} ended with {done.returncode}: {done.stdout[-300:]}")
    return done.stdout


def carmen_log(session: RegisteredSession, ranges_m: F32, fov_rad: float, T_base_middle: SE2) -> str:
    """Return the first scan, those after each motion, and the last as a CARMEN log: a ROBOTLASER1 line each,
    with the odometry.

    ranges_m (N, B) of all scans; `T_base_middle` looks at the middle of `fov_rad`.
    """
    p = PARTICLE_FILTER
    ranges_m = np.where(np.isfinite(ranges_m), np.minimum(ranges_m, p.max_range_m), p.max_range_m)
    beams = ranges_m.shape[1]
    step_rad = fov_rad / (beams - 1)
    way, lines = session.trajectory, []
    last = len(way) - 1
    for k in dict.fromkeys([*(k for k, _ in after_motion(enumerate(way.T_session_base))), last]):
        T_odom_base = SE2.from_matrix(way.T_session_base[k])
        T_odom_middle = T_odom_base @ T_base_middle
        seconds = (way.stamps_ns[k] - way.stamps_ns[0]) * 1e-9
        lines.append(
            f"ROBOTLASER1 0 {-fov_rad / 2:.6f} {fov_rad:.6f} {step_rad:.6f} {p.max_range_m:g} 0.01 0 {beams} "
            + " ".join(f"{r:.3f}" for r in ranges_m[k])
            + f" 0 {T_odom_middle.x:.4f} {T_odom_middle.y:.4f} {T_odom_middle.yaw:.5f}"
            + f" {T_odom_base.x:.4f} {T_odom_base.y:.4f} {T_odom_base.yaw:.5f}"
            + f" 0 0 0 0 0 {seconds:.6f} robot {seconds:.6f}"
        )
    return "\n".join(lines) + "\n"


def own(map_stem: str) -> Callable[[str], PoseAndScore]:
    """Return what locates queries with pc2grid itself, in one map.

    It gets the nav2 map and the registered planar scans, and asks as `pc2grid relocalize` does: again after
    every metre, and at the end. Only `located` is an answer; the score is the confidence.
    """
    index = index_of("map", load_map(Path(f"{map_stem}.yaml")), Config())

    def locate(query: str) -> PoseAndScore:
        localizer = Localizer(index)
        for scan in kept(Path(f"{query}.pickle")).scans():
            localizer.add(*scan)
        answer = localizer.answer()
        return None if answer.T_map_base is None else (answer.T_map_base.lift(), answer.confidence)

    return locate


# --- judging ------------------------------------------------------------------------------------------

Coverage = Literal["covered", "uncovered", "elsewhere"]
"""covered: the map shows what the query saw last. uncovered: it does not. elsewhere: the map is of another
building."""

DECIDES = "pc2grid"
"""The program whose answers need no threshold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerTrial:
    """One judged answer, see `answers`.

    site : the building of the query. right : near the true pose; false without a pose and elsewhere.
    error_m : None without a pose and elsewhere.
    """

    peer: str
    site: str
    place: Coverage
    pose: tuple[float, float, float] | None
    score: float
    cpu_s: float
    peak_mb: float
    right: bool
    error_m: float | None

    @staticmethod
    def of(peer: str, site: str, map_: str, query: SiteQuery, answer: Mapping[str, Any]) -> PeerTrial:
        """Judge the answer to a query. map_ : the building of the map."""
        place: Coverage = "elsewhere" if map_ != site else "covered" if query.covered else "uncovered"
        right, error_m = False, None
        if answer["pose"] is not None and place != "elsewhere":
            right, error_m = is_right(SE2(*answer["pose"]), SE2(*query.pose), JUDGEMENT.right_recorded_m)
        return PeerTrial(peer=peer, site=site, place=place, right=right, error_m=error_m, **answer)

    def answered(self, threshold: float) -> bool:
        """Return whether there is an answer at this threshold of the score."""
        return self.pose is not None and self.score >= threshold


def best_threshold(trials: Sequence[PeerTrial]) -> float:
    """Return the threshold with the most right answers less the wrong ones; of several the highest.

    Infinite, which is never to answer, if wrong answers outnumber the right ones at every threshold.
    """

    def gain(threshold: float) -> int:
        return sum(1 if t.right else -1 for t in trials if t.answered(threshold))

    scores = {t.score for t in trials if t.pose is not None}
    return max([math.inf, *sorted(scores, reverse=True)], key=gain)


def cells_of_trials(trials: Sequence[PeerTrial]) -> list[Cell]:
    """Return a cell for each site and program, in their order. A program has one threshold for all.

    threshold: None if the program decides by itself, or never answers. right, wrong: of the covered queries;
    interval: 5 and 95 % of the share that is right. The others are wrong answers to the queries that have no
    right one. cpu_s, elsewhere_cpu_s: median of an answer in the own and in another building's map.
    """
    thresholds = {
        name: -math.inf if name == DECIDES else best_threshold([t for t in trials if t.peer == name])
        for name in dict.fromkeys(t.peer for t in trials)
    }
    pairs = dict.fromkeys((t.site, t.peer) for t in trials)
    return [_cell([t for t in trials if (t.site, t.peer) == pair], thresholds[pair[1]]) for pair in pairs]


def _cell(trials: Sequence[PeerTrial], threshold: float) -> Cell:
    answered = [trial for trial in trials if trial.answered(threshold)]
    of_place = Counter(trial.place for trial in trials)
    wrong = Counter(trial.place for trial in answered if not trial.right)
    errors_m = [t.error_m for t in answered if t.right and t.place == "covered" and t.error_m is not None]
    covered, right = of_place["covered"], len(errors_m)
    return {
        "site": trials[0].site,
        "peer": trials[0].peer,
        "threshold": threshold if math.isfinite(threshold) else None,
        "covered": covered,
        "right": right,
        "interval": clopper_pearson(right, covered, 0.1) if covered else None,
        "wrong": wrong["covered"],
        "uncovered": of_place["uncovered"],
        "uncovered_wrong": wrong["uncovered"],
        "elsewhere": of_place["elsewhere"],
        "elsewhere_wrong": wrong["elsewhere"],
        "median_error_m": _median(errors_m),
        "cpu_s": _median(t.cpu_s for t in trials if t.place != "elsewhere"),
        "elsewhere_cpu_s": _median(t.cpu_s for t in trials if t.place == "elsewhere"),
        "peak_mb": max(t.peak_mb for t in trials),
    }


def _median(values: Iterable[float]) -> float | None:
    some = list(values)
    return median(some) if some else None


def compare_peers(given: ComparePeers, terminal: Console) -> None:
    """Ask every program that is installed, and write the table."""
    recordings, out = given.recordings, given.out
    seconds = _seconds(given.mapped or (), recordings)
    not_installed = {kind.name: command for kind in PEERS if (command := how_to_install(kind)) is not None}
    for name, command in not_installed.items():
        warn(f"{name} is not installed: {command}")
    work = out / digest_of_sources((FRONT, BACK, LABORATORY))
    make_folder(out)
    sites, trials = [], []
    with terminal.progress("prepare") as advance:
        for recording in recordings:
            sites.append(_site(recording, work, given, seconds.get(recording.stem)))
            advance(len(sites) / len(recordings))
    tasks = _tasks(sites, not_installed)
    with terminal.progress("locate") as advance:
        for done, (kind, site, map_site) in enumerate(tasks, start=1):
            asked = site.queries()
            file = work / f"{kind.name}.{site.folder.name}.in.{map_site.folder.name}.json"
            found = answers(kind, map_site.map_stem, [site.stem(one) for one in asked], file)
            for query, answer in zip(asked.values(), found, strict=True):
                trials.append(PeerTrial.of(kind.name, site.name, map_site.name, query, answer))
            advance(done / len(tasks))
    cells = cells_of_trials(trials)
    setting = {
        "queries": given.queries,
        "travel": given.travel,
        "pins": PINS,
        "not_installed": not_installed,
        **seconds,
    }
    document = {"setting": setting, "cells": cells, "trials": list(map(asdict, trials))}
    write_text(out / "peers.json", json_text(document) + "\n")
    print_cells("later parts of recordings in a map of an earlier part", 2, cells)
    print(
        "uncovered wrong, elsewhere wrong: answers to queries that have no right one. pc2grid decides itself;"
        " the others have the threshold with the most right answers less wrong ones in this very table"
    )
    print(out / "peers.json")


def _tasks(sites: Sequence[Site], not_installed: Mapping[str, str]) -> list[tuple[PeerKind, Site, Site]]:
    """Return what is run: each installed program with the sites of its sensors, in two maps."""
    tasks = []
    for kind in PEERS:
        for sensor in kind.sensors if kind.name not in not_installed else ():
            of_sensor = [site for site in sites if site.sensor == sensor]
            for k, site in enumerate(of_sensor):
                tasks += [(kind, site, other) for other in dict.fromkeys((site, of_sensor[k - 1]))]
    return tasks


def _site(recording: Path, work: Path, given: ComparePeers, mapped_s: float | None) -> Site:
    """Return the building of a recording, or of a 3D scan; what was prepared from the same before is used
    again."""
    if not recording.exists():
        raise LogNotFound(f"{recording}: no such file")
    config, is_building = Config(), is_building_file(recording)
    truth = b"" if is_building else truth_file(recording).read_bytes()
    made_of = (digest_of(recording, config), truth, given.queries, given.travel, mapped_s, given.of_base)
    folder = work / f"{recording.stem}.{hashlib.sha256(repr(made_of).encode()).hexdigest()[:12]}"
    if is_building:
        return simulated_site(recording, folder, config, queries=given.queries, travel_m=given.travel)
    return recorded_site(
        recording,
        folder,
        config,
        queries=given.queries,
        travel_m=given.travel,
        mapped_s=mapped_s,
        of_base=given.of_base,
    )


def _seconds(mapped: Sequence[str], recordings: Sequence[Path]) -> dict[str, float]:
    """Return the values of `--mapped`, by name. Raises ConfigError."""
    names, seconds = names_of(recordings), {}
    for text in mapped:
        name, _, value = text.partition("=")
        try:
            seconds[name] = float(value)
        except ValueError:
            seconds[name] = 0.0
        if name not in names or seconds[name] <= 0.0:
            raise ConfigError(
                f"--mapped {text}: not seconds of one of the recordings", hint=f"for example {names[0]}=600"
            )
    return seconds


if __name__ == "__main__":
    serve(lambda name, stem: {"pc2grid": own, "particle-filter": particle_filter}[name](stem))
