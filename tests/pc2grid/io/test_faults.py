"""Damaged, odd and hostile recordings: a Pc2GridError, the clean result, or a loss that is counted."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from pc2grid.config import ReadConfig
from pc2grid.errors import (
    FrameError,
    LimitExceeded,
    LogCorrupt,
    LogNotFound,
    LogTruncated,
    NoScans,
    NotALog,
    Pc2GridError,
    PointCloudError,
    TopicError,
    UnsupportedSchema,
)
from pc2grid.io import open_log
from pc2grid.io.containers.mcap_records import MAGIC
from pc2grid.io.export.mcap import LogWriter
from tests.helpers.recordings import T0, raw_log, read, ros, write_clouds

SCANS = 40


@pytest.fixture(scope="module")
def log_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_clouds(tmp_path_factory.mktemp("log") / "log.mcap").read_bytes()


@pytest.fixture
def damaged(tmp_path: Path, log_bytes: bytes) -> Callable[[bytes], Path]:
    def write(content: bytes) -> Path:
        path = tmp_path / "damaged.mcap"
        path.write_bytes(content)
        return path

    return write


def test_the_clean_log_reads_with_odometry_and_mount(
    damaged: Callable[[bytes], Path], log_bytes: bytes
) -> None:
    scans, report = read(damaged(log_bytes))
    assert len(scans) == SCANS
    assert not report.lossy
    assert scans[0].T_base_sensor[:3, 3].tolist() == [0.2, 0.0, 0.5]
    # Odometry comes 10 ms after each scan: 0.1 m per 0.1 s, so the scan is 0.01 m behind.
    assert scans[5].T_odom_base is not None
    assert scans[5].T_odom_base[0, 3] == pytest.approx(0.49)
    assert float(scans[0].points_m[:, 2].min()) > 1.5


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        (b"", LogTruncated, "empty file"),
        (MAGIC, LogTruncated, "first 8 bytes"),
        (MAGIC[:5], LogTruncated, "ends after 5 bytes"),
        (b"hello world\n", NotALog, "looks like text"),
        (b"#ROSBAG V2.0\n" + b"\0" * 99, Pc2GridError, "bag"),
        (b"SQLite format 3\0" + b"\0" * 99, Pc2GridError, "db3"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 99, NotALog, "PNG image"),
    ],
)
def test_what_is_not_an_mcap(
    damaged: Callable[[bytes], Path], content: bytes, error: type[Pc2GridError], words: str
) -> None:
    with pytest.raises(error, match=words):
        read(damaged(content))


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(LogNotFound, match="no such file"):
        open_log(tmp_path / "none.mcap")
    with pytest.raises(LogNotFound, match="folder without a recording"):
        open_log(tmp_path)


@pytest.mark.parametrize("share", [0.1, 0.35, 0.6, 0.9])
def test_truncated(damaged: Callable[[bytes], Path], log_bytes: bytes, share: float) -> None:
    path = damaged(log_bytes[: int(len(log_bytes) * share)])
    with pytest.raises(LogTruncated, match=r"readable.*--recover"):
        open_log(path)
    if share > 0.5:
        scans, report = read(path, recover=True)
        assert 0 < len(scans) < SCANS
        assert report.bytes_lost > 0


def test_killed_recorder_reads_in_full_with_a_warning(
    damaged: Callable[[bytes], Path], log_bytes: bytes
) -> None:
    # Cut right behind the last chunk's message indexes: where DataEnd (0x0f, length 4) starts.
    end = log_bytes.rindex(b"\x0f" + struct.pack("<Q", 4))
    scans, report = read(damaged(log_bytes[:end]))
    assert len(scans) == SCANS
    assert not report.lossy
    assert any("not closed" in w for w in report.warnings)


def test_bit_flip_in_a_chunk(damaged: Callable[[bytes], Path], log_bytes: bytes) -> None:
    flipped = bytearray(log_bytes)
    flipped[3 * len(flipped) // 4] ^= 0x10  # the second chunk: the first holds tf
    path = damaged(bytes(flipped))
    with pytest.raises(LogCorrupt, match=r"chunk \d+ \(.* s to .* s\).*--recover"):
        read(path)
    scans, report = read(path, recover=True)
    assert 0 < len(scans) < SCANS
    assert report.bytes_lost > 1000


def test_flip_in_the_summary_costs_nothing(damaged: Callable[[bytes], Path], log_bytes: bytes) -> None:
    flipped = bytearray(log_bytes)
    flipped[-100] ^= 0xFF
    scans, report = read(damaged(bytes(flipped)))
    assert len(scans) == SCANS
    assert any("index is not usable" in w for w in report.warnings)


def test_topics(tmp_path: Path) -> None:
    cloud = ("sensor_msgs/msg/PointCloud2", "ros2msg", ros().schema("sensor_msgs/PointCloud2"))
    text = ("std_msgs/msg/String", "ros2msg", b"string data")
    two = raw_log(tmp_path / "two.mcap", [("/a", *cloud, b"\0\1\0\0"), ("/b", *cloud, b"\0\1\0\0")])
    with pytest.raises(TopicError, match=r"/a .*/b .*--topic"):
        read(two)
    with pytest.raises(TopicError, match="did you mean /a"):
        read(two, ReadConfig(topic="/aa"))
    with pytest.raises(PointCloudError, match="no whole sensor_msgs/PointCloud2"):
        read(two, ReadConfig(topic="/a"))
    with pytest.raises(NoScans, match=r"/chat \(std_msgs/String\)"):
        read(raw_log(tmp_path / "none.mcap", [("/chat", *text, b"\0\1\0\0")]))
    with pytest.raises(UnsupportedSchema, match="is of type std_msgs/String"):
        read(tmp_path / "none.mcap", ReadConfig(topic="/chat"))
    with pytest.raises(NoScans, match="no message"):
        read(raw_log(tmp_path / "empty.mcap", [("/a", *cloud, b"")]))
    short = cloud[2].replace(b"uint32 height\n", b"", 1)
    with pytest.raises(UnsupportedSchema, match=r"differently from ROS: .*height"):
        read(raw_log(tmp_path / "odd.mcap", [("/a", cloud[0], "ros2msg", short, b"\0\1\0\0")]))


def test_unknown_compression_and_bomb_and_absurd_length(
    tmp_path: Path, damaged: Callable[[bytes], Path], log_bytes: bytes
) -> None:
    swapped = log_bytes.replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00brot")
    with pytest.raises(UnsupportedSchema, match="brot"):
        read(damaged(swapped))
    with pytest.raises(LimitExceeded, match="max_chunk_bytes"):
        read(damaged(log_bytes), ReadConfig(max_chunk_bytes=1000))
    at = log_bytes.index(b"\x04\x00\x00\x00zstd") - 37
    absurd = log_bytes[: at + 1] + struct.pack("<Q", 1 << 60) + log_bytes[at + 9 :]
    with pytest.raises(LogCorrupt, match="another length"):
        read(damaged(absurd))
    with pytest.raises(LogTruncated, match="does not fit into the file"):
        read(damaged(absurd[:-20]))


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_every_way_of_writing_reads_the_same(
    tmp_path: Path, log_bytes: bytes, chunked: bool, compression: CompressionType
) -> None:
    from mcap.reader import NonSeekingReader

    source = tmp_path / "source.mcap"
    source.write_bytes(log_bytes)
    target = tmp_path / "target.mcap"
    with source.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            if channel.id not in channels:
                key = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", key)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()
    expected = [s.points_m.tobytes() for s in read(source)[0]]
    assert [s.points_m.tobytes() for s in read(target)[0]] == expected


def test_start_and_duration_select_by_time(damaged: Callable[[bytes], Path], log_bytes: bytes) -> None:
    with open_log(damaged(log_bytes)) as log:
        stamps = [s.stamp_ns - T0 for s in log.scans(1.0, 0.5)]
        assert stamps == [1_000_000_000 + i * 100_000_000 for i in range(5)]
        assert [s.stamp_ns for s in log.scans()] == sorted(s.stamp_ns for s in log.scans())
        with pytest.raises(NoScans, match=r"lasts 3\.9 s"):
            list(log.scans(100.0))


def test_frames(tmp_path: Path) -> None:
    path = tmp_path / "frames.mcap"
    cloud = np.ones((5, 3), np.float32)
    with LogWriter(path) as out:
        out.tf_static(T0, "base_link", "lidar_top", np.eye(4))
        out.point_cloud("/points", T0, "lidar_tip", cloud)
    with pytest.raises(FrameError, match=r"lidar_tip to base_link; did the driver mean lidar_top"):
        read(path)
    assert len(read(path, ReadConfig(assume_identity=True))[0]) == 1
    with LogWriter(path, force=True) as out:
        out.tf_static(T0, "a", "b", np.eye(4))
        out.tf_static(T0, "b", "a", np.eye(4))
        out.tf_static(T0, "map", "base_link", np.eye(4))
        out.point_cloud("/points", T0, "a", cloud)
    with pytest.raises(FrameError, match="goes in a circle"):
        read(path)


def test_stamps(tmp_path: Path) -> None:
    path = tmp_path / "stamps.mcap"
    day = 86_400_000_000_000
    offsets = [0, 1, 1, 3, 2, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24]
    with LogWriter(path) as out:
        for i, k in enumerate(offsets):
            stamp = T0 + k * 100_000_000 + (day if k == 8 else 0)
            out.point_cloud("/points", stamp, "lidar", np.full((2, 3), i + 1, np.float32))
    scans, report = read(path)
    stamps = [s.stamp_ns for s in scans]
    assert stamps == sorted(set(stamps))
    assert report.lossy
    assert sum(report.scans_skipped.values()) + len(scans) == len(offsets)
