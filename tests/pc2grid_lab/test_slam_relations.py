"""The SLAM benchmark's measure, on a hand-made graph."""

import numpy as np
import pytest

from pc2grid.errors import TrajectoryFileError
from pc2grid.geometry import SE2
from pc2grid.model import Trajectory
from pc2grid_lab.truth import read_relations, relation_error


def trajectory(poses):
    stamps = np.arange(len(poses)) * 1_000_000_000
    return Trajectory(stamps_ns=stamps, T_session_base=np.array([SE2(*p).lift() for p in poses]))


def relations(tmp_path, lines):
    path = tmp_path / "x.relations"
    path.write_text("\n".join(lines) + "\n")
    return read_relations(path)


def test_exact_trajectory_anywhere_has_no_error(tmp_path):
    truth = relations(tmp_path, ["0 1 1 0 0 0 0 1.570796327", "1 2 1 0 0 0 0 0"])
    moved = SE2(5, -3, 1.0)
    poses = [moved @ p for p in (SE2(), SE2(1, 0, np.pi / 2), SE2(1, 1, np.pi / 2))]
    error = relation_error(trajectory([(p.x, p.y, p.yaw) for p in poses]), truth)
    assert error.translation_m == pytest.approx(0, abs=1e-8) and error.rotation_deg == pytest.approx(
        0, abs=1e-6
    )
    assert (error.used, error.total) == (2, 2)


def test_mean_by_hand(tmp_path):
    truth = relations(tmp_path, ["0 1 1 0 0 0 0 0", "1 2 1 0 0 0 0 0", "0 7 1 0 0 0 0 0"])
    error = relation_error(trajectory([(0, 0, 0), (1.3, 0.4, 0), (2.3, 0.4, np.radians(2))]), truth)
    assert error.translation_m == pytest.approx(0.25)
    assert error.rotation_deg == pytest.approx(1.0)
    assert (error.used, error.total) == (2, 3)


def test_relations_may_describe_the_laser_instead_of_the_base(tmp_path):
    truth = relations(tmp_path, ["0 1 -0.2 0 0 0 0 3.141592654"])
    turned = trajectory([(0, 0, 0), (-0.4, 0, np.pi)])
    assert relation_error(turned, truth).translation_m == pytest.approx(0.2)
    assert relation_error(turned, truth, base_to_reference_m=(-0.1, 0.0)).translation_m == pytest.approx(
        0, abs=1e-8
    )


def test_a_malformed_line_is_named(tmp_path):
    with pytest.raises(TrajectoryFileError, match="line 2"):
        relations(tmp_path, ["0 1 1 0 0 0 0 0", "0 1 2"])
