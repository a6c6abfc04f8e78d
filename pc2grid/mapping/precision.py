"""How exactly the places of a map lie to each other, from the pose graph it was made with.

A corridor that was driven once and never met again cannot contradict anything, so the checks of
`consistency.py` are silent about it. But the pose graph knows: the covariance of its solution grows along
such a corridor and shrinks wherever a loop ties it to the rest.

The covariance of the poses is the inverse of the information matrix (Thrun, Burgard and Fox, "Probabilistic
Robotics", chapter 11). It is stated relative to the part of the session that is well tied together, not to
the first pose: the error of each position is what remains after the whole has been placed on the truth, with
the weight of well-known places (the S-transformation of Baarda, 1973, as free networks are adjusted in
geodesy).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from pc2grid.arrays import F64, I64
from pc2grid.mapping.building_axes import WallDirection
from pc2grid.mapping.parts import PARTS
from pc2grid.mapping.pose_graph import Edge, information_matrix
from pc2grid.model import Precision, Trajectory, UncertainStretch


@dataclass(frozen=True, slots=True, kw_only=True)
class PrecisionParameters:
    """Numbers of the estimate.

    promised_m : standard deviation of a position from which a place is called uncertain. Beyond it, an answer
        that is exact to the walls around it is off in the map by more than that as often as one in three.
    rounds : in which the weights of the places are found; they change little after two.
    first_information : per square metre and radian, on the first pose, so that the matrix can be inverted.
        The result does not depend on it.
    """

    promised_m: float = 0.5
    rounds: int = 3
    first_information: float = 1e4


PRECISION = PrecisionParameters()

_TOGETHER = 64
"""Poses whose covariance is computed at once; memory grows linearly with the length of a session."""


def position_sigmas(
    poses: F64,
    edges: Sequence[Edge],
    walls: Sequence[WallDirection] | None = None,
    parameters: PrecisionParameters = PRECISION,
) -> tuple[F64, F64]:
    """Standard deviation (N,) of each position in metres, in its least certain direction, and weights (N,).

    poses : (N, 3) x, y, yaw that agree best with the edges. edges : those that count; they connect all poses.
    walls : of each pose, if the building's axes constrain the headings.
    weights : with which the places count when the map is placed on the truth.
    """
    count = len(poses)
    sigma, weight = np.zeros(count), np.ones(count)
    if count < 2:
        return sigma, weight
    first = np.zeros(3 * count)
    first[:3] = parameters.first_information
    information = information_matrix(poses, edges, walls) + diags(first)
    solve = splu(information.tocsc(), permc_spec="MMD_AT_PLUS_A").solve
    blocks = _diagonal_blocks(solve, count)
    moved = _moved_by_whole(poses)
    for _ in range(parameters.rounds):
        # The whole is placed by weighted least squares: its motion is `placing` (3, 3 N) times the errors.
        normal = np.einsum("n,nai,naj->ij", weight, moved, moved)
        by_pose = np.zeros((count, 3, 3))
        by_pose[:, :2] = weight[:, None, None] * moved @ np.linalg.inv(normal)
        placing = by_pose.reshape(-1, 3)
        with_errors = solve(placing)
        of_whole = placing.T @ with_errors
        across = with_errors.reshape(-1, 3, 3)[:, :2] @ moved.transpose(0, 2, 1)
        covariance = blocks - across - across.transpose(0, 2, 1)
        covariance += moved @ of_whole @ moved.transpose(0, 2, 1)
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0))
        weight = 1.0 / (sigma**2 + parameters.promised_m**2)
    return sigma, weight


def _diagonal_blocks(solve: Callable[[F64], F64], count: int) -> F64:
    """The covariance (N, 2, 2) of x and y of each of the poses.

    solve : the product of columns (3 N, K) with the covariance (3 N, 3 N) of all.
    """
    blocks = np.empty((count, 2, 2))
    for begin in range(0, count, _TOGETHER):
        some = np.arange(begin, min(begin + _TOGETHER, count))
        rows = (3 * some[:, None] + np.arange(2)).ravel()
        columns = np.zeros((3 * count, len(rows)))
        columns[rows, np.arange(len(rows))] = 1.0
        found = solve(columns)[rows].reshape(len(some), 2, len(some), 2)
        blocks[some] = found[some - begin, :, some - begin]
    return blocks


def _moved_by_whole(poses: F64) -> F64:
    """How each position moves (N, 2, 3) with a motion x, y, yaw of the whole about its middle."""
    moved = np.zeros((len(poses), 2, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    away = poses[:, :2] - poses[:, :2].mean(axis=0)
    moved[:, 0, 2], moved[:, 1, 2] = -away[:, 1], away[:, 0]
    return moved


def precision_of(
    trajectory: Trajectory, scans: I64, sigma_m: F64, parameters: PrecisionParameters = PRECISION
) -> Precision:
    """The precision of a map, from the standard deviations (N,) at some of its scans (N,), in their order."""
    if not len(scans):
        return Precision()
    stamps_ns, xy, travel_m = trajectory.stamps_ns, trajectory.planar()[:, :2], trajectory.path_m()
    # Every local map stands for the travel up to the middle between it and the next.
    middles = (scans[1:] + scans[:-1]) // 2
    begins, ends = np.append(0, middles), np.append(middles, len(trajectory) - 1)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], sigma_m > parameters.promised_m, [False]))))
    found = []
    for begin, end in edges.reshape(-1, 2).tolist():
        first, last = int(begins[begin]), int(ends[end - 1])
        worst = begin + int(np.argmax(sigma_m[begin:end]))
        length_m = float(travel_m[last] - travel_m[first])
        if length_m >= PARTS.least_travel_m:
            found.append(
                UncertainStretch(
                    from_ns=int(stamps_ns[first]),
                    to_ns=int(stamps_ns[last]),
                    x_m=float(xy[scans[worst], 0]),
                    y_m=float(xy[scans[worst], 1]),
                    length_m=length_m,
                    sigma_m=round(float(sigma_m[worst]), 3),
                )
            )
    return Precision(
        stamps_ns=tuple(stamps_ns[scans].tolist()),
        sigma_m=tuple(sigma_m.round(3).tolist()),
        loose=tuple(sorted(found, key=lambda stretch: (-stretch.sigma_m, stretch.from_ns))),
    )


def precision_warning(precision: Precision, trajectory: Trajectory) -> str | None:
    """One sentence that says which part of a map is weakly tied to the rest and what to do; None if none."""
    if not precision.loose:
        return None
    worst = precision.loose[0]
    start_ns = int(trajectory.stamps_ns[0])
    from_s, to_s = ((stamp - start_ns) * 1e-9 for stamp in (worst.from_ns, worst.to_ns))
    others = len(precision.loose) - 1
    more = f" (and {others} more such stretch{'es' if others > 1 else ''})" if others else ""
    return (
        f"no loop ties {worst.length_m:.0f} m of the travel, {from_s:.0f} to {to_s:.0f} s after the first "
        f"scan{more}, well to the rest: near x {worst.x_m:.1f}, y {worst.y_m:.1f} m the map may be off "
        f"by {worst.sigma_m:.1f} m (standard deviation), and no doubled wall would show it; come back from "
        "there to a place seen before, by another way if there is one"
    )
