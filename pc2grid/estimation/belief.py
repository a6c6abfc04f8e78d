"""What is known of the pose of the base: a Gaussian with tails as heavy as those of the evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64
from pc2grid.estimation.manifold import steps

PLANAR: tuple[int, ...] = (0, 1, 5)
"""The free directions of a base on wheels: x, y, and the turn about z, in the base frame."""
SPATIAL: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
"""The free directions of a sensor in the hand: x, y, z, and the turns about them."""
KERNEL = 3.0
"""Standard deviations at which evidence counts half: scale of the Cauchy weights. Chosen by hand."""


@dataclass(frozen=True)
class Belief:
    """A pose (4, 4) T_session_base with its covariance (D, D) in the free directions (D,) of the base
    frame."""

    pose: F64
    covariance: F64
    free: NDArray[np.intp]

    @cached_property
    def information(self) -> F64:
        """Inverse (D, D) of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance), np.float64)

    @cached_property
    def sigmas(self) -> tuple[float, float]:
        """Largest standard deviation of the position (m) and of the turn (rad)."""
        position = self.free < 3
        largest = (np.linalg.eigvalsh(self.covariance[np.ix_(k, k)])[-1] for k in (position, ~position))
        of_position_m, of_turn_rad = (math.sqrt(variance) for variance in largest)
        return of_position_m, of_turn_rad

    def chi2(self, pose: F64) -> float:
        """Squared Mahalanobis distance of a pose (4, 4)."""
        away = steps(self.pose[None], pose[None]).step[0, self.free]
        return float(away @ self.information @ away)

    def log_density(self, chi2: float) -> float:
        """Logarithm of the density at a squared Mahalanobis distance, but for a constant; far off it falls as
        slowly as evidence."""
        return -0.5 * (KERNEL**2 * math.log1p(chi2 / KERNEL**2) + self._log_volume)

    @cached_property
    def _log_volume(self) -> float:
        return float(np.linalg.slogdet(self.covariance)[1])
