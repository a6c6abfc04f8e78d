"""Two rooms with the same plan, of which one is higher, as points; and a robot's scans of one of them."""

import math

import numpy as np

from pc2grid.geometry import F64, SE2, invert_pose, pose_from_rotation_vector, transform_points
from pc2grid.model import Health, PointMap, RegisteredScan, Scan
from tests.helpers.building_clouds import box_surface

PLAN_M = (6.0, 5.0)
HEIGHTS_M = (2.5, 3.1)
APART_M = 20.0
"""The lower room begins at (0, 0), the higher one so far along x."""


def room(height_m: float, *, cupboard: bool = False) -> F64:
    """The surfaces (N, 3) of a room with an alcove wall, so that no turn of it looks the same."""
    x, y = PLAN_M
    parts = [
        box_surface((0, 0, 0), (x, y, 0)),
        box_surface((0, 0, height_m), (x, y, height_m)),
        box_surface((0, 0, 0), (0, y, height_m)),
        box_surface((x, 0, 0), (x, y, height_m)),
        box_surface((0, 0, 0), (x, 0, height_m)),
        box_surface((0, y, 0), (x, y, height_m)),
        box_surface((0, 3.5, 0), (1.5, 3.5, height_m)),
    ]
    if cupboard:
        left, front, top = 2.5, 3.6, 1.8
        parts += [
            box_surface((left, front, 0), (x, front, top)),
            box_surface((left, front, 0), (left, y, top)),
        ]
    return np.concatenate(parts)


def furnished_map() -> PointMap:
    """The points of two rooms of the lower height, with a cupboard in the second only."""
    first, second = room(HEIGHTS_M[0]), room(HEIGHTS_M[0], cupboard=True)
    return PointMap.of(np.concatenate((first, second + np.array((APART_M, 0.0, 0.0)))), 0.05)


def twin_map() -> PointMap:
    """The points of both rooms."""
    low, high = map(room, HEIGHTS_M)
    return PointMap.of(np.concatenate((low, high + np.array((APART_M, 0.0, 0.0)))), 0.05)


def drive(height_m: float, *, cupboard: bool = False) -> list[tuple[RegisteredScan, F64]]:
    """Scans of a lidar 1 m above its base, which drives 1 m in a room; each with its true pose T_room_base.

    The session frame is 0.4 m above the floor, and the base tilts by a degree.
    """
    surfaces = room(height_m, cupboard=cupboard)
    rng = np.random.default_rng(0)
    T_base_sensor = np.eye(4)
    T_base_sensor[2, 3] = 1.0
    scans = []
    tilt = pose_from_rotation_vector([math.radians(1.0), 0.0, 0.0])
    T_room_session = SE2(2.5, 2.0, 0.7).lift()
    T_room_session[2, 3] = 0.4
    for k in range(6):
        T_session_base = SE2(0.2 * k, 0.0, 0.1 * k).lift() @ tilt
        T_session_base[2, 3] -= 0.4
        T_room_base = T_room_session @ T_session_base
        points = transform_points(invert_pose(T_room_base), surfaces)
        # The alcove hides what lies behind it.
        sensor = (T_room_base @ T_base_sensor)[:3, 3]
        hidden = (surfaces[:, 0] < 1.5) & (surfaces[:, 1] > 3.55) & (sensor[1] < 3.5)
        seen = points[~hidden][rng.random((~hidden).sum()) < 0.5]
        scan = Scan(
            stamp_ns=k,
            points_m=seen + rng.normal(0.0, 0.01, seen.shape),
            T_base_sensor=T_base_sensor,
            sensor="lidar",
        )
        registered = RegisteredScan(scan=scan, T_session_base=T_session_base, health=Health.FINE)
        scans.append((registered, T_room_base))
    return scans
