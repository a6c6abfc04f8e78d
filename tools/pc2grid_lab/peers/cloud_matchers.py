"""Programs that match clouds: MapClosures, KISS-Matcher, and Open3D's FPFH + RANSAC.

    python PROGRAM.py NAME MAP_STEM ANSWERS.json QUERY_STEM...

`serve` is what the processes of all programs share: they locate each query and write all answers to one file.
This file imports nothing of pc2grid, because the environment of two of the programs does not contain it.

The parameters are those that performed best in rooms and corridors; the default ones of MapClosures are made
for streets and describe nothing here.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
PoseAndScore = tuple[Matrix, float] | None
"""T_map_base (4, 4) and a score, or None."""


def serve(locator: Callable[[str, str], Callable[[str], PoseAndScore]]) -> None:
    """Answer the queries of the command line.

    locator : what locates the queries, of the name of the program and the stem of the map. The first query is
        located once more before: that functions are compiled does not count.
    """
    name, map_stem, out, *queries = sys.argv[1:]
    locate, answers = locator(name, map_stem), []
    for query in queries[:1]:
        locate(query)
    for query in queries:
        begin_s = _cpu_s()
        found = locate(query)
        cpu_s = _cpu_s() - begin_s
        T, score = (None, 0.0) if found is None else found
        pose = None if T is None else [T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]
        answers.append({"pose": pose, "score": score, "cpu_s": cpu_s, "peak_mb": _peak_mb()})
    Path(out).write_text(json.dumps(answers))


def _cpu_s() -> float:
    """Return the processor time of this process, and of those that it has started and that have ended."""
    used = map(getrusage, (RUSAGE_SELF, RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def _peak_mb() -> float:
    """Return the largest resident memory so far of this process or of one that it has started."""
    lines = Path("/proc/self/status").read_text().splitlines()
    own_kb = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    return max(own_kb, getrusage(RUSAGE_CHILDREN).ru_maxrss) / 1000.0


Cloud = NDArray[np.floating]
Locate = Callable[[Cloud], PoseAndScore]
"""Where the points, in the frame of the query's last base, lie in the map."""

SUBMAP_M = 15.0
"""Travel that makes a submap of MapClosures; shorter ones describe too little."""
VOXEL_M = 0.3
"""Of KISS-Matcher, where 0.15 m takes three times as long and finds no more, and of Open3D's FPFH, where with
0.2 m a query takes 18 s, most of it for the matches of features."""
DENSITY_M = 0.5 * VOXEL_M
"""Pixel of the density maps of MapClosures; its default is 0.5 m."""


def map_closures(path: Matrix, clouds: list[Cloud]) -> Locate:
    """Prepare MapClosures: submaps of 15 m of the map's path; a query is matched with all of them at once.
    Score: inliers."""
    from map_closures.config import MapClosuresConfig
    from map_closures.map_closures import MapClosures

    config = MapClosuresConfig()
    config.density_map_resolution = DENSITY_M
    closures, poses = MapClosures(config), []
    travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2, 3], axis=0).T))))
    for number in np.unique(travel_m // SUBMAP_M):
        members = np.flatnonzero(travel_m // SUBMAP_M == number)
        poses.append(path[members[0]])
        T = np.linalg.inv(poses[-1])
        local = np.concatenate([clouds[i] for i in members]) @ T[:3, :3].T + T[:3, 3]
        closures.get_best_closure(len(poses) - 1, np.ascontiguousarray(local, np.float64))
    asked = len(poses)

    def locate(points_m: Cloud) -> PoseAndScore:
        # The three newest submaps are never matched, and a query becomes a submap. Therefore each query gets
        # a number far from those of the map.
        nonlocal asked
        asked += 10
        found = closures.get_best_closure(asked, np.ascontiguousarray(points_m, np.float64))
        if not 0 <= found.source_id < len(poses):
            return None
        return poses[found.source_id] @ np.linalg.inv(found.pose), float(found.number_of_inliers)

    return locate


def kiss_matcher(_: Matrix, clouds: list[Cloud]) -> Locate:
    """Prepare KISS-Matcher: the cloud of a query is matched with that of the whole building. Score:
    inliers."""
    import kiss_matcher as library

    matcher = library.KISSMatcher(library.KISSMatcherConfig(VOXEL_M))
    building = thinned(np.concatenate(clouds), VOXEL_M)

    def locate(points_m: Cloud) -> PoseAndScore:
        matcher.reset()
        found = matcher.estimate(thinned(points_m, VOXEL_M), building)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        return T, float(matcher.get_num_final_inliers())

    return locate


def fpfh_ransac(_: Matrix, clouds: list[Cloud]) -> Locate:
    """Prepare Open3D: FPFH features, RANSAC on their matches, ICP point to plane. Score: share of points
    that fit."""
    import open3d

    steps: Any = open3d.pipelines.registration
    near_m = 1.5 * VOXEL_M

    def described(points_m: Cloud) -> tuple[Any, Any]:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_m.astype(np.float64)))
        cloud = cloud.voxel_down_sample(VOXEL_M)
        search = open3d.geometry.KDTreeSearchParamHybrid
        cloud.estimate_normals(search(radius=2.0 * VOXEL_M, max_nn=30))
        wide = search(radius=5.0 * VOXEL_M, max_nn=100)
        return cloud, steps.compute_fpfh_feature(cloud, wide)

    building, features = described(np.concatenate(clouds))

    def locate(points_m: Cloud) -> PoseAndScore:
        open3d.utility.random.seed(0)
        query, own = described(points_m)
        coarse = steps.registration_ransac_based_on_feature_matching(
            query,
            building,
            own,
            features,
            True,
            near_m,
            steps.TransformationEstimationPointToPoint(False),
            3,
            [
                steps.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                steps.CorrespondenceCheckerBasedOnDistance(near_m),
            ],
            steps.RANSACConvergenceCriteria(100_000, 0.999),
        )
        if not len(coarse.correspondence_set):
            return None
        plane = steps.TransformationEstimationPointToPlane()
        fine = steps.registration_icp(query, building, near_m, coarse.transformation, plane)
        return np.asarray(fine.transformation), float(fine.fitness)

    return locate


def thinned(points_m: Cloud, edge_m: float) -> Cloud:
    """Return one point for each voxel."""
    _, first = np.unique(np.floor(points_m / edge_m).astype(np.int64), axis=0, return_index=True)
    return points_m[np.sort(first)]


def locator(name: str, map_stem: str) -> Callable[[str], PoseAndScore]:
    """Return a program that has the clouds of the map."""
    with np.load(f"{map_stem}.npz") as file:
        path, points_m, count = file["T_map_base"], file["points_m"], file["count"]
    matcher = {"map-closures": map_closures, "kiss-matcher": kiss_matcher, "fpfh-ransac": fpfh_ransac}[name]
    locate = matcher(path, np.split(points_m, np.cumsum(count)[:-1]))
    return lambda query: locate(np.load(f"{query}.cloud.npz")["points_m"])


if __name__ == "__main__":
    serve(locator)
