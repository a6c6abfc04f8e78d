"""Scores a pose both ways: the query's walls against the map, and the map's walls against the query.

One way alone is not enough. The walls of a small query fit into many places; but at the wrong ones the map
has walls where the query has seen free space.

What each side must have seen of the other's walls is told by `pc2grid.matching.walls.Walls.facing`. A laser
passes under tables: what stands at some heights only explains what the laser sees, and does not contradict
its free space.

A wall that the map has seen from its other side only, as it does not know the ground in front of it, may be
the right one: walls are thin. But a query along the outer wall of a building fits the rooms behind it, too.
So such a wall counts in the score, by which places are ranked, and not as evidence of a place (`compared`).
Not the other way round: what a single scan knows of the ground are thin rays. Within a session, and between
two of one building, both sides are of one wall: there `Walls.before_m` are the walls.

Two lasers at different heights are compared on what both can see. The walls of the higher one stand on the
floor; what the lower one has seen need not reach up, so it counts as on unknown ground where the higher one
sees free space.

Improves a pose below the cell size: Gauss-Newton on the interpolated likelihood field.

As Hector SLAM does it (Kohlbrecher et al. 2011, "A flexible and scalable SLAM system", section IV-B): the sum
over the points of (1 - field)^2 is minimised, with the bilinear interpolation's gradient.

What supports and what contradicts a query at a pose, wall point by wall point.

A `Fit` is a mean over wall points; a picture that shows why it is high or low needs the points themselves.

How well a map fits onto itself, slid along: high in a bare corridor, low among rooms.

What fits onto itself elsewhere fits into other places of its kind as well: the walls that agree then say "a
corridor", not which one or where in it.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy import fft
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, SE2, U8, wrap_angle
from pc2grid.matching.walls import LIKELIHOOD, LikelihoodField, Walls


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """How well a query agrees with a map at one pose. Means and shares are weighted by `walls.steadiness`.

    T_map_query : pose of the query's frame in the map.
    forward : 0..1, mean likelihood of the query's walls; neutral where the map is unknown.
    backward : 0..1, mean likelihood of the map's walls on ground that the query knows.
    overlap : 0..1, share of the query's walls on ground that the map knows.
    compared : number of the query's wall points on ground that the map knows, as it does the ground in front
        of them, by weight.
    looked_at : number of the map's wall points on ground that the query knows, by weight.
    score : 0..1, geometric mean of forward and backward; hypotheses are ranked by it.
    covariance : (3, 3) of x, y, yaw from the refinement: wide along a corridor, narrow across it.
    """

    T_map_query: SE2
    forward: float
    backward: float
    overlap: float
    compared: float
    looked_at: float
    score: float
    covariance: F64

    def __repr__(self) -> str:
        pose = self.T_map_query
        return (
            f"Fit(x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {math.degrees(pose.yaw):.1f} deg,"
            f" score {self.score:.2f}, overlap {self.overlap:.2f})"
        )

    @property
    def known_agreement(self) -> float:
        """0..1, mean likelihood of the query's walls on ground that the map knows; 0 if it knows none."""
        if not self.overlap:
            return 0.0
        known = (self.forward - LIKELIHOOD.neutral * (1.0 - self.overlap)) / self.overlap
        return min(max(known, 0.0), 1.0)

    @property
    def known_agreement_both_ways(self) -> float:
        """0..1, the smaller of `known_agreement` and `backward`: how well each fits what the other knows."""
        return min(self.known_agreement, self.backward)


def score_fit(target: Walls, query: Walls, T_map_query: SE2, covariance: F64) -> Fit:
    """Score the query at a pose on the map `target`."""
    mine, theirs, T_query_map = query.facing(target), target.facing(query), T_map_query.inverse()
    seen, likelihood, behind = _sums(mine, target.field, T_map_query).tolist()
    looked_at, returned, _ = _sums(theirs, query.field, T_query_map).tolist()
    weight = mine.weight
    forward = (likelihood + LIKELIHOOD.neutral * (weight - seen)) / weight if weight else 0.0
    backward = scored = returned / looked_at if looked_at else 0.0
    if theirs.only_explain:
        observed = float(_sums(replace(theirs, only_explain=False), query.field, T_query_map)[0])
        scored = (returned + LIKELIHOOD.neutral * (observed - looked_at)) / observed if observed else 0.0
    return Fit(
        T_map_query=T_map_query,
        forward=forward,
        backward=backward,
        overlap=seen / weight if weight else 0.0,
        compared=seen - behind,
        looked_at=looked_at,
        score=math.sqrt(forward * scored),
        covariance=covariance,
    )


def _sums(walls: Walls, field: LikelihoodField, T_field_walls: SE2) -> F64:
    """(3,) what `_kernels.known_sums` says of walls on a field."""
    from pc2grid.matching.search import known_sums

    least = LIKELIHOOD.neutral_value + 1 if walls.only_explain else 0
    pose = T_field_walls.x, T_field_walls.y, T_field_walls.yaw
    on = field.values, field.known, field.resolution_m, field.origin_m
    return np.array(known_sums(*on, walls.points_m, walls.before_m, walls.weights, pose, least))


