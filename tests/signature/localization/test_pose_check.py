"""A pose that the robot believes in: right, a little off, in another room, in a room that is alike."""

import functools
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pc2grid
from pc2grid.clouds.planar_scan import PlanarScan
from pc2grid.errors import ConfigError
from pc2grid.geometry import SE2
from pc2grid.io.map_pose import MapPose
from pc2grid.io.maps import load_map
from pc2grid.model import UNKNOWN, Health, OccupancyGrid, RegisteredScan
from signature.config import Config
from signature.localization.pose_check import PoseCheck, PoseWatch, check_pose
from signature.paper import SignatureTable
from signature.places.map_index import MapIndex
from tests.helpers.simulated_drives import BENT, OTHER, TWINS, building, drive, office, plan

ROOM = [(0, 0, 6, 0), (0, 6, 6, 6), (0, 0, 0, 6), (6, 0, 6, 6), *BENT]
EQUAL = plan(18, 9, [(x0 + x, y0 + 1, x1 + x, y1 + 1) for x in (1, 10) for x0, y0, x1, y1 in ROOM])
"""Two equal rooms that stand apart: (x, y) of the one is (x + 9, y) of the other."""
OFFICE, ALIKE = building({"office": office()}), building({"equal": EQUAL})
Driven = list[tuple[RegisteredScan, PlanarScan, SE2]]


@functools.cache
def in_office() -> Driven:
    return list(drive(office(), [(1.5, 7.0), (9.5, 7.0), (9.5, 4.0)]))


def check(index: MapIndex, driven: Driven, off: SE2, **about: object) -> PoseCheck:
    """The pose at the end, or at `stamp_ns`, moved by `off` in its own frame."""
    stamp_ns = about.get("stamp_ns")
    truth = next((t for r, _, t in driven if r.scan.stamp_ns == stamp_ns), driven[-1][2])
    return check_pose(((r, s) for r, s, _ in driven), index, truth @ off, **about)  # type: ignore[arg-type]


@pytest.mark.parametrize("off", [SE2(), SE2(0.15, -0.1, math.radians(4.0))])
def test_a_right_pose_is_fine(off: SE2) -> None:
    checked = check(OFFICE, in_office(), off)
    assert checked.status == "fine" and checked.probability >= 0.9 and checked.better is None
    assert checked.off_m == pytest.approx(math.hypot(off.x, off.y), abs=0.05)
    assert checked.off_rad == pytest.approx(abs(off.yaw), abs=math.radians(1.0))


@pytest.mark.parametrize(
    "off",
    [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, math.radians(20.0)), (0, 0, math.pi), (6.0, -3.0, 0)],
)
def test_a_wrong_pose_is_lost_and_the_right_one_is_told(off: tuple[float, float, float]) -> None:
    checked = check(OFFICE, in_office(), SE2(*off))
    truth = in_office()[-1][2]
    assert checked.status == "lost" and checked.probability <= 0.1
    assert checked.better is not None and checked.better.T_map_base is not None
    pose = checked.better.T_map_base
    assert math.dist((pose.x, pose.y), (truth.x, truth.y)) < 0.1


def test_of_two_rooms_that_are_alike_the_pose_says_which() -> None:
    """Nothing that the robot sees tells them apart, so neither pose is contradicted; a wrong one in either
    room is."""
    driven = list(drive(EQUAL, [(2.0, 2.0), (6.0, 2.0), (6.0, 3.4)]))
    truth = driven[-1][2]
    assert check(ALIKE, driven, SE2()).status == "fine"
    other_room = SE2(truth.x + 9.0, truth.y, truth.yaw)
    assert check(ALIKE, driven, truth.inverse() @ other_room).status == "fine"
    assert check(ALIKE, driven, SE2(0.6, 0.0, 0.0)).status == "lost"


def test_where_the_map_knows_nothing_it_is_unsure() -> None:
    cells = office().cells.copy()
    cells[:, :370] = UNKNOWN  # the robot is at x < 10 m all the time
    half = building({"half": OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))})
    checked = check(half, in_office(), SE2())
    assert checked.status == "unsure" and checked.better is None


def test_in_another_building_it_is_lost_and_no_place_is_told() -> None:
    checked = check(building({"other": OTHER}), in_office(), SE2())
    assert checked.status == "lost" and checked.better is None and checked.probability <= 0.1


