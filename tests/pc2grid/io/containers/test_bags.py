"""ROS 1 bags: of every compression, damaged, and with an index that is wrong."""

import bz2
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
import pytest
import yaml

from pc2grid.errors import LimitExceeded, LogCorrupt, LogNotFound, LogTruncated, NotALog
from pc2grid.io.recording import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.field import DATA
from tests.helpers.memory import bounded_memory
from tests.helpers.recordings import (
    STEP,
    T0,
    check_drive,
    drive,
    read,
    ros,
    write_bag,
    write_mcap,
    write_rosbag2,
)


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_a_bag_of_every_compression(tmp_path: Path, compression: str) -> None:
    path = write_bag(tmp_path / "odd name #1?.bag", drive("ros1"), compression)
    with open_log(path) as log:
        assert log.info.format == "bag/ros1"
        assert log.info.message_count == 25
        assert (log.info.start_ns, log.info.end_ns) == (T0, T0 + 11 * STEP)
        check_drive(list(log.scans()))
        assert not log.report().lossy
        assert [s.stamp_ns for s in log.scans(0.5, 0.2)] == [T0 + 5 * STEP, T0 + 6 * STEP]
        assert any("no checksum" in w for w in log.report().warnings)


@pytest.mark.skipif(not (DATA / "laser/aces_ros1.bag").exists(), reason="no recorded data (PC2GRID_DATA)")
def test_a_real_bag() -> None:
    with open_log(DATA / "laser/aces_ros1.bag") as log:
        assert {t.topic: t.message_count for t in log.info.topics}["/scan"] == 7374
        scans = list(log.scans(duration_s=60.0))
        assert not log.report().lossy
    assert len(scans) > 300
    for scan in scans:
        assert scan.sensor == "laser"
        assert 0 < len(scan.points_m) <= 181
        assert scan.T_odom_base is not None


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_recover_says_what_mends_a_damaged_bag(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.bag"
    whole = write_bag(path, drive("ros1", scans=60), compression, chunk_bytes=4096).read_bytes()
    check_drive(read(path, recover=True)[0], 60)  # a whole bag is read as without --recover
    unindexed = whole.index(b"index_pos=") + 10  # a recorder that was killed: no index, last chunk cut off
    middle = whole.index(b"compression=", len(whole) // 3)
    unindexed_bag = whole[:unindexed] + bytes(8) + whole[unindexed + 8 :]
    damaged = [unindexed_bag, unindexed_bag[: len(whole) // 2], whole[: len(whole) // 2], whole[:13]]
    places = (middle - 16, middle - 8, middle)  # the header's length, the kind, the compression
    damaged += [whole[:place] + b"\xff\xff\xff\xff" + whole[place + 4 :] for place in places]
    for content in damaged:
        path.write_bytes(content)
        for recover in (False, True):
            with pytest.raises((LogTruncated, LogCorrupt), match=r"a\.bag.*`rosbag reindex a\.bag` mends it"):
                read(path, recover=recover)


@pytest.mark.parametrize("compression", ["", "bz2"])
def test_an_index_of_a_bag_that_names_another_topic(tmp_path: Path, compression: str) -> None:
    path = write_bag(tmp_path / "a.bag", drive("ros1"), compression)
    whole = path.read_bytes()
    at = whole.index(b"conn=", whole.index(b"op=\x04")) + 5
    path.write_bytes(whole[:at] + b"\0\x10" + whole[at + 2 :])
    with pytest.raises(LogCorrupt, match=r"the index does not list what the chunks hold .*rosbag reindex"):
        read(path)
    assert str(path) not in [file.path for file in psutil.Process().open_files()]


def test_a_bag_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.bag", drive("ros1"), "bz2")
    with pytest.raises(LimitExceeded, match=r"more than 1000 bytes .*max_chunk_bytes"):
        read(path, ReadConfig(max_chunk_bytes=1000))
    content = path.read_bytes()
    at = content.index(b"BZh9")
    size = struct.unpack("<I", content[at - 4 : at])[0]
    bomb = bz2.compress(bytes(64 << 20))
    assert len(bomb) < size
    path.write_bytes(content[:at] + bomb.ljust(size, b"\0") + content[at + size :])
    with pytest.raises(LimitExceeded, match="max_chunk_bytes"):
        read(path, ReadConfig(max_chunk_bytes=32 << 20))


def test_index_of_a_bag_that_leads_to_an_absurd_length(tmp_path: Path) -> None:
    """The bytes where a chunk should begin read as a length of 4 GB, which must not be allocated."""
    path = write_bag(tmp_path / "a.bag", drive("ros1"), "bz2")
    content = bytearray(path.read_bytes())
    place = content.rindex(b"chunk_pos=") + len(b"chunk_pos=")
    wrong = content.index(b"index_pos=") - 6  # in the header, where bytes of a name follow
    content[place : place + 8] = wrong.to_bytes(8, "little")
    path.write_bytes(content)
    with bounded_memory(100 << 20), pytest.raises(LogTruncated, match="ends within"):
        read(path)


# --- rosbag2 .db3 files: damage, and what a killed recorder left, is named with the command that mends it ---


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


# --- rosbag2 folders: of every kind, split, compressed, and with parts missing or damaged ---


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("compression", ["", "message"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_folder_of_every_kind(
    tmp_path: Path, storage: Literal["mcap", "sqlite3"], compression: Literal["", "message"], version: int
) -> None:
    folder = write_rosbag2(tmp_path / "log", drive(), storage, compression, version)
    for path in (folder, folder / "metadata.yaml"):
        with open_log(path) as log:
            assert log.info.format == ("mcap/ros2" if storage == "mcap" else "db3/ros2")
            assert log.info.message_count == 25
            check_drive(list(log.scans()))
            assert not log.report().lossy


def split(folder: Path, names: list[str]) -> Path:
    """The drive in as many MCAP files as there are names, listed in that order by a metadata.yaml."""
    folder.mkdir()
    messages = drive()
    size = -(-len(messages) // len(names))
    for i, name in enumerate(names):
        write_mcap(folder / name, messages[i * size : (i + 1) * size])
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": [f"log/{name}" for name in names]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
    return folder


def test_split_recordings_in_the_order_of_the_metadata(tmp_path: Path) -> None:
    # Neither the order of the names nor that of their numbers.
    folder = split(tmp_path / "log", ["b_2.mcap", "a_10.mcap", "c_1.mcap"])
    with open_log(folder) as log:
        assert {t.topic: t.message_count for t in log.info.topics} == {
            "/odom": 12,
            "/points": 12,
            "/tf_static": 1,
        }
        check_drive(list(log.scans()))
        # tf is in the first file only, and still known in the last.
        late = list(log.scans(1.0))
        assert [s.stamp_ns for s in late] == [T0 + 10 * STEP, T0 + 11 * STEP]
        assert late[0].T_base_sensor[0, 3] == 0.2
        digest = log.digest()
    (folder / "metadata.yaml").unlink()
    (folder / "metadata.yaml").write_text("")
    with pytest.raises(LogCorrupt, match=r"metadata\.yaml: .*reindex"):
        read(folder)
    listed = {"rosbag2_bagfile_information": {"relative_file_paths": ["c_1.mcap", "b_2.mcap", "a_10.mcap"]}}
    (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
    with open_log(folder) as log:
        assert log.digest() != digest  # another order is another input


def test_without_metadata_there_is_one_file_or_what_to_type(tmp_path: Path) -> None:
    """A recorder that was killed leaves none."""
    folder = split(tmp_path / "log", ["log_0.mcap"])
    (folder / "metadata.yaml").unlink()
    check_drive(read(folder)[0])
    write_mcap(folder / "log_1.mcap", drive())
    for recover in (False, True):
        with pytest.raises(LogNotFound, match=r"log: 2 files, and no metadata\.yaml") as caught:
            open_log(folder, recover=recover)
        assert caught.value.hint is not None
        assert f"`ros2 bag reindex {folder}`" in caught.value.hint
        assert f"pc2grid convert {folder}/*.mcap" in caught.value.hint


def test_a_folder_of_ros_1_bags_is_refused_with_what_to_type(tmp_path: Path) -> None:
    write_bag(tmp_path / "a.bag", drive("ros1"))
    with pytest.raises(LogNotFound) as caught:
        open_log(tmp_path)
    assert caught.value.hint == f"name the files: pc2grid convert {tmp_path}/*.bag"


def test_a_missing_part(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap", "log_1.mcap", "log_2.mcap"])
    (folder / "log_1.mcap").unlink()
    with pytest.raises(LogNotFound, match=r"lists log_1\.mcap, which is not there"):
        read(folder)
    scans, report = read(folder, recover=True)
    assert 0 < len(scans) < 12
    assert report.lossy and report.severe
    assert "log_1.mcap is missing" in report.warnings


def test_a_damaged_part(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap", "log_1.mcap"])
    part = folder / "log_1.mcap"
    part.write_bytes(part.read_bytes()[:200])
    with pytest.raises(LogTruncated, match=r"log_1\.mcap"):
        read(folder)
    scans, report = read(folder, recover=True)
    assert 0 < len(scans) < 12
    assert report.bytes_lost > 0


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[1, 2]",
        b"rosbag2_bagfile_information: {relative_file_paths: 7}",
        b"rosbag2_bagfile_information: {relative_file_paths: [[1]]}",
        b"a: !!python/object/apply:os.system [touch hacked]",
        b"\xff\xfe\x00",
        b"[" * 5000,
        b"a: [" + b"1," * 300_000 + b"]",
    ],
    ids=range(8),
)
def test_metadata_that_makes_no_sense(tmp_path: Path, content: bytes) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap"])
    (folder / "metadata.yaml").write_bytes(content)
    with pytest.raises(LogCorrupt, match=r"metadata\.yaml: not the metadata of a recording .*reindex"):
        read(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: []}")
    with pytest.raises(LogNotFound, match="none of the files"):
        read(folder)


def test_no_path_in_the_metadata_leads_out_of_the_folder(tmp_path: Path) -> None:
    write_mcap(tmp_path / "secret.mcap", drive())
    folder = tmp_path / "log"
    folder.mkdir()
    for name in ("../secret.mcap", str(tmp_path / "secret.mcap")):
        listed = {"rosbag2_bagfile_information": {"relative_file_paths": [name]}}
        (folder / "metadata.yaml").write_text(yaml.safe_dump(listed))
        with pytest.raises(LogNotFound, match=r"lists secret\.mcap, which is not there"):
            read(folder)


def test_files_compressed_as_a_whole_are_read_once_unpacked(tmp_path: Path) -> None:
    import zstandard

    folder = write_rosbag2(tmp_path / "log", drive(), "sqlite3", "file")
    with pytest.raises(LogNotFound, match=r"log\.db3\.zstd is compressed as a whole .*zstd -d"):
        read(folder)
    with (folder / "log.db3.zstd").open("rb") as packed, (folder / "log.db3").open("wb") as plain:
        zstandard.ZstdDecompressor().copy_stream(packed, plain)
    check_drive(read(folder)[0])
