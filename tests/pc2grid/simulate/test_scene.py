"""Floor plans, their walls in space, and what is put into them."""

from pathlib import Path

import numpy as np
import pytest

from pc2grid.geometry import F32, F64
from pc2grid.model import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from pc2grid.simulate import Building, SimulationConfig, load_building, prepare_session
from pc2grid.simulate.plan import clearance_m, office_floorplan
from pc2grid.simulate.scene import Scene, covered, place_clutter, prism, voxel_faces, voxel_m
from tests.helpers.building_clouds import ROOM_M, room_cloud


def largest_share(grid: OccupancyGrid, free: np.ndarray, robot_m: float = 0.35) -> float:
    """Share of the passable cells that a robot can reach from one another."""
    from scipy import ndimage

    labels, _ = ndimage.label(clearance_m(free, grid.resolution_m) >= robot_m, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel())[1:]
    return float(sizes.max() / sizes.sum())


@pytest.mark.parametrize("seed", [0, 1, 2])  # a comb, a ladder and a ring of corridors
def test_office_is_one_connected_building_with_corridors_and_rooms(seed: int) -> None:
    grid = office_floorplan(seed)
    assert largest_share(grid, grid.free) > 0.97
    assert 0.6 < grid.free.mean() < 0.9
    # Closed to the outside: unknown cells around it touch walls only.
    outside = np.pad(grid.free, 1)
    touching = np.pad(grid.cells == UNKNOWN, 1, constant_values=True)
    assert not (outside[1:] & touching[:-1]).any()
    assert not (outside[:, 1:] & touching[:, :-1]).any()


def test_office_depends_on_the_seed_alone() -> None:
    first = office_floorplan(3)
    assert np.array_equal(office_floorplan(3).cells, first.cells)
    assert (office_floorplan(4).cells != first.cells).mean() > 0.02


def test_clutter_leaves_every_way_open() -> None:
    grid = office_floorplan(0)
    clutter = place_clutter(grid, 80, np.random.default_rng(0), robot_m=0.35)
    assert len(clutter) > 60
    under = covered(grid, clutter)
    assert not (under & ~grid.free).any()
    assert largest_share(grid, grid.free & ~under) > 0.97


def test_clutter_keeps_away_from_the_start() -> None:
    cells = np.full((80, 80), OCCUPIED, np.int8)
    cells[2:-2, 2:-2] = FREE
    grid = OccupancyGrid(cells=cells, resolution_m=0.05, origin_m=(0.0, 0.0))
    for seed in range(5):
        clutter = place_clutter(grid, 20, np.random.default_rng(seed), robot_m=0.3, keep_free_m=((1.0, 2.0),))
        assert clutter
        for furniture in clutter:
            outline = furniture.pose.apply(furniture.outline_m)
            assert np.linalg.norm(outline - (1.0, 2.0), axis=1).min() > 1.0


# --- A robot drives through a cloud or a mesh of a building ---


def write_cloud(path: Path, points: F64) -> Path:
    import open3d as o3d

    o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    return path


def write_mesh(path: Path, triangles_m: F32) -> Path:
    import open3d as o3d

    corners_m = triangles_m.reshape(-1, 3).astype(float)
    made = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(corners_m),
        o3d.utility.Vector3iVector(np.arange(len(corners_m), dtype=np.int32).reshape(-1, 3)),
    )
    made.compute_triangle_normals()
    o3d.io.write_triangle_mesh(str(path), made)
    return path


def hall() -> F32:
    x, y, z = ROOM_M
    outline = np.array([(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)])
    pillar = np.array([(5.0, 3.0), (5.5, 3.0), (5.5, 3.5), (5.0, 3.5)])
    return np.concatenate([prism(outline, 0.4, 0.4 + z), prism(pillar, 0.4, 0.4 + z)])


def test_rays_hit_the_faces_of_voxels() -> None:
    cloud = room_cloud()
    assert voxel_m(cloud) == pytest.approx(0.05)
    scene = Scene(voxel_faces(cloud, 0.05))
    rays = np.array([(2, 2, 1, 1, 0, 0), (2, 2, 1, 0, -1, 0), (2, 2, 1, 0, 0, -1)], np.float32)
    assert scene.cast(rays) == pytest.approx([ROOM_M[0] - 2.025, 1.975, 0.975], abs=0.03)


def test_walls_of_a_thin_irregular_cloud_have_no_holes() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack((rng.uniform(-2, 2, 4000), np.full(4000, 3.0), rng.uniform(0, 2, 4000)))
    edge_m = voxel_m(wall)
    assert edge_m > 0.05
    across, up = np.meshgrid(np.linspace(-0.5, 0.5, 30), np.linspace(-0.2, 0.2, 20))
    rays = np.zeros((across.size, 6), np.float32)
    rays[:, 2], rays[:, 3], rays[:, 4], rays[:, 5] = 1.0, across.ravel(), 1.0, up.ravel()
    assert np.isfinite(Scene(voxel_faces(wall, edge_m)).cast(rays)).mean() > 0.97


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_cloud_is_driven_through(tmp_path: Path, suffix: str) -> None:
    building = load_building(write_cloud(tmp_path / f"room{suffix}", room_cloud(1.7)))
    assert isinstance(building, Building)
    config = SimulationConfig(length_m=4.0, clutter=2)
    session = prepare_session(sensor="laser", grid=building, config=config)
    assert len(session.clutter) == 2
    scan, T_map_base = next(iter(session.scans()))
    seen = T_map_base.apply(scan.points_m[:, :2])
    x, y, _ = ROOM_M
    assert seen.min() > -0.15 and seen[:, 0].max() < x + 0.15 and seen[:, 1].max() < y + 0.15


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_mesh_is_driven_through(tmp_path: Path, suffix: str) -> None:
    building = load_building(write_mesh(tmp_path / f"hall{suffix}", hall()))
    assert isinstance(building, Building)
    assert building.shell[..., 2].min() == pytest.approx(0.0, abs=0.01)
    session = prepare_session(sensor="depth", grid=building, config=SimulationConfig(length_m=3.0, clutter=0))
    scan, _ = next(iter(session.scans()))
    assert len(scan.points_m) > 1000
    x, y = session.drive.poses[:, 0], session.drive.poses[:, 1]
    inside_pillar = (np.abs(x - 5.25) < 0.5) & (np.abs(y - 3.25) < 0.5)
    assert not inside_pillar.any()
