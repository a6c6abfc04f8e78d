"""rosbag2 .db3 files: damage is named with the command that mends it; what a killed recorder left is read."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil
import pytest

from pc2grid.config import ReadConfig
from pc2grid.errors import LimitExceeded, LogCorrupt, LogTruncated, NotALog, Pc2GridError
from pc2grid.io import open_log
from pc2grid_cli.main import main
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
            with pytest.raises(LogTruncated, match=rf"log\.db3: ends after \d+ of \d+ bytes .*{MENDS}"):
                read(path, CONFIG, recover=recover)


@pytest.mark.fault(5)
def test_the_command_says_what_mends_a_db3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_rosbag2(tmp_path / "log", drive(scans=60)) / "log.db3"
    content = path.read_bytes()
    path.write_bytes(content[: 2 * len(content) // 3])
    database = tmp_path / "x.submaps"
    for more in ([], ["--recover"]):
        monkeypatch.setattr(sys, "argv", ["pc2grid", "convert", str(path), "-o", str(database), *more])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 1
        assert "sqlite3 log.db3 .recover" in capfd.readouterr().err
        assert not database.exists()


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
    with pytest.raises(LogCorrupt, match=r"index of times disagree .*sqlite3"):
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
    with pytest.raises(LogCorrupt, match=r"messages, topics and index .*sqlite3") as caught:
        read(path)
    assert psutil.Process().num_fds() == before, caught


def test_a_message_above_the_limit_is_refused(tmp_path: Path) -> None:
    path = db3(tmp_path)
    with pytest.raises(
        LimitExceeded, match=r"log\.db3: a message has more than 5000 bytes .*max_record_bytes"
    ):
        read(path, ReadConfig(assume_identity=True, max_record_bytes=5000))


def test_a_header_that_is_damaged(tmp_path: Path) -> None:
    path = db3(tmp_path)
    with path.open("r+b") as file:
        file.seek(16)
        file.write(b"\x00\x03")
    for recover in (False, True):
        with pytest.raises(LogCorrupt, match=r"log\.db3: a damaged \.db3"):
            read(path, CONFIG, recover=recover)


# --- recorders that were killed -----------------------------------------------------------------------


def killed(folder: Path, commits: int) -> Path:
    """A .db3 whose last messages are in its write-ahead log, committed in so many steps."""
    source = write_rosbag2(folder / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(source)) as db:
        db.execute("PRAGMA journal_mode=WAL")
        rows = db.execute("SELECT * FROM messages WHERE id > 5").fetchall()
        db.execute("DELETE FROM messages WHERE id > 5")
        db.commit()
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        db.execute("PRAGMA wal_autocheckpoint=0")
        size = -(-len(rows) // commits)
        for first in range(0, len(rows), size):
            db.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[first : first + size])
            db.commit()
        for name in ("log.db3", "log.db3-wal"):
            shutil.copy(source.with_name(name), folder / name)
    assert (folder / "log.db3-wal").stat().st_size > PAGE
    return folder / "log.db3"


@pytest.mark.fault(6)
def test_what_the_recorder_left_in_the_log_is_read(tmp_path: Path) -> None:
    path = killed(tmp_path, 1)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()}
    for recover in (False, True):
        scans, report = read(path, recover=recover)
        check_drive(scans)
        assert not report.lossy
        assert any("did not close the file" in w for w in report.warnings)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir() if file.is_file()} == before


@pytest.mark.fault(6)
def test_of_the_log_only_what_was_committed_counts(tmp_path: Path) -> None:
    path = killed(tmp_path, 4)
    wal = path.with_name("log.db3-wal")
    content = bytearray(wal.read_bytes())
    content[-100] ^= 1  # in the last commit
    path = killed(tmp_path / "again", 4)
    for damaged in (content, content[:-100]):
        wal.write_bytes(damaged)
        with closing(sqlite3.connect(wal.with_name("log.db3"))) as db:  # SQLite's own recovery, which writes
            expected = db.execute("SELECT timestamp FROM messages ORDER BY timestamp, id").fetchall()
        assert 5 < len(expected) < 25
        path.with_name("log.db3-wal").write_bytes(damaged)
        with open_log(path) as log:
            assert log.info.message_count == len(expected)
            assert any("did not close the file" in w for w in log.report().warnings)


def test_a_log_of_another_file_is_not_read(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    for content in (b"junk", bytes(5000), b"\x37\x7f\x06\x82" + bytes(5000)):
        path.with_name("log.db3-wal").write_bytes(content)
        scans, report = read(path)
        check_drive(scans)
        assert any("did not close the file" in w for w in report.warnings)


@pytest.mark.parametrize("at", [5, 14, 17, 25])
def test_a_log_whose_beginning_is_damaged_is_not_read(tmp_path: Path, at: int) -> None:
    path = killed(tmp_path, 1)
    wal = path.with_name("log.db3-wal")
    content = bytearray(wal.read_bytes())
    content[at] ^= 4
    wal.write_bytes(content)
    with open_log(path) as log:
        assert log.info.message_count == 5
        assert any("did not close the file" in w for w in log.report().warnings)


def test_damage_beside_a_log_is_not_passed_over(tmp_path: Path) -> None:
    path = killed(tmp_path, 1)
    content = bytearray(path.read_bytes())
    content[3 * PAGE : 4 * PAGE] = b"\x55" * PAGE  # the topics, of which the log holds nothing newer
    path.write_bytes(content)
    with pytest.raises(LogCorrupt, match=rf"log\.db3: a damaged .*{MENDS}"):
        read(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_log_beside_a_file_that_may_not_be_written(tmp_path: Path) -> None:
    path = killed(tmp_path, 1)
    path.chmod(stat.S_IRUSR)
    with pytest.raises(LogCorrupt, match="copy it and the -wal file beside it to a folder"):
        read(path)


def test_a_file_that_is_being_recorded_is_not_disturbed(tmp_path: Path) -> None:
    path = write_rosbag2(tmp_path / "log", drive()) / "log.db3"
    with closing(sqlite3.connect(path)) as recorder:
        recorder.execute("PRAGMA journal_mode=WAL")
        recorder.execute("DELETE FROM messages WHERE id > 20")
        recorder.commit()
        # In a process of its own: locks of one process do not exclude each other.
        code = "import sys; from pc2grid.io import open_log; open_log(sys.argv[1])"
        command = [sys.executable, "-c", code, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "log.db3: cannot be read: " in done.stderr
        assert "copy it and the -wal file beside it" in done.stderr
        recorder.execute("DELETE FROM messages WHERE id > 10")
        recorder.commit()
        copy = tmp_path / "copy"
        copy.mkdir()
        for name in ("log.db3", "log.db3-wal"):
            shutil.copy(path.with_name(name), copy / name)
    with open_log(copy / "log.db3") as log:
        assert log.info.message_count == 10


def test_junk_behind_the_magic_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    path.write_bytes(b"SQLite format 3\0" + bytes(range(1, 256)) * 40)
    with pytest.raises(Pc2GridError, match=r"x\.db3"):
        read(path, recover=True)


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


def test_what_is_no_whole_db3(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "log", drive())
    path = folder / "log.db3"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(
        LogTruncated, match=r"log\.db3: ends after \d+ of \d+ bytes.*sqlite3 log\.db3 \.recover"
    ):
        read(path)
    path.write_bytes(whole[:50])
    with pytest.raises(LogTruncated, match="ends after 50 bytes"):
        read(path)
    page = struct.unpack(">H", whole[16:18])[0]
    path.write_bytes(whole[:page] + b"\x55" * (len(whole) - page))
    with pytest.raises(LogCorrupt, match=r"log\.db3: .*malformed"):
        read(path)
    other = tmp_path / "other.db3"
    with sqlite3.connect(other) as db:
        db.execute("CREATE TABLE cookies(x)")
    db.close()
    with pytest.raises(NotALog, match=r"not a rosbag2 \.db3"):
        read(other)


def test_a_message_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    big = ros().cloud("/points", T0, np.zeros((100_000, 3)))
    folder = write_rosbag2(tmp_path / "log", [big], "sqlite3", "message")
    with pytest.raises(LimitExceeded, match="max_chunk_bytes"):
        read(folder, ReadConfig(max_chunk_bytes=10_000))
