"""Where a robot drives: through free space, to new places first, back where a way ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import ConfigError
from pc2grid.geometry import F64
from pc2grid.model import F32, I64, OccupancyGrid, _freeze
from pc2grid.simulate.passage import clearance_m

STEP_M = 0.05
"""Distance between the points of a route."""

SEEN_M = 1.5
"""Places this close to the route count as visited."""


@dataclass(frozen=True, slots=True)
class Route:
    """A line to drive along.

    points_m : (N, 2) in the map frame, about STEP_M apart.
    turns : (K,) increasing indices into points_m where the robot stops and turns in place.
    """

    points_m: F64
    turns: I64

    def __post_init__(self) -> None:
        _freeze(self, "points_m", np.float64, (None, 2))
        _freeze(self, "turns", np.int64, (None,))

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.linalg.norm(np.diff(self.points_m, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class _Lattice:
    """Passable points some cells apart, with the ways between neighbours.

    points_m : (N, 2). cells : (N, 2) row, column. graph : (N, N) sparse, edges weigh their length, more
    where it is narrow. centres : (N,) whether the point is in the middle of its surroundings.
    """

    points_m: F64
    cells: I64
    graph: Any
    centres: NDArray[np.bool_]


def _lattice(
    grid: OccupancyGrid, clearance: F32, least_m: float, start_m: tuple[float, float] | None
) -> _Lattice:
    """The largest connected part of the passable space, or the one that holds the start.

    Raises ConfigError when nothing is passable, or nothing within 1 m of the start.
    """
    from scipy import ndimage
    from scipy.sparse import coo_matrix

    stride = max(1, round(0.1 / grid.resolution_m))
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
        if away.min() > 1.0:
            x, y = grid.to_point(cells[[np.argmin(away)]] * stride)[0]
            raise ConfigError(
                f"the start ({start_m[0]:g}, {start_m[1]:g}) is {away.min():.1f} m from where a robot fits",
                hint=f"the nearest such place is ({x:.2f}, {y:.2f})",
            )
        near = labels[tuple(cells[away <= 1.0].T)]
        label = int(near[np.argmax(sizes[near])])
    part = labels == label
    # In the middle: nowhere around is clearly more room.
    size = 2 * round(0.6 / (stride * grid.resolution_m)) + 1
    centres = part & (here >= 0.95 * ndimage.maximum_filter(np.where(part, here, 0), size=size))
    number = np.full(part.shape, -1, np.int64)
    cells = np.argwhere(part)
    number[part] = np.arange(len(cells))
    comfort_m = least_m + 0.5
    discomfort = 1 + 2 * np.clip((comfort_m - here) / comfort_m, 0, 1)
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
    """Chooses one goal after the other and remembers where it has been."""

    def __init__(self, lattice: _Lattice, at: int, rng: np.random.Generator) -> None:
        from scipy.spatial import cKDTree

        self.lattice = lattice
        self.at = at
        self.rng = rng
        self.new = np.ones(len(lattice.points_m), bool)
        self._tree = cKDTree(lattice.points_m)
        # A taste that changes from place to place sends each session another way.
        blocks = np.floor((lattice.points_m - lattice.points_m.min(axis=0)) / 2.0).astype(int)
        self._taste_m = rng.uniform(0, 4, size=blocks.max(axis=0) + 1)[blocks[:, 0], blocks[:, 1]]
        self._visit(np.array([at]))

    def _visit(self, path: I64) -> None:
        for near in self._tree.query_ball_point(self.lattice.points_m[path[::5]], SEEN_M):
            self.new[near] = False

    def next_path(self, heading: F64 | None) -> I64:
        """Points (indices) to the next goal: near, new, and rather ahead than behind.

        Once all is visited, the farthest place becomes the goal and everything behind it new again.
        """
        from scipy.sparse.csgraph import dijkstra

        points = self.lattice.points_m
        for limit in (8.0, 30.0, np.inf):
            away, before = dijkstra(
                self.lattice.graph, directed=False, indices=self.at, return_predecessors=True, limit=limit
            )
            goals = np.flatnonzero(self.lattice.centres & self.new & np.isfinite(away) & (away > 0.5))
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
            score += 1.5 * (1 - direction @ heading / np.linalg.norm(direction, axis=1))
        goal = int(goals[np.argmin(score)])
        path = [goal]
        while path[-1] != self.at:
            path.append(int(before[path[-1]]))
        indices = np.array(path[::-1], dtype=np.int64)
        self._visit(indices)
        self.at = goal
        return indices


def _resample(points_m: F64) -> F64:
    """The same line with points STEP_M apart; its ends stay."""
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points_m, axis=0), axis=1))))
    count = max(round(float(lengths[-1]) / STEP_M), 1)
    at = np.linspace(0, lengths[-1], count + 1)
    return np.column_stack([np.interp(at, lengths, points_m[:, k]) for k in (0, 1)])


def _smooth(points_m: F64, grid: OccupancyGrid, clearance: F32, least_m: float) -> F64:
    """Pull the line straight as far as its clearance allows (an elastic band); ends stay."""
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
    """A drive of `length_m` that stays `least_m` away from all that is not free.

    blocked : (H, W) cells that clutter stands on. New places come first; where a way ends the robot turns;
    what is seen twice closes loops.
    Raises ConfigError when there is no room, or none at the start.
    """
    clearance = clearance_m(grid.free & ~blocked, grid.resolution_m)
    lattice = _lattice(grid, clearance, least_m, start_m)
    if start_m is None:
        centres = np.flatnonzero(lattice.centres)
        at = int(centres[rng.integers(len(centres))])
    else:
        at = int(np.argmin(np.linalg.norm(lattice.points_m - start_m, axis=1)))
    explorer = _Explorer(lattice, at, rng)
    # Between two turns in place the line is one smooth piece.
    pieces: list[list[F64]] = [[lattice.points_m[[at]]]]
    heading: F64 | None = None
    driven_m = 0.0
    # Smoothing takes the corners off, so plan for more than is asked for.
    while driven_m < 1.3 * length_m + 2.0:
        leg = lattice.points_m[explorer.next_path(heading)]
        driven_m += float(np.linalg.norm(np.diff(leg, axis=0), axis=1).sum())
        leaving = leg[min(5, len(leg) - 1)] - leg[0]
        if heading is not None and heading @ leaving < 0:
            pieces.append([leg[:1]])
        pieces[-1].append(leg[1:])
        arriving = leg[-1] - leg[max(-6, -len(leg))]
        heading = arriving / np.linalg.norm(arriving)
    lines = [_smooth(_resample(np.concatenate(piece)), grid, clearance, least_m) for piece in pieces]
    points = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
    turns = np.cumsum([len(line) - 1 for line in lines])
    lengths = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    last = min(int(np.searchsorted(lengths, length_m)), len(points) - 1)
    return Route(points[: last + 1], turns[turns < last])
