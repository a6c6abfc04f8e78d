"""A running robot's points, where the database has points, too."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import pytest

from pc2grid.model import PointMap
from signature.database import Label
from signature.localization.follower import Follower
from signature.localization.localizer import Localizer, Look
from signature.localization.map_index import MapIndex
from tests.helpers.simulated_drives import building, office
from tests.helpers.tall_offices import lidar_drive, points

LOW_M, HIGH_M = 2.5, 3.5
TWINS = building(
    {"low": office(), "high": office()}, labels={"low": Label(floor="low"), "high": Label(floor="high")}
)
ALONE = building({"high": office()})


def with_points(index: MapIndex, maps: Mapping[str, PointMap]) -> MapIndex:
    index = copy.copy(index)
    index.points_of = maps.get
    return index


@pytest.fixture(scope="module")
def maps() -> dict[str, PointMap]:
    return {"low": points(LOW_M), "high": points(HIGH_M)}


@pytest.mark.parametrize(("height_m", "name"), [(LOW_M, "low"), (HIGH_M, "high")])
def test_twins_that_differ_in_height_only(height_m: float, name: str, maps: dict[str, PointMap]) -> None:
    plain, spatial = Localizer(TWINS), Localizer(with_points(TWINS, maps))
    answers: list[Look] = []
    for registered, planar_scan, _ in lidar_drive(height_m):
        in_plane = plain.follow(registered, planar_scan)
        assert in_plane is None or in_plane.answer.status != "located"
        look = spatial.follow(registered, planar_scan)
        answers += [] if look is None else [look]
    located = [look for look in answers if look.state == "located"]
    assert located
    assert {look.session for look in located} == {name}
    assert all(look.answer.in_space is not None for look in located)


def test_a_thread_refines_a_located_robot(maps: dict[str, PointMap]) -> None:
    """The thread gets the points of a scan every 0.2 m; the pose is that of space."""
    localizer = Localizer(with_points(ALONE, maps))
    truth, errors_m = {}, []
    with Follower(localizer, beside=True) as follower:
        for registered, planar_scan, T_map_base in lidar_drive(HIGH_M):
            truth[registered.scan.stamp_ns] = T_map_base
            follower.add(registered, planar_scan)
        follower.finish()
        looks = follower.take()
    for look in looks:
        if look.T_map_base is None:
            continue
        assert look.answer.in_space is not None and look.answer.in_space.status == "agrees"
        true = truth[look.registered.scan.stamp_ns]
        errors_m.append(math.hypot(look.T_map_base.x - true.x, look.T_map_base.y - true.y))
    assert errors_m and max(errors_m) < 0.04


def test_without_points_nothing_is_done_in_space() -> None:
    assert not Localizer(ALONE).uses_points
    localizer = Localizer(with_points(ALONE, {}))
    looks = [localizer.follow(registered, planar_scan) for registered, planar_scan, _ in lidar_drive(LOW_M)]
    located = [look for look in looks if look is not None and look.state == "located"]
    assert located and all(look.answer.in_space is None for look in located)