@dataclass(frozen=True, slots=True, kw_only=True)
class RefinementParameters:
    """How the refinement steps, and what its covariance assumes. All chosen by hand.

    steps : Gauss-Newton steps at most; where hardly anything fits, poses do not converge.
    longest_step_cells : a step is cut to this length; the field's slope is known nearby only.
    still_cells, still_rad : steps below both of these end the refinement.
    damping : share of the Hessian's diagonal that is added to it (Levenberg-Marquardt).
    least_points : points within reach of a wall below which the pose is left as it is.
    few_points : of four times as many points, every so many are refined first, so that most steps are fast.
    correlated : so many neighbouring wall points carry the information of one.
    least_misfit : lower bound of the mean squared misfit in the covariance.
    prior_m, prior_rad : standard deviations of a direction that the walls do not constrain.
    """

    steps: int = 8
    longest_step_cells: float = 2.0
    still_cells: float = 0.02
    still_rad: float = 2e-4
    damping: float = 0.05
    least_points: int = 10
    few_points: int = 300
    correlated: float = 5.0
    least_misfit: float = 0.02
    prior_m: float = 0.5
    prior_rad: float = 0.1


REFINEMENT = RefinementParameters()
LEAST_LIKELIHOOD = 0.05
"""A point on a lower likelihood is too far from every wall for a gradient; it is left out."""


def refine(
    field: LikelihoodField,
    points_m: F32,
    T_map_query: SE2,
    center_m: tuple[float, float],
    parameters: RefinementParameters = REFINEMENT,
) -> tuple[SE2, F64]:
    """Improve the pose of points (M, 2) of the query's frame; returns it and its covariance (3, 3).

    center_m : the point of the query's frame that the rotation turns about; the covariance, of x, y and yaw
    in the map, is that of the query's pose at this point.

    The covariance is the inverse of the Gauss-Newton Hessian, scaled for the correlation of neighbouring
    points, with a prior as wide as the neighbourhood that the field can see: a direction that the walls do
    not constrain gets that width, not infinity.
    """
    res = field.resolution_m
    center = np.asarray(center_m, np.float64)
    x, y = ((points_m - center) / res).T.copy()
    start = (T_map_query.apply(center[None])[0] - field.origin_m) / res
    pose = np.array([start[0], start[1], T_map_query.yaw])
    if len(x) >= 4 * parameters.few_points:
        every = len(x) // parameters.few_points
        pose, _, _ = gauss_newton(field.values, x[::every].copy(), y[::every].copy(), pose, parameters)
    pose, hessian, misfit = gauss_newton(field.values, x, y, pose, parameters)
    per_cell = np.array([res, res, 1.0])
    information = hessian / np.outer(per_cell, per_cell)
    information /= parameters.correlated * max(misfit, parameters.least_misfit)
    information += np.diag([parameters.prior_m**-2, parameters.prior_m**-2, parameters.prior_rad**-2])
    yaw = wrap_angle(float(pose[2]))
    at_x, at_y = pose[:2] * res + field.origin_m
    turned = SE2(0.0, 0.0, yaw).apply(center[None])[0]
    return SE2(float(at_x - turned[0]), float(at_y - turned[1]), yaw), np.asarray(
        np.linalg.inv(information), np.float64
    )


def gauss_newton(
    values: U8, x: F64, y: F64, pose: F64, parameters: RefinementParameters = REFINEMENT
) -> tuple[F64, F64, float]:
    """The pose (tx, ty, yaw; cells) of points improved, the Hessian (3, 3) and the mean squared misfit.

    values : likelihood field (H, W). x, y : (M,) of the points.
    """
    from pc2grid.matching.search import normal_equations

    pose, misfit = pose.copy(), 1.0
    hessian = np.zeros((3, 3))
    for _ in range(parameters.steps):
        hessian, gradient, total, count = normal_equations(values, x, y, pose[0], pose[1], pose[2])
        if count < parameters.least_points:
            break
        misfit = total / count
        damped = hessian + np.diag(parameters.damping * np.diag(hessian) + 1e-3)
        step = np.linalg.solve(damped, gradient)
        size = math.hypot(step[0], step[1])
        if size > parameters.longest_step_cells:
            step *= parameters.longest_step_cells / size
        pose += step
        if size < parameters.still_cells and abs(step[2]) < parameters.still_rad:
            break
    return pose, hessian, misfit


class Support(enum.IntEnum):
    """What a map says about a wall point of a query.

    FITS : there is a wall of the map so near that the point raises the score. CONTRADICTED : the map knows
    free ground there. UNKNOWN : the map knows nothing there.
    """

    UNKNOWN = 0
    FITS = 1
    CONTRADICTED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """The wall points behind a `two_way_score.Fit`.

    points_m : (K, 2) float32, the query's wall points, in the query's frame.
    support : (K,) uint8, the `Support` of each.
    weights : (K,) float32, 0..1, how much each counts, see `walls.steadiness`.
    missed_m : (M, 2) float32, wall points of the map, in the map frame, where the query saw free ground.
    """

    points_m: F32
    support: U8
    weights: F32
    missed_m: F32

    def share(self, kind: Support) -> float:
        """The share of the query's wall points of this kind, 0..1, by weight; 0 without points.

        The shares that fit and that are contradicted add up to `Fit.overlap`.
        """
        total = float(self.weights.sum(dtype=np.float64))
        of_these = float(self.weights[self.support == kind].sum(dtype=np.float64))
        return of_these / total if total else 0.0


