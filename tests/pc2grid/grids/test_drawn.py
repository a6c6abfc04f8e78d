"""One cloud of a building becomes a levelled occupancy grid."""

from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import MapFileError
from pc2grid.geometry import F64, transform_points
from pc2grid.grids import drawn
from pc2grid.grids.drawn import (
    CLOUD_MAP,
    CloudMapParameters,
    DrawnMap,
    drivable_plan,
    is_upside_down,
    level_cloud,
    load_drawn_map,
    map_cloud,
    other_floors,
    voxel_cloud,
)
from pc2grid.io.building_file import UPRIGHT
from pc2grid.io.export import write_cloud
from pc2grid.model import OccupancyGrid
from pc2grid.settings import Config, ReadConfig
from tests.helpers.building_clouds import (
    ROOM_M,
    box_surface,
    hall_cloud,
    raised,
    room_cloud,
    rooms_cloud,
    turned,
)
from tests.helpers.field import DATA, field_file
from tests.helpers.rooms import RESOLUTION_M

FLOOR = DATA / "lidar" / "fr079_floor.ply"


def cell_at(grid: OccupancyGrid, x_m: float, y_m: float) -> int:
    return int(grid.crop((x_m, y_m), 0.0).cells[0, 0])  # unknown past the edge


@pytest.mark.parametrize(("height_m", "tilt_deg"), [(0.0, 0.0), (-1.3, 0.0), (4.0, 2.0)])
def test_floor_is_levelled(height_m: float, tilt_deg: float) -> None:
    points = room_cloud(height_m, tilt_deg)
    level = transform_points(level_cloud(points), points)
    floor = level[np.abs(level[:, 2]) < 0.3]
    assert len(floor) > 15_000
    assert np.median(np.abs(floor[:, 2])) < 0.01
    assert level[:, 2].max() == pytest.approx(2.5, abs=RESOLUTION_M)


def test_plan_is_free_where_floor_is_seen_and_nothing_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = drivable_plan(room_cloud())
    assert cell_at(grid, 3.0, 2.0) == 0
    assert cell_at(grid, 5.25, 3.0) == 100  # the pillar
    assert cell_at(grid, 4.0, 0.02) == 100  # a wall
    assert cell_at(grid, -0.3, 3.0) == -1
    # Nothing above the floor blocks a lower robot; here the table is one voxel thick.
    assert cell_at(grid, 1.5, 4.4) == 0
    monkeypatch.setattr(drawn, "CLOUD_MAP", CloudMapParameters(obstacle_voxels=1))
    assert cell_at(drivable_plan(room_cloud()), 1.5, 4.4) == 100


def test_floor_hidden_by_furniture_is_free_up_to_the_wall_and_a_hole_in_it_is_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cloud = room_cloud()
    hidden = (cloud[:, 2] < 0.1) & (cloud[:, 0] > 0.1) & (cloud[:, 0] < 0.4) & (cloud[:, 1] > 1.0)
    hole = (cloud[:, 0] > 7.9) & (np.abs(cloud[:, 1] - 2.0) < 0.06)
    next_room = box_surface((9, 0, 0), (9, 6, 2.5))
    floor_there = box_surface((8.1, 0, 0), (9, 6, 0))
    cloud = np.concatenate((cloud[~hidden & ~hole], next_room, floor_there))
    grid = map_cloud(cloud)
    assert cell_at(grid, 0.25, 3.0) < 20
    assert cell_at(drivable_plan(cloud), 0.25, 3.0) == -1
    assert cell_at(grid, 8.5, 2.0) < 20  # seen from its own floor
    one_room = CloudMapParameters(floor_m=0.02, spacing_m=20.0, tile_m=40.0)
    monkeypatch.setattr(drawn, "CLOUD_MAP", one_room)
    assert cell_at(map_cloud(cloud), 8.5, 2.0) == -1


def test_ground_far_from_seen_floor_stays_unknown() -> None:
    cloud = room_cloud()
    wide = (cloud[:, 2] < 0.1) & (cloud[:, 0] < 3.0)
    assert cell_at(map_cloud(cloud[~wide]), 1.5, 2.0) == -1


def test_single_scan_is_drawn_from_its_origin() -> None:
    """Sixteen rings around a sensor 1 m above the floor: on the floor there is no room for a viewpoint."""
    bearing, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 1800), np.radians(np.arange(-15, 16, 2)))
    ray = np.stack(
        (np.cos(bearing) * np.cos(elevation), np.sin(bearing) * np.cos(elevation), np.sin(elevation)), -1
    ).reshape(-1, 3)
    origin = np.array([3.0, 2.0, 1.0])
    far = np.where(ray > 0, np.array(ROOM_M) - origin, -origin) / np.where(ray == 0, 1e-9, ray)
    scan = origin + far.min(axis=1)[:, None] * ray
    with pytest.raises(MapFileError, match="seen nowhere"):
        map_cloud(scan)
    grid = map_cloud(scan, origin_m=origin)
    assert cell_at(grid, 5.0, 4.0) < 20
    assert max(cell_at(grid, x_m, 2.0) for x_m in (7.98, 8.02)) > 65


@pytest.mark.parametrize(("scale", "words"), [(1000.0, "too high"), (0.001, "too small")])
def test_cloud_that_is_not_in_metres_is_refused(scale: float, words: str) -> None:
    with pytest.raises(MapFileError, match=words):
        voxel_cloud([room_cloud() * scale])
    with pytest.raises(MapFileError, match="in metres"):
        level_cloud(room_cloud() * scale)


def test_stray_points_do_not_take_all_memory() -> None:
    far = np.append(room_cloud(), [[40_000.0, 40_000.0, 0.0]], axis=0)
    with pytest.raises(MapFileError, match="stray"):
        drivable_plan(far)
    assert map_cloud(far).cells.size < 100_000


