"""The drive of a simulated robot: its route through free space, its motion along it, and its wheel odometry.

The route leads first to places that the robot has not visited. The motion has speeds, turns in place and
short stops.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from pc2grid.errors import ConfigError
from pc2grid.geometry import F32, F64, I64, SE2, frozen_arrays, wrap_angle
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.config import DriveConfig, OdometryConfig
from pc2grid.simulate.plan import clearance_m

# --- the motion along a route -------------------------------------------------------------------------

RATE_HZ = 100.0
"""Samples of a drive in a second."""
_PAUSE_S = (0.5, 2.5)  # shortest and longest stop
_SMOOTHING_S = 0.08  # standard deviation in time that inertia gives to every change of speed
_LEAST_MPS = 0.02  # mean speed of a step; keeps the time of a step finite


@dataclass(frozen=True, slots=True)
@frozen_arrays(poses=(np.float64, "N", 3))
class Drive:
    """The true motion of the base, sampled evenly from time 0.

    poses : (N, 3) x, y, yaw in the map frame, RATE_HZ apart; metres and radians, yaw without jumps.
    """

    poses: F64

    @property
    def duration_s(self) -> float:
        """Return the time of the last pose."""
        return (len(self.poses) - 1) / RATE_HZ

    @property
    def length_m(self) -> float:
        """Return the distance driven."""
        return float(np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=1).sum())

    def at(self, times_s: F64) -> F64:
        """Return poses (..., 3) at times (...) in seconds; before the start and after the end the robot
        stands."""
        position = np.clip(np.asarray(times_s) * RATE_HZ, 0, len(self.poses) - 1)
        low = np.minimum(position.astype(np.int64), max(len(self.poses) - 2, 0))
        high = np.minimum(low + 1, len(self.poses) - 1)
        part = (position - low)[..., None]
        return np.asarray((1 - part) * self.poses[low] + part * self.poses[high])

    def pose(self, time_s: float) -> SE2:
        """Return T_map_base at a time."""
        x, y, yaw = (float(v) for v in self.at(np.array(time_s)))
        return SE2(x, y, wrap_angle(yaw))


def drive_along(points: F64, turns: I64, config: DriveConfig, rng: np.random.Generator) -> Drive:
    """Drive a route of `plan_route` from rest to rest, with random short stops and a stop at each turn."""
    last = len(points) - 1
    gap = config.pause_every_m
    steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
    pauses = np.cumsum(rng.exponential(gap, size=int(3 * float(steps_m.sum()) / gap) + 10))
    driven = np.concatenate(([0.0], np.cumsum(steps_m)))
    stops = {int(np.searchsorted(driven, s)): float(rng.uniform(*_PAUSE_S)) for s in pauses if s < driven[-1]}
    ends = [0, *(int(v) for v in turns if 0 < v < last), last]
    yaw = float(_headings(points[: ends[1] + 1])[0])
    times, poses = [np.array([0.0, 0.5])], [np.tile([*points[0], yaw], (2, 1))]
    for a, b in pairwise(ends):
        line = points[a : b + 1]
        yaws = _headings(line)
        spin = wrap_angle(float(yaws[0]) - yaw)
        if abs(spin) > 1e-3:
            when, angles = _turn(spin, config)
            times.append(times[-1][-1] + when)
            poses.append(np.column_stack((np.tile(line[0], (len(when), 1)), yaw + angles)))
        yaws += yaw + spin - yaws[0]
        cuts = sorted({a, b, *(s for s in stops if a + 10 < s < b - 10)})
        for c, d in pairwise(cuts):
            part, headings = points[c : d + 1], yaws[c - a : d - a + 1]
            times.append(times[-1][-1] + _follow(part, headings, config))
            poses.append(np.column_stack((part, headings)))
            if d in stops:
                times.append(times[-1][-1:] + stops[d])
                poses.append(poses[-1][-1:])
        yaw = float(yaws[-1])
    when, where = np.concatenate(times), np.concatenate(poses)
    even = np.arange(int(when[-1] * RATE_HZ) + 1) / RATE_HZ
    sampled = np.column_stack([np.interp(even, when, where[:, k]) for k in range(3)])
    return Drive(gaussian_filter1d(sampled, _SMOOTHING_S * RATE_HZ, axis=0, mode="nearest"))


def _headings(points_m: F64) -> F64:
    """Return the direction of the line at each of its points, radians, without jumps of 2 pi."""
    reach = min(2, len(points_m) - 1)
    index = np.arange(len(points_m))
    ahead = points_m[np.minimum(index + reach, len(points_m) - 1)]
    direction = ahead - points_m[np.maximum(index - reach, 0)]
    return np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))


def _follow(points_m: F64, yaws: F64, config: DriveConfig) -> F64:
    """Return times (N,) along a line, starting and ending at rest, within speed, yaw rate and
    acceleration."""
    steps = np.maximum(np.linalg.norm(np.diff(points_m, axis=0), axis=1), 1e-6)
    curvature = np.abs(np.gradient(yaws)) / np.gradient(np.concatenate(([0.0], np.cumsum(steps))))
    curvature = maximum_filter1d(curvature, 5)
    speed = np.minimum(config.speed_mps, config.yaw_rate_rps / np.maximum(curvature, 1e-3))
    speed[0] = speed[-1] = 0.0
    for way, step in ((speed, steps), (speed[::-1], steps[::-1])):  # speeding up, then braking
        for i in range(1, len(way)):
            way[i] = min(way[i], np.sqrt(way[i - 1] ** 2 + 2 * config.acceleration_mps2 * step[i - 1]))
    seconds = 2 * steps / np.maximum(speed[1:] + speed[:-1], _LEAST_MPS)
    seconds = np.maximum(seconds, np.abs(np.diff(yaws)) / config.yaw_rate_rps)
    return np.concatenate(([0.0], np.cumsum(seconds)))


def _turn(angle_rad: float, config: DriveConfig) -> tuple[F64, F64]:
    """Return times and angles of a turn in place with a trapezoidal profile of the yaw rate."""
    size = abs(angle_rad)
    top = min(config.yaw_rate_rps, np.sqrt(size * config.yaw_acceleration_rps2))
    ramp_s = top / config.yaw_acceleration_rps2
    total_s = ramp_s + size / top
    times = np.linspace(0, total_s, max(int(total_s * RATE_HZ), 2))
    up = np.minimum(times, ramp_s)
    down = np.maximum(times - (total_s - ramp_s), 0)
    angles = top * (times - up) + config.yaw_acceleration_rps2 * (up**2 - down**2) / 2
    return times, np.sign(angle_rad) * angles


# --- the route ----------------------------------------------------------------------------------------

STEP_M = 0.05
"""Distance between two points of a route."""
SEEN_M = 1.5
"""Places this near to the route count as visited."""
START_M = 1.0
"""A start may be this far from the nearest place where the robot fits."""
_LATTICE_M = 0.1  # distance between the points among which the route is planned


# A centre has this share of the largest clearance within the window.
_CENTRE_WINDOW_M, _CENTRE_SHARE = 0.6, 0.95


# With less clearance than this beyond the necessary one, an edge counts up to 1 + `_DISCOMFORT` times.
_COMFORT_M, _DISCOMFORT = 0.5, 2.0
_SEARCH_M = (8.0, 30.0, math.inf)  # goals are searched for within these distances, one after another
_NEAREST_GOAL_M = 0.5
_BLOCK_M, _TASTE_M = 2.0, 4.0  # edge of a block, and largest detour for its preference
_AHEAD_M = 1.5  # detour accepted for a goal that lies ahead and not beside
_LONGER, _LONGER_M = 1.3, 2.0


def plan_route(
    grid: OccupancyGrid,
    blocked: NDArray[np.bool_],
    length_m: float,
    *,
    start_m: tuple[float, float] | None,
    least_m: float,
    rng: np.random.Generator,
) -> tuple[F64, I64]:
    """Plan a route of `length_m` that stays `least_m` away from everything that is not free.

    Returns its points (N, 2) in the map frame, about STEP_M apart, and the increasing indices (K,) of those
    where the robot stops and turns in place.

    blocked : (H, W) cells below clutter. Places that were not visited come first; at dead ends the robot
    turns; later it comes back to places, which closes loops. Raises ConfigError if there is no room, or none
    at the start.
    """
    clearance = clearance_m(grid.free & ~blocked, grid.resolution_m)
    lattice = _lattice(grid, clearance, least_m, start_m)
    if start_m is None:
        centres = np.flatnonzero(lattice.centres)
        at = int(centres[rng.integers(len(centres))])
    else:
        at = int(np.argmin(np.linalg.norm(lattice.points_m - start_m, axis=1)))
    legs = _legs(lattice, at, rng)
    # The line is smooth between two turns in place.
    segments: list[list[F64]] = [[lattice.points_m[[at]]]]
    driven_m = 0.0
    # Smoothing shortens the line, so more than the length is planned.
    while driven_m < _LONGER * length_m + _LONGER_M:
        leg, turns_before = next(legs)
        driven_m += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        if turns_before:
            segments.append([leg[:1]])
        segments[-1].append(leg[1:])
    lines = [_smooth(np.concatenate(part), grid, clearance, least_m) for part in segments]
    points = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
    turns = np.cumsum([len(line) - 1 for line in lines])
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    last = min(int(np.searchsorted(lengths, length_m)), len(points) - 1)
    return points[: last + 1], turns[turns < last]


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Passable points some cells apart, connected with their neighbours.

    points_m : (N, 2). graph : (N, N) sparse; the weight of an edge is its length, and up to three times that
    near walls. centres : (N,) True where the clearance is about the largest around.
    """

    points_m: F64
    graph: Any
    centres: NDArray[np.bool_]


