"""Scores a pose both ways, the query's walls against the map and the map's walls against the query; refines
it.

The walls of a small query fit into many places. At a wrong one the map has walls where the query has observed
free space, so both directions count. What each side must have observed is defined by `Walls.facing`: a laser
passes under tables, so obstacles at some heights only explain its returns, and do not contradict its free
space. Two lasers at different heights are compared on what both can observe: the walls of the higher one
stand on the floor, but those of the lower one need not reach up, so they count as on unknown ground where the
higher one observes free space.

Walls are thin: a wall that the map has observed from its other side only, where it does not know the ground
in front, may be the right one. But a query along the outer wall of a building also fits the rooms behind it.
So such a wall counts in the score, which ranks places, but not as evidence of a place (`compared`). The walls
of the map are not treated so, because a single scan knows the ground along thin rays only. Within a session,
and between two of one building, both have observed the same side: there `Walls.before_m` are the walls.

`refine` improves a pose below the cell size as Hector SLAM does (Kohlbrecher et al. 2011, "A flexible and
scalable SLAM system", section IV-B): Gauss-Newton minimises the sum over the points of (1 - field)^2, with
the gradient of the bilinear interpolation. `agreement` lists the wall points behind a score. The
`self_similarity` of a map is how well it fits onto itself, shifted: high in a bare corridor, low among rooms.
A map that fits onto itself elsewhere also fits other places of its kind.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy import fft
from numpy.typing import NDArray

from pc2grid.geometry import F32, F64, SE2, U8, BoolGrid, wrap_angle
from pc2grid.libraries import compiled
from pc2grid.matching.walls import LIKELIHOOD, WALLS, LikelihoodField, Walls


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """The agreement of a query with a map at one pose. Means and shares are weighted by `walls.permanence`.

    T_map_query : pose of the query's frame in the map.
    forward : 0..1, mean likelihood of the query's walls; neutral where the map is unknown.
    backward : 0..1, mean likelihood of the map's walls on ground known to the query.
    overlap : 0..1, share of the query's walls on ground known to the map.
    compared : number of the query's wall points that, with the ground in front of them, are known to the map,
        by weight.
    looked_at : number of the map's wall points on ground known to the query, by weight.
    score : 0..1, geometric mean of forward and backward; hypotheses are ranked by it.
    covariance : (3, 3) of x, y, yaw from the refinement: wide along a corridor, narrow across it.
    session_index : number of the map among those that were searched: of a session, or, where a loop is
        recognised, of a place map. submap_id : of its place that proposed the pose; -1: none.
    """

    T_map_query: SE2
    forward: float
    backward: float
    overlap: float
    compared: float
    looked_at: float
    score: float
    covariance: F64
    session_index: int = 0
    submap_id: int = -1

    def __repr__(self) -> str:
        pose = self.T_map_query
        return (
            f"Fit(x {pose.x:.2f} m, y {pose.y:.2f} m, yaw {math.degrees(pose.yaw):.1f} deg,"
            f" score {self.score:.2f}, overlap {self.overlap:.2f})"
        )

    @property
    def known_agreement(self) -> float:
        """Return the mean likelihood, 0..1, of the query's walls on ground known to the map; 0 if there is
        none.
        """
        if not self.overlap:
            return 0.0
        known = (self.forward - LIKELIHOOD.neutral * (1.0 - self.overlap)) / self.overlap
        return min(max(known, 0.0), 1.0)

    @property
    def known_agreement_both_ways(self) -> float:
        """Return the smaller of `known_agreement` and `backward`, 0..1: the worse of the two directions."""
        return min(self.known_agreement, self.backward)


_EXACT = np.zeros((3, 3))


def score_fit(target: Walls, query: Walls, T_map_query: SE2, covariance: F64 = _EXACT) -> Fit:
    """Score the query at a pose on the map `target`. covariance : (3, 3) of the pose."""
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
    """Return `known_sums` (3,) of walls on a field."""
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
) -> tuple[SE2, F64]:
    """Refine the pose of points (M, 2) of the query's frame; returns it and its covariance (3, 3).

    center_m : centre of rotation in the query's frame; the covariance, of x, y and yaw in the map, is that of
    the query's pose at this point.

    The covariance is the inverse of the Gauss-Newton Hessian, scaled for the correlation of neighbouring
    points, with a prior as wide as the reach of the field: a direction that the walls do not constrain gets
    that width, not infinity.
    """
    p, res = REFINEMENT, field.resolution_m
    center = np.asarray(center_m, np.float64)
    x, y = ((points_m - center) / res).T.copy()
    start = (T_map_query.apply(center[None])[0] - field.origin_m) / res
    pose = np.array([start[0], start[1], T_map_query.yaw])
    if len(x) >= 4 * p.few_points:
        every = len(x) // p.few_points
        pose, _, _ = gauss_newton(field.values, x[::every].copy(), y[::every].copy(), pose)
    pose, hessian, misfit = gauss_newton(field.values, x, y, pose)
    per_cell = np.array([res, res, 1.0])
    information = hessian / np.outer(per_cell, per_cell)
    information /= p.correlated * max(misfit, p.least_misfit)
    information += np.diag([p.prior_m**-2, p.prior_m**-2, p.prior_rad**-2])
    yaw = wrap_angle(float(pose[2]))
    at_x, at_y = pose[:2] * res + field.origin_m
    turned = SE2(0.0, 0.0, yaw).apply(center[None])[0]
    return SE2(float(at_x - turned[0]), float(at_y - turned[1]), yaw), np.asarray(
        np.linalg.inv(information), np.float64
    )


def gauss_newton(
    values: U8, x: F64, y: F64, pose: F64, parameters: RefinementParameters = REFINEMENT
) -> tuple[F64, F64, float]:
    """Improve the pose (tx, ty, yaw; cells) of points; returns it, the Hessian (3, 3) and the mean squared
    misfit.

    values : likelihood field (H, W). x, y : (M,) of the points.
    """
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
    """How a map explains a wall point of a query.

    FITS : a wall of the map is so near that the point raises the score. CONTRADICTED : the map is free there.
    UNKNOWN : the map is unknown there.
    """

    UNKNOWN = 0
    FITS = 1
    CONTRADICTED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """The wall points behind a `Fit`.

    points_m : (K, 2) float32, the query's wall points, in the query's frame.
    support : (K,) uint8, the `Support` of each.
    weights : (K,) float32, 0..1, see `walls.permanence`.
    missed_m : (M, 2) float32, wall points of the map, in the map frame, where the query observed free ground.
    """

    points_m: F32
    support: U8
    weights: F32
    missed_m: F32

    def share(self, kind: Support) -> float:
        """Return the share of the query's wall points of this kind, 0..1, by weight; 0 without points.

        The shares that fit and that are contradicted add up to `Fit.overlap`.
        """
        total = float(self.weights.sum(dtype=np.float64))
        of_these = float(self.weights[self.support == kind].sum(dtype=np.float64))
        return of_these / total if total else 0.0


def agreement(target: Walls, query: Walls, T_map_query: SE2) -> Agreement:
    """Compare a query with the map `target` at a pose.

    A point fits if its likelihood is not below `LikelihoodParameters.neutral`, the likelihood of a point on
    unknown ground: it then supports the pose, otherwise it contradicts it. With the usual numbers a point
    fits if a wall of the map lies within 0.14 m.
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
    """Return a mask (N,) of the wall points near a wall of the other side, and one (N,) of those on ground
    known to it.
    """
    likelihood, known = other.field.at(T_other_walls.apply(walls.points_m), above=walls.only_explain)
    return likelihood >= LIKELIHOOD.neutral, known


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfSimilarityParameters:
    """Which shifts are compared. All chosen by hand.

    nearest_m, farthest_m : lengths of a shift, in any direction: farther than two hypotheses that are one,
        and about as far as a robot sees.
    cell_m : shifts are multiples of about the spacing of wall points.
    overlap : least share of the walls, by weight, on known ground, shifted forward and back. The known ground
        of a single scan hardly overlaps with itself, so it is compared with nothing.
    """

    nearest_m: float = 1.0
    farthest_m: float = 8.0
    cell_m: float = WALLS.spacing_m
    overlap: float = 0.5


