"""Health says where the scans overruled odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pc2grid.estimation.tracker import Disagreement, Tracker, check_odometry
from pc2grid.geometry import SE2
from pc2grid.model import Health, OdometryCheck, OdometryOutlier, Scan
from pc2grid.settings import Config
from pc2grid.simulate import SimulationConfig, prepare_session

SLIGHT, LARGE, LARGER = (
    Disagreement(0.02, 0.01, False),
    Disagreement(0.3, 0.1, True),
    Disagreement(0.2, 0.7, True),
)


def test_scans_that_follow_closely_are_one_stretch() -> None:
    stamps_ns = [k * 5 * 10**8 for k in range(8)]
    found = check_odometry(stamps_ns, [None, SLIGHT, LARGE, SLIGHT, LARGER, None, None, LARGE])
    assert found == OdometryCheck(
        compared=5,
        overruled=3,
        stretches=(
            OdometryOutlier(from_ns=10**9, to_ns=2 * 10**9, distance_m=0.3, turn_rad=0.7),
            OdometryOutlier(from_ns=35 * 10**8, to_ns=35 * 10**8, distance_m=0.3, turn_rad=0.1),
        ),
    )
    assert check_odometry([], []) == OdometryCheck()


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    session = prepare_session(sensor="laser", config=SimulationConfig(length_m=6.0, seed=3, clutter=10))
    return [scan for scan, _ in session.scans()]


def checked(scans: list[Scan]) -> tuple[OdometryCheck, list[Health]]:
    tracker = Tracker(Config().registration, in_hand=False)
    tracked = [tracker.track(scan) for scan in scans]
    check = check_odometry([scan.stamp_ns for scan in scans], [t.disagreement for t in tracked])
    return check, [t.registered.health for t in tracked]


def test_odometry_that_is_merely_inexact_is_not_overruled(scans: list[Scan]) -> None:
    check, _ = checked(scans)
    assert check.compared == len(scans) - 1 and check.overruled == 0


def test_odometry_that_stalls_and_catches_up_in_one_step_is_overruled_there(scans: list[Scan]) -> None:
    """As that of a real robot did: four scans without a motion, then half a turn at once."""
    odometry = [SE2.from_matrix(scan.T_odom_base) for scan in scans if scan.T_odom_base is not None]
    size = [
        np.hypot(step.x, step.y) + abs(step.yaw)
        for a, b in zip(odometry, odometry[4:], strict=False)
        for step in [a.inverse() @ b]
    ]
    first = int(np.argmax(size)) + 1
    stalled = [
        replace(scan, T_odom_base=scans[first - 1].T_odom_base) if first <= k < first + 3 else scan
        for k, scan in enumerate(scans)
    ]
    check, health = checked(stalled)
    assert 1 <= check.overruled <= 5 and len(check.stretches) == 1
    (stretch,) = check.stretches
    assert scans[first].stamp_ns <= stretch.from_ns <= stretch.to_ns <= scans[first + 3].stamp_ns
    assert Health.LOST not in health


def test_without_odometry_there_is_nothing_to_overrule(scans: list[Scan]) -> None:
    check, _ = checked([replace(scan, T_odom_base=None) for scan in scans[:30]])
    assert check == OdometryCheck()
