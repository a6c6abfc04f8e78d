"""Several robots in one recording: only what belongs to the robot of the chosen scans is used."""

from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import LogError, NoScans, TopicError
from pc2grid.io.live.live_log import open_live
from pc2grid.io.recording import open_log
from pc2grid.io.source import Choice
from pc2grid.model import Scan
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap


def robot(
    k: int,
    *,
    space: str = "",
    prefix: str = "",
    suffix: str = "",
    shared_tf: bool = False,
    odometry: str = "odom",
    tf_odometry: bool = False,
    static: bool = True,
    scans: str = "scan",
    child: str | None = None,
) -> list[Message]:
    """Robot k: its laser sits k/10 m ahead of its base, which moves k/10 m a scan.

    space, prefix, suffix : before the names of its topics, before and after those of its frames.
    odometry : name of its topic; empty: none.
    """
    to, tf = ros(), "" if shared_tf else space
    base = f"{prefix}base_link{suffix}"
    found = []
    if static:
        mount = to.tf(T0, base, f"{prefix}laser_link{suffix}", 0.1 * k, topic=f"{tf}/tf_static")
        found.append(mount)
    for i in range(5):
        stamp = T0 + i * STEP
        if odometry:
            topic = odometry if odometry.startswith("/") else f"{space}/{odometry}"
            found.append(to.odometry(topic, stamp, 0.1 * k * i, child or base))
        if tf_odometry:
            found.append(to.tf(stamp, f"{prefix}odom{suffix}", base, 0.1 * k * i, topic=f"{tf}/tf"))
        if scans:
            found.append(to.laser(f"{space}/{scans}", stamp, [2.0, 2.0, 2.0], f"{prefix}laser_link{suffix}"))
    return found


def written(folder: Path, *robots: list[Message]) -> Path:
    messages = sorted((m for robot in robots for m in robot), key=lambda m: m.log_time_ns)
    return write_mcap(folder / "a.mcap", messages)


def check(path: Path, topic: str | None, k: int, *, odometry: bool = True, live: bool = False) -> Choice:
    """Read the scans of robot k, if `live` also as they arrive, and compare places and odometry."""
    config = ReadConfig(topic=topic)

    def check_scan(i: int, scan: Scan) -> None:
        assert scan.T_base_sensor[0, 3] == pytest.approx(0.1 * k)
        assert (scan.T_odom_base is not None) == odometry
        if scan.T_odom_base is not None:
            assert scan.T_odom_base[0, 3] == pytest.approx(0.1 * k * i)

    with open_log(path, config) as log:
        for i, scan in enumerate(log.scans()):
            check_scan(i, scan)
        choice = log.choose()
    if live:
        with open_live(str(path), config) as running:
            for i, scan in enumerate(running.scans()):
                check_scan(i, scan)
            assert running.choose() == choice
    return choice


def fleet(space: str, prefix: str, **options: object) -> list[list[Message]]:
    """Three robots; {} in the names is the number of each."""
    return [robot(k, space=space.format(k), prefix=prefix.format(k), **options) for k in (1, 2, 3)]  # type: ignore[arg-type]


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize(
    "robots",
    [
        fleet("/robot{}", ""),
        fleet("/robot{}", "", tf_odometry=True),
        fleet("/robot{}", "", tf_odometry=True, odometry=""),
        fleet("/fleet/robot{}", ""),
        fleet("/robot{}", "robot{}/", shared_tf=True),
        fleet("/robot{}", "robot{}/", shared_tf=True, tf_odometry=True),
        fleet("/robot{}", "robot{}/", shared_tf=True, tf_odometry=True, odometry=""),
        fleet("/robot{}", "robot{}_", shared_tf=True),
        fleet("/robot{}", "robot{}_", shared_tf=True, tf_odometry=True, odometry=""),
        fleet("/robot{}", "robot{}/", shared_tf=True, child="base_link"),
        fleet("/robot{}", "robot{}/"),
    ],
)
def test_each_robot_is_read_by_itself(tmp_path: Path, robots: list[list[Message]], k: int) -> None:
    space = robots[k - 1][-1].topic.rpartition("/")[0]
    check(written(tmp_path, *robots), f"{space}/scan", k, live=k == 2)


