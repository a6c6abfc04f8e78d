"""The error of a trajectory: absolute (ATE) and over a metre of travel (RPE).

Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems" (2012); computed as evo does, with
alignment and without scale.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import interpolate_pose
from pc2grid.model import Health, Trajectory

_TURNS = 100
"""Turns of the fit of a lever; the change of the last ones is below a micrometre. Measured."""
MAX_GAP_S = 1.0
"""The truth is interpolated between two poses that differ by no more than this in time; chosen by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryError:
    """The errors of a trajectory; poses of lost scans are left out.

    ate_m : RMS distance from the truth after the best rigid alignment. rpe_m, rpe_deg : RMS error of the
    motion over a metre of travel, NaN if the path is shorter. poses : how many were compared.
    """

    ate_m: float
    rpe_m: float
    rpe_deg: float
    poses: int


def trajectory_error(estimated: Trajectory, truth: Trajectory) -> TrajectoryError:
    """The error of a trajectory with respect to the truth, which is interpolated at its stamps.

    The two may name the axes of the base differently (for example a camera's optical frame). Therefore one
    constant rotation is fitted and removed from the errors of motion, as the alignment removes one from the
    positions. Raises ValueError if fewer than three poses have a true pose.
    """
    index, true = _truth_at(estimated, truth)
    if len(index) < 3:
        raise ValueError("fewer than three poses of the trajectory have a truth in time")
    guess = estimated.T_session_base[index]
    a, b = guess[:, :3, 3], true[:, :3, 3]
    R = _rotation(np.einsum("ni,nj->ij", b - b.mean(axis=0), a - a.mean(axis=0)))
    apart = np.linalg.norm((a - a.mean(axis=0)) @ R.T - (b - b.mean(axis=0)), axis=1)
    axes = _rotation(np.einsum("nji,jk,nkl->il", guess[:, :3, :3], R.T, true[:, :3, :3]))
    turned = guess.copy()
    turned[:, :3, :3] = guess[:, :3, :3] @ axes
    first, second = _metre_apart(true[:, :3, 3])
    rpe_m = rpe_deg = math.nan
    if len(first):
        error = np.linalg.inv(_motion(true, first, second)) @ _motion(turned, first, second)
        cosine = (np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2
        rpe_m = _rms(np.linalg.norm(error[:, :3, 3], axis=1))
        rpe_deg = _rms(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return TrajectoryError(ate_m=_rms(apart), rpe_m=rpe_m, rpe_deg=rpe_deg, poses=len(index))


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


def error_with_lever(estimated: Trajectory, truth: Trajectory) -> tuple[float, F64]:
    """ATE where the two are of different points of one body, metres, and the lever (3,) from the estimated to
    the true one, in the axes of the estimated base.

    The lever is fitted together with the alignment, by turns; a direction about which the body does not turn
    is not determined, and the lever is the shortest one. Raises ValueError as `trajectory_error` does.
    """
    index, true = _truth_at(estimated, truth)
    if len(index) < 3:
        raise ValueError("fewer than three poses of the trajectory have a truth in time")
    guess, b = estimated.T_session_base[index], true[:, :3, 3] - true[:, :3, 3].mean(axis=0)
    turns, at = (part - part.mean(axis=0) for part in (guess[:, :3, :3], guess[:, :3, 3]))
    lever = np.zeros(3)
    for _ in range(_TURNS):
        a = at + turns @ lever
        R = _rotation(np.einsum("ni,nj->ij", b, a))
        lever = np.linalg.lstsq(turns.reshape(-1, 3), (b @ R - at).reshape(-1), rcond=1e-6)[0]
    return _rms(np.linalg.norm((at + turns @ lever) @ R.T - b, axis=1)), lever


def _rotation(covariance: F64) -> F64:
    """The rotation (3, 3) nearest to a covariance of target and source (Umeyama 1991)."""
    U, _, Vt = np.linalg.svd(covariance)
    sign = np.diag((1.0, 1.0, np.sign(np.linalg.det(U @ Vt))))
    nearest: F64 = U @ sign @ Vt
    return nearest


def _metre_apart(positions: F64) -> tuple[I64, I64]:
    """Pairs of indices: each position, and the first one a metre of travel later."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    driven = np.concatenate(([0.0], np.cumsum(steps)))
    second = np.searchsorted(driven, driven + 1.0)
    first = np.flatnonzero(second < len(driven))
    return first, second[first]


def _motion(poses: F64, first: I64, second: I64) -> F64:
    moved: F64 = np.linalg.inv(poses[first]) @ poses[second]
    return moved


def _rms(values: F64) -> float:
    return float(np.sqrt(np.mean(values**2)))
