"""The absolute error of a trajectory (ATE).

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (2012); computed as evo does, with
alignment and without scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import interpolate_pose
from pc2grid.model import Health, Trajectory

MAX_GAP_S = 1.0
"""The truth is interpolated between two poses that differ by no more than this in time; chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryError:
    """The errors of a trajectory; poses of lost scans are left out.

    ate_m : RMS distance from the truth after the best rigid alignment. poses : how many were compared.
    """

    ate_m: float
    poses: int


def trajectory_error(estimated: Trajectory, truth: Trajectory) -> TrajectoryError:
    """The error of a trajectory with respect to the truth, which is interpolated at its stamps.

    Raises ValueError if fewer than three poses have a true pose.
    """
    index, true = _truth_at(estimated, truth)
    if len(index) < 3:
        raise ValueError("fewer than three poses of the trajectory have a truth in time")
    a, b = estimated.T_session_base[index, :3, 3], true[:, :3, 3]
    R = _rotation(np.einsum("ni,nj->ij", b - b.mean(axis=0), a - a.mean(axis=0)))
    apart = np.linalg.norm((a - a.mean(axis=0)) @ R.T - (b - b.mean(axis=0)), axis=1)
    return TrajectoryError(ate_m=_rms(apart), poses=len(index))


def _truth_at(estimated: Trajectory, truth: Trajectory) -> tuple[I64, F64]:
    """Indices (N,) of the poses that are not lost and have a true pose, and the true poses (N, 4, 4)."""
    index, poses = [], []
    for k, stamp in enumerate(estimated.stamps_ns):
        if estimated.health and estimated.health[k] is Health.LOST:
            continue
        after = int(np.searchsorted(truth.stamps_ns, stamp))
        if after < len(truth) and truth.stamps_ns[after] == stamp:
            index.append(k)
            poses.append(truth.T_session_base[after])
        elif 0 < after < len(truth):
            span = int(truth.stamps_ns[after] - truth.stamps_ns[after - 1])
            if span <= MAX_GAP_S * 1e9:
                part = int(stamp - truth.stamps_ns[after - 1]) / span
                index.append(k)
                poses.append(
                    interpolate_pose(truth.T_session_base[after - 1], truth.T_session_base[after], part)
                )
    return np.array(index, np.int64), np.array(poses).reshape(-1, 4, 4)


def _rotation(covariance: F64) -> F64:
    """The rotation (3, 3) nearest to a covariance of target and source (Umeyama 1991)."""
    U, _, Vt = np.linalg.svd(covariance)
    sign = np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt))))
    nearest: F64 = U @ sign @ Vt
    return nearest


def _rms(values: F64) -> float:
    return float(np.sqrt(np.mean(values**2)))
