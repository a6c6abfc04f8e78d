"""Scan matching with the local map: the most probable of several matches.

A sensor makes the matches (`ScanMatcher`: in the plane, or in space); their selection (`MatchSelector`) is
the same with three and with six degrees of freedom. KISS-ICP brings the scan near from each expected pose,
and the matches begin there. If none fits, the scan is searched for. The posterior density of a match is the
product of the likelihood of the scan and of the density of the expected pose. The best match is taken. Its
covariance is widened by the spread of all matches: where two places fit alike, neither is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Protocol

import numpy as np

from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.estimation.line_map import TRACKING_PARAMETERS, TrackingParameters, steps
from pc2grid.estimation.smoother import KERNEL, PoseWithCovariance
from pc2grid.geometry import F32, F64
from pc2grid.model import Scan

Measurement = tuple[F64, F64]
"""A pose or a motion (4, 4), with its information (D, D) in the axes of the base where it begins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanMatch:
    """A scan matched with the local map; D directions of the pose are free.

    pose : (4, 4) T_session_base, with the expected pose as prior. alone : the pose by the points alone, with
    its information (D, D) in the axes of the base.
    overlap : share of the points that meet the map. measured : True if they fix every direction of the
    position.
    evidence : logarithm of the likelihood of the scan at that pose, but for a constant.
    credible : True if surfaces and free space there support the pose without any prior.
    """

    pose: F64
    alone: Measurement
    overlap: float
    measured: bool
    evidence: float
    credible: bool


class ScanMatcher(Protocol):
    """Matches the scans of a session, one after another, with a local map.

    free : directions of the pose that can change, `PLANAR` or `SPATIAL` of `pc2grid.estimation.smoother`.
    points_m : (N, 3) deskewed points of a scan in the base frame.
    """

    free: tuple[int, ...]

    def start(self, scan: Scan, points_m: F32) -> F64:
        """Begin with the first scan; returns its pose (4, 4): the session frame is its base, levelled."""

    def take(self, scan: Scan, points_m: F32) -> None:
        """Prepare a scan for the following calls."""

    def __bool__(self) -> bool:
        """Return True if there is a local map."""

    def match(self, belief: PoseWithCovariance) -> list[ScanMatch]:
        """Match the scan taken last with the local map, from the expected pose or that of KISS-ICP, or both.

        KISS-ICP begins at the belief, which is also the prior of all matches.
        """

    def search(self, belief: PoseWithCovariance) -> Iterator[ScanMatch]:
        """Search the scan taken last wherever the belief allows, and match it there."""

    def observable(self, fit: ScanMatch) -> ScanMatch:
        """Return the match with only the information that the surfaces really provide
        (`SurfaceMap.observable`).
        """

    def follow(self, belief: PoseWithCovariance) -> Measurement | None:
        """Match with the last scans alone; returns the motion T_last_now, or None if the scan does not fit
        them.
        """

    def fits_last(self, belief: PoseWithCovariance) -> bool:
        """Return True if the scan taken last fits the scans before it; the local map does not matter."""

    def levelled(self, pose: F64) -> F64:
        """Return a pose (4, 4) in the free directions, with tilt and height where these are known besides."""

    def cut(self, scan: Scan, points_m: F32, pose: F64, *, lost: bool) -> PlanarScan:
        """Return the planar scan, in the levelled base frame, of the scan taken last at its final pose (4,
        4).
        """

    def extend(self, pose: F64) -> None:
        """Add the scan taken last, a keyframe, to the local map at its final pose (4, 4)."""

    def restart(self) -> None:
        """Forget the local map: the next scan that is not lost begins a new one."""


@dataclass(frozen=True, slots=True)
class MatchedScan:
    """The selected match of a scan with the local map.

    pose : (4, 4) initial T_session_base for the smoother. alone : as of `ScanMatch`; None if the scan fits
    nowhere. motion : T_last_now, if the scan shows new ground and fits only the scans before.
    sure : True if it fits the map well. measured : True if its points fix every direction of the position.
    first : True if there is no local map yet, nor any since tracking started again.
    """

    pose: F64
    alone: Measurement | None = None
    motion: Measurement | None = None
    sure: bool = False
    measured: bool = False
    first: bool = False


