"""The last pose in the map that a recording holds, written by an independent encoder."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pc2grid.errors import FrameError, NoScans, Pc2GridError, TopicError
from pc2grid.io.map_pose import MapPose
from pc2grid.io.recording import open_log
from tests.helpers.recordings import STEP, T0, Message, ros, write_bag, write_mcap

RANGES = np.full(300, 2.0)


def pose_message(
    topic: str, stamp_ns: int, x_m: float, yaw_rad: float, frame: str = "map", dialect: str = "ros2"
) -> Message:
    encoder = ros(dialect)  # type: ignore[arg-type]
    make = encoder.make
    pose = make(
        "geometry_msgs/Pose",
        make("geometry_msgs/Point", x_m, -1.0, 0.0),
        make("geometry_msgs/Quaternion", 0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)),
    )
    covariance = np.arange(36.0)
    content = make(
        "geometry_msgs/PoseWithCovarianceStamped",
        encoder.header(stamp_ns, frame),
        make("geometry_msgs/PoseWithCovariance", pose, covariance),
    )
    return encoder.message(topic, stamp_ns, content)


def recorded(tmp_path: Path, *more: Message) -> Path:
    """Ten scans 0.1 s apart, tf odom -> base_link -> laser, and other messages."""
    encoder = ros()
    messages = [encoder.tf(T0, "base_link", "laser", 0.0, topic="/tf_static")]
    for k in range(10):
        stamp_ns = T0 + k * STEP
        messages += [
            encoder.laser("/scan", stamp_ns, RANGES),
            encoder.tf(stamp_ns, "odom", "base_link", 0.5 * k),
        ]
    messages = sorted([*messages, *more], key=lambda m: m.log_time_ns)
    return write_mcap(tmp_path / "log.mcap", messages)


def ask(path: Path, topic: str, end_s: float | None = None) -> MapPose:
    with open_log(path) as log:
        return log.map_pose(topic, end_s)


def test_the_last_pose_of_a_topic_and_the_last_before_an_end(tmp_path: Path) -> None:
    poses = [pose_message("/amcl_pose", T0 + k * STEP, 1.0 + k, 0.3 * k) for k in (1, 5)]
    path = recorded(tmp_path, *poses)
    found = ask(path, "/amcl_pose")
    assert found.stamp_ns == T0 + 5 * STEP
    assert (found.T_map_base.x, found.T_map_base.y) == (6.0, -1.0)
    assert found.T_map_base.yaw == pytest.approx(1.5)
    # Rows and columns 0, 1 and 5 of a matrix of 6 x 6.
    assert found.covariance is not None
    assert found.covariance.tolist() == [[0, 1, 5], [6, 7, 11], [30, 31, 35]]
    assert ask(path, "/amcl_pose", 0.3).T_map_base.x == 2.0
    with pytest.raises(NoScans, match="no pose"):
        ask(path, "/amcl_pose", 0.05)


def test_ros_1_poses_are_read(tmp_path: Path) -> None:
    encoder = ros("ros1")
    messages = [encoder.laser("/scan", T0 + k * STEP, RANGES) for k in range(3)]
    messages.append(pose_message("/amcl_pose", T0 + STEP, 4.0, 0.0, dialect="ros1"))
    path = write_bag(tmp_path / "log.bag", sorted(messages, key=lambda m: m.log_time_ns))
    assert ask(path, "/amcl_pose").T_map_base.x == 4.0


def test_tf_gives_map_to_base_at_the_newest_time_that_all_of_it_is_known(tmp_path: Path) -> None:
    """map -> odom is published seldom and with stamps in the future, as AMCL does."""
    corrections = [
        ros().tf(T0 + k * STEP + 700_000_000, "map", "odom", 10.0 * k, late_ns=-700_000_000) for k in (1, 6)
    ]
    path = recorded(tmp_path, *corrections)
    found = ask(path, "/tf")
    assert found.stamp_ns == T0 + 9 * STEP and found.covariance is None
    # At 0.9 s the correction is that of 0.8 s (10 m) until that of 1.3 s (60 m): in between it moves.
    assert found.T_map_base.x == pytest.approx(10.0 + 50.0 * 0.1 / 0.5 + 4.5)
    early = ask(path, "/tf", 0.25)
    assert early.T_map_base.x == pytest.approx(10.0 + 1.0)


@pytest.mark.parametrize(
    ("more", "topic", "error", "words"),
    [
        ([], "/amcl_pose", TopicError, ["/amcl_pose", "/tf"]),
        ([], "/scan", TopicError, ["LaserScan"]),
        ([], "/tf", FrameError, ["no frame map", "odom"]),
        ([pose_message("/goal", T0, 0.0, 0.0, frame="odom")], "/goal", FrameError, ["odom", "/amcl_pose"]),
        ([pose_message("/amcl_pose", T0, math.nan, 0.0)], "/amcl_pose", NoScans, ["no pose"]),
        ([pose_message("/amcl_pose", T0, 0.0, 0.0)], "/amcl_poze", TopicError, ["did you mean /amcl_pose"]),
    ],
)
def test_what_is_no_pose_in_a_map_is_refused(
    more: Sequence[Message], topic: str, error: type[Pc2GridError], words: list[str], tmp_path: Path
) -> None:
    with pytest.raises(error) as caught:
        ask(recorded(tmp_path, *more), topic)
    for word in words:
        assert word in str(caught.value)


def test_a_truncated_pose_is_passed_over(tmp_path: Path) -> None:
    whole = pose_message("/amcl_pose", T0 + STEP, 2.0, 0.0)
    cut = pose_message("/amcl_pose", T0 + 2 * STEP, 3.0, 0.0)
    found = ask(recorded(tmp_path, whole, cut._replace(data=cut.data[:60])), "/amcl_pose")
    assert found.T_map_base.x == 2.0
