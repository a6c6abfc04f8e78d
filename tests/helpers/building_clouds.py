"""Clouds of small buildings, for what turns a cloud into a map or drives through it."""

from __future__ import annotations

import math

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import pose_from_rotation_vector, transform_points

SPACING_M = 0.05
ROOM_M = (8.0, 6.0, 2.5)


def box_surface(low_m: tuple[float, float, float], high_m: tuple[float, float, float]) -> F64:
    """Points (N, 3) on a lattice that fill a box."""
    axes = [np.arange(a, max(b, a + 1e-6), SPACING_M) for a, b in zip(low_m, high_m, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def room_cloud(height_m: float = 0.0, tilt_deg: float = 0.0) -> F64:
    """A furnished room (N, 3): floor, four walls, ceiling, a pillar, and a table that stands on its legs.

    height_m : of the floor. tilt_deg : of the whole room about its x axis.
    """
    x, y, z = ROOM_M
    parts = [
        box_surface((0, 0, 0), (x, y, 0)),
        box_surface((0, 0, z), (x, y, z)),
        box_surface((0, 0, 0), (0, y, z)),
        box_surface((x, 0, 0), (x, y, z)),
        box_surface((0, 0, 0), (x, 0, z)),
        box_surface((0, y, 0), (x, y, z)),
        box_surface((5, 3, 0), (5.5, 3.5, z)),
        box_surface((1, 4, 0.7), (2.2, 4.8, 0.7)),
    ]
    T = pose_from_rotation_vector(np.array([math.radians(tilt_deg), 0.0, 0.0]))
    T[2, 3] = height_m
    return transform_points(T, np.concatenate(parts))