@dataclass(frozen=True, slots=True, order=True)
class _Candidate:
    """A match with the logarithm of its posterior density, but for a constant.

    sure : True if the scan fits well there. near : True if it lies at an expected pose, False if it was
    searched for.
    """

    score: float
    fit: ScanMatch = field(compare=False)
    sure: bool = field(compare=False)
    near: bool = field(compare=False)


class MatchSelector:
    """Selects the most probable match of each scan of a sensor."""

    def __init__(self, sensor: ScanMatcher, parameters: TrackingParameters = TRACKING_PARAMETERS) -> None:
        self._sensor, self._parameters = sensor, parameters

    def place(
        self, scan: Scan, points_m: F32, belief: PoseWithCovariance, others: Iterable[PoseWithCovariance] = ()
    ) -> MatchedScan:
        """Match the next scan with the local map.

        points_m : (N, 3) deskewed, base frame. belief : the most credible prediction of the pose, which a
        scan gets that fits nowhere, or is empty. others : less credible ones, made only where needed.
        """
        p = self._parameters
        self._sensor.take(scan, points_m)
        if not self._sensor:
            return MatchedScan(belief.pose, sure=True, first=True)
        found = self._candidates(belief, others)
        best = max(found)
        if best.fit.overlap < p.min_overlap or not (best.near or best.fit.credible):
            return MatchedScan(belief.pose, motion=self._sensor.follow(belief))
        fit = self._sensor.observable(best.fit)
        alone, information = fit.alone
        if len(found) > 1:
            spread = _spread(found, best)[np.ix_(belief.free, belief.free)]
            # The inverse of the sum of both covariances, also where a match has none of a direction.
            information = np.asarray(
                np.linalg.solve(np.eye(len(spread)) + information @ spread, information), np.float64
            )
        estimate = alone, 0.5 * (information + information.T)
        return MatchedScan(fit.pose, estimate, sure=best.sure, measured=fit.measured)

    def _candidates(
        self, first: PoseWithCovariance, others: Iterable[PoseWithCovariance]
    ) -> list[_Candidate]:
        """Return the matches at the expected poses, as many as are needed until one fits that an exact belief
        has led to; if none fits, also those of a search.
        """
        expected: list[PoseWithCovariance] = []
        fits: list[ScanMatch] = []
        for belief in chain((first,), others):
            expected.append(belief)
            fits += self._sensor.match(belief)
            found = [self._candidate(fit, expected) for fit in fits]
            if max(found).sure and max(found).near and not self._is_vague(belief):
                return found
        if not max(found).sure and (self._is_vague(first) or not max(found).near):
            found += [
                replace(self._candidate(fit, expected), near=False) for fit in self._sensor.search(first)
            ]
        return found

    def _candidate(self, fit: ScanMatch, expected: Sequence[PoseWithCovariance]) -> _Candidate:
        """Weight a match by the expected pose that explains it best."""
        chi2 = [belief.chi2(fit.pose) for belief in expected]
        density = max(belief.log_density(c) for belief, c in zip(expected, chi2, strict=True))
        sure = fit.credible and fit.overlap >= self._parameters.sure_overlap
        return _Candidate(fit.evidence + density, fit, sure, near=min(chi2) < KERNEL**2)

    def _is_vague(self, belief: PoseWithCovariance) -> bool:
        """Return True if a belief is wider than the reach of a match."""
        p, (sigma_m, sigma_rad) = self._parameters, belief.sigmas
        return KERNEL * max(sigma_m / p.search_above_m, sigma_rad / p.search_above_rad) > 1.0


def _spread(found: Sequence[_Candidate], best: _Candidate) -> F64:
    """Return the covariance (6, 6) of all candidates about the best one, in the axes of the base there."""
    mass = np.exp([other.score - best.score for other in found])
    poses = np.array([other.fit.pose for other in found])
    away = steps(np.tile(best.fit.pose, (len(poses), 1, 1)), poses).step
    spread: F64 = np.einsum("n,na,nb->ab", mass / mass.sum(), away, away)
    return spread
