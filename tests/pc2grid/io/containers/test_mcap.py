"""MCAP: its index is used as far as it is sound; damage is named, and --recover reads what is certain."""

import io
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType

from pc2grid.errors import FrameError, LimitExceeded, LogCorrupt, LogError, LogTruncated
from pc2grid.io.containers.mcap import BoundedFile
from pc2grid.io.recording import open_log
from pc2grid.settings import ReadConfig
from tests.helpers.memory import peak_memory
from tests.helpers.recordings import STEP, T0, Message, check_drive, drive, read, ros, write_mcap

SCANS = 30
PLAIN = ReadConfig(assume_identity=True)
FOOTER = 37  # opcode, length, summary start, offset start, checksum, magic
CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS, DATA_END = 4, 5, 6, 7, 8, 11, 15


def summary_of(whole: bytes) -> int:
    return int(struct.unpack("<Q", whole[-FOOTER + 9 : -FOOTER + 17])[0])


def unfinished(whole: bytes) -> bytes:
    """The file as a recorder leaves it that is killed before it writes the end of the data."""
    return whole[: summary_of(whole) - 13]


# --- the index ----------------------------------------------------------------------------------------


def with_summary(
    whole: bytes, change: Callable[[int, bytes], bytes | None], *, checked: bool = True, behind: bytes = b""
) -> bytes:
    """The file with records of its summary changed or left out, with a right checksum or without one.

    behind : records to put behind the last chunk.
    """
    at = start = summary_of(whole)
    section = b""
    while at < len(whole) - FOOTER:
        opcode, length = whole[at], int.from_bytes(whole[at + 1 : at + 9], "little")
        new = change(opcode, whole[at + 9 : at + 9 + length])
        if new is not None and opcode != 0x0E:  # offsets would be wrong, and are not needed
            section += bytes([opcode]) + struct.pack("<Q", len(new)) + new
        at += 9 + length
    head = b"\x02" + struct.pack("<QQQ", 20, start + len(behind), 0)
    crc = zlib.crc32(section + head) if checked else 0
    data = whole[: start - 13] + behind + whole[start - 13 : start]
    return data + section + head + struct.pack("<I", crc) + whole[-8:]


def without(opcode: int) -> Callable[[int, bytes], bytes | None]:
    return lambda kind, body: None if kind == opcode else body


def patched(opcode: int, at: int, layout: str, value: int) -> Callable[[int, bytes], bytes | None]:
    """All records of a kind with one number replaced."""

    def change(kind: int, body: bytes) -> bytes:
        new = struct.pack(layout, value)
        return body[:at] + new + body[at + len(new) :] if kind == opcode else body

    return change


NOTHING: dict[str, Any] = {
    "index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False,
    "repeat_schemas": False, "use_summary_offsets": False,
}  # fmt: skip


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"index_types": IndexType.NONE}, "chunks"),
        ({"use_statistics": False}, "its writer made none"),
        ({"repeat_channels": False, "repeat_schemas": False}, "channels"),
        (NOTHING, "its writer made none"),
        ({"use_summary_offsets": False}, None),
    ],
)
def test_writers_that_leave_parts_out(tmp_path: Path, options: dict[str, Any], words: str | None) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000, **options)
    scans, report = read(path)
    check_drive(scans)
    assert not report.lossy
    said = [warning for warning in report.warnings if "index" in warning]
    assert bool(said) == (words is not None)
    assert words is None or words in said[0]
    whole = write_mcap(tmp_path / "b.mcap", drive(), chunk_size=2000)
    with open_log(path) as log, open_log(whole) as usual:
        assert [log.info.start_ns, log.info.end_ns] == [usual.info.start_ns, usual.info.end_ns]
        assert (log.info.message_count, log.info.topics) == (usual.info.message_count, usual.info.topics)
        counts = [[t.message_count for t in info.topics] for info in (log.info, usual.info)]
        assert counts[0] == counts[1]


def footer_of(whole: bytes, start: int) -> bytes:
    """The file whose footer says that the summary begins elsewhere."""
    return whole[: -FOOTER + 9] + struct.pack("<Q", start) + whole[-FOOTER + 17 :]


def another_topic(whole: bytes) -> bytes:
    at = whole.rindex(b"/tf_static") + 1
    return whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]


INCOMPLETE = [
    without(STATISTICS),
    without(CHANNEL),
    without(CHUNK_INDEX),
    patched(STATISTICS, 22, "<I", 99),  # more chunks than listed
    patched(STATISTICS, 10, "<I", 99),  # more channels than listed
]


