"""A robot drives up a ramp: the rising floor in front of it is not a wall."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from pc2grid.model import Scan
from pc2grid.pipeline import map_scans
from pc2grid.simulate.scene import Mesh, Scene, prism, quads
from signature.config import Config

LENGTH_M, HALF_WIDTH_M, CEILING_M, RISE_M = 20.0, 1.5, 2.6, 0.5
PROFILE_M = np.array([(0.0, 0.0), (6.0, 0.0), (12.0, RISE_M), (LENGTH_M, RISE_M)])
"""Of the floor, x and z: 1 in 12, the steepest that building codes allow wheelchairs."""


def floor_m(x: float) -> float:
    return float(np.interp(x, *PROFILE_M.T))


def corridor() -> Scene:
    faces = []
    for (x0, z0), (x1, z1) in itertools.pairwise(PROFILE_M):
        y, h = HALF_WIDTH_M, CEILING_M
        faces += [[(x0, -y, z0 + up), (x1, -y, z1 + up), (x1, y, z1 + up), (x0, y, z0 + up)] for up in (0, h)]
        faces += [[(x0, s, z0), (x1, s, z1), (x1, s, z1 + h), (x0, s, z0 + h)] for s in (-y, y)]
    faces += [
        [(x, -y, z), (x, y, z), (x, y, z + h), (x, -y, z + h)] for x, z in (PROFILE_M[0], PROFILE_M[-1])
    ]
    pillars = [
        prism(np.array([(x, s * 1.1), (x + 0.4, s * 1.1), (x + 0.4, s * 1.5), (x, s * 1.5)]), -0.5, 3.5)
        for x, s in ((3, -1), (5, 1), (8, -1), (10.5, 1), (13, -1), (16, 1))
    ]
    return Scene(Mesh.join([quads(np.array(faces)), *pillars]))


def drive() -> Iterator[Scan]:
    """A lidar 0.5 m above a robot that stands on its wheels, 0.25 m before and behind its middle."""
    scene, rng = corridor(), np.random.default_rng(0)
    bearing, up = np.meshgrid(np.radians(np.arange(-180, 180, 2.0)), np.radians(np.linspace(-15, 15, 16)))
    beams = np.stack((np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)), axis=-1)
    beams = beams.reshape(-1, 3)
    mount = np.eye(4)
    mount[2, 3] = 0.5
    for k, x in enumerate(np.arange(1.0, 17.0, 0.25)):
        low, high = floor_m(x - 0.25), floor_m(x + 0.25)
        c, s = math.cos(math.atan2(high - low, 0.5)), math.sin(math.atan2(high - low, 0.5))
        R = np.array([(c, 0, -s), (0, 1, 0), (s, 0, c)])
        eye = np.array([x, 0.0, (low + high) / 2]) + R @ mount[:3, 3]
        rays = np.concatenate((np.tile(eye, (len(beams), 1)), beams @ R.T), axis=1)
        ranges = scene.cast(rays.astype(np.float32))
        points = beams * (ranges + rng.normal(0, 0.01, len(beams)))[:, None]
        yield Scan(
            stamp_ns=int(k * 2e8),
            points_m=points[np.isfinite(ranges)].astype(np.float32),
            T_base_sensor=mount,
            sensor="lidar",
        )


def test_a_ramp_that_was_driven_up_is_free() -> None:
    grid, trajectory, _ = map_scans(drive(), Config())
    assert np.abs(trajectory.planar()[-1] - (15.75, 0.0, 0.0)).max() < 0.1
    cells = np.argwhere(grid.cells >= 0)
    x, y = grid.to_point(cells).T
    x = x + 1.0  # the map begins where the robot stood first
    inside = (np.abs(y) < 1.0) & (x > 0.2) & (x < LENGTH_M - 0.2)
    assert inside.sum() > 0.95 * (2.0 * (LENGTH_M - 0.4)) / grid.resolution_m**2
    assert grid.free[tuple(cells[inside].T)].mean() > 0.995
    assert not grid.occupied[tuple(cells[inside].T)].any()
