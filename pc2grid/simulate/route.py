"""The route of a robot through free space: first to places that it has not visited."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from pc2grid.arrays import F32, F64, I64, freeze
from pc2grid.errors import ConfigError
from pc2grid.model import OccupancyGrid
from pc2grid.simulate.passage import clearance_m

STEP_M = 0.05
"""Distance between two points of a route."""

SEEN_M = 1.5
"""Places this near to the route count as visited."""

START_M = 1.0
"""A start may be this far from the nearest place where the robot fits."""

_LATTICE_M = 0.1  # distance between the points among which the route is planned
_CENTRE_WINDOW_M, _CENTRE_SHARE = (
    0.6,
    0.95,
)  # a centre has this share of the largest clearance within the window
_COMFORT_M, _DISCOMFORT = (
    0.5,
    2.0,
)  # with less clearance than this more than needed, an edge weighs up to 1 + 2
_SEARCH_M = (8.0, 30.0, math.inf)  # goals are looked for within these distances, one after another
_NEAREST_GOAL_M = 0.5
_BLOCK_M, _TASTE_M = 2.0, 4.0  # edge of a block, and largest detour for its preference
_AHEAD_M = 1.5  # detour accepted for a goal that lies ahead and not beside
_LONGER, _LONGER_M = 1.3, 2.0


@dataclass(frozen=True, slots=True)
class Route:
    """A line to drive along.

    points_m : (N, 2) in the map frame, about STEP_M apart.
    turns : (K,) increasing indices into points_m where the robot stops and turns in place.
    """

    points_m: F64
    turns: I64

    def __post_init__(self) -> None:
        freeze(self, "points_m", np.float64, (None, 2))
        freeze(self, "turns", np.int64, (None,))

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.linalg.norm(np.diff(self.points_m, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Passable points some cells apart, connected with their neighbours.

    points_m : (N, 2). cells : (N, 2) row, column. graph : (N, N) sparse; the weight of an edge is its length,
    and up to three times that near walls. centres : (N,) whether the clearance is about the largest around.
    """

    points_m: F64
    cells: I64
    graph: Any
    centres: NDArray[np.bool_]


