"""Raw scans tell whether a relation or a trajectory is nearer to the truth."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from pc2grid.model import Scan, Trajectory
from pc2grid_lab.experiments.relation_fit import RelationFit, relation_fit
from pc2grid_lab.experiments.slam_relations import read_relations

TRUE = [SE2(0.3 * k, 0.1 * k, 0.1 * k) for k in range(6)]
SENSOR_M = (0.2, 0.05)
"""Where the laser, whose poses the relations are, sits on the base."""


def walls() -> F64:
    """Points on the walls of a room that is no rectangle, every 5 cm."""
    corners = np.array(
        [(-3.0, -2.0), (4.0, -2.0), (4.5, 3.0), (1.0, 3.5), (0.5, 2.0), (-3.0, 2.5), (-3.0, -2.0)]
    )
    sides = []
    for a, b in itertools.pairwise(corners):
        along = np.arange(0.0, np.hypot(*(b - a)), 0.05)[:, None]
        sides.append(a + along * (b - a) / np.hypot(*(b - a)))
    return np.vstack(sides)


def scans() -> list[Scan]:
    found = []
    for k, pose in enumerate(TRUE):
        points = pose.inverse().apply(walls())
        points_m = np.column_stack((points, np.zeros(len(points)))).astype(np.float32)
        found.append(Scan(stamp_ns=k * 10**9, points_m=points_m, T_base_sensor=np.eye(4), sensor="laser"))
    return found


def fit(path: Path, relation_wrong_m: float, trajectory_wrong_m: float) -> RelationFit:
    sensor = SE2(*SENSOR_M, 0.0)
    lines = []
    for k in range(5):
        relative = (TRUE[k] @ sensor).inverse() @ TRUE[k + 1] @ sensor
        lines.append(f"{k} {k + 1} {relative.x + relation_wrong_m} {relative.y} 0 0 0 {relative.yaw}")
    path.write_text("\n".join(lines))
    poses = [pose @ SE2(trajectory_wrong_m * (k % 2), 0.0, 0.0) for k, pose in enumerate(TRUE)]
    trajectory = Trajectory(
        stamps_ns=np.arange(6) * 10**9, T_session_base=np.array([pose.lift() for pose in poses])
    )
    return relation_fit(scans(), trajectory, read_relations(path), base_to_reference_m=SENSOR_M)


@pytest.mark.parametrize(("relation_m", "trajectory_m", "better"), [(0.03, 0.0, 1.0), (0.0, 0.03, 0.0)])
def test_the_scans_tell_which_of_the_two_is_wrong(
    tmp_path: Path, relation_m: float, trajectory_m: float, better: float
) -> None:
    found = fit(tmp_path / "x.relations", relation_m, trajectory_m)
    assert found.pairs == 5 and found.better == better
    wrong, right = (found.relations_m, found.trajectory_m)[:: 1 if relation_m else -1]
    assert wrong > right + 0.005
    assert right == pytest.approx(0.0, abs=1e-6)


def test_pairs_that_do_not_overlap_tell_nothing(tmp_path: Path) -> None:
    found = fit(tmp_path / "x.relations", 30.0, 0.0)
    assert found.pairs == 0 and np.isnan(found.better)