SELF_SIMILARITY = SelfSimilarityParameters()


def self_similarity(walls: Walls) -> float:
    """Return the best agreement of a map with itself, 0..1, over all shifts; 0 if none overlaps enough.

    As between two maps (`score_fit`), it is the geometric mean, forward and backward, of the mean likelihood
    of the wall points on known ground. All shifts are computed at once, as correlations by the fast Fourier
    transform.
    """
    p, total = SELF_SIMILARITY, walls.weight
    if total <= 0.0:
        return 0.0
    n = max(round(p.cell_m / walls.field.resolution_m), 1)
    cell_m = n * walls.field.resolution_m
    drawn = _drawn(walls, n)
    reach = round(p.farthest_m / cell_m)
    shape = [cv2.getOptimalDFTSize(n + reach) for n in drawn[0].shape]
    points, *grounds = (fft.rfft2(image, shape) for image in drawn)
    slides = np.arange(-reach, reach + 1)
    fits, overlap = (
        fft.irfft2(np.conj(points) * ground, shape)[np.ix_(slides, slides)] for ground in grounds
    )
    there = np.where(overlap > 1e-6, fits / np.maximum(overlap, 1e-6), 0.0)
    length_m = cell_m * np.hypot(slides[:, None], slides)
    enough = overlap >= p.overlap * total
    compared = (length_m >= p.nearest_m) & (length_m <= p.farthest_m)
    compared &= enough & enough[::-1, ::-1]
    both_ways = np.clip(there * there[::-1, ::-1], 0.0, 1.0)[compared]
    return math.sqrt(float(both_ways.max())) if len(both_ways) else 0.0


