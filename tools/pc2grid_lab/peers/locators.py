"""The programs of this environment that locate by planar scans: pc2grid itself, and MRPT's particle filter.

MRPT is as Debian installs it (`apt-get install mrpt-apps`). `ros-map-yaml2mrpt` converts the map,
`carmen2rawlog` the scans with the odometry, and `pf-localization` tells the mean pose and its spread after
each scan on its standard output. It seeds itself by the clock, so its answers differ a little from run to
run.
"""

from __future__ import annotations

import math
import re
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pc2grid.errors import Pc2GridError
from pc2grid.geometry import F32, F64, SE2
from pc2grid.io.maps import load_map
from pc2grid_lab.peers.cloud_matchers import PoseAndScore, serve
from pc2grid_lab.sensors import RegisteredSession, index_of
from pc2grid_lab.truth import apart
from signature.config import Config
from signature.localization.localizer import Localizer

PROGRAMS = ("pf-localization", "carmen2rawlog", "ros-map-yaml2mrpt")


@dataclass(frozen=True, slots=True, kw_only=True)
class ParticleFilterParameters:
    """Settings of `pf-localization`; others are those of its demonstration of global localization.

    per_m2, least : particles at the start for each square metre of free floor, and at least; twice as many at
        most. 27 on 376 m2 found nothing, and 60,000 take 43 s a query.
    step_m, step_rad : a scan is used after this motion, as particle filters of robots do.
    max_range_m : beams that are as long came back from nothing.

    The least noise of the odometry between two scans (`DummyOdometryParams` below) is that of registration.
    """

    per_m2: float = 80.0
    least: int = 30_000
    step_m: float = 0.2
    step_rad: float = 0.2
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
    _run("ros-map-yaml2mrpt", "-q", "-w", "-i", f"{map_stem}.yaml", "-d", folder.name)

    def locate(query: str) -> PoseAndScore:
        log, config = Path(folder.name, "query.log"), Path(folder.name, "query.ini")
        with np.load(f"{query}.ranges.npz") as file:
            ranges_m, fov_rad, T_base_middle = file["ranges_m"], float(file["fov_rad"]), file["T_base_middle"]
        session = RegisteredSession.load(Path(f"{query}.pickle"))
        log.write_text(carmen_log(session, ranges_m, fov_rad, SE2.from_matrix(T_base_middle)))
        _run("carmen2rawlog", "-q", "-w", "-i", str(log), "-o", setting["rawlog"])
        config.write_text(_CONFIG.format(**setting, decimation=max(ranges_m.shape[1] // 36, 1)))
        output = _run("pf-localization", str(config))
        found = _ESTIMATE.findall(output)
        if not found:
            raise Pc2GridError(f"pf-localization: no estimate for {query}: {output[-300:]}")
        x, y, yaw_deg, spread = (float(value) for value in found[-1])
        return SE2(x, y, math.radians(yaw_deg)).lift(), -spread

    return locate


def _run(*command: str) -> str:
    """Run a program to its end: its output. Raises Pc2GridError if it fails."""
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        raise Pc2GridError(f"{command[0]} ended with {done.returncode}: {done.stdout[-300:]}")
    return done.stdout


def carmen_log(session: RegisteredSession, ranges_m: F32, fov_rad: float, T_base_middle: SE2) -> str:
    """Return the scans after each step of motion as a CARMEN log: a ROBOTLASER1 line each, with the odometry.

    ranges_m (N, B) of all scans; `T_base_middle` looks at the middle of `fov_rad`.
    """
    p = PARTICLE_FILTER
    ranges_m = np.where(np.isfinite(ranges_m), np.minimum(ranges_m, p.max_range_m), p.max_range_m)
    beams = ranges_m.shape[1]
    step_rad = fov_rad / (beams - 1)
    lines = []
    start_ns = session.planar_scans[0].stamp_ns
    for k in _after_motion(session.T_odom_base):
        T_odom_base = SE2(*session.T_odom_base[k].tolist())
        T_odom_middle = T_odom_base @ T_base_middle
        seconds = (session.planar_scans[k].stamp_ns - start_ns) * 1e-9
        lines.append(
            f"ROBOTLASER1 0 {-fov_rad / 2:.6f} {fov_rad:.6f} {step_rad:.6f} {p.max_range_m:g} 0.01 0 {beams} "
            + " ".join(f"{r:.3f}" for r in ranges_m[k])
            + f" 0 {T_odom_middle.x:.4f} {T_odom_middle.y:.4f} {T_odom_middle.yaw:.5f}"
            + f" {T_odom_base.x:.4f} {T_odom_base.y:.4f} {T_odom_base.yaw:.5f}"
            + f" 0 0 0 0 0 {seconds:.6f} robot {seconds:.6f}"
        )
    return "\n".join(lines) + "\n"


def _after_motion(T_odom_base: F64) -> list[int]:
    """Return the first scan, those after each step of motion, and the last."""
    poses, p = [SE2(*row) for row in T_odom_base.tolist()], PARTICLE_FILTER
    kept = [0]
    for k, pose in enumerate(poses):
        step_m, step_rad = apart(poses[kept[-1]], pose)
        if step_m >= p.step_m or step_rad >= p.step_rad or k == len(poses) - 1 > 0:
            kept.append(k)
    return kept


def own(map_stem: str) -> Callable[[str], PoseAndScore]:
    """Return what locates queries with pc2grid itself, in one map.

    It gets the nav2 map and the registered planar scans, and asks as `pc2grid relocalize` does: again after
    every metre, and at the end. Only `located` is an answer; the score is the confidence.
    """
    index = index_of("map", load_map(Path(f"{map_stem}.yaml")), Config())

    def locate(query: str) -> PoseAndScore:
        localizer = Localizer(index)
        for scan in RegisteredSession.load(Path(f"{query}.pickle")).scans():
            localizer.add(*scan)
        answer = localizer.answer()
        return None if answer.T_map_base is None else (answer.T_map_base.lift(), answer.confidence)

    return locate


if __name__ == "__main__":
    serve(lambda name, stem: {"pc2grid": own, "particle-filter": particle_filter}[name](stem))