def test_a_pose_of_an_earlier_time_is_moved_by_the_travel() -> None:
    driven = in_office()
    stamp_ns = driven[20][0].scan.stamp_ns
    checked = check(OFFICE, driven, SE2(), stamp_ns=stamp_ns)
    truth = driven[-1][2]
    assert checked.status == "fine" and checked.stamp_ns == driven[-1][0].scan.stamp_ns
    assert math.dist((checked.T_map_base.x, checked.T_map_base.y), (truth.x, truth.y)) < 1e-6
    assert check(OFFICE, driven, SE2(0.0, 0.7, 0.0), stamp_ns=stamp_ns).status == "lost"
    lost = [(replace(r, health=Health.LOST) if k == 25 else r, s, t) for k, (r, s, t) in enumerate(driven)]
    checked = check(OFFICE, lost, SE2(), stamp_ns=stamp_ns)
    assert checked.status == "unsure" and checked.lapsed


def test_the_session_must_be_named_where_there_are_several() -> None:
    both = building({"twins": TWINS, "office": office()})
    with pytest.raises(ConfigError, match="2 sessions"):
        check(both, in_office(), SE2())
    assert check(both, in_office(), SE2(), session="office").status == "fine"
    checked = check(both, in_office(), SE2(), session="twins")
    assert checked.status == "lost" and checked.better is not None and checked.better.session == "office"


DATA = Path(os.environ.get("PC2GRID_DATA", "../shared/data"))
T_MAP_LOG = SE2(24.77, 8.41, 0.0792)
"""From gmapping's frame into that of the nav2 map, fitted to 16 answers of the log (worst 0.07 m)."""


def real_queries() -> Iterator[tuple[Driven, SE2]]:
    """Some metres of the real log, and the true pose of the base at the end of each."""
    truth = np.loadtxt(DATA / "laser/fr079_corrected.tum")
    with pc2grid.open_log(DATA / "laser/fr079.mcap") as log:
        for start_s in (200.0, 800.0):
            driven = [(r, s, SE2()) for r, s in pc2grid.follow(log.scans(start_s, 20.0))]
            near = truth[np.argmin(np.abs(truth[:, 0] - driven[-1][0].scan.stamp_ns * 1e-9))]
            laser = SE2(near[1], near[2], 2.0 * math.atan2(near[6], near[7]))
            yield driven, T_MAP_LOG @ laser @ SE2(-0.04, 0.0, 0.0)


@pytest.mark.skipif(not (DATA / "laser/fr079.mcap").exists(), reason="no real log: set PC2GRID_DATA")
def test_a_real_log_in_the_nav2_map_of_the_floor() -> None:
    # Without places that are described (20 s): the map is searched as a whole.
    grids = {"fr079": load_map(DATA / "maps/fr079.yaml")}
    index = MapIndex(grids, grids.__getitem__, SignatureTable.of([], []), Config(), Config())
    told = []
    for driven, truth in real_queries():
        scans = [(r, s) for r, s, _ in driven]
        offs = SE2(), SE2(0.5, 0.0, 0.0), SE2(0.0, 0.0, math.radians(20.0)), SE2(9.0, 4.0, 2.0)
        told.append([check_pose(scans, index, truth @ off).status for off in offs])
    right, *wrong = zip(*told, strict=True)
    assert "lost" not in right and right.count("fine") >= 1
    assert all("fine" not in statuses for statuses in wrong)


def test_a_robot_that_stands_is_judged_once_after_each_loss() -> None:
    """Ten scans a second, the fiftieth lost: the pose is judged two seconds after the start of each part."""
    registered, planar_scan, truth = in_office()[-1]
    newest = MapPose(stamp_ns=0, T_map_base=truth)
    watch = PoseWatch(OFFICE, lambda: newest)
    judged = []
    for number in range(100):
        scan = replace(registered.scan, stamp_ns=number * 10**8)
        moved = replace(registered, scan=scan, health=Health.LOST if number == 50 else Health.FINE)
        newest = replace(newest, stamp_ns=number * 10**8)
        if watch.add(moved, planar_scan) is not None:
            judged.append(number)
    assert judged == [21, 72]
