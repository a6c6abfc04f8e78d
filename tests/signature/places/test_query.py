"""What a query keeps of what it has seen, and where it is described."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pc2grid.errors import NoScans
from pc2grid.geometry import SE2
from pc2grid.model import UNKNOWN, Health, OccupancyGrid
from signature.localization.localizer import locate_map
from signature.places.query import Query
from tests.helpers.simulated_drives import OTHER, RESOLUTION_M, building, cut, drive, office

OFFICE = building({"office": office()})


def test_views_lie_apart_and_on_what_was_seen() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)], field_rad=math.radians(90.0)):
        seen.add(registered, planar_scan)
    query = seen.map()
    centers = np.array([v.center_m for v in query.views])
    apart = np.hypot(*(centers[:, None] - centers[None]).transpose(2, 0, 1))
    assert 2 <= len(centers) <= OFFICE.config.views
    assert apart[~np.eye(len(centers), dtype=bool)].min() >= OFFICE.config.view_spacing_m
    cells = query.grid.to_cell(centers)
    assert (query.grid.cells[cells[:, 0], cells[:, 1]] >= 0).all()


def test_a_window_forgets_what_lies_farther_back() -> None:
    config = OFFICE.config.model_copy(update={"window_m": 3.0})
    long, short = (Query(OFFICE.made_with, OFFICE.config), Query(OFFICE.made_with, config))
    for registered, planar_scan, _ in drive(office(), [(1.5, 7.0), (9.5, 7.0)]):
        for seen in (long, short):
            seen.add(registered, planar_scan)
    assert long.path_m == pytest.approx(short.path_m) == pytest.approx(7.8, abs=0.3)
    assert len(short.map().keyframes) < 20 < len(long.map().keyframes)


def test_the_scans_since_a_slip_know_the_pose_of_a_later_time() -> None:
    scans = list(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for number, kept in ((-4, True), (4, False)):
        seen = Query(OFFICE.made_with, OFFICE.config, prior_ns=scans[number][0].scan.stamp_ns)
        for registered, planar_scan, _ in scans:
            seen.add(registered, planar_scan)
        whole, since = seen.map(), seen.since(10).map()
        assert whole.T_odom_prior is not None and (since.T_odom_prior is not None) is kept
        if kept:
            assert since.T_odom_prior == whole.T_odom_prior
            assert since.since_prior_m == pytest.approx(whole.since_prior_m)


def test_a_keyframe_is_weak_where_a_pose_since_the_one_before_is_not_fine() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    scans = list(drive(office(), [(1.5, 7.0), (3.5, 7.0)]))
    for number, (registered, planar_scan, _) in enumerate(scans):
        seen.add(replace(registered, health=Health.OVERRULED if number == 3 else Health.FINE), planar_scan)
        if number in (3, 6):  # the robot stands for a moment
            seen.add(replace(registered, health=Health.DEGENERATE), planar_scan)
    assert [n for n, k in enumerate(seen.map().keyframes) if k.weak] == [3, 4, 7]


def test_a_restart_forgets_the_scans_and_the_pose_of_an_earlier_time() -> None:
    scans = list(drive(office(), [(1.5, 7.0), (3.5, 7.0)]))
    seen = Query(OFFICE.made_with, OFFICE.config, prior_ns=scans[2][0].scan.stamp_ns)
    for registered, planar_scan, _ in scans:
        seen.add(registered, planar_scan)
    assert seen.map().T_odom_prior is not None
    seen.restart()
    with pytest.raises(NoScans):
        seen.map()
    seen.add(*scans[-1][:2])
    assert seen.map().T_odom_prior is None and seen.part == 1 and seen.path_m == 0.0


def test_standing_still_adds_nothing() -> None:
    seen = Query(OFFICE.made_with, OFFICE.config)
    registered, planar_scan, _ = next(drive(office(), [(1.5, 7.0), (9.5, 7.0)]))
    for _ in range(50):
        seen.add(registered, planar_scan)
    assert len(seen.map().keyframes) == 2 and seen.path_m == 0.0  # the first one and the newest


# --- A drawn map as the query: where does it lie in the building? ---


def turned(grid: OccupancyGrid, quarters: int, origin_m: tuple[float, float]) -> tuple[OccupancyGrid, SE2]:
    """The plan turned counterclockwise about its corner and moved; and T_plan_turned."""
    height, width = (n * RESOLUTION_M for n in grid.cells.shape)
    corner = [(0, 0), (height, 0), (width, height), (0, width)][quarters]
    T_turned_plan = SE2(*origin_m) @ SE2(*corner, quarters * math.pi / 2)
    cells = np.rot90(grid.cells, -quarters)  # rows count upwards
    moved = OccupancyGrid(cells=cells.copy(), resolution_m=RESOLUTION_M, origin_m=origin_m)
    return moved, T_turned_plan.inverse()


@pytest.mark.parametrize(
    ("quarters", "origin_m"), [(0, (-40.0, 25.0)), (1, (0.0, 0.0)), (2, (9.0, -4.0)), (3, (-40.0, 25.0))]
)
def test_a_part_of_the_plan_is_located_wherever_its_frame_is(
    quarters: int, origin_m: tuple[float, float]
) -> None:
    part, T_part_turned = turned(cut(office(), 4.0, 3.0, 15.0, 12.0), quarters, origin_m)
    truth = SE2(4.0, 3.0) @ T_part_turned
    answer = locate_map(part, OFFICE)
    assert answer.status == "located" and answer.session == "office" and answer.confidence >= 0.9
    assert answer.T_map_base is not None and answer.T_map_odom == answer.T_map_base
    corners = np.array([(0, 0), (0, 9), (9, 0), (9, 9)]) + origin_m
    error = np.abs(answer.T_map_odom.apply(corners) - truth.apply(corners)).max()
    assert error < 0.15
    assert answer.path_m == 0.0 and len(answer.history) == 1


def test_the_covariance_is_that_of_the_map_s_own_frame() -> None:
    near, _ = turned(cut(office(), 4.0, 3.0, 15.0, 12.0), 0, (0.0, 0.0))
    far, _ = turned(near, 0, (-40.0, 0.0))
    a, b = locate_map(near, OFFICE).covariance, locate_map(far, OFFICE).covariance
    assert a is not None and b is not None
    assert b[2, 2] == pytest.approx(a[2, 2], rel=0.05)
    # 40 m of lever arm along x turn yaw into y, hardly into x.
    assert b[1, 1] > 100 * a[2, 2] and b[0, 0] < b[1, 1] / 4
    assert np.linalg.eigvalsh(b).min() > 0


def test_the_plan_of_another_building_is_not_located() -> None:
    answer = locate_map(OTHER, OFFICE)
    assert answer.status != "located" and answer.T_map_base is None


def test_a_map_of_nothing_is_not_found() -> None:
    cells = np.full((50, 50), UNKNOWN, np.int8)
    answer = locate_map(OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0)), OFFICE)
    assert answer.status == "not_found" and answer.hypotheses == () and answer.confidence == 0.0
