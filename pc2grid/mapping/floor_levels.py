"""The heights of a session's keyframes: one recording is one floor, and a floor is level.

A pose in space drifts in height as it does in the plane. For gravity-aligned poses height is independent of
x, y and yaw, so it is a least-squares problem of its own, and a linear one: steps of tracking between
keyframes, the height above the floor where that is seen, and the heights of loops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from pc2grid.arrays import F64, I64
from pc2grid.clouds.level import LEVEL


@dataclass(frozen=True, slots=True)
class HeightStep:
    """The height of one keyframe above another one, in metres, with its standard deviation."""

    first: int
    second: int
    rise_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorLevelParameters:
    """Numbers of the least squares; chosen by hand.

    sigmas : standard deviations at which a floor or a loop has half of its weight (Cauchy). rounds : of
        reweighting; the first begins so wide that the worst has half of its weight, each narrows it by
        `annealing`.
    around : keyframes on either side of the two of a loop whose points are compared.
    reach_m : the passes of a loop differ in height by no more. layer_m, cell_m : height and edge of the
        voxels in which they are. thin : layers that a column without a wall fills at most: floor, table and
        ceiling. beside, stands_out : level surfaces make their meeting a peak, so many times as high as so
        many layers beside it.
    known_m : standard deviation of the first height; it counts where no floor is seen. lost_m : of a step
        where tracking was lost.
    apart_from_m : floors of a map that lie so far apart are told.
    """

    sigmas: float = 3.0
    rounds: int = 12
    annealing: float = 2.0
    around: int = 2
    reach_m: float = 0.6
    layer_m: float = 0.04
    thin: int = 6
    cell_m: float = 0.1
    beside: int = 3
    stands_out: float = 1.5
    known_m: float = 100.0
    lost_m: float = 1.0
    apart_from_m: float = 0.1


FLOOR_LEVELS = FloorLevelParameters()


def settled_heights(
    tracked_m: F64,
    travel_m: F64,
    above_floor_m: F64,
    restarts: Sequence[int] | I64,
    loops: Sequence[HeightStep] = (),
    parameters: FloorLevelParameters = FLOOR_LEVELS,
) -> F64:
    """The heights (K,) of keyframes above their one floor; without a floor, above any level.

    tracked_m : (K,) z as tracked. travel_m : (K,) metres of travel at each. above_floor_m : (K,) as seen, NaN
    where no floor is. restarts : the keyframes before which tracking was lost.
    """
    p, count = parameters, len(tracked_m)
    seen = np.flatnonzero(np.isfinite(above_floor_m))
    steps_m = np.sqrt(LEVEL.drift_per_m * np.maximum(np.diff(travel_m), 1e-3))
    steps_m[np.asarray(restarts, np.int64) - 1] = p.lost_m
    chain = np.arange(count - 1)
    # One row for each observation: the height of `second` less that of `first`, which is -1 for the floor.
    first = np.concatenate((chain, [-1], np.full(len(seen), -1), [loop.first for loop in loops]))
    second = np.concatenate((chain + 1, [0], seen, [loop.second for loop in loops])).astype(np.int64)
    rise_m = np.concatenate(
        (np.diff(tracked_m), tracked_m[:1], above_floor_m[seen], [loop.rise_m for loop in loops])
    )
    sigma_m = np.concatenate(
        (steps_m, [p.known_m], np.full(len(seen), LEVEL.seen_m), [loop.sigma_m for loop in loops])
    )
    first = first.astype(np.int64)
    may_be_wrong = np.arange(len(first)) >= count
    row = np.arange(len(first))
    inner = first >= 0
    values = np.concatenate((np.ones(len(row)), -np.ones(int(inner.sum()))))
    A = coo_matrix(
        (values, (np.concatenate((row, row[inner])), np.concatenate((second, first[inner])))),
        shape=(len(row), count),
    ).tocsc()
    weight, scale, heights_m = sigma_m**-2, np.inf, tracked_m
    for _ in range(p.rounds):
        heights_m = splu((A.T @ A.multiply(weight[:, None])).tocsc()).solve(A.T @ (weight * rise_m))
        off = np.abs(A @ heights_m - rise_m) / sigma_m
        scale = max(min(scale / p.annealing, off[may_be_wrong].max(initial=0.0)), p.sigmas)
        weight = sigma_m**-2 * np.where(may_be_wrong, 1.0 / (1.0 + (off / scale) ** 2), 1.0)
    return np.asarray(heights_m)


def rise_between(
    first_m: F64, second_m: F64, parameters: FloorLevelParameters = FLOOR_LEVELS
) -> float | None:
    """By how much points (M, 3) must rise to meet others (N, 3); None if no level surface of both tells.

    first_m : the others. Floors, tables and ceilings meet at one height, walls at all.
    """
    p = parameters
    most = round(p.reach_m / p.layer_m)
    edges_m = np.array((p.cell_m, p.cell_m, p.layer_m))
    first, second = (np.floor(points / edges_m).astype(np.int64) for points in (first_m, second_m))
    columns = [cells[:, :2] @ (1 << 20, 1) for cells in (first, second)]
    shared = np.intersect1d(*columns)
    if not len(shared):
        return None
    lowest = min(first[:, 2].min(), second[:, 2].min()) - most
    layers = int(max(first[:, 2].max(), second[:, 2].max()) - lowest) + most + 1
    full = np.zeros((2, len(shared), layers), np.bool_)
    for cloud, cells, column in zip(full, (first, second), columns, strict=True):
        both = np.isin(column, shared)
        cloud[np.searchsorted(shared, column[both]), cells[both, 2] - lowest] = True
    # A wall meets itself at any height, in as many layers as it is high.
    full = full[:, full.sum(axis=2).max(axis=0) <= p.thin]
    inner = full[1, :, most:-most]
    meet = np.array(
        [(full[0, :, k : k + inner.shape[1]] & inner).sum() for k in range(2 * most + 1)], np.float64
    )
    best = int(np.argmax(meet))
    if not p.beside <= best < len(meet) - p.beside:
        return None
    if meet[best] < p.stands_out * max(meet[best - p.beside], meet[best + p.beside], 1.0):
        return None
    before, peak, after = meet[best - 1 : best + 2]
    between = 0.5 * (before - after) / min(before - 2.0 * peak + after, -1.0)
    return float((best - most + between) * p.layer_m)


def floors_apart_m(heights_m: F64, above_floor_m: F64) -> float | None:
    """Over which height the floor lies that keyframes at heights (K,) see, without the outer twentieths.

    None if none is seen.
    """
    floor_m = (heights_m - above_floor_m)[np.isfinite(above_floor_m)]
    if not len(floor_m):
        return None
    low_m, high_m = np.percentile(floor_m, (5.0, 95.0))
    return float(high_m - low_m)


def floor_warning(apart_m: float | None, parameters: FloorLevelParameters = FLOOR_LEVELS) -> str | None:
    """One sentence that says how far the floors of a map lie apart and what to do; None if they do not."""
    if apart_m is None or apart_m < parameters.apart_from_m:
        return None
    return (
        f"a floor is level, but what was seen of it lies over {apart_m:.2f} m of height: where it was passed "
        "twice, one floor may stand on the other as an obstacle; hold the sensor so that it sees the floor, "
        "or cut the recording at a step or ramp, with --start and --duration"
    )
