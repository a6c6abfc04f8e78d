"""ROS 1 bags, rosbag2 folders and .db3 files: whole, split, compressed and damaged."""

from __future__ import annotations

import bz2
import os
import sqlite3
import struct
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import yaml

from pc2grid.config import ReadConfig
from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    LogNotFound,
    LogTruncated,
    NotALog,
)
from pc2grid.io import open_log
from tests.builders import (
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

DATA = Path(os.environ.get("PC2GRID_DATA", "../shared/data"))


# --- ROS 1 bags ---------------------------------------------------------------------------------------


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
        assert any("no checksum" in w for w in log.report().warnings) == (compression != "bz2")


@pytest.mark.skipif(not (DATA / "laser/aces_ros1.bag").exists(), reason="no recorded data (PC2GRID_DATA)")
def test_a_real_bag_to_its_end() -> None:
    with open_log(DATA / "laser/aces_ros1.bag") as log:
        count = 0
        for scan in log.scans():
            count += 1
            assert scan.sensor == "laser"
            assert 0 < len(scan.points_m) <= 181
            assert scan.T_odom_base is not None
        assert count == 7374
        assert not log.report().lossy


def test_what_is_no_whole_bag(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "a.bag", drive("ros1")).read_bytes()

    def bag(content: bytes) -> Path:
        path = tmp_path / "b.bag"
        path.write_bytes(content)
        return path

    with pytest.raises(LogTruncated, match=r"ends within a record.*--recover"):
        read(bag(whole[: len(whole) // 2]))
    with pytest.raises(LogCorrupt, match="--recover"):
        read(bag(whole[:13]))
    with pytest.raises(LogTruncated, match=r"not indexed.*--recover"):  # a recorder that was killed
        at = whole.index(b"index_pos=") + 10
        read(bag(whole[:at] + bytes(8) + whole[at + 8 :]))
    with pytest.raises(NotALog, match="ROS 1 bag of an old format"):
        read(bag(b"#ROSBAG V1.2\n" + bytes(50)))


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_recover_reads_the_whole_chunks_of_a_damaged_bag(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.bag"
    whole = write_bag(path, drive("ros1", scans=120), compression, chunk_bytes=4096).read_bytes()
    assert whole.count(b"compression=") > 10
    clean = [s.points_m.tobytes() for s in read(path)[0]]
    found, report = read(path, recover=True)
    assert [s.points_m.tobytes() for s in found] == clean
    assert not report.lossy

    at = whole.index(b"index_pos=") + 10  # a recorder that was killed: no index, last chunk cut off
    path.write_bytes(whole[:at] + bytes(8) + whole[at + 8 : len(whole) // 2])
    with pytest.raises(LogTruncated, match="--recover"):
        read(path)
    found, report = read(path, recover=True)
    assert 30 < len(found) < 90
    assert [s.points_m.tobytes() for s in found] == clean[: len(found)]
    assert report.bytes_lost > 0

    middle = whole.index(b"compression=", len(whole) // 3)
    for place in (middle - 16, middle - 8, middle):  # the header's length, the kind, the compression
        content = bytearray(whole)
        content[place : place + 4] = b"\xff\xff\xff\xff"
        path.write_bytes(content)
        found, report = read(path, recover=True)
        assert 100 < len(found) < 120
        assert {s.points_m.tobytes() for s in found} <= set(clean)
        assert found[-1].points_m.tobytes() == clean[-1]
        assert report.bytes_lost > 1000


@pytest.mark.parametrize("compression", ["", "bz2"])
def test_an_index_of_a_bag_that_names_another_topic(tmp_path: Path, compression: str) -> None:
    path = write_bag(tmp_path / "a.bag", drive("ros1"), compression)
    whole = path.read_bytes()
    at = whole.index(b"conn=", whole.index(b"op=\x04")) + 5
    path.write_bytes(whole[:at] + b"\0\x10" + whole[at + 2 :])
    with pytest.raises(LogCorrupt, match=r"the index does not list what the chunks hold .*--recover"):
        read(path)
    scans, report = read(path, recover=True)
    check_drive(scans)
    assert not report.lossy


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


# --- rosbag2 ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("compression", ["", "message"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_folder_of_every_kind(
    tmp_path: Path,
    storage: Literal["mcap", "sqlite3"],
    compression: Literal["", "message"],
    version: int,
) -> None:
    folder = write_rosbag2(tmp_path / "log", drive(), storage, compression, version)
    for path in (folder, folder / "metadata.yaml"):
        with open_log(path) as log:
            assert log.info.format == ("mcap/ros2" if storage == "mcap" else "db3/ros2")
            assert log.info.message_count == 25
            check_drive(list(log.scans()))
            assert not log.report().lossy


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
    with pytest.raises(LogCorrupt, match=r"metadata\.yaml: key .*reindex"):
        read(folder)
    with open_log(folder, recover=True) as log:
        assert log.digest() != digest  # another order is another input


def test_without_metadata_the_numbers_of_the_files_count(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", [f"log_{i}.mcap" for i in range(12)])
    (folder / "metadata.yaml").unlink()
    scans, report = read(folder)
    check_drive(scans)
    assert any("no metadata.yaml" in w for w in report.warnings)


def test_a_missing_part(tmp_path: Path) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap", "log_1.mcap", "log_2.mcap"])
    (folder / "log_1.mcap").unlink()
    with pytest.raises(LogNotFound, match=r"lists log_1\.mcap, which is not there"):
        read(folder)
    scans, report = read(folder, recover=True)
    assert 0 < len(scans) < 12
    assert report.lossy
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
    ("content", "words"),
    [
        (b"", "relative_file_paths is missing"),
        (b"[1, 2]", "relative_file_paths is missing"),
        (b"rosbag2_bagfile_information: {relative_file_paths: 7}", "not a list"),
        (b"rosbag2_bagfile_information: {relative_file_paths: []}", "not a list"),
        (b"rosbag2_bagfile_information: {relative_file_paths: [[1]]}", "not a list"),
        (b"a: !!python/object/apply:os.system [touch hacked]", "not YAML"),
        (b"\xff\xfe\x00", "not YAML"),
        (b"[" * 5000, "not YAML"),
    ],
)
def test_metadata_that_makes_no_sense(tmp_path: Path, content: bytes, words: str) -> None:
    folder = split(tmp_path / "log", ["log_0.mcap"])
    (folder / "metadata.yaml").write_bytes(content)
    with pytest.raises(LogCorrupt, match=words):
        read(folder)
    scans, report = read(folder, recover=True)
    check_drive(scans)
    assert any("order of their numbers" in w for w in report.warnings)


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


def test_what_is_no_whole_db3(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path / "log", drive())
    path = folder / "log.db3"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LogTruncated, match=r"log\.db3: ends after \d+ of \d+ bytes.*recover"):
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
