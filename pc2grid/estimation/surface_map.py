"""The surfaces around a sensor in the hand, as a map of voxels, and the registration of scans to them.

The local map is a hash map of voxels. Each voxel keeps the moments of its points, so adding a scan costs one
pass over its points, and the shape of the surface in a voxel (plane, edge, neither) becomes more exact with
every scan. A scan is aligned by Gauss-Newton: the shape of its voxel constrains each point in the directions
in which the shape is thin (Biber and Strasser 2003; Koide et al., "Voxelized GICP", 2021), after KISS-ICP has
brought the scan near.

The pose comes with its information, the Hessian (6, 6) of the points, so that odometry or constant velocity
decides in the directions that the points do not fix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from pc2grid.clouds.cloud import AXIS_BITS, HALF_VOXELS, random_subset
from pc2grid.clouds.ground import SYMMETRIC
from pc2grid.estimation.line_map import MATCHING_PARAMETERS, TRACKING, moved, steps, weakest
from pc2grid.estimation.registration import KissRegistration
from pc2grid.estimation.smoother import PoseWithCovariance
from pc2grid.geometry import F32, F64, I64, skew, transform_points
from pc2grid.libraries import compiled
from pc2grid.settings import RegistrationConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceParameters:
    """Numbers of the registration in space. Chosen by hand, unless noted.

    edge_per_range, edge_m : the edge of a voxel is this times the 75th percentile of the first ranges, within
        these bounds: a room needs finer voxels than a hall.
    thinning : a scan is reduced to one point for each cube of this many edges. To test which directions are
        observable, points are displaced by as much.
    near_scale : of the Cauchy weight at the pose of KISS-ICP, in edges. aside_scale : the same of that test.
    kiss : edge of a voxel of KISS-ICP over that of this map.
    points : of a scan that are aligned, at most.
    least : least number of points of a voxel with a shape. most : a voxel with more forgets the oldest in
        proportion. Without that, e1r loses a scan.
    noise_m : a voxel constrains points in the directions in which its own have a deviation below this.
    near_sigma_m : standard deviation that one point counts with for the pose of KISS-ICP. Otherwise it is
        `MatchingParameters.cell_m`.
    rounds : scale (m) of the Cauchy weight of a distance in each iteration.
    converged : the iterations end when a step, in rad and m, is smaller.
    least_points : with less information than that of so many points along it, a direction of the position is
        not measured: uneven voxels seem to hold a floor in every direction.
    least_kept : secant over tangent of an observable direction, at least. The least of the six has a median
        of 0.4 to 0.6 in recordings of two rooms, a kitchen, an office and a hall, and of 0.15 to 0.2 in
        simulated flats in which scans slipped.
    """

    edge_per_range: float = 0.04
    edge_m: tuple[float, float] = (0.1, 0.5)
    thinning: float = 0.5
    near_scale: float = 3.0
    aside_scale: float = 1.5
    kiss: float = 2.0
    points: int = 2000
    least: float = 4.0
    most: float = 200.0
    noise_m: float = 0.02
    near_sigma_m: float = 1.0
    rounds: tuple[float, ...] = (0.3, 0.3, 0.3, 0.1, 0.1, 0.1, *(0.05,) * 8)
    converged: float = 2e-4
    least_points: float = 5.0
    least_kept: float = 0.2


SURFACES = SurfaceParameters()
LEAST_INFORMATION = 1e-3 * np.eye(6)
"""(6, 6) added so that a direction that nothing holds can be solved for: of a standard deviation of 30 m and
30 rad, farther than any match is moved. One point has 1e5 times as much."""


class VoxelShapes:
    """A map of voxels with the shape of the surface in each. edge_m : of a voxel."""

    def __init__(self, edge_m: float) -> None:
        self.edge_m = edge_m
        self._rows = _rows(0)
        self._used = 0  # rows in use
        self._slots: NDArray[np.int32] = np.full(1 << 15, -1, np.int32)
        self._entered = 0  # rows that the slots hold

    def __len__(self) -> int:
        """Return the number of voxels in use."""
        return self._used

    @property
    def shapes(self) -> F64:
        """Return (V, 9): mean of the points, m, and the upper triangle of their information, 0..1."""
        return self._rows[2][: self._used]

    def add(self, points_m: F64) -> None:
        """Add points (N, 3), in the frame of the map, and fit the shapes of their voxels.

        A shape is zero where there are too few points. Its information is the constraint of a point in each
        direction, 0..1: s^2 / (v + s^2) for a variance v of the points along it and a noise s, less that of
        the widest direction. So a plane constrains along its normal, an edge across its line, and a ball not
        at all.
        """
        rows, (codes, moments, shapes) = np.unique(self.enter(points_m)), self._rows
        code, count = codes[rows, None] >> np.array([2 * AXIS_BITS, AXIS_BITS, 0]), moments[rows, :1]
        mean = moments[rows, 1:4] / count
        shapes[rows, :3] = mean + ((code & (2 * HALF_VOXELS - 1)) - HALF_VOXELS) * self.edge_m
        shapes[rows, 3:] = 0.0
        some = count[:, 0] >= SURFACES.least
        C = (moments[rows[some], 4:][:, SYMMETRIC] / count[some]).reshape(-1, 3, 3)
        variances, axes = np.linalg.eigh(C - mean[some, :, None] * mean[some, None])
        held = SURFACES.noise_m**2 / (np.maximum(variances, 0.0) + SURFACES.noise_m**2)
        information = (axes * (held - held[:, 2:])[:, None]) @ axes.swapaxes(1, 2)
        shapes[rows[some], 3:] = information.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]

    def enter(self, points_m: F64) -> I64:
        """Add points (N, 3) to the moments alone; return the row (N,) of the voxel of each."""
        need = self._used + len(points_m)
        if need > len(self._rows[0]):
            before, self._rows = self._rows, _rows(max(2 * len(self._rows[0]), need, 1 << 13))
            for rows, more in zip(before, self._rows, strict=True):
                more[: self._used] = rows[: self._used]
        size = 1 << (3 * need).bit_length()
        if len(self._slots) < size:
            self._slots, self._entered = np.full(size, -1, np.int32), 0
        touched = np.empty(len(points_m), np.int64)
        self._used = self._entered = add(
            self._slots, *self._rows[:2], self._entered, self._used, points_m, self.edge_m, SURFACES.most,
            touched,
        )  # fmt: skip
        return touched

    def forget_beyond(self, center_m: F64, reach_m: float) -> None:
        """Forget the voxels farther than `reach_m` from a place (3,)."""
        away = self.shapes[:, :3] - center_m
        kept = np.flatnonzero(np.einsum("ij,ij->i", away, away) < reach_m**2)
        for rows in self._rows:
            rows[: len(kept)] = rows[kept]
        self._used = len(kept)
        self._slots[:], self._entered = -1, 0
        self.enter(np.empty((0, 3)))

    def equations(self, points_m: F64, weights: F64, pose: F64, scale_m: float) -> tuple[F64, F64, float]:
        """Linearise the distances of points (N, 3) in a change of their pose (4, 4), in its own axes.

        Returns H (6, 6) and g (6,) of the step H d = -g, and the number of points with a shape.
        """
        H, g, J, room = np.zeros((6, 6)), np.zeros(6), np.eye(3, 6), np.empty((3, 8))
        codes, _, shapes = self._rows
        found = normal_equations(
            self._slots, codes, shapes, points_m, weights,
            np.ascontiguousarray(pose),  # or the kernel is compiled twice
            self.edge_m, scale_m, H, g, J, room,
        )  # fmt: skip
        H = H + np.triu(H, 1).T
        R = np.zeros((6, 6))
        R[:3, :3] = R[3:, 3:] = pose[:3, :3]
        return R.T @ H @ R, R.T @ g, found


def _rows(count: int) -> tuple[I64, F64, F64]:
    """Return so many rows of voxels: codes (V,), see `add`; moments (V, 10); and shapes (V, 9), the mean of
    the points and the upper triangle of their information.
    """
    # What is not written takes no memory: a scan is thinned by rows most of which stay unused.
    return np.empty(count, np.int64), np.empty((count, 10)), np.empty((count, 9))


class SurfaceMap:
    """The surfaces within `reach_m` of a sensor in the hand."""

    def __init__(
        self,
        edge_m: float,
        reach_m: float,
        registration: RegistrationConfig,
    ) -> None:
        self._reach_m = reach_m
        self._cleared_at: F64 | None = None
        self.fine = VoxelShapes(edge_m)
        self._kiss = KissRegistration(registration, SURFACES.kiss * edge_m, reach_m)

    def __bool__(self) -> bool:
        return len(self.fine) > 0

    def thinned(self, points_m: F32) -> F64:
        """Downsample the points (N, 3) of a scan to about one for each half voxel."""
        points = points_m.astype(np.float64)
        rows = VoxelShapes(SURFACES.thinning * self.fine.edge_m).enter(points)
        # The rows are numbered by the first of their points.
        return points[np.diff(np.maximum.accumulate(rows), prepend=-1) > 0]

    def alone(self, points_m: F64) -> F64:
        """Return the shapes (V, 9) of the surfaces in points (N, 3) alone."""
        view = VoxelShapes(self.fine.edge_m)
        view.add(points_m)
        return view.shapes

    def add(self, points_m: F64, pose: F64) -> None:
        """Add thinned points (N, 3) at their pose (4, 4); voxels that are far by now are forgotten."""
        here = pose[:3, 3]
        self.fine.add(transform_points(pose, points_m))
        self._kiss.add(points_m, pose)
        if self._cleared_at is None:
            self._cleared_at = here
        elif np.linalg.norm(here - self._cleared_at) > 0.25 * self._reach_m:
            self._cleared_at = here
            self.fine.forget_beyond(here, 1.25 * self._reach_m)

    def match(
        self, points_m: F64, weights: F64, guess: F64, prior: PoseWithCovariance
    ) -> tuple[F64, F64, float, bool]:
        """Register thinned points (N, 3), base frame, from a guess (4, 4), with a prior.

        weights : (N,) of the points, 0..1, by their noise.

        Returns the pose (4, 4); the information (6, 6), from the points alone, of a change of it as in
        `pc2grid.estimation.line_map`; the share of the points that meet a surface of the map; and True if
        they fix every direction of the position.
        """
        p, chosen = SURFACES, random_subset(len(points_m), SURFACES.points)
        points_m, weights = points_m[chosen], weights[chosen]
        unit = MATCHING_PARAMETERS.cell_m**-2
        pose, information, found = guess, np.zeros((6, 6)), 0.0
        for scale_m in p.rounds:
            H, g, found = self.fine.equations(points_m, weights, pose, scale_m)
            information = unit * H
            step = _step(pose, information, unit * g, prior)
            pose = moved(pose[None], step[None])[0]
            if scale_m == p.rounds[-1] and np.abs(step).sum() < p.converged:
                break
        measured = weakest(information) > p.least_points * unit
        return pose, information, found / max(len(points_m), 1), measured

    def near(self, points_m: F64, weights: F64, guess: F64, prior: PoseWithCovariance) -> F64:
        """Register thinned points (N, 3) by KISS-ICP from a guess (4, 4), and weigh the pose against a prior.

        The weight is the information of the surfaces there: KISS-ICP slides in the directions that they leave
        free.
        """
        p, registered = SURFACES, self._kiss.register(points_m, guess)
        few = random_subset(len(points_m), TRACKING.matched)
        H = self.fine.equations(points_m[few], weights[few], registered, p.near_scale * self.fine.edge_m)[0]
        step = _step(registered, H / p.near_sigma_m**2, np.zeros(6), prior)
        near: F64 = moved(registered[None], step[None])[0]
        return near

    def observable(self, points_m: F64, weights: F64, pose: F64) -> F64:
        """Return the projection (6, 6) of changes of a pose (4, 4) of thinned points (N, 3) onto those that
        the surfaces really constrain; the identity if these are all.

        On surfaces that noise has made uneven, points find a neighbour anywhere, and the tangent of their
        distances suggests a constraint. Half a voxel aside no gradient draws them back: the secant of the
        gradients there is small beside the tangent. Both are compared along the six principal changes of the
        pose, in metres of displacement of the points.
        """
        p = SURFACES
        few = random_subset(len(points_m), TRACKING.matched)
        points, own, aside_m = points_m[few], weights[few], p.thinning * self.fine.edge_m

        def at(step: F64) -> tuple[F64, F64]:
            """Return the Hessian (6, 6) and gradient (6,) after a change (6,) of the pose."""
            there = moved(pose[None], step[None])[0]
            return self.fine.equations(points, own, there, p.aside_scale * self.fine.edge_m)[:2]

        # Mean square (6, 6) of the displacement of the points by changes of the base, m2.
        displaced = np.zeros((len(points), 3, 6))
        displaced[:, :, :3], displaced[:, :, 3:] = np.eye(3), skew(points).swapaxes(1, 2)
        displacement = np.einsum("nai,naj->ij", displaced, displaced) / len(points) + 1e-9 * np.eye(6)
        tangents, changes = eigh(at(np.zeros(6))[0], displacement)
        secants = [
            change @ (at(aside_m * change)[1] - at(-aside_m * change)[1]) / (2.0 * aside_m)
            for change in changes.T
        ]
        unconstrained = changes[:, secants < p.least_kept * tangents]
        kept: F64 = np.eye(6) - unconstrained @ unconstrained.T @ displacement
        return kept


def _step(pose: F64, information: F64, gradient: F64, prior: PoseWithCovariance) -> F64:
    """Return the Gauss-Newton step (6,) from a pose (4, 4), given measurements there and a prior."""
    away, _, J = (of_prior[0] for of_prior in steps(prior.pose[None], pose[None]))
    step: F64 = -np.linalg.solve(
        information + J.T @ prior.information @ J + LEAST_INFORMATION,
        gradient + J.T @ prior.information @ away,
    )
    return step


@compiled(inline="always")
def _slot(slots: NDArray[np.int32], codes: I64, code: int) -> int:
    """Return the slot of the row of a code, or the slot where it belongs."""
    mask = len(slots) - 1
    mixed = np.uint64(code) * np.uint64(0x9E3779B97F4A7C15)
    slot = int(np.int64(mixed >> np.uint64(20)) & mask)
    while slots[slot] >= 0 and codes[slots[slot]] != code:
        slot = (slot + 1) & mask
    return slot


@compiled()
def add(
    slots: NDArray[np.int32],
    codes: I64,
    moments: F64,
    entered: int,
    used: int,
    points: F64,
    edge: float,
    most: float,
    touched: I64,
) -> int:
    """Add points (N, 3) to the moments (V, 10) of their voxels: number, sums and second moments.

    A code is the three indices of a voxel, each within a million of zero, as one number. Rows from `entered`
    to before `used` are entered into the slots first. Coordinates are relative to the corner of the voxel. A
    voxel with more than `most` points forgets old ones in proportion. `touched` (N,) gets the row of each
    point. Returns the number of rows in use.
    """
    for row in range(entered, used):
        slots[_slot(slots, codes, codes[row])] = row
    for n in range(len(points)):
        i = math.floor(points[n, 0] / edge)
        j = math.floor(points[n, 1] / edge)
        k = math.floor(points[n, 2] / edge)
        code = ((i + HALF_VOXELS) << (2 * AXIS_BITS)) | ((j + HALF_VOXELS) << AXIS_BITS) | (k + HALF_VOXELS)
        slot = _slot(slots, codes, code)
        row = slots[slot]
        if row < 0:
            row = used
            used += 1
            slots[slot] = row
            codes[row] = code
            moments[row] = 0.0
        m = moments[row]
        if m[0] >= most:
            m *= (most - 1.0) / m[0]
        powers = 1.0, points[n, 0] - i * edge, points[n, 1] - j * edge, points[n, 2] - k * edge
        place = 0
        for a in range(4):
            for b in range(a, 4):
                m[place] += powers[a] * powers[b]
                place += 1
        touched[n] = row
    return used


_ROW = 3 + SYMMETRIC.reshape(3, 3)
"""Columns of a shape that hold its information, as a symmetric matrix."""


@compiled()
def normal_equations(
    slots: NDArray[np.int32],
    codes: I64,
    shapes: F64,
    points: F64,
    weights: F64,
    pose: F64,
    edge: float,
    scale: float,
    H: F64,
    g: F64,
    J: F64,
    room: F64,
) -> float:
    """Linearise the distances of points (N, 3) from the shapes (V, 9) of the voxels around them.

    pose : (4, 4). A point meets the shape whose mean is nearest, of its own voxel and the 26 around it. scale
    : of the Cauchy weight of a distance. weights : (N,) inverse variances of the points, relative. The
    unknowns are the shift and the rotation vector of the placed points about the origin of the base.

    Adds to the upper triangle of H (6, 6) and to g (6,), and returns the number of points with a shape. J :
    (3, 6), the identity and zeros; it and `room` (3, 8) are written to.
    """
    found = 0.0
    for n in range(len(points)):
        px, py, pz = points[n, 0], points[n, 1], points[n, 2]
        rx = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz
        ry = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz
        rz = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
        x, y, z = rx + pose[0, 3], ry + pose[1, 3], rz + pose[2, 3]
        i, j, k = math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)
        code = ((i + HALF_VOXELS) << (2 * AXIS_BITS)) | ((j + HALF_VOXELS) << AXIS_BITS) | (k + HALF_VOXELS)
        best, best_row = 2.25 * edge * edge, -1
        # The own voxel first: no mean in a voxel around it is nearer than that voxel is.
        low_x, low_y, low_z = x - i * edge, y - j * edge, z - k * edge
        for a in (0, -1, 1):
            off_x = 0.0 if a == 0 else low_x if a < 0 else edge - low_x
            for b in (0, -1, 1):
                off_y = 0.0 if b == 0 else low_y if b < 0 else edge - low_y
                for c in (0, -1, 1):
                    off_z = 0.0 if c == 0 else low_z if c < 0 else edge - low_z
                    if off_x * off_x + off_y * off_y + off_z * off_z >= best:
                        continue
                    row = slots[_slot(slots, codes, code + (a << (2 * AXIS_BITS)) + (b << AXIS_BITS) + c)]
                    if row < 0 or shapes[row, 3] + shapes[row, 6] + shapes[row, 8] <= 0.0:
                        continue
                    dx, dy, dz = x - shapes[row, 0], y - shapes[row, 1], z - shapes[row, 2]
                    apart = dx * dx + dy * dy + dz * dz
                    if apart < best:
                        best, best_row = apart, row
        if best_row < 0:
            continue
        room[0, 7], room[1, 7], room[2, 7] = (
            x - shapes[best_row, 0],
            y - shapes[best_row, 1],
            z - shapes[best_row, 2],
        )
        J[0, 4], J[0, 5] = rz, -ry
        J[1, 3], J[1, 5] = -rz, rx
        J[2, 3], J[2, 4] = ry, -rx
        squared = 0.0
        for a in range(3):
            p, q, r = shapes[best_row, _ROW[a, 0]], shapes[best_row, _ROW[a, 1]], shapes[best_row, _ROW[a, 2]]
            for b in range(6):
                room[a, b] = p * J[0, b] + q * J[1, b] + r * J[2, b]
            room[a, 6] = p * room[0, 7] + q * room[1, 7] + r * room[2, 7]
            squared += room[a, 7] * room[a, 6]
        weight = weights[n] / (1.0 + squared / (scale * scale))
        for a in range(3):
            for b in range(7):
                room[a, b] *= weight
        for a in range(6):
            g[a] += J[0, a] * room[0, 6] + J[1, a] * room[1, 6] + J[2, a] * room[2, 6]
            for b in range(a, 6):
                H[a, b] += J[0, a] * room[0, b] + J[1, a] * room[1, b] + J[2, a] * room[2, b]
        found += 1.0
    return found
