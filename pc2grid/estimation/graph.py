"""Robust least squares over factors, dense: the solver of the smoother.

A factor is a residual that depends on few of the unknowns. Gauss-Newton with Cauchy weights (iteratively
reweighted least squares); the unknowns are numbered rows, and what they mean is known to the factors alone.
The pose graph of a session has thousands of unknowns and a sparse solver of its own
(`pc2grid.mapping.pose_graph`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.estimation import _kernels


@dataclass(frozen=True, slots=True)
class Factors:
    """F factors of one kind, linearised.

    rows : (F, K) unknowns that each depends on. error : (F, M) residuals. jacobian : (F, M, K) of these.
    information : (F, M, M) inverse covariance of each residual.
    kernel : (F,) scale of the Cauchy weight, standard deviations; infinite: the weight is 1.
    """

    rows: NDArray[np.intp]
    error: F64
    jacobian: F64
    information: F64
    kernel: F64

    def touching(self, rows: NDArray[np.intp]) -> Factors:
        """Those of the factors that depend on any of some unknowns (R,)."""
        these = np.isin(self.rows, rows).any(axis=1)
        return Factors(
            self.rows[these],
            self.error[these],
            self.jacobian[these],
            self.information[these],
            self.kernel[these],
        )


def normal_equations(factors: Iterable[Factors], count: int) -> tuple[F64, F64]:
    """The matrix (N, N) and the gradient (N,) of all factors over N = `count` unknowns."""
    H, g = np.zeros((count, count)), np.zeros(count)
    for kind in factors:
        _kernels.add_factors(kind.rows, kind.error, kind.jacobian, kind.information, kind.kernel, H, g)
    return H, g


def without(H: F64, g: F64, old: NDArray[np.intp]) -> tuple[F64, F64]:
    """The information (N - O, N - O) and the gradient on the other unknowns when those in `old` (O,) are
    marginalised: the Schur complement."""
    rest = np.setdiff1d(np.arange(len(H)), old)
    A = H[np.ix_(old, old)] + 1e-9 * np.eye(len(old))
    solved = np.linalg.solve(A, np.column_stack((H[np.ix_(old, rest)], g[old])))
    B = H[np.ix_(rest, old)]
    reduced = H[np.ix_(rest, rest)] - B @ solved[:, :-1]
    return 0.5 * (reduced + reduced.T), g[rest] - B @ solved[:, -1]
