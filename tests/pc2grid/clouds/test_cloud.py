"""Points collected block by block, one a voxel."""

import numpy as np
import pytest

from pc2grid.clouds import cloud as cloud_of_points
from pc2grid.clouds.cloud import VoxelCloud
from pc2grid.errors import LimitExceeded


def test_blocks_give_what_open3d_gives_for_all_at_once() -> None:
    import open3d as o3d

    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3))
    cloud = VoxelCloud(0.25)
    for block in np.array_split(points, 17):
        cloud.add(block)
    corner = points[0] - 0.125  # of our first voxel; Open3D puts one at the lowest point less half an edge
    reference = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    low = corner + 0.25 * np.floor((points.min(axis=0) - corner) / 0.25) - 0.25
    found, *_ = reference.voxel_down_sample_and_trace(0.25, low, low + 3.0)
    expected = np.asarray(found.points)
    ours = cloud.points_m()
    assert len(cloud) == len(ours) == len(expected)
    assert np.abs(ours[np.lexsort(ours.T)] - expected[np.lexsort(expected.T)]).max() < 1e-6


def test_points_far_from_zero_keep_their_place() -> None:
    far = np.array([[5e6, 4e6, 100.0], [5e6 + 0.01, 4e6, 100.0], [5e6 - 3.0, 4e6, 100.0]])
    cloud = VoxelCloud(0.05)
    cloud.add(far)
    assert cloud.points_m() == pytest.approx(np.array([far[2], far[:2].mean(axis=0)]), abs=1e-6)


def test_what_cannot_be_a_building_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = VoxelCloud(0.05)
    cloud.add(np.zeros((1, 3)))
    with pytest.raises(LimitExceeded, match="km apart"):
        cloud.add(np.full((1, 3), 1e5))
    monkeypatch.setattr(cloud_of_points, "MAX_VOXELS", 10)
    with pytest.raises(LimitExceeded, match="more than 10 voxels"):
        VoxelCloud(0.05).add(np.arange(60.0).reshape(-1, 3))
