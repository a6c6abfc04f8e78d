"""Operations on the points of a cloud: deskewing, random subsets, and a voxel filter for clouds of any
length.

`VoxelCloud` keeps the mean of the points of each voxel, so memory grows with the surfaces and not with the
number of scans. Open3D's voxel_down_sample does the same for a cloud that is in memory as a whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import LimitExceeded
from pc2grid.geometry import F32, F64, I64, rotation_vector, skew


def deskew(points_m: F32, offsets_s: F32, motion: F64, motion_s: float) -> F32:
    """Return the points as if all of them had been measured at the stamp of the scan.

    points_m : (N, 3) in the base frame at the time of each point. offsets_s : (N,) that time relative to
    the stamp. motion : (4, 4) T_before_now over `motion_s` seconds around the scan; velocity and angular
    velocity are taken as constant.
    Returns (N, 3) float32 in the base frame at the stamp.
    """
    if motion_s <= 0 or not len(points_m):
        return points_m
    turn_rad = rotation_vector(motion)
    angle_rad = float(np.linalg.norm(turn_rad))
    share = (offsets_s / np.float32(motion_s)).astype(np.float32)
    moved: F32 = points_m + share[:, None] * motion[:3, 3].astype(np.float32)
    if angle_rad < 1e-9:
        return moved
    # Rodrigues' formula about one axis: p + sin(a) k x p + (1 - cos(a)) k x (k x p), with k x p = K p.
    K = skew(turn_rad[None] / angle_rad)[0]
    angles = share * np.float32(angle_rad)
    moved += np.sin(angles)[:, None] * (points_m @ K.T.astype(np.float32))
    moved += (1.0 - np.cos(angles))[:, None] * (points_m @ (K @ K).T.astype(np.float32))
    return moved


def random_subset(length: int, count: int) -> NDArray[np.intp]:
    """Return at most `count` of the indices below `length`, random and in increasing order.

    The seed is `length`, so that equal input gives equal output. The choice is random because a regular
    one, every n-th pixel of a camera or beam of a lidar, moves with the sensor and pulls ICP towards
    standing still.
    """
    if length <= count:
        return np.arange(length)
    return np.sort(np.random.default_rng(length).choice(length, count, replace=False, shuffle=False))


AXIS_BITS = 21
HALF_VOXELS = 1 << (AXIS_BITS - 1)  # voxels on either side of the first point: 52 km with an edge of 5 cm
MAX_VOXELS = 200_000_000
"""Voxels of the largest cloud: 100,000 m2 of floor at 5 cm with what stands on it; 4 GB of memory."""


class VoxelCloud:
    """Collects points; `edge_m` is the edge of a voxel, and `corner_m` (3,) a corner of one.

    The first point lies in the middle of its voxel, so that a lattice of the same spacing keeps one point a
    voxel.

    >>> import numpy as np
    >>> cloud = VoxelCloud(0.1)
    >>> for x in (0.01, 0.03):
    ...     cloud.add(np.array([[x, 0.0, 0.0], [x + 1.0, 0.0, 0.0]]))
    >>> cloud.points_m().round(3).tolist()
    [[0.02, 0.0, 0.0], [1.02, 0.0, 0.0]]
    """

    def __init__(self, edge_m: float) -> None:
        self.edge_m = edge_m
        self.corner_m: F64 = np.zeros(3)  # of a voxel: the first point is in its middle
        # The first part has each voxel once; the others are to be merged into it.
        nothing = np.empty(0, np.int64), np.empty((0, 3), np.float32), np.empty(0, np.int32)
        self._parts: list[_Voxels] = [nothing]

    def add(self, points_m: NDArray[np.floating]) -> None:
        """Add points (N, 3), finite.

        Raises LimitExceeded if the cloud becomes too large.
        """
        if not len(points_m):
            return
        points = np.asarray(points_m, np.float64)
        if not len(self._parts[0][0]):
            self.corner_m = points[0] - 0.5 * self.edge_m
        points = points - self.corner_m
        voxel = np.floor(points / self.edge_m)
        if np.abs(voxel).max() >= HALF_VOXELS:
            raise LimitExceeded(
                f"points are more than {HALF_VOXELS * self.edge_m / 1000:.0f} km apart",
                hint="remove stray points, or use larger voxels",
            )
        index = voxel.astype(np.int64) + HALF_VOXELS
        code = (index[:, 0] << 2 * AXIS_BITS) + (index[:, 1] << AXIS_BITS) + index[:, 2]
        within = (points - voxel * self.edge_m).astype(np.float32)
        self._parts.append(_reduced(code, within, np.ones(len(code), np.int32)))
        if sum(len(part[0]) for part in self._parts[1:]) > len(self._parts[0][0]) // 2:
            self._merged()

    def __len__(self) -> int:
        """Return the number of voxels that hold points."""
        return len(self._merged()[0])

    def points_m(self) -> F64:
        """Return the mean (V, 3) of each voxel that holds points, by increasing x, then y, then z of the
        voxels.
        """
        code, sum_m, count = self._merged()
        points: F64 = sum_m / count[:, None].astype(np.float64)
        mask = (1 << AXIS_BITS) - 1
        for axis in range(3):
            index = ((code >> (2 - axis) * AXIS_BITS) & mask) - HALF_VOXELS
            points[:, axis] += index * self.edge_m + self.corner_m[axis]
        return points

    def _merged(self) -> _Voxels:
        """Return the voxels, each once."""
        if len(self._parts) > 1:
            self._parts = [_reduced(*map(np.concatenate, zip(*self._parts, strict=True)))]
        if len(self._parts[0][0]) > MAX_VOXELS:
            raise LimitExceeded(
                f"the cloud has more than {MAX_VOXELS} voxels of {self.edge_m:g} m",
                hint="is it in metres? else cut it into parts, or use larger voxels",
            )
        return self._parts[0]


_Voxels = tuple[I64, F32, NDArray[np.int32]]
"""Voxels by increasing code: (V,) the three indices in one number; (V, 3) sums of the offsets of the points
from the lowest corner of their voxel; (V,) how many points."""


def _reduced(code: I64, sum_m: F32, count: NDArray[np.int32]) -> _Voxels:
    """Add up the entries (N,), (N, 3), (N,) that have the same code."""
    order = np.argsort(code, kind="stable")
    code = code[order]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    sums, counts = (np.add.reduceat(values[order], starts, axis=0) for values in (sum_m, count))
    return code[starts], sums, counts
