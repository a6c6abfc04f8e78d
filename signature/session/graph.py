"""The pose graph in the plane, with one more source of evidence: the axes of the building.

`optimise` is sparse least squares over planar poses with robust edges: the manifold Gauss-Newton of Grisetti
et al., "A tutorial on graph-based SLAM" (2010), section IV. Cauchy weights decide which of the edges that may
be wrong are right, and those solve the graph. In the plane it needs 3 numbers a pose where Open3D's optimiser
has 6, uses each edge's information as it was measured, and needs no Open3D for a 2D laser. It was compared
with Open3D's `global_optimization` (`docs/method.md`).

Loops fix the headings at places that are visited twice. Along a corridor that is driven once nothing does,
and an error of one degree moves its far end by 1.7 m in 100 m. As far as a building is right-angled, its
walls give the heading (the Manhattan world of Coughlan and Yuille, 1999; in a pose graph: Peasley et al.,
"Accurate on-line 3D occupancy grids using Manhattan world constraints", 2012). Each local map contributes the
direction of its walls modulo 90 degrees, weakly and robustly: walls of other directions are either not
concentrated (curved walls) or farther from the axes than the robust scale (a wing at another angle), and lose
their weight. Loops and tracked steps are ten times as exact and decide wherever there are any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import splu

from pc2grid.geometry import F64, SE2, wrap_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraphParameters:
    """Numbers of the optimisation; chosen by hand.

    iterations : of each of the two rounds, at most. converged : largest change of a coordinate, metres and
        radians, that ends them.
    damping : added to the diagonal of the normal equations, so that they can always be solved.
    robust_sigmas : standard deviations at which a loop edge has half of its weight.
    annealing : factor by which the robust scale of loops shrinks in each iteration.
    kept : share of its weight with which a loop still counts in full when the graph is solved again: the
        weight at a chi-square of three `robust_sigmas` squared, 27. Of true loops, which have three degrees
        of freedom, six in a million are farther off.
    """

    iterations: int = 25
    converged: float = 1e-5
    damping: float = 1e-6
    robust_sigmas: float = 3.0
    annealing: float = 3.0
    kept: float = 0.25


POSE_GRAPH = PoseGraphParameters()


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured relative pose T_first_second with its information (3, 3) in the first pose's axes.

    loop : True if the measurement may be wrong altogether; its weight is then robust. counts : weight, 0..1,
    that is already a factor of the information; less than 1 for a doubtful overlap. mass : the part of it
    that a recognised place has by its alternatives and by drift; 1 for what was found near its pose.
    """

    first: int
    second: int
    T_first_second: SE2
    information: F64
    loop: bool = False
    counts: float = 1.0
    mass: float = 1.0


@dataclass(frozen=True, slots=True)
class Solution:
    """The poses that agree best with the edges.

    poses : (N, 3) x, y, yaw. accepted : (E,) False for loops that contradict the poses by more than
    `PoseGraphParameters.robust_sigmas`.
    """

    poses: F64
    accepted: NDArray[np.bool_]


