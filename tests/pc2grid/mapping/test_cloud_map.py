"""One cloud of a building becomes a levelled occupancy grid."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import MapFileError
from pc2grid.geometry import transform_points
from pc2grid.mapping.cloud_map import CLOUD_MAP, CloudMapParameters, level_cloud, map_cloud
from pc2grid.model import OccupancyGrid
from tests.helpers.building_clouds import room_cloud

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[3] / ".." / "shared" / "data"))
FLOOR = DATA / "lidar" / "fr079_floor.ply"


def cell_at(grid: OccupancyGrid, x_m: float, y_m: float) -> int:
    row, column = grid.to_cell(np.array([[x_m, y_m]]))[0]
    return int(grid.cells[row, column])


@pytest.mark.parametrize(("height_m", "tilt_deg"), [(0.0, 0.0), (-1.3, 0.0), (4.0, 2.0)])
def test_floor_is_levelled(height_m: float, tilt_deg: float) -> None:
    points = room_cloud(height_m, tilt_deg)
    level = transform_points(level_cloud(points), points)
    floor = level[np.abs(level[:, 2]) < 0.3]
    assert len(floor) > 15_000
    assert np.median(np.abs(floor[:, 2])) < 0.01
    assert level[:, 2].max() == pytest.approx(2.5, abs=0.05)


def test_floor_is_free_and_what_stands_on_it_is_occupied() -> None:
    grid = map_cloud(room_cloud())
    assert cell_at(grid, 3.0, 2.0) == 0
    assert cell_at(grid, 5.25, 3.0) == 100  # the pillar
    assert cell_at(grid, 4.0, 0.02) == 100  # a wall
    assert cell_at(grid, -0.3, 3.0) == -1
    # Nothing above the floor blocks a lower robot; here the table is one voxel thick.
    assert cell_at(grid, 1.5, 4.4) == 0
    one_is_enough = CloudMapParameters(obstacle_voxels=1)
    assert cell_at(map_cloud(room_cloud(), one_is_enough), 1.5, 4.4) == 100


def test_denser_cloud_gives_the_same_grid() -> None:
    cloud = room_cloud() + 0.02  # away from the edges of cells
    rng = np.random.default_rng(0)
    dense = np.concatenate((cloud, cloud + rng.uniform(-0.01, 0.01, cloud.shape)))
    assert np.array_equal(map_cloud(cloud).cells, map_cloud(dense).cells)


def test_cloud_without_floor_is_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(MapFileError, match="no floor"):
        level_cloud(rng.uniform(-5, 5, (5000, 3)))
    with pytest.raises(MapFileError, match="no floor"):
        level_cloud(np.empty((0, 3)))


def test_stray_point_does_not_take_all_memory() -> None:
    far = np.append(room_cloud(), [[90_000.0, 90_000.0, 0.0]], axis=0)
    with pytest.raises(MapFileError, match="stray"):
        map_cloud(far)


@pytest.mark.skipif(not FLOOR.is_file(), reason="no real cloud: set PC2GRID_DATA")
def test_real_floor() -> None:
    import open3d as o3d

    points = np.asarray(o3d.io.read_point_cloud(str(FLOOR)).points)
    level = transform_points(level_cloud(points), points)
    grid = map_cloud(level)
    # The corridor of 39 x 3 m and what can be seen of the rooms.
    assert 115 < grid.free.sum() * CLOUD_MAP.resolution_m**2 < 140
