"""A flat of seven rooms, through which a depth camera is carried; the height of its odometry drifts."""

import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from pc2grid.geometry import F32, F64, pose_from_rotation_vector
from pc2grid.model import Scan
from pc2grid.simulate.scene import OPTICAL, Scene, prism

STEP_M, TURN_RAD = 0.25, 0.35  # between two images
Point = tuple[float, float]
_CORRIDOR = (0.0, 1.3)  # its lowest and highest y; x from 0 to 10.5 m
_DOORS = {1.3: (1.2, 3.8, 6.4, 9.0), 0.0: (1.7, 5.2, 8.8)}  # of its walls at y: the middles of doors
_DEEP_M = 3.4  # the rooms
_FURNITURE = (  # lowest corner, highest corner, bottom, top
    ((0.1, 3.4), (2.0, 4.7), 0.0, 0.5),
    ((2.8, 2.4), (3.3, 4.7), 0.0, 2.0),
    ((4.2, 3.7), (5.2, 4.4), 0.68, 0.72),
    ((5.4, 4.0), (7.5, 4.7), 0.0, 0.45),
    ((8.2, 3.6), (9.6, 4.5), 0.7, 0.74),
    ((9.9, 2.2), (10.4, 3.6), 0.0, 1.1),
    ((0.1, -3.3), (0.7, -1.0), 0.0, 0.9),
    ((2.4, -3.3), (3.3, -2.4), 0.0, 2.1),
    ((4.3, -3.3), (6.3, -1.9), 0.0, 0.5),
    ((7.6, -3.3), (9.0, -2.6), 0.68, 0.72),
    ((9.8, -1.8), (10.4, -0.9), 0.0, 1.8),
)


def box(low: Point, high: Point, bottom_m: float, top_m: float) -> F32:
    (a, b), (c, d) = low, high
    return prism(np.array([(a, b), (c, b), (c, d), (a, d)]), bottom_m, top_m)


def scene() -> Scene:
    """Walls with doors 0.9 m wide and 2 m high, furniture, a floor and a ceiling of 2.5 m."""
    low, high = _CORRIDOR[0] - _DEEP_M, _CORRIDOR[1] + _DEEP_M
    parts = [box((0.0, low), (10.5, high), 0.0, 2.5)]
    for y, doors in _DOORS.items():
        ends = [0.0, *(x + side for x in doors for side in (-0.45, 0.45)), 10.5]
        for first, last in zip(ends[::2], ends[1::2], strict=True):
            parts.append(box((first, y - 0.05), (last, y + 0.05), 0.0, 2.5))
        parts += [box((x - 0.45, y - 0.05), (x + 0.45, y + 0.05), 2.0, 2.5) for x in doors]
    parts += [box((x - 0.05, 1.3), (x + 0.05, high), 0.0, 2.5) for x in (2.5, 5.3, 7.8)]
    parts += [box((x - 0.05, low), (x + 0.05, 0.0), 0.0, 2.5) for x in (3.5, 7.0)]
    return Scene(np.concatenate([*parts, *(box(*thing) for thing in _FURNITURE)]))


CORRIDOR: tuple[Point, ...] = ((0.5, 0.65), (10.0, 0.65), (0.5, 0.65))
"""Down the corridor and back."""


def rooms() -> tuple[Point, ...]:
    """Into every room on the way down the corridor."""
    visits = sorted((x, y) for y, doors in _DOORS.items() for x in doors)
    stops = [CORRIDOR[0]]
    for x, y in visits:
        stops += [(x, 0.65), (x, 2.5 if y > 0.0 else -1.2), (x, 0.65)]
    return (*stops, CORRIDOR[1])


def carried(stops: Sequence[Point], down_deg: float = 20.0) -> list[F64]:
    """T_flat_base of a camera 1.4 m high, looking down by 12 degrees more and less; it turns at each stop."""
    way: list[tuple[float, float, float]] = []
    yaw = 0.0
    for (x, y), (u, v) in itertools.pairwise(stops):
        turn = math.remainder(math.atan2(v - y, u - x) - yaw, 2.0 * math.pi)
        turns, ahead = math.ceil(abs(turn) / TURN_RAD), math.ceil(math.hypot(u - x, v - y) / STEP_M)
        way += [(x, y, yaw + turn * k / turns) for k in range(turns)]
        yaw += turn
        way += [(x + (u - x) * k / ahead, y + (v - y) * k / ahead, yaw) for k in range(ahead)]
    poses = []
    for k, (x, y, heading) in enumerate(way):
        tilt = (0.03 * math.sin(0.5 * k), math.radians(down_deg + 12.0 * math.sin(0.21 * k)), 0.0)
        pose = pose_from_rotation_vector((0.0, 0.0, heading)) @ pose_from_rotation_vector(tilt)
        pose[:3, 3] = x, y, 1.4 + 0.03 * math.sin(0.9 * k)
        poses.append(pose)
    return poses


def rising(poses: Sequence[F64], share: float) -> list[F64]:
    """The poses by an odometry whose height rises by a share of the way."""
    way_m = np.cumsum([0.0, *(float(np.linalg.norm((b - a)[:2, 3])) for a, b in itertools.pairwise(poses))])
    risen = [pose.copy() for pose in poses]
    for pose, rise_m in zip(risen, share * way_m, strict=True):
        pose[2, 3] += rise_m
    return risen


def images(poses: Sequence[F64], odometry: Sequence[F64]) -> Iterator[Scan]:
    """What the camera sees at its poses in the flat, five times a second."""
    return camera_images(scene(), poses, odometry, half=(0.77, 0.58), noise_per_m=0.002, holes=0.1)


def camera_images(
    scene: Scene,
    poses: Sequence[F64],
    odometry: Sequence[F64],
    *,
    half: tuple[float, float],
    noise_per_m: float,
    holes: float,
    flying: float = 0.0,
    interval_ns: int = 200_000_000,
) -> Iterator[Scan]:
    """What a depth camera sees up to 5 m. half : tangents of half its view, right and down. holes, flying :
    shares of its pixels without a depth, and of those at edges whose depth lies between both surfaces."""
    rng = np.random.default_rng(1)
    right, down = (np.linspace(-side, side, count) for side, count in zip(half, (96, 72), strict=True))
    v, u = np.meshgrid(down, right, indexing="ij")
    rays = np.column_stack((u.ravel(), v.ravel(), np.ones(u.size)))
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3] = OPTICAL
    for k, (T, T_odom_base) in enumerate(zip(poses, odometry, strict=True)):
        T_room_camera = T @ T_base_camera
        ahead = rays @ T_room_camera[:3, :3].T
        start = np.tile(T_room_camera[:3, 3], (len(rays), 1))
        depth = scene.cast(np.hstack((start, ahead)).astype(np.float32)).astype(np.float64)
        if flying:
            beside = np.roll(depth, 1)
            between = (np.abs(beside - depth) > 0.1) & (rng.random(len(depth)) < flying)
            depth = np.where(between, 0.5 * (beside + depth), depth)
        depth += noise_per_m * depth**2 * rng.standard_normal(len(depth))
        seen = np.isfinite(depth) & (depth < 5.0) & (rng.random(len(depth)) > holes)
        points = ((depth[seen, None] * rays[seen]) @ T_base_camera[:3, :3].T).astype(np.float32)
        yield Scan(
            stamp_ns=interval_ns * k, points_m=points, T_base_sensor=T_base_camera, sensor="depth",
            T_odom_base=T_odom_base,
        )  # fmt: skip
