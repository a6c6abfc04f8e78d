"""Programs that match clouds, in a process of their own: it reads stems of queries and writes answers.

    python cloud_matchers.py map-closures|kiss-matcher|fpfh-ransac MAP_STEM

This file imports nothing of pc2grid, because the environments of the peers do not contain it. The protocol is
that of `peer_process`. The parameters are those that performed best in rooms and corridors; the default ones
of MapClosures are made for streets and describe nothing here.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TextIO

import numpy as np
from numpy.typing import NDArray

Cloud = NDArray[np.floating]
Matrix = NDArray[np.float64]
Found = tuple[Matrix, float] | None
"""T_map_base (4, 4) and a score, or None."""


class CloudMatcher(Protocol):
    """A program that has the map, and is given queries."""

    def locate(self, points_m: Cloud) -> Found:
        """Where the points, in the frame of the query's last base, lie in the map."""
        ...


SUBMAP_M = 15.0
"""Travel that makes a submap of MapClosures; shorter ones describe too little."""
DENSITY_M = 0.15
"""Pixel of the density maps of MapClosures; its default is 0.5 m."""
VOXEL_M = 0.3
"""Of KISS-CloudMatcher; 0.15 m takes three times as long and finds no more."""
FPFH_VOXEL_M = 0.3
"""Of Open3D's FPFH; with 0.2 m a query takes 18 s, most of it for the matches of features."""
SEED = 0


class MapClosures:
    """Submaps of 15 m of the map's path; the query is matched with all of them at once. Score: inliers."""

    def __init__(self, path: Matrix, clouds: list[Cloud]) -> None:
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures as Closures

        config = MapClosuresConfig()
        config.density_map_resolution = DENSITY_M
        self._closures = Closures(config)
        travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2, 3], axis=0).T))))
        self._poses: list[Matrix] = []
        for number in range(int(travel_m[-1] // SUBMAP_M) + 1):
            members = np.flatnonzero(travel_m // SUBMAP_M == number)
            if not len(members):
                continue
            self._poses.append(path[members[0]])
            T_local_map = np.asarray(np.linalg.inv(self._poses[-1]), np.float64)
            local = moved(T_local_map, np.concatenate([clouds[i] for i in members]))
            self._closures.get_best_closure(len(self._poses) - 1, np.ascontiguousarray(local, np.float64))
        self._next = len(self._poses)

    def locate(self, points_m: Cloud) -> Found:
        """The submap with most inliers."""
        # The three newest submaps are never matched, and a query becomes a submap. Therefore each query gets
        # a number far from those of the map.
        self._next += 10
        found = self._closures.get_best_closure(self._next, np.ascontiguousarray(points_m, np.float64))
        if not 0 <= found.source_id < len(self._poses):
            return None
        return self._poses[found.source_id] @ np.linalg.inv(found.pose), float(found.number_of_inliers)


class KissMatcher:
    """The cloud of the query is matched with that of the whole building. Score: inliers."""

    def __init__(self, path: Matrix, clouds: list[Cloud]) -> None:
        import kiss_matcher

        self._matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(VOXEL_M))
        self._map = thinned(np.concatenate(clouds), VOXEL_M)

    def locate(self, points_m: Cloud) -> Found:
        """It always has an answer."""
        self._matcher.reset()
        found = self._matcher.estimate(thinned(points_m, VOXEL_M), self._map)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        return T, float(self._matcher.get_num_final_inliers())


class FpfhRansac:
    """Open3D: FPFH features, RANSAC on their matches, ICP point to plane. Score: share of points that fit."""

    def __init__(self, path: Matrix, clouds: list[Cloud]) -> None:
        import open3d

        self._o3d = open3d
        self._map, self._features = self._described(np.concatenate(clouds))

    def _described(self, points_m: Cloud) -> tuple[Any, Any]:
        o3d = self._o3d
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m.astype(np.float64)))
        cloud = cloud.voxel_down_sample(FPFH_VOXEL_M)
        search = o3d.geometry.KDTreeSearchParamHybrid
        cloud.estimate_normals(search(radius=2.0 * FPFH_VOXEL_M, max_nn=30))
        wide = search(radius=5.0 * FPFH_VOXEL_M, max_nn=100)
        return cloud, o3d.pipelines.registration.compute_fpfh_feature(cloud, wide)

    def locate(self, points_m: Cloud) -> Found:
        """It has an answer if RANSAC finds three matches that agree."""
        registration = self._o3d.pipelines.registration
        self._o3d.utility.random.seed(SEED)
        query, features = self._described(points_m)
        near_m = 1.5 * FPFH_VOXEL_M
        coarse = registration.registration_ransac_based_on_feature_matching(
            query,
            self._map,
            features,
            self._features,
            True,
            near_m,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(near_m),
            ],
            registration.RANSACConvergenceCriteria(100_000, 0.999),
        )
        if not len(coarse.correspondence_set):
            return None
        plane = registration.TransformationEstimationPointToPlane()
        fine = registration.registration_icp(query, self._map, near_m, coarse.transformation, plane)
        return np.asarray(fine.transformation), float(fine.fitness)


def moved(T: Matrix, points_m: Cloud) -> Matrix:
    """The points (N, 3), transformed by T (4, 4)."""
    return np.asarray(points_m @ T[:3, :3].T + T[:3, 3], np.float64)


def thinned(points_m: Cloud, edge_m: float) -> Cloud:
    """One point for each voxel."""
    _, first = np.unique(np.floor(points_m / edge_m).astype(np.int64), axis=0, return_index=True)
    return points_m[np.sort(first)]


def peak_mb() -> float:
    """Largest resident memory of this process so far."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1000.0 for line in lines if line.startswith("VmHWM"))


def answer_stream() -> TextIO:
    """The standard output, for answers alone: what libraries print goes to the standard error from now on.

    Open3D, for one, prints a warning where RANSAC has too few matches.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def serve(locate: Callable[[str], Found], answers: TextIO, *, compiles: bool = False) -> None:
    """Answer the queries of the standard input until it ends. compiles : the first one is located twice."""
    for number, line in enumerate(sys.stdin):
        query = line.rstrip("\n")
        if compiles and number == 0:
            locate(query)
        begin_s = time.process_time()
        found = locate(query)
        cpu_s = time.process_time() - begin_s
        pose = None
        if found is not None:
            T = found[0]
            pose = [float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])]
        score = 0.0 if found is None else found[1]
        answer = {"pose": pose, "score": score, "cpu_s": cpu_s, "peak_mb": peak_mb()}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def main() -> None:
    """Load the map, then answer."""
    answers = answer_stream()
    name, map_stem = sys.argv[1:]
    with np.load(f"{map_stem}.npz") as file:
        path, points_m, count = file["T_map_base"], file["points_m"], file["count"]
    clouds = np.split(points_m, np.cumsum(count)[:-1])
    matchers: dict[str, Callable[[Matrix, list[Cloud]], CloudMatcher]] = {
        "map-closures": MapClosures,
        "kiss-matcher": KissMatcher,
        "fpfh-ransac": FpfhRansac,
    }
    matcher = matchers[name](path, clouds)

    def locate(query: str) -> Found:
        with np.load(f"{query}.cloud.npz") as file:
            points_m = file["points_m"]
        return matcher.locate(points_m)

    serve(locate, answers)


if __name__ == "__main__":
    main()