def test_odometry_in_one_namespace_is_told_apart_by_its_frames(tmp_path: Path) -> None:
    robots = [
        robot(k, space=f"/robot{k}", prefix=f"robot{k}/", shared_tf=True, odometry=f"/odom{k}")
        for k in (1, 2)
    ]
    path = written(tmp_path, *robots)
    assert check(path, "/robot1/scan", 1).odometry_topic == "/odom1"
    assert check(path, "/robot2/scan", 2).odometry_topic == "/odom2"


def test_robots_whose_frames_have_numbers_are_told_apart_by_what_tf_connects(tmp_path: Path) -> None:
    def numbered(k: int, **options: object) -> list[Message]:
        return robot(k, suffix=f"_{k}", odometry=f"odom{k}", scans=f"scan{k}", tf_odometry=True, **options)  # type: ignore[arg-type]

    maps = [ros().tf(T0, "map", f"odom_{k}", 1.0, topic="/tf_static") for k in (1, 2)]
    for path in (written(tmp_path, above, numbered(1), numbered(2)) for above in ([], maps)):
        for k in (1, 2):
            assert check(path, f"/scan{k}", k).base_frame == f"base_link_{k}"
            assert check(path, f"/scan{k}", k).odometry_topic == f"/odom{k}"


def test_a_map_above_both_robots_connects_them_and_nothing_more(tmp_path: Path) -> None:
    robots = fleet("/robot{}", "robot{}/", shared_tf=True, tf_odometry=True)
    maps = [ros().tf(T0, "map", f"robot{k}/odom", 1.0, topic="/tf_static") for k in (1, 2, 3)]
    path = written(tmp_path, maps, *robots)
    for k in (1, 2, 3):
        assert check(path, f"/robot{k}/scan", k).base_frame == f"robot{k}/base_link"


def test_a_robot_without_a_namespace_beside_one_with(tmp_path: Path) -> None:
    path = written(tmp_path, robot(1), robot(2, space="/robot2"))
    check(path, "/scan", 1)
    check(path, "/robot2/scan", 2)


def test_odometry_of_another_robot_is_not_taken(tmp_path: Path) -> None:
    robots = [robot(1, space="/robot1", odometry=""), robot(2, space="/robot2")]
    path = written(tmp_path, *robots)
    choice = check(path, "/robot1/scan", 1, odometry=False)
    assert "no odometry topic (also there: /robot2/odom" in choice.reason
    prefixed = [
        robot(1, space="/robot1", prefix="robot1/", shared_tf=True, odometry=""),
        robot(2, space="/robot2", prefix="robot2/", shared_tf=True, odometry="/odom"),
    ]
    check(written(tmp_path, *prefixed), "/robot1/scan", 1, odometry=False)


def test_only_one_robot_s_scans_were_recorded(tmp_path: Path) -> None:
    path = written(tmp_path, robot(1, space="/robot1", scans=""), robot(2, space="/robot2"))
    assert check(path, None, 2).odometry_topic == "/robot2/odom"


@pytest.mark.parametrize(
    "messages",
    [
        robot(1, space="/robot1"),
        robot(1, space="/robot1", tf_odometry=True, odometry=""),
        robot(1, space="/fleet/robot1"),
        robot(1, space="/robot1", shared_tf=True),
        robot(1, space="/robot1", odometry="/odom"),
        robot(1, odometry="robot1/odom"),
        robot(1, scans="camera/front/scan"),
        robot(1, space="/robot1", scans="lidar/scan", odometry="ekf/odom"),
        robot(1, space="/robot1", prefix="robot1/", shared_tf=True),
        robot(1, odometry="/controller/odom", shared_tf=True, space="/laser"),
    ],
)
def test_one_robot_alone_may_name_its_topics_as_it_likes(tmp_path: Path, messages: list[Message]) -> None:
    path = written(tmp_path, messages)
    check(path, None, 1)
    assert not read(path)[1].warnings


def test_robots_of_one_make_may_share_what_their_transforms_say(tmp_path: Path) -> None:
    path = written(tmp_path, *(robot(1, space=f"/robot{k}", shared_tf=True) for k in (1, 2)))
    assert check(path, "/robot2/scan", 1).odometry_topic == "/robot2/odom"


def test_the_nearest_odometry_is_taken_and_said(tmp_path: Path) -> None:
    path = written(tmp_path, robot(1), robot(1, odometry="filtered/odometry", scans="", static=False))
    words = "odometry from /odom (also there: /filtered/odometry; --odometry chooses)"
    assert words in check(path, None, 1).reason
    assert words in read(path)[1].warnings


