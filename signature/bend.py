"""How a map is bent: a small rigid motion that varies over the map.

A session drifts where it closes no loop, and what another session knows straightens it
(`signature.localization.joining.straightening`). Its map stays as it was drawn. A bend has a row for each of
some places of the map: x and y of the place, and how the map moves about it, x, y and yaw, all in the axes of
the map. In between, the motions are blended by a Gaussian of the distance. A map without rows is straight.
"""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2

Bend = tuple[tuple[float, float, float, float, float], ...]
"""Rows (x, y, motion in x, in y, in yaw); metres and radians."""

_BLENDED_M = 3.0
"""Standard deviation of the weights. From 2 to 4 m, sessions of csail and aces came to lie equally well."""
_NEAREST = 8
"""Places that are blended; those further away have no weight."""
_ROUNDS = 3
"""In which a motion is inverted: each leaves a few percent of the error, as steep as real bends are."""


def motions(bend: Bend, points_m: F64) -> F64:
    """How a map moves at points (M, 2): (M, 3) x, y, yaw."""
    points_m = np.asarray(points_m, np.float64)
    if not bend or not len(points_m):
        return np.zeros((len(points_m), 3))
    from scipy.spatial import cKDTree

    rows = np.array(bend)
    distance_m, near = cKDTree(rows[:, :2]).query(points_m, k=range(1, min(_NEAREST, len(rows)) + 1))
    weight = np.exp((distance_m[:, :1] ** 2 - distance_m**2) / (2.0 * _BLENDED_M**2))
    weight /= weight.sum(axis=1, keepdims=True)
    moved = rows[near, 2:]
    away = points_m[:, None] - rows[near, :2]
    moved[..., 0] -= moved[..., 2] * away[..., 1]
    moved[..., 1] += moved[..., 2] * away[..., 0]
    return np.asarray((weight[..., None] * moved).sum(axis=1))


def straightened(bend: Bend, points_m: F64) -> F64:
    """Where points (M, 2) of a map lie when it is straight."""
    return np.asarray(points_m + motions(bend, points_m)[:, :2])


def drawn_at(bend: Bend, points_m: F64) -> F64:
    """The points (M, 2) of a map that lie at `points_m` (M, 2) when it is straight."""
    drawn_m = points_m
    for _ in range(_ROUNDS if bend else 0):
        drawn_m = points_m - motions(bend, drawn_m)[:, :2]
    return drawn_m


def rigid_motions(bend: Bend, points_m: F64) -> list[SE2]:
    """The rigid motions of a map about points (M, 2) of it: T_straight_drawn, each good near its point."""
    found = []
    for (x, y), (dx, dy, yaw) in zip(points_m.tolist(), motions(bend, points_m).tolist(), strict=True):
        found.append(SE2(x + dx, y + dy, yaw) @ SE2(-x, -y, 0.0))
    return found


def largest_m(bend: Bend) -> float:
    """How far a bend moves any of its places."""
    return max((float(np.hypot(dx, dy)) for _, _, dx, dy, _ in bend), default=0.0)
