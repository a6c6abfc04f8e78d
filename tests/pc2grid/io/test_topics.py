"""Which topic is proposed where several hold scans."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid.errors import TopicError
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, Message, read, ros, write_mcap


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
