"""Keyframes that wait in a file."""

import errno
import io

import numpy as np
import pytest

from pc2grid.clouds.planar_scan import PlanarScan, planar_normals
from pc2grid.errors import OutputError
from pc2grid.geometry import SE2, transform_points
from pc2grid.model import POINT_STEPS, PointMap, Scan, SensorKind
from pc2grid.settings import ProjectionConfig
from pc2grid.simulate import SimulationConfig, simulate_session
from signature.config import Config
from signature.session import keyframes as spool
from signature.session.build import build_map
from signature.session.keyframes import Keyframe, KeyframePoints, Keyframes
from tests.helpers.simulated_drives import office


def planar_scan(hits: int) -> PlanarScan:
    rng = np.random.default_rng(hits)
    hits_m, origin_m = rng.normal(size=(hits, 2)).astype(np.float32), rng.normal(size=2)
    return PlanarScan(
        stamp_ns=2**60 + hits,
        hits_m=hits_m,
        normal_rad=planar_normals(hits_m, origin_m),
        origin_m=origin_m,
        free_m=rng.random(8).astype(np.float32),
    )


@pytest.mark.parametrize("in_memory_bytes", [spool.IN_MEMORY_BYTES, 1])
def test_keyframes_come_back_as_they_were(monkeypatch: pytest.MonkeyPatch, in_memory_bytes: int) -> None:
    monkeypatch.setattr(spool, "IN_MEMORY_BYTES", in_memory_bytes)
    keyframes = Keyframes()
    kept = [Keyframe(3 * k, planar_scan(k), SE2(0.1 * k, 1.0, -0.2), k == 7) for k in range(20)]
    for k, keyframe in enumerate(kept):
        keyframes.append(keyframe)
        keyframes[k // 2]  # reading moves the file; the next goes to its end all the same
    for got, want in zip(keyframes, kept, strict=True):
        assert (got.index, got.T_session_base, got.restart) == (want.index, want.T_session_base, want.restart)
        for name in ("stamp_ns", "hits_m", "normal_rad", "origin_m", "free_m", "height_m"):
            assert np.array_equal(getattr(got.planar_scan, name), getattr(want.planar_scan, name))
    keyframes.close()


def test_a_full_disk_under_the_keyframes_is_an_output_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def write(self, data: object) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tempfile.SpooledTemporaryFile", lambda max_size: Full())
    with pytest.raises(OutputError, match="no room for the scans of the map: No space left") as caught:
        Keyframes().append(Keyframe(0, planar_scan(5), SE2()))
    assert "TMPDIR" in str(caught.value.hint)


# --- The points of keyframes become the points of a session at their final poses ---


CLOUD = np.random.default_rng(0).uniform(-6.0, 6.0, (500, 3)).astype(np.float32)


def scan(sensor: SensorKind = "lidar") -> Scan:
    return Scan(stamp_ns=0, points_m=CLOUD, T_base_sensor=np.eye(4), sensor=sensor)


def test_points_follow_the_final_poses_of_their_scans() -> None:
    points = KeyframePoints(0.01, 20.0)
    points.append(0, scan())
    points.append(3, scan())
    poses = np.stack([SE2(10.0 * k, 1.0, 0.5 * k).lift() for k in range(4)])
    both = points.registered(poses)
    assert both is not None
    found = both.points_m()
    wanted = np.concatenate([transform_points(poses[k], CLOUD) for k in (0, 3)])
    assert len(found) == len(wanted)
    assert np.linalg.norm(found[:, None] - wanted[None], axis=2).min(axis=1).max() < 0.003


def test_points_of_some_scans() -> None:
    points = KeyframePoints(0.01, 20.0)
    points.append(0, scan())
    points.append(1, scan())
    poses = np.stack([np.eye(4), SE2(100.0, 0.0, 0.0).lift()])
    second = points.registered(poses, np.array([False, True]))
    assert second is not None and second.points_m()[:, 0].min() > 90.0
    assert points.registered(poses, np.array([False, False])) is None


def test_a_camera_is_not_believed_as_far_as_a_lidar() -> None:
    """At 5 cm voxels up to 5.8 m, where the noise of a depth is as large."""
    points = KeyframePoints(0.05, 20.0)
    for k, sensor in enumerate(("depth", "lidar")):
        points.append(k, scan(sensor))
    near, all_ = (cloud for _, cloud in points)
    assert np.linalg.norm(near, axis=1).max() < 5.8 < np.linalg.norm(all_, axis=1).max()


def test_point_map_keeps_one_point_a_voxel_within_a_millimetre() -> None:
    points = PointMap.of(CLOUD, 0.05)
    assert len(points) == len(np.unique(np.floor((CLOUD - CLOUD.min(axis=0)) / 0.05), axis=0))
    away_m = np.linalg.norm(points.points_m()[:, None] - CLOUD[None], axis=2).min(axis=1)
    assert away_m.max() < 0.05 / POINT_STEPS  # a step of a voxel of 5 cm
    again = PointMap.of(points.points_m(), 0.05, points.origin_m)
    assert np.array_equal(again.steps, points.steps)
    assert len(PointMap.of(np.empty((0, 3)), 0.05)) == 0


def test_a_recording_keeps_its_points_by_default(tmp_path_factory: pytest.TempPathFactory) -> None:
    from pc2grid.io.recording import open_log

    log_file = tmp_path_factory.mktemp("points") / "lidar.mcap"
    drive = SimulationConfig.model_validate(
        {"length_m": 2.0, "seed": 4, "clutter": 0, "lidar": {"rate_hz": 4.0, "columns": 360}}
    )
    simulate_session(log_file, sensor="lidar", grid=office(), config=drive)
    without = Config(projection=ProjectionConfig(points_voxel_m=None))
    with open_log(log_file) as log:
        plain = build_map(log, without, session="a")
        kept = build_map(log, session="a")
    assert plain.points is None
    assert kept.points is not None and np.array_equal(plain.grid.cells, kept.grid.cells)
    points = kept.points.points_m()
    assert len(points) > 1000
    # Floor and ceiling are level and 2.5 m apart; walls stand where the grid has them.
    heights = np.sort(points[:, 2])
    assert heights[-50] - heights[50] == pytest.approx(2.5, abs=0.1)
    walls = points[(points[:, 2] > heights[50] + 0.5) & (points[:, 2] < heights[-50] - 0.5)]
    cells = kept.grid.to_cell(walls[:, :2])
    inside = ((cells >= 0) & (cells < kept.grid.cells.shape)).all(axis=1)
    import cv2

    near_wall = cv2.dilate(kept.grid.occupied.astype(np.uint8), np.ones((5, 5), np.uint8))
    assert near_wall[tuple(cells[inside].T)].mean() > 0.95
