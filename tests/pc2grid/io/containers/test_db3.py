"""rosbag2 .db3 files: damage, and what a killed recorder left, is named with the command that mends it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest

from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated, NotALog
from pc2grid.io import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.recordings import STEP, T0, check_drive, drive, read, ros, write_rosbag2

PAGE = 4096
SCANS = 60
CONFIG = ReadConfig(assume_identity=True)
MENDS = r"`sqlite3 log\.db3 \.recover | sqlite3 mended\.db3` mends it".replace("|", r"\|")


def db3(folder: Path, points: int = 1000) -> Path:
    """Clouds of three pages each, and nothing else."""
    rng = np.random.default_rng(3)
    clouds = [ros().cloud("/points", T0 + i * STEP, rng.uniform(1, 9, (points, 3))) for i in range(SCANS)]
    return write_rosbag2(folder / "log", clouds) / "log.db3"


def page_of(content: bytes, kind: int, number: int = 0) -> int:
    """Where a page of a kind begins; behind the small tables, which are of one page each."""
    pages = [at for at in range(5 * PAGE, len(content), PAGE) if content[at] == kind]
    return pages[number]


@pytest.mark.fault(5)
@pytest.mark.fault(7)
@pytest.mark.parametrize(
    "damage",
    [
        lambda c: (page_of(c, 0x0D, 4), b"\x55" * PAGE),  # the rows of a page
        lambda c: (page_of(c, 0x0D, 4), b"\x00"),  # what it says it is
        lambda c: (page_of(c, 0x0D, -1), b"\x05"),  # the same of the last
        # A page of an index in its place.
        lambda c: (page_of(c, 0x0D, -1), c[page_of(c, 0x0A) :][:PAGE]),
        lambda c: (page_of(c, 0x0D, 4) + 4, b"\x00"),  # how many rows it has
        lambda c: (page_of(c, 0x0D, 4) + 8, b"\xff\xff"),  # where the first is
        lambda c: (page_of(c, 0x00, 20), b"\x00\x00\x00\x09"),  # where a row goes on: in another's page
        lambda c: (page_of(c, 0x00, 20), b"\x77"),  # where there is no page
        lambda c: (page_of(c, 0x05), b"\x55" * PAGE),  # the tree above all rows
        lambda c: (page_of(c, 0x0A), b"\x55" * PAGE),  # the index by time
    ],
)
def test_damage_is_named_with_what_mends_it(
    tmp_path: Path, damage: Callable[[bytes], tuple[int, bytes]]
) -> None:
    path = db3(tmp_path)
    content = bytearray(path.read_bytes())
    at, new = damage(bytes(content))
    content[at : at + len(new)] = new
    path.write_bytes(content)
    for recover in (False, True):
        with pytest.raises(LogCorrupt, match=rf"log\.db3: a damaged \.db3: .*{MENDS}"):
            read(path, CONFIG, recover=recover)
    assert path.read_bytes() == content


@pytest.mark.fault(5)
def test_a_db3_that_ends_too_early(tmp_path: Path) -> None:
    path = db3(tmp_path)
    whole = path.read_bytes()
    for size in range(len(whole) - 1, 12 * PAGE, -len(whole) // 7):
        path.write_bytes(whole[:size])
        for recover in (False, True):
            with pytest.raises(LogCorrupt, match=rf"log\.db3: a damaged \.db3: .*{MENDS}"):
                read(path, CONFIG, recover=recover)


def test_messages_that_were_deleted_are_no_damage(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("DELETE FROM messages WHERE id > 1 AND id % 3 = 0")  # cut by hand: no loss
    scans, report = read(path)
    assert 0 < len(scans) < 12
    assert not report.lossy


def test_an_index_that_misses_messages_is_noticed(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    at = page_of(bytes(content), 0x0A)
    assert content[at + 4] == 25
    content[at + 4] = 20
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"a damaged \.db3: .*sqlite3"):
        read(path)


def test_a_topic_that_is_lost(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    content = bytearray(path.read_bytes())
    at = 3 * PAGE
    cell = at + int.from_bytes(content[at + 10 : at + 12], "big")
    assert b"/odom" in content[cell : cell + 20]
    content[cell + 1] = 40  # topic 2 is now 40
    path.write_bytes(content)
    before = psutil.Process().num_fds()
    with pytest.raises(LogCorrupt, match=r"messages whose topic is missing .*sqlite3") as caught:
        read(path)
    assert psutil.Process().num_fds() == before, caught


def test_a_message_above_the_limit_is_refused(tmp_path: Path) -> None:
    path = db3(tmp_path)
    with pytest.raises(
        LimitExceeded, match=r"log\.db3: a message has \d+ bytes; the limit is 5000 .*max_record_bytes"
    ):
        read(path, ReadConfig(assume_identity=True, max_record_bytes=5000))


# --- recorders that were killed -----------------------------------------------------------------------


@pytest.mark.fault(6)
def test_what_the_recorder_left_in_the_log_is_not_passed_over(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA journal_mode=WAL")
        db.execute("DELETE FROM messages WHERE id > 5")
        db.commit()
        for recover in (False, True):
            with pytest.raises(LogTruncated, match=r"log\.db3: its recorder was killed.*wal_checkpoint"):
                read(path, recover=recover)
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        with open_log(path) as log:
            assert log.info.message_count == 5


def test_a_file_of_another_application_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE topics(id)")
    with pytest.raises(NotALog, match=r"x\.db3: an SQLite file, but not a rosbag2 \.db3"):
        open_log(path)


def test_a_db3_on_its_own_even_of_an_odd_name(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "log", drive(), "sqlite3", "message")
    path = (folder / "log.db3").rename(tmp_path / "50% of #1? ü.db3")
    check_drive(read(path)[0])
    assert path.read_bytes()[:6] == b"SQLite"


def test_a_db3_of_an_old_rosbag2_has_no_definitions(tmp_path: Path) -> None:
    path = tmp_path / "old.db3"
    with sqlite3.connect(path) as db:
        db.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
        )
        db.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        topics = {"/tf_static": "tf2_msgs/msg/TFMessage", "/odom": "nav_msgs/msg/Odometry",
                  "/points": "sensor_msgs/msg/PointCloud2"}  # fmt: skip
        for i, (name, kind) in enumerate(topics.items()):
            db.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (i, name, kind))
        for m in drive():
            db.execute(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                (list(topics).index(m.topic), m.log_time_ns, m.data),
            )
    db.close()
    check_drive(read(path)[0])


def test_a_message_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    big = ros().cloud("/points", T0, np.zeros((100_000, 3)))
    folder = write_rosbag2(tmp_path / "log", [big], "sqlite3", "message")
    with pytest.raises(LimitExceeded, match="max_chunk_bytes"):
        read(folder, ReadConfig(max_chunk_bytes=10_000))