def test_cloud_without_floor_is_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(MapFileError, match="no floor"):
        level_cloud(rng.uniform(-5, 5, (5000, 3)))
    with pytest.raises(MapFileError, match="neither points"):
        level_cloud(np.empty((0, 3)))


def test_floor_that_most_points_lie_on_is_found() -> None:
    hall = hall_cloud()
    assert (hall[:, 2] == 0.0).mean() > 0.6
    assert level_cloud(raised(hall, 0.4))[2, 3] == pytest.approx(-0.4, abs=0.01)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.4, 0.0)])
@pytest.mark.parametrize(("tilt_deg", "ceiling"), [(20.0, True), (40.0, True), (37.0, False)])
def test_tilted_floor_is_levelled(axis: tuple[float, float, float], tilt_deg: float, ceiling: bool) -> None:
    points = turned(rooms_cloud(ceiling=ceiling), axis, tilt_deg)
    up = turned(np.array([[0.0, 0.0, 1.0]]), axis, tilt_deg)[0]
    assert level_cloud(points)[2, :3] @ up > np.cos(np.radians(0.5))


def test_floor_that_another_axis_is_nearer_to_is_named_with_its_tilt() -> None:
    """At 60 degrees a wall is nearer to level than the floor."""
    for points in (rooms_cloud(), rooms_cloud(ceiling=False), hall_cloud()):
        lying = turned(points, (1.0, 0.0, 0.0), 60.0)
        with pytest.raises(MapFileError, match="level plane, is tilted by 60 degrees") as refused:
            level_cloud(lying)
        assert "read.up=-y" in (refused.value.hint or "")
        T = level_cloud(lying @ UPRIGHT["-y"].T, up="-y")
        assert T[:3, :3] @ UPRIGHT["-y"] @ turned(np.eye(3), (1.0, 0.0, 0.0), 60.0).T[:, 2] == pytest.approx(
            (0.0, 0.0, 1.0), abs=0.01
        )


def test_floor_above_all_else_is_said_to_be_upside_down() -> None:
    """Without a ceiling, nothing but the floor can be the floor."""
    for points in (rooms_cloud(ceiling=False), hall_cloud()):
        for up in ("z", "-y"):
            over = points @ np.diag((1.0, -1.0, -1.0))
            with pytest.raises(MapFileError, match="but one lies above them") as refused:
                level_cloud(over, up=up)
            assert f"read.up={'-z' if up == 'z' else 'y'}" in (refused.value.hint or "")


@pytest.mark.skipif(not FLOOR.is_file(), reason="no real cloud: set PC2GRID_DATA")
def test_real_floor() -> None:
    import open3d as o3d

    points = np.asarray(o3d.io.read_point_cloud(str(FLOOR)).points)
    level = transform_points(level_cloud(points), points)
    grid = drivable_plan(level)
    # The corridor of 39 x 3 m and what can be seen of the rooms.
    assert 115 < grid.free.sum() * CLOUD_MAP.resolution_m**2 < 140


def test_an_uneven_floor_is_where_the_user_says(tmp_path: Path) -> None:
    """The floor of a room goes up and down by 0.3 m, so that no level plane is large."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0.0, 5.0, (2, 20_000))
    floor = np.column_stack((x, y, -0.4 + rng.uniform(-0.15, 0.15, 20_000)))
    along, up = rng.uniform(0.0, 5.0, 20_000), rng.uniform(-0.4, 2.0, 20_000)
    walls = [np.column_stack((along, np.full(20_000, at), up)) for at in (0.0, 5.0)]
    walls += [wall[:, [1, 0, 2]] for wall in walls]
    below = np.column_stack((rng.uniform(0.0, 5.0, (300, 2)), rng.uniform(-1.5, -0.6, 300)))  # mirrored in it
    file = tmp_path / "room.ply"
    write_cloud(file, np.concatenate((floor, *walls, below)))
    with pytest.raises(MapFileError, match="no floor") as refused:
        load_drawn_map(file)
    assert "read.floor_z" in (refused.value.hint or "")
    drawn = load_drawn_map(file, Config(read=ReadConfig(floor_z=-0.4)))
    assert drawn.T_map_file[2, 3] == pytest.approx(0.4)
    assert drawn.grid.free.sum() * drawn.grid.resolution_m**2 > 15.0


# --- What is told of a cloud whose map may be wrong: upside down, on its side, thin, of several floors ---


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


@pytest.mark.parametrize(
    ("rise_m", "storeys", "ceiling"), [(2.8, 2, True), (2.8, 2, False), (3.0, 3, True), (4.0, 2, False)]
)
def test_other_floors_are_found(rise_m: float, storeys: int, ceiling: bool) -> None:
    above = [raised(rooms_cloud(ceiling=ceiling), i * rise_m) for i in range(storeys)]
    found = other_floors(level(np.concatenate(above)))
    assert [height_m for height_m, _ in found] == pytest.approx(np.arange(1, storeys) * rise_m, abs=0.03)
    assert all(45.0 < area_m2 < 60.0 for _, area_m2 in found)


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
def test_a_real_floor_is_not_doubted(tmp_path: Path) -> None:
    import open3d as o3d

    points = np.asarray(o3d.io.read_point_cloud(str(FLOOR)).points)
    upright = level(points)
    assert not is_upside_down(upright) and other_floors(upright) == []
    assert is_upside_down(level(points @ OVER))
    ((height_m, _),) = other_floors(level(np.concatenate((points, raised(points, 3.0)))))
    assert height_m == pytest.approx(3.0, abs=0.05)
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