def two(*, of: int = 0, **options: object) -> list[list[Message]]:
    """Two robots with the same options. of : the number that both have."""
    return [robot(of or k, space=f"/robot{k}", **options) for k in (1, 2)]  # type: ignore[arg-type]


ONE, TWO = "/robot1/scan", "/robot2/scan"
ODOMETRY_OF, TF_OF = "odometry is of the robot of", "transforms are of the robot"


@pytest.mark.fault(15)
@pytest.mark.parametrize(
    ("robots", "topic", "words", "hint"),
    [
        (fleet("/robot{}", ""), None, "several topics hold scans", f"--topic {ONE}"),
        (fleet("/robot{}", ""), f"{ONE},{TWO}", "of two robots", f"--topic {ONE}"),
        (fleet("/robot{}", "robot{}/", shared_tf=True), f"{ONE},{TWO}", "of two robots", "--topic"),
        ([robot(1, space="/robot1", odometry="/odom"), robot(2, space="/robot2", odometry="")],
         TWO, f"{ODOMETRY_OF} {TWO}: /odom", "--odometry none"),
        ([robot(1, space="/robot1", static=False, odometry=""), robot(2, space="/robot2", static=False)],
         ONE, f"{ODOMETRY_OF} {ONE}: /robot2/odom", "--odometry /robot2/odom"),
        (two(of=1, odometry="", tf_odometry=True, shared_tf=True),
         ONE, f"{ODOMETRY_OF} {ONE}: /tf", "--odometry none"),
        (two(of=1, odometry="/odom", shared_tf=True), ONE, f"{ODOMETRY_OF} {ONE}: /odom", "--odometry none"),
        (fleet("/robot{}", "", shared_tf=True),
         ONE, "frame laser_link in two places", "--odometry none --set read.base_frame=laser_link"),
        ([robot(1, static=False), robot(2, space="/robot2")],
         "/scan", f"{TF_OF} of /scan: /robot2/tf_static", "assume_identity"),
        ([*two(), robot(3, static=False, scans="laser/scan")], "/laser/scan", TF_OF, "assume_identity"),
    ],
)  # fmt: skip
def test_what_cannot_be_told_is_refused_with_the_choice(
    tmp_path: Path, robots: list[list[Message]], topic: str | None, words: str, hint: str
) -> None:
    with pytest.raises(LogError, match=words) as error:
        read(written(tmp_path, *robots), ReadConfig(topic=topic))
    assert isinstance(error.value, TopicError)
    assert hint in str(error.value.hint)


# --- cameras, gravity, and other sensors of one robot ------------------------------------------------


def camera(k: int, space: str, *, info: bool = True) -> list[Message]:
    """A depth camera with focal length 10 k."""
    to = ros()
    found = [to.tf(T0, "base_link", "optical", 0.1 * k, topic=f"{space}/tf_static")]
    for i in range(3):
        stamp = T0 + i * STEP
        if info:
            found.append(to.camera(f"{space}/camera/depth/camera_info", stamp, 8, 6, 10.0 * k))
        pixels = np.full((6, 8), 1000, np.uint16)
        found.append(to.image(f"{space}/camera/depth/image_raw", stamp, pixels, "16UC1", "optical"))
    return found


def test_a_camera_has_the_calibration_of_its_robot(tmp_path: Path) -> None:
    both = written(tmp_path, camera(1, "/robot1"), camera(2, "/robot2"))
    for k in (1, 2):
        scan = read(both, ReadConfig(topic=f"/robot{k}/camera/depth/image_raw", depth_stride=1))[0][0]
        assert np.ptp(scan.points_m[:, 0]) == pytest.approx(0.7 / k, abs=1e-3)
    one = written(tmp_path, camera(1, "/robot1", info=False), camera(2, "/robot2"))
    with pytest.raises(NoScans, match="a depth image without a CameraInfo"):
        read(one, ReadConfig(topic="/robot1/camera/depth/image_raw"))


def lidar(k: int, space: str, *, imu: str = "imu", tf: bool = True, prefix: str = "") -> list[Message]:
    """A lidar, and an IMU that is tilted by k/10 about y."""
    to = ros()
    found = []
    for child in ("lidar", "imu") if tf else ():
        mount = to.tf(T0, f"{prefix}base_link", f"{prefix}{child}", 0.1 * k, topic=f"{space}/tf_static")
        found.append(mount)
    for i in range(5):
        stamp = T0 + i * STEP
        if imu:
            felt = 9.81 * np.array([np.sin(0.1 * k), 0.0, np.cos(0.1 * k)])
            found.append(to.imu(f"{space}/{imu}", stamp, felt, f"{prefix}imu" if tf else "lidar"))
        found.append(to.cloud(f"{space}/points", stamp, [[1, 2, 3]], f"{prefix}lidar"))
    return found


