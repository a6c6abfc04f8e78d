"""Folders of PCD, PLY and KITTI .bin files, as Open3D and plain numpy write them."""

from pathlib import Path

import numpy as np

from pc2grid.geometry import pose_from_rotation_vector
from pc2grid.model import Trajectory
from tests.helpers.recordings import STEP, T0

POINTS = np.random.default_rng(5).uniform(-9, 9, (200, 3)).astype(np.float32)
KINDS = ["pcd ascii", "pcd binary", "ply ascii", "ply binary", "bin"]


def write_cloud(path: Path, points: np.ndarray, kind: str) -> Path:
    path = path.with_name(path.name + "." + kind.split()[0])
    if kind == "bin":
        np.column_stack((points, np.full(len(points), 0.5))).astype("<f4").tofile(path)
        return path
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(points, np.float32)))
    assert o3d.t.io.write_point_cloud(str(path), cloud, write_ascii="ascii" in kind)
    return path


def folder_of(tmp_path: Path, kind: str, count: int = 12, name: str = "clouds") -> Path:
    """Scan i holds the first 100 + i points; the names are numbers without leading zeros."""
    folder = tmp_path / name
    folder.mkdir(parents=True)
    for i in range(count):
        write_cloud(folder / f"scan_{i}", POINTS[: 100 + i], kind)
    return folder


def trajectory(count: int = 12) -> Trajectory:
    poses = [pose_from_rotation_vector((0, 0, 0.1 * i), (0.5 * i, 0, 0)) for i in range(count)]
    return Trajectory(stamps_ns=T0 + STEP * np.arange(count), T_session_base=np.array(poses))