def _lattice(
    grid: OccupancyGrid, clearance: F32, least_m: float, start_m: tuple[float, float] | None
) -> _Lattice:
    """The largest connected part of the passable space, or the one that contains the start.

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
    rows, columns, weights = [], [], []
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        other = padded[1 + dr : 1 + dr + height, 1 + dc : 1 + dc + width]
        edge = part & (other >= 0)
        a, b = number[edge], other[edge]
        rows.append(a)
        columns.append(b)
        cost = discomfort[part]
        weights.append(math.hypot(dr, dc) * stride * grid.resolution_m * (cost[a] + cost[b]) / 2)
    shape = (len(cells), len(cells))
    graph = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    return _Lattice(grid.to_point(cells * stride), cells * stride, graph.tocsr(), centres[part])


class _Explorer:
    """Chooses one goal after another; keeps which places were visited."""

    def __init__(self, lattice: _Lattice, at: int, rng: np.random.Generator) -> None:
        self.lattice = lattice
        self.at = at
        self.rng = rng
        self.new = np.ones(len(lattice.points_m), bool)
        self._tree = cKDTree(lattice.points_m)
        # A random preference for each block of the map makes the routes of two seeds differ.
        blocks = np.floor((lattice.points_m - lattice.points_m.min(axis=0)) / _BLOCK_M).astype(int)
        self._taste_m = rng.uniform(0, _TASTE_M, size=blocks.max(axis=0) + 1)[blocks[:, 0], blocks[:, 1]]
        self._visit(np.array([at]))

    def _visit(self, path: I64) -> None:
        for near in self._tree.query_ball_point(self.lattice.points_m[path[::5]], SEEN_M):
            self.new[near] = False

    def next_path(self, heading: F64 | None) -> I64:
        """Points (indices) to the next goal: near, not visited, and preferably ahead.

        When everything is visited, a random place far away becomes the goal and all places count as new.
        """
        points = self.lattice.points_m
        for limit in _SEARCH_M:
            away, before = dijkstra(
                self.lattice.graph, directed=False, indices=self.at, return_predecessors=True, limit=limit
            )
            goals = np.flatnonzero(
                self.lattice.centres & self.new & np.isfinite(away) & (away > _NEAREST_GOAL_M)
            )
            if len(goals):
                break
        else:
            self.new[:] = True
            reachable = np.isfinite(away)
            goals = np.flatnonzero(reachable & (away > 0.5 * away[reachable].max()))
            if len(goals) == 0:
                raise ConfigError("the free space is too small to drive in", hint="choose another --start")
            goals = goals[[self.rng.integers(len(goals))]]
        score = away[goals] + self._taste_m[goals]
        if heading is not None:
            direction = points[goals] - points[self.at]
            score += _AHEAD_M * (1 - direction @ heading / np.linalg.norm(direction, axis=1))
        goal = int(goals[np.argmin(score)])
        path = [goal]
        while path[-1] != self.at:
            path.append(int(before[path[-1]]))
        indices = np.array(path[::-1], dtype=np.int64)
        self._visit(indices)
        self.at = goal
        return indices


def _resample(points_m: F64) -> F64:
    """The same line with points STEP_M apart and the same ends."""
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))))
    count = max(round(float(lengths[-1]) / STEP_M), 1)
    at = np.linspace(0, lengths[-1], count + 1)
    return np.column_stack([np.interp(at, lengths, points_m[:, k]) for k in (0, 1)])


def _smooth(points_m: F64, grid: OccupancyGrid, clearance: F32, least_m: float) -> F64:
    """Straighten the line as far as its clearance allows (an elastic band); its ends stay."""
    if len(points_m) < 3:
        return points_m

    def room(at_m: F64) -> F32:
        cell = grid.to_cell(at_m)
        return clearance[cell[:, 0], cell[:, 1]]

    band = points_m.copy()
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


def plan_route(
    grid: OccupancyGrid,
    blocked: NDArray[np.bool_],
    length_m: float,
    *,
    start_m: tuple[float, float] | None,
    least_m: float,
    rng: np.random.Generator,
) -> Route:
    """A route of `length_m` that stays `least_m` away from everything that is not free.

    blocked : (H, W) cells below clutter. Places that were not visited come first; at dead ends the robot
    turns; later it comes back to places, which closes loops.
    Raises ConfigError if there is no room, or none at the start.
    """
    clearance = clearance_m(grid.free & ~blocked, grid.resolution_m)
    lattice = _lattice(grid, clearance, least_m, start_m)
    if start_m is None:
        centres = np.flatnonzero(lattice.centres)
        at = int(centres[rng.integers(len(centres))])
    else:
        at = int(np.argmin(np.linalg.norm(lattice.points_m - start_m, axis=1)))
    explorer = _Explorer(lattice, at, rng)
    # The line is smooth between two turns in place.
    segments: list[list[F64]] = [[lattice.points_m[[at]]]]
    heading: F64 | None = None
    driven_m = 0.0
    # Smoothing shortens the line, so more than the length is planned.
    while driven_m < _LONGER * length_m + _LONGER_M:
        leg = lattice.points_m[explorer.next_path(heading)]
        driven_m += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        leaving = leg[min(5, len(leg) - 1)] - leg[0]
        if heading is not None and heading @ leaving < 0:
            segments.append([leg[:1]])
        segments[-1].append(leg[1:])
        arriving = leg[-1] - leg[max(-6, -len(leg))]
        heading = arriving / np.linalg.norm(arriving)
    lines = [_smooth(_resample(np.concatenate(part)), grid, clearance, least_m) for part in segments]
    points = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
    turns = np.cumsum([len(line) - 1 for line in lines])
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    last = min(int(np.searchsorted(lengths, length_m)), len(points) - 1)
    return Route(points[: last + 1], turns[turns < last])