def test_gravity_is_of_the_imu_of_the_same_robot(tmp_path: Path) -> None:
    for tf in (True, False):
        path = written(tmp_path, lidar(1, "/robot1", tf=tf), lidar(2, "/robot2", tf=tf, imu="a"))
        for k, name in ((1, "imu"), (2, "a")):
            with open_log(path, ReadConfig(topic=f"/robot{k}/points")) as log:
                assert log.choose().imu_topic == f"/robot{k}/{name}"
        path = written(tmp_path, lidar(1, "/robot1", tf=tf, imu=""), lidar(2, "/robot2", tf=tf))
        with open_log(path, ReadConfig(topic="/robot1/points")) as log:
            assert log.choose().imu_topic is None
    path = written(tmp_path, lidar(1, "", prefix="r1/", imu="x"), lidar(2, "/b", prefix="r2/", imu="y"))
    for topic, imu in (("/points", "/x"), ("/b/points", "/b/y")):
        with open_log(path, ReadConfig(topic=topic)) as log:
            assert log.choose().imu_topic == imu


def test_a_camera_with_odometry_of_its_own_is_on_the_robot_that_tf_puts_it_on(tmp_path: Path) -> None:
    to, space = ros(), "/zed/zed_node"
    zed = [to.tf(T0, "base_link", "zed_optical", 0.1, topic="/tf_static")]
    for i in range(5):
        stamp = T0 + i * STEP
        zed.append(to.camera(f"{space}/depth/camera_info", stamp, 8, 6, 10.0))
        pixels = np.full((6, 8), 1000, np.uint16)
        zed.append(to.image(f"{space}/depth/image", stamp, pixels, "16UC1", "zed_optical"))
        zed.append(to.odometry(f"{space}/odom", stamp, 0.1 * i))
    path = written(tmp_path, robot(1, odometry=""), zed)
    assert check(path, "/scan", 1).odometry_topic == f"{space}/odom"
    path = written(tmp_path, robot(1), zed)
    assert check(path, "/scan", 1).odometry_topic == "/odom"
    with open_log(path, ReadConfig(topic=f"{space}/depth/image")) as log:
        assert log.choose().base_frame == "base_link"


def test_odometry_beside_a_copy_of_the_scans_may_be_of_another_robot(tmp_path: Path) -> None:
    path = written(tmp_path, robot(1, odometry=""), robot(1, space="/kiss", shared_tf=True))
    with pytest.raises(TopicError, match="of the robot of /scan: /kiss/odom"):
        read(path, ReadConfig(topic="/scan"))
    scans, _ = read(path, ReadConfig(topic="/scan", odometry="/kiss/odom"))
    assert scans[4].T_odom_base is not None


def test_two_robots_on_one_topic_are_chosen_by_their_base(tmp_path: Path) -> None:
    robots = [robot(k, prefix=f"robot{k}/", odometry=f"odom{k}") for k in (1, 2)]
    path = written(tmp_path, *robots)
    with pytest.raises(TopicError, match=r"/scan in frame robot\d/laser_link .* of two robots") as error:
        read(path)
    assert "--set read.base_frame=robot" in str(error.value.hint)
    for k in (1, 2):
        scans, report = read(path, ReadConfig(base_frame=f"robot{k}/base_link"))
        assert len(scans) == 5
        assert scans[4].T_base_sensor[0, 3] == pytest.approx(0.1 * k)
        assert scans[4].T_odom_base is not None
        assert scans[4].T_odom_base[0, 3] == pytest.approx(0.4 * k)
        assert any("is left out: read.base_frame is robot" in w for w in report.warnings)


def test_a_pose_in_tf_is_of_the_transforms_of_the_same_robot(tmp_path: Path) -> None:
    maps = [ros().tf(T0, "map", "odom", 10.0 * k, topic=f"/robot{k}/tf_static") for k in (1, 2)]
    path = written(tmp_path, maps, *fleet("/robot{}", "", odometry="", tf_odometry=True))
    for k in (1, 2):
        with open_log(path, ReadConfig(topic=f"/robot{k}/scan")) as log:
            assert log.map_pose(f"/robot{k}/tf").T_map_base.x == pytest.approx(10.0 * k + 0.4 * k)
