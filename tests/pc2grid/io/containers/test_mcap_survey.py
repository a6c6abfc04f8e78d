"""With --recover, reading continues at the next whole chunk after damage in an MCAP; nothing else is lost."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType

from pc2grid.config import ReadConfig
from pc2grid.errors import FrameError, LimitExceeded, LogCorrupt, LogError, LogTruncated, UnsupportedSchema
from pc2grid.io.containers import mcap_survey
from pc2grid.model import ReadReport
from tests.helpers.recordings import STEP, T0, drive, read, ros, write_mcap

SCANS = 30
PLAIN = ReadConfig(assume_identity=True)
CHUNK, MESSAGE_INDEX, DATA_END = 6, 7, 15


class Part(NamedTuple):
    """A chunk: where it and its message indexes stand, and which scans are in it."""

    start: int
    body: int
    end: int
    after: int
    scans: tuple[int, ...]


def clouds() -> list[np.ndarray]:
    return [np.random.default_rng(i).normal(size=(50, 3)).astype("f4") for i in range(SCANS)]


def recording(path: Path, compression: CompressionType) -> bytes:
    messages = [ros().cloud("/points", T0 + i * STEP, points) for i, points in enumerate(clouds())]
    return write_mcap(path, messages, chunk_size=2000, compression=compression).read_bytes()


def parts(whole: bytes) -> list[Part]:
    found: list[Part] = []
    at = 8
    while whole[at] != DATA_END:
        length = int.from_bytes(whole[at + 1 : at + 9], "little")
        end = at + 9 + length
        if whole[at] == CHUNK:
            low, high = struct.unpack("<QQ", whole[at + 9 : at + 25])
            mark = int.from_bytes(whole[at + 37 : at + 41], "little")
            scans = tuple(range((low - T0) // STEP, (high - T0) // STEP + 1))
            found.append(Part(at, at + 41 + mark + 8, end, end, scans))
        elif whole[at] == MESSAGE_INDEX:
            found[-1] = found[-1]._replace(after=end)
        at = end
    return found


def recovered(path: Path, content: bytes) -> tuple[list[int], ReadReport]:
    """Which scans are read, each of them whole."""
    path.write_bytes(content)
    with pytest.raises(LogError):
        read(path, PLAIN)
    scans, report = read(path, PLAIN, recover=True)
    numbers = [(scan.stamp_ns - T0) // STEP for scan in scans]
    wanted = clouds()
    for number, scan in zip(numbers, scans, strict=True):
        np.testing.assert_array_equal(scan.points_m, wanted[number])
    return numbers, report


DAMAGES: dict[str, Callable[[Part], tuple[int, bytes]]] = {
    "kind": lambda p: (p.start, b"\0"),
    "length": lambda p: (p.start + 1, b"\xff" * 8),
    "length a little": lambda p: (p.start + 1, struct.pack("<Q", p.end - p.start - 9 + 3)),
    "stored length": lambda p: (p.body - 8, struct.pack("<Q", p.end - p.body + 1)),
    "content": lambda p: ((p.body + p.end) // 2, b"\x55\xaa\x55\xaa"),
    "checksum": lambda p: (p.start + 33, b"\x01\x02\x03\x04"),
    "size": lambda p: (p.start + 25, struct.pack("<Q", 1999)),
    "compression": lambda p: (p.start + 37, b"x"),
    "times": lambda p: (p.start + 9, struct.pack("<Q", T0 + 10 * STEP * SCANS)),
    "all of it": lambda p: (p.start, b"\xee" * (p.end - p.start)),
}


@pytest.mark.fault(7)
@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("damage", DAMAGES)
def test_only_the_damaged_chunk_is_lost(tmp_path: Path, compression: CompressionType, damage: str) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, compression)
    chunks = parts(whole)
    assert len(chunks) > 6
    for chunk in (chunks[0], chunks[3], chunks[-1]):
        content = bytearray(whole)
        at, new = DAMAGES[damage](chunk)
        content[at : at + len(new)] = new
        found, report = recovered(path, bytes(content))
        assert found == [i for i in range(SCANS) if i not in chunk.scans]
        # Up to the next record, or chunk, or to the end where there is none.
        beyond = len(whole) if chunk is chunks[-1] else chunk.after
        hidden = damage in ("kind", "length", "length a little", "all of it")
        assert report.bytes_lost == (beyond if hidden else chunk.end) - chunk.start
        assert [f"at byte {chunk.start}:" in w for w in report.warnings if "skipped" in w] == [True]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_each_place_of_damage_costs_its_own_chunk(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, compression)
    chunks = parts(whole)
    hit = [chunks[i] for i in (1, 2, 5)]
    content = bytearray(whole)
    for chunk, damage in zip(hit, ("length", "content", "kind"), strict=True):
        at, new = DAMAGES[damage](chunk)
        content[at : at + len(new)] = new
    found, report = recovered(path, bytes(content))
    assert found == [i for i in range(SCANS) if not any(i in chunk.scans for chunk in hit)]
    assert sum(c.end - c.start for c in hit) <= report.bytes_lost <= sum(c.after - c.start for c in hit)


def test_whether_tf_is_lost_is_known_where_the_summary_lists_the_topics(tmp_path: Path) -> None:
    """Without a summary the lost chunk may have held the tf, so no frame is guessed."""
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    chunk = parts(whole)[3]
    at, new = DAMAGES["content"](chunk)
    content = whole[:at] + new + whole[at + len(new) :]
    path.write_bytes(content)
    scans, report = read(path, recover=True)
    assert len(scans) == SCANS - len(chunk.scans)
    assert any("taken for the robot's base" in w for w in report.warnings)
    path.write_bytes(content[: parts(whole)[-1].end])
    with pytest.raises(FrameError, match="lidar"):
        read(path, recover=True)
    path.write_bytes(whole[: parts(whole)[-1].end - 1])  # nothing is lost in front of what is read
    assert len(read(path, recover=True)[0]) == SCANS - len(parts(whole)[-1].scans)


@pytest.mark.parametrize("window", [1, 45, 46, 64, 1000])
@pytest.mark.parametrize("junk", [1, 40, 63, 64, 5000])
def test_junk_between_chunks_hides_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: int, junk: int
) -> None:
    """Wherever the next chunk begins within the blocks that are searched."""
    monkeypatch.setattr(mcap_survey, "_WINDOW_BYTES", window)
    path = tmp_path / "a.mcap"
    whole = recording(path, list(CompressionType)[junk % 3])
    at = parts(whole)[4].start
    found, report = recovered(path, whole[:at] + b"\0" * junk + whole[at:])
    assert found == list(range(SCANS))
    assert report.bytes_lost == junk


@pytest.mark.parametrize("name", [b"\4\0\0\0zstd", b"\3\0\0\0lz4", bytes(4)])
def test_what_only_looks_like_a_chunk_is_passed_over(tmp_path: Path, name: bytes) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    at = parts(whole)[4].start
    rest = len(whole) - at
    junk = b"\0" * 9
    for length, plain, stored in (
        (500, 400, 500 - 36 - len(name) + 1),  # lengths that contradict each other
        (500, 400, 500),
        (rest + 5000, rest + 5000 - 36 - len(name), rest + 5000 - 36 - len(name)),  # beyond the end
        *([(500, 400, 500 - 36 - len(name))] if not any(name) else []),  # not compressed, and yet smaller
    ):
        junk += b"\x06" + struct.pack("<QQQQI", length, 0, 0, plain, 0) + name + struct.pack("<Q", stored)
    found, report = recovered(path, whole[:at] + junk + whole[at:])
    assert found == list(range(SCANS))
    assert [w for w in report.warnings if "skipped" in w] == [
        f"not a record, at byte {at}: {len(junk)} bytes were skipped"
    ]


@pytest.mark.parametrize(
    ("at", "new", "error", "words"),
    [
        (41, b"brot", UnsupportedSchema, "compressed with 'brot'"),
        (25, struct.pack("<Q", 1 << 40), LimitExceeded, "would expand to 1099511627776 bytes"),
    ],
)
def test_a_chunk_that_is_not_read_is_one_that_is_lost(
    tmp_path: Path, at: int, new: bytes, error: type[LogError], words: str
) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    chunk = parts(whole)[3]
    at += chunk.start
    content = whole[:at] + new + whole[at + len(new) :]
    for whole_or_unfinished in (content, content[: parts(whole)[-1].end]):
        path.write_bytes(whole_or_unfinished)
        with pytest.raises(error, match=words):
            read(path, PLAIN)
        found, report = recovered(path, whole_or_unfinished)
        assert found == [i for i in range(SCANS) if i not in chunk.scans]
        assert report.bytes_lost == chunk.end - chunk.start
        assert any(words in w for w in report.warnings)


# --- records that fit into the file and are wrong -----------------------------------------------------


def record(kind: int, body: bytes) -> bytes:
    return bytes([kind]) + struct.pack("<Q", len(body)) + body


def chunk_of(content: bytes, low: int = T0, high: int = T0, crc: int | None = None) -> bytes:
    """A chunk whose checksum is right."""
    crc = zlib.crc32(content) if crc is None else crc
    head = struct.pack("<QQQII", low, high, len(content), crc, 0)
    return record(CHUNK, head + struct.pack("<Q", len(content)) + content)


def message(channel: int, time_ns: int, data: bytes = b"") -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + data)


TEXT = struct.pack("<I", 1) + b"a"
WRONG_RECORDS = {
    "schema too short": (record(3, b"\1"), "shorter than its fields"),
    "schema of number 0": (record(3, b"\0\0" + TEXT + TEXT + TEXT), "schema 0 is defined twice"),
    "schema that ends in a name": (record(3, b"\7\0\t\0\0\0a"), "shorter than its fields"),
    "schema whose name is no text": (record(3, b"\7\0\1\0\0\0\xff"), "a name is not text"),
    "schema defined again": (record(3, b"\1\0" + TEXT + TEXT + TEXT), "schema 1 is defined twice"),
    "channel too short": (record(4, b"\1"), "shorter than its fields"),
    "channel defined again": (record(4, b"\1\0\1\0" + TEXT + TEXT + bytes(4)), "channel 1 is defined twice"),
    "channel without schema": (
        record(4, b"\7\0\7\0" + TEXT + TEXT + bytes(4)),
        "names schema 7, which is missing",
    ),
    "message too short": (record(5, bytes(21)), "shorter than its fields"),
    "message of no channel": (message(7, T0), "names channel 7, which is missing"),
    "chunk too short": (record(CHUNK, bytes(9)), "shorter than its fields"),
    "chunk with another length": (record(CHUNK, bytes(41)), "contradict each other"),
    "chunk of other size": (
        record(CHUNK, struct.pack("<QQQIIQ", T0, T0, 5, 0, 0, 4) + bytes(4)),
        "a chunk has 4 bytes instead of 5",
    ),
    "chunk of another checksum": (chunk_of(b"", crc=1), "checksum (CRC) is wrong"),
    "chunk that ends in a head": (chunk_of(bytes(8)), "a chunk ends within a record"),
    "chunk that ends in a record": (chunk_of(record(9, b"abc")[:-1]), "a chunk ends within a record"),
    "message too short in a chunk": (chunk_of(record(5, bytes(21))), "a message is shorter than its fields"),
    "message of no channel in a chunk": (chunk_of(message(7, T0)), "names channel 7, which is missing"),
    "message before its chunk": (chunk_of(message(1, T0 - 1)), "a chunk's times contradict its messages"),
    "message behind its chunk": (chunk_of(message(1, T0 + 1)), "a chunk's times contradict its messages"),
    "no record": (record(0, b""), "not a record"),
    "of a kind nobody knows": (record(0x10, b"abc"), "a record of unknown kind 0x10"),
    "data end too short": (record(DATA_END, b"abc"), "shorter than its fields"),
}  # fmt: skip


@pytest.mark.fault(12)
@pytest.mark.parametrize("wrong", WRONG_RECORDS)
def test_a_wrong_record_is_named_and_passed_over(tmp_path: Path, wrong: str) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    at = parts(whole)[4].start
    new, words = WRONG_RECORDS[wrong]
    without_end = whole[: whole.index(record(DATA_END, b"")[:1] + struct.pack("<Q", 4), at)]
    path.write_bytes(without_end[:at] + new + without_end[at:])
    with pytest.raises(
        LogCorrupt, match=re.escape(words) + rf", at byte {at} of \d+; {at_most(whole, at)} messages"
    ):
        read(path, PLAIN)
    found, report = recovered(path, path.read_bytes())
    assert found == list(range(SCANS))
    assert report.bytes_lost == len(new)
    assert any(words in w and f"at byte {at}" in w for w in report.warnings)


def at_most(whole: bytes, at: int) -> int:
    """How many messages stand before a place."""
    return sum(len(part.scans) for part in parts(whole) if part.end <= at)


@pytest.mark.parametrize("kind", [0x80, 0xFF, 9, 12])
def test_records_of_other_people_are_passed_over(tmp_path: Path, kind: int) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    at = parts(whole)[4].start
    for content in (
        whole[:at] + record(kind, b"abc") + whole[at:],
        whole[:at] + chunk_of(record(kind, b"abc")) + whole[at:],
        whole[:at] + chunk_of(message(1, T0 + 5, whole[:0])[:0]) + whole[at:],
    ):
        path.write_bytes(content[: content.rindex(b"\x0f" + struct.pack("<Q", 4))])
        scans, report = read(path, PLAIN)
        assert len(scans) == SCANS
        assert not report.lossy


def test_a_file_that_ends_is_truncated_and_one_that_is_wrong_is_corrupt(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, CompressionType.ZSTD)
    chunk = parts(whole)[-1]
    for size in (chunk.start + 5, chunk.start + 9, chunk.start + 30, chunk.end - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(
            LogTruncated, match=rf"at byte {chunk.start} of {size}; {SCANS - len(chunk.scans)} messages"
        ):
            read(path, PLAIN)
    path.write_bytes(whole[: chunk.end] + b"\0" * 9)
    with pytest.raises(LogCorrupt, match=f"not a record, at byte {chunk.end} of"):
        read(path, PLAIN)
    path.write_bytes(whole + b"\0")
    with pytest.raises(LogCorrupt, match=f"1 bytes follow the end of the log, at byte {len(whole)} of"):
        read(path, PLAIN)
    path.write_bytes(whole[:-1])
    with pytest.raises(LogTruncated, match="the end mark is missing"):
        read(path, PLAIN)


def test_the_checksum_of_the_data_section_covers_what_is_between_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    messages = [ros().cloud("/points", T0 + i * STEP, points) for i, points in enumerate(clouds())]
    whole = write_mcap(path, messages, chunk_size=2000, enable_data_crcs=True).read_bytes()
    words = "the checksum of the data section is wrong, outside of the chunks"
    scans, report = read(path, PLAIN, recover=True)
    assert len(scans) == SCANS
    assert words not in report.warnings
    index = parts(whole)[3]
    content = bytearray(whole)
    content[index.after - 1] ^= 1  # of a message index, which is not needed
    path.write_bytes(content)
    scans, report = read(path, PLAIN, recover=True)
    assert len(scans) == SCANS
    assert words in report.warnings
    assert not report.lossy
    path.write_bytes(whole[: index.start] + b"\0" * 9 + whole[index.start :])
    _, report = read(path, PLAIN, recover=True)
    assert report.bytes_lost == 9  # reported once, as what it is
    assert words not in report.warnings


# --- losses that only a count or a missing topic shows -------------------------------------------------


def test_tf_may_be_among_what_is_lost_without_a_trace(tmp_path: Path) -> None:
    """The chunk with tf and its channel is damaged, and so is the index: the sensor's pose is not guessed."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=200, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    place = content.index(b"/tf_static")
    content[place : place + 4] = b"\xff\xff\xff\xff"
    (tmp_path / "b.mcap").write_bytes(content[:-100])
    with pytest.raises(FrameError, match="tf does not connect frame lidar to the base") as caught:
        read(tmp_path / "b.mcap", recover=True)
    assert "assume_identity" in str(caught.value.hint)
    scans, report = read(tmp_path / "b.mcap", ReadConfig(assume_identity=True), recover=True)
    assert scans
    assert report.lossy


