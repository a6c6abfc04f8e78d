"""Clouds and meshes read as points, block by block."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pc2grid.arrays import F64
from pc2grid.config import ReadConfig
from pc2grid.errors import MapFileError
from pc2grid.io import building_file
from pc2grid.io.building_file import building_points, digest_of_building, is_building_file, kind_of
from pc2grid.io.export.cloud import write_cloud

CLOUD = np.random.default_rng(0).uniform(-5, 5, (1000, 3)).astype(np.float32)


def points(path: Path, **config: object) -> F64:
    return np.concatenate([np.empty((0, 3)), *building_points(path, ReadConfig.model_validate(config))])


def square(path: Path) -> Path:
    """A mesh of 2 m x 1 m."""
    corners = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\n"
    path.write_text(corners + "f 1 2 3\nf 1 3 4\n")
    return path


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_blocks_are_the_whole(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building_file, "_BLOCK_POINTS", 300)
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, CLOUD)
    blocks = list(building_points(path, ReadConfig()))
    assert [len(block) for block in blocks] == [300, 300, 300, 100]
    assert np.array_equal(np.concatenate(blocks), CLOUD)
    assert kind_of(path) == "cloud"


@pytest.mark.parametrize("suffix", [".xyz", ".pts"])
def test_text_is_read(tmp_path: Path, suffix: str) -> None:
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(CLOUD.astype(float)))
    path = tmp_path / f"cloud{suffix}"
    o3d.io.write_point_cloud(str(path), cloud)
    assert points(path) == pytest.approx(CLOUD, abs=1e-5)


def test_mesh_is_sampled_evenly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = square(tmp_path / "square.obj")
    monkeypatch.setattr(building_file, "_BLOCK_POINTS", 500)
    found = points(path)
    assert kind_of(path) == "mesh" and len(found) == 2 * 1600
    counts, *_ = np.histogram2d(found[:, 0], found[:, 1], bins=(4, 2), range=((0, 2), (0, 1)))
    assert counts.min() > 320 and counts.sum() == len(found)
    assert np.array_equal(found, points(path))


def test_units_and_the_axis_that_points_up(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    write_cloud(path, CLOUD)
    assert points(path, unit_m=0.001) == pytest.approx(CLOUD * 0.001)
    for up, axis in (("x", 0), ("y", 1)):
        turned = points(path, up=up)
        assert turned[:, 2] == pytest.approx(CLOUD[:, axis])
        # A rotation keeps the hand of the axes.
        R = np.linalg.lstsq(CLOUD.astype(float), turned, rcond=None)[0].T
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_local_maps_of_kiss_slam_are_one_cloud(tmp_path: Path) -> None:
    plys = tmp_path / "latest" / "local_maps" / "plys"
    plys.mkdir(parents=True)
    write_cloud(plys / "000000.ply", CLOUD[:400])
    write_cloud(plys / "000001.ply", CLOUD[400:])
    assert is_building_file(tmp_path / "latest") and not is_building_file(tmp_path)
    assert np.array_equal(points(tmp_path / "latest"), CLOUD)
    assert len(digest_of_building(tmp_path / "latest")) == 64


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(MapFileError, match=r"gone\.ply: no such file"):
        points(tmp_path / "gone.ply")
    with pytest.raises(MapFileError, match="not a building"):
        points(tmp_path / "notes.txt")
    (tmp_path / "empty.ply").touch()
    with pytest.raises(MapFileError, match=r"empty\.ply: empty file"):
        points(tmp_path / "empty.ply")
    write_cloud(tmp_path / "cut.pcd", CLOUD)
    data = (tmp_path / "cut.pcd").read_bytes()
    (tmp_path / "cut.pcd").write_bytes(data[:-100])
    with pytest.raises(MapFileError, match=r"cut\.pcd: ends in the middle"):
        points(tmp_path / "cut.pcd")
    (tmp_path / "odd.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(MapFileError, match=r"odd\.ply: a PLY without a header"):
        points(tmp_path / "odd.ply")
    (tmp_path / "no.obj").write_text("v 0 0 0\n")
    with pytest.raises(MapFileError, match="neither points nor triangles"):
        points(tmp_path / "no.obj")