def agreement(target: Walls, query: Walls, T_map_query: SE2) -> Agreement:
    """Compare a query with the map `target` at a pose.

    A point fits if its likelihood is not below `LikelihoodParameters.neutral`, the likelihood of a point on
    unknown ground: then it supports the pose, otherwise it speaks against it. With the usual numbers that is
    a wall of the map within 0.14 m.
    """
    query, target = query.facing(target), target.facing(query)
    fits, known = _fits(query, target, T_map_query)
    support = np.where(known, np.where(fits, Support.FITS, Support.CONTRADICTED), Support.UNKNOWN)
    met, looked_at = _fits(target, query, T_map_query.inverse())
    return Agreement(
        points_m=query.points_m,
        support=support.astype(np.uint8),
        weights=query.weights,
        missed_m=target.points_m[looked_at & ~met],
    )


def _fits(walls: Walls, other: Walls, T_other_walls: SE2) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which wall points (N,) have a wall of the other side near, and which lie on ground that it knows."""
    likelihood, known = other.field.at(T_other_walls.apply(walls.points_m), above=walls.only_explain)
    return likelihood >= LIKELIHOOD.neutral, known


@dataclass(frozen=True, slots=True, kw_only=True)
class LikenessParameters:
    """Which slides are compared. All chosen by hand.

    nearest_m, farthest_m : lengths of a slide, in any direction: farther than two hypotheses that are one,
        and about as far as a robot sees.
    cell_m : slides are multiples of about this, the spacing of wall points.
    overlap : at least this share of the walls lies on known ground, by weight, slid there and slid back. What
        a single scan knows hardly overlaps with itself, and is compared with nothing.
    """

    nearest_m: float = 1.0
    farthest_m: float = 8.0
    cell_m: float = 0.1
    overlap: float = 0.5


LIKENESS = LikenessParameters()


def self_likeness(walls: Walls, parameters: LikenessParameters = LIKENESS) -> float:
    """The best agreement of a map with itself, 0..1, over all slides; 0 if none overlaps enough.

    As of two maps (`two_way_score`): the geometric mean, forward and backward, of the mean likelihood of the
    wall points on known ground. All slides at once, as correlations by the fast Fourier transform.
    """
    total = walls.weight
    if total <= 0.0:
        return 0.0
    n = max(round(parameters.cell_m / walls.field.resolution_m), 1)
    cell_m = n * walls.field.resolution_m
    drawn = _drawn(walls, n)
    reach = round(parameters.farthest_m / cell_m)
    shape = [cv2.getOptimalDFTSize(n + reach) for n in drawn[0].shape]
    points, *grounds = (fft.rfft2(image, shape) for image in drawn)
    slides = np.arange(-reach, reach + 1)
    fits, overlap = (
        fft.irfft2(np.conj(points) * ground, shape)[np.ix_(slides, slides)] for ground in grounds
    )
    there = np.where(overlap > 1e-6, fits / np.maximum(overlap, 1e-6), 0.0)
    length_m = cell_m * np.hypot(slides[:, None], slides)
    enough = overlap >= parameters.overlap * total
    compared = (length_m >= parameters.nearest_m) & (length_m <= parameters.farthest_m)
    compared &= enough & enough[::-1, ::-1]
    both_ways = np.clip(there * there[::-1, ::-1], 0.0, 1.0)[compared]
    return math.sqrt(float(both_ways.max())) if len(both_ways) else 0.0


def _drawn(walls: Walls, n: int) -> tuple[F64, F64, F64]:
    """(H, W) each, in squares of n by n cells: weight of the wall points, mean likelihood of the known
    ground, and whether at least half of it is known."""
    field = walls.field
    height, width = (-(-side // n) for side in field.values.shape)

    def mean(values: U8) -> F64:
        short = ((0, height * n - values.shape[0]), (0, width * n - values.shape[1]))
        padded = np.pad(values, short)
        cells = (padded[row::n, column::n].astype(np.float64) for row in range(n) for column in range(n))
        return np.asarray(sum(cells) / n**2)

    share = mean(field.known.view(np.uint8))
    known = share >= 0.5
    on_known = mean(field.values * field.known) / 255.0
    likelihood = np.where(known, on_known / np.maximum(share, 0.5), 0.0)
    cells = np.floor((walls.points_m - np.asarray(field.origin_m)) / (n * field.resolution_m)).astype(np.intp)
    weights = np.zeros((height, width))
    np.add.at(weights, (cells[:, 1], cells[:, 0]), walls.weights)
    return weights, likelihood, known.astype(np.float64)