@pytest.mark.parametrize("recover", [False, True])
@pytest.mark.parametrize("counted", [True, False])
def test_chunk_of_an_mcap_that_is_cut_out_with_its_indexes(
    tmp_path: Path, recover: bool, counted: bool
) -> None:
    """Every other record stands where it should; only the summary shows that messages are missing."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000, use_statistics=counted)
    whole, chunks = path.read_bytes(), chunks_of(path)
    path.write_bytes(whole[: chunks[2]] + whole[chunks[3] :])
    scans, report = read(path, recover=recover)
    assert 0 < len(scans) < 12
    assert any("the index is not usable" in warning for warning in report.warnings)
    said = any("messages that the log counts are not there" in warning for warning in report.warnings)
    assert said == counted


def test_chunk_of_an_mcap_with_tf_that_is_cut_out(tmp_path: Path) -> None:
    """It held the sensor's pose, and only a count is wrong: this must not pass for a log without tf."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=200, compression=CompressionType.NONE)
    whole, chunks = path.read_bytes(), chunks_of(path)
    after = next(place for place in chunks if place > whole.index(b"/tf_static"))
    path.write_bytes(whole[: chunks[0]] + whole[after:])
    for recover in (False, True):
        with pytest.raises(FrameError, match="tf does not connect frame lidar to the base"):
            read(path, recover=recover)


def chunks_of(path: Path) -> list[int]:
    """Where the chunks of a sound MCAP begin."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [index.chunk_start_offset for index in summary.chunk_indexes]
