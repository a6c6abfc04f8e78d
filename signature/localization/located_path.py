"""The path of a query, corrected by where it was located on the way."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import SE2, wrap_angle
from pc2grid.model import Health, Trajectory
from signature.localization.hypotheses import HYPOTHESES
from signature.localization.prior import PRIOR

if TYPE_CHECKING:
    from signature.localization.answer import Answer


def followed(poses: Trajectory, answer: Answer) -> Trajectory:
    """The query's poses (odometry frame of its last scan), corrected by where it was located on the way.

    Between two located moments the correction is interpolated along the travel, in position and heading of
    the base; before the first one it is that of the first. Where registration was lost the motion is not
    known, so nothing is interpolated across. A moment counts if the one before or after it agrees with it, by
    the motion between them.

    Without an answer: as they are.
    """

    if answer.T_map_odom is None:
        return poses
    planar = poses.planar()
    travel_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(planar[:, :2], axis=0).T))))
    # Scans of a standing robot get increasing values, too.
    travel_m += 1e-9 * np.arange(len(travel_m))
    health = poses.health or (Health.FINE,) * len(poses)
    part = np.cumsum([h is Health.LOST for h in health])
    at, moments = _located_moments(poses, travel_m, part, answer)
    T_odom_map = answer.T_map_odom.inverse()
    corrections = [T_odom_map @ pose @ SE2(*planar[k]).inverse() for k, pose in zip(at, moments, strict=True)]
    turns = np.unwrap([T.yaw for T in corrections])
    moved = np.array([T.apply(planar[:, :2]) for T in corrections])
    corrected = poses.T_session_base.copy()
    for number in np.unique(part):
        here = np.flatnonzero(part == number)
        own = np.flatnonzero(part[at] == number)
        if not len(own):
            own = np.abs(at - here.mean()).argmin(keepdims=True)
        # How much each of the moments counts at each of the scans: between two of them, both.
        shares = [np.interp(travel_m[here], travel_m[at[own]], one) for one in np.eye(len(own))]
        for k, share in zip(here, np.transpose(shares), strict=True):
            height_m = corrected[k, 2, 3]
            corrected[k] = SE2(0.0, 0.0, share @ turns[own]).lift() @ corrected[k]
            corrected[k, :3, 3] = *(share @ moved[own, k]), height_m
    return replace(poses, T_session_base=corrected)


def _located_moments(poses: Trajectory, travel_m: F64, part: I64, answer: Answer) -> tuple[I64, list[SE2]]:
    """The scans at which the query was located in the session of the answer, and the base in its map."""

    planar = poses.planar()
    found = [
        (int(np.searchsorted(poses.stamps_ns, moment.stamp_ns)), moment.pose)
        for moment in answer.history
        if moment.status == "located" and moment.session == answer.session and moment.pose is not None
    ]

    def agree(a: tuple[int, SE2], b: tuple[int, SE2]) -> bool:
        if part[a[0]] != part[b[0]]:
            return False
        expected = a[1] @ SE2(*planar[a[0]]).inverse() @ SE2(*planar[b[0]])
        apart_m = math.hypot(expected.x - b[1].x, expected.y - b[1].y)
        limit_m = HYPOTHESES.same_m + PRIOR.drift * (travel_m[b[0]] - travel_m[a[0]])
        return apart_m <= limit_m and abs(wrap_angle(expected.yaw - b[1].yaw)) <= HYPOTHESES.same_rad

    agrees = [agree(a, b) for a, b in itertools.pairwise(found)]
    kept = [
        here
        for here, before, after in zip(found, [False, *agrees], [*agrees, True], strict=True)
        if before or after  # the last one is the answer
    ]
    return np.array([k for k, _ in kept], np.int64), [pose for _, pose in kept]
