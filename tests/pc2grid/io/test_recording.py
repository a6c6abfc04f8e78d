"""Which topic is proposed where several hold scans."""

from pathlib import Path

import pytest

from pc2grid.errors import FrameError, TopicError
from pc2grid.io.recording import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, check_drive, drive, read, ros, write_mcap


def robot_with_copies() -> list[Message]:
    """A laser whose scans are published again: later in the same frame, and as points in odom."""
    to = ros()
    messages = [to.tf(T0, "base_link", "laser", 0.2, topic="/tf_static")]
    for i in range(5):
        stamp = T0 + i * STEP
        messages += [
            to.cloud("/projected", stamp, [[1, 2, 0]], frame="odom"),
            to.laser("/scan", stamp, [2.0, 2.0, 2.0]),
            to.laser("/a_stable_scan", stamp, [2.0, 2.0, 2.0])._replace(log_time_ns=stamp + STEP // 2),
            to.tf(stamp, "odom", "base_link", 0.1 * i),
        ]
    return sorted(messages, key=lambda m: m.log_time_ns)


def test_the_driver_s_own_scans_are_proposed_and_one_sensor_is_not_joined_with_itself(tmp_path: Path) -> None:
    with pytest.raises(TopicError, match="several topics hold scans") as error:
        read(write_mcap(tmp_path / "a.mcap", robot_with_copies()))
    assert error.value.hint == "choose one, e.g. --topic /scan"


def test_a_sensor_is_not_put_together_with_itself(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", robot_with_copies())
    with pytest.raises(TopicError, match="/a_stable_scan is in frame laser of the first topic"):
        read(path, ReadConfig(topic="/scan,/a_stable_scan"))


def test_names_in_a_file_break_no_line(tmp_path: Path) -> None:
    to = ros()
    mount = to.tf(T0, "mast\x1b[31m", "li\ndar", 0.2, topic="/tf_static")
    path = write_mcap(tmp_path / "a\nb.mcap", [mount, to.cloud("/points", T0, [[1, 2, 3]])])
    with pytest.raises(FrameError) as caught:
        read(path)
    assert str(caught.value).isprintable()
    assert r"frames in the log: li\ndar, mast\x1b[31m" in caught.value.message
    assert caught.value.message.count("a\\nb.mcap") == 1


def test_the_shortest_of_several_odometries_is_used_and_reported(tmp_path: Path) -> None:
    to, messages = ros(), drive()
    wheels = [to.odometry("/wheels/odometry", T0 + i * STEP, 7.0) for i in range(12)]
    with open_log(write_mcap(tmp_path / "a.mcap", [*messages, *wheels])) as log:
        assert "odometry from /odom (also there: /wheels/odometry" in log.choose().reason
        check_drive(list(log.scans()))


@pytest.mark.parametrize("in_tf", [False, True])
def test_one_stray_time_of_recording_is_no_other_clock(tmp_path: Path, in_tf: bool) -> None:
    """A message that was recorded with a time of the year before comes first, and decides nothing."""
    to = ros()
    mount, *messages = drive()
    if in_tf:
        clouds = [m for m in messages if m.topic == "/points"]
        messages = [*clouds, *(to.tf(T0 + i * STEP, "odom", "base_link", 0.1 * i) for i in range(12))]
    k = next(k for k, message in enumerate(messages) if message.topic != "/points")
    messages[k] = messages[k]._replace(log_time_ns=T0 - 10**16)
    path = write_mcap(tmp_path / "a.mcap", sorted([mount, *messages], key=lambda m: m.log_time_ns))
    with open_log(path) as log:
        assert log.choose().odometry_topic == ("/tf" if in_tf else "/odom")
        check_drive(list(log.scans()))
        assert not any("clocks" in warning for warning in log.report().warnings)
