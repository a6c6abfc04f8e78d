"""Undoing the motion of the robot within a scan."""

from __future__ import annotations

import numpy as np
from numba import njit

from pc2grid.geometry import F64, rotation_vector
from pc2grid.model import F32

_STEPS = 128


def deskew(points_m: F32, offsets_s: F32, motion: F64, motion_s: float) -> F32:
    """Points as they would have been seen had the scan been taken at once, at its stamp.

    points_m : (N, 3) in the base frame at the time of each point. offsets_s : (N,) that time relative to
    the stamp. motion : (4, 4) T_before_now over `motion_s` seconds around the scan; its rate is taken as
    constant.
    """
    if motion_s <= 0 or not len(points_m):
        return points_m
    rate = np.concatenate((rotation_vector(motion), motion[:3, 3])) / motion_s
    first, last = float(offsets_s.min()), float(offsets_s.max())
    if last - first < 1e-6:
        first, last = first - 1e-6, last + 1e-6
    # Poses on a fine raster of times; between two of them the robot moves less than a millimetre.
    times = np.linspace(first, last, _STEPS)
    rotations, shifts = _rotations(rate[:3] * times[:, None]), rate[3:] * times[:, None]
    return _moved(points_m, offsets_s, first, (_STEPS - 1) / (last - first), rotations, shifts)


@njit(cache=True)
def _moved(points: F32, offsets: F32, first: float, per_s: float, rotations: F64, shifts: F64) -> F32:
    moved = np.empty_like(points)
    for k in range(len(points)):
        step = round((offsets[k] - first) * per_s)
        R, t = rotations[step], shifts[step]
        x, y, z = points[k]
        for axis in range(3):
            moved[k, axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z + t[axis]
    return moved


def _rotations(vectors: F64) -> F64:
    """Rodrigues' formula for (N, 3) axis times angle -> (N, 3, 3)."""
    angles = np.linalg.norm(vectors, axis=1)
    axes = vectors / np.maximum(angles, 1e-12)[:, None]
    K = np.zeros((len(vectors), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axes[:, 2], axes[:, 1], -axes[:, 0]
    K -= K.transpose(0, 2, 1)
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    rotations: F64 = np.eye(3) + sine * K + (1.0 - cosine) * (K @ K)
    return rotations
