"""The absolute error of a trajectory (ATE).

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (2012); computed as evo does, with
alignment and without scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pc2grid.model import Health, Trajectory
from pc2grid_lab.experiments.frames import pose_at

MAX_GAP_S = 1.0
"""The truth is interpolated between two poses that differ by no more than this in time; chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryError:
    """The errors of a trajectory; poses of lost scans are left out.

    ate_m : RMS distance from the truth after the best rigid alignment. poses : how many were compared.
    """

    ate_m: float
    poses: int


def trajectory_error(estimated: Trajectory, truth: Trajectory) -> TrajectoryError | None:
    """The error of a trajectory with respect to the truth, which is interpolated at its stamps.

    None if fewer than three poses have a true pose.
    """
    found = [
        (estimated.T_session_base[k, :3, 3], true[:3, 3])
        for k, stamp_ns in enumerate(estimated.stamps_ns.tolist())
        if not (estimated.health and estimated.health[k] is Health.LOST)
        and (true := pose_at(truth, stamp_ns, same_ns=0.0, gap_ns=MAX_GAP_S * 1e9)) is not None
    ]
    if len(found) < 3:
        return None
    a, b = (points - points.mean(axis=0) for points in np.swapaxes(found, 0, 1))
    # The rotation nearest to the covariance of the two (Umeyama 1991).
    U, _, Vt = np.linalg.svd(np.einsum("ni,nj->ij", b, a))
    R = U @ np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt)))) @ Vt
    apart_m = np.linalg.norm(a @ R.T - b, axis=1)
    return TrajectoryError(ate_m=float(np.sqrt(np.mean(apart_m**2))), poses=len(found))
