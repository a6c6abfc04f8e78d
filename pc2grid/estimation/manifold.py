"""Poses as unknowns of least squares: many at once, with the derivatives of the steps between them.

A pose changes by a vector (6,) in its own axes, translation (m) and rotation vector (rad): the translation is
added, the rotation multiplied (Sola et al., "A micro Lie theory for state estimation in robotics", 2018).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pc2grid.arrays import F64
from pc2grid.estimation import _kernels


class Steps(NamedTuple):
    """The steps from poses to others, in the axes of the first.

    step : (N, 6). by_first, by_second : (N, 6, 6) its Jacobians with respect to changes of both.
    """

    step: F64
    by_first: F64
    by_second: F64


def moved(poses: F64, changes: F64) -> F64:
    """Poses (N, 4, 4) after changes (N, 6) in their own axes."""
    result: F64 = _kernels.moved(*_for_compiled(poses, changes))
    return result


def steps(first: F64, second: F64) -> Steps:
    """The steps from poses (N, 4, 4) to others."""
    return Steps(*_kernels.steps(*_for_compiled(first, second)))


def carried_on(motion: F64) -> F64:
    """How a change of a pose changes the pose after a motion (4, 4), a matrix (6, 6)."""
    R = motion[:3, :3].T
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = R
    result[:3, 3:] = -R @ _skew(motion[None, :3, 3])[0]
    return result


def weakest(information: F64, position: int) -> float:
    """Information (N, N) on the position, the first 2 or 3 directions, in its weakest one.

    The rotation, which follows, is eliminated (Schur complement).
    """
    mixed, turn = information[:position, position:], information[position:, position:]
    turn = turn + 1e-9 * np.eye(len(turn))
    across = information[:position, :position] - mixed @ np.linalg.solve(turn, mixed.T)
    return float(np.linalg.eigvalsh(across)[0])


def _for_compiled(*arrays: F64) -> Iterator[F64]:
    """Arrays in one order of memory, writable: for any other, the same code would be compiled once more."""
    return (np.require(array, requirements=("C", "W")) for array in arrays)


def _skew(vectors: F64) -> F64:
    """The matrices (N, 3, 3) of the cross products with vectors (N, 3)."""
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    return result - result.transpose(0, 2, 1)
