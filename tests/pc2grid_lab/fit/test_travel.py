"""A robot asked along its way, and its answers judged by those from other starts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pc2grid.geometry import SE2
from pc2grid.model import Trajectory
from pc2grid_lab.experiments.recordings.run import RecordedDrive
from pc2grid_lab.fit import travel
from signature.localization.localizer import Localizer
from tests.helpers.simulated_drives import building, drive, office


def test_a_robot_is_asked_when_it_has_come_so_far() -> None:
    scans = [(registered, scan) for registered, scan, _ in drive(office(), [(1.5, 7.0), (6.5, 7.0)])]
    rows = list(travel.asked(2, Localizer(building({"map": office()})), scans))
    assert [(row.start, row.travel_m) for row in rows] == [(2, 0.0), (2, 3.0)]
    assert rows[0].answer.path_m < 1.0 and 3.0 <= rows[1].answer.path_m < 3.5
    assert rows[1].answer.status == "located" and rows[1].best[0] == "map"

    # Of five starts, one says another transform than the others; and one alone is not judged.
    poses = np.array([SE2(4.0 * k, 0.0, 0.3 * k).lift() for k in range(5)])
    stamps_ns = np.arange(5, dtype=np.int64) * 10**9
    own = RecordedDrive((Trajectory(stamps_ns=stamps_ns, T_session_base=poses),), None)
    said = [SE2(1.0, 2.0, 0.5) @ SE2.from_matrix(pose) for pose in poses]
    said[3] = said[3] @ SE2(2.0, 0.0, 0.0)
    found = []
    for start, pose in enumerate(said):
        h = rows[1].answer.hypotheses[0]
        fit = replace(h.fit, T_map_query=pose @ rows[1].answer.T_odom_base.inverse())
        answer = replace(rows[1].answer, stamp_ns=start * 10**9, hypotheses=(replace(h, fit=fit),))
        found.append(replace(rows[1], start=start, answer=answer))
    assert travel.right(own, found) == [True, True, True, False, True]
    assert travel.right(own, found[:1]) == [False]


def test_robots_begin_where_they_can_drive_far_enough() -> None:
    way = SimpleNamespace(path_m=lambda: np.arange(101.0), stamps_ns=np.arange(101) * 10**9)
    assert travel.starts_s(cast(Trajectory, way), 10.0, 3) == pytest.approx([10.0, 35.0, 60.0])
