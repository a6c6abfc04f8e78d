"""Sparse least squares over planar poses with robust edges.

The manifold Gauss-Newton of Grisetti et al., "A tutorial on graph-based SLAM" (2010), section IV, with
Cauchy weights on the edges that may be wrong. In the plane it needs 3 numbers a pose where Open3D's
optimiser has 6, and takes each edge's information as it was measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.geometry import F64, SE2

_NEAR_BY_M = 6.0
_AGREE_M, _AGREE_RAD = 0.3, 0.05
_LESS_LENIENT = 3.0  # an iteration


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured relative pose T_first_second with its information (3, 3) in the first pose's axes.

    loop : whether it may be wrong altogether, hence robust.
    """

    first: int
    second: int
    T_first_second: SE2
    information: F64
    loop: bool = False


@dataclass(frozen=True, slots=True)
class Solution:
    """poses (N, 3): x, y, yaw. chi2 (E,): weighted squared error of each edge, before robust weights.

    believed (E,): all edges but the loops that lost more than half of their say.
    """

    poses: F64
    chi2: F64
    believed: NDArray[np.bool_]


def optimise(
    poses: F64,
    edges: Sequence[Edge],
    *,
    iterations: int = 25,
    robust_scale: float = 3.0,
) -> Solution:
    """Poses (N, 3) that agree best with the edges; the first pose stays where it is.

    robust_scale : standard deviations at which a loop edge has lost half of its say.

    A loop is doubted from the start, or a false one would bend the map before the others are heard - unless
    two more, at other places near by, ask for the same correction. Then drift is likelier than three equal
    mistakes, and doubt comes only as the iterations go on (graduated non-convexity, Yang et al. 2020).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    poses = np.array(poses, dtype=np.float64)
    if not edges or len(poses) < 2:
        return Solution(poses, np.zeros(len(edges)), np.ones(len(edges), np.bool_))
    i = np.array([e.first for e in edges])
    j = np.array([e.second for e in edges])
    z = np.array([(e.T_first_second.x, e.T_first_second.y, e.T_first_second.yaw) for e in edges])
    omega = np.array([e.information for e in edges])
    loop = np.array([e.loop for e in edges])
    rows = np.stack((3 * i, 3 * i + 1, 3 * i + 2, 3 * j, 3 * j + 1, 3 * j + 2), axis=1)
    row = np.repeat(rows, 6, axis=1).ravel()
    column = np.tile(rows, (1, 6)).ravel()
    size = 3 * len(poses)
    error, jacobian = _linearise(poses, i, j, z)
    chi2 = np.einsum("ea,eab,eb->e", error, omega, error)
    seconded = _seconded(poses, i, j, z, loop & (chi2 > robust_scale**2))
    leniency = np.where(seconded, np.maximum(chi2 / robust_scale**2, 1.0), 1.0)
    for _ in range(iterations):
        weight = np.where(loop, 1.0 / (1.0 + chi2 / (leniency * robust_scale**2)), 1.0)
        weighted = omega * weight[:, None, None]
        JtO = jacobian.transpose(0, 2, 1) @ weighted
        H = coo_matrix(((JtO @ jacobian).ravel(), (row, column)), shape=(size, size)).tocsc()
        g = np.zeros(size)
        np.add.at(g, rows, np.einsum("eab,eb->ea", JtO, error))
        delta = np.zeros(size)
        delta[3:] = spsolve(H[3:, 3:] + 1e-6 * _identity(size - 3), -g[3:])
        poses += delta.reshape(-1, 3)
        poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
        error, jacobian = _linearise(poses, i, j, z)
        chi2 = np.einsum("ea,eab,eb->e", error, omega, error)
        if leniency.max() == 1.0 and np.abs(delta).max() < 1e-5:
            break
        leniency = np.maximum(leniency / _LESS_LENIENT, 1.0)
    return Solution(poses, chi2, ~loop | (chi2 <= robust_scale**2))


def _seconded(
    poses: F64, i: NDArray[np.intp], j: NDArray[np.intp], z: F64, doubted: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which of the doubted edges (of E) at least two others, near by but between other poses, agree with.

    Two edges agree if they want to move what is at their second ends in the same way.
    """
    seconded = np.zeros(len(i), np.bool_)
    index = np.flatnonzero(doubted)
    a, b, measured = poses[i[index]], poses[j[index]], z[index]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    wanted = np.column_stack(
        (
            a[:, 0] + c * measured[:, 0] - s * measured[:, 1],
            a[:, 1] + s * measured[:, 0] + c * measured[:, 1],
            a[:, 2] + measured[:, 2],
        )
    )
    turn = wanted[:, 2] - b[:, 2]
    for k in range(len(index)):
        near = np.hypot(*(b[:, :2] - b[k, :2]).T) < _NEAR_BY_M
        near &= np.hypot(*(a[:, :2] - a[k, :2]).T) < _NEAR_BY_M
        near &= (i[index] != i[index[k]]) & (j[index] != j[index[k]])
        other = np.flatnonzero(near)
        if len(other) < 2:
            continue
        # Where this edge's correction would take the others' second ends.
        cos, sin = np.cos(turn[k]), np.sin(turn[k])
        d = b[other, :2] - b[k, :2]
        x = wanted[k, 0] + cos * d[:, 0] - sin * d[:, 1] - wanted[other, 0]
        y = wanted[k, 1] + sin * d[:, 0] + cos * d[:, 1] - wanted[other, 1]
        yaw = np.abs(np.remainder(turn[k] - turn[other] + np.pi, 2 * np.pi) - np.pi)
        seconded[index[k]] = ((np.hypot(x, y) < _AGREE_M) & (yaw < _AGREE_RAD)).sum() >= 2
    return seconded


def _identity(size: int):  # type: ignore[no-untyped-def]
    from scipy.sparse import identity

    return identity(size, format="csc")


def _linearise(poses: F64, i: NDArray[np.intp], j: NDArray[np.intp], z: F64) -> tuple[F64, F64]:
    """Errors (E, 3) and Jacobians (E, 3, 6) with respect to both poses of each edge."""
    a, b = poses[i], poses[j]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    error = np.column_stack((c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2])) - z
    error[:, 2] = np.arctan2(np.sin(error[:, 2]), np.cos(error[:, 2]))
    jacobian = np.zeros((len(i), 3, 6))
    jacobian[:, 0, 0], jacobian[:, 0, 1] = -c, -s
    jacobian[:, 1, 0], jacobian[:, 1, 1] = s, -c
    jacobian[:, 0, 2] = -s * dx + c * dy
    jacobian[:, 1, 2] = -c * dx - s * dy
    jacobian[:, :2, 3:5] = -jacobian[:, :2, :2]
    jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
    return error, jacobian