def _lattice(
    grid: OccupancyGrid, clearance: F32, least_m: float, start_m: tuple[float, float] | None
) -> _Lattice:
    """Return the largest connected part of the passable space, or the one that contains the start.

    Raises ConfigError if nothing is passable, or nothing within `START_M` of the start.
    """
    stride = max(1, round(_LATTICE_M / grid.resolution_m))
    here = clearance[::stride, ::stride]
    passable = here >= least_m
    labels, count = ndimage.label(passable, np.ones((3, 3), bool))
    if count == 0:
        raise ConfigError(
            f"no free space of the map is {2 * least_m:.2f} m wide",
            hint="lower drive.clearance_m, or check resolution and thresholds of the map",
        )
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    label = int(np.argmax(sizes))
    if start_m is not None:
        cells = np.argwhere(passable)
        away = np.linalg.norm(grid.to_point(cells * stride) - start_m, axis=1)
        if away.min() > START_M:
            x, y = grid.to_point(cells[[np.argmin(away)]] * stride)[0]
            raise ConfigError(
                f"the start ({start_m[0]:g}, {start_m[1]:g}) is {away.min():.1f} m from where a robot fits",
                hint=f"the nearest such place is ({x:.2f}, {y:.2f})",
            )
        near = labels[tuple(cells[away <= START_M].T)]
        label = int(near[np.argmax(sizes[near])])
    part = labels == label
    size = 2 * round(_CENTRE_WINDOW_M / (stride * grid.resolution_m)) + 1
    centres = part & (here >= _CENTRE_SHARE * ndimage.maximum_filter(np.where(part, here, 0), size=size))
    number = np.full(part.shape, -1, np.int64)
    cells = np.argwhere(part)
    number[part] = np.arange(len(cells))
    comfort_m = least_m + _COMFORT_M
    discomfort = 1 + _DISCOMFORT * np.clip((comfort_m - here) / comfort_m, 0, 1)
    padded = np.pad(number, 1, constant_values=-1)
    height, width = part.shape
    cost = discomfort[part]
    rows, columns, weights = [], [], []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = padded[1 + dr : 1 + dr + height, 1 + dc : 1 + dc + width]
        edge = part & (other >= 0)
        a, b = number[edge], other[edge]
        rows.append(a)
        columns.append(b)
        weights.append(math.hypot(dr, dc) * stride * grid.resolution_m * (cost[a] + cost[b]) / 2)
    shape = (len(cells), len(cells))
    graph = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    return _Lattice(grid.to_point(cells * stride), graph.tocsr(), centres[part])


