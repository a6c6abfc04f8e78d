"""Where a scan lies on the local map of the last metres: the most probable of several matches.

A sensor matches (`PlacingSensor`: in the plane, or in space); what is made of its matches is the same with
three and with six degrees of freedom. KISS-ICP brings the scan near, from where the base is expected; the
matches begin there. If none fits, the scan is searched for. Each match has a posterior density: by how the
scan fits, and by what was expected. The best one is taken, and the covariance of all says how far it is to be
believed: of two places that fit alike neither is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.line_map import TRACKING_PARAMETERS, TrackingParameters, steps
from pc2grid.estimation.smoother import KERNEL, Belief
from pc2grid.geometry import F32, F64
from pc2grid.model import Scan

Estimate = tuple[F64, F64]
"""A pose or a motion (4, 4), with its information (D, D) in the axes of the base where it begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """A scan matched with the local map; D directions of the pose are free.

    pose : (4, 4) T_session_base, held to what was expected. alone : the pose by the points alone, with its
    information (D, D) in the axes of the base.
    overlap : share of the points that meet the map. measured : whether they fix every direction of the
    position.
    evidence : logarithm of the likelihood of the scan at that pose, but for a constant.
    credible : what is known there, free space included, speaks for the pose even if nothing else does.
    """

    pose: F64
    alone: Estimate
    overlap: float
    measured: bool
    evidence: float
    credible: bool


class PlacingSensor(Protocol):
    """Takes in the scans of a session, one after another, and matches them with a local map.

    free : directions of the pose that can change, `PLANAR` or `SPATIAL` of `pc2grid.estimation.smoother`.
    points_m : (N, 3) deskewed points of a scan in the base frame.
    """

    free: tuple[int, ...]

    def start(self, scan: Scan, points_m: F32) -> F64:
        """Begin with the first scan; returns its pose (4, 4): the session frame is its base, levelled."""

    def take(self, scan: Scan, points_m: F32) -> None:
        """Take in a scan."""

    def __bool__(self) -> bool:
        """Whether there is a local map."""

    def match(self, belief: Belief) -> list[Fit]:
        """Match the scan taken last with the local map. KISS-ICP begins at the belief, and the first match
        begins where KISS-ICP ends. All matches are held to the belief."""

    def search(self, belief: Belief) -> Iterator[Fit]:
        """Match the scan taken last wherever a belief holds it possible."""

    def held(self, fit: Fit) -> Fit:
        """A match of the scan taken last, by what the map holds, and not only seems to."""

    def follow(self, belief: Belief) -> Estimate | None:
        """The motion, T_last_now, by the last scans alone; None if the scan taken last does not fit them."""

    def fits_last(self, belief: Belief) -> bool:
        """Whether the scan taken last fits the scans before it, whatever the local map holds."""

    def levelled(self, pose: F64) -> F64:
        """A pose (4, 4) in the free directions, with the tilt and the height that are known besides."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """The planar scan, in the levelled base frame, of the scan taken last at its final pose (4, 4)."""

    def extend(self, pose: F64) -> None:
        """The scan taken last is a keyframe, at its final pose (4, 4)."""

    def restart(self) -> None:
        """Forget the local map: the next scan that is not lost begins a new one."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A scan placed on the local map.

    pose : (4, 4) T_session_base, from which the smoother begins. alone : as of `Fit`; None if the scan fits
    nowhere. motion : T_last_now, if the scan fits those before, but not the map: what it shows is new.
    sure : it fits the map well. measured : its points fix every direction of the position.
    first : there is no local map yet, nor any since tracking started again.
    """

    pose: F64
    alone: Estimate | None = None
    motion: Estimate | None = None
    sure: bool = False
    measured: bool = False
    first: bool = False


@dataclass(frozen=True, slots=True, order=True)
class _Hypothesis:
    """A match, and the logarithm of its posterior density but for a constant.

    sure : the scan fits well there. near : it lies where it is expected, and was not searched for.
    """

    score: float
    fit: Fit = field(compare=False)
    sure: bool = field(compare=False)
    near: bool = field(compare=False)


class Placer:
    """Places the scans of a sensor."""

    def __init__(self, sensor: PlacingSensor, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._sensor, self._parameters = sensor, parameters

    def place(self, scan: Scan, points_m: F32, expected: Sequence[Belief]) -> Placed:
        """Place the next scan.

        points_m : (N, 3) deskewed, base frame. expected : where the base may be, the most credible first. A
        scan that fits nowhere, or shows nothing, is placed there.
        """
        p, belief = self._parameters, expected[0]
        self._sensor.take(scan, points_m)
        if not self._sensor:
            return Placed(belief.pose, sure=True, first=True)
        found = self._hypotheses(expected)
        best = max(found)
        if best.fit.overlap < p.min_overlap or not (best.near or best.fit.credible):
            return Placed(belief.pose, motion=self._sensor.follow(belief))
        spread = _spread(found, best)[np.ix_(belief.free, belief.free)]
        fit = self._sensor.held(best.fit)
        alone, information = fit.alone
        # The inverse of the sum of both covariances, also where a match tells nothing of a direction.
        believed = np.linalg.solve(np.eye(len(spread)) + information @ spread, information)
        estimate = alone, 0.5 * (believed + believed.T)
        return Placed(fit.pose, estimate, sure=best.sure, measured=fit.measured)

    def _hypotheses(self, expected: Sequence[Belief]) -> list[_Hypothesis]:
        """Where the scan taken last may lie. If it fits nowhere that it is expected, it is searched for."""
        found: list[_Hypothesis] = []
        first = expected[0]
        for belief in expected:
            found += [self._hypothesis(fit, expected) for fit in self._sensor.match(belief)]
            if max(found).sure and max(found).near and not self._is_vague(belief):
                return found
        if not max(found).sure and (self._is_vague(first) or not max(found).near):
            found += [
                replace(self._hypothesis(fit, expected), near=False) for fit in self._sensor.search(first)
            ]
        return found

    def _hypothesis(self, fit: Fit, expected: Sequence[Belief]) -> _Hypothesis:
        """A match, weighed by the expectation that explains it best."""
        chi2 = [belief.chi2(fit.pose) for belief in expected]
        density = max(belief.log_density(c) for belief, c in zip(expected, chi2, strict=True))
        sure = fit.credible and fit.overlap >= self._parameters.sure_overlap
        return _Hypothesis(fit.evidence + density, fit, sure, near=min(chi2) < KERNEL**2)

    def _is_vague(self, belief: Belief) -> bool:
        """Whether a match alone does not reach all that a belief holds possible."""
        p, (sigma_m, sigma_rad) = self._parameters, belief.sigmas
        return KERNEL * max(sigma_m / p.search_above_m, sigma_rad / p.search_above_rad) > 1.0


def _spread(found: Sequence[_Hypothesis], best: _Hypothesis) -> F64:
    """The covariance (6, 6) of all hypotheses about the best one, in the axes of the base there."""
    mass = np.exp([other.score - best.score for other in found])
    poses = np.array([other.fit.pose for other in found])
    away = steps(np.tile(best.fit.pose, (len(poses), 1, 1)), poses).step
    spread: F64 = np.einsum("n,na,nb->ab", mass / mass.sum(), away, away)
    return spread
