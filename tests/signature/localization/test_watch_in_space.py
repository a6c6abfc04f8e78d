"""A running robot's points, where the database has points, too."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import pytest

from pc2grid.matching.icp_in_space import MapSurface
from signature.database import Label
from signature.localization.localizer import Estimate, Follower, Localizer
from signature.localization.map_index import MapIndex
from tests.helpers.simulated_drives import building, office
from tests.helpers.tall_offices import lidar_drive, points

LOW_M, HIGH_M = 2.5, 3.5
TWINS = building(
    {"low": office(), "high": office()}, labels={"low": Label(floor="low"), "high": Label(floor="high")}
)
ALONE = building({"high": office()})


def with_points(index: MapIndex, maps: Mapping[str, MapSurface]) -> MapIndex:
    index = copy.copy(index)
    index.surface_of = maps.get
    return index


@pytest.fixture(scope="module")
def maps() -> dict[str, MapSurface]:
    return {"low": MapSurface(points(LOW_M)), "high": MapSurface(points(HIGH_M))}


@pytest.mark.parametrize(("height_m", "name"), [(LOW_M, "low"), (HIGH_M, "high")])
def test_twins_that_differ_in_height_only(height_m: float, name: str, maps: dict[str, MapSurface]) -> None:
    plain, spatial = Localizer(TWINS), Localizer(with_points(TWINS, maps))
    answers: list[Estimate] = []
    for registered, planar_scan, _ in lidar_drive(height_m):
        in_plane = plain.add(registered, planar_scan)
        assert in_plane is None or in_plane.answer.status != "located"
        estimate = spatial.add(registered, planar_scan)
        answers += [] if estimate is None else [estimate]
    located = [estimate for estimate in answers if estimate.state == "located"]
    assert located
    assert {estimate.answer.session for estimate in located} == {name}
    assert all(estimate.answer.in_space is not None for estimate in located)


def test_a_thread_refines_a_located_robot(maps: dict[str, MapSurface]) -> None:
    """The thread gets the points of a scan every 0.2 m; the pose is that of space."""
    localizer = Localizer(with_points(ALONE, maps))
    truth, errors_m = {}, []
    with Follower(localizer, beside=True) as follower:
        for registered, planar_scan, T_map_base in lidar_drive(HIGH_M):
            truth[registered.scan.stamp_ns] = T_map_base
            follower.add(registered, planar_scan)
        follower.finish()
        estimates = follower.take()
    for estimate in estimates:
        if estimate.answer.T_map_base is None:
            continue
        assert estimate.answer.in_space is not None and estimate.answer.in_space.status == "agrees"
        true = truth[estimate.registered.scan.stamp_ns]
        errors_m.append(
            math.hypot(estimate.answer.T_map_base.x - true.x, estimate.answer.T_map_base.y - true.y)
        )
    assert errors_m and max(errors_m) < 0.04


def test_without_points_nothing_is_done_in_space() -> None:
    assert not Localizer(ALONE).uses_points
    localizer = Localizer(with_points(ALONE, {}))
    estimates = [localizer.add(registered, planar_scan) for registered, planar_scan, _ in lidar_drive(LOW_M)]
    located = [estimate for estimate in estimates if estimate is not None and estimate.state == "located"]
    assert located and all(estimate.answer.in_space is None for estimate in located)
