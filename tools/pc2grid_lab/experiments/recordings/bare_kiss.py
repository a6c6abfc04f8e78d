"""Processor time and error of bare KISS-ICP on a recording: `python -m ...bare_kiss LOG [TRUTH.tum]`."""

from __future__ import annotations

import json
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from pc2grid.estimation.registration import BareKissIcp
from pc2grid.io import open_log
from pc2grid.io.trajectory import read_tum
from pc2grid.model import Scan, Trajectory
from pc2grid_lab.experiments.trajectory_error import trajectory_error

VOXELS_PER_RANGE = 40.0
"""The 75th percentile of the ranges over the voxel: 0.3 m in rooms and halls. Chosen by hand."""
_WALK_MPS, _WALK_MOST_M = 1.0, 0.5
"""A voxel is the way between two scans at least, as partners of points are found no farther; by hand."""


def indoors(first: Scan, second: Scan) -> tuple[float, float]:
    """The voxel and the range, metres, with which KISS-ICP maps the surroundings of the first two scans.

    Its own, 1 m and 100 m, are for streets: with these it is ten times faster, and makes no map of a room.
    """
    ranges_m = np.linalg.norm(first.points_m, axis=1)
    walked_m = min(_WALK_MPS * (second.stamp_ns - first.stamp_ns) * 1e-9, _WALK_MOST_M)
    voxel_m = np.clip(max(np.percentile(ranges_m, 75) / VOXELS_PER_RANGE, walked_m), 0.3, 1.0)
    return float(voxel_m), float(np.clip(1.5 * np.percentile(ranges_m, 98), 10.0, 100.0))


def main() -> None:
    """Print one JSON document: scans, cpu_s, and ate_m or null.

    cpu_s is the processor time of `register_frame` alone, over all points of each scan, with a voxel and a
    range for indoors. ate_m is the error with KISS-ICP's own settings.
    """
    log, truth = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    with open_log(log) as opened:
        config: Any = KISSConfig()
        config.mapping.voxel_size, config.data.max_range = indoors(*islice(opened.scans(), 2))
        config.data.deskew = False
        config.registration.max_num_threads = 1
        kiss, own = KissICP(config), BareKissIcp()
        stamps, poses, cpu_s = [], [], 0.0
        for scan in opened.scans():
            points_m = np.asarray(scan.points_m, np.float64)
            begin = time.process_time()
            kiss.register_frame(points_m, np.empty(0))
            cpu_s += time.process_time() - begin
            last_s = 0.0 if scan.offsets_s is None or not len(scan.offsets_s) else float(scan.offsets_s.max())
            stamps.append(scan.stamp_ns + round(last_s * 1e9))
            if truth is not None:
                poses.append(own.register(scan))
    ate_m = None
    if truth is not None:
        trajectory = Trajectory(stamps_ns=np.array(stamps, np.int64), T_session_base=np.array(poses))
        error = trajectory_error(trajectory, read_tum(Path(truth)))
        ate_m = None if error is None else error.ate_m
    print(json.dumps({"scans": len(stamps), "cpu_s": cpu_s, "ate_m": ate_m}))


if __name__ == "__main__":
    main()