def _drawn(walls: Walls, n: int) -> tuple[F64, F64, F64]:
    """Rasterise walls in squares of n by n cells (H, W): weight of the wall points, mean likelihood, known
    ground.

    The likelihood is that of the known cells; a square is known if at least half of it is.
    """
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


# --- compiled functions -------------------------------------------------------------------------------


@compiled(nogil=True)
def known_sums(
    values: U8,
    known: BoolGrid,
    resolution_m: float,
    origin_m: tuple[float, float],
    points_m: F32,
    before_m: F32,
    weights: F32,
    pose: tuple[float, float, float],
    least: int,
) -> tuple[float, float, float]:
    """Return the weight of the wall points on known ground, their weighted sum of likelihoods, and the weight
    of those whose front is unknown.

    Likelihoods are 0..1. Points with a likelihood below `least` do not count.
    """
    height, width = values.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] - origin_m[0], pose[1] - origin_m[1]
    seen, likelihood, behind = 0.0, 0.0, 0.0
    for p in range(len(points_m)):
        j = math.floor((c * points_m[p, 0] - s * points_m[p, 1] + x) / resolution_m)
        i = math.floor((s * points_m[p, 0] + c * points_m[p, 1] + y) / resolution_m)
        if j < 0 or i < 0 or j >= width or i >= height or not known[i, j] or values[i, j] < least:
            continue
        seen += weights[p]
        likelihood += weights[p] * (values[i, j] / 255.0)
        j = math.floor((c * before_m[p, 0] - s * before_m[p, 1] + x) / resolution_m)
        i = math.floor((s * before_m[p, 0] + c * before_m[p, 1] + y) / resolution_m)
        if j < 0 or i < 0 or j >= width or i >= height or not known[i, j]:
            behind += weights[p]
    return seen, likelihood, behind


@compiled(nogil=True, fastmath=True)
def normal_equations(
    field: U8, x: F64, y: F64, tx: float, ty: float, yaw: float
) -> tuple[F64, F64, float, float]:
    """Return the Hessian (3, 3), gradient (3,), sum of squared misfits and number of the points that count.

    A point counts if the interpolation has its four cells within the field and is at least
    `LEAST_LIKELIHOOD`; the value of a cell is that of its centre.
    """
    height, width = field.shape
    c, s = math.cos(yaw), math.sin(yaw)
    right, top, unit = width - 1 - 1e-6, height - 1 - 1e-6, 1.0 / 255.0
    g0, g1, g2 = 0.0, 0.0, 0.0
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    misfit, count = 0.0, 0.0
    for p in range(len(x)):
        rx, ry = c * x[p] - s * y[p], s * x[p] + c * y[p]
        u, v = rx + tx - 0.5, ry + ty - 0.5
        inside_u, inside_v = min(max(u, 0.0), right), min(max(v, 0.0), top)
        j, i = int(inside_u), int(inside_v)
        a, b = inside_u - j, inside_v - i
        f00, f01 = field[i, j] * unit, field[i, j + 1] * unit
        f10, f11 = field[i + 1, j] * unit, field[i + 1, j + 1] * unit
        f = (1 - b) * ((1 - a) * f00 + a * f01) + b * ((1 - a) * f10 + a * f11)
        # Branchless: a point that does not count has weight 0.
        w = 1.0 if (inside_u == u) & (inside_v == v) & (f >= LEAST_LIKELIHOOD) else 0.0
        du = w * ((1 - b) * (f01 - f00) + b * (f11 - f10))
        dv = w * ((1 - a) * (f10 - f00) + a * (f11 - f01))
        r, dyaw = w * (1.0 - f), dv * rx - du * ry
        misfit += r * r
        count += w
        g0 += du * r
        g1 += dv * r
        g2 += dyaw * r
        h00 += du * du
        h01 += du * dv
        h02 += du * dyaw
        h11 += dv * dv
        h12 += dv * dyaw
        h22 += dyaw * dyaw
    H, g = np.empty((3, 3)), np.empty(3)
    H[0, 0], H[0, 1], H[0, 2] = h00, h01, h02
    H[1, 0], H[1, 1], H[1, 2] = h01, h11, h12
    H[2, 0], H[2, 1], H[2, 2] = h02, h12, h22
    g[0], g[1], g[2] = g0, g1, g2
    return H, g, misfit, count
