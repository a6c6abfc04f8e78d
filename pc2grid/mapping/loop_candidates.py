"""Which recognised places are loops: those that agree with the drift of tracking and with each other.

A recognition alone may be wrong with high confidence: buildings repeat themselves, and some look alike when
they are turned by 180 degrees. Two facts that the recognizer does not use distinguish such a place from the
right one. Tracking drifts, but only so far. And what is recognised on two stretches must fit together with
the travel between them (pairwise consistency, Mangelson et al., "Pairwise consistent measurement set
maximization for robust multi-robot map merging", 2018). A recognition that is not accepted remains a
candidate, because later ones may support it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from pc2grid.arrays import F64, I64
from pc2grid.mapping.place_recognition import Recognition
from pc2grid.mapping.pose_graph import between, compose


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateParameters:
    """Numbers of the acceptance. Chosen on aces and csail, unless noted.

    The drift that tracking may have over a travel, in standard deviations, generous because a slip of the
    wheels counts too (`docs/method.md`):

    drift_m, drift_per_m : of position, constant and per metre of travel.
    drift_rad, drift_rad_per_m : of yaw.

    The drift over the short travel between two recognitions that support each other:

    short_m, short_per_m, short_rad : as above; per metre of travel the yaw drifts by `drift_rad_per_m`.
    consistent : largest Mahalanobis distance at which two of them agree; 3 degrees of freedom, 1 %.

    What is required:

    alone : largest Mahalanobis distance from the tracked pose at which a recognition without support is
        accepted.
    supported : the same with one other recognition that agrees.
    possible : the same with two; beyond it a recognition is never accepted. 3 degrees of freedom, 0.3 %.
    known_way_m : a recognition over a shorter way adds nothing: tracking is more exact. A stretch and a half.
    rival : log-odds by which a contradicting place of the same stretch must be less likely.
    pending : candidates that are kept at most, the latest.
    """

    drift_m: float = 0.3
    drift_per_m: float = 0.025
    drift_rad: float = math.radians(1.5)
    drift_rad_per_m: float = math.radians(0.1)
    short_m: float = 0.15
    short_per_m: float = 0.015
    short_rad: float = math.radians(1.0)
    consistent: float = 3.37
    alone: float = 1.0
    supported: float = 2.5
    possible: float = 3.8
    known_way_m: float = 18.0
    rival: float = 3.0
    pending: int = 100


CANDIDATES = CandidateParameters()


class LoopCandidates:
    """Recognised places that are not accepted as loops yet."""

    def __init__(self, parameters: CandidateParameters = CANDIDATES) -> None:
        self._parameters = parameters
        self._pending: list[Recognition] = []

    def add(self, candidates: Sequence[Recognition]) -> None:
        """Add what was recognised on the newest stretch."""
        self._pending = [*self._pending, *candidates][-self._parameters.pending :]

    def take(self, nodes: F64, travel_m: F64) -> list[Recognition]:
        """The candidates that are loops by drift and by each other. They, and those that cannot be, go.

        nodes : (N, 3) settled poses of the stretches. travel_m : (N,) metres of travel at each.
        """
        pending, p = self._pending, self._parameters
        if not pending:
            return []
        older, newer = np.array([(c.older, c.newer) for c in pending]).T
        measured = np.array([(c.T_older_newer.x, c.T_older_newer.y, c.T_older_newer.yaw) for c in pending])
        probability = np.clip([c.probability for c in pending], 1e-6, 1.0 - 1e-6)

        way_m = travel_m[newer] - travel_m[older]
        error = between(measured, between(nodes[older], nodes[newer]))
        off = _mahalanobis(error, p.drift_m + p.drift_per_m * way_m, p.drift_rad + p.drift_rad_per_m * way_m)
        in_reach, known = off <= p.possible, way_m <= p.known_way_m

        agrees = self._agreement(older, newer, measured, nodes, travel_m)
        same = newer[:, None] == newer
        support = np.array([len(set(newer[row])) for row in agrees & ~same & in_reach])
        likely = np.log(probability / (1.0 - probability)) - 0.5 * off**2

        reach = np.choose(np.minimum(support, 2), (p.alone, p.supported, p.possible))
        fits = (off <= reach) & ~known
        # Rival k of candidate i contradicts it; one of the two must be clearly better.
        weaker = support < support[:, None]
        less_likely = (support == support[:, None]) & (likely <= likely[:, None] - p.rival)
        beaten = weaker | less_likely | ~(same & ~agrees & in_reach)
        chosen = fits & beaten.all(axis=1)
        self._pending = list(compress(pending, in_reach & ~known & ~chosen))
        return list(compress(pending, chosen))

    def _agreement(
        self, older: I64, newer: I64, measured: F64, nodes: F64, travel_m: F64
    ) -> NDArray[np.bool_]:
        """Which candidates (C, C) fit together with the travel between them.

        older, newer : (C,) stretches. measured : (C, 3) x, y, yaw of the newer in the older.
        """
        p = self._parameters
        travelled_m = np.abs(travel_m[newer][:, None] - travel_m[newer])
        travelled_m += np.abs(travel_m[older][:, None] - travel_m[older])
        first, second = (k.ravel() for k in np.indices(travelled_m.shape))
        there = compose(measured[first], between(nodes[newer[first]], nodes[newer[second]]))
        again = compose(between(nodes[older[first]], nodes[older[second]]), measured[second])
        apart = _mahalanobis(
            between(there, again),
            p.short_m + p.short_per_m * travelled_m.ravel(),
            p.short_rad + p.drift_rad_per_m * travelled_m.ravel(),
        )
        return (apart <= p.consistent).reshape(travelled_m.shape)


def _mahalanobis(error: F64, sigma_m: F64, sigma_rad: F64) -> F64:
    """(N,) length of errors (N, 3) of x, y, yaw in standard deviations."""
    yaw = (error[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(np.sqrt((error[:, 0] ** 2 + error[:, 1] ** 2) / sigma_m**2 + yaw**2 / sigma_rad**2))
