"""One peer, run in the peers' environment: it reads numbers of queries and writes times and poses.

python peer.py map_closures|kiss_matcher FOLDER

The parameters are those that performed best in rooms and corridors of this size. The default ones of
MapClosures are made for streets and locate nothing here.
"""

import json
import math
import sys
import time
from pathlib import Path

import numpy as np

SUBMAP_M = 15.0


def load(path):
    """The clouds of a file, (N, 3) each."""
    with np.load(path) as clouds:
        return [clouds[f"arr_{k}"] for k in range(len(clouds.files))]


def voxels(points, size_m):
    """One point for each voxel."""
    _, index = np.unique(np.floor(points / size_m).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(index)]


class MapClosures:
    """Submaps of 15 m of the map's path; the query is matched with all of them at once."""

    def __init__(self, folder):
        from map_closures.config import MapClosuresConfig
        from map_closures.map_closures import MapClosures as Closures

        config = MapClosuresConfig()
        config.density_map_resolution = 0.15
        self._closures = Closures(config)
        path, clouds = np.load(folder / "path.npy"), load(folder / "map.npz")
        travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))))
        self._poses = []
        for k in range(int(travel_m[-1] // SUBMAP_M) + 1):
            members = np.flatnonzero(travel_m // SUBMAP_M == k)
            self._poses.append(matrix(path[members[0]]))
            inverse = np.linalg.inv(self._poses[-1])
            local = np.concatenate([clouds[i] for i in members]) @ inverse[:3, :3].T + inverse[:3, 3]
            self._closures.get_best_closure(k, np.ascontiguousarray(local, np.float64))
        self._next = len(self._poses)

    def prepare(self, clouds):
        """The query in the form that `locate` takes; not timed."""
        return np.ascontiguousarray(np.concatenate(clouds), np.float64)

    def locate(self, points):
        """T_map_base (4, 4), or None."""
        # The three newest submaps are never matched. Therefore each query gets a number far from those of the
        # map.
        self._next += 10
        found = self._closures.get_best_closure(self._next, points)
        if not 0 <= found.source_id < len(self._poses) or found.number_of_inliers <= 2:
            return None
        return self._poses[found.source_id] @ np.linalg.inv(found.pose)


class KissMatcher:
    """The cloud of the query is matched with that of the whole building."""

    def __init__(self, folder):
        import kiss_matcher

        self._matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(0.3))
        self._map = voxels(np.concatenate(load(folder / "map.npz")), 0.3).astype(np.float32)

    def prepare(self, clouds):
        """The query in the form that `locate` takes; not timed."""
        return voxels(np.concatenate(clouds), 0.3).astype(np.float32)

    def locate(self, points):
        """T_map_base (4, 4), or None."""
        found = self._matcher.estimate(points, self._map)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, found.translation
        return T


def matrix(pose):
    """x, y, yaw as (4, 4)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], pose[:2]
    return T


def main():
    """Answer queries until the input ends."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    peer = {"map_closures": MapClosures, "kiss_matcher": KissMatcher}[name](folder)
    for line in sys.stdin:
        points = peer.prepare(load(folder / f"query{int(line)}.npz"))
        wall, cpu = time.perf_counter(), time.process_time()
        T = peer.locate(points)
        seconds = time.perf_counter() - wall, time.process_time() - cpu
        pose = None if T is None else [T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]
        print(json.dumps({"seconds": seconds, "pose": pose}), flush=True)


if __name__ == "__main__":
    main()
