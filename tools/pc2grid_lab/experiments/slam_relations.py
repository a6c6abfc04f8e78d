"""The SLAM benchmark's measure of a trajectory, which needs neither a map nor a reference frame.

Kuemmerle et al., "On measuring the accuracy of SLAM algorithms" (2009), section III: the relative poses
of a trajectory between chosen pairs of times are compared with relative poses that people have verified.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import wrap_angle
from pc2grid.model import Trajectory
from pc2grid_lab.experiments.frames import nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class Relations:
    """R verified relative poses.

    first_ns, second_ns : (R,) int64, the two times of each relation. T_first_second : (R, 3) x, y, yaw.
    """

    first_ns: I64
    second_ns: I64
    T_first_second: F64


@dataclass(frozen=True, slots=True, kw_only=True)
class RelationError:
    """Mean absolute errors over the relations, metres and degrees; NaN without any.

    used : number of relations, of `total`, for which the trajectory has poses at both times.
    """

    translation_m: float
    rotation_deg: float
    used: int
    total: int


def read_relations(path: Path) -> Relations:
    """Read a `*.relations` file: `t1 t2 x y z roll pitch yaw` in each line, in seconds, metres, radians.

    Raises TrajectoryFileError if a line has another form.
    """
    firsts, seconds, poses = [], [], []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            t1, t2, x, y, _, _, _, yaw = (float(word) for word in line.split())
        except ValueError:
            raise TrajectoryFileError(
                f"{path}, line {number}: expected 't1 t2 x y z roll pitch yaw'"
            ) from None
        firsts.append(round(t1 * 1e9))
        seconds.append(round(t2 * 1e9))
        poses.append((x, y, yaw))
    return Relations(
        first_ns=np.array(firsts, dtype=np.int64),
        second_ns=np.array(seconds, dtype=np.int64),
        T_first_second=np.array(poses, dtype=np.float64).reshape(-1, 3),
    )


def relation_error(
    trajectory: Trajectory,
    relations: Relations,
    *,
    base_to_reference_m: tuple[float, float] = (0.0, 0.0),
) -> RelationError:
    """The errors of a trajectory with respect to the relations.

    base_to_reference_m : position on the base of the point that the relations describe (the benchmark's poses
        are those of the laser, not of the base).

    A relation is left out if there is no pose at one of its times.
    """
    poses = trajectory.planar()
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    dx, dy = base_to_reference_m
    poses[:, 0] += c * dx - s * dy
    poses[:, 1] += s * dx + c * dy
    i, j = (
        nearest(trajectory.stamps_ns, wanted_ns) for wanted_ns in (relations.first_ns, relations.second_ns)
    )
    used = (i >= 0) & (j >= 0)
    error = _relative(relations.T_first_second[used], _relative(poses[i[used]], poses[j[used]]))
    off_m, off_deg = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(wrap_angle(error[:, 2])))
    return RelationError(
        translation_m=float(off_m.mean()) if len(error) else math.nan,
        rotation_deg=float(off_deg.mean()) if len(error) else math.nan,
        used=len(error),
        total=len(used),
    )


def _relative(a: F64, b: F64) -> F64:
    """T_a_b (N, 3) of poses (N, 3) in one frame."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack((c * dx + s * dy, -s * dx + c * dy, b[:, 2] - a[:, 2]))