def _legs(lattice: _Lattice, at: int, rng: np.random.Generator) -> Iterator[tuple[F64, bool]]:
    """Yield the points (N, 2) to one goal after another, and whether the robot turns before it goes there.

    A goal is near, not visited, and preferably ahead. When everything is visited, a random place far away
    becomes the goal and all places count as new.
    """
    points, tree = lattice.points_m, cKDTree(lattice.points_m)
    new = np.ones(len(points), bool)
    # A random preference for each block of the map makes the routes of two seeds differ.
    blocks = np.floor((points - points.min(axis=0)) / _BLOCK_M).astype(int)
    taste_m = rng.uniform(0, _TASTE_M, size=blocks.max(axis=0) + 1)[blocks[:, 0], blocks[:, 1]]
    path = [at]
    heading: F64 | None = None
    while True:
        for near in tree.query_ball_point(points[path[::5]], SEEN_M):
            new[near] = False
        for limit in _SEARCH_M:
            away, before = dijkstra(
                lattice.graph, directed=False, indices=at, return_predecessors=True, limit=limit
            )
            goals = np.flatnonzero(lattice.centres & new & np.isfinite(away) & (away > _NEAREST_GOAL_M))
            if len(goals):
                break
        else:
            new[:] = True
            reachable = np.isfinite(away)
            goals = np.flatnonzero(reachable & (away > 0.5 * away[reachable].max()))
            if len(goals) == 0:
                raise ConfigError("the free space is too small to drive in", hint="choose another --start")
            goals = goals[[rng.integers(len(goals))]]
        score = away[goals] + taste_m[goals]
        if heading is not None:
            direction = points[goals] - points[at]
            score += _AHEAD_M * (1 - direction @ heading / np.linalg.norm(direction, axis=1))
        path = [int(goals[np.argmin(score)])]
        while path[-1] != at:
            path.append(int(before[path[-1]]))
        path.reverse()
        at, leg = path[-1], points[path]
        leaving = leg[min(5, len(leg) - 1)] - leg[0]
        yield leg, heading is not None and bool(heading @ leaving < 0)
        arriving = leg[-1] - leg[max(-6, -len(leg))]
        heading = arriving / np.linalg.norm(arriving)


