"""Improves a pose below the cell size: Gauss-Newton on the interpolated likelihood field.

As Hector SLAM does it (Kohlbrecher et al. 2011, "A flexible and scalable SLAM system", section IV-B): the sum
over the points of (1 - field)^2 is minimised, with the bilinear interpolation's gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F32, F64, U8
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.matching.likelihood_field import LikelihoodField


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
    from pc2grid.matching._kernels import normal_equations

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
