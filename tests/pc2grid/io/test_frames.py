"""tf of every kind: moving, late, with two parents, in the place of odometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pc2grid.errors import FrameError, LogCorrupt, PointCloudError
from pc2grid.io import open_log
from pc2grid.io.frames import PoseTrack
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap

POINT = [[1.0, 2.0, 3.0]]


def clouds(count: int, frame: str = "lidar") -> list[Message]:
    return [ros().cloud("/points", T0 + i * STEP, POINT, frame) for i in range(count)]


def by_time(*groups: list[Message]) -> list[Message]:
    return sorted((m for group in groups for m in group), key=lambda m: m.log_time_ns)


def test_odometry_from_tf_where_no_odometry_topic_is(tmp_path: Path) -> None:
    to = ros()
    mount = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    # tf at twice the rate, half a step off: every pose has to be interpolated, 1 m per scan.
    moving = [to.tf(T0 + (2 * i - 1) * STEP // 4, "odom", "base_link", 0.5 * i - 0.25) for i in range(30)]
    path = write_mcap(tmp_path / "a.mcap", by_time(mount, clouds(10), moving))
    with open_log(path) as log:
        choice = log.choose()
        scans = list(log.scans())
    assert choice.odometry_topic == "/tf"
    assert "odometry from tf, odom -> base_link" in choice.reason
    poses = [s.T_odom_base for s in scans]
    assert all(p is not None for p in poses)
    np.testing.assert_allclose([p[0, 3] for p in poses if p is not None], np.arange(10.0), atol=1e-9)
    assert all(s.T_odom_base is None for s in read(path, ReadConfig(odometry="none"))[0])


def test_a_moving_mount_is_interpolated_at_the_stamp(tmp_path: Path) -> None:
    to = ros()
    lift = [to.tf(T0 + i * STEP - STEP // 2, "base_link", "lidar", 0.1 * i) for i in range(11)]
    path = write_mcap(tmp_path / "a.mcap", by_time(clouds(10), lift))
    scans, _ = read(path)
    found = [s.T_base_sensor[0, 3] for s in scans]
    np.testing.assert_allclose(found, 0.1 * np.arange(10) + 0.05, atol=1e-9)
    np.testing.assert_allclose([s.points_m[0, 0] for s in scans], np.array(found) + 1.0, atol=1e-6)


def test_tf_recorded_later_than_the_scans_it_is_for(tmp_path: Path) -> None:
    to = ros()
    lift = [to.tf(T0 + i * STEP, "base_link", "lidar", 0.1 * i, late_ns=3 * STEP) for i in range(10)]
    path = write_mcap(tmp_path / "a.mcap", by_time(clouds(10), lift))
    scans, report = read(path)
    assert len(scans) == 10
    assert not report.lossy
    np.testing.assert_allclose([s.T_base_sensor[0, 3] for s in scans], 0.1 * np.arange(10), atol=1e-9)


def test_a_static_tf_that_comes_after_the_first_scans(tmp_path: Path) -> None:
    static = ros().tf(T0 + 5 * STEP, "base_link", "lidar", 0.3, topic="/tf_static")
    scans, report = read(write_mcap(tmp_path / "a.mcap", [*clouds(5), static]))
    assert [s.T_base_sensor[0, 3] for s in scans] == [0.3] * 5
    assert not report.lossy


def test_a_moving_tf_that_ends_early_costs_the_scans_behind_it(tmp_path: Path) -> None:
    lift = [ros().tf(T0 + i * STEP, "base_link", "lidar", 0.1 * i) for i in range(19)]
    scans, report = read(write_mcap(tmp_path / "a.mcap", by_time(clouds(21), lift)))
    assert len(scans) == 20  # the sample counts for 0.1 s
    assert report.scans_skipped == {"tf is unknown at the stamp": 1}
    with pytest.raises(LogCorrupt, match="5 of 25 scans are unreadable: tf is unknown"):
        read(write_mcap(tmp_path / "b.mcap", by_time(clouds(25), lift)))


def test_a_frame_that_changes_within_the_log(tmp_path: Path) -> None:
    static = ros().tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")
    last = ros().cloud("/points", T0 + 9 * STEP, POINT, "lidar_2")
    with pytest.raises(FrameError, match=r"frame lidar_2 to base_link; did the driver mean lidar\?"):
        read(write_mcap(tmp_path / "a.mcap", [static, *clouds(5), last]))


def test_the_base_named_by_the_user_and_namespaced_frames(tmp_path: Path) -> None:
    to = ros()
    edges = [
        to.tf(T0, "robot1/base_link", "lidar", 0.2, topic="/tf_static"),
        to.tf(T0, "robot1/base_link", "imu", -0.3, topic="/tf_static"),
    ]
    path = write_mcap(tmp_path / "a.mcap", [*edges, *clouds(1)])
    assert read(path)[0][0].T_base_sensor[0, 3] == 0.2
    np.testing.assert_allclose(read(path, ReadConfig(base_frame="imu"))[0][0].T_base_sensor[0, 3], 0.5)
    with pytest.raises(FrameError, match="imu_link"):
        read(path, ReadConfig(base_frame="imu_link"))


def test_impossible_transforms_are_ignored_and_reported(tmp_path: Path) -> None:
    to = ros()
    good = to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")
    bad = to.tf(T0, "base_link", "lidar", float("nan"), topic="/tf_static")
    far = to.tf(T0, "base_link", "lidar", 0.7, topic="/tf_static")
    w = np.float64(1.0).tobytes()
    far = far._replace(data=far.data.replace(w, np.float64(1e200).tobytes()))
    own = to.tf(T0, "lidar", "lidar", 1.0, topic="/tf_static")
    scans, report = read(write_mcap(tmp_path / "a.mcap", [good, bad, far, own, *clouds(1)]))
    assert scans[0].T_base_sensor[0, 3] == 0.2
    assert sum("makes no sense" in w for w in report.warnings) == 2


def test_odometry_of_another_child_is_moved_to_the_base(tmp_path: Path) -> None:
    to = ros()
    edges = [
        to.tf(T0, "base_footprint", "base_link", 0.25, topic="/tf_static"),
        to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static"),
    ]
    odometry = [to.odometry("/odom", T0 + i * STEP, 1.0 * i, "base_footprint") for i in range(4)]
    scans, _ = read(write_mcap(tmp_path / "a.mcap", [*edges, *by_time(odometry, clouds(4))]))
    found = [s.T_odom_base[0, 3] for s in scans if s.T_odom_base is not None]
    np.testing.assert_allclose(found, [0.25, 1.25, 2.25, 3.25])


def test_a_scan_of_which_all_tf_is_unknown_is_no_scan(tmp_path: Path) -> None:
    late = ros().tf(T0 + 50 * STEP, "base_link", "lidar", 0.1)
    with pytest.raises(PointCloudError, match="3 of 3 scans are unreadable: tf is unknown"):
        read(write_mcap(tmp_path / "a.mcap", [*clouds(3), late]))


def where(samples: dict[int, float], lasting: bool, at: int) -> float | None:
    """A track by its definition: at a sample, between two near ones, held, or near one."""
    if at in samples:
        return samples[at]
    before = max((s for s in samples if s < at), default=None)
    after = min((s for s in samples if s > at), default=None)
    if before is not None and after is not None and after - before <= 2 * 10**9:
        return samples[before] + (samples[after] - samples[before]) * (at - before) / (after - before)
    if lasting and before is not None:
        return samples[before]
    if lasting and len(samples) == 1:
        return samples[after or 0]
    near = [s for s in (before, after) if s is not None and abs(s - at) <= 10**8]
    return samples[near[0]] if near else None


@settings(max_examples=100, deadline=None)
@given(
    samples=st.dictionaries(st.integers(0, 80), st.integers(-9, 9).map(float), max_size=6),
    lasting=st.booleans(),
    at=st.integers(-10, 90),
    unit=st.sampled_from([10**7, 5 * 10**7, 10**9]),
)
def test_a_track_agrees_with_the_oracle(samples: dict[int, float], lasting: bool, at: int, unit: int) -> None:
    """In whatever order the samples come; the first of a stamp counts."""
    track = PoseTrack(lasting=True) if lasting else PoseTrack()
    for stamp, x in samples.items():
        assert track.add(stamp * unit, (x, 0, 0, 0, 0, 0, 1))
        assert track.add(stamp * unit, (x + 1, 0, 0, 0, 0, 0, 1))
    expected = where({stamp * unit: x for stamp, x in samples.items()}, lasting, at * unit)
    found = track.at(at * unit)
    if expected is None:
        assert found is None
    else:
        assert found is not None
        assert found[0, 3] == pytest.approx(expected)
