"""A recording lasts from its first scan to its last one, whatever else it holds."""

from __future__ import annotations

from pathlib import Path

import pytest

from pc2grid.io import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import T0, Message, laser_drive, ros, write_mcap, write_rosbag2

S = 10**9
WEEK_S = 7 * 24 * 3600


def with_strays() -> list[Message]:
    """A drive of 11.9 s. A transform comes a week later, and odometry begins 40 s before the first scan."""
    late = ros().tf(T0 + WEEK_S * S, "base_link", "camera", 0.1, topic="/tf_static")
    early = [ros().odometry("/odom", T0 - 40 * S + k * S, 0.0) for k in range(40)]
    return [*early, *laser_drive(), late]


@pytest.mark.parametrize("container", ["mcap", "loose", "sqlite3"])
def test_strays_do_not_count(tmp_path: Path, container: str) -> None:
    messages = with_strays()
    if container == "sqlite3":
        path = write_rosbag2(tmp_path / "a", messages, "sqlite3")
    else:
        path = write_mcap(tmp_path / "a.mcap", messages, use_chunking=container == "mcap", chunk_size=2000)
    with open_log(path) as log:
        assert (log.info.start_ns, log.info.end_ns) == (T0, T0 + 119 * S // 10)
        assert len(list(log.scans())) == 120
        # Odometry is known at all of them.
        part = list(log.scans(5.0, 2.0))
        assert [scan.stamp_ns for scan in part] == [T0 + 5 * S + k * S // 10 for k in range(20)]
        assert all(scan.T_odom_base is not None for scan in part)


def test_without_scans_the_times_are_those_of_all_messages(tmp_path: Path) -> None:
    messages = [m for m in laser_drive() if m.topic != "/scan"]
    with open_log(write_mcap(tmp_path / "a.mcap", messages)) as log:
        assert log.info.start_ns == T0 and log.info.duration_s == pytest.approx(11.95)


def test_of_several_scanners_the_times_are_those_of_the_one_that_is_read(tmp_path: Path) -> None:
    later = [ros().laser("/second", T0 + (20 + k) * S, [1.0] * 30) for k in range(3)]
    path = write_mcap(tmp_path / "a.mcap", [*laser_drive(), *later])
    with open_log(path, ReadConfig(topic="/scan")) as log:
        assert log.info.duration_s == pytest.approx(11.9)
    with open_log(path) as log:
        assert log.info.duration_s == pytest.approx(22.0)
