"""Clouds of small buildings, for what turns a cloud into a map or drives through it."""

import math

import numpy as np

from pc2grid.geometry import F64, pose_from_rotation_vector, transform_points

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


def rooms_cloud(rooms: int = 2, *, ceiling: bool = True, furniture: bool = True) -> F64:
    """Rooms (N, 3) of 5 x 5 x 2.7 m in a row, floor at z = 0, with a door between neighbours.

    furniture : a table and a cupboard in each, and a lamp below its ceiling.
    """
    width_m, height_m, door_m = 5.0, 2.7, 2.05
    length_m = rooms * width_m
    parts = [box_surface((0, 0, 0), (length_m, width_m, 0))]
    parts += [box_surface((0, y, 0), (length_m, y, height_m)) for y in (0.0, width_m)]
    parts += [box_surface((x, 0, 0), (x, width_m, height_m)) for x in (0.0, length_m)]
    for x in width_m * np.arange(1, rooms):
        parts += [
            box_surface((x, 0, 0), (x, 1.5, height_m)),
            box_surface((x, 2.4, 0), (x, width_m, height_m)),
        ]
        parts.append(box_surface((x, 1.5, door_m), (x, 2.4, height_m)))
    if ceiling:
        parts.append(box_surface((0, 0, height_m), (length_m, width_m, height_m)))
    for x in width_m * np.arange(rooms) if furniture else ():
        parts.append(box_surface((x + 0.4, 3.8, 0), (x + 2.0, 4.7, 0.75)))
        parts.append(box_surface((x + 3.2, 0.1, 0), (x + 4.2, 0.6, 1.8)))
        if ceiling:
            parts.append(box_surface((x + 2.0, 2.2, 2.4), (x + 3.2, 2.5, 2.6)))
    return np.concatenate(parts)


def hall_cloud() -> F64:
    """An open hall (N, 3) of 12 x 8 m without a ceiling, with two boxes. Most of its points are floor."""
    x, y, z = 12.0, 8.0, 1.0
    walls = [box_surface((0, at, 0), (x, at, z)) for at in (0.0, y)]
    walls += [box_surface((at, 0, 0), (at, y, z)) for at in (0.0, x)]
    boxes = [box_surface((at, 3, 0), (at + 0.8, 3.6, 0.6)) for at in (3.0, 8.0)]
    return np.concatenate((box_surface((0, 0, 0), (x, y, 0)), *walls, *boxes))


def raised(points: F64, height_m: float) -> F64:
    """Points (N, 3) higher by a height."""
    higher: F64 = points + np.array([0.0, 0.0, height_m])
    return higher


def turned(points: F64, axis: tuple[float, float, float], angle_deg: float) -> F64:
    """Points (N, 3) turned about an axis through the origin."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return transform_points(pose_from_rotation_vector(math.radians(angle_deg) * unit), points)