def optimise(
    poses: F64,
    edges: Sequence[Edge],
    walls: Sequence[WallDirection] | None = None,
) -> Solution:
    """Optimise poses (N, 3) so that they agree best with the edges; the first pose is fixed.

    walls : of each pose, if the building's axes constrain the headings.

    First, Cauchy weights find the loops that agree. The robust scale of a loop that contradicts the poses
    starts so large that it has half of its weight, and shrinks to its final value during the iterations
    (graduated non-convexity, Yang et al. 2020): loops that agree correct large drift, and outvote a false
    loop. But false loops together still pull, each by the inverse of its error. So the graph is solved again
    with fixed weights. A loop that has kept `kept` of its weight counts in full; beyond, its pull falls with
    the fifth power of its error. The weight has no step, at which the last bit of a number would decide on
    the map.
    """
    poses = np.array(poses, dtype=np.float64)
    if not edges or len(poses) < 2:
        return Solution(poses, np.ones(len(edges), np.bool_))
    i, j, measured, information = _arrays(edges)
    loop = np.array([e.loop for e in edges])
    rows = _unknowns(i, j)
    damping = POSE_GRAPH.damping * identity(3 * len(poses) - 3, format="csc")
    limit = POSE_GRAPH.robust_sigmas**2
    error, jacobian = _linearise(poses, i, j, measured)
    chi2 = np.einsum("ea,eab,eb->e", error, information, error)
    scale = np.maximum(chi2 / limit, 1.0)
    fixed: F64 | None = None
    for _ in range(2):
        for _ in range(POSE_GRAPH.iterations):
            weight = 1.0 / (1.0 + chi2 / (scale * limit)) if fixed is None else fixed
            JtO = jacobian.transpose(0, 2, 1) @ (information * np.where(loop, weight, 1.0)[:, None, None])
            H, g = _normal_equations(poses, rows, JtO, jacobian, error, walls)
            delta = np.zeros(3 * len(poses))
            # Ordered and pivoted as a symmetric matrix: 2,000 poses take 0.8 s in place of 1.8.
            factors = splu(H[3:, 3:] + damping, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            delta[3:] = factors.solve(-g[3:])
            poses += delta.reshape(-1, 3)
            poses[:, 2] = wrap_angle(poses[:, 2])
            error, jacobian = _linearise(poses, i, j, measured)
            chi2 = np.einsum("ea,eab,eb->e", error, information, error)
            if scale.max() == 1.0 and np.abs(delta).max() < POSE_GRAPH.converged:
                break
            scale = np.maximum(scale / POSE_GRAPH.annealing, 1.0)
        fixed = np.minimum(1.0 / (1.0 + chi2 / limit) / POSE_GRAPH.kept, 1.0) ** 3
    return Solution(poses, ~loop | (chi2 <= limit))


def _normal_equations(
    poses: F64,
    rows: NDArray[np.intp],
    JtO: F64,
    jacobian: F64,
    error: F64,
    walls: Sequence[WallDirection] | None,
) -> tuple[csc_matrix, F64]:
    """Return the matrix (3 N, 3 N) and the gradient (3 N,) of edges and of the building's axes.

    rows : (E, 6) unknowns of each edge. JtO : (E, 6, 3) transposed Jacobian times information.
    """
    H = _of_edges(JtO @ jacobian, rows, len(poses)).tocsc()
    g = np.zeros(3 * len(poses))
    np.add.at(g, rows, np.einsum("eab,eb->ea", JtO, error))
    if walls is not None:
        deviation, heading = pull_to_axes(poses[:, 2], walls)
        H += _of_headings(heading)
        g[2::3] += heading * deviation
    return H, g


def information_matrix(
    poses: F64, edges: Sequence[Edge], walls: Sequence[WallDirection] | None = None
) -> coo_matrix:
    """Return the information matrix (3 N, 3 N) of poses (N, 3), sparse: x, y, yaw of one pose after the
    other.

    It does not constrain the pose of the whole. walls : as for `optimise`.
    """
    i, j, measured, information = _arrays(edges)
    _, jacobian = _linearise(poses, i, j, measured)
    H = jacobian.transpose(0, 2, 1) @ information @ jacobian
    by_edges = _of_edges(H, _unknowns(i, j), len(poses))
    if walls is None:
        return by_edges
    return by_edges + _of_headings(pull_to_axes(poses[:, 2], walls)[1])


def _of_edges(information: F64, rows: NDArray[np.intp], count: int) -> coo_matrix:
    """Return the information matrix (3 N, 3 N) of edges, (E, 6, 6), between their unknowns (E, 6). count :
    N."""
    row, column = np.repeat(rows, 6, axis=1).ravel(), np.tile(rows, (1, 6)).ravel()
    return coo_matrix((information.ravel(), (row, column)), shape=(3 * count, 3 * count))


def _of_headings(information: F64) -> coo_matrix:
    """Return the information matrix (3 N, 3 N) of headings with `information` (N,)."""
    yaw = 3 * np.arange(len(information)) + 2
    return coo_matrix((information, (yaw, yaw)), shape=(3 * len(yaw), 3 * len(yaw)))


def _arrays(edges: Sequence[Edge]) -> tuple[NDArray[np.intp], NDArray[np.intp], F64, F64]:
    """Return first (E,) and second (E,) poses of edges, measured steps (E, 3) and information (E, 3, 3)."""
    i, j = np.array([(e.first, e.second) for e in edges]).T
    measured = np.array([(e.T_first_second.x, e.T_first_second.y, e.T_first_second.yaw) for e in edges])
    return i, j, measured, np.array([e.information for e in edges])


def _unknowns(i: NDArray[np.intp], j: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the numbers (E, 6) of the coordinates of both poses of each edge among those of all poses."""
    return np.stack((3 * i, 3 * i + 1, 3 * i + 2, 3 * j, 3 * j + 1, 3 * j + 2), axis=1)


def _linearise(poses: F64, i: NDArray[np.intp], j: NDArray[np.intp], measured: F64) -> tuple[F64, F64]:
    """Return errors (E, 3) and Jacobians (E, 3, 6) with respect to both poses of each edge."""
    a, b = poses[i], poses[j]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    error = between(a, b) - measured
    error[:, 2] = wrap_angle(error[:, 2])
    jacobian = np.zeros((len(i), 3, 6))
    jacobian[:, 0, 0], jacobian[:, 0, 1] = -c, -s
    jacobian[:, 1, 0], jacobian[:, 1, 1] = s, -c
    jacobian[:, 0, 2] = -s * dx + c * dy
    jacobian[:, 1, 2] = -c * dx - s * dy
    jacobian[:, :2, 3:5] = -jacobian[:, :2, :2]
    jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
    return error, jacobian


def between(a: F64, b: F64) -> F64:
    """Return T_a_b (N, 3) of poses (N, 3) in one frame: x, y, yaw."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack((c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]))


def compose(a: F64, b: F64) -> F64:
    """Compose poses: return `b` (N, 3), given in the frames of `a` (N, 3), in the frame of these."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        (a[:, 0] + c * b[:, 0] - s * b[:, 1], a[:, 1] + s * b[:, 0] + c * b[:, 1], a[:, 2] + b[:, 2])
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AxesParameters:
    """Numbers of the constraint. They follow from what walls look like, and were not fitted.

    robust_rad : deviation from the axes at which a local map has a quarter of its weight: two to seven times
        that of real walls (`docs/method.md`).
    sigma_rad : standard deviation of the direction of one local map whose walls are all parallel to the axes.
        Local maps 4 m apart show the same walls up to 12 m ahead and behind: six of them are about one
        observation with 3 degrees, so that each alone counts as one with sqrt(6) times as much.
    rounds : in which the axes are found; outliers lose their weight in the first of them.
    """

    robust_rad: float = math.radians(3.0)
    sigma_rad: float = math.radians(7.0)
    rounds: int = 5


AXES = AxesParameters()


@dataclass(frozen=True, slots=True)
class WallDirection:
    """The direction of the walls of a local map, modulo 90 degrees.

    direction_rad : in the frame of the local map, within 45 degrees of its x axis. concentration : 0 if all
    directions are equally frequent, 1 if all walls are parallel or at right angles.
    """

    direction_rad: float
    concentration: float


def wall_direction(normal_rad: NDArray[np.floating]) -> WallDirection:
    """Return the direction of the walls with normals (N,); without a wall, of concentration 0."""
    if not len(normal_rad):
        return WallDirection(0.0, 0.0)
    # Four times an angle is the same for directions that differ by right angles.
    mean = np.exp(4j * np.asarray(normal_rad, np.float64)).mean()
    return WallDirection(float(np.angle(mean)) / 4.0, float(np.abs(mean)))


def pull_to_axes(yaw_rad: F64, walls: Sequence[WallDirection]) -> tuple[F64, F64]:
    """Return the deviation of the walls of local maps with headings (N,) from the axes, and its information.

    Deviations (N,) are in radians, within 45 degrees, positive for headings that are too large; their robust
    information (N,) is in 1 / rad^2 (weights of Geman and McClure). The axes are those of the local maps
    themselves.
    """
    direction = np.array([wall.direction_rad for wall in walls]) + yaw_rad
    weight = np.array([wall.concentration for wall in walls]) ** 2
    axis_rad = float(np.angle((weight * np.exp(4j * direction)).sum())) / 4.0
    for _ in range(AXES.rounds):
        deviation = _from_axis(direction, axis_rad)
        robust = weight / (1.0 + (deviation / AXES.robust_rad) ** 2) ** 2
        axis_rad += float((robust * deviation).sum() / max(robust.sum(), np.finfo(float).tiny))
    return _from_axis(direction, axis_rad), robust / AXES.sigma_rad**2


def _from_axis(direction_rad: F64, axis_rad: float) -> F64:
    """Return directions (N,) relative to the nearest axis, from -45 to 45 degrees."""
    return wrap_angle(4.0 * (direction_rad - axis_rad)) / 4.0