@pytest.mark.fault(9)
@pytest.mark.parametrize(
    "damaged",
    [
        *(partial(with_summary, change=change, checked=True) for change in INCOMPLETE),
        *(partial(with_summary, change=change, checked=False) for change in INCOMPLETE),
        *(partial(footer_of, start=start) for start in (1 << 60, 3)),
        another_topic,
    ],
)
def test_a_summary_that_is_not_usable_costs_nothing(
    tmp_path: Path, damaged: Callable[[bytes], bytes]
) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    path.write_bytes(damaged(path.read_bytes()))
    scans, report = read(path)
    check_drive(scans)
    assert not report.lossy
    assert any("the index is not usable" in warning for warning in report.warnings)


@pytest.mark.parametrize("place", [3, 2000, 1 << 60])
def test_an_index_that_points_elsewhere_is_damage(tmp_path: Path, place: int) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    path.write_bytes(with_summary(path.read_bytes(), patched(CHUNK_INDEX, 16, "<Q", place)))
    with pytest.raises(LogError, match=rf"a\.mcap: chunk at byte {place}: .*recover=True"):
        read(path)


# --- damage -------------------------------------------------------------------------------------------


class Part(NamedTuple):
    """A chunk: where it stands, where its data begin, and which scans are in it."""

    start: int
    body: int
    end: int
    scans: tuple[int, ...]


def clouds() -> list[np.ndarray]:
    return [np.random.default_rng(i).normal(size=(50, 3)).astype("f4") for i in range(SCANS)]


def recording(path: Path, compression: CompressionType = CompressionType.ZSTD, **options: Any) -> bytes:
    messages = [ros().cloud("/points", T0 + i * STEP, points) for i, points in enumerate(clouds())]
    options = {"chunk_size": 2000, "compression": compression, **options}
    return write_mcap(path, messages, **options).read_bytes()


