"""Operations on the points of a cloud: deskewing, random subsets, and a voxel filter for clouds of any
length.

`VoxelCloud` keeps the mean of the points of each voxel, so memory grows with the surfaces and not with the
number of scans. Open3D's voxel_down_sample does the same for a cloud that is in memory as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pc2grid.errors import LimitExceeded
from pc2grid.geometry import F32, F64, I64, rotation_vector


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
    x, y, z = turn_rad / angle_rad
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
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
    """Collects points; `edge_m` is the edge of a voxel.

    The first point lies in the middle of its voxel, so that a lattice of the same spacing keeps one point a
    voxel.

    >>> import numpy as np
    >>> cloud = VoxelCloud(0.1)
    >>> for x in (0.01, 0.03):
    ...     cloud.add(np.array([[x, 0.0, 0.0], [x + 1.0, 0.0, 0.0]]))
    >>> cloud.points_m().round(3).tolist()
    [[0.02, 0.0, 0.0], [1.02, 0.0, 0.0]]
    """

    def __init__(self, edge_m: float, max_voxels: int = MAX_VOXELS) -> None:
        self.edge_m = edge_m
        self._max_voxels = max_voxels
        self._corner_m: F64 | None = None  # of a voxel with the first point in its middle
        self._merged = _Voxels()
        self._new: list[_Voxels] = []

    def add(self, points_m: NDArray[np.floating]) -> None:
        """Add points (N, 3), finite.

        Raises LimitExceeded if the cloud becomes too large.
        """
        if not len(points_m):
            return
        points = np.asarray(points_m, np.float64)
        if self._corner_m is None:
            self._corner_m = points[0] - 0.5 * self.edge_m
        points = points - self._corner_m
        voxel = np.floor(points / self.edge_m)
        if np.abs(voxel).max() >= HALF_VOXELS:
            raise LimitExceeded(
                f"points are more than {HALF_VOXELS * self.edge_m / 1000:.0f} km apart",
                hint="remove stray points, or use larger voxels",
            )
        index = voxel.astype(np.int64) + HALF_VOXELS
        code = (index[:, 0] << 2 * AXIS_BITS) + (index[:, 1] << AXIS_BITS) + index[:, 2]
        within = (points - voxel * self.edge_m).astype(np.float32)
        self._new.append(_reduced(code, within, np.ones(len(code), np.int32)))
        if sum(len(voxels.code) for voxels in self._new) > len(self._merged.code) // 2:
            self._merge()

    def __len__(self) -> int:
        """Return the number of voxels that hold points."""
        self._merge()
        return len(self._merged.code)

    @property
    def corner_m(self) -> F64:
        """Return a corner (3,) of a voxel."""
        return np.zeros(3) if self._corner_m is None else self._corner_m

    def points_m(self) -> F64:
        """Return the mean (V, 3) of each voxel that holds points, by increasing x, then y, then z of the
        voxels.
        """
        self._merge()
        if self._corner_m is None:
            return np.empty((0, 3))
        kept = self._merged
        points: F64 = kept.sum_m / kept.count[:, None].astype(np.float64)
        mask = (1 << AXIS_BITS) - 1
        for axis in range(3):
            index = ((kept.code >> (2 - axis) * AXIS_BITS) & mask) - HALF_VOXELS
            points[:, axis] += index * self.edge_m + self._corner_m[axis]
        return points

    def _merge(self) -> None:
        """Reduce each voxel to one entry."""
        if not self._new:
            return
        parts = [self._merged, *self._new]
        self._merged = _reduced(
            np.concatenate([part.code for part in parts]),
            np.concatenate([part.sum_m for part in parts]),
            np.concatenate([part.count for part in parts]),
        )
        self._new = []
        if len(self._merged.code) > self._max_voxels:
            raise LimitExceeded(
                f"the cloud has more than {self._max_voxels} voxels of {self.edge_m:g} m",
                hint="is it in metres? else cut it into parts, or use larger voxels",
            )


@dataclass(frozen=True, slots=True)
class _Voxels:
    """Voxels, each once, by increasing code.

    code : (V,) the three indices in one number. sum_m : (V, 3) sums of the points' offsets from the voxel's
    lowest corner. count : (V,) how many points.
    """

    code: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    sum_m: F32 = field(default_factory=lambda: np.empty((0, 3), np.float32))
    count: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))


def _reduced(code: I64, sum_m: F32, count: NDArray[np.int32]) -> _Voxels:
    """Add up the entries (N,), (N, 3), (N,) that have the same code."""
    order = np.argsort(code, kind="stable")
    code = code[order]
    starts = np.flatnonzero(np.diff(code, prepend=-1))
    return _Voxels(
        code[starts],
        np.add.reduceat(sum_m[order], starts, axis=0),
        np.add.reduceat(count[order], starts),
    )
