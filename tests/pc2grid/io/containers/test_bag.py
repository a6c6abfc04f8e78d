"""ROS 1 bags: of every compression, damaged, and with an index that is wrong."""

from __future__ import annotations

import bz2
import os
import struct
from pathlib import Path

import psutil
import pytest

from pc2grid.errors import (
    LimitExceeded,
    LogCorrupt,
    LogTruncated,
    NotALog,
)
from pc2grid.io import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.memory import bounded_memory
from tests.helpers.recordings import (
    STEP,
    T0,
    check_drive,
    drive,
    read,
    write_bag,
)

DATA = Path(os.environ.get("PC2GRID_DATA", Path(__file__).resolve().parents[4] / ".." / "shared" / "data"))


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


def test_what_is_no_whole_bag(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "a.bag", drive("ros1")).read_bytes()

    def bag(content: bytes) -> Path:
        path = tmp_path / "b.bag"
        path.write_bytes(content)
        return path

    with pytest.raises(LogTruncated, match=r"b\.bag: .*`rosbag reindex b\.bag`"):
        read(bag(whole[: len(whole) // 2]))
    with pytest.raises(LogTruncated, match="`rosbag reindex"):
        read(bag(whole[:13]))
    with pytest.raises(LogTruncated, match=r"not indexed.*`rosbag reindex"):  # a recorder that was killed
        at = whole.index(b"index_pos=") + 10
        read(bag(whole[:at] + bytes(8) + whole[at + 8 :]))
    with pytest.raises(NotALog, match="ROS 1 bag of an old format"):
        read(bag(b"#ROSBAG V1.2\n" + bytes(50)))


@pytest.mark.parametrize("compression", ["", "bz2", "lz4"])
def test_recover_says_what_mends_a_damaged_bag(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.bag"
    whole = write_bag(path, drive("ros1", scans=60), compression, chunk_bytes=4096).read_bytes()
    check_drive(read(path, recover=True)[0], 60)  # a whole bag is read as without --recover
    unindexed = whole.index(b"index_pos=") + 10  # a recorder that was killed: no index, last chunk cut off
    middle = whole.index(b"compression=", len(whole) // 3)
    damaged = [whole[:unindexed] + bytes(8) + whole[unindexed + 8 : len(whole) // 2]]
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