def parts(whole: bytes) -> list[Part]:
    found: list[Part] = []
    at = 8
    while whole[at] != DATA_END:
        end = at + 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
        if whole[at] == CHUNK:
            low, high = struct.unpack("<QQ", whole[at + 9 : at + 25])
            mark = int.from_bytes(whole[at + 37 : at + 41], "little")
            scans = tuple(range((low - T0) // STEP, (high - T0) // STEP + 1))
            found.append(Part(at, at + 41 + mark + 8, end, scans))
        at = end
    return found


def recovered(path: Path, content: bytes) -> tuple[list[int], int]:
    """Which scans are read, each of them whole, and how many bytes are lost."""
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"a\.mcap"):
        read(path, PLAIN)
    scans, report = read(path, PLAIN, recover=True)
    numbers = [(scan.stamp_ns - T0) // STEP for scan in scans]
    wanted = clouds()
    for number, scan in zip(numbers, scans, strict=True):
        np.testing.assert_array_equal(scan.points_m, wanted[number])
    return numbers, report.bytes_lost


DAMAGES: dict[str, Callable[[Part], tuple[int, bytes]]] = {
    "kind": lambda p: (p.start, b"\0"),
    "kind of another program": lambda p: (p.start, b"\x86"),
    "length": lambda p: (p.start + 1, b"\xff" * 8),
    "length a little": lambda p: (p.start + 1, struct.pack("<Q", p.end - p.start - 9 + 3)),
    "stored length": lambda p: (p.body - 8, struct.pack("<Q", p.end - p.body + 1)),
    "content": lambda p: ((p.body + p.end) // 2, b"\x55\xaa\x55\xaa"),
    "checksum": lambda p: (p.start + 33, b"\x01\x02\x03\x04"),
    "size": lambda p: (p.start + 25, struct.pack("<Q", 1999)),
    "size without end": lambda p: (p.start + 25, struct.pack("<Q", 1 << 40)),
    "compression": lambda p: (p.start + 37, b"x"),
    "header": lambda p: (p.start + 9, bytes(p.body - p.start - 9)),  # of an empty chunk without a checksum
    "all of it": lambda p: (p.start, b"\xee" * (p.end - p.start)),
}


@pytest.mark.fault(7)
@pytest.mark.parametrize("damage", DAMAGES)
def test_with_an_index_only_the_damaged_chunk_is_lost(tmp_path: Path, damage: str) -> None:
    for compression in CompressionType:
        whole = recording(tmp_path / "a.mcap", compression)
        chunks = parts(whole)
        assert len(chunks) > 6
        for chunk in (chunks[0], chunks[3], chunks[-1]):
            at, new = DAMAGES[damage](chunk)
            found, lost = recovered(tmp_path / "a.mcap", whole[:at] + new + whole[at + len(new) :])
            assert found == [i for i in range(SCANS) if i not in chunk.scans]
            assert lost == chunk.end - chunk.start


@pytest.mark.fault(7)
@pytest.mark.parametrize("damage", ["length", "content", "checksum", "size", "size without end"])
def test_without_an_index_the_log_is_read_up_to_its_first_damage(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path)
    chunk = parts(whole)[3]
    at, new = DAMAGES[damage](chunk)
    content = unfinished(whole[:at] + new + whole[at + len(new) :])
    path.write_bytes(content)
    count = chunk.scans[0]
    words = rf"{count} messages before it are readable .*"
    with pytest.raises(LogError, match=rf"a\.mcap: at byte \d+ of {len(content)}: .*; {words}"):
        read(path, PLAIN)
    found, lost = recovered(path, content)
    assert found == list(range(count))
    assert lost >= len(content) - chunk.start


def test_whether_tf_is_lost_is_known_where_the_summary_lists_the_topics(tmp_path: Path) -> None:
    """Without a summary, tf may stand behind the damage, so no frame is guessed."""
    path = tmp_path / "a.mcap"
    whole = recording(path)
    at, new = DAMAGES["content"](parts(whole)[3])
    content = whole[:at] + new + whole[at + len(new) :]
    path.write_bytes(content)
    _, report = read(path, recover=True)
    assert any("taken for the robot's base" in w for w in report.warnings)
    path.write_bytes(unfinished(content))
    with pytest.raises(FrameError, match="lidar"):
        read(path, recover=True)


@pytest.mark.fault(6)
def test_a_file_that_ends_is_truncated_and_one_that_was_not_closed_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path)
    chunk = parts(whole)[-1]
    for size in (chunk.start + 5, chunk.start + 9, chunk.start + 30, chunk.end - 1):
        path.write_bytes(whole[:size])
        before = SCANS - len(chunk.scans)
        with pytest.raises(LogTruncated, match=rf"at byte {chunk.start} of {size}: .*; {before} messages"):
            read(path, PLAIN)
    for end in (chunk.end, len(unfinished(whole))):
        path.write_bytes(whole[:end])
        scans, report = read(path, PLAIN)
        assert len(scans) == SCANS
        assert not report.lossy
        assert any("was not closed" in warning for warning in report.warnings)
    path.write_bytes(whole + b"junk")
    assert len(read(path, PLAIN)[0]) == SCANS


def test_a_chunk_that_is_cut_out_with_its_index_is_missed(tmp_path: Path) -> None:
    """It held the sensor's pose, and only a count is wrong: this must not pass for a log without tf."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=200)
    whole = path.read_bytes()
    first, second = (part.start for part in parts(whole)[:2])
    path.write_bytes(whole[:first] + whole[second:])
    with pytest.raises(FrameError, match="tf does not connect frame lidar to the base"):
        read(path)
    _, report = read(path, PLAIN)
    assert "1 messages that the log counts are not there" in report.warnings


# --- messages outside of chunks -----------------------------------------------------------------------


def test_the_checksum_of_the_data_protects_messages_outside_of_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    whole = recording(path, use_chunking=False, enable_data_crcs=True)
    scans, report = read(path, PLAIN)
    assert len(scans) == SCANS
    assert not any("no checksum" in warning for warning in report.warnings)
    half = len(whole) // 2
    found, lost = recovered(path, whole[:half] + bytes([whole[half] ^ 1]) + whole[half + 1 :])
    assert len(found) < SCANS or lost
    path.write_bytes(unfinished(whole))
    assert any("no checksum" in warning for warning in read(path, PLAIN)[1].warnings)


def record(opcode: int, body: bytes) -> bytes:
    return bytes([opcode]) + struct.pack("<Q", len(body)) + body


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


HEADER = b"\x89MCAP0\r\n" + record(1, text(b"ros2") + text(b"me"))
A = record(CHANNEL, struct.pack("<HH", 1, 0) + text(b"/a") + text(b"cdr") + struct.pack("<I", 0))
ONE, OF_NONE = (record(MESSAGE, struct.pack("<HIQQ", key, 0, T0, T0) + b"\0\1\0\0") for key in (1, 2))


def chunk_of(content: bytes, size: int | None = None) -> bytes:
    """A chunk with a right checksum."""
    head = struct.pack("<QQQI", T0, T0, len(content) if size is None else size, zlib.crc32(content))
    return record(CHUNK, head + text(b"") + struct.pack("<Q", len(content)) + content)


@pytest.mark.fault(12)
@pytest.mark.parametrize(
    ("body", "words"),
    [
        (record(CHANNEL, b"\1\0"), "ends within"),
        (chunk_of(A + OF_NONE), "channel 2, which is missing"),
        (chunk_of(A + ONE[:-3]) + chunk_of(ONE + ONE[:5]), "damaged"),
        (chunk_of(ONE[:9], size=99), "does not hold 99 bytes"),
        (record(CHUNK, bytes(28) + text(b"") + struct.pack("<Q", 999)), "ends within 999 bytes"),
    ],
)
def test_records_that_contradict_themselves(tmp_path: Path, body: bytes, words: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(HEADER + body)
    with pytest.raises(LogError, match=words) as caught:
        read(path)
    assert "a.mcap: at byte" in str(caught.value)


@pytest.mark.parametrize("indexed", [True, False])
def test_messages_outside_of_the_chunks_are_read(tmp_path: Path, indexed: bool) -> None:
    """They stand behind the last chunk; the index in the summary lists the chunks alone."""
    *messages, last = drive()
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_size=2000)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (key,) = (channel.id for channel in summary.channels.values() if channel.topic == last.topic)
    times = last.log_time_ns, last.log_time_ns
    loose = record(MESSAGE, struct.pack("<HIQQ", key, 0, *times) + last.data)
    whole = with_summary(path.read_bytes(), lambda kind, body: body, behind=loose)
    path.write_bytes(whole if indexed else unfinished(whole))
    scans, report = read(path)
    check_drive(scans)
    assert not report.lossy
    said = "does not list the messages outside of the chunks" if indexed else "was not closed"
    assert any(said in warning for warning in report.warnings)


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"compression": CompressionType.NONE}])
def test_a_record_larger_than_the_limit(tmp_path: Path, options: dict[str, Any]) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), **options)
    with pytest.raises(LimitExceeded, match=r"a\.mcap: .*the limit is 100.*max_record_bytes"):
        read(path, ReadConfig(max_record_bytes=100))


def test_records_of_users_are_passed_over(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    whole = path.read_bytes()
    at = 17 + int.from_bytes(whole[9:17], "little")
    path.write_bytes(whole[:at] + record(0x90, b"ours") + whole[at:])
    check_drive(read(path)[0])


# --- A file that refuses to read more at once than is allowed, or than there is ---


@pytest.fixture
def file(tmp_path: Path) -> BoundedFile:
    path = tmp_path / "a"
    path.write_bytes(bytes(range(100)))
    return BoundedFile(io.FileIO(path), most_bytes=40)


def test_what_is_allowed_is_read_and_no_more(file: BoundedFile) -> None:
    assert file.read(40) == bytes(range(40))
    with pytest.raises(LimitExceeded, match=r"a record has 41 bytes; the limit is 40 .*max_record_bytes"):
        file.read(41)
    file.seek(95)
    with pytest.raises(LogTruncated, match="ends within"):
        file.read(6)
    assert file.read(5) == bytes(range(95, 100))


@pytest.mark.parametrize("size", [-1, -5, None])
def test_a_length_that_is_none_is_damage(file: BoundedFile, size: int | None) -> None:
    with pytest.raises(LogCorrupt, match="where a record should begin"):
        file.read(size)


MIB = 1 << 20


def test_small_messages_do_not_keep_large_chunks_in_memory(tmp_path: Path) -> None:
    """16 chunks of 8 MB that overlap in time, each with one scan among images that are not read."""
    image = Message("/other", "sensor_msgs/Image", T0, bytes(8 * MIB))
    messages = []
    for i in range(16):
        messages += [image, ros().cloud("/points", T0 + i * STEP, [[1, 2, 3]])]
    path = write_mcap(tmp_path / "a.mcap", messages, chunk_size=7 * MIB)
    assert path.stat().st_size < MIB
    with peak_memory() as peak:
        assert len(read(path, ReadConfig(assume_identity=True))[0]) == 16
    assert peak.grown_bytes() < 66 * MIB
