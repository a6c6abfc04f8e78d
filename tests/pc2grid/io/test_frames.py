"""tf of every kind: moving, late, with two parents, in the place of odometry."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pc2grid.errors import FrameError, LogCorrupt, PointCloudError, TopicError
from pc2grid.geometry import F64, invert_pose, motion_size, pose_from_rotation_vector, quat_xyzw_from_pose
from pc2grid.io.frames import Attitude, FrameTree, PoseTrack
from pc2grid.io.messages.types import Header, Imu, Transform
from pc2grid.io.recording import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Dialect, Message, read, ros, write_mcap

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


# --- An IMU tells which way is up: by itself, and in a recording ---


G = 9.81
RATE_HZ = 100
TILTED = pose_from_rotation_vector((0.5, -0.3, 1.0))


def message(k: int, T: F64, *, shaken: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Imu:
    """The k-th message of an IMU with an attitude (4, 4) at rest, shaken by an acceleration of the room."""
    felt = T[:3, :3].T @ (np.array(shaken) + (0.0, 0.0, G))  # noqa: RUF005
    return Imu(Header(T0 + k * 10**9 // RATE_HZ, "imu"), None, (0.0, 0.0, 0.0), tuple(felt))


def off_deg(found: F64 | None, true: F64) -> float:
    """How far two attitudes (4, 4) disagree about what is up."""
    assert found is not None
    return math.degrees(math.acos(min(1.0, float(found[2, :3] @ true[2, :3]))))


@pytest.mark.parametrize("T", [np.eye(4), TILTED, pose_from_rotation_vector((math.pi, 0.0, 0.0))])
def test_an_imu_at_rest_knows_what_is_up_however_it_is_mounted(T: F64) -> None:
    attitude = Attitude()
    for k in range(20):
        attitude.add(message(k, T), T0 + k * 10**7)
    assert off_deg(attitude.at(T0 + 10**8), T) < 1e-6


def test_the_shaking_of_steps_cancels() -> None:
    """Two steps a second push by a quarter of gravity: a single message takes that for 14 degrees."""
    attitude, worst = Attitude(), 0.0
    for k in range(4 * RATE_HZ):
        push = 0.25 * G * math.cos(2.0 * math.pi * 2.0 * k / RATE_HZ)
        attitude.add(message(k, TILTED, shaken=(push, 0.0, 0.0)), T0 + k * 10**7)
        if k > RATE_HZ:
            worst = max(worst, off_deg(attitude.at(T0 + k * 10**7), TILTED))
    assert worst < 1.6  # of a first-order mean: 14 degrees / (2 pi 2 Hz 1 s) = 1.1, and half as much again


def test_turns_are_those_of_the_gyroscope() -> None:
    """Half a turn about an axis that is tilted: up stays known, and the angle is that of the gyroscope."""
    attitude, rate = Attitude(), np.array([0.4, 0.9, 0.2])
    poses = [TILTED @ pose_from_rotation_vector(rate * k / RATE_HZ) for k in range(300)]
    for k, T in enumerate(poses):
        attitude.add(replace(message(k, T), turn_rate_rps=tuple(rate)), T0 + k * 10**7)
    first, last = attitude.at(T0 + 10**9), attitude.at(T0 + 2 * 10**9)
    assert first is not None
    assert last is not None
    assert off_deg(last, poses[200]) < 0.1
    wrong = invert_pose(invert_pose(first) @ last) @ invert_pose(poses[100]) @ poses[200]
    assert motion_size(wrong)[1] < 1e-3


def test_what_says_nothing_of_gravity_is_not_used() -> None:
    falling, fast = Attitude(), Attitude()
    for k in range(50):
        falling.add(replace(message(k, TILTED), acceleration_mps2=(0.0, 0.0, 1.0)), T0 + k * 10**7)
        fast.add(message(k, TILTED, shaken=(0.0, 0.0, 8.0)), T0 + k * 10**7)
    assert falling.at(T0 + 10**8) is None  # such as one that counts in standard gravities
    assert fast.at(T0 + 10**8) is None


def test_an_orientation_stands_in_for_accelerations_that_are_not_measured() -> None:
    x, y, z, w = quat_xyzw_from_pose(TILTED).tolist()
    attitude, silent = Attitude(), Attitude()
    for k in range(5):
        known = replace(message(k, TILTED), orientation=(x, y, z, w), acceleration_mps2=None)
        attitude.add(known, T0 + k * 10**7)
        silent.add(replace(known, orientation=None), T0 + k * 10**7)
    assert off_deg(attitude.at(T0), TILTED) < 1e-6
    assert silent.at(T0) is None


# --- in a recording -------------------------------------------------------------------------------------


def recording(path: Path, *, mounted: bool = True, odometry: bool = False, dialect: Dialect = "ros2") -> Path:
    """A lidar and an IMU on a base; the IMU feels 9.81 m/s2 along its x axis."""
    to = ros(dialect)
    messages: list[Message] = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    if mounted:
        messages.append(to.tf(T0, "base_link", "imu", 0.1, topic="/tf_static"))
    for k in range(20):
        messages.append(to.cloud("/points", T0 + k * STEP, [[1.0, 2.0, 3.0]]))
        messages += [to.imu("/imu/data", T0 + k * STEP + j * STEP // 10, (G, 0.0, 0.0)) for j in range(10)]
        if odometry:
            messages.append(to.odometry("/odom", T0 + k * STEP, 0.1 * k))
    messages.sort(key=lambda m: m.log_time_ns)
    return write_mcap(path, messages, dialect)


@pytest.mark.parametrize("dialect", ["ros1", "ros2"])
def test_a_recording_without_odometry_is_read_with_its_imu(tmp_path: Path, dialect: Dialect) -> None:
    path = recording(tmp_path / "a.mcap", dialect=dialect)
    with open_log(path) as log:
        choice = log.choose()
    assert choice.imu_topic == "/imu/data"
    assert "gravity from /imu/data" in choice.reason
    scans, report = read(path)
    assert report.warnings == ()
    for scan in scans:
        assert scan.T_level_base is not None
        np.testing.assert_allclose(scan.T_level_base[2, :3], (1.0, 0.0, 0.0), atol=1e-9)
    assert all(scan.T_level_base is None for scan in read(path, ReadConfig(imu="none"))[0])


def test_an_imu_is_not_read_beside_odometry_unless_it_is_named(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", odometry=True)
    assert all(scan.T_level_base is None for scan in read(path)[0])
    assert all(scan.T_level_base is not None for scan in read(path, ReadConfig(imu="/imu/data"))[0])


def test_an_imu_whose_place_is_not_known_is_not_used(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", mounted=False)
    with open_log(path) as log:
        choice = log.choose()
    assert choice.imu_topic is None
    assert "/imu/data is not used: tf does not connect frame imu to base_link" in choice.reason
    with pytest.raises(FrameError, match="imu"):
        read(path, ReadConfig(imu="/imu/data"))
    with pytest.raises(TopicError, match=r"no imu topic /imu; there is: /imu/data"):
        read(path, ReadConfig(imu="/imu"))


def test_an_imu_that_cannot_be_decoded_costs_nothing_but_gravity(tmp_path: Path) -> None:
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    messages += [to.cloud("/points", T0 + k * STEP, [[1.0, 2.0, 3.0]]) for k in range(5)]
    messages += [Message("/imu/data", "sensor_msgs/Imu", T0 + k * STEP, b"\0\1\0\0") for k in range(5)]
    scans, _ = read(write_mcap(tmp_path / "a.mcap", messages))
    assert [scan.T_level_base for scan in scans] == [None] * 5


# --- Clouds that are registered already, and robots without a base_link ---


SEEN = np.float32([[2.0, 1.0, 0.4], [3.0, -1.0, 0.1], [2.5, 0.5, -0.7], [1.0, 0.0, -0.7]])
"""Points in the frame of a lidar that stands 0.7 m above the floor."""
MOUNT_M = 0.7


def registered(
    frame: str = "odom", *, tf: bool = True, odometry: bool = False, mount: bool = True
) -> list[Message]:
    """A robot that moves 0.1 m a scan, whose driver publishes the points in a fixed frame."""
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar_top", 0.0, z_m=MOUNT_M, topic="/tf_static")] if mount else []
    for i in range(5):
        stamp, x_m = T0 + i * STEP, 5.0 + 0.1 * i
        messages.append(to.cloud("/registered", stamp, SEEN + np.float32([x_m, 0.0, MOUNT_M]), frame=frame))
        if tf:
            messages.append(to.tf(stamp, frame, "base_link", x_m))
        if odometry:
            messages.append(to.odometry("/odom", stamp, x_m))
    return messages


@pytest.mark.parametrize("odometry", [False, True])
def test_points_in_a_fixed_frame_are_taken_back_to_the_sensor(odometry: bool, tmp_path: Path) -> None:
    scans, report = read(write_mcap(tmp_path / "a.mcap", registered(odometry=odometry)))
    assert len(scans) == 5 and not report.lossy
    for i, scan in enumerate(scans):
        np.testing.assert_allclose(scan.points_m, SEEN + np.float32([0.0, 0.0, MOUNT_M]), atol=1e-5)
        np.testing.assert_allclose(scan.T_base_sensor[:3, 3], (0.0, 0.0, MOUNT_M))
        assert scan.T_odom_base is not None
        assert scan.T_odom_base[0, 3] == pytest.approx(5.0 + 0.1 * i)


def test_a_fixed_frame_of_any_name_is_found_above_the_base(tmp_path: Path) -> None:
    (scan, *_), _ = read(write_mcap(tmp_path / "a.mcap", registered("lio_start")))
    np.testing.assert_allclose(scan.T_base_sensor[:3, 3], (0.0, 0.0, MOUNT_M))


@pytest.mark.parametrize(
    "messages",
    [
        registered(tf=False),
        registered(tf=False, odometry=True),
        registered(tf=False, mount=False),
        registered(mount=False),  # the base stands on the floor, so it cannot be where the sensor is
        [ros().tf(T0, "odom", "base_link", 1.0), ros().laser("/scan", T0, [2.0, 2.0], frame="odom")],
    ],
    ids=["no tf to the base", "odometry alone", "no tf", "no sensor", "a laser"],
)
def test_what_cannot_be_taken_back_is_refused(messages: list[Message], tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="registered already, in the fixed frame odom") as error:
        read(write_mcap(tmp_path / "a.mcap", messages))
    assert "--topic" in str(error.value.hint)


def test_a_first_cloud_without_points_decides_nothing(tmp_path: Path) -> None:
    mount, _, *rest = registered()
    empty = ros().cloud("/registered", T0, np.empty((0, 3)), frame="odom")
    scans, _ = read(write_mcap(tmp_path / "a.mcap", [mount, empty, *rest]))
    assert len(scans) == 5
    path = write_mcap(tmp_path / "b.mcap", [empty, *rest])
    with pytest.raises(FrameError, match="registered already"):
        read(path)


def test_a_sensor_whose_own_frame_is_merely_named_like_a_fixed_one(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", registered("map", tf=False, mount=False))
    (scan, *_), _ = read(path, ReadConfig(assume_identity=True))
    assert scan.T_base_sensor.tolist() == np.eye(4).tolist()


def test_the_root_of_the_only_static_tree_is_the_base(tmp_path: Path) -> None:
    to = ros()
    messages = [
        to.tf(T0, "chassis", "mast", 0.1, topic="/tf_static"),
        to.tf(T0, "mast", "lidar", 0.2, topic="/tf_static"),
        *(to.cloud("/points", T0 + i * STEP, SEEN) for i in range(3)),
        *(to.tf(T0 + i * STEP, "odom", "chassis", 0.1 * i) for i in range(3)),
    ]
    path = write_mcap(tmp_path / "a.mcap", sorted(messages, key=lambda m: m.log_time_ns))
    scans, report = read(path)
    assert scans[2].T_base_sensor[0, 3] == pytest.approx(0.3)
    assert scans[2].T_odom_base is not None and scans[2].T_odom_base[0, 3] == pytest.approx(0.2)
    assert any("tf has no base_link: chassis, the root" in warning for warning in report.warnings)
    with open_log(path) as log:
        assert log.choose().base_frame == "chassis"


def test_of_several_static_trees_none_is_the_robot_s(tmp_path: Path) -> None:
    to = ros()
    messages = [
        to.tf(T0, "chassis", "lidar", 0.1, topic="/tf_static"),
        to.tf(T0, "arm", "camera", 0.2, topic="/tf_static"),
        to.cloud("/points", T0, SEEN),
    ]
    with pytest.raises(FrameError, match="tf does not connect frame lidar to the base"):
        read(write_mcap(tmp_path / "a.mcap", messages))


@pytest.mark.fault(36)
def test_tf_that_goes_in_a_circle_is_refused(tmp_path: Path) -> None:
    there, back = (("base_link", "lidar"), ("lidar", "base_link"))
    edges = [ros().tf(T0, *edge, 0.2, topic="/tf_static") for edge in (there, back)]
    with pytest.raises(FrameError, match="tf goes in a circle"):
        read(write_mcap(tmp_path / "a.mcap", [*edges, *clouds(1)]))


def moved(message: Message, old: float, new: float) -> Message:
    """The message with one of its numbers replaced."""
    before = struct.pack("<d", old)
    assert before in message.data
    return message._replace(data=message.data.replace(before, struct.pack("<d", new), 1))


ABSURD = [1e300, -1e300, 1e39, 1.1e8, float("nan"), float("inf")]
NOWHERE = [*((0.25, value) for value in ABSURD), *((1.0, w) for w in (0.0, 1e-200, 1e200, float("nan")))]


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
@pytest.mark.parametrize(("old", "new"), NOWHERE)
def test_a_mount_that_is_nowhere_or_turned_nowhere_is_refused_by_name(
    tmp_path: Path, old: float, new: float, topic: str
) -> None:
    """x of a transform, or w of its quaternion."""
    to = ros()
    mount = moved(to.tf(T0, "base_link", "lidar", 0.25, topic=topic), old, new)
    path = write_mcap(tmp_path / "a.mcap", [mount, to.cloud("/points", T0, [[1, 2, 3]])])
    with pytest.raises(FrameError, match=r"a transform base_link -> lidar of the log makes no sense"):
        read(path)
    scans, report = read(path, ReadConfig(assume_identity=True))
    assert scans[0].points_m.tolist() == [[1, 2, 3]]
    assert any("base_link -> lidar" in warning for warning in report.warnings)


def test_a_chain_of_very_many_frames() -> None:
    links = [
        Transform(Header(T0, f"f{i}"), f"f{i + 1}", (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for i in range(1_100)
    ]
    tree = FrameTree()
    tree.add_all(tuple(links), static=True)
    tree.add_all(tuple(links[990:]), static=True)
    assert len(tree.frames) == 1_001
    assert any("more than 1000 frames" in w for w in tree.warnings)
    assert len(tree.chain("f1000")) == 1_001
    tree.add(Transform(Header(T0, "f900"), "f0", links[0].pose), static=True)
    assert len(tree.chain("f1000")) == 1_001  # f0 had no parent before, and there is no room for it
    tree.add(Transform(Header(T0, "f900"), "f1", links[0].pose), static=True)
    with pytest.raises(FrameError, match=r"tf goes in a circle: .* -> f1 -> f900$"):
        tree.chain("f1000")


def test_an_unreadable_tf_message_is_not_taken_for_no_tf(tmp_path: Path) -> None:
    to = ros()
    mount = to.tf(T0, "base_link", "lidar", 0.25, topic="/tf_static")
    cloud = to.cloud("/points", T0, [[1, 2, 3]])
    path = write_mcap(tmp_path / "a.mcap", [mount._replace(data=mount.data[:-20]), cloud])
    with pytest.raises(FrameError, match="some tf messages are unreadable"):
        read(path)
    scans, report = read(write_mcap(tmp_path / "b.mcap", [cloud]))
    assert len(scans) == 1
    assert any("the log has no tf" in warning for warning in report.warnings)


@pytest.mark.parametrize("value", ABSURD)
def test_odometry_that_is_nowhere_on_earth_is_ignored_and_said(tmp_path: Path, value: float) -> None:
    to = ros()
    messages = []
    for i in range(12):
        odometry = to.odometry("/odom", T0 + i * STEP, 0.25 + i)
        messages.append(moved(odometry, 5.25, value) if i == 5 else odometry)
        messages.append(to.cloud("/points", T0 + i * STEP, [[1, 2, 3]]))
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    found = [scan.T_odom_base[0, 3] for scan in scans if scan.T_odom_base is not None]
    assert found == pytest.approx([0.25 + i for i in range(12)])  # between its neighbours
    assert any("odometry messages are unreadable or not finite" in w for w in report.warnings)


def test_odometry_of_a_frame_that_moves_on_the_base(tmp_path: Path) -> None:
    to = ros()
    messages = [to.tf(T0, "base_link", "lidar", 0.2, topic="/tf_static")]
    for i in range(12):
        stamp = T0 + i * STEP
        messages.append(to.tf(stamp, "base_link", "arm", 0.1 * i))
        messages.append(to.odometry("/odom", stamp, 0.1 * i, child="arm"))
        messages.append(to.cloud("/points", stamp, [[1, 2, 3]]))
    scans, report = read(write_mcap(tmp_path / "a.mcap", messages))
    assert len(scans) == 12
    assert any("the odometry is of frame arm, which is taken for base_link" in w for w in report.warnings)


def test_a_track_forgets_what_is_long_gone() -> None:
    track = PoseTrack()
    for i in range(50_000):
        assert track.add(i * STEP, (0.1 * i, 0, 0, 0, 0, 0, 1))
    assert len(track) <= 40_000
    assert track.at(0) is None
    last = track.at(49_999 * STEP)
    assert last is not None
    assert last[0, 3] == pytest.approx(4999.9)