def _smooth(points_m: F64, grid: OccupancyGrid, clearance: F32, least_m: float) -> F64:
    """Put the points of a line STEP_M apart, and straighten it as far as its clearance allows (an elastic
    band); its ends stay."""
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))))
    count = max(round(float(lengths[-1]) / STEP_M), 1)
    at = np.linspace(0, lengths[-1], count + 1)
    band = np.column_stack([np.interp(at, lengths, points_m[:, k]) for k in (0, 1)])
    if len(band) < 3:
        return band

    def room(at_m: F64) -> F32:
        cell = grid.to_cell(at_m)
        return clearance[cell[:, 0], cell[:, 1]]

    wanted = np.minimum(room(band), least_m)
    for reach in (8, 4, 2, 1):
        for _ in range(30):
            n = len(band)
            index = np.arange(n)
            k = np.minimum(np.minimum(index, n - 1 - index), reach)
            moved = 0.5 * band + 0.25 * (band[index - k] + band[index + k])
            ok = room(moved) >= wanted
            band[ok] = moved[ok]
    return band


# --- wheel odometry -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
@frozen_arrays(times_s=(np.float64, "N"), poses=(np.float64, "N", 3))
class SimulatedOdometry:
    """Odometry as the robot publishes it, starting at the identity.

    times_s : (N,) since the session's start. poses : (N, 3) x, y, yaw of the base in the odom frame, metres
    and radians, yaw without jumps.
    """

    times_s: F64
    poses: F64

    def at(self, time_s: float) -> SE2:
        """Return T_odom_base between two messages."""
        x, y, yaw = (float(np.interp(time_s, self.times_s, self.poses[:, k])) for k in range(3))
        return SE2(x, y, math.remainder(yaw, 2 * math.pi))


def odometry_of(drive: Drive, config: OdometryConfig, rng: np.random.Generator) -> SimulatedOdometry:
    """Integrate the steps of the drive with the errors of wheel odometry.

    Three relative errors are added to the distance and rotation of each step: slip, which is correlated over
    `slip_s` (an Ornstein-Uhlenbeck process), a bias that is constant in the session, and a rotation per metre
    driven. The error grows with the distance, and not while the robot stands.
    """
    step_s = 1.0 / config.rate_hz
    times_s = (np.arange(math.floor(drive.duration_s * config.rate_hz) + 2) * step_s).astype(np.float64)
    x, y, yaw = drive.at(times_s).T
    middle = (yaw[1:] + yaw[:-1]) / 2
    forward = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    turn = np.diff(yaw)
    steps = len(turn)
    bias_forward, bias_turn, veer = rng.standard_normal(3) * (
        config.distance_bias,
        config.rotation_bias,
        config.veer_rpm,
    )
    slip_forward = _slip(steps, config.distance_error, step_s, config.slip_s, rng)
    slip_turn = _slip(steps, config.rotation_error, step_s, config.slip_s, rng)
    turn = turn * (1 + bias_turn + slip_turn) + veer * np.abs(forward)
    forward = forward * (1 + bias_forward + slip_forward)
    poses = np.zeros((steps + 1, 3))
    poses[1:, 2] = np.cumsum(turn)
    middle = poses[:-1, 2] + turn / 2
    poses[1:, 0] = np.cumsum(forward * np.cos(middle))
    poses[1:, 1] = np.cumsum(forward * np.sin(middle))
    return SimulatedOdometry(times_s, poses)


def _slip(steps: int, error: float, step_s: float, memory_s: float, rng: np.random.Generator) -> F64:
    """Return relative errors (steps,) of standard deviation `error`, correlated over `memory_s`."""
    keep = math.exp(-step_s / memory_s)
    white = rng.standard_normal(steps) * error * math.sqrt(1 - keep * keep)
    first = error * rng.standard_normal()
    slip = itertools.accumulate(white.tolist(), lambda before, new: keep * before + new, initial=first)
    return np.array([*slip][1:])
