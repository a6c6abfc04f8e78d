"""From the file to the map: start of the program, info, decoding, time and memory of convert, growth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pc2grid.io.messages.types import Header, PointCloud2
from pc2grid.io.sensors import pointcloud2
from pc2grid.submaps.partition import partition
from pc2grid_lab.bench import fixtures
from pc2grid_lab.bench.measure import Row, Time, interleaved, median, program, run_python, timed
from signature.config import Config


def help_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid --help`, compared with an interpreter that does nothing."""
    actions = {"help": lambda: program("--help"), "python": lambda: run_python("pass")}
    runs: dict[str, list[Time]] = {name: [] for name in actions}
    for _ in range(3 if quick else 11):
        for name, action in actions.items():
            runs[name].append(action().time)
    found = {name: median(times) for name, times in runs.items()}
    yield Row(
        what="pc2grid --help",
        measured=found["help"].wall,
        cpu=found["help"].cpu,
        unit="s",
        goal=0.3,
        note=f"a Python that does nothing takes {found['python'].wall:.2f} s",
    )


def info_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid info` on a large recording."""
    size = 500_000_000 if quick else 10_000_000_000
    log = folder / "huge.mcap"
    fixtures.huge_log(log, size)
    took = median(program("info", log).time for _ in range(3 if quick else 7))
    yield Row(
        what=f"pc2grid info, {log.stat().st_size / 1e9:.1f} GB",
        measured=took.wall,
        cpu=took.cpu,
        unit="s",
        goal=1.0,
    )


def decode_speed(folder: Path, quick: bool) -> Iterator[Row]:
    """PointCloud2 messages in memory to points and times, compared with kiss-icp's reader."""
    from kiss_icp.tools.point_cloud2 import read_point_cloud

    rng = np.random.default_rng(0)
    for name, columns in (("x y z intensity", 4), ("x y z intensity time", 5)):
        points = rng.uniform(-20, 20, (75_000, columns)).astype(np.float32)
        points[::50, :3] = np.nan
        if columns == 5:
            points[:, 4] = np.linspace(0, 0.1, len(points))
        fields = tuple((n, 4 * i, 7, 1) for i, n in enumerate(("x", "y", "z", "intensity", "time")[:columns]))
        ours = PointCloud2(
            Header(0, "lidar"), 1, len(points), fields, False, 4 * columns, points.nbytes, points.tobytes()
        )
        # With the constants of PointField: kiss-icp's reader uses them and mcap-ros2-support does not have
        # them.
        theirs = SimpleNamespace(
            fields=[
                SimpleNamespace(name=n, offset=o, datatype=d, count=c, FLOAT32=7) for n, o, d, c in fields
            ],
            width=ours.width,
            height=1,
            point_step=ours.point_step,
            is_bigendian=False,
            data=ours.data,
        )
        found = interleaved(
            {
                "ours": lambda ours=ours: pointcloud2.decode(ours),
                "kiss": lambda m=theirs: read_point_cloud(m),
            },
            20 if quick else 200,
        )
        speed = Time(*(points.nbytes / t / 1e9 for t in found["ours"].times(1.0)))
        what = f"decode PointCloud2 ({name})"
        yield Row(what=what, measured=speed.wall, cpu=speed.cpu, unit="GB/s", goal=1.0, at_least=True)
        ratio = found["kiss"].cpu / found["ours"].cpu
        yield Row(what=f"{what} over kiss-icp's reader", measured=ratio, unit="x", goal=5.0, at_least=True)


_BARE = """
import json, sys, time
import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from pc2grid.io import open_log
from pc2grid_lab.experiments.recordings.bare_kiss import indoors

path, duration = sys.argv[1], float(sys.argv[2]) or None
with open_log(path) as log:
    scans = list(log.scans(0.0, duration))
voxel_m, range_m = indoors(*scans[:2])
found = {"scans": len(scans), "voxel": voxel_m}
points = [np.asarray(scan.points_m, np.float64) for scan in scans]
for name, voxel, reach in (
    ("same", voxel_m, range_m),
    ("default", KISSConfig().mapping.voxel_size or 1.0, KISSConfig().data.max_range),
):
    config = KISSConfig()
    config.data.deskew = False
    config.data.max_range, config.mapping.voxel_size = reach, voxel
    config.registration.max_num_threads = 1
    kiss = KissICP(config)
    wall, cpu = time.perf_counter(), time.process_time()
    for frame in points:
        kiss.register_frame(frame, np.empty(0))
    found[name] = time.perf_counter() - wall, time.process_time() - cpu
print(json.dumps(found))
"""


@dataclass(frozen=True, slots=True)
class BareKiss:
    """Time of bare `KissICP.register_frame` over the decoded scans of a log, with one thread.

    same : with a voxel and a range for indoors. default : with KISS-ICP's default of 1 m.
    """

    scans: int
    voxel_m: float
    same: Time
    default: Time


def bare_kiss(log: Path, duration_s: float = 0.0) -> BareKiss:
    """Run it in a process of its own, as pc2grid is."""
    found = json.loads(run_python(_BARE, log, str(duration_s)).stdout)
    return BareKiss(found["scans"], found["voxel"], Time(*found["same"]), Time(*found["default"]))


def convert_time(folder: Path, quick: bool) -> Iterator[Row]:
    """`pc2grid convert` from start to end over bare KISS-ICP on the same scans."""
    simulated = folder / "lidar.mcap"
    fixtures.lidar_log(simulated, 8.0 if quick else 40.0)
    logs = {"simulated lidar": simulated, "hall.mcap": fixtures.data_file("lidar/hall.mcap")}
    for name, log in logs.items():
        what = f"convert {name}, over KISS-ICP at the same voxel"
        if log is None:
            yield Row(what=what, measured=None, unit="x", goal=1.15, note="needs PC2GRID_DATA")
            continue
        program("convert", log, "--duration", "1", "-o", folder / "out.submaps", "--force")  # compiles
        whole, bare = [], []
        for _ in range(1 if quick else 3):
            whole.append(program("convert", log, "-o", folder / "out.submaps", "--force").time)
            bare.append(bare_kiss(log))
        took, same, default = median(whole), median(b.same for b in bare), median(b.default for b in bare)
        yield Row(
            what=what,
            measured=took.wall / same.wall,
            cpu=took.cpu / same.cpu,
            unit="x",
            goal=1.15,
            note=f"{bare[0].scans} scans, cpu: {took.cpu:.1f} s; KISS-ICP {same.cpu:.1f} s at"
            f" {bare[0].voxel_m:.2f} m, {default.cpu:.1f} s at 1 m",
        )


def convert_memory(folder: Path, quick: bool) -> Iterator[Row]:
    """Peak memory of `pc2grid convert` at two lengths."""
    peaks = []
    for minutes, goal in ((3, None), (6, 600.0)) if quick else ((15, None), (60, 600.0)):
        log = folder / "long.mcap"
        scans = fixtures.lidar_log(log, 34.0 * minutes, lidar=fixtures.SPARSE)
        child = program("convert", log, "-o", folder / "out.submaps", "--force")
        peaks.append(child.peak_mb)
        yield Row(
            what=f"memory of convert, a log of {minutes} min",
            measured=child.peak_mb,
            unit="MB",
            goal=goal,
            note=f"{scans} scans of 8 x 240 points in {child.time.cpu:.0f} s of cpu",
        )
        log.unlink()
        log.with_suffix(".tum").unlink()
    yield Row(what="the longer over the shorter", measured=peaks[1] / peaks[0], unit="x", goal=1.1)


def growth(folder: Path, quick: bool) -> Iterator[Row]:
    """Processor time of convert per scan, and of partition per area, at 1x, 4x and 16x."""
    config, base_m = Config().partition, 5.0 if quick else 20.0
    runs = []
    fixtures.lidar_log(folder / "short.mcap", 2.0, lidar=fixtures.SPARSE)
    program("convert", folder / "short.mcap", "-o", folder / "out.submaps", "--force")  # compiles
    for times in (1, 4, 16):
        log = folder / f"{times}.mcap"
        scans = fixtures.lidar_log(log, base_m * times, lidar=fixtures.SPARSE)
        child = program("convert", log, "-o", folder / "out.submaps", "--force")
        runs.append((scans, child.time.cpu))
    start = program("convert", log, "--duration", "1", "-o", folder / "out.submaps", "--force").time.cpu
    per_scan = [(cpu - start) / scans for scans, cpu in runs]
    yield Row(
        what="convert: cpu time per scan, 16x over 1x as long",
        measured=per_scan[2] / per_scan[0],
        unit="x",
        goal=1.15,
        note=", ".join(f"{scans} scans {cpu:.1f} s" for scans, cpu in runs) + f", start {start:.1f} s",
    )
    further = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(runs)]
    yield Row(
        what="convert: cpu time of a further scan, from 4x to 16x over from 1x to 4x",
        measured=further[1] / further[0],
        unit="x",
        goal=1.15,
        note=", ".join(f"{1e3 * seconds:.2f} ms" for seconds in further) + "; start and first metres cancel",
    )
    seconds = []
    for side in (1, 2, 4):
        grid = fixtures.office(0, side)
        partition(grid, config)
        seconds.append(median(timed(lambda g=grid: partition(g, config)) for _ in range(3)).cpu)
    yield Row(
        what="partition: cpu time per area, 16x over 1x as large",
        measured=seconds[2] / seconds[0] / 16,
        unit="x",
        goal=1.15,
        note=", ".join(f"{s:.2f} s" for s in seconds),
    )
