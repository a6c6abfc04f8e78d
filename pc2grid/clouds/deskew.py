"""Removal of the robot's motion from the points of one scan."""

from __future__ import annotations

import numpy as np

from pc2grid.arrays import F32, F64
from pc2grid.geometry import rotation_vector


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
