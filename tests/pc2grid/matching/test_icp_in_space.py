"""A planar pose refined in space, and rays that agree with a map or pass through it."""

import math

import numpy as np
import pytest

from pc2grid.geometry import (
    F64,
    SE2,
    invert_pose,
    pose_from_rotation_vector,
    rotation_vector,
    transform_points,
)
from pc2grid.matching.icp_in_space import MapSurface, SpatialFit, SpatialView, register_in_space
from pc2grid.model import PointMap
from signature.config import Config
from signature.places.query import QueryInSpace
from tests.helpers.building_clouds import box_surface
from tests.helpers.twin_rooms import APART_M, HEIGHTS_M, drive, twin_map

OFF = SE2(0.08, -0.06, math.radians(2.0))


def asked(height_m: float) -> tuple[QueryInSpace, SE2, F64, F64]:
    """A query, the planar pose of its odom frame in the room, the last true pose, and the same in odom."""
    query, scans = QueryInSpace(Config()), drive(height_m)
    for registered, _ in scans:
        query.add(registered)
    last, T_room_base = scans[-1]
    T_room_odom = T_room_base @ invert_pose(last.T_session_base)
    return query, SE2.from_matrix(T_room_odom), T_room_base, last.T_session_base


@pytest.mark.parametrize(("height_m", "x_m"), [(HEIGHTS_M[0], 0.0), (HEIGHTS_M[1], APART_M)])
def test_pose_in_space_is_exact_to_a_centimetre(height_m: float, x_m: float) -> None:
    query, T_room_odom, T_room_base, T_odom_base = asked(height_m)
    fit = register_in_space(query.views, MapSurface(twin_map()), SE2(x_m, 0.0, 0.0) @ T_room_odom @ OFF)
    assert isinstance(fit, SpatialFit)
    true = T_room_base.copy()
    true[0, 3] += x_m
    error = invert_pose(true) @ fit.T_map_query @ T_odom_base
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.linalg.norm(rotation_vector(error)) < math.radians(0.3)
    assert fit.on > 0.97 and fit.through < 0.02 and fit.rmse_m < 0.03
    sigma = np.sqrt(np.diag(fit.covariance_at(T_odom_base)))
    assert (sigma[:3] > 1e-3).all() and (sigma[:3] < 0.05).all() and (sigma[3:] < math.radians(1.0)).all()


def test_a_query_that_is_not_level_is_tilted_with_its_floor() -> None:
    """Without tf, the first scan decides how level the odom frame is; here it is wrong by 12 degrees."""
    query, T_room_odom, T_room_base, T_odom_base = asked(HEIGHTS_M[0])
    tilt = pose_from_rotation_vector([math.radians(12.0), 0.0, 0.0])
    tilted = [
        SpatialView(
            sensor_m=transform_points(tilt, view.sensor_m[None])[0],
            points_m=transform_points(tilt, view.points_m),
        )
        for view in query.views
    ]
    fit = register_in_space(tilted, MapSurface(twin_map()), T_room_odom)
    assert isinstance(fit, SpatialFit)
    error = invert_pose(T_room_base) @ fit.T_map_query @ tilt @ T_odom_base
    assert np.linalg.norm(error[:3, 3]) < 0.02


def test_a_hall_that_is_mostly_floor_is_registered() -> None:
    """More than half of what is seen of a wide hall is its floor; so the floor is the median height."""
    sides = [
        ((-8, -8, 0), (8, -8, 2)),
        ((-8, 8, 0), (5, 8, 2)),
        ((-8, -8, 0), (-8, 8, 2)),
        ((8, -8, 0), (8, 3, 2)),
    ]
    points_m = np.concatenate([box_surface((-8, -8, 0), (8, 8, 0)), *(box_surface(*side) for side in sides)])
    assert np.median(points_m[:, 2]) < 0.05
    view = SpatialView(sensor_m=np.array([1.0, 0.5, 1.0]), points_m=points_m)
    fit = register_in_space([view], MapSurface(PointMap.of(points_m, 0.05)), OFF)
    assert isinstance(fit, SpatialFit) and fit.on > 0.97
    assert np.linalg.norm(fit.T_map_query[:3, 3]) < 0.02


