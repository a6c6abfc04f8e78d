"""People who walk are seen where they are, and change nothing else."""

from __future__ import annotations

import numpy as np

from pc2grid.simulate.config import LidarConfig
from pc2grid_lab.worlds import WorldConfig, prepare_session


def test_walkers_are_seen_where_they_walk() -> None:
    exact = {"lidar": LidarConfig(noise_m=0, dropout=0), "seed": 8}
    alone = prepare_session(sensor="lidar", config=WorldConfig(length_m=3.0, clutter=0, **exact))
    among = prepare_session(sensor="lidar", config=WorldConfig(length_m=3.0, clutter=0, **exact, walkers=6))
    assert np.array_equal(alone.drive.poses, among.drive.poses)
    seen = 0
    for a, b in zip(alone.readings(), among.readings(), strict=True):
        nearer = np.flatnonzero(np.isfinite(b.values_m) & (a.values_m != b.values_m))
        assert (b.values_m[nearer] < a.values_m[nearer]).all()
        rays = among.sensor.directions[nearer] * b.values_m[nearer, None]
        time_s = b.time_s + among.sensor.offsets_s[nearer]
        T = among.sensor.T_base_sensor
        points = rays @ T[:3, :3].T + T[:3, 3]
        pose = among.drive.at(time_s)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x = pose[:, 0] + c * points[:, 0] - s * points[:, 1]
        y = pose[:, 1] + s * points[:, 0] + c * points[:, 1]
        for walker in among.walkers:
            at = walker.walk.at(time_s)
            on_it = np.abs(np.hypot(x - at[:, 0], y - at[:, 1]) - walker.radius_m) < 1e-3
            seen += int(on_it.sum())
            nearer = nearer[~on_it]
            x, y, time_s, points = x[~on_it], y[~on_it], time_s[~on_it], points[~on_it]
        assert len(nearer) == 0
    assert seen > 500
