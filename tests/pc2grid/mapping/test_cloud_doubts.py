"""What is told of a cloud whose map may be wrong: upside down, on its side, thin, of several floors."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import MapFileError
from pc2grid.geometry import F64, transform_points
from pc2grid.io.export import write_cloud
from pc2grid.mapping.drawn import DrawnMap, is_upside_down, level_cloud, load_drawn_map, other_floors
from pc2grid.settings import Config, ReadConfig
from tests.helpers.building_clouds import hall_cloud, raised, room_cloud, rooms_cloud, turned
from tests.helpers.field import field_file

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[3] / ".." / "shared" / "data"))
FLOOR = DATA / "lidar" / "fr079_floor.ply"
OVER = np.diag((1.0, -1.0, -1.0))


def level(points: F64) -> F64:
    return transform_points(level_cloud(points), points)


def read(path: Path, **read_config: object) -> DrawnMap:
    return load_drawn_map(path, Config(read=ReadConfig.model_validate(read_config)))


def free_m2(drawn: DrawnMap) -> float:
    return float(drawn.grid.free.sum()) * drawn.grid.resolution_m**2


def thinned(points: F64, leaf_m: float) -> F64:
    """One point a voxel, as a voxel filter makes them."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return np.asarray(cloud.voxel_down_sample(leaf_m).points)


@pytest.mark.parametrize("furniture", [True, False])
@pytest.mark.parametrize("rooms", [2, 3])
def test_rooms_are_known_to_be_upside_down_by_their_doors(rooms: int, furniture: bool) -> None:
    points = rooms_cloud(rooms, furniture=furniture)
    assert not is_upside_down(level(points))
    assert is_upside_down(level(points @ OVER))


def test_a_single_room_is_known_to_be_upside_down_by_its_furniture() -> None:
    assert not is_upside_down(level(rooms_cloud(1)))
    assert is_upside_down(level(rooms_cloud(1) @ OVER))


def test_nothing_is_said_where_nothing_shows_it() -> None:
    for points in (room_cloud(), rooms_cloud(1, furniture=False), rooms_cloud(ceiling=False), hall_cloud()):
        assert not is_upside_down(level(points))


@pytest.mark.parametrize(("rise_m", "storeys"), [(2.8, 2), (3.0, 3), (4.0, 2)])
@pytest.mark.parametrize("ceiling", [True, False])
def test_other_floors_are_found(rise_m: float, storeys: int, ceiling: bool) -> None:
    above = [raised(rooms_cloud(ceiling=ceiling), i * rise_m) for i in range(storeys)]
    found = other_floors(level(np.concatenate(above)))
    assert [floor.height_m for floor in found] == pytest.approx(np.arange(1, storeys) * rise_m, abs=0.03)
    assert all(45.0 < floor.area_m2 < 60.0 for floor in found)


def test_a_ceiling_is_no_other_floor() -> None:
    for points in (room_cloud(), rooms_cloud(), hall_cloud()):
        assert other_floors(level(points)) == []


def test_what_is_told_of_a_cloud_and_what_to_type(tmp_path: Path) -> None:
    path = tmp_path / "house.pcd"
    write_cloud(path, rooms_cloud() @ OVER)
    assert "upside down" in read(path).warnings[0] and "read.up=-z" in read(path).warnings[0]
    turned_right = read(path, up="-z")
    assert turned_right.warnings == ()
    assert turned_right.T_map_file[2] == pytest.approx((0.0, 0.0, 1.0, 0.0), abs=0.01)

    write_cloud(path, rooms_cloud() @ OVER @ turned(np.eye(3), (1.0, 0.0, 0.0), 90.0))
    assert "on its side" in read(path).warnings[0] and "read.up=" in read(path).warnings[0]
    told = {up: read(path, up=up).warnings for up in ("y", "-y")}
    wrong = next(up for up in told if told[up])
    right = {"y": "-y", "-y": "y"}[wrong]
    assert f"--set read.up={right} " in told[wrong][0] and told[right] == ()

    write_cloud(path, raised(np.concatenate((rooms_cloud(), raised(rooms_cloud(1), 3.0))), 0.5))
    below, above = read(path), read(path, floor_z=3.5)
    (said,) = below.warnings
    assert "another floor lies at z = 3.5 with 2" in said and "--set read.floor_z=3.5 " in said
    assert above.warnings == () and 0.35 < free_m2(above) / free_m2(below) < 0.65


@pytest.mark.parametrize(("leaf_m", "told"), [(0.1, False), (0.2, True), (0.4, True)])
def test_walls_thinned_to_dots_are_told(tmp_path: Path, leaf_m: float, told: bool) -> None:
    """Of rooms, and of rooms in which no viewpoint is found any more."""
    path = tmp_path / "rooms.ply"
    for offset_m in (0.03, 0.11):
        write_cloud(path, thinned(rooms_cloud() + offset_m, leaf_m))
        try:
            said = " ".join(read(path).warnings)
        except MapFileError as error:
            said = error.in_short
        assert ("so walls have gaps" in said and "voxel filter" in said) == told, said


@pytest.mark.skipif(not FLOOR.is_file(), reason="no real cloud: set PC2GRID_DATA")
def test_real_floor(tmp_path: Path) -> None:
    import open3d as o3d

    points = np.asarray(o3d.io.read_point_cloud(str(FLOOR)).points)
    upright = level(points)
    assert not is_upside_down(upright) and other_floors(upright) == []
    assert is_upside_down(level(points @ OVER))
    (above,) = other_floors(level(np.concatenate((points, raised(points, 3.0)))))
    assert above.height_m == pytest.approx(3.0, abs=0.05)
    path = tmp_path / "thin.ply"
    write_cloud(path, thinned(points, 0.1))
    assert read(path).warnings == ()
    write_cloud(path, thinned(points, 0.2))
    (said,) = read(path).warnings
    assert "so walls have gaps" in said


def test_clouds_of_the_field() -> None:
    path = field_file("cloud_upside_down.ply")
    (said,) = read(path).warnings
    assert "upside down" in said and "--set read.up=-z " in said
    assert read(path, up="-z").warnings == ()

    mostly_floor = read(field_file("cloud_mostly_floor.ply"))
    assert free_m2(mostly_floor) == pytest.approx(374.0, abs=5.0)
    assert mostly_floor.T_map_file[2, 3] == pytest.approx(0.0, abs=0.02)

    with pytest.raises(MapFileError, match="float32 cannot hold these coordinates") as refused:
        read(field_file("cloud_utm_float32.ply"))
    assert "subtract an offset" in (refused.value.hint or "")