def test_twin_rooms_of_other_height_are_told_apart() -> None:
    """A query in the lower room ends before the ceiling of the higher one; the other way round it passes."""
    for height_m, own_m, other_m, share in (
        (HEIGHTS_M[0], 0.0, APART_M, "before"),
        (HEIGHTS_M[1], APART_M, 0.0, "through"),
    ):
        query, T_room_odom, *_ = asked(height_m)
        own, other = (
            register_in_space(query.views, MapSurface(twin_map()), SE2(x_m, 0.0, 0.0) @ T_room_odom)
            for x_m in (own_m, other_m)
        )
        assert isinstance(own, SpatialFit) and isinstance(other, SpatialFit)
        assert own.on > other.on + 0.1
        assert getattr(other, share) > 0.1 > getattr(own, share)


def test_a_shelf_is_no_wall() -> None:
    """Up to 1.8 m both look alike; above the shelf the rays go on to the wall behind it."""
    floor, sides = box_surface((0, 0, 0), (5, 4, 0)), box_surface((0, 0, 0), (0, 4, 2.8))
    walls = [floor, sides, box_surface((0, 0, 0), (5, 0, 2.8)), box_surface((0, 4, 0), (5, 4, 2.8))]
    with_wall = np.concatenate([*walls, box_surface((4, 0, 0), (4, 4, 2.8))])
    shelf = [box_surface((4, 0, 0), (4, 4, 1.8)), box_surface((5, 0, 1.8), (5, 4, 2.8))]
    view = SpatialView(sensor_m=np.array([2.0, 2.0, 1.2]), points_m=np.concatenate([*walls, *shelf]))
    through = register_in_space([view], MapSurface(PointMap.of(with_wall, 0.05)), SE2())
    right = register_in_space([view], MapSurface(PointMap.of(view.points_m, 0.05)), SE2())
    assert isinstance(through, SpatialFit) and isinstance(right, SpatialFit)
    assert through.through > 0.05 and right.through == 0.0
    assert right.on > through.on + 0.05


def test_one_free_direction_is_uncertain() -> None:
    """A corridor without ends: along it nothing fixes the pose."""
    walls = [box_surface((0, y, 0), (20, y, 2.5)) for y in (0.0, 2.0)]
    cloud = np.concatenate([*walls, box_surface((0, 0, 0), (20, 2, 0))])
    seen = cloud[np.abs(cloud[:, 0] - 10.0) < 4.0]
    view = SpatialView(sensor_m=np.array([10.0, 1.0, 1.0]), points_m=seen)
    fit = register_in_space([view], MapSurface(PointMap.of(cloud, 0.05)), SE2())
    assert isinstance(fit, SpatialFit)
    sigma = np.sqrt(np.diag(fit.covariance_at(np.eye(4))))
    assert sigma[0] > 10.0 * max(sigma[1:3])


def test_nothing_is_known_where_there_is_no_map() -> None:
    query, T_room_odom, *_ = asked(HEIGHTS_M[0])
    away = SE2(100.0, 0.0, 0.0) @ T_room_odom
    assert register_in_space(query.views, MapSurface(twin_map()), away) == "unknown"
    assert register_in_space([], MapSurface(twin_map()), T_room_odom) == "unknown"


@pytest.mark.parametrize("off", [SE2(0.65, 0.0, 0.0), SE2(0.0, -0.65, 0.0)], ids=["along x", "along y"])
def test_a_pose_beside_the_right_one_is_left(off: SE2) -> None:
    query, T_room_odom, *_ = asked(HEIGHTS_M[0])
    assert register_in_space(query.views, MapSurface(twin_map()), off @ T_room_odom) == "left"
