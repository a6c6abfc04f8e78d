"""The index at the end of an MCAP is used as far as it is there and agrees with the file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import IndexType

from pc2grid.errors import LogCorrupt
from pc2grid.io import open_log
from tests.helpers.recordings import check_drive, drive, read, write_mcap

FOOTER = 37  # opcode, length, summary start, offset start, checksum, magic
STATISTICS, CHUNK_INDEX, CHANNEL, DATA_END = 0x0B, 0x08, 0x04, 0x0F


def summary_of(whole: bytes) -> int:
    return int(struct.unpack("<Q", whole[-FOOTER + 9 : -FOOTER + 17])[0])


def records(section: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at < len(section):
        length = int.from_bytes(section[at + 1 : at + 9], "little")
        found.append((section[at], section[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def with_summary(
    whole: bytes, change: Callable[[int, bytes], bytes | None], *, checked: bool = True
) -> bytes:
    """The file with records of its summary changed or left out, with a right checksum or without one."""
    start = summary_of(whole)
    section = b""
    for opcode, body in records(whole[start:-FOOTER]):
        new = change(opcode, body)
        if new is not None and opcode != 0x0E:  # offsets would be wrong, and are not needed
            section += bytes([opcode]) + struct.pack("<Q", len(new)) + new
    head = b"\x02" + struct.pack("<QQQ", 20, start, 0)
    crc = zlib.crc32(section + head) if checked else 0
    return whole[:start] + section + head + struct.pack("<I", crc) + whole[-8:]


def without(opcode: int) -> Callable[[int, bytes], bytes | None]:
    return lambda kind, body: None if kind == opcode else body


def patched(opcode: int, at: int, layout: str, value: int) -> Callable[[int, bytes], bytes | None]:
    """All records of a kind with one number replaced."""

    def change(kind: int, body: bytes) -> bytes:
        if kind != opcode:
            return body
        size = struct.calcsize(layout)
        return body[:at] + struct.pack(layout, value) + body[at + size :]

    return change


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"index_types": IndexType.NONE}, "chunks"),
        ({"use_statistics": False}, "statistics"),
        ({"repeat_channels": False, "repeat_schemas": False}, "channels"),
        (
            {
                "index_types": IndexType.NONE, "use_statistics": False, "repeat_channels": False,
                "repeat_schemas": False, "use_summary_offsets": False,
            },
            "its writer made none",
        ),
        ({"use_summary_offsets": False}, None),
    ],
)  # fmt: skip
def test_writers_that_leave_parts_out(tmp_path: Path, options: dict[str, Any], words: str | None) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000, **options)
    scans, report = read(path)
    check_drive(scans)
    assert not report.lossy
    said = [warning for warning in report.warnings if "index" in warning]
    assert bool(said) == (words is not None)
    if words:
        assert words in said[0]
    with open_log(path) as log:
        assert {t.topic: t.message_count for t in log.info.topics}["/points"] == 12


@pytest.mark.parametrize(
    "change",
    [
        without(STATISTICS),
        without(CHANNEL),
        without(CHUNK_INDEX),
        patched(STATISTICS, 22, "<I", 99),  # more chunks than listed
        patched(STATISTICS, 10, "<I", 99),  # more channels than listed
        patched(CHUNK_INDEX, 16, "<Q", 3),  # a chunk that begins in the magic,
        patched(CHUNK_INDEX, 16, "<Q", 1 << 60),  # far outside,
        patched(CHUNK_INDEX, 24, "<Q", 1 << 60),  # that reaches outside,
        patched(CHUNK_INDEX, 24, "<Q", 2),  # that is too short for its own head
        patched(CHUNK_INDEX, 16, "<Q", 2000),  # all of them in one place
    ],
)
@pytest.mark.parametrize("checked", [True, False])
def test_a_wrong_index_costs_nothing(
    tmp_path: Path, change: Callable[[int, bytes], bytes | None], checked: bool
) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    path.write_bytes(with_summary(path.read_bytes(), change, checked=checked))
    scans, report = read(path)
    check_drive(scans)
    assert not report.lossy
    assert any("index" in warning for warning in report.warnings)


@pytest.mark.parametrize("start", [1 << 60, 3])
def test_a_footer_that_points_elsewhere(tmp_path: Path, start: int) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    whole = path.read_bytes()
    path.write_bytes(whole[: -FOOTER + 9] + struct.pack("<Q", start) + whole[-FOOTER + 17 :])
    scans, report = read(path)
    check_drive(scans)
    assert any("index is not usable" in warning for warning in report.warnings)


@pytest.mark.parametrize("kind", [0x86, 0x07, 0x09, 0x0C, 0xFF])
@pytest.mark.parametrize("number", [0, 2])
def test_a_chunk_that_looks_like_another_record_is_missed(tmp_path: Path, kind: int, number: int) -> None:
    """With a flipped bit in its first byte, a reader that follows the records passes over the chunk."""
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    clean = read(path)[0]
    whole = bytearray(path.read_bytes())
    at = [i for i in range(8, len(whole)) if whole[i] == 6 and whole[i + 37 : i + 45] == b"\4\0\0\0zstd"][
        number
    ]
    whole[at] = kind
    path.write_bytes(whole)
    with pytest.raises(LogCorrupt, match=r"a\.mcap: chunk"):
        read(path)
    if number == 0:
        return  # it holds tf, without which no scan can be used
    scans, report = read(path, recover=True)
    assert 0 < len(scans) < len(clean)
    assert report.bytes_lost > 300
    assert any("not there" in w or "skipped" in w for w in report.warnings)


def test_counts_that_do_not_add_up_are_not_shown(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    path.write_bytes(with_summary(path.read_bytes(), patched(STATISTICS, 0, "<Q", 5)))
    with open_log(path) as log:
        assert {t.topic: t.message_count for t in log.info.topics}["/points"] is None
        assert log.info.message_count in (None, 5)
    check_drive(read(path)[0])


def test_a_file_without_chunks_whose_data_has_no_end(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), use_chunking=False)
    whole = path.read_bytes()
    at = summary_of(whole) - 13
    assert whole[at] == DATA_END
    path.write_bytes(whole[:at] + b"\x99" + whole[at + 1 :])
    scans, report = read(path)
    check_drive(scans)
    assert any("index is not usable" in warning for warning in report.warnings)


def test_the_span_of_the_index_is_that_of_the_messages(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", drive(), chunk_size=2000)
    with open_log(path) as log:
        indexed = (log.info.start_ns, log.info.end_ns, log.info.message_count)
    whole = path.read_bytes()
    path.write_bytes(with_summary(whole, without(STATISTICS)))
    with open_log(path) as log:
        assert (log.info.start_ns, log.info.end_ns, log.info.message_count) == indexed
    assert np.isfinite(indexed[2])


@pytest.mark.parametrize("options", [{"chunk_size": 2000}, {"use_chunking": False}])
@pytest.mark.parametrize("finished", [True, False])
def test_every_message_passes_through_the_reader_of_mcap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], finished: bool
) -> None:
    """With an index and without one; the survey of a file without an index reads it once more."""
    path = write_mcap(tmp_path / "a.mcap", drive(), **options)
    whole = path.read_bytes()
    if not finished:
        path.write_bytes(whole[: summary_of(whole) - 13])
    seen: list[bytes] = []
    plain = StreamReader._read_record

    def noted(self: StreamReader, opcode: int, length: int) -> Any:
        record = plain(self, opcode, length)
        if isinstance(record, Message):
            seen.append(record.data)
        elif isinstance(record, Chunk):
            seen.extend(m.data for m in breakup_chunk(record, True) if isinstance(m, Message))
        return record

    monkeypatch.setattr(StreamReader, "_read_record", noted)
    with open_log(path) as log:
        found = [bytes(m.data) for m in log._source.messages({t.topic for t in log._source.info.topics})]
    assert len(found) == len(drive())
    assert sorted(seen) == sorted(found)
